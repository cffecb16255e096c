"""Motion control of the SVGS routine: Algorithms 2 to 6, one setpoint after the other."""

import math
from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.schedule import SUPERVISOR_PERIOD
from systems.signals.measurement import SETPOINT, VEHICLE_ESTIMATE, Layout
from systems.supervisors import svgs_routine as routine
from systems.supervisors.svgs_routine import COMMAND, SvgsRoutineConfig

if TYPE_CHECKING:
    from collections.abc import Callable

_P = VEHICLE_ESTIMATE.slice("p_WB")
_H_COUNTER = VEHICLE_ESTIMATE.index("horizontal_reset_counter")
_H_RESET = VEHICLE_ESTIMATE.slice("horizontal_reset")
_V_COUNTER = VEHICLE_ESTIMATE.index("vertical_reset_counter")
_V_RESET = VEHICLE_ESTIMATE.index("vertical_reset")
_YAW_Q = VEHICLE_ESTIMATE.slice("q_WB")

MEMORY = Layout(
    "SvgsMotionMemory",
    (
        "begun",  # s, of the manoeuvre under way
        "next",  # s, when the next setpoint is due: the algorithms' sleep
        "row",  # Algorithm 2's i
        "column",  # Algorithm 2's j
        "level",  # m, height at the manoeuvre's beginning
        "yaw",  # rad, heading at the first manoeuvre's beginning
        "horizontal_resets",
        "vertical_resets",
    ),
)


class Motion:
    """One event of motion control: what is known, and the setpoint to be decided.

    Attributes
    ----------
    time : float
        s.
    x, y, z : float
        The estimated position, m in W: the paper's CurrF, CurrL, CurrU.
    command : named view of `COMMAND`
    memory : named view of `MEMORY`
    setpoint : named view of `SETPOINT`
    done : bool
        Whether the manoeuvre is finished.
    """

    def __init__(
        self,
        time: float,
        position: np.ndarray,
        command: np.ndarray,
        memory: np.ndarray,
        setpoint: np.ndarray,
    ):
        self.time = time
        self.x, self.y, self.z = position.tolist()
        self.command = COMMAND(command)
        self.memory = MEMORY(memory)
        self.setpoint = SETPOINT(setpoint)
        self.done = False

    @property
    def age(self) -> float:
        """Time in the manoeuvre, s."""
        return float(self.time - self.memory.begun)

    def send(self, x: float, y: float, z: float, wait: float) -> None:
        """Ask for a position (m), and sleep for `wait` seconds."""
        self.setpoint.p_WB_x, self.setpoint.p_WB_y, self.setpoint.p_WB_z = x, y, z
        self.memory.next = self.time + wait


class SvgsMotionControl(LeafSystem):
    """Carries out the manoeuvre that the commander asks for.

    .. pydrake_system::
        name: SvgsMotionControl
        input_ports:
        - command
        - estimate
        output_ports:
        - setpoint
        - feedback

    | port | layout | meaning |
    |---|---|---|
    | `command` | `svgs_routine.COMMAND` | the manoeuvre, and what it needs to know |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle's position and resets |
    | `setpoint` | `SETPOINT` | a position; `armed` is left to others |
    | `feedback` | `svgs_routine.FEEDBACK` | whether the manoeuvre is done |

    The node `motion_control_drspider` of "High-altitude precision landing by SVGS" (Drones 8, 37,
    2024). Each algorithm's sleep is a time in the state, not a blocked thread:

    | manoeuvre | algorithm | setpoints (F, L, U), curr being the present position |
    |---|---|---|
    | scan | 2 | curr + 0.5 j left, in odd rows right; after a row 0.5 i ahead; 3 s each |
    | align | 3 | over the point, once a second for 5 s |
    | descend | 6 | curr, 0.7 m lower, once a second |
    | relocate xy, xyz | 4 | trusted position at this height, then its height; 2 s, and reached |
    | offset | 5 | two requests 2.5 s apart |
    | land | 6 | after 2 s, 5 m below |
    | return | | over the point of the stage, at this height; 2 s, and reached |

    Other than in the paper the scan, alignment and offset keep the height they began with (the
    present one would drift in gusts), an offset goes to the point that the commander names instead
    of 1.5 m on from wherever the vehicle is, and the descent may follow the target. Positions are
    in W; a reset of the navigation filter moves them along.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 (paper: 30 Hz) | the next setpoint, if due |
    """

    def __init__(self, config: SvgsRoutineConfig, seed: int = 0):
        """Motion control; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        self._command = self.DeclareVectorInputPort("command", COMMAND.size).Eval
        self._estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size).Eval
        initial = SETPOINT.zeros()
        initial[SETPOINT.slice("p_WB")] = np.nan
        initial[SETPOINT.index("yaw")] = np.nan
        setpoint = self.DeclareDiscreteState(BasicVector(initial))
        feedback = self.DeclareDiscreteState(BasicVector(np.array([-1.0, 0.0])))
        memory = MEMORY(MEMORY.zeros())
        memory.begun = memory.horizontal_resets = memory.vertical_resets = -1.0
        memory.yaw = math.nan
        self.DeclareDiscreteState(BasicVector(np.asarray(memory[:])))
        self.DeclareStateOutputPort("setpoint", setpoint)
        self.DeclareStateOutputPort("feedback", feedback)
        self.DeclarePeriodicDiscreteUpdateEvent(SUPERVISOR_PERIOD, 0.0, self._update)
        self._manoeuvres: dict[int, Callable[[Motion], None]] = {
            routine.HOLD: self.hold,
            routine.SCAN: self.scan,
            routine.ALIGN: self.align,
            routine.DESCEND: self.descend,
            routine.RELOCATE_XY: self.relocate_xy,
            routine.RELOCATE_XYZ: self.relocate_xyz,
            routine.OFFSET: self.offset,
            routine.LAND: self.land,
            routine.RETURN: self.return_to_pad,
        }

    def configure(self, config: SvgsRoutineConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        command = self._command(context)
        manoeuvre = int(command[0])
        if manoeuvre == routine.NONE:
            return EventStatus.DidNothing()
        estimate = self._estimate(context)
        values = discrete_state.get_mutable_value(0)
        memory = discrete_state.get_mutable_value(2)
        motion = Motion(context.get_time(), estimate[_P], command, memory, values)
        self._follow_resets(motion, estimate)
        if motion.memory.begun != motion.command.begun:
            self._begin(motion, estimate)
        if motion.time >= motion.memory.next - 1e-9:
            self._manoeuvres[manoeuvre](motion)
        feedback = discrete_state.get_mutable_value(1)
        if motion.done or feedback[0] != motion.command.begun:
            feedback[0] = motion.command.begun
            feedback[1] = float(motion.done)
        return EventStatus.Succeeded()

    def _begin(self, motion: Motion, estimate: np.ndarray) -> None:
        m = motion.memory
        m.begun = motion.command.begun
        m.next = motion.time
        m.row = m.column = 0.0
        m.level = motion.z
        if math.isnan(m.yaw):
            w, x, y, z = estimate[_YAW_Q]
            m.yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        motion.setpoint.maximum_speed = self.config.maximum_speed
        motion.setpoint.yaw = m.yaw

    def _follow_resets(self, motion: Motion, estimate: np.ndarray) -> None:
        m, s = motion.memory, motion.setpoint
        if m.horizontal_resets not in (-1.0, estimate[_H_COUNTER]):
            s.p_WB_x += estimate[_H_RESET.start]
            s.p_WB_y += estimate[_H_RESET.start + 1]
        if m.vertical_resets not in (-1.0, estimate[_V_COUNTER]):
            s.p_WB_z += estimate[_V_RESET]
            m.level += estimate[_V_RESET]
        m.horizontal_resets, m.vertical_resets = estimate[_H_COUNTER], estimate[_V_COUNTER]

    def hold(self, motion: Motion) -> None:
        """Stay where the manoeuvre began."""
        motion.send(motion.x, motion.y, motion.memory.level, math.inf)

    def scan(self, motion: Motion) -> None:
        """Algorithm 2: a square in rows to and fro, ahead and to the left, in growing steps."""
        c, m = self.config, motion.memory
        ahead, left = math.cos(m.yaw), math.sin(m.yaw)
        if m.row >= motion.command.square_side:
            motion.done = True
            motion.send(motion.x, motion.y, m.level, math.inf)
            return
        if m.column <= motion.command.square_side:
            step = c.scan_step * m.column * (1.0 if m.row % 2 == 0 else -1.0)
            # F is the body's front at the beginning, L its left
            motion.send(motion.x - left * step, motion.y + ahead * step, m.level, c.scan_wait)
            m.column += 1.0
        else:
            m.column = 0.0
            m.row += 1.0
            step = c.scan_step * m.row
            motion.send(motion.x + ahead * step, motion.y + left * step, m.level, c.scan_wait)

    def align(self, motion: Motion) -> None:
        """Algorithm 3: over the target, once a second for five seconds."""
        motion.done = motion.age >= self.config.align_time
        aim = motion.command
        motion.send(aim.aim_x, aim.aim_y, motion.memory.level, self.config.align_wait)

    def descend(self, motion: Motion) -> None:
        """Algorithm 6, first branch: a step down, once a second."""
        c, aim = self.config, motion.command
        high = motion.z - aim.aim_z > c.short_height + c.high_descent_step
        step = c.high_descent_step if high else c.descent_step
        x, y = motion.x, motion.y
        if c.descend_over == "target":
            x, y = aim.aim_x, aim.aim_y
        motion.send(x, y, motion.z - step, c.descent_wait)

    def _relocate(self, motion: Motion, x: float, y: float, z: float) -> None:
        c = self.config
        reached = math.hypot(x - motion.x, y - motion.y, z - motion.z) <= c.relocation_radius
        motion.done = motion.age >= c.relocation_time and (
            reached or motion.age >= c.relocation_timeout
        )
        motion.send(x, y, z, 0.0)

    def relocate_xy(self, motion: Motion) -> None:
        """Algorithm 4, first to the trusted position in the plane."""
        trusted = motion.command
        level = motion.memory.level
        self._relocate(motion, trusted.trusted_x, trusted.trusted_y, level)

    def relocate_xyz(self, motion: Motion) -> None:
        """Algorithm 4, then to the trusted position."""
        trusted = motion.command
        self._relocate(motion, trusted.trusted_x, trusted.trusted_y, trusted.trusted_z)

    def return_to_pad(self, motion: Motion) -> None:
        """Over the aim, at the height it began with."""
        aim = motion.command
        self._relocate(motion, aim.aim_x, aim.aim_y, motion.memory.level)

    def offset(self, motion: Motion) -> None:
        """Algorithm 5: two requests."""
        motion.done = motion.age >= self.config.offset_time
        aim = motion.command
        motion.send(aim.aim_x, aim.aim_y, motion.memory.level, 0.5 * self.config.offset_time)

    def land(self, motion: Motion) -> None:
        """Algorithm 6, second branch: below the ground, which the vehicle detects."""
        aim, m = motion.command, motion.memory
        x, y = (aim.aim_x, aim.aim_y) if aim.aim_known else (motion.x, motion.y)
        if motion.age < self.config.offset_wait:
            motion.send(x, y, m.level, 0.0)
        else:
            if not aim.aim_known and m.row > 0.0:  # stay over the point where it began
                x, y = motion.setpoint.p_WB_x, motion.setpoint.p_WB_y
            m.row = 1.0
            motion.send(x, y, motion.z - self.config.depth, self.config.descent_wait)


def add_motion_control(
    builder: DiagramBuilder, name: str, config: SvgsRoutineConfig, seed: int = 0
) -> SvgsMotionControl:
    """Add motion control called `name` to `builder`."""
    return builder.AddNamedSystem(name, SvgsMotionControl(config, seed))

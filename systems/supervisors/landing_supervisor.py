"""The supervisor of a vertical landing: a mission, a landing routine and the touchdown.

A new routine is one file (a table, its guards and actions, a configuration with `routine()`)
and one line in `RoutineConfig`.
"""

import math
from struct import Struct
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import Seconds, Vector3, configuration, require_same_structure
from systems.schedule import SUPERVISOR_PERIOD
from systems.signals.measurement import (
    RANGE_FINDER,
    SETPOINT,
    SUPERVISOR_STATUS,
    TARGET_ESTIMATE,
    TIME_OF_ARRIVAL,
    VALID,
    VEHICLE_ESTIMATE,
    VEHICLE_STATUS,
    no_measurement,
)
from systems.signals.optional_input import optional_input
from systems.supervisors.ardupilot import ArduPilotConfig
from systems.supervisors.cautious import CautiousConfig
from systems.supervisors.cone import ConeConfig
from systems.supervisors.mission import Mission, MissionConfig, flight_table
from systems.supervisors.normal import NormalConfig
from systems.supervisors.px4_precland import PX4PreclandConfig
from systems.supervisors.situation import Memory, Situation
from systems.supervisors.state_machine import StateMachine, TransitionTable, to_dot
from systems.supervisors.svgs_routine import SvgsRoutineConfig
from systems.supervisors.touchdown import TouchdownDetector, TouchdownDetectorConfig

if TYPE_CHECKING:
    from systems.supervisors.svgs_guidance import SvgsGuidance

RoutineConfig = Annotated[
    NormalConfig
    | ArduPilotConfig
    | CautiousConfig
    | PX4PreclandConfig
    | SvgsRoutineConfig
    | ConeConfig,
    Field(discriminator="kind"),
]


class Routine(Protocol):
    """What a landing routine is: a table, the class of its memory, and its handlers as methods."""

    @property
    def table(self) -> TransitionTable:
        """The states and transitions between the mission and the state `landed`."""

    @property
    def memory(self) -> type[Memory]:
        """The class of the memory."""


@configuration
class LandingSupervisorConfig:
    """The flight from the start to the stopped rotors."""

    mission: MissionConfig = Field(default_factory=MissionConfig)
    routine: RoutineConfig = Field(default_factory=ArduPilotConfig)
    touchdown: TouchdownDetectorConfig = Field(default_factory=TouchdownDetectorConfig)
    # m in B, the point to be brought over the pad's centre: the thesis measures at the cameras
    reference_point: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    range_timeout: Seconds = 0.5  # s, after which a range measurement is too old
    rotor_count: int = Field(default=6, ge=1)  # size of the input rotor_commands

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int = 0
    ) -> "LandingSupervisor | SvgsGuidance":
        """Add a supervisor called `name` to `builder`; the SVGS routine's is a diagram of three."""
        if isinstance(self.routine, SvgsRoutineConfig):
            from systems.supervisors import svgs_guidance  # builds on this module

            return builder.AddNamedSystem(name, svgs_guidance.SvgsGuidance(self, seed))
        return builder.AddNamedSystem(name, LandingSupervisor(self, seed))


_E = {field: VEHICLE_ESTIMATE.index(field) for field in VEHICLE_ESTIMATE.fields}
_Q = VEHICLE_ESTIMATE.slice("q_WB")
_P = VEHICLE_ESTIMATE.slice("p_WB")
_V = VEHICLE_ESTIMATE.slice("v_WB")
_A = VEHICLE_ESTIMATE.slice("a_WB")
_HEIGHT, _HEIGHT_VALID = _E["height_above_ground"], _E["height_above_ground_valid"]
_VALIDITY = slice(_E["attitude_valid"], _E["vertical_valid"] + 1)
_H_COUNTER = _E["horizontal_reset_counter"]
_H_RESET = slice(_E["horizontal_reset_x"], _E["horizontal_reset_y"] + 1)
_V_COUNTER, _V_RESET = _E["vertical_reset_counter"], _E["vertical_reset"]
_ACQUIRED = TARGET_ESTIMATE.index("acquired")
_FUSED = TARGET_ESTIMATE.index("time_of_last_fusion")
_P_BP = TARGET_ESTIMATE.slice("p_BP_W")
_V_WP = TARGET_ESTIMATE.slice("v_WP")
_P_VARIANCE = slice(
    TARGET_ESTIMATE.index("position_variance_x"), TARGET_ESTIMATE.index("position_variance_y") + 1
)
_RANGE = RANGE_FINDER.index("range")
_STATUS = SETPOINT.size  # where the status begins in the fields of `Memory`
_VEHICLE = _STATUS + SUPERVISOR_STATUS.size
_REST = _VEHICLE + VEHICLE_STATUS.size
_SETPOINT_NUMBERS = Struct(f"{SETPOINT.size}d")
_STATUS_NUMBERS = Struct(f"{SUPERVISOR_STATUS.size}d")
_VEHICLE_NUMBERS = Struct(f"{VEHICLE_STATUS.size}d")
_AXES = ("_x", "_y", "_z")  # endings of the names of positions
_NEVER_SEEN = TARGET_ESTIMATE.zeros()
_NO_RANGE = no_measurement(RANGE_FINDER)


class LandingSupervisor(LeafSystem):
    """Decides what the vehicle does: mission, landing routine, touchdown.

    .. pydrake_system::
        name: LandingSupervisor
        input_ports:
        - estimate
        - target (optional)
        - range_finder (optional)
        - rotor_commands (optional)
        output_ports:
        - setpoint
        - status
        - vehicle_status

    | port | layout | meaning |
    |---|---|---|
    | `estimate` | `VEHICLE_ESTIMATE` | the navigation filter's answer |
    | `target` (optional) | `TARGET_ESTIMATE` | the landing target; unconnected: never seen |
    | `range_finder` (optional) | `RANGE_FINDER` | height along the body's axis; unconnected: \
the estimate's height above ground, or the height above the place of arming, stands in |
    | `rotor_commands` (optional) | one a rotor, proportional to thrust | a sign of the ground; \
unconnected: touchdown is judged by motion alone |
    | `setpoint` | `SETPOINT` | what the controller is asked for |
    | `status` | `SUPERVISOR_STATUS` | the state by its index in `machine.table` |
    | `vehicle_status` | `VEHICLE_STATUS` | what the land detector tells the navigation filter |

    The table `machine.table` (states, guards, actions) is the specification; draw it with
    `state_machine.to_dot`. Over the target, with the reference point C fixed in B,

        setpoint p_WB = p_WB + p_BP_W − R_z(yaw) p_BC,  v_WB = v_WP  (horizontally)

    A jump of the navigation filter moves every stored position by the same amount. Where
    the filter jumps more than once between two events, only the last jump is known.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | inputs, resets, sightings, touchdown, one transition at most |
    """

    def __init__(self, config: LandingSupervisorConfig, seed: int = 0):
        """A supervisor; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self._build(config)
        self._estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size).Eval
        self._target = optional_input(
            self.DeclareVectorInputPort("target", TARGET_ESTIMATE.size), _NEVER_SEEN
        )
        self._range_finder = optional_input(
            self.DeclareVectorInputPort("range_finder", RANGE_FINDER.size), _NO_RANGE
        )
        self._commands = optional_input(
            self.DeclareVectorInputPort("rotor_commands", config.rotor_count),
            np.full(config.rotor_count, math.nan),
        )
        initial = np.array(self._routine.memory.initial())
        setpoint = self.DeclareDiscreteState(BasicVector(initial[:_STATUS]))
        status = self.DeclareDiscreteState(BasicVector(initial[_STATUS:_VEHICLE]))
        vehicle = self.DeclareDiscreteState(BasicVector(initial[_VEHICLE:_REST]))
        self.DeclareDiscreteState(BasicVector(initial[_REST:]))
        self.DeclareStateOutputPort("setpoint", setpoint)
        self.DeclareStateOutputPort("status", status)
        self.DeclareStateOutputPort("vehicle_status", vehicle)
        self.DeclarePeriodicDiscreteUpdateEvent(SUPERVISOR_PERIOD, 0.0, self._update)

    def configure(self, config: LandingSupervisorConfig, seed: int = 0) -> None:
        """Take over a new configuration; its routine's kind and the rotor count must be the same.

        Raises
        ------
        StructureChangedError
            If the configuration needs another diagram.
        """
        require_same_structure(self.config, config, "rotor_count")
        require_same_structure(self.config.routine, config.routine, "kind")
        self._build(config)

    def _build(self, config: LandingSupervisorConfig) -> None:
        self.config = config
        self._routine: Routine = config.routine.routine()
        self._detector = TouchdownDetector(config.touchdown)
        mission = Mission(config.mission)
        self._handlers = (self._routine, mission, self._detector)
        self.machine = StateMachine(flight_table(self._routine.table), *self._handlers)
        fields = self._routine.memory.fields()
        self._fields = fields
        self._rest = Struct(f"{len(fields) - _REST}d")
        self._positions = tuple([n for n in fields if n.endswith(axis)] for axis in _AXES)

    def state_name(self, status: np.ndarray) -> str:
        """The name of the state in a `SUPERVISOR_STATUS`."""
        return self.machine.table.states[int(status[0])].name

    def states_dot(self) -> str:
        """The transition table as DOT text."""
        return to_dot(self.machine.table, self.get_name(), *self._handlers)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        setpoint = discrete_state.get_mutable_value(0)
        status = discrete_state.get_mutable_value(1)
        vehicle = discrete_state.get_mutable_value(2)
        rest = discrete_state.get_mutable_value(3)
        memory = self._routine.memory()
        values = vars(memory)
        stored = (*setpoint.tolist(), *status.tolist(), *vehicle.tolist(), *rest.tolist())
        values.update(zip(self._fields, stored, strict=True))
        s: Situation[Any] = Situation(memory, SUPERVISOR_PERIOD)
        s.time = context.get_time()
        self._perceive_vehicle(context, s)
        self._perceive_target(context, s)
        self._detector.observe(s)

        state = int(memory.state)
        following = self.machine.next_state(state, s)
        if following != state:
            memory.state, memory.entered = float(following), s.time
        self.machine.stay(following, s)
        memory.time_in_state = s.time - memory.entered

        # A third of the time that numpy takes to make an array of a list.
        numbers = list(values.values())
        _SETPOINT_NUMBERS.pack_into(setpoint, 0, *numbers[:_STATUS])
        _STATUS_NUMBERS.pack_into(status, 0, *numbers[_STATUS:_VEHICLE])
        _VEHICLE_NUMBERS.pack_into(vehicle, 0, *numbers[_VEHICLE:_REST])
        self._rest.pack_into(rest, 0, *numbers[_REST:])

    def _perceive_vehicle(self, context: Context, s: Situation[Any]) -> None:
        m = s.memory
        estimate = self._estimate(context).tolist()
        w, x, y, z = estimate[_Q]
        s.x, s.y, s.z = estimate[_P]
        s.vx, s.vy, s.vz = estimate[_V]
        s.ax, s.ay, s.az = estimate[_A]
        s.up_x, s.up_y = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)
        s.up_z = 1.0 - 2.0 * (x * x + y * y)
        s.yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        s.navigation_valid = min(estimate[_VALIDITY]) > 0.0
        self._follow_resets(m, estimate)

        ranging = self._range_finder(context).tolist()
        age = s.time - ranging[TIME_OF_ARRIVAL]
        if ranging[VALID] > 0.0 and age <= self.config.range_timeout:
            s.range_valid = s.height_measured = True
            s.height = ranging[_RANGE] * s.up_z
        else:
            s.height_measured = estimate[_HEIGHT_VALID] > 0.0
            s.height = estimate[_HEIGHT] if s.height_measured else s.z - m.home_z

        s.command = sum(self._commands(context).tolist()) / self.config.rotor_count

    def _follow_resets(self, m: Memory, estimate: list[float]) -> None:
        if estimate[_H_COUNTER] != m.horizontal_resets:
            if m.horizontal_resets >= 0.0:
                for names, jump in zip(self._positions, estimate[_H_RESET], strict=False):
                    _shift(m, names, jump)
            m.horizontal_resets = estimate[_H_COUNTER]
        if estimate[_V_COUNTER] != m.vertical_resets:
            if m.vertical_resets >= 0.0:
                _shift(m, self._positions[2], estimate[_V_RESET])
            m.vertical_resets = estimate[_V_COUNTER]

    def _perceive_target(self, context: Context, s: Situation[Any]) -> None:
        m = s.memory
        target = self._target(context).tolist()
        s.acquired = target[_ACQUIRED] > 0.0
        if not s.acquired:
            return
        to_pad_x, to_pad_y, to_pad_z = target[_P_BP]
        s.pad_vx, s.pad_vy, s.pad_vz = target[_V_WP]
        s.goal_sigma = math.sqrt(max(target[_P_VARIANCE]))
        ahead, left, _ = self.config.reference_point
        c, n = math.cos(s.yaw), math.sin(s.yaw)
        s.goal_x = s.x + to_pad_x - (c * ahead - n * left)
        s.goal_y = s.y + to_pad_y - (n * ahead + c * left)
        s.goal_z = s.z + to_pad_z
        m.last_acquired = s.time
        if target[_FUSED] > m.last_fusion:
            s.updated = True
            m.last_fusion = target[_FUSED]
            m.goal_x, m.goal_y, m.goal_z = s.goal_x, s.goal_y, s.goal_z
            m.sighting_x, m.sighting_y, m.sighting_z = s.x, s.y, s.z


def remembered(memory: type[Memory]) -> tuple[str, ...]:
    """The names of what is in the discrete state's last group, behind setpoint and statuses."""
    return memory.fields()[_REST:]


def _shift(m: Memory, names: list[str], jump: float) -> None:
    for name in names:
        setattr(m, name, getattr(m, name) + jump)

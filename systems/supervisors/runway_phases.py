"""The phases of the landing without GPS (Leonard 2016, 2.3 and 4.2)."""

import math
from collections.abc import Callable
from enum import IntEnum
from types import SimpleNamespace

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem

from systems.configuration import Metres, NonNegative, Seconds, configuration
from systems.signals.runway_measurement import (
    FIX,
    GUIDANCE,
    LASER_HEIGHT,
    NAVIGATION_ESTIMATE,
    PHASE_STATUS,
    PICTURE,
    PICTURE_PERIOD,
    WHEEL_SPEED,
)
from systems.supervisors.state_machine import State, StateMachine, Transition, TransitionTable


class Phase(IntEnum):
    """The phases in the order of the transition table."""

    STANDBY = 0
    RETURN = 1
    FINAL = 2
    FINAL_WITH_LASER = 3
    SHORT_FINAL = 4
    BRAKING = 5
    STANDSTILL = 6


_STANDBY, _STANDSTILL = int(Phase.STANDBY), int(Phase.STANDSTILL)  # an enumeration is slow to ask

TABLE = TransitionTable(
    initial="standby",
    states=(
        State("standby"),
        State("return"),
        State("final"),
        State("final_with_laser"),
        State("short_final"),
        State("braking"),
        State("standstill", final=True),
    ),
    transitions=(
        Transition("standby", "return", guard="gps_lost"),
        Transition("return", "braking", guard="on_the_ground"),
        Transition("return", "final", guard="last_waypoint_passed"),
        Transition("final", "braking", guard="on_the_ground"),
        Transition("final", "short_final", guard="near_touchdown"),
        Transition("final", "final_with_laser", guard="laser_active"),
        Transition("final_with_laser", "braking", guard="on_the_ground"),
        Transition("final_with_laser", "short_final", guard="near_touchdown"),
        Transition("short_final", "braking", guard="on_the_ground"),
        Transition("braking", "standstill", guard="stopped"),
    ),
)


@configuration
class RunwayPhasesConfig:
    """When one phase gives way to the next.

    The thesis leaves the criteria of the last two transitions open (4.2); here
    they are the distance at which its tables stop (6.1) or a lost tracker, and
    weight on wheels.
    """

    confirm_loss: Seconds = 2.0  # s without a fix
    short_final_distance: Metres = 100.0  # m before the touch-down point, as estimated
    tracker_patience: Seconds = 1.0  # s without a picture, nearer than the next distance
    tracker_distance: Metres = 250.0  # m, farther a lost tracker does not end the final
    standstill_speed: NonNegative = 0.2  # m/s, of the wheels
    settle: Seconds = 1.0  # s at a standstill before the simulation ends
    use_laser: bool = True  # false is the reference of section 6.1

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "RunwayPhases":
        """Add the supervisor to a builder."""
        return builder.AddNamedSystem(name, RunwayPhases(self, seed))


class RunwayPhases(LeafSystem):
    """Standby, Return, Final without and with laser, Short Final, Braking, standstill.

    .. pydrake_system::

        name: RunwayPhases
        input_ports:
        - estimate
        - guidance
        - fix
        - laser
        - picture
        - wheel_speed
        output_ports:
        - status

    | port | layout | meaning |
    |---|---|---|
    | estimate | NAVIGATION_ESTIMATE | for the distance to the touch-down point |
    | guidance | GUIDANCE | whether the last waypoint is passed |
    | fix | FIX | the receiver |
    | laser | LASER_HEIGHT | valid from its activation on |
    | picture | PICTURE | the tracker, valid while locked |
    | wheel_speed | WHEEL_SPEED | valid with weight on wheels |
    | status | PHASE_STATUS | the phase |

    | from | to | when |
    |---|---|---|
    | Standby | Return | the loss of GPS is confirmed |
    | Return | Final | the last waypoint of the return is passed |
    | Final | Final with laser | the laser height sensor is active |
    | either Final | Short Final | near the touch-down point, or the tracker lost it there |
    | any in the air | Braking | weight on wheels |
    | Braking | Standstill | the wheels stand |

    | event | when | does |
    |---|---|---|
    | decide | every 40 ms from 0 | at most one transition; ends the simulation at rest |
    """

    def __init__(self, config: RunwayPhasesConfig, seed: int = 0):
        super().__init__()
        self.configure(config, seed)
        self._inputs: list[Callable[[Context], np.ndarray]] = []
        for name, layout in (
            ("estimate", NAVIGATION_ESTIMATE),
            ("guidance", GUIDANCE),
            ("fix", FIX),
            ("laser", LASER_HEIGHT),
            ("picture", PICTURE),
            ("wheel_speed", WHEEL_SPEED),
        ):
            self._inputs.append(self.DeclareVectorInputPort(name, layout.size).Eval)
        status = self.DeclareDiscreteState(PHASE_STATUS.size)
        self.DeclareDiscreteState([0.0])  # s, when the tracker last had the point
        self.DeclareStateOutputPort("status", status)
        self.DeclarePeriodicDiscreteUpdateEvent(PICTURE_PERIOD, 0.0, self._decide)
        self._machine = StateMachine(TABLE, self)

    def configure(self, config: RunwayPhasesConfig, seed: int = 0) -> None:
        """Take new criteria."""
        self._config = config

    def gps_lost(self, now: SimpleNamespace) -> bool:
        """The loss of GPS is confirmed."""
        return bool(now.silent > self._config.confirm_loss)

    def last_waypoint_passed(self, now: SimpleNamespace) -> bool:
        """The last waypoint of the return is passed."""
        return bool(now.input(1)[1] > 0.0)

    def laser_active(self, now: SimpleNamespace) -> bool:
        """The laser height sensor is active."""
        return bool(self._config.use_laser and now.input(3)[3] > 0.0)

    def near_touchdown(self, now: SimpleNamespace) -> bool:
        """Near the touch-down point, or the tracker lost it there."""
        estimate = now.input(0)
        distance = math.hypot(estimate[2], estimate[3])
        blind = now.untracked > self._config.tracker_patience
        return bool(
            distance < self._config.short_final_distance
            or (blind and distance < self._config.tracker_distance)
        )

    def on_the_ground(self, now: SimpleNamespace) -> bool:
        """Weight on wheels."""
        return bool(now.input(5)[3] > 0.0)

    def stopped(self, now: SimpleNamespace) -> bool:
        """The wheels stand."""
        wheels = now.input(5)
        return bool(wheels[3] > 0.0 and wheels[4] < self._config.standstill_speed)

    def _decide(self, context, discrete_state):
        status = discrete_state.get_mutable_value(0)
        tracked = discrete_state.get_mutable_value(1)
        time = context.get_time()

        def read(port):
            return self._inputs[port](context)

        if status[0] == _STANDBY:
            fix = read(2)
            status[2] = time - max(fix[0], 0.0) if fix[3] > 0.0 else status[2] + PICTURE_PERIOD
        if read(4)[3] > 0.0:
            tracked[0] = time
        now = SimpleNamespace(input=read, silent=status[2], untracked=time - tracked[0])
        before = int(status[0])
        after = self._machine.next_state(before, now)
        status[0] = after
        status[1] = 0.0 if after != before else status[1] + PICTURE_PERIOD
        status[3] = float(after == _STANDSTILL)
        if after == _STANDSTILL and status[1] >= self._config.settle:
            return EventStatus.ReachedTermination(self, "at a standstill")
        return None

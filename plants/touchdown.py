"""The judge of a run: when and how the vehicle touched down, from the true states."""

import math
from typing import Any, Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import BasicVector, DiagramBuilder, EventStatus, LeafSystem

from plants import touchdown_judge as rules
from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Seconds,
    Vector3,
    configuration,
    require_same_structure,
)
from systems.schedule import BASE_PERIOD
from systems.signals.measurement import BODY_STATE, PAD_STATE, SUPERVISOR_STATUS, TOUCHDOWN
from systems.signals.optional_input import optional_input

REASONS = {
    rules.RUNNING: "still running",
    rules.LANDED: "landed",
    rules.TILTED: "crashed: tilted beyond the limit on the ground",
    rules.HIT_HARD: "crashed: hit the ground too fast",
    rules.STOPPED_IN_THE_AIR: "crashed: stopped its rotors in the air",
    rules.TIME_LIMIT_FLYING: "time limit: still flying",
    rules.TIME_LIMIT_NOT_AT_REST: "time limit: touched down, but not at rest with stopped rotors",
    rules.NEVER_TOOK_OFF: "time limit: never took off",
    rules.LEFT_THE_ARENA: "left the arena",
}

_REASON = TOUCHDOWN.index("reason")
_DISARMED = SUPERVISOR_STATUS.index("disarmed")
_CONTACT_FORCE = BODY_STATE.index("contact_force")
_THRUST = BODY_STATE.index("f_B_z")
_LITTLE_THRUST = 3.0  # m/s2
_LOOK_PERIOD = 16 * BASE_PERIOD  # s
_FINISH_PERIOD = 64 * BASE_PERIOD  # s
_NOTHING = EventStatus.DidNothing()
_VERDICT, _MEMORY = range(2)  # groups of the discrete state
_NO_PAD = PAD_STATE.zeros()


@configuration
class TouchdownConfig:
    """What counts as landed, and when a run is given up."""

    kind: Literal["touchdown"] = "touchdown"
    # m in B; the thesis measures from the cameras, in the middle between the legs
    reference_point: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.2])
    feet_height: Finite = -0.2  # m, of the feet in B: where the vehicle's height is counted from
    time_limit: Seconds = 120.0  # s
    tilt_limit: Positive = math.radians(60.0)  # rad, on the ground; beyond it a vehicle topples
    speed_limit: Positive = 3.0  # m/s, downwards at first contact; beyond it legs break
    arena_radius: Metres = 200.0  # m, horizontally from the pad
    arena_height: Metres = 250.0  # m, of the body over z = 0
    airborne_height: Metres = 0.3  # m, of the feet over the surface: it has taken off
    stopped_speed: Positive = 20.0  # rad/s, slower rotors count as stopped
    rest_speed: NonNegative = 0.05  # m/s and rad/s, slower counts as at rest
    rest_time: Seconds = 0.5  # s, at rest with stopped rotors: it has landed
    rotor_count: int = Field(default=6, ge=1)  # rotors of the vehicle

    def parameters(self) -> np.ndarray:
        """The parameter vector of `plants.touchdown_judge`."""
        p = np.zeros(rules.PARAMETERS)
        p[rules.REFERENCE_X : rules.REFERENCE_Z + 1] = self.reference_point
        p[rules.TIME_LIMIT] = self.time_limit
        p[rules.TILT_LIMIT] = self.tilt_limit
        p[rules.SPEED_LIMIT] = self.speed_limit
        p[rules.ARENA_RADIUS] = self.arena_radius
        p[rules.ARENA_HEIGHT] = self.arena_height
        p[rules.AIRBORNE_HEIGHT] = self.airborne_height
        p[rules.STOPPED_SPEED] = self.stopped_speed
        p[rules.REST_SPEED] = self.rest_speed
        p[rules.REST_TIME] = self.rest_time
        p[rules.FEET_Z] = self.feet_height
        p[rules.PERIOD] = _LOOK_PERIOD
        return p

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "TouchdownObserver":
        """Add the system to `builder` under `name`."""
        return builder.AddNamedSystem(name, TouchdownObserver(self, seed))


class TouchdownObserver(LeafSystem):
    """Watches the true states, gives the verdict, and ends the simulation.

    .. pydrake_system::

        name: TouchdownObserver
        input_ports:
        - body
        - rotor_speeds
        - pad
        - supervisor
        output_ports:
        - touchdown

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the true body |
    | `rotor_speeds` | (N,) | rad/s |
    | `pad` (optional) | `PAD_STATE` | unconnected: ground at z = 0, a target at W's origin |
    | `supervisor` (optional) | `SUPERVISOR_STATUS` | for `disarmed`; unconnected: never |
    | `touchdown` | `TOUCHDOWN` | the verdict; reason codes in `REASONS` |

    A touchdown is the first contact after the feet were `airborne_height` up;
    going up again cancels it. Speeds are relative to the surface, from the last
    look without contact (at most 40 ms before); the vertical one is carried on to
    where the feet meet the surface. Time, speeds and tilt are those of first
    contact, the offset is the last seen: at rest where the run ends so.
    A vehicle that says it is disarmed, with stopped rotors above
    `airborne_height`, has crashed.

    | event | when | does |
    |---|---|---|
    | look | every 40 ms from 0 | one application of the rules to the states at t |
    | finish | every 160 ms from 0 (publish) | ends the simulation once there is a verdict |
    """

    def __init__(self, config: TouchdownConfig, seed: int = 0):
        super().__init__()
        self._config = config
        verdict = TOUCHDOWN.zeros()
        verdict[TOUCHDOWN.index("time")] = -1.0
        state = self.DeclareDiscreteState(BasicVector(verdict.tolist()))
        self.DeclareDiscreteState(rules.MEMORY_SIZE)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        self._rotors = self.DeclareVectorInputPort("rotor_speeds", config.rotor_count).Eval
        self._pad = optional_input(self.DeclareVectorInputPort("pad", PAD_STATE.size), _NO_PAD)
        supervisor = self.DeclareVectorInputPort("supervisor", SUPERVISOR_STATUS.size)
        self._supervisor = optional_input(supervisor, SUPERVISOR_STATUS.zeros())
        self.DeclareStateOutputPort("touchdown", state)
        self.DeclarePeriodicDiscreteUpdateEvent(_LOOK_PERIOD, 0.0, self._look)
        self.DeclarePeriodicPublishEvent(_FINISH_PERIOD, 0.0, self._finish)
        self._parameters = config.parameters()

    def configure(self, config: TouchdownConfig, seed: int = 0) -> None:
        """Other rules from now on; the number of rotors must stay the same."""
        require_same_structure(self._config, config, "rotor_count")
        self._config = config
        self._parameters = config.parameters()

    def _look(self, context: Any, discrete_state: Any) -> None:
        body = self._body(context)
        fastest_rotor = math.inf
        disarmed = False
        # Off the ground with thrust (the usual case) the rotors turn: no need to look at them.
        if body.item(_CONTACT_FORCE) > 0.0 or body.item(_THRUST) < _LITTLE_THRUST:
            fastest_rotor = max(self._rotors(context).tolist())
            disarmed = self._supervisor(context).item(_DISARMED) > 0.5
        rules.judge(
            discrete_state.get_mutable_value(_VERDICT),
            discrete_state.get_mutable_value(_MEMORY),
            body,
            self._pad(context),
            fastest_rotor,
            disarmed,
            context.get_time(),
            self._parameters,
        )

    def _finish(self, context: Any) -> EventStatus:
        reason = context.get_discrete_state(_VERDICT)[_REASON]
        if reason == rules.RUNNING:
            return _NOTHING
        return EventStatus.ReachedTermination(self, REASONS[int(reason)])

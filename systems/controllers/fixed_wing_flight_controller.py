"""The fixed wing's flight controller: guidance, helmsman's law and altitude control."""

import math

from numba import njit
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import Metres, Positive, configuration
from systems.controllers.fixed_wing_guidance import (
    FlightControllerGains,
    RouteConfig,
    follow,
    helmsman,
    steer,
    vertical_speed_command,
)
from systems.runway_frames import RunwayConfig, wrap_angle
from systems.signals.runway_measurement import (
    ACT_OFFSET,
    FIXED_WING_COMMAND,
    GUIDANCE,
    NAVIGATION_ESTIMATE,
    NAVIGATION_PERIOD,
    PHASE_STATUS,
)
from systems.supervisors.runway_phases import Phase

_BRAKING = float(Phase.BRAKING)


@configuration
class FixedWingFlightControllerConfig:
    """The simplified flight controller of appendix A, with route and landing profile."""

    route: RouteConfig = Field(default_factory=RouteConfig)
    gains: FlightControllerGains = Field(default_factory=FlightControllerGains)
    speed: Positive = 33.0  # m/s, the aircraft's
    gear: Metres = 1.2  # m, from the wheels up to the centre of gravity

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "FixedWingFlightController":
        """Add the controller to a builder."""
        return builder.AddNamedSystem(name, FixedWingFlightController(self, seed, runway))


@njit(cache=True)
def control(
    command, guidance, estimate, phase, waypoints, heading, profile, gains, deceleration, dt
):
    """One step of the flight controller, in place.

    Parameters
    ----------
    command : array, shape (4,)
        Layout `FIXED_WING_COMMAND`.
    guidance : array, shape (5,)
        Layout `GUIDANCE`.
    estimate : array
        Begins with layout `NAVIGATION_ESTIMATE`.
    phase : float
        Index of the phase.
    waypoints, heading, profile : array (n, 3), float, array (5,)
        As in `systems.controllers.fixed_wing_guidance.follow`.
    gains : array, shape (12,)
    deceleration : float
        m/s2.
    dt : float
        s.
    """
    p_n, v_n = estimate[2:5], estimate[5:8]
    course, sink = follow(guidance, p_n, v_n, waypoints, heading, profile, gains[2])
    if phase >= _BRAKING:
        error = wrap_angle(estimate[8] - heading)
        command[0] = 0.0
        command[1] = 0.0
        command[2] = deceleration
        command[3] = steer(error, guidance[2], math.hypot(v_n[0], v_n[1]), gains)
        return
    error = wrap_angle(math.atan2(v_n[1], v_n[0]) - course)
    command[0] = helmsman(error, guidance[2], gains)
    command[1], guidance[4] = vertical_speed_command(guidance[3], guidance[4], sink, dt, gains)
    command[2] = 0.0
    command[3] = 0.0


class FixedWingFlightController(LeafSystem):
    """Keeps the aircraft on its route and its landing trajectory by the filter's estimate.

    .. pydrake_system::

        name: FixedWingFlightController
        input_ports:
        - estimate
        - phase
        output_ports:
        - command
        - guidance

    | port | layout | meaning |
    |---|---|---|
    | estimate | NAVIGATION_ESTIMATE | where the filter believes the aircraft is |
    | phase | PHASE_STATUS | from Braking on it brakes and steers |
    | command | FIXED_WING_COMMAND | roll, vertical speed, brakes, nose wheel |
    | guidance | GUIDANCE | place on the route |

    Equations: `systems.controllers.fixed_wing_guidance`. Until the estimate is
    initialised the command stays zero.

    | event | when | does |
    |---|---|---|
    | control | every 20 ms from 5 ms | guidance and command by the estimate before t |
    """

    def __init__(
        self,
        config: FixedWingFlightControllerConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
    ):
        super().__init__()
        self.configure(config, seed, runway)
        self._estimate = self.DeclareVectorInputPort("estimate", NAVIGATION_ESTIMATE.size).Eval
        self._phase = self.DeclareVectorInputPort("phase", PHASE_STATUS.size).Eval
        command = self.DeclareDiscreteState(FIXED_WING_COMMAND.size)
        guidance = self.DeclareDiscreteState(GUIDANCE.size)
        self.DeclareStateOutputPort("command", command)
        self.DeclareStateOutputPort("guidance", guidance)
        self.DeclarePeriodicDiscreteUpdateEvent(NAVIGATION_PERIOD, ACT_OFFSET, self._control)

    def configure(
        self,
        config: FixedWingFlightControllerConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
    ) -> None:
        """Take a new route, gains and runway."""
        runway = runway or RunwayConfig()
        self._waypoints = config.route.waypoints_n(runway)
        self._heading = runway.heading_radians
        self._profile = config.route.profile.vector(config.speed, config.gear)
        self._gains = config.gains.vector()
        self._deceleration = config.gains.deceleration

    @property
    def model(self) -> tuple:
        """Waypoints, heading, profile, gains and deceleration, as `control` takes them."""
        return self._waypoints, self._heading, self._profile, self._gains, self._deceleration

    def _control(self, context, discrete_state):
        estimate = self._estimate(context)
        if estimate[1] == 0.0:
            return
        control(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            estimate,
            self._phase(context)[0],
            self._waypoints,
            self._heading,
            self._profile,
            self._gains,
            self._deceleration,
            NAVIGATION_PERIOD,
        )

"""The thesis's filter: a five-state error filter on the inertial navigation, phase by phase."""

from typing import Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import Metres, NonNegative, Positive, Probability, configuration
from systems.estimators.runway_error_filter_kernel import initial_memory, step
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_camera import RunwayCameraConfig
from systems.signals.runway_measurement import (
    ACT_OFFSET,
    ATTITUDE_PERIOD,
    MEASUREMENTS,
    NAVIGATION_ESTIMATE,
)


@configuration
class RunwayErrorFilterConfig:
    """Process and sensor noise from the sensors' specification, times the hand tuning of 4.3."""

    kind: Literal["error_filter"] = "error_filter"
    tuning: Literal["theoretical", "hand"] = "hand"  # hand: Q 2.25, R 400, 100 and 400 times
    # theoretical standard deviations of one step of 20 ms
    position_walk: Metres = 0.001  # m, √q1 and √q2
    # m, √q3: the altimeter's scale factor of 1 % times the 7 cm of descent in a step, rounded
    altitude_walk: Metres = 0.001
    speed_walk: NonNegative = 0.0002  # m/s, √q4 and √q5: 0.02 m/s in a landing of 150 s
    return_noise: Positive = 0.2  # deg, of the antenna's azimuth
    # mrad; secret, too: chosen so that it converges as slowly as the thesis's (docs). A sighting
    # may be off by the harmonisation, half a degree about each axis, by the heading, 0.4 deg
    # (ARINC 704), and by a click and a track of some pixels of 0.05 deg
    final_noise: Positive = 20.0
    # m: "taking into account the sensor accuracy only, and not the error introduced by the
    # terrain elevation" (4.3); of the SF11
    laser_noise: Positive = 0.1
    # the laser's activation (4.2): the share of the altitude's innovation that is taken over
    # at once (1 reset, 0 covariance only), and the standard deviation that is added
    altitude_reset: Probability = 0.5
    altitude_increase: Metres = 0.5  # m
    camera: RunwayCameraConfig = Field(default_factory=RunwayCameraConfig)  # as known on board

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayErrorFilter":
        """Add the filter to a builder."""
        return builder.AddNamedSystem(name, RunwayErrorFilter(self, seed, runway))

    def parameters(self, runway: RunwayConfig) -> np.ndarray:
        """The flat parameters of the kernel, shape (PARAMETERS,)."""
        hand = self.tuning == "hand"
        q, r_return, r_final, r_laser = (2.25, 400.0, 100.0, 400.0) if hand else (1.0,) * 4
        station = runway.ground_station_n()
        return np.array(
            [
                q * self.position_walk**2,
                q * self.altitude_walk**2,
                q * self.speed_walk**2,
                r_return * np.radians(self.return_noise) ** 2,
                r_final * (1e-3 * self.final_noise) ** 2,
                r_laser * self.laser_noise**2,
                self.altitude_reset,
                self.altitude_increase**2,
                station[0],
                station[1],
                *self.camera.optics(),
                *self.camera.position,
                *self.camera.mounting_radians(),
            ]
        )


class RunwayErrorFilter(LeafSystem):
    """Estimates the errors of the inertial navigation and takes them out (Leonard 2016, 4).

    .. pydrake_system::

        name: RunwayErrorFilter
        input_ports:
        - measurements
        output_ports:
        - estimate

    | port | layout | meaning |
    |---|---|---|
    | measurements | MEASUREMENTS | the newest of each sensor, and the phase |
    | estimate | NAVIGATION_ESTIMATE | the corrected navigation |

    | measurement | used |
    |---|---|
    | inertial | position, speed and attitude, drifting |
    | baro | the vertical position |
    | fix | in Standby |
    | antenna | its azimuth, in Return |
    | picture | the tracked touch-down point, in Final |
    | laser | in Final with laser |
    | phase | which of them count |
    | heading, wheel_speed, airspeed | not by the thesis's filter |

    Equations: `systems.estimators.runway_error_filter_kernel`. The covariance is
    kept from phase to phase; when the laser is activated the altitude is reset,
    its covariance increased, or both by halves (4.2).

    | event | when | does |
    |---|---|---|
    | step | every 10 ms from 5 ms | fuses what arrived; propagates with each new position |
    """

    def __init__(
        self,
        config: RunwayErrorFilterConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
    ):
        super().__init__()
        self.configure(config, seed, runway)
        self._measurements = self.DeclareVectorInputPort("measurements", MEASUREMENTS.size).Eval
        estimate = self.DeclareDiscreteState(NAVIGATION_ESTIMATE.size)
        self.DeclareDiscreteState(initial_memory())
        self.DeclareStateOutputPort("estimate", estimate)
        self.DeclarePeriodicDiscreteUpdateEvent(ATTITUDE_PERIOD, ACT_OFFSET, self._step)

    def configure(
        self,
        config: RunwayErrorFilterConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
    ) -> None:
        """Take a new tuning and runway."""
        self._parameters = config.parameters(runway or RunwayConfig())

    @property
    def model(self) -> np.ndarray:
        """The flat parameters of the kernel."""
        return self._parameters

    def _step(self, context, discrete_state):
        step(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            self._measurements(context),
            self._parameters,
        )

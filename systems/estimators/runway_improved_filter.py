"""The improved filter: the thesis's with its future work (Leonard 2016, chapter 7) done."""

import math
from typing import Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import Metres, NonNegative, Positive, Seconds, configuration
from systems.estimators.runway_improved_filter_kernel import initial_memory, step
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_camera import RunwayCameraConfig
from systems.signals.runway_measurement import (
    ACT_OFFSET,
    ATTITUDE_PERIOD,
    MEASUREMENTS,
    NAVIGATION_ESTIMATE,
)


@configuration
class RunwayImprovedFilterConfig:
    """What is known of the sensors' errors; the defaults match the sensors' own."""

    kind: Literal["improved_filter"] = "improved_filter"
    speed_walk: NonNegative = 5e-4  # m/s/√s
    tilt: NonNegative = 0.15  # mrad, D/ω_S for 0.033 deg/h
    tilt_walk: NonNegative = 5e-6  # rad/√s: 0.033 deg/h over half an hour
    altitude_walk: NonNegative = 0.01  # m/√s
    camera_bearing: NonNegative = 0.31  # deg, harmonisation 0.3, click 0.075
    camera_elevation: NonNegative = 0.32  # deg, harmonisation 0.3, pitch 0.05, click 0.075
    camera_walk: NonNegative = 0.02  # mrad/√s, of both
    click: NonNegative = 1.5  # px
    bearing_noise: Positive = 1.2  # px; the tracker's is a pixel
    elevation_noise: Positive = 1.2  # px
    camera_shift: Metres = 0.05  # m, position of the camera
    picture_correlation: Positive = 50.0  # pictures that tell as much as one of roll and position
    antenna_azimuth: NonNegative = 0.5  # deg
    antenna_elevation: NonNegative = 0.3  # deg
    antenna_noise: Positive = 0.25  # deg
    altimeter_scale: NonNegative = 0.01  # 1
    heading: NonNegative = 0.2  # deg, bias of the inertial heading
    roll: NonNegative = 0.3  # deg, of camera and inertial navigation together
    laser_noise: Positive = 0.15  # m, with the bias
    terrain: NonNegative = 0.03  # 1, elevation per distance from the flat part
    flat_within: Metres = 250.0  # m before the touch-down point
    laser_correlation: Positive = 10.0  # samples that tell as much as one
    gate: Positive = 4.0  # standard deviations
    patience: Seconds = 20.0  # s of refused pictures
    camera_latency: Seconds = 0.0  # s, the part of L_ti that is known
    wheel_noise: Positive = 0.5  # m/s, with the heading's error at 33 m/s
    gear: Metres = 1.2  # m
    camera: RunwayCameraConfig = Field(default_factory=RunwayCameraConfig)  # as known on board

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayImprovedFilter":
        """Add the filter to a builder."""
        return builder.AddNamedSystem(name, RunwayImprovedFilter(self, seed, runway))

    def parameters(self, runway: RunwayConfig) -> np.ndarray:
        """The flat parameters of the kernel, shape (PARAMETERS,)."""
        optics = self.camera.optics()
        return np.array(
            [
                self.speed_walk**2,
                self.tilt_walk**2,
                self.altitude_walk**2,
                (1e-3 * self.camera_walk) ** 2,
                1e-3 * self.tilt,
                math.radians(self.camera_bearing),
                math.radians(self.camera_elevation),
                math.radians(self.antenna_azimuth),
                math.radians(self.antenna_elevation),
                self.altimeter_scale,
                math.radians(self.heading),
                math.radians(self.roll),
                self.click * optics[2],
                (self.bearing_noise * optics[2]) ** 2,
                (self.elevation_noise * optics[3]) ** 2,
                self.camera_shift,
                self.picture_correlation,
                math.radians(self.antenna_noise) ** 2,
                self.laser_noise**2,
                self.terrain,
                self.flat_within,
                self.laser_correlation,
                self.gate,
                self.patience,
                self.camera_latency,
                self.wheel_noise**2,
                self.gear,
                *runway.ground_station_n(),
                *optics,
                *self.camera.position,
                *self.camera.mounting_radians(),
            ]
        )


class RunwayImprovedFilter(LeafSystem):
    """The error filter with gates, synchronisation, biases, wind and a ground phase.

    .. pydrake_system::

        name: RunwayImprovedFilter
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
    | antenna | azimuth and elevation, from Return to touchdown |
    | picture | the tracked touch-down point, from Final to touchdown |
    | laser | from its activation to touchdown |
    | phase | which of them count |
    | heading | declination in the air, heading on the ground |
    | wheel_speed | on the ground |
    | airspeed | wind, in the air |

    Equations: `systems.estimators.runway_improved_filter_kernel`.

    | event | when | does |
    |---|---|---|
    | step | every 10 ms from 5 ms | propagates and fuses what arrived |
    """

    def __init__(
        self,
        config: RunwayImprovedFilterConfig,
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
        config: RunwayImprovedFilterConfig,
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

"""All-weather camera: where the touch-down point is in the picture."""

import math
from typing import Literal

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Metres, NonNegative, Positive, Seconds, Vector3, configuration
from systems.runway_frames import (
    RunwayConfig,
    bearing_and_elevation,
    direction_in_camera,
    pixel_from_angles,
)
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.runway_measurement import PICTURE, PICTURE_PERIOD


@configuration
class RunwayCameraConfig:
    """An uncooled infrared landing camera, 640 x 480 behind 32 x 24 deg, 25 Hz."""

    kind: Literal["geometric"] = "geometric"
    period: Seconds = PICTURE_PERIOD  # s, 25 Hz (Table 3)
    columns: Positive = 640.0  # px
    rows: Positive = 480.0  # px
    horizontal_field_of_view: Positive = 32.0  # deg, FOV_H
    vertical_field_of_view: Positive = 24.0  # deg, FOV_V
    position: Vector3 = Field(default_factory=lambda: [2.5, 0.0, 0.5])  # m, body frame, the nose
    mounting: Vector3 = Field(default_factory=lambda: [0.0, -3.0, 0.0])  # deg, yaw, pitch, roll
    # deg, one sigma of the harmonisation about each axis: roll X, pitch Y, yaw Z; half a degree
    # is the limit that those responsible find reasonable (6.2), taken for two sigma
    harmonisation_roll_spread: NonNegative = 0.25
    harmonisation_pitch_spread: NonNegative = 0.25
    harmonisation_yaw_spread: NonNegative = 0.25
    # m, one sigma of each component of the position; 16 cm is the tolerance of 6.3
    position_spread: Metres = 0.05
    # s, L_ti: from the world to the camera's output, where the time stamp is put (6.4)
    latency: Seconds = 0.0

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayCamera":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayCamera(self, seed, runway))

    def optics(self) -> np.ndarray:
        """FOV_H, FOV_V (rad) and IFOV_H, IFOV_V (rad/px), shape (4,)."""
        h = math.radians(self.horizontal_field_of_view)
        v = math.radians(self.vertical_field_of_view)
        return np.array([h, v, h / self.columns, v / self.rows])

    def mounting_radians(self) -> np.ndarray:
        """Yaw, pitch and roll of the camera in the body frame, rad, shape (3,)."""
        return np.radians(self.mounting)


@njit(cache=True)
def camera_sample(state, time, index, parameters):
    """One picture's content, shape (7,).

    `parameters` are the optics (4), the true position (3, m) and mounting (3,
    rad) of the camera and its latency (s), which the time stamp includes.
    """
    optics = parameters[:4]
    p_c = direction_in_camera(
        state[:3], state[6], state[7], state[8], parameters[4:7], parameters[7:10]
    )
    bearing, elevation = bearing_and_elevation(p_c)
    u, v = pixel_from_angles(bearing, elevation, optics)
    inside = p_c[0] > 0.0 and 0.0 <= u < optics[0] / optics[2] and 0.0 <= v < optics[1] / optics[3]
    stamp = time + parameters[10]
    return np.array([stamp, time, float(index), 1.0 if inside else 0.0, u, v, 0.0])


def camera_parameters(config: RunwayCameraConfig, seed: int) -> np.ndarray:
    """The parameters of `camera_sample` with the harmonisation errors of one run, shape (11,)."""
    stream = RunwayCamera.stream
    angles = turn_on(
        seed,
        stream,
        [
            math.radians(config.harmonisation_yaw_spread),
            math.radians(config.harmonisation_pitch_spread),
            math.radians(config.harmonisation_roll_spread),
        ],
    )
    shift = turn_on(seed, f"{stream}.position", [config.position_spread] * 3)
    return np.array(
        [
            *config.optics(),
            *(np.array(config.position) + shift),
            *(config.mounting_radians() + angles),
            config.latency,
        ]
    )


class RunwayCamera(RunwaySensor):
    """The camera of the thesis: pinhole angles, harmonisation errors, latency.

    .. pydrake_system::

        name: RunwayCamera
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | PICTURE | the touch-down point; valid inside the field of view |

    With P_c the touch-down point in the camera frame (Leonard 2016, Eqs. 7, 9, 14)

        ((Bearing + FOV_H/2)/IFOV_H, (Elevation + FOV_V/2)/IFOV_V)
        Bearing = atan2(Y, X),  Elevation = asin(Z/D)

    The harmonisation errors turn the true mounting away from the configured one
    (angles) and shift it (position). The camera's latency cannot be corrected: its
    time of validity is when the picture left the camera, not when it was taken.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | samples every `period` |

    The measurement leaves the camera at its time of validity; the tracker holds
    it back until then.
    """

    layout = PICTURE
    stream = "runway_camera"
    look = PICTURE_PERIOD
    capacity = 1

    def _draw(self, config: RunwayCameraConfig, seed: int) -> np.ndarray:
        return camera_parameters(config, seed)

    def _sample(self, state, time, index):
        return camera_sample(state, time, index, self._parameters)

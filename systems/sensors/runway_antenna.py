"""Directional antenna of the ground station: azimuth, and the elevation that chapter 7 adds."""

import math

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import NonNegative, Seconds, configuration
from systems.runway_frames import RunwayConfig, wrap_angle
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.noise import standard_normals
from systems.signals.runway_measurement import ANTENNA, ANTENNA_PERIOD, PICTURE_PERIOD


@configuration
class RunwayAntennaConfig:
    """A two-axis tracking antenna with a dish of a few degrees' beam.

    Such positioners are specified to track within a tenth of the beam, a few
    tenths of a degree; the harmonisation is a surveyed alignment on a mast.
    """

    period: Seconds = ANTENNA_PERIOD  # s, 1 Hz (Table 21)
    azimuth_bias_spread: NonNegative = 0.5  # deg, harmonisation
    elevation_bias_spread: NonNegative = 0.3  # deg
    noise: NonNegative = 0.2  # deg, tracking, both axes
    delay: Seconds = 0.2  # s, of the data link

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayAntenna":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayAntenna(self, seed, runway))


@njit(cache=True)
def antenna_angles(p_n, station):
    """Azimuth (clockwise from north) and elevation of a point seen from the station, rad."""
    north, east, down = p_n[0] - station[0], p_n[1] - station[1], p_n[2] - station[2]
    return math.atan2(east, north), math.atan2(-down, math.hypot(north, east))


@njit(cache=True)
def antenna_sample(state, time, index, parameters, key):
    """One measurement (16), shape (6,).

    `parameters` are the two biases, the noise (rad) and the station in NED (m).
    """
    azimuth, elevation = antenna_angles(state[:3], parameters[3:6])
    n = standard_normals(key, index, 2)
    azimuth = wrap_angle(azimuth + parameters[0] + parameters[2] * n[0])
    elevation += parameters[1] + parameters[2] * n[1]
    return np.array([time, time, float(index), 1.0, azimuth, elevation])


class RunwayAntenna(RunwaySensor):
    """The ground station's antenna, which follows the aircraft and sends it the angles.

    .. pydrake_system::

        name: RunwayAntenna
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | ANTENNA | azimuth and elevation of the aircraft |

    α_k = α_{k−τ} + b + n_k (Leonard 2016, Eq. 16), the elevation likewise.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = ANTENNA
    stream = "runway_antenna"
    look = PICTURE_PERIOD

    def _draw(self, config: RunwayAntennaConfig, seed: int) -> np.ndarray:
        biases = turn_on(
            seed,
            self.stream,
            [math.radians(config.azimuth_bias_spread), math.radians(config.elevation_bias_spread)],
        )
        return np.array([*biases, math.radians(config.noise), *self._runway.ground_station_n()])

    def _sample(self, state, time, index):
        return antenna_sample(state, time, index, self._parameters, self._key)

"""Magnetic heading: the angle between the aircraft's axis and magnetic north."""

import math

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Finite, NonNegative, Seconds, configuration
from systems.runway_frames import RunwayConfig, wrap_angle
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.noise import standard_normal
from systems.signals.runway_measurement import MAGNETIC_HEADING, SLOW_PERIOD


@configuration
class RunwayHeadingConfig:
    """An electronic compass; Honeywell's HMR3500 class holds 1 deg rms after calibration."""

    period: Seconds = SLOW_PERIOD  # s
    declination: Finite = 1.0  # deg, magnetic north east of true north, at the site
    declination_spread: NonNegative = 0.3  # deg, local anomaly, one sigma from run to run
    deviation_spread: NonNegative = 0.5  # deg, left by the calibration, one sigma
    noise: NonNegative = 0.5  # deg, one sigma
    delay: Seconds = 0.0  # s

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayHeading":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayHeading(self, seed, runway))


@njit(cache=True)
def heading_sample(state, time, index, parameters, key):
    """One measurement, shape (5,); `parameters` are declination less deviation, and noise (rad)."""
    heading = wrap_angle(state[6] - parameters[0] + parameters[1] * standard_normal(key, index, 0))
    return np.array([time, time, float(index), 1.0, heading])


class RunwayHeading(RunwaySensor):
    """The aircraft's compass.

    .. pydrake_system::

        name: RunwayHeading
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | MAGNETIC_HEADING | clockwise from magnetic north |

    ψ_k^mag = ψ_{k−τ} − declination + deviation + n_k (Leonard 2016, 2.2).

    | event | when | does |
    |---|---|---|
    | update | every 80 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = MAGNETIC_HEADING
    stream = "runway_heading"
    look = SLOW_PERIOD

    def _draw(self, config: RunwayHeadingConfig, seed: int) -> np.ndarray:
        anomaly, deviation = turn_on(
            seed, self.stream, [config.declination_spread, config.deviation_spread]
        )
        offset = math.radians(config.declination + anomaly - deviation)
        return np.array([offset, math.radians(config.noise)])

    def _sample(self, state, time, index):
        return heading_sample(state, time, index, self._parameters, self._key)

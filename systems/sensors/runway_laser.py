"""Laser height sensor: height above the ground with bias, noise, delay and activation height."""

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Metres, Seconds, configuration
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.noise import standard_normal
from systems.signals.runway_measurement import LASER_HEIGHT, LASER_PERIOD


@configuration
class RunwayLaserConfig:
    """A laser altimeter of the class of the LightWare SF11 (120 m, ±0.1 m, median filter)."""

    period: Seconds = LASER_PERIOD  # s, 10 Hz (Table 3)
    bias_spread: Metres = 0.05  # m, "a few centimeters" (3.2)
    noise: Metres = 0.1  # m, one sigma; SF11 manual: accuracy 0.1 m
    delay: Seconds = 0.1  # s, of the filter that takes out trees and houses
    activation_height: Metres = 100.0  # m above ground (6.1, Delayed Laser Activation)
    activation_spread: Metres = 5.0  # m, one sigma of it from run to run

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayLaser":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayLaser(self, seed, runway))


@njit(cache=True)
def laser_sample(state, time, index, parameters, key):
    """One measurement (12), shape (5,); `parameters` are bias, noise, activation height (m)."""
    height = state[13] + parameters[0] + parameters[1] * standard_normal(key, index, 0)
    valid = 1.0 if state[13] < parameters[2] else 0.0
    return np.array([time, time, float(index), valid, height])


class RunwayLaser(RunwaySensor):
    """The laser height sensor of the thesis.

    .. pydrake_system::

        name: RunwayLaser
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | LASER_HEIGHT | valid below the activation height |

    H_k^Laser = H_{k−τ}^AGL + b + n_k (Leonard 2016, Eq. 12). It measures along
    the vertical: the sensor takes out the attitude.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = LASER_HEIGHT
    stream = "runway_laser"

    def _draw(self, config: RunwayLaserConfig, seed: int) -> np.ndarray:
        bias, activation = turn_on(
            seed, self.stream, [config.bias_spread, config.activation_spread]
        )
        return np.array([bias, config.noise, config.activation_height + activation])

    def _sample(self, state, time, index):
        return laser_sample(state, time, index, self._parameters, self._key)

"""Wheel encoder: the speed of the main wheels while they are on the ground."""

import math

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import NonNegative, Seconds, configuration
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.noise import standard_normal
from systems.signals.runway_measurement import SLOW_PERIOD, WHEEL_SPEED


@configuration
class RunwayWheelEncoderConfig:
    """The tone wheel of an anti-skid brake."""

    period: Seconds = SLOW_PERIOD  # s
    scale_spread: NonNegative = 0.01  # 1, tyre radius with load and pressure, one sigma
    resolution: NonNegative = 0.05  # m/s, one tooth of 60 on a wheel of 0.5 m in 0.5 s
    noise: NonNegative = 0.05  # m/s, one sigma
    delay: Seconds = 0.0  # s

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayWheelEncoder":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayWheelEncoder(self, seed, runway))


@njit(cache=True)
def wheel_sample(state, time, index, parameters, key):
    """One measurement, shape (5,); `parameters` are scale error, resolution and noise (m/s)."""
    speed = (1.0 + parameters[0]) * math.hypot(state[3], state[4])
    speed += parameters[2] * standard_normal(key, index, 0)
    if parameters[1] > 0.0:
        speed = parameters[1] * math.floor(speed / parameters[1] + 0.5)
    return np.array([time, time, float(index), state[14], max(speed, 0.0)])


class RunwayWheelEncoder(RunwaySensor):
    """The wheel encoder that section 2.3 proposes for the braking phase.

    .. pydrake_system::

        name: RunwayWheelEncoder
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | WHEEL_SPEED | valid with weight on wheels |

    | event | when | does |
    |---|---|---|
    | update | every 80 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = WHEEL_SPEED
    stream = "runway_wheel_encoder"
    look = SLOW_PERIOD

    def _draw(self, config: RunwayWheelEncoderConfig, seed: int) -> np.ndarray:
        scale = turn_on(seed, self.stream, [config.scale_spread])
        return np.array([scale[0], config.resolution, config.noise])

    def _sample(self, state, time, index):
        return wheel_sample(state, time, index, self._parameters, self._key)

"""Airspeed from air data: what the wind is found from."""

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import NonNegative, Seconds, configuration
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.noise import standard_normal
from systems.signals.runway_measurement import AIRSPEED, SLOW_PERIOD


@configuration
class RunwayAirspeedConfig:
    """A pitot-static air-data computer, its airspeed corrected to true."""

    period: Seconds = SLOW_PERIOD  # s
    bias_spread: NonNegative = 0.5  # m/s, one sigma; TSO-C106 computers hold a knot or two
    noise: NonNegative = 0.3  # m/s, one sigma
    delay: Seconds = 0.0  # s

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayAirspeed":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayAirspeed(self, seed, runway))


@njit(cache=True)
def airspeed_sample(state, time, index, parameters, key):
    """One measurement, shape (5,); `parameters` are bias and noise (m/s)."""
    airspeed = state[12] + parameters[0] + parameters[1] * standard_normal(key, index, 0)
    valid = 1.0 - state[14]
    return np.array([time, time, float(index), valid, airspeed])


class RunwayAirspeed(RunwaySensor):
    """The air data's true airspeed (Leonard 2016, 2.2).

    .. pydrake_system::

        name: RunwayAirspeed
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | AIRSPEED | valid in the air |

    | event | when | does |
    |---|---|---|
    | update | every 80 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = AIRSPEED
    stream = "runway_airspeed"
    look = SLOW_PERIOD

    def _draw(self, config: RunwayAirspeedConfig, seed: int) -> np.ndarray:
        bias = turn_on(seed, self.stream, [config.bias_spread])
        return np.array([bias[0], config.noise])

    def _sample(self, state, time, index):
        return airspeed_sample(state, time, index, self._parameters, self._key)

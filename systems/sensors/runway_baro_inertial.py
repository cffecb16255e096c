"""Baro-inertial altitude: bias, scale factor and what is left of the barometer's delay."""

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Metres, NonNegative, Seconds, configuration
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_sensor import RunwaySensor, turn_on
from systems.signals.runway_measurement import BARO_INERTIAL, NAVIGATION_PERIOD


@configuration
class RunwayBaroInertialConfig:
    """An air-data altimeter set by the operator to the field's pressure."""

    period: Seconds = NAVIGATION_PERIOD  # s, 50 Hz (Table 3)
    # m, one sigma: RVSM systems hold 25 m at cruise (ICAO Doc 9574), low ones ±20 ft at the
    # field (14 CFR 43 appendix E, 0 to 1000 ft), and the reference pressure is given to 1 hPa
    bias_spread: Metres = 4.0
    # 1: 4 ft a 1000 ft for each degree off the standard atmosphere (ICAO Doc 8168), and 2 or 3
    # degrees left once the field's temperature is set
    scale_spread: NonNegative = 0.01
    delay: Seconds = 0.1  # s, what the inertial fusion leaves of the pressure line's lag

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayBaroInertial":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayBaroInertial(self, seed, runway))


@njit(cache=True)
def baro_inertial_sample(state, time, index, parameters):
    """One measurement (13), shape (5,); `parameters` are bias (m) and scale factor (1)."""
    altitude = -state[2] + parameters[0] - parameters[1] * state[2]
    return np.array([time, time, float(index), 1.0, altitude])


class RunwayBaroInertial(RunwaySensor):
    """The baro-inertial altitude of the thesis, above the touch-down point.

    .. pydrake_system::

        name: RunwayBaroInertial
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | BARO_INERTIAL | altitude above the touch-down point |

    H_k^Baro = Z_{k−τ} + b + sf Z_{k−τ} (Leonard 2016, Eq. 13), where Z is meant
    upwards although the superscript says NED.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = BARO_INERTIAL
    stream = "runway_baro_inertial"

    def _draw(self, config: RunwayBaroInertialConfig, seed: int) -> np.ndarray:
        return turn_on(seed, self.stream, [config.bias_spread, config.scale_spread])

    def _sample(self, state, time, index):
        return baro_inertial_sample(state, time, index, self._parameters)

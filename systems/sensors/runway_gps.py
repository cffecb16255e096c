"""The receiver that gets lost: position and velocity until the loss."""

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Metres, NonNegative, Seconds, configuration
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_sensor import RunwaySensor
from systems.signals.noise import standard_normals
from systems.signals.runway_measurement import FIX, PICTURE_PERIOD


@configuration
class RunwayGpsConfig:
    """A receiver in the normal operation mode.

    In a scenario that starts on final there is one fix only, at t = 0, with the
    spread that the return leaves: it stands for the thesis's "filter's initial
    parameters", the errors in X, Y, Z, V_X and V_Y drawn from normal laws (6.2).
    """

    period: Seconds = 1.0  # s
    horizontal_noise: Metres = 1.5  # m, one sigma of each component
    vertical_noise: Metres = 3.0  # m
    speed_noise: NonNegative = 0.1  # m/s
    # What the fix says of itself; 0: the truth. Smaller than the noise it makes a filter trust a
    # position, an altitude or a speed that is wrong, as one that has drifted since
    reported_horizontal_accuracy: Metres = 0.0  # m
    reported_vertical_accuracy: Metres = 0.0  # m
    reported_speed_accuracy: NonNegative = 0.0  # m/s
    loss_time: Seconds = 0.0  # s, the last fix is the one at or before it
    delay: Seconds = 0.0  # s

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayGps":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayGps(self, seed, runway))


@njit(cache=True)
def fix_sample(state, time, index, parameters, key):
    """One fix, shape (12,).

    `parameters` are the three sigmas (m, m, m/s), the time of loss (s), and the three
    accuracies as reported (0: the sigma).
    """
    n = standard_normals(key, index, 5)
    fix = np.empty(12)
    fix[0] = time
    fix[1] = time
    fix[2] = index
    fix[3] = 1.0 if time <= parameters[3] + 1e-9 else 0.0
    fix[4] = state[0] + parameters[0] * n[0]
    fix[5] = state[1] + parameters[0] * n[1]
    fix[6] = state[2] + parameters[1] * n[2]
    fix[7] = state[3] + parameters[2] * n[3]
    fix[8] = state[4] + parameters[2] * n[4]
    fix[9:12] = parameters[:3]
    for i in range(3):
        if parameters[4 + i] > 0.0:
            fix[9 + i] = parameters[4 + i]
    return fix


class RunwayGps(RunwaySensor):
    """The satellite receiver, jammed from `loss_time` on.

    .. pydrake_system::

        name: RunwayGps
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | FIX | valid until the loss |

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | samples every `period`, lets out after `delay` |
    """

    layout = FIX
    stream = "runway_gps"
    look = PICTURE_PERIOD

    def _draw(self, config: RunwayGpsConfig, seed: int) -> np.ndarray:
        return np.array(
            [
                config.horizontal_noise,
                config.vertical_noise,
                config.speed_noise,
                config.loss_time,
                config.reported_horizontal_accuracy,
                config.reported_vertical_accuracy,
                config.reported_speed_accuracy,
            ]
        )

    def _sample(self, state, time, index):
        return fix_sample(state, time, index, self._parameters, self._key)

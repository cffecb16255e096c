"""ArduPilot's descent, with and without a target: shared by the routines that build on it.

Facts: ArduPilot Copter's land mode and `AC_PrecLand`; default parameters in the comments. The
descent is horizontal position control towards the target with a vertical speed that
depends on the height and on the horizontal error:

    above land_altitude_low      root controller towards it, at most land_speed_high
    below                        land_speed
    with a target, error e > maximum_error       0
    with a target, low_height < height < slow_height
                                 max(minimum_speed, ½ land_speed (1 − e/acceptable_error))
"""

import math
from typing import Generic, TypeVar

from systems.configuration import Metres, Positive, configuration
from systems.supervisors.situation import Memory, Situation

M = TypeVar("M", bound=Memory)


@configuration
class DescentConfig:
    """How fast ArduPilot descends."""

    land_speed: Positive = 0.5  # m/s, LAND_SPEED
    land_speed_high: Positive = 1.5  # m/s, WPNAV_SPEED_DN, as LAND_SPEED_HIGH is 0
    land_altitude_low: Metres = 10.0  # m, LAND_ALT_LOW
    position_gain: Positive = 1.0  # 1/s, PSC_POSZ_P
    acceleration: Positive = 1.0  # m/s2, WPNAV_ACCEL_Z
    maximum_error: Metres = 2.5  # m, PLND_XY_DIST_MAX; 0 descends whatever the error
    low_height: Metres = 0.35  # m above the target, fixed in ArduPilot
    slow_height: Metres = 2.0  # m above the target, fixed in ArduPilot
    acceptable_error: Positive = 0.15  # m, fixed in ArduPilot
    minimum_speed: Positive = 0.10  # m/s, fixed in ArduPilot
    approach_speed: Positive = 5.0  # m/s, horizontal limit on the way to the target


def landing_speed(config: DescentConfig, height: float) -> float:
    """The rate of descent without a target at a height above ground (m), m/s.

    Above `land_altitude_low` the speed at which the acceleration just suffices to slow down,
    √(2 a (d − a/2k²)) at distance d > a/k², and k d nearer.
    """
    distance = height - max(config.land_altitude_low, 1.0)
    gain, acceleration = config.position_gain, config.acceleration
    linear = acceleration / gain**2
    if distance > linear:
        speed = math.sqrt(2.0 * acceleration * (distance - 0.5 * linear))
    else:
        speed = gain * distance
    fastest = max(config.land_speed_high, config.land_speed)
    return min(max(speed, config.land_speed), fastest)


def precision_landing_speed(
    config: DescentConfig, height: float, height_above_target: float, error: float
) -> float:
    """The rate of descent with a target at a horizontal distance `error` (m), m/s."""
    if error > config.maximum_error > 0.0:
        return 0.0
    if config.low_height < height_above_target < config.slow_height:
        slowed = 0.5 * config.land_speed * (1.0 - error / config.acceptable_error)
        return max(config.minimum_speed, slowed)
    return landing_speed(config, height)


class ArduPilotDescent(Generic[M]):
    """Actions and guards of the descent; base class of the routines that descend like this."""

    def __init__(self, descent: DescentConfig):
        """A descent; see `DescentConfig`."""
        self._descent = descent

    def descend_on_target(self, s: Situation[M]) -> None:
        """Steer over the target and descend as the error allows."""
        m = s.memory
        s.go_to(s.goal_x, s.goal_y, self._descent.approach_speed)
        m.setpoint_vx, m.setpoint_vy = s.pad_vx, s.pad_vy
        m.target_in_use = 1.0
        error = s.distance_to(s.goal_x, s.goal_y)
        s.descend_with(precision_landing_speed(self._descent, s.height, s.z - s.goal_z, error))

    def descend_vertically(self, s: Situation[M]) -> None:
        """Descend at landing speed over the point last asked for."""
        s.hold_horizontally()
        s.descend_with(landing_speed(self._descent, s.height))

    def hold_position(self, s: Situation[M]) -> None:
        """Stay over the point last asked for, at the present height."""
        s.hold_horizontally()
        s.hold_height()

    def target_acquired(self, s: Situation[M]) -> bool:
        """The target is acquired."""
        return s.acquired

    def target_not_acquired(self, s: Situation[M]) -> bool:
        """The target is not acquired any more."""
        return not s.acquired

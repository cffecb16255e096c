"""How the vehicle itself knows that it has landed: after PX4's multicopter land detector.

PX4 believes in a landing after a commanded descent without vertical motion, with
little thrust, close to the ground, for a second in all, and for three seconds where the
distance to the ground is not measured (`MulticopterLandDetector`, stages of a third each).
"""

import math

from systems.configuration import Metres, Positive, Probability, Seconds, configuration
from systems.supervisors.situation import NOT_YET, Memory, Situation

S = Situation[Memory]


@configuration
class TouchdownDetectorConfig:
    """When the vehicle takes itself for landed; defaults from PX4's land detector."""

    duration: Seconds = 1.0  # s, how long the signs must last
    slow_factor: Positive = 3.0  # on the duration where one sign is missing
    maximum_vertical_speed: Positive = 0.25  # m/s, LNDMC_Z_VEL_MAX
    maximum_horizontal_speed: Positive = 1.5  # m/s, LNDMC_XY_VEL_MAX
    minimum_commanded_descent: Positive = 0.275  # m/s, 1.1 LNDMC_Z_VEL_MAX
    maximum_height: Metres = 1.0  # m, above ground where that is measured
    # Of the mean rotor command between its minimum and that of level flight. PX4 takes 0.6, where
    # its controller also stops integrating: a little more is surely reached.
    low_thrust: Probability = 0.7
    minimum_command: Probability = 0.12  # MPC_THR_MIN


class TouchdownDetector:
    """Watches for the ground; the guard `touched_down` is shared by all routines.

    Contact is felt while the commanded rate of descent d > 0 and

        |v_z| < maximum_vertical_speed, −v_z < d/2, |v_xy| < maximum_horizontal_speed,
        height < maximum_height (where measured), and
        low thrust, or d ≥ minimum_commanded_descent

    It must last `duration`; `slow_factor` times longer where the height is not
    measured, and again where rotor commands are known but not low.

    It is at rest until armed, and in the air from when it first moves vertically faster than
    `maximum_vertical_speed` until disarmed. As in PX4, ground effect is to be expected while it is
    asked to descend with `minimum_commanded_descent` and hardly moves horizontally.
    """

    def __init__(self, config: TouchdownDetectorConfig):
        """A detector; see `TouchdownDetectorConfig`."""
        self.config = config

    def observe(self, s: S) -> None:
        """Keep the time since which contact has been felt, and what the detector publishes."""
        c, m = self.config, s.memory
        descent = -m.setpoint_vz if math.isnan(m.setpoint_z) else 0.0
        horizontally_still = math.hypot(s.vx, s.vy) < c.maximum_horizontal_speed
        m.at_rest = 1.0 - m.armed
        if m.armed == 0.0:
            m.in_air = 0.0
        elif abs(s.vz) > c.maximum_vertical_speed:
            m.in_air = 1.0
        m.in_ground_effect = float(descent >= c.minimum_commanded_descent and horizontally_still)
        felt = (
            m.armed > 0.0
            and descent > 0.0
            and abs(s.vz) < c.maximum_vertical_speed
            and -s.vz < 0.5 * descent
            and horizontally_still
            and (s.height < c.maximum_height or not s.height_measured)
            and (descent >= c.minimum_commanded_descent or self.unloaded(s))
        )
        if not felt:
            m.contact_since = NOT_YET
        elif m.contact_since < 0.0:
            m.contact_since = s.time

    def unloaded(self, s: S) -> bool:
        """Whether the rotors carry much less than in level flight (false where not known)."""
        low, hover = self.config.minimum_command, s.memory.hover_command
        return s.command < low + self.config.low_thrust * (hover - low)

    def touched_down(self, s: S) -> bool:
        """The vehicle has felt the ground for a while."""
        c, m = self.config, s.memory
        if m.contact_since < 0.0:
            return False
        duration = c.duration
        if not s.height_measured:
            duration *= c.slow_factor
        if not math.isnan(s.command) and not self.unloaded(s):
            duration *= c.slow_factor
        return s.time - m.contact_since >= duration

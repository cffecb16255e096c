"""ArduPilot's precision landing: `AC_PrecLand` with its retries and failsafe.

| target | STRICT 0 | STRICT 1 | STRICT 2 |
|---|---|---|---|
| acquired | descend on it | same | same |
| out of range | descend | same | same |
| lost a while ago | descend | descend `timeout`, then retry | same |
| never seen, or retry without success | descend | hold 7 s, then descend | hold for ever |

Out of range is a height that is unknown, below `minimum_height` or above `maximum_height`; a
target seen before counts as never seen afterwards. With STRICT 0 this is the default
operation of the infrared and marker thesis (section 6.1): when the target is lost the
descent goes on at landing speed.

A retry flies to where the target was last seen, 1.5 m higher, and back down; the target's
re-acquisition at any time resumes the landing.
"""

import math
from typing import Literal

from pydantic import Field

from systems.configuration import Metres, Positive, Seconds, configuration
from systems.supervisors.descent import ArduPilotDescent, DescentConfig
from systems.supervisors.situation import Memory, Situation
from systems.supervisors.state_machine import (
    State,
    Transition,
    TransitionTable,
    transitions_from,
)

_RETRY_CLIMB = 1.5  # m, above the stored point
_RETRY_TOLERANCE = 0.75  # m
_FAILSAFE_HOLD = 7.0  # s
_FORGET_TIME = 180.0  # s
_FORGET_DISTANCE = 30.0  # m


class ArduPilotMemory(Memory):
    """What the routine remembers besides."""

    seen: float = 0.0  # 0/1, the target was acquired and has not been out of range since
    retries: float = 0.0


S = Situation[ArduPilotMemory]


class ArduPilot(ArduPilotDescent[ArduPilotMemory]):
    """Guards and actions of ArduPilot's precision landing."""

    table = TransitionTable(
        initial="descend",
        states=(
            State("descend", stay=("descend_vertically", "watch_range")),
            State("descend_on_target", stay=("descend_on_target", "remember_target")),
            State("retry_climb", entry=("count_retry",), stay=("fly_above_last_sighting",)),
            State("retry_descend", stay=("fly_to_height_of_last_sighting",)),
            State("failsafe_hold", entry=("hold_position",)),
            State("failsafe_descend", stay=("descend_vertically",)),
        ),
        transitions=(
            *transitions_from(("descend", "descend_on_target"), "landed", "touched_down"),
            Transition("descend_on_target", "descend", "target_not_acquired"),
            *transitions_from(
                ("descend", "retry_climb", "retry_descend", "failsafe_hold"),
                "descend_on_target",
                "target_acquired",
            ),
            Transition("descend", "retry_climb", "retry_due"),
            Transition("descend", "failsafe_hold", "failsafe_due"),
            *transitions_from(
                ("retry_climb", "retry_descend", "failsafe_hold"), "descend", "out_of_range"
            ),
            Transition("retry_climb", "retry_descend", "above_last_sighting"),
            Transition("retry_descend", "failsafe_hold", "at_height_of_last_sighting"),
            Transition("failsafe_hold", "failsafe_descend", "failsafe_hold_over"),
            Transition("failsafe_descend", "landed", "touched_down"),
            Transition("failsafe_descend", "descend_on_target", "target_acquired"),
        ),
    )
    memory = ArduPilotMemory

    def __init__(self, config: "ArduPilotConfig"):
        """ArduPilot's precision landing; see `ArduPilotConfig`."""
        super().__init__(config.descent)
        self.config = config

    def out_of_range(self, s: S) -> bool:
        """The sensor cannot be expected to see the target from this height."""
        low, high = self.config.minimum_height, self.config.maximum_height
        if low == 0.0 and high == 0.0:
            return False
        return not s.range_valid or s.height < low or (high > 0.0 and s.height > high)

    def watch_range(self, s: S) -> None:
        """Forget that the target was seen while out of range, or long ago, or far away."""
        m = s.memory
        if m.seen > 0.0:
            away = max(s.distance_to(m.goal_x, m.goal_y), s.distance_to(m.sighting_x, m.sighting_y))
            if (
                self.out_of_range(s)
                or s.time - m.last_acquired > _FORGET_TIME
                or away > _FORGET_DISTANCE
            ):
                m.seen = 0.0

    def remember_target(self, s: S) -> None:
        """Remember that the target was acquired."""
        s.memory.seen = 1.0

    def _timed_out(self, s: S) -> bool:
        return s.time - s.memory.last_acquired >= self.config.timeout

    def retry_due(self, s: S) -> bool:
        """The target has been lost for the timeout, in range, and a retry is left."""
        return (
            self.config.strictness > 0
            and s.memory.seen > 0.0
            and not self.out_of_range(s)
            and self._timed_out(s)
            and s.memory.retries < self.config.maximum_retries
        )

    def failsafe_due(self, s: S) -> bool:
        """In range, the target was never seen or no retry is left."""
        if self.config.strictness == 0 or self.out_of_range(s):
            return False
        return s.memory.seen == 0.0 or self._timed_out(s)

    def count_retry(self, s: S) -> None:
        """Count the retry as a new attempt."""
        s.memory.retries += 1.0
        s.memory.attempts += 1.0

    def _last_sighting(self, s: S) -> tuple[float, float, float]:
        m = s.memory
        if self.config.retry_behaviour == "target_location":
            return m.goal_x, m.goal_y, m.sighting_z
        return m.sighting_x, m.sighting_y, m.sighting_z

    def fly_above_last_sighting(self, s: S) -> None:
        """Fly to the stored point, a little higher."""
        x, y, z = self._last_sighting(s)
        s.go_to(x, y, self.config.retry_speed)
        s.climb_towards(z + _RETRY_CLIMB, self.config.retry_speed)
        s.memory.target_in_use = 0.0

    def above_last_sighting(self, s: S) -> bool:
        """The point above the last sighting is reached."""
        x, y, z = self._last_sighting(s)
        distance = math.hypot(s.distance_to(x, y), s.z - z - _RETRY_CLIMB)
        return distance < _RETRY_TOLERANCE

    def fly_to_height_of_last_sighting(self, s: S) -> None:
        """Descend again to the height of the last sighting."""
        s.climb_towards(s.memory.sighting_z, self.config.retry_speed)

    def at_height_of_last_sighting(self, s: S) -> bool:
        """The height of the last sighting is reached without the target."""
        return abs(s.z - s.memory.sighting_z) < _RETRY_TOLERANCE

    def failsafe_hold_over(self, s: S) -> bool:
        """The failsafe has held its position long enough, and may land."""
        return self.config.strictness < 2 and s.time - s.memory.entered >= _FAILSAFE_HOLD


@configuration
class ArduPilotConfig:
    """ArduPilot's precision landing; defaults are ArduPilot's."""

    kind: Literal["ardupilot"] = "ardupilot"
    descent: DescentConfig = Field(default_factory=DescentConfig)
    strictness: Literal[0, 1, 2] = 1  # PLND_STRICT: land anyway, retry, never land blindly
    timeout: Seconds = 4.0  # s, PLND_TIMEOUT, descent goes on so long after a loss
    maximum_retries: int = Field(default=4, ge=0, le=10)  # PLND_RET_MAX
    retry_behaviour: Literal["last_location", "target_location"] = "last_location"  # RET_BEHAVE
    minimum_height: Metres = 0.75  # m, PLND_ALT_MIN
    maximum_height: Metres = 8.0  # m, PLND_ALT_MAX
    retry_speed: Positive = 1.5  # m/s, on the way to the stored point

    def routine(self) -> ArduPilot:
        """The routine with this configuration."""
        return ArduPilot(self)

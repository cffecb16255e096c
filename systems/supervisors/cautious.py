"""The cautious landing of the infrared and marker thesis (Badakis 2020, chapter 6.2).

When the target is lost on the descent the vehicle pauses; if it does not see the target again
it goes back to where it last saw it in this attempt, then to a default height to start
another attempt from scratch. When the attempts are used up it descends as by default, whatever
it sees. The descent itself is ArduPilot's (section 6.1).

The thesis leaves the pauses, the default height and the number of attempts to
parameters without giving their values.
"""

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


class CautiousMemory(Memory):
    """What the routine remembers besides."""

    seen: float = 0.0  # 0/1, the target was in sight during this attempt


S = Situation[CautiousMemory]


class Cautious(ArduPilotDescent[CautiousMemory]):
    """Guards and actions of the cautious landing."""

    table = TransitionTable(
        initial="pause",
        states=(
            State("pause", entry=("hold_position",)),
            State("descend", stay=("descend_by_default", "remember_sighting")),
            State("return_to_sighting", stay=("fly_to_sighting",)),
            State("look_from_sighting", entry=("hold_position",)),
            State("return_to_height", entry=("begin_attempt",), stay=("fly_to_height",)),
            State("descend_blindly", stay=("descend_by_default",)),
        ),
        transitions=(
            Transition("pause", "descend", "target_in_sight"),
            Transition("pause", "return_to_sighting", "pause_over_after_sighting"),
            Transition("pause", "return_to_height", "pause_over_and_attempts_left"),
            Transition("pause", "descend_blindly", "pause_over"),
            Transition("descend", "landed", "touched_down"),
            Transition("descend", "pause", "target_lost"),
            Transition("return_to_sighting", "look_from_sighting", "at_sighting"),
            Transition(
                "look_from_sighting",
                "descend",
                "target_in_sight_and_attempts_left",
                ("begin_attempt",),
            ),
            Transition("look_from_sighting", "return_to_height", "pause_over_and_attempts_left"),
            Transition("look_from_sighting", "descend_blindly", "pause_over"),
            Transition("return_to_height", "pause", "at_height"),
            *transitions_from(("descend_blindly",), "landed", "touched_down"),
        ),
    )
    memory = CautiousMemory

    def __init__(self, config: "CautiousConfig"):
        """A cautious landing; see `CautiousConfig`."""
        super().__init__(config.descent)
        self.config = config

    def target_in_sight(self, s: S) -> bool:
        """The target is acquired and was fused a moment ago."""
        return s.acquired and s.time - s.memory.last_fusion <= self.config.lost_after

    def target_lost(self, s: S) -> bool:
        """The target is out of sight, and the ground is not yet close."""
        return s.height > self.config.commit_height and not self.target_in_sight(s)

    def _attempts_left(self, s: S) -> bool:
        return s.memory.attempts < self.config.maximum_attempts

    def target_in_sight_and_attempts_left(self, s: S) -> bool:
        """The target is in sight, and another attempt is left."""
        return self._attempts_left(s) and self.target_in_sight(s)

    def pause_over(self, s: S) -> bool:
        """The pause is over."""
        return s.time - s.memory.entered >= self.config.pause

    def pause_over_after_sighting(self, s: S) -> bool:
        """The pause is over, and the target was seen in this attempt."""
        return s.memory.seen > 0.0 and self.pause_over(s)

    def pause_over_and_attempts_left(self, s: S) -> bool:
        """The pause is over, and another attempt is left."""
        return self._attempts_left(s) and self.pause_over(s)

    def at_sighting(self, s: S) -> bool:
        """The place of the last sighting is reached."""
        m = s.memory
        return (
            s.distance_to(m.sighting_x, m.sighting_y) <= self.config.tolerance
            and abs(s.z - m.sighting_z) <= self.config.tolerance
        )

    def at_height(self, s: S) -> bool:
        """The default height is reached."""
        return abs(self._default_z(s) - s.z) <= self.config.tolerance

    def _default_z(self, s: S) -> float:
        return s.memory.home_z + self.config.default_height

    def descend_by_default(self, s: S) -> None:
        """Descend on the target if it is acquired, vertically if not."""
        if s.acquired:
            self.descend_on_target(s)
        else:
            self.descend_vertically(s)

    def remember_sighting(self, s: S) -> None:
        """Remember that the target was in sight during this attempt."""
        if s.updated:
            s.memory.seen = 1.0

    def begin_attempt(self, s: S) -> None:
        """Begin another attempt from scratch."""
        s.memory.attempts += 1.0
        s.memory.seen = 0.0

    def fly_to_sighting(self, s: S) -> None:
        """Fly back to where the vehicle was when it last saw the target."""
        m = s.memory
        s.go_to(m.sighting_x, m.sighting_y, self.config.return_speed)
        s.climb_towards(m.sighting_z, self.config.return_speed)

    def fly_to_height(self, s: S) -> None:
        """Climb (or descend) to the default height."""
        s.hold_horizontally()
        s.climb_towards(self._default_z(s), self.config.return_speed)


@configuration
class CautiousConfig:
    """The thesis's cautious landing."""

    kind: Literal["cautious"] = "cautious"
    descent: DescentConfig = Field(default_factory=DescentConfig)
    lost_after: Seconds = 1.0  # s without a fused measurement; thesis 5.2, freshness
    pause: Seconds = 3.0  # s, longer than ArduPilot takes to acquire a target
    default_height: Metres = 6.0  # m above the place of arming; marker reliable to here, 8.2.2
    maximum_attempts: int = Field(default=3, ge=1)
    commit_height: Metres = 0.75  # m, below which the descent goes on; ArduPilot PLND_ALT_MIN
    tolerance: Positive = 0.3  # m, at which a place or a height is reached
    return_speed: Positive = 1.5  # m/s, on the way back

    def routine(self) -> Cautious:
        """The routine with this configuration."""
        return Cautious(self)

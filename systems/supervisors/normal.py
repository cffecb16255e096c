"""Normal: a landing without a target, at the point where the climb had ended."""

from typing import Literal

from pydantic import Field

from systems.configuration import configuration
from systems.supervisors.descent import ArduPilotDescent, DescentConfig
from systems.supervisors.situation import Memory, Situation
from systems.supervisors.state_machine import State, Transition, TransitionTable


class Normal(ArduPilotDescent[Memory]):
    """ArduPilot's land mode without a precision-landing sensor (thesis section 3.3, "None")."""

    table = TransitionTable(
        initial="descend",
        states=(State("descend", entry=("aim_at_mark",), stay=("descend_vertically",)),),
        transitions=(Transition("descend", "landed", "touched_down"),),
    )
    memory = Memory

    def __init__(self, config: "NormalConfig"):
        """A normal landing; see `NormalConfig`."""
        super().__init__(config.descent)
        self.config = config

    def aim_at_mark(self, s: Situation[Memory]) -> None:
        """Go over the point where the climb had ended."""
        s.go_to(s.memory.mark_x, s.memory.mark_y, self.config.descent.approach_speed)


@configuration
class NormalConfig:
    """A landing at the place of the take-off, by the navigation filter alone."""

    kind: Literal["normal"] = "normal"
    descent: DescentConfig = Field(default_factory=DescentConfig)

    def routine(self) -> Normal:
        """The routine with this configuration."""
        return Normal(self)

"""The face of the laboratory: the command line, and the names a notebook imports.

import plumbline

scenario = plumbline.load_scenario("infrared-and-marker", {"wind.speed": 5.0})
result, log = plumbline.fly(scenario)
"""

from typing import TYPE_CHECKING, Any

from diagrams.loading import ScenarioError, load_scenario, scenario_names, with_overrides

if TYPE_CHECKING:
    import pyarrow as pa

    from runs.run import Laboratory, RunResult

__all__ = [
    "ScenarioError",
    "fly",
    "laboratory",
    "load_scenario",
    "replay",
    "scenario_names",
    "with_overrides",
]


def laboratory(scenario: Any) -> "Laboratory":
    """The laboratory that flies `scenario`, re-used within the process where it can be."""
    from runs.run import laboratory

    return laboratory(scenario)


def fly(scenario: Any) -> "tuple[RunResult, pa.Table]":
    """Fly a scenario; returns the verdict and the log (a table; `.to_pandas()` if you like)."""
    lab = laboratory(scenario)
    simulator = lab.start()
    result = lab.fly(simulator)
    return result, lab.log(simulator.get_context())


class Replay:
    """A 3-D replay of a flight, which a notebook shows as it is."""

    def __init__(self, page: str):
        self.page = page

    def _repr_html_(self) -> str:
        from html import escape

        source = escape(self.page)
        return f'<iframe srcdoc="{source}" width="100%" height="480" style="border:0"></iframe>'


def replay(scenario: Any, log: "pa.Table") -> Replay:
    """A flight in 3-D, to look at in a notebook."""
    from runs.replay_3d import replay_html

    return Replay(replay_html(scenario, log))

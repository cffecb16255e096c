"""The experiments of the studies that land without GPS: compiled, or in the Drake diagram."""

import math
import time
from typing import Any

from diagrams.landing_without_gps import LandingWithoutGpsScenario
from diagrams.loading import ScenarioError, load_scenario, with_overrides
from runs.compiled_landing import fly_compiled
from runs.landing_without_gps import simulate_landing
from studies.study import Study, StudyError


class DiagramLanding:
    """Flies the Drake diagram; see `studies.executors.Experiment`."""

    fly = staticmethod(simulate_landing)

    def prepare(self, study: Study) -> None:
        """Load the study's scenario."""
        try:
            scenario = load_scenario(study.scenario)
        except ScenarioError as error:
            raise StudyError(str(error)) from None
        if not isinstance(scenario, LandingWithoutGpsScenario):
            raise StudyError(
                f"{study.name}: expected a scenario of kind landing_without_gps, but "
                f"{study.scenario} is a {scenario.kind}"
            )
        self._scenario = scenario

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        """Fly once.

        Parameters
        ----------
        overrides : dict
            Dotted field paths of the scenario and their values.
        seed : int
            Of all noise of the run, and of every error that is drawn once a run.

        Returns
        -------
        dict
            The numbers of `runs.landing_without_gps.landing_numbers`, `touchdown_error_m` (from the
            touch-down point), and `cpu_s`.
        """
        begin = time.process_time()
        try:
            row = self.fly(with_overrides(self._scenario, overrides), seed)
        except ScenarioError as error:
            raise StudyError(str(error)) from None
        row["touchdown_error_m"] = math.hypot(row["touchdown_x"], row["touchdown_y"])
        return {**row, "cpu_s": time.process_time() - begin}


class CompiledLanding(DiagramLanding):
    """The same landings, to the bit, fifty times as fast: `runs.compiled_landing`."""

    fly = staticmethod(fly_compiled)

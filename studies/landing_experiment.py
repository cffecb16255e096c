"""The experiment of most studies: one landing of a scenario with overrides."""

from typing import Any

import cv2

from diagrams.loading import ScenarioError, load_scenario, with_overrides
from runs.run import laboratory
from studies.study import Study, StudyError


class LandingExperiment:
    """Flies `MultirotorLanding` scenarios; see `studies.executors.Experiment`."""

    def prepare(self, study: Study) -> None:
        """Load the study's scenario; one thread, as campaigns use a process a core."""
        cv2.setNumThreads(1)
        try:
            self._scenario = load_scenario(study.scenario)
        except ScenarioError as error:
            raise StudyError(str(error)) from None

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        """Fly once.

        Parameters
        ----------
        overrides : dict
            Dotted field paths of the scenario and their values.
        seed : int
            Of all noise of the run.

        Returns
        -------
        dict
            `landed`, `reason`, `landing_error_m`, `landing_x_m`, `landing_y_m`,
            `landing_time_s`, `touchdown_speed_m_s`, `attempts`, `simulated_s`, `cpu_s`.
        """
        try:
            scenario = with_overrides(self._scenario, {**overrides, "seed": seed})
        except ScenarioError as error:
            raise StudyError(str(error)) from None
        result = laboratory(scenario).fly()
        x, y = result.landing_offset_m
        return {
            "landed": result.landed,
            "reason": result.reason,
            "landing_error_m": result.landing_error_m,
            "landing_x_m": x,
            "landing_y_m": y,
            "landing_time_s": result.landing_time_s,
            "touchdown_speed_m_s": result.touchdown_speed_m_s,
            "attempts": result.attempts,
            "simulated_s": result.simulated_s,
            "cpu_s": result.cpu_s,
        }

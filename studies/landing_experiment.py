"""The experiment of most studies: one landing of a scenario with overrides."""

from math import nan
from typing import Any

import cv2

from diagrams.loading import ScenarioError, load_scenario, with_overrides
from runs.run import laboratory
from studies.study import Study, StudyError
from systems.signals.measurement import SUPERVISOR_STATUS


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
            `landing_started_s` (of the landing routine), from there `landing_time_s` (to the first
            contact) and `time_to_disarm_s` (to the stopped rotors), `touchdown_speed_m_s`,
            `attempts`, `simulated_s`, `cpu_s`.
        """
        try:
            scenario = with_overrides(self._scenario, {**overrides, "seed": seed})
        except ScenarioError as error:
            raise StudyError(str(error)) from None
        lab = laboratory(scenario)
        simulator = lab.start()
        result = lab.fly(simulator)
        context = simulator.get_context()
        status = SUPERVISOR_STATUS(lab.landing.evaluate("supervisor", context))
        disarmed = context.get_time() - status.time_in_state if status.landed_detected else nan
        x, y = result.landing_offset_m
        return {
            "landed": result.landed,
            "reason": result.reason,
            "landing_error_m": result.landing_error_m,
            "landing_x_m": x,
            "landing_y_m": y,
            "landing_started_s": float(status.landing_started),
            "landing_time_s": result.landing_time_s,
            "time_to_disarm_s": disarmed - status.landing_started,
            "touchdown_speed_m_s": result.touchdown_speed_m_s,
            "attempts": result.attempts,
            "simulated_s": result.simulated_s,
            "cpu_s": result.cpu_s,
        }

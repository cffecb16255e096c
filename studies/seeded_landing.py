"""The experiment of searches: a landing whose seed is chosen like everything else."""

from typing import Any

from diagrams.loading import ScenarioError, with_overrides
from plants.touchdown import REASONS
from plants.touchdown_judge import NEVER_TOOK_OFF
from runs.run import laboratory
from studies.landing_experiment import LandingExperiment
from studies.study import StudyError
from systems.signals.measurement import SUPERVISOR_STATUS

SEED = "seed"  # the override that is the seed of all noise


class SeededLanding(LandingExperiment):
    """Flies `MultirotorLanding` scenarios; the override `seed` counts, not the study's own."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        """Fly once.

        Parameters
        ----------
        overrides : dict
            Dotted field paths of the scenario and their values, with `seed`.
        seed : int
            Not used.

        Returns
        -------
        dict
            `landed`, `reason`, `took_off`, `landing_error_m`, `landing_x_m`, `landing_y_m`,
            `landing_time_s` (to the first contact), `landing_started_s`, `touchdown_speed_m_s`,
            `attempts`, `simulated_s`, `cpu_s`.
        """
        try:
            lab = laboratory(with_overrides(self._scenario, overrides))
        except ScenarioError as error:
            raise StudyError(str(error)) from None
        simulator = lab.start()
        result = lab.fly(simulator)
        status = SUPERVISOR_STATUS(lab.landing.evaluate("supervisor", simulator.get_context()))
        x, y = result.landing_offset_m
        return {
            "landed": result.landed,
            "reason": result.reason,
            "took_off": result.reason != REASONS[NEVER_TOOK_OFF],
            "landing_error_m": result.landing_error_m,
            "landing_x_m": x,
            "landing_y_m": y,
            "landing_time_s": result.landing_time_s,
            "landing_started_s": float(status.landing_started),
            "touchdown_speed_m_s": result.touchdown_speed_m_s,
            "attempts": result.attempts,
            "simulated_s": result.simulated_s,
            "cpu_s": result.cpu_s,
        }

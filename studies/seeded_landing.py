"""The experiment of searches: a landing whose seed is chosen like everything else."""

from typing import Any

from plants.touchdown import REASONS
from plants.touchdown_judge import NEVER_TOOK_OFF
from studies.landing_experiment import LandingExperiment

SEED = "seed"  # the override that is the seed of all noise


class SeededLanding(LandingExperiment):
    """`LandingExperiment` with one column more, `took_off`; the override `seed` counts."""

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
            The columns of `LandingExperiment`, and `took_off`.
        """
        row = super().run(overrides, overrides[SEED])
        return {**row, "took_off": row["reason"] != REASONS[NEVER_TOOK_OFF]}

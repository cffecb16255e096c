"""Flies or resumes a toy campaign in a process of its own, for tests that kill it.

python driver.py FOLDER WORKERS RUNS
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from studies.campaign import run_study
from studies.sampling import Uniform
from studies.study import Study, Variant


def slow_study() -> Study:
    """A few seconds of work for two workers, with some failures."""
    return Study(
        name="toy",
        scenario="toy",
        experiment="tests.studies.toy:Toy",
        overrides={"toy.seconds": 0.01, "toy.failures": 0.02},
        variants={"narrow": Variant(), "wide": Variant(overrides={"toy.spread": 0.3})},
        distributions={"toy.wind": Uniform(low=0.0, high=4.0)},
    )


if __name__ == "__main__":
    folder, workers, runs = sys.argv[1:]
    result = run_study(slow_study(), folder, runs=int(runs), workers=int(workers), progress=False)
    print("complete" if result.complete else "partial", result.done)

"""Cases that `plumbline falsify` found, flown again and again.

`spoiled/` holds cases that still spoil their landing, `mended/` those that did once. A change that
mends a case moves its file, by hand, so that it stays mended; a flight more or less in another seed
does not count: a case is spoiled if any of a few seeds from its own on is.
"""

from pathlib import Path

import pytest

from diagrams.loading import load_scenario, with_overrides
from runs.run import laboratory
from studies.disturbances import Space
from studies.falsification import MISS

HERE = Path(__file__).parent
CASES = sorted((HERE / "spoiled").glob("*.yaml")) + sorted((HERE / "mended").glob("*.yaml"))
WINDS = ("wind", "gust")  # disturbances
TRIES = 5  # seeds; one that spoils is enough, and usually it is the first


def misses(path: Path) -> list[str]:
    """What came of the flights until one was spoiled; empty if none was."""
    case = load_scenario(path)
    for seed in range(case.seed, case.seed + TRIES):
        result = laboratory(with_overrides(case, {"seed": seed})).fly()
        if not result.landed or result.landing_error_m > MISS:
            return [f"seed {seed}: {'; '.join(result.sentences())}"]
    return []


def name_of(path: Path) -> str:
    return path.stem


@pytest.mark.parametrize("path", CASES, ids=name_of)
def test_a_case_is_what_its_folder_says(path):
    missed = misses(path)
    if path.parent.name == "spoiled":
        assert missed, f"{path.name} is mended: move it to mended/, so that it stays so"
    else:
        assert missed == [], f"{path.name} was mended, and is spoiled again"


@pytest.mark.parametrize("path", CASES, ids=name_of)
def test_every_case_lies_inside_the_vehicles_wind_limit(path):
    case = load_scenario(path)
    wind, gust = (Space(load_scenario(base_of(path)), [name]).variables[0] for name in WINDS)
    assert case.wind.speed <= wind.high
    gusts = [sum(v * v for v in entry.velocity) ** 0.5 for entry in case.wind.gusts]
    assert max(gusts, default=0.0) <= gust.high + 1e-3


def base_of(path: Path) -> str:
    """The scenario that a case extends."""
    (line,) = [line for line in path.read_text().splitlines() if line.startswith("extends: ")]
    return line.removeprefix("extends: ")


def test_there_are_cases():
    assert CASES

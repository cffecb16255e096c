import dataclasses
import itertools
import re

import numpy as np
import pytest
from scipy import stats

from studies.published import INCONSISTENCIES, PUBLISHED, SIGNIFICANCE, compare, holm
from tests.shared_data import shared

TABLES = [PUBLISHED[f"infrared-and-marker/{table}"] for table in range(6, 18)]
# What Tables 3 to 5 state of each table of trials: mean and largest error (cm), mean time (s).
STATED = {
    "Table 6": (67.15, 180.00, None),
    "Table 7": (5.79, 13.86, None),
    "Table 8": (21.86, 70.00, None),
    "Table 9": (47.10, 66.30, None),
    "Table 10": (8.51, 11.60, None),
    "Table 11": (11.05, 16.50, None),
    "Table 12": (39.32, 62.90, 17.43),
    "Table 13": (13.62, 24.60, None),
    "Table 14": (14.66, 20.60, None),
    "Table 15": (13.74, 20.40, None),
    "Table 16": (29.40, 46.10, None),
    "Table 17": (14.37, 24.10, 41.46),
}


@pytest.mark.parametrize("row", TABLES, ids=lambda row: row.table)
def test_trials_average_to_what_tables_3_to_5_state(row):
    assert len(row.error) == len(row.x) == len(row.y) == len(row.time) == 10
    # Table 3 cuts the 5.795 cm of Table 7 off to 5.79 instead of rounding.
    mean, largest, time = STATED[row.table]
    assert 100 * row.error.mean() == pytest.approx(mean, abs=0.006)
    assert 100 * row.error.max() == pytest.approx(largest, abs=0.005)
    if time is not None:
        assert row.time.mean() == pytest.approx(time, abs=0.005)


def test_x_and_y_give_the_error_but_for_one_trial():
    wrong = [
        (row.table, trial + 1)
        for row in TABLES
        for trial in np.flatnonzero(np.abs(np.hypot(row.x, row.y) - row.error) > 0.06e-2)
    ]
    assert wrong == [("Table 6", 1)]


def test_the_trials_are_those_of_the_thesis():
    """Every line of the CSV stands in the thesis, in the table it is said to."""
    text = shared("papers/infrared-and-marker-precision-landing.txt").read_text(encoding="utf-8")
    appendices = text[text.index("\nAppendices\n") :]
    number = r"(-?[\d.]+)"
    line = re.compile(rf"^\d+\t{number}\t{number}, {number}\t{number}$|^Table (\d+):", re.MULTILINE)
    tables: dict[str, np.ndarray] = {}
    trials: list[list[float]] = []
    for match in line.finditer(appendices):
        *values, table = match.groups()
        if table:
            tables[f"Table {table}"], trials = np.array(trials), []
        else:
            trials.append([float(value) for value in values])
    assert list(tables) == [row.table for row in TABLES]
    for row in TABLES:
        ours = np.column_stack([100 * row.error, 100 * row.x, 100 * row.y, row.time])
        np.testing.assert_allclose(ours, tables[row.table], rtol=1e-12)


def test_the_inconsistencies_are_there():
    """What `INCONSISTENCIES` says in words, in numbers."""
    text = shared("papers/infrared-and-marker-precision-landing.txt").read_text(encoding="utf-8")
    ten, thirteen = PUBLISHED["infrared-and-marker/10"], PUBLISHED["infrared-and-marker/13"]
    assert "on average 6.79 and 8.51 cm" in text
    assert ten.error.mean() == pytest.approx(0.0851)
    assert "21.86 cm and 11.50 cm" in text
    assert "with a worst case of 20-21 cm" in text
    np.testing.assert_allclose(np.sort(thirteen.error)[-2:], [0.241, 0.246])
    assert "Default\t39.32\t62.90\t17.43" in text
    assert "6m\tAbove 3m\tBelow 3m\t13.74" in text
    assert "in the IRLock and Fusion mode, the take-off altitude is set to 10 meters" in text
    assert len(INCONSISTENCIES) == 6


def test_holm_is_the_smallest_family_wise_adjustment_of_its_kind():
    # Wikipedia's worked example of the procedure: H1 and H4 fall at 5 %, the others stand.
    adjusted = holm([0.01, 0.04, 0.03, 0.005])
    assert adjusted == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_a_hypothesis_falls_by_holm_exactly_when_stepping_down_rejects_it():
    rng = np.random.default_rng(3)
    for count, level in itertools.product((1, 4, 26), (0.01, 0.2)):
        p = rng.uniform(size=count) ** 4
        rejected = np.zeros(count, bool)
        for step, index in enumerate(np.argsort(p)):
            if p[index] > level / (count - step):
                break
            rejected[index] = True
        assert ((np.asarray(holm(list(p))) <= level) == rejected).all()


def test_the_same_distribution_agrees_and_is_wrongly_refused_as_often_as_stated():
    rng = np.random.default_rng(5)
    row = PUBLISHED["infrared-and-marker/10"]
    refused = 0
    for _ in range(400):
        ours, theirs = rng.rayleigh(0.08, 300), rng.rayleigh(0.08, 10)
        comparison = compare("x", "error", ours, _with_error(row, theirs))
        assert comparison is not None
        refused += comparison.p < 0.05
    assert stats.binomtest(refused, 400, 0.05).pvalue > 0.01


@pytest.mark.parametrize(
    ("ours", "quantity", "verdict"),
    [
        (lambda rng: rng.normal(0.085, 0.023, 500), "error", r"agrees: mean 8.\d cm against 8.5"),
        (lambda rng: rng.normal(0.30, 0.05, 500), "error", r"differs: 21.\d cm more, mean 2?3?"),
        (lambda rng: rng.normal(0.01, 0.002, 500), "error", r"differs: 7.\d cm less, mean 1.0 cm"),
        (lambda rng: rng.normal(25.0, 1.8, 500), "time", r"agrees: mean 2\d.\d s against 25.0"),
        (
            lambda rng: 25.0 + 60.0 * rng.choice([-1, 1], 500) * rng.uniform(0.5, 1, 500),
            "time",
            r"differs in shape: mean",
        ),
    ],
)
def test_a_verdict_says_how_much(ours, quantity, verdict):
    row = PUBLISHED["infrared-and-marker/10"]
    comparison = compare("Marker", quantity, ours(np.random.default_rng(1)), row)
    assert comparison is not None
    comparison = dataclasses.replace(comparison, p_adjusted=holm([comparison.p])[0])
    assert re.match(verdict, comparison.verdict), comparison.verdict
    assert comparison.agrees == (comparison.p_adjusted >= SIGNIFICANCE)
    assert comparison.low < comparison.difference < comparison.high


def test_too_few_landings_are_not_compared():
    row = PUBLISHED["infrared-and-marker/10"]
    assert compare("Marker", "error", [0.1, np.nan], row) is None


def _with_error(row, error):
    return dataclasses.replace(row, error=error)

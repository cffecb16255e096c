"""Which disturbances matter, on a landing whose answer is known."""

import numpy as np
import pandas as pd
import pytest

from studies.sensitivity import CHANCE, Sensitivity, analyse
from studies.study import StudyError

TOY = "tests.studies.toy_landing:ToyLanding"
VARY = ("wind", "latency", "drops")


def analysis(folder, method="morris", runs=300, vary=VARY) -> Sensitivity:
    options = {"workers": 0, "progress": False, "experiment": TOY}
    return analyse("infrared-and-marker", folder, vary, runs, method, **options)


def index_of(made, output, column):
    return made.ranked(output).set_index("parameter")[column]


def without_drops(folder, method, runs):
    """No landing is lost, which would make the error jump."""
    return analysis(folder, method, runs, vary=("wind", "latency", "turbulence"))


def test_morris_finds_the_slopes(tmp_path):
    made = without_drops(tmp_path, "morris", 600)
    effect = index_of(made, "error", "mu_star")
    # d error / d wind over its range: (2 w + latency) 6.67/7 with luck of 1.05 in the mean
    w = (0.5 + np.array([0.0, 1.0, 2.0, 3.0]) / 3.0 * 6.67) / 7.0
    mean = 1.05 * 6.67 / 7.0 * (w[[0, 1, 2, 3]].mean() * 2.0 + 0.5)
    assert effect["wind"] == pytest.approx(mean, rel=0.1)
    assert effect["latency"] == pytest.approx(1.05 * w.mean(), rel=0.15)
    assert effect["wind direction"] == effect["turbulence"] == 0.0
    assert 0.0 < effect[CHANCE] < 0.2
    assert list(made.ranked("error")["parameter"][:2]) == ["wind", "latency"]


def test_sobol_shares_out_the_variance(tmp_path):
    made = without_drops(tmp_path, "sobol", 800)
    total, alone = index_of(made, "error", "ST"), index_of(made, "error", "S1")
    # By brute force, without luck.
    rng = np.random.default_rng(1)
    w, latency = (0.5 + 6.67 * rng.random(200_000)) / 7.0, rng.random(200_000)
    error = 0.1 + w**2 + w * latency
    by_latency = np.var(0.1 + np.mean(w**2) + np.mean(w) * latency) / np.var(error)
    intervals = made.table.set_index(["output", "parameter"])[["S1_conf", "ST_conf"]]
    bound = 1.5 * intervals  # a normal deviate lies within 99.7 % of the time
    assert abs(alone["latency"] - by_latency) < bound.S1_conf["error", "latency"]
    assert abs(total["wind"] - (1.0 - by_latency)) < bound.ST_conf["error", "wind"]
    assert bound.ST_conf["error", "wind"] < 0.5
    assert abs(total["turbulence"]) < 1e-9


def test_an_output_that_nothing_changes_has_no_indices(tmp_path):
    made = without_drops(tmp_path, "morris", 60)
    assert (index_of(made, "time", "mu_star") == 0.0).all()


def test_a_landing_that_is_lost_counts_as_far_off(tmp_path):
    made = analysis(tmp_path)
    lost = made.flights[~made.flights["landed"]]
    assert len(lost) > 0
    assert (lost["drops"] > 0.8).all()
    assert (lost["error"] == 3.0).all()
    assert (lost["time"] == 30.0).all()  # from the routine's start at 30 s to the end at 60 s


def test_it_writes_tables_and_a_bar_chart(tmp_path):
    made = analysis(tmp_path, runs=60)
    table = pd.read_csv(tmp_path / "sensitivity.csv")
    assert len(table) == 2 * (len(made.space.variables) + 1)
    assert len(pd.read_csv(tmp_path / "runs.csv")) == len(made.flights) <= 60
    for name in ("report.md", "report.html"):
        assert made.sentences()[0] in (tmp_path / name).read_text()
    assert "<svg" in (tmp_path / "sensitivity.svg").read_text()


def test_asked_again_it_flies_nothing_and_says_the_same(tmp_path):
    first = analysis(tmp_path, runs=60)
    flown = (tmp_path / "flights.jsonl").read_bytes()
    again = analysis(tmp_path, runs=60)
    assert (tmp_path / "flights.jsonl").read_bytes() == flown
    pd.testing.assert_frame_equal(first.table, again.table)


@pytest.mark.parametrize("method", ["morris", "sobol"])
def test_too_few_runs_are_refused(method, tmp_path):
    with pytest.raises(StudyError, match=f"{method} with 5 parameters needs"):
        analysis(tmp_path, method, 10)

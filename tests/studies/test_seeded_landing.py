"""The experiment that searches fly, on a real landing."""

import pytest

from diagrams.loading import load_scenario
from runs.run import laboratory
from studies.seeded_landing import SeededLanding
from studies.study import Study, StudyError


@pytest.fixture(scope="module")
def experiment():
    made = SeededLanding()
    made.prepare(Study(name="search", scenario="plumbline-landing"))
    return made


def test_the_seed_among_the_overrides_counts(experiment):
    overrides = {"fidelity": "geometric", "wind.speed": 2.0, "seed": 7}
    row = experiment.run(overrides, seed=123)
    result = laboratory(load_scenario("plumbline-landing", overrides)).fly()
    assert row["landed"] is True
    assert row["landing_error_m"] == result.landing_error_m
    assert row["touchdown_speed_m_s"] == result.touchdown_speed_m_s
    assert 10.0 < row["landing_started_s"] < row["simulated_s"] - row["landing_time_s"]


def test_what_a_scenario_refuses_ends_the_search(experiment):
    with pytest.raises(StudyError, match=r"wind\.speed"):
        experiment.run({"wind.speed": -1.0, "seed": 1}, seed=0)

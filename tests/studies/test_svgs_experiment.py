"""The SVGS studies: their baseline is the baseline's scenario, and landing on an LED is noticed."""

import math

import numpy as np
import pytest

from diagrams.loading import load_scenario, to_plain, with_overrides
from studies.study import load_study, study_names
from studies.svgs_experiment import SvgsExperiment, clearance, reach

BASELINE = {
    "infrared-1": "infrared-high-altitude",
    "infrared-2": "infrared-flight-2",
    "infrared-3": "infrared-flight-3",
}
FLIGHTS = {"svgs-1": "svgs-high-altitude", "svgs-2": "svgs-flight-2", "svgs-3": "svgs-flight-3"}
NAMES = ("name", "description", "seed", "time_limit", "navigation")


@pytest.mark.parametrize(("variant", "name"), [*FLIGHTS.items(), *BASELINE.items()])
def test_flights_are_those_of_the_scenarios(variant: str, name: str):
    study = load_study("svgs-flights")
    flown = with_overrides(load_scenario(study.scenario), study.variants[variant].overrides)
    scenario = load_scenario(name)
    np.testing.assert_array_equal(
        flown.navigation.parameter_array(), scenario.navigation.parameter_array()
    )
    left, right = to_plain(flown), to_plain(scenario)
    for field in NAMES:
        left.pop(field), right.pop(field)
    assert left == right


def test_winds_are_within_table_2():
    knot = 1852.0 / 3600.0
    for name in study_names():
        study = load_study(name)
        if name.startswith("svgs-") and "wind.speed" in study.distributions:
            assert study.distributions["wind.speed"].quantile(1.0 - 1e-9) <= 10.0 * knot


def test_clearance():
    scenario = load_scenario("svgs-high-altitude")
    free = clearance(scenario, np.zeros(2))
    # The nearest LED of the short-range beacon is 1.7 - 0.315 m away.
    assert free == pytest.approx(1.385 - reach(scenario.vehicle.resolved_vehicle()))
    assert clearance(scenario, np.array([-1.7, 0.0])) < 0.0
    turned = with_overrides(scenario, {"pad.yaw": math.pi / 2})
    assert clearance(turned, np.array([0.0, -1.7])) < 0.0
    assert math.isnan(clearance(load_scenario("infrared-high-altitude"), np.zeros(2)))


def test_experiment_gives_what_the_studies_measure():
    study = load_study("svgs-high-altitude")
    experiment = SvgsExperiment()
    experiment.prepare(study)
    row = experiment.run({"time_limit": 0.5, "fidelity": "geometric"}, seed=3)
    assert set(study.measures.columns()) <= set(row)
    assert not row["landed"]

"""Studies as data: every case builds a scenario and meets published rows of its tables."""

import math

import numpy as np
import pytest

from studies.landing_without_gps import (
    STUDIES,
    calibrated_accuracy,
    equivalent_angular_error,
    scenario_with,
)
from studies.published_landing_without_gps import POSITION_TOLERANCE, PUBLISHED, published
from systems.estimators.runway_error_filter import RunwayErrorFilterConfig

CASES = [(study, case) for study in STUDIES.values() for case in study.cases]


@pytest.mark.parametrize(("study", "case"), CASES, ids=lambda x: getattr(x, "name", x))
def test_every_case_is_a_scenario(study, case):
    scenario = study.scenario(case)
    assert scenario.name == f"{study.name}_{case}"
    assert study.reference in study.cases


def test_every_published_row_belongs_to_a_case_of_a_study():
    for row in PUBLISHED:
        studies = [study for study in STUDIES.values() if row.table in study.tables]
        assert any(row.case in study.cases for study in studies), row


def test_every_table_of_chapter_6_is_there():
    assert {row.table for row in PUBLISHED} == {*range(4, 21), *range(22, 30)}
    assert published(22, statistic="valid")[2].value == 0.78
    assert published(9, "cliff", "mean")[0].value == -3.39
    assert all(0.0 <= row.value <= 1.0 for row in PUBLISHED if row.statistic == "valid")


def test_changes_of_latency_are_those_printed_beside_the_percentages():
    """Table 24 prints its changes; 61 % against 71 % is −10."""
    reference = {r.distance: r.value for r in published(24, "closed_camera_0ms")}
    slow = {r.distance: r.value for r in published(24, "closed_camera_500ms")}
    changes = [round(100 * (slow[d] - reference[d])) for d in (300.0, 150.0, 100.0)]
    assert changes == [-10, -13, -12]


def test_studies_vary_what_they_say():
    camera = STUDIES["harmonisation_yaw"].scenario("yaw_0.9").camera
    assert camera.harmonisation_yaw_spread == 0.9
    assert camera.harmonisation_pitch_spread == 0.0
    assert STUDIES["terrain"].scenario("cliff").terrain.kind == "cliff"
    tuning = STUDIES["terrain"].scenario("cliff").filter
    assert isinstance(tuning, RunwayErrorFilterConfig)
    assert tuning.tuning == "theoretical"
    assert STUDIES["vision_latency_open"].scenario("open_vision_200ms").tracker.delay == 0.2
    assert STUDIES["fly_back"].scenario("error_filter").gps.loss_time == 30.0


def test_an_unknown_field_is_refused():
    with pytest.raises(ValueError, match="noize"):
        scenario_with({"laser.noize": 1.0}, "x")


def test_calibration_is_the_quantile_that_the_thesis_names():
    errors = np.random.default_rng(0).normal(size=20_000)
    assert calibrated_accuracy(errors, 0.6827) == pytest.approx(1.0, rel=0.03)


def test_position_harmonisation_of_figures_37_to_39():
    assert equivalent_angular_error(POSITION_TOLERANCE, 100.0) == pytest.approx(0.1, rel=0.02)
    errors = [equivalent_angular_error(POSITION_TOLERANCE, d) for d in (100.0, 500.0, 3000.0)]
    assert errors[0] > 4.9 * errors[1] > 20.0 * errors[2]
    small = equivalent_angular_error(0.01, 100.0)
    assert math.radians(small) == pytest.approx(0.01 * 1.099 / 100.0, rel=0.01)

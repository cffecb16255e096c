"""Studies and published rows: every row has its variant, and is held against it."""

import math

import numpy as np
import pandas as pd
import pytest

from diagrams.landing_without_gps import LandingWithoutGpsScenario
from diagrams.loading import load_scenario, with_overrides
from studies.landing_without_gps import (
    PREFIX,
    STUDY_OF_TABLE,
    agreement,
    calibrate,
    calibrated_accuracy,
    equivalent_angular_error,
    markdown,
    predict,
    read_campaigns,
    variant_of,
)
from studies.landing_without_gps_experiment import CompiledLanding
from studies.published_landing_without_gps import POSITION_TOLERANCE, PUBLISHED, published
from studies.study import StudyError, load_study, study_names
from systems.estimators.runway_error_filter import RunwayErrorFilterConfig

STUDIES = {name: load_study(name) for name in study_names() if name.startswith(PREFIX)}
CASES = [(name, variant) for name, study in STUDIES.items() for variant in study.variants]


def scenario_of(name: str, variant: str) -> LandingWithoutGpsScenario:
    study = STUDIES[name]
    overrides = study.overrides | study.variants[variant].overrides
    scenario = with_overrides(load_scenario(study.scenario), overrides)
    assert isinstance(scenario, LandingWithoutGpsScenario)
    return scenario


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_every_variant_is_a_scenario(name, variant):
    scenario_of(name, variant)


def test_every_published_row_belongs_to_a_variant_of_a_study():
    for row in PUBLISHED:
        assert variant_of(row) in STUDIES[PREFIX + STUDY_OF_TABLE[row.table]].variants, row


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
    camera = scenario_of(f"{PREFIX}harmonisation", "yaw_0.9").camera
    assert camera.harmonisation_yaw_spread == 0.9
    assert camera.harmonisation_pitch_spread == 0.0
    cliff = scenario_of(f"{PREFIX}terrain", "cliff")
    assert cliff.terrain.kind == "cliff"
    assert isinstance(cliff.filter, RunwayErrorFilterConfig)
    assert cliff.filter.tuning == "theoretical"
    late = scenario_of(f"{PREFIX}latency-open", "open_vision_200ms")
    assert late.tracker.delay == 0.2
    assert scenario_of(f"{PREFIX}fly-back", "error_filter").gps.loss_time == 30.0


def test_the_experiment_flies_a_run_and_refuses_another_vehicle():
    study = STUDIES[f"{PREFIX}harmonisation"]
    experiment = CompiledLanding()
    experiment.prepare(study)
    spec = study.run_spec(0)
    row = experiment.run(spec.overrides, spec.seed)
    assert row["landed"]
    assert set(study.measures.columns()) <= set(row)
    assert abs(row["lateral_100"]) < 20.0
    study.scenario = "infrared-and-marker"
    with pytest.raises(StudyError, match="landing_without_gps"):
        experiment.prepare(study)
    study.scenario = "landing-without-gps-final"


def campaign(study: str, runs: int, scale: float = 1.0) -> pd.DataFrame:
    """A made-up campaign: errors are normal with a deviation of 10 m along and 2 m across."""
    rng = np.random.default_rng(1)
    rows = []
    for variant in STUDIES[PREFIX + study].variants:
        errors = scale * rng.normal(size=(runs, 6)) * np.array([10.0] * 3 + [2.0] * 3)
        names = [f"{axis}_{d}" for axis in ("longitudinal", "lateral") for d in (300, 150, 100)]
        rows.append(pd.DataFrame(errors, columns=names).assign(variant=variant))
    return pd.concat(rows)


def test_campaigns_are_held_against_the_tables(tmp_path):
    for name in ("terrain", "latency-closed"):
        (tmp_path / f"{PREFIX}{name}").mkdir()
        campaign(name, 10_000).to_parquet(tmp_path / f"{PREFIX}{name}" / "runs.parquet")
    campaigns = read_campaigns(tmp_path)
    assert set(campaigns) == {"terrain", "latency-closed"}
    accuracy = calibrate(campaigns)
    # 47 % of a normal distribution lie within 0.63 sigma, 78 % within 1.23, 84 % within 1.41
    assert accuracy.long_open == pytest.approx(6.28, rel=0.05)
    assert accuracy.long_closed == pytest.approx(12.27, rel=0.05)
    assert accuracy.lat == pytest.approx(2.81, rel=0.05)
    predictions = predict(campaigns, accuracy)
    reference = {
        p.row.distance: p for p in predictions if (p.row.table, p.row.statistic) == (4, "valid")
    }
    assert reference[100.0].value == pytest.approx(0.47, abs=0.001)
    assert reference[100.0].agrees
    assert not reference[300.0].agrees  # 63 % published
    good, of = agreement(predictions)
    assert 0 < good < of == sum(p.row.statistic == "valid" for p in predictions)
    page = markdown(predictions, accuracy)
    assert "| no laser | **4" in page  # 47 % of ours against 63 %
    assert f"{good} of {of} percentages" in page


def test_a_landing_that_did_not_get_there_is_invalid():
    table = campaign("latency-closed", 100)
    table.loc[table["variant"].eq("closed_camera_500ms"), "longitudinal_300"] = math.nan
    campaigns = {"latency-closed": table, "terrain": campaign("terrain", 100)}
    predictions = predict(campaigns, calibrate(campaigns))
    (lost,) = (
        p
        for p in predictions
        if (p.row.table, p.row.case, p.row.distance) == (24, "closed_camera_500ms", 300.0)
    )
    assert lost.value == 0.0


def test_calibration_is_the_quantile_that_the_thesis_names():
    errors = np.random.default_rng(0).normal(size=20_000)
    assert calibrated_accuracy(errors, 0.6827) == pytest.approx(1.0, rel=0.03)


def test_position_harmonisation_of_figures_37_to_39():
    assert equivalent_angular_error(POSITION_TOLERANCE, 100.0) == pytest.approx(0.1, rel=0.02)
    errors = [equivalent_angular_error(POSITION_TOLERANCE, d) for d in (100.0, 500.0, 3000.0)]
    assert errors[0] > 4.9 * errors[1] > 20.0 * errors[2]
    small = equivalent_angular_error(0.01, 100.0)
    assert math.radians(small) == pytest.approx(0.01 * 1.099 / 100.0, rel=0.01)

"""The registry of disturbances, and the cube of cases."""

import math

import numpy as np
import pytest

from diagrams.loading import load_scenario, to_plain, with_overrides
from studies.disturbances import DISTURBANCES, Space, Window
from studies.study import StudyError

SCENARIOS = [
    "infrared-and-marker",
    "infrared-landing",
    "px4-precision-landing",
    "svgs-high-altitude",
    "plumbline-landing",
]


def space_of(names, scenario="infrared-and-marker", limits=None):
    made = Space(load_scenario(scenario), names, limits)
    made.window = Window(30.0, 50.0)
    return made


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_disturbance_at_its_limit_is_a_valid_scenario(scenario):
    loaded = load_scenario(scenario)
    names = [name for name, entry in DISTURBANCES.items() if not entry.lacks(loaded)]
    space = space_of(names, scenario)
    for index in [*space.strengths, None]:
        point = space.undisturbed()
        point[space.strengths if index is None else index] = 1.0
        disturbed = with_overrides(loaded, space.overrides(point))
        assert to_plain(disturbed) != to_plain(loaded)


def test_nothing_is_changed_by_no_disturbance():
    space = space_of(list(DISTURBANCES))
    assert space.overrides(space.undisturbed()) == {}
    assert space.severity(space.undisturbed()) == 0.0
    assert space.describe(space.undisturbed()) == "undisturbed"


def test_the_scale_goes_from_the_scenario_to_the_limit():
    space = space_of(["wind"], limits={"wind": 8.5})
    for strength, speed in ((0.5, 4.5), (1.0, 8.5), (1.7, 8.5)):
        assert space.overrides(np.array([strength, 0.5]))["wind.speed"] == speed
    assert space.severity(np.array([0.5, 0.9])) == 0.5


def test_severity_is_the_norm_of_the_strengths_alone():
    space = space_of(["wind", "dropout", "latency"])
    assert [v.name for v in space.variables] == [
        "wind", "wind direction", "dropout", "dropout time", "latency",
    ]  # fmt: skip
    assert space.severity(np.array([0.3, 1.0, 0.4, 1.0, 0.0])) == pytest.approx(0.5)


def test_directions_go_round():
    space = space_of(["wind"])
    east = space.overrides(np.array([1.0, 0.5]))["wind.direction"]
    assert east == 0.0
    for turns in (-1.0, 2.0):
        assert space.overrides(np.array([1.0, 0.5 + turns]))["wind.direction"] == east


def test_faults_come_after_those_of_the_scenario():
    space = space_of(["drops", "dropout", "blind"], "cautious-landing")
    faults = space.overrides(np.array([0.5, 0.5, 0.25, 1.0]))["sensors.marker_camera.faults.faults"]
    assert [fault["kind"] for fault in faults] == ["below", "random", "permanent", "below"]
    assert faults[2]["start_time"] == 35.0  # a quarter into the landing from 30 to 50 s
    assert faults[2]["end_time"] == 40.0


def test_latency_adds_to_the_scenarios_own():
    scenario = load_scenario(
        "infrared-and-marker", {"sensors.infrared_camera.latency.transport": 0.01}
    )
    space = Space(scenario, ["latency", "jitter"])
    overrides = space.overrides(np.array([0.4, 1.0]))
    assert overrides["sensors.infrared_camera.latency.transport"] == pytest.approx(0.11)
    assert overrides["sensors.marker_camera.latency.transport"] == pytest.approx(0.1)
    disturbed = with_overrides(scenario, overrides)
    assert disturbed.sensors.infrared_camera.latency.latency.longest == pytest.approx(0.15)


def test_svgs_latency_stays_uniform():
    space = space_of(["jitter"], "svgs-high-altitude")
    own = space.scenario.sensors.svgs_camera.latency.latency
    (model,) = [v for k, v in space.overrides(np.array([1.0])).items() if k.endswith("latency")]
    assert model["kind"] == own.kind == "uniform"
    assert model["shortest"] == own.shortest
    assert model["longest"] == pytest.approx(own.longest + 0.15)


def test_the_svgs_vehicle_has_its_papers_limits():
    space = space_of(["wind", "gust"], "svgs-high-altitude")
    strengths = [space.variables[index] for index in space.strengths]
    assert strengths[0].high == pytest.approx(10 * 1852 / 3600, abs=0.01)
    assert strengths[0].high + strengths[1].high == pytest.approx(12 * 1852 / 3600, abs=0.01)


def test_a_gust_blows_where_and_when_it_is_told():
    space = space_of(["gust"])
    overrides = space.overrides(np.array([1.0, 0.75, 0.5]))
    (gust,) = overrides["wind.gusts"]
    assert gust["start"] + 0.5 * gust["duration"] == 40.0
    assert np.hypot(*gust["velocity"][:2]) == pytest.approx(0.5 * 7.17, abs=2e-3)
    assert math.atan2(*gust["velocity"][1::-1]) == pytest.approx(0.5 * math.pi, abs=1e-3)


@pytest.mark.parametrize(
    ("names", "scenario", "limits", "part"),
    [
        (["wnd"], "infrared-and-marker", {}, "nearest is wind"),
        ([], "infrared-and-marker", {}, "expected one or more of"),
        (["false-beacon"], "svgs-high-altitude", {}, "no infrared camera"),
        (["wind"], "infrared-and-marker", {"wind": 0.2}, "a limit above the scenario's 0.5 m/s"),
        (["wind"], "infrared-and-marker", {"drops": 0.2}, "--limit drops"),
        (["wind"], "landing-without-gps-final", {}, "multirotor_landing"),
    ],
)
def test_what_cannot_be_is_one_sentence(names, scenario, limits, part):
    with pytest.raises(StudyError, match=part):
        Space(load_scenario(scenario), names, limits)

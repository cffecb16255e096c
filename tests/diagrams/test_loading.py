"""Scenarios load, and wrong ones are refused in one sentence that names the place."""

import pytest

from diagrams.loading import (
    ScenarioError,
    load_scenario,
    scenario_names,
    to_plain,
    to_yaml,
    with_overrides,
)


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_loads_and_says_what_it_is(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.description


@pytest.mark.parametrize("name", scenario_names())
def test_yaml_round_trip(name, tmp_path):
    scenario = load_scenario(name)
    file = tmp_path / "again.yaml"
    file.write_text(to_yaml(scenario))
    assert load_scenario(file) == scenario


def test_overrides_reach_every_depth():
    scenario = load_scenario(
        "infrared-and-marker",
        [
            "wind.speed=5",
            "sensors.marker_camera.latency.processing=0.2",
            "sensors.marker_camera.faults.faults=[{kind: below, height: 2}]",
            "guidance.routine={kind: cautious}",
        ],
    )
    assert scenario.wind.speed == 5.0
    assert scenario.sensors.marker_camera.latency.processing == 0.2
    assert scenario.sensors.marker_camera.faults.faults[0].height == 2.0
    assert scenario.guidance.routine.kind == "cautious"


def test_with_overrides_leaves_the_original_alone():
    scenario = load_scenario("infrared-and-marker")
    changed = with_overrides(scenario, {"wind.speed": 7.0})
    assert changed.wind.speed == 7.0
    assert scenario.wind.speed != 7.0


def test_a_file_extends_another(tmp_path):
    file = tmp_path / "windy.yaml"
    file.write_text("extends: infrared-and-marker\nname: windy\nwind: {speed: 6}\n")
    scenario = load_scenario(file)
    base = load_scenario("infrared-and-marker")
    assert scenario.wind.speed == 6.0
    assert to_plain(scenario)["guidance"] == to_plain(base)["guidance"]


WRONG = {
    "wind: {speeed: 5}": ["line 1", "wind.speeed", "unknown field", "the nearest is speed"],
    "wind: {speed: fast}": ["wind.speed", "expected", "number", "'fast'"],
    "wind: {speed: -1}": ["wind.speed", "greater than or equal to 0", "-1"],
    "\n\nsensors:\n  gnss:\n    sensor: {kind: rtkk}": ["line 5", "kind", "'rtk'", "rtkk"],
    "guidance: {routine: {kind: cautios}}": ["guidance.routine", "cautios", "nearest is cautious"],
    "kind: helicopter": ["kind", "helicopter", "multirotor_landing"],
    "wind: [1, 2]": ["wind", "expected"],
    "wind: {speed: .nan}": ["wind.speed", "finite"],
    "seed: 1.5": ["seed", "integer"],
    "- a list": ["expected fields of a scenario"],
    "wind: {speed: 5": ["not YAML"],
    "extends: nowhere": ["nowhere", "no scenario of that name"],
    "sensors: {gnss: {latency: {drop: 1.5}}}": ["sensors.gnss.latency.drop", "less than or equal"],
    "sensors: {gnss: {latency: {latency: {kind: uniform, shortest: 2, longest: 1}}}}": [
        "sensors.gnss.latency.latency", "less than shortest",
    ],
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_wrong_files_are_refused_in_one_sentence(text, tmp_path):
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(ScenarioError) as error:
        load_scenario(file)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert str(file) in sentence or "nowhere" in sentence
    for part in WRONG[text]:
        assert part in sentence, sentence


@pytest.mark.parametrize(
    ("name", "overrides", "parts"),
    [
        ("infrared-and-markr", (), ["the nearest is infrared-and-marker"]),
        ("missing/file.yaml", (), ["there is no such file"]),
        ("infrared-and-marker", ["wind.speed"], ["expected FIELD.PATH=VALUE"]),
        ("infrared-and-marker", ["wind.speed=[1"], ["not a YAML value"]),
        ("infrared-and-marker", ["wind.sped=1"], ["wind.sped", "the nearest is speed"]),
        ("infrared-and-marker", ["wind.speed.x=1"], ["wind.speed"]),
        ("infrared-and-marker", ["wind.gusts.0.start=1"], ["wind.gusts"]),
    ],
)
def test_wrong_names_and_overrides(name, overrides, parts):
    with pytest.raises(ScenarioError) as error:
        load_scenario(name, overrides)
    sentence = str(error.value)
    assert "\n" not in sentence
    for part in parts:
        assert part in sentence, sentence


def test_a_binary_file_is_refused(tmp_path):
    file = tmp_path / "picture.yaml"
    file.write_bytes(bytes(range(256)))
    with pytest.raises(ScenarioError, match="UTF-8"):
        load_scenario(file)


def test_overrides_are_not_written_into():
    """A path below a map that is overridden as a whole must not change the caller's map."""
    wind = {"speed": 1.0}
    overrides = {"wind": wind, "wind.speed": 2.0}
    assert load_scenario("infrared-and-marker", overrides).wind.speed == 2.0
    assert wind == {"speed": 1.0}
    aircraft = {"kind": "recorded_flight", "altitude_error": 4.0}
    final = load_scenario("landing-without-gps-final")
    for _ in range(2):
        assert with_overrides(final, {"aircraft": aircraft}).aircraft.altitude_error == 4.0
        changed = with_overrides(final, {"aircraft": aircraft, "aircraft.altitude_error": 0.0})
        assert changed.aircraft.altitude_error == 0.0


def test_a_map_given_in_part_keeps_the_rest_of_its_fields_default():
    path = "sensors.infrared_camera.latency"
    whole = load_scenario("infrared-and-marker")
    assert whole.sensors.infrared_camera.latency.processing == 0.02
    for change in ({f"{path}.transport": 0.03}, {path: {"transport": 0.03}}):
        by_file = load_scenario("infrared-and-marker", change)
        assert by_file.sensors.infrared_camera.latency.transport == 0.03
        assert by_file.sensors.infrared_camera.latency.processing == 0.02
        assert with_overrides(whole, change) == by_file

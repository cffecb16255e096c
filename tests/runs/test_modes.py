"""The modes and faults of the thesis's Tables 3 to 5 fly."""

import pytest

from diagrams.loading import load_scenario
from runs.run import laboratory


def drop(camera, fault):
    fault = {"while_landing": True, **fault}
    return {f"sensors.{camera}_camera.faults": {"faults": [fault]}}


BELOW, ABOVE = {"kind": "below", "height": 3.0}, {"kind": "above", "height": 3.0}
CASES = {
    "normal": ("normal-landing", {}, 2.5),
    "infrared": ("infrared-landing", {}, 0.2),
    "infrared random": (
        "infrared-landing", drop("infrared", {"kind": "random", "probability": 0.75}), 0.3,
    ),
    "infrared below": ("infrared-landing", drop("infrared", BELOW), 1.0),
    "infrared permanent": ("infrared-landing", drop("infrared", {"kind": "permanent"}), 6.0),
    "marker": ("marker-landing", {}, 0.2),
    "marker random": (
        "marker-landing", drop("marker", {"kind": "random", "probability": 0.5}), 0.3,
    ),
    "marker below": ("marker-landing", drop("marker", BELOW), 1.0),
    "fused complementary": (
        "infrared-and-marker", {**drop("infrared", BELOW), **drop("marker", ABOVE)}, 0.3,
    ),
    "fused complementary the other way": (
        "infrared-and-marker",
        {**drop("infrared", ABOVE), **drop("marker", BELOW), "guidance.mission.altitude": 6.0},
        0.5,
    ),
    "fused random": (
        "infrared-and-marker",
        {
            **drop("infrared", {"kind": "random", "probability": 0.75}),
            **drop("marker", {"kind": "random", "probability": 0.5}),
        },
        0.3,
    ),
    "cautious": ("cautious-landing", {}, 0.3),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_mode_lands(case):
    name, overrides, worst = CASES[case]
    scenario = load_scenario(name, {**overrides, "fidelity": "geometric", "seed": 3})
    result = laboratory(scenario).fly()
    assert result.landed, result.reason
    assert result.landing_error_m < worst
    assert result.touchdown_speed_m_s < 0.8


def test_the_cautious_approach_tries_again_and_lands_closer_than_the_default():
    cautious = load_scenario("cautious-landing", {"fidelity": "geometric", "seed": 4})
    default = load_scenario(
        "cautious-landing",
        {"fidelity": "geometric", "seed": 4,
         "guidance.routine": {"kind": "ardupilot", "strictness": 0}},
    )  # fmt: skip
    patient, hasty = laboratory(cautious).fly(), laboratory(default).fly()
    assert patient.attempts == 2
    assert hasty.attempts == 1
    assert patient.landing_error_m < hasty.landing_error_m
    assert patient.landing_time_s > hasty.landing_time_s

"""The laboratory's own landing, with every set of sensors that it takes."""

import pytest

from diagrams.loading import load_scenario
from runs.run import laboratory

BLIND = {"faults": [{"kind": "permanent", "while_landing": True}]}
NO_CAMERA = {"sensors.marker_camera.faults": BLIND, "sensors.infrared_camera.faults": BLIND}
LAMP = {"position": [1.5, 0.0, 0.0], "strength": 2.0, "start_time": 18.0, "end_time": 48.0}
CASES = {
    "gusty": ("plumbline-landing", {"wind.speed": 7.0}, 0.10),
    "false beacon": (
        "plumbline-landing",
        {"wind.speed": 7.0, "sensors.infrared_camera.sensor.false_beacons": [LAMP]},
        0.10,
    ),
    "pad at 2 m/s": ("plumbline-moving-pad", {"sensors.pad_gnss": None}, 0.15),
    "pad at 2 m/s by its fixes alone": ("plumbline-moving-pad", NO_CAMERA, 0.15),
    "pad at 2 m/s by wandering receivers, seen to set off": (
        "plumbline-moving-pad",
        {
            **NO_CAMERA,
            "pad.motion_start": 3.0,
            "sensors.gnss.sensor.kind": "standalone",
            "sensors.pad_gnss.sensor.kind": "standalone",
        },
        1.0,
    ),
    "light beacons from 107 m": ("plumbline-svgs", {}, 0.25),
}


@pytest.mark.parametrize("case", CASES)
def test_lands(case):
    name, overrides, worst = CASES[case]
    scenario = load_scenario(name, {**overrides, "fidelity": "geometric", "seed": 3})
    result = laboratory(scenario).fly()
    assert result.landed, result.reason
    assert result.landing_error_m < worst
    assert result.touchdown_speed_m_s < 0.6

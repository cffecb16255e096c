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


# In these gales a vehicle that waits low above the pad whatever its lean strikes it with a foot.
BELOW = {"faults": [{"kind": "below", "height": 3.0, "while_landing": True}]}
FROM_5_M = {
    "fidelity": "geometric",
    "guidance.mission.side": 0.0,
    "guidance.mission.climb_speed": 3.0,
    "guidance.mission.altitude": 5.0,
    "navigation.parameters.EKF2_REQ_GPS_H": 1,
    "vehicle.position": [0.5, 0.0, 0.0],
    "wind.speed": 10.0,
    "pad.yaw_rate": 1.0e-12,
}
GALES = {
    "blind below 3 m": {
        "sensors.marker_camera.faults": BELOW,
        "sensors.infrared_camera.faults": BELOW,
        "wind.direction": -2.2973572091724623,
        "seed": 1001,
    },
    "pad sets off at 1.5 m/s": {
        "pad.motion_from": "landing",
        "pad.motion_start": 1.0,
        "pad.velocity": [1.5, 0.0, 0.0],
        "wind.direction": 2.8653478367048724,
        "seed": 1002,
    },
}


@pytest.mark.parametrize("gale", GALES)
def test_never_topples(gale):
    scenario = load_scenario("plumbline-landing", {**FROM_5_M, **GALES[gale]})
    result = laboratory(scenario).fly()
    assert result.landed, result.reason
    assert result.landing_error_m < 1.0
    assert result.touchdown_speed_m_s < 0.7

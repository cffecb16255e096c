"""The compiled landing is the diagram's, to the last bit."""

import dataclasses
import math

import pytest

from diagrams.landing_without_gps import LandingWithoutGpsScenario
from diagrams.loading import ScenarioError
from plants.fixed_wing import FixedWingConfig
from plants.recorded_flight import RecordedFlightConfig
from runs.compiled_landing import fly_compiled
from runs.landing_without_gps import simulate_landing
from systems.estimators.runway_improved_filter import RunwayImprovedFilterConfig
from systems.sensors.runway_gps import RunwayGpsConfig
from systems.sensors.runway_pixel_camera import RunwayPixelCameraConfig
from systems.sensors.runway_tracker import RunwayTrackerConfig

SHORT = FixedWingConfig(start=[0.0, -1500.0, -154.1])
BASE = LandingWithoutGpsScenario(time_limit=90.0, aircraft=SHORT)
SCENARIOS = {
    "thesis's filter": BASE,
    "improved filter, lagged aircraft in wind, late vision chain": dataclasses.replace(
        BASE,
        aircraft=dataclasses.replace(SHORT, dynamics="lagged", wind=[2.0, -3.0]),
        filter=RunwayImprovedFilterConfig(),
        tracker=RunwayTrackerConfig(delay=0.2),
        camera=dataclasses.replace(BASE.camera, latency=0.1),
    ),
    "GPS lost on the way": dataclasses.replace(
        BASE, gps=RunwayGpsConfig(loss_time=5.0), filter=RunwayImprovedFilterConfig()
    ),
    "open loop": dataclasses.replace(
        BASE, aircraft=RecordedFlightConfig(start_distance=1500.0, altitude_error=4.0)
    ),
    "time limit": dataclasses.replace(BASE, time_limit=20.0),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_number_is_that_of_the_diagram(name):
    scenario = SCENARIOS[name]
    diagram, compiled = simulate_landing(scenario, 7), fly_compiled(scenario, 7)
    assert diagram.keys() == compiled.keys()
    for key, value in diagram.items():
        both_nan = isinstance(value, float) and math.isnan(value) and math.isnan(compiled[key])
        assert compiled[key] == value or both_nan, key
    assert diagram["landed"] == (name != "time limit")


def test_pictures_need_the_diagram():
    scenario = dataclasses.replace(BASE, camera=RunwayPixelCameraConfig())
    with pytest.raises(ScenarioError, match="geometric camera"):
        fly_compiled(scenario, 0)

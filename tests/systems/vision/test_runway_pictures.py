"""The runway drawn and followed: against the geometric camera, and without drifting away."""

import dataclasses
import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from diagrams.landing_without_gps import LandingWithoutGpsDiagram, LandingWithoutGpsScenario
from plants.fixed_wing import FixedWingConfig
from systems.runway_frames import RunwayConfig, ned_from_runway
from systems.sensors.runway_camera import camera_parameters, camera_sample
from systems.sensors.runway_pixel_camera import RunwayPixelCamera, RunwayPixelCameraConfig
from systems.sensors.runway_tracker import RunwayTrackerConfig
from systems.signals.runway_measurement import FIXED_WING_STATE
from systems.vision.runway_picture import ground_shade
from systems.vision.runway_point_tracker import follow_point
from tests.runway_bench import assert_contract
from tests.system_contract import periodic_update

RUNWAY = RunwayConfig()


def aircraft(distance, right=0.0, roll=0.0) -> np.ndarray:
    """On the glide slope of 6 deg, nose 3 deg down."""
    state = FIXED_WING_STATE.zeros()
    up = distance * math.tan(math.radians(6.0))
    state[:3] = ned_from_runway(np.array([right, -distance, -up]), RUNWAY.heading_radians)
    state[6:9] = (RUNWAY.heading_radians, math.radians(-3.0), roll)
    return state


def test_topology():
    camera = RunwayPixelCamera(RunwayPixelCameraConfig())
    assert_contract(camera)
    assert periodic_update(camera) == (0.04, 0.0)


@pytest.mark.parametrize("roll", [0.0, 0.3])
def test_the_aiming_point_is_where_the_geometric_camera_says(roll):
    """The two white blocks lie evenly about the touch-down point."""
    config = RunwayPixelCameraConfig(grain=0.0)
    camera = RunwayPixelCamera(config, 4)
    state = aircraft(400.0, right=3.0, roll=roll)
    picture = camera.picture(state, 0, (0, 0), (480, 640)).astype(float)
    message = camera_sample(state, 0.0, 0, camera_parameters(config, 4))
    u, v = message[4:6]
    rows, columns = np.mgrid[0:480, 0:640]
    # bright, but neither the centre line nor the threshold
    axis = np.array([math.cos(roll), -math.sin(roll)])
    across = (columns + 0.5 - u) * axis[0] + (rows + 0.5 - v) * axis[1]
    near = np.hypot(columns + 0.5 - u, rows + 0.5 - v) < 55.0
    blocks = (picture > 140.0) & near & (np.abs(across) > 15.0)
    assert blocks.sum() > 100
    centre = np.array([columns[blocks].mean() + 0.5, rows[blocks].mean() + 0.5])
    np.testing.assert_allclose(centre, (u, v), atol=1.5)


def test_markings_and_sky():
    shade = lambda x, y: ground_shade(x, y, 0.1, 0.1, 50.0, 1500.0)  # noqa: E731
    assert shade(12.0, 0.0) == pytest.approx(215.0)
    assert shade(5.0, 0.0) < 90.0
    assert shade(0.0, 75.0) == pytest.approx(215.0)  # centre line
    camera = RunwayPixelCamera(RunwayPixelCameraConfig(grain=0.0))
    picture = camera.picture(aircraft(3000.0), 0, (0, 0), (480, 640))
    assert (picture[0] == 180).all()


def test_same_index_same_grain():
    camera = RunwayPixelCamera(RunwayPixelCameraConfig(), 1)
    first = camera.picture(aircraft(900.0), 5, (300, 200), (40, 60))
    np.testing.assert_array_equal(first, camera.picture(aircraft(900.0), 5, (300, 200), (40, 60)))
    whole = camera.picture(aircraft(900.0), 5, (0, 0), (480, 640))
    np.testing.assert_array_equal(first, whole[200:240, 300:360])
    assert not np.array_equal(first, camera.picture(aircraft(900.0), 6, (300, 200), (40, 60)))


def test_the_tracker_refuses_plain_pictures():
    plain = np.full((80, 80), 90, np.uint8)
    assert follow_point(plain, plain, (40.0, 40.0)) is None


def test_the_point_is_held_over_an_approach():
    """From the click at 1000 m on for seven seconds: within three pixels."""
    config = RunwayPixelCameraConfig()
    scenario = LandingWithoutGpsScenario(
        seed=2,
        camera=config,
        tracker=RunwayTrackerConfig(click_spread=0.0, clicks=[1010.0, 1.0, 1.0]),
        aircraft=FixedWingConfig(dynamics="lagged", start=[0.0, -1000.0, -106.3]),
        gps=dataclasses.replace(LandingWithoutGpsScenario().gps, horizontal_noise=5.0),
    )
    landing = LandingWithoutGpsDiagram(scenario)
    assert "tracker" not in landing.systems
    simulator = Simulator(landing.diagram)
    camera = landing.systems["camera"]
    parameters = camera_parameters(config, 2)
    errors = []
    for time in np.arange(0.52, 7.0, 0.4):
        simulator.AdvanceTo(time + 0.001)
        root = simulator.get_context()
        found = camera.GetOutputPort("measurement").Eval(camera.GetMyContextFromRoot(root))
        state = landing.diagram.GetOutputPort("state").Eval(root)
        # the picture was taken at t, the state has moved on by 10 ms
        truth = camera_sample(state, time, 0, parameters)
        assert found[3] == 1.0
        errors.append(found[4:6] - truth[4:6])
    assert np.abs(errors).max() < 3.0
    assert np.std(errors, axis=0)[0] < 1.5
    image = camera.GetOutputPort("image").Eval(camera.GetMyContextFromRoot(root))
    assert image.shape == (480, 640)

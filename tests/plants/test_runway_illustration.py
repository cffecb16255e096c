"""The fixed wing's picture: wheels on the ground, everything where the flight says it is."""

import numpy as np
import pytest
from pydrake.geometry import Cylinder, Ellipsoid

from plants import runway_illustration as picture
from plants.terrain import CliffTerrain, CoastalTerrain
from systems.runway_frames import RunwayConfig
from systems.signals.runway_measurement import (
    ANTENNA,
    FIXED_WING_STATE,
    NAVIGATION_ESTIMATE,
    PICTURE,
)

RUNWAY = RunwayConfig()
LENS = picture.Lens(np.zeros(3), np.zeros(3), np.array([0.56, 0.42, 0.56 / 640, 0.42 / 480]))


class Recorder:
    """Takes what `move_world` tells Meshcat."""

    def __init__(self):
        self.poses, self.properties = {}, {}

    def SetTransform(self, path, pose, time=None):
        self.poses[path] = pose

    def SetProperty(self, path, name, value, time=None):
        self.properties[path, name] = value


@pytest.fixture
def samples():
    """On the axis 1000 m before the touch-down point, 100 m up, heading for it, level."""
    heading = RUNWAY.heading_radians
    state = np.zeros(FIXED_WING_STATE.size)
    state[:3] = [-1000.0 * np.cos(heading), -1000.0 * np.sin(heading), -100.0]
    state[6] = heading
    return {
        "state": state,
        "estimate": np.zeros(NAVIGATION_ESTIMATE.size),
        "antenna": np.zeros(ANTENNA.size),
        "picture": np.zeros(PICTURE.size),
    }


def test_the_wheels_reach_as_low_as_the_gear():
    pieces = picture.aircraft_pieces(1.2)
    assert len({piece.name for piece in pieces}) == len(pieces)
    wheels = [piece for piece in pieces if piece.name.endswith("wheel")]
    for wheel in wheels:
        assert isinstance(wheel.shape, Cylinder)
        assert wheel.pose.translation()[2] + wheel.shape.radius() == pytest.approx(1.2)
    wings = [piece for piece in pieces if piece.name.endswith("wing")]
    span = 2.0 * max(abs(p.pose.translation()[1]) + p.shape.b() for p in wings)
    assert all(isinstance(piece.shape, Ellipsoid) for piece in wings)
    assert span == pytest.approx(18.0, abs=0.5)


@pytest.mark.parametrize(("length", "width"), [(1500.0, 50.0), (200.0, 8.0), (1.0, 0.1)])
def test_the_paint_lies_on_the_asphalt(length, width):
    pieces = picture.runway_pieces(RunwayConfig(length=length, width=width))
    assert len({piece.name for piece in pieces}) == len(pieces)
    asphalt = pieces[0]
    top = asphalt.pose.translation()[2] + 0.5 * asphalt.shape.height()
    for piece in pieces[1:]:
        z = piece.pose.translation()[2]
        assert z - 0.5 * piece.shape.height() <= top < z + 0.5 * piece.shape.height()
    first = asphalt.pose.translation()[0] - 0.5 * asphalt.shape.width()
    assert first == pytest.approx(-300.0)
    assert first + asphalt.shape.width() == pytest.approx(length)


def test_the_eye_keeps_behind_the_aircraft(samples):
    scene = Recorder()
    picture.move_world(scene, samples, RUNWAY, LENS, "/p")
    seen = scene.poses["/p"].multiply(scene.poses["/p/world"])
    seen = seen.multiply(scene.poses["/p/world/aircraft"])
    np.testing.assert_allclose(seen.translation(), 0.0, atol=1e-9)
    np.testing.assert_allclose(seen.rotation().matrix(), np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_what_is_not_measured_is_not_drawn(samples):
    scene = Recorder()
    picture.move_world(scene, samples, RUNWAY, LENS, "/p")
    for part in ("estimate", "sight", "antenna/length"):
        assert scene.properties[f"/p/world/{part}", "visible"] is False


def test_the_rays_end_where_the_sensors_point(samples):
    aircraft = picture.positions(samples["state"])
    station = RUNWAY.ground_station_n()
    from_station = samples["state"][:3] - station
    antenna, seen = samples["antenna"], samples["picture"]
    antenna[3] = seen[3] = 1.0
    antenna[4] = np.arctan2(from_station[1], from_station[0])
    antenna[5] = np.arctan2(-from_station[2], np.hypot(*from_station[:2]))
    down = np.arcsin(100.0 / np.hypot(1000.0, 100.0))
    seen[4:6] = 320.0, 240.0 + down / LENS.optics[3]
    scene = Recorder()
    picture.move_world(scene, samples, RUNWAY, LENS, "/p")

    def end(ray):
        length = scene.properties[f"/p/world/{ray}/length", "scale"][2]
        return scene.poses[f"/p/world/{ray}"].multiply(np.array([0.0, 0.0, length]))

    np.testing.assert_allclose(end("antenna"), aircraft, atol=1e-6)
    np.testing.assert_allclose(end("sight"), 0.0, atol=1e-6)


@pytest.mark.parametrize("terrain", [CoastalTerrain(), CliffTerrain()])
def test_the_ground_is_the_terrain(terrain):
    track = np.array([[0.0, 0.0, 0.0], [-4000.0, -4000.0, 500.0]])
    vertices, faces, colours = picture._terrain_mesh(RUNWAY, terrain, track)
    grid = terrain.grid(RUNWAY)
    rng = np.random.default_rng(0)
    for k in rng.integers(vertices.shape[1], size=50):
        east, north, up = vertices[:, k]
        assert up == pytest.approx(grid.elevation(north, east) - picture._SUNK, abs=1e-9)
    assert faces.max() == vertices.shape[1] - 1
    assert colours.min() >= 0.0
    assert colours.max() <= 1.0
    corners = vertices[:2, faces]  # every triangle is seen from above by the same side
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    turn = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
    assert (np.sign(turn) == np.sign(turn[0])).all()

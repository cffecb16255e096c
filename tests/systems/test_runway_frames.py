"""The thesis's frames against pymap3d and scipy."""

import math

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from systems.runway_frames import (
    RunwayConfig,
    angles_from_pixel,
    bearing_and_elevation,
    body_from_ned,
    camera_from_body,
    ecef_from_geodetic,
    geodetic_from_ecef,
    geodetic_from_ned,
    ned_from_ecef_rotation,
    ned_from_geodetic,
    ned_from_runway,
    pixel_from_angles,
    rotation,
    runway_from_ned,
    wrap_angle,
)

_LONGITUDE = st.floats(-179.9, 179.9)
_LATITUDE = st.floats(-89.0, 89.0)
_ANGLE = st.floats(-3.1, 3.1)


@settings(max_examples=50, deadline=None)
@given(_LONGITUDE, _LATITUDE, st.floats(-100.0, 20000.0))
def test_wgs84_and_ecef_agree_with_pymap3d(longitude, latitude, height):
    expected = pymap3d.geodetic2ecef(latitude, longitude, height)
    lam, phi = math.radians(longitude), math.radians(latitude)
    p_e = ecef_from_geodetic(lam, phi, height)
    np.testing.assert_allclose(p_e, expected, atol=1e-6)
    back = geodetic_from_ecef(p_e)
    np.testing.assert_allclose(back[:2], (lam, phi), atol=1e-11)
    assert back[2] == pytest.approx(height, abs=1e-4)


def test_the_printed_z_of_equation_2_is_upside_down():
    """(a²/b² N + h) sin φ, as printed, misses pymap3d by tens of kilometres."""
    a, b = 6378137.0, 6356752.31424518
    phi = math.radians(49.5)
    N = a / math.sqrt(1.0 - (a * a - b * b) / (a * a) * math.sin(phi) ** 2)
    printed = (a * a / (b * b) * N + 89.0) * math.sin(phi)
    true = pymap3d.geodetic2ecef(49.5, 0.0, 89.0)[2]
    assert abs(printed - true) > 50_000.0
    assert ecef_from_geodetic(0.0, phi, 89.0)[2] == pytest.approx(true, abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(_LONGITUDE, _LATITUDE)
def test_ned_rotation_agrees_with_pymap3d(longitude, latitude):
    R = ned_from_ecef_rotation(math.radians(longitude), math.radians(latitude))
    expected = pymap3d.ecef2nedv(3.0, -4.0, 5.0, latitude, longitude)
    np.testing.assert_allclose(R @ (3.0, -4.0, 5.0), expected, atol=1e-9)


def test_geodetic_to_ned_and_back():
    runway = RunwayConfig()
    p_n = np.array([-4000.0, 2500.0, -530.0])
    geodetic = geodetic_from_ned(p_n, runway)
    np.testing.assert_allclose(ned_from_geodetic(geodetic, runway), p_n, atol=1e-5)
    lam, phi = math.radians(geodetic[1]), math.radians(geodetic[0])
    origin = np.radians([runway.longitude, runway.latitude])
    own = ned_from_ecef_rotation(origin[0], origin[1]) @ (
        ecef_from_geodetic(lam, phi, geodetic[2])
        - ecef_from_geodetic(origin[0], origin[1], runway.altitude)
    )
    np.testing.assert_allclose(own, p_n, atol=1e-4)


def test_runway_frame_is_right_along_down_and_left_handed():
    heading = math.radians(42.0)
    along = ned_from_runway(np.array([0.0, 1.0, 0.0]), heading)
    np.testing.assert_allclose(along, [math.cos(heading), math.sin(heading), 0.0])
    right = ned_from_runway(np.array([1.0, 0.0, 0.0]), heading)
    np.testing.assert_allclose(np.cross([0.0, 0.0, 1.0], along), right, atol=1e-12)
    matrix = np.column_stack([ned_from_runway(row, heading) for row in np.eye(3)])
    assert np.linalg.det(matrix) == pytest.approx(-1.0)
    p = np.array([3.0, -7.0, 2.0])
    np.testing.assert_allclose(runway_from_ned(ned_from_runway(p, heading), heading), p)


@settings(max_examples=30, deadline=None)
@given(_ANGLE, st.floats(-1.5, 1.5), _ANGLE)
def test_body_rotation_agrees_with_scipy(yaw, pitch, roll):
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rotation(yaw, pitch, roll), expected, atol=1e-12)


def test_body_and_camera_frames():
    # flying east, level: a point ahead lies on the body's x axis
    p_b = body_from_ned(
        np.array([0.0, 100.0, 0.0]), np.array([0.0, 0.0, -10.0]), math.pi / 2, 0.0, 0.0
    )
    np.testing.assert_allclose(p_b, [100.0, 0.0, 10.0], atol=1e-12)
    # a camera that looks down by 3 deg sees a point 3 deg below the nose on its axis
    down = math.radians(3.0)
    p_c = camera_from_body(
        np.array([2.5 + 100.0 * math.cos(down), 0.0, 100.0 * math.sin(down)]),
        np.array([2.5, 0.0, 0.0]),
        np.array([0.0, -down, 0.0]),
    )
    np.testing.assert_allclose(p_c, [100.0, 0.0, 0.0], atol=1e-9)


def test_pixels_of_equation_14():
    optics = np.array([0.56, 0.42, 0.56 / 640, 0.42 / 480])
    assert pixel_from_angles(0.0, 0.0, optics) == pytest.approx((320.0, 240.0))
    assert pixel_from_angles(-0.28, -0.21, optics) == pytest.approx((0.0, 0.0))
    bearing, elevation = bearing_and_elevation(np.array([1.0, 1.0, math.sqrt(2.0)]))
    assert (bearing, elevation) == pytest.approx((math.pi / 4, math.pi / 4))
    u, v = pixel_from_angles(0.1, -0.05, optics)
    assert angles_from_pixel(u, v, optics) == pytest.approx((0.1, -0.05))


@pytest.mark.parametrize("angle", [-10.0, -math.pi, 0.0, 3.0, 40.0])
def test_wrapped_angles(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle))
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-12)

"""Frames against Drake's rotations, scipy's and pymap3d's geodesy."""

import math
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from systems import frames

# Rows are the axes of one frame in the other: NED in W (ENU), FRD in B (FLU).
R_NED_W = RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
R_FRD_B = RotationMatrix(np.diag([1.0, -1.0, -1.0]))

RANDOM = np.random.default_rng(0)
QUATERNIONS = [q / np.linalg.norm(q) for q in RANDOM.normal(size=(20, 4))]
VECTORS = list(RANDOM.normal(size=(20, 3)))


def drake(q: np.ndarray) -> RotationMatrix:
    return RotationMatrix(Quaternion(q))


def same_rotation(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(min(np.abs(a - b).max(), np.abs(a + b).max()) < 1e-14)


@pytest.mark.parametrize("v", VECTORS)
def test_vectors(v):
    np.testing.assert_allclose(frames.ned_from_world(v), R_NED_W @ v, atol=1e-15)
    np.testing.assert_allclose(frames.frd_from_body(v), R_FRD_B @ v, atol=1e-15)
    np.testing.assert_array_equal(frames.ned_from_world(frames.ned_from_world(v)), v)
    np.testing.assert_array_equal(frames.frd_from_body(frames.frd_from_body(v)), v)


def test_axes_by_name():
    east, north, up = np.eye(3)
    np.testing.assert_array_equal(frames.ned_from_world(east), [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(frames.ned_from_world(north), [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(frames.ned_from_world(up), [0.0, 0.0, -1.0])
    forward, left, up = np.eye(3)
    np.testing.assert_array_equal(frames.frd_from_body(forward), [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(frames.frd_from_body(left), [0.0, -1.0, 0.0])
    np.testing.assert_array_equal(frames.frd_from_body(up), [0.0, 0.0, -1.0])


@pytest.mark.parametrize("q", QUATERNIONS)
def test_rotation_matrix(q):
    np.testing.assert_allclose(frames.rotation_matrix(q), drake(q).matrix(), atol=1e-14)


@pytest.mark.parametrize(("a", "b"), list(pairwise(QUATERNIONS)))
def test_quaternion_multiply(a, b):
    product = drake(a) @ drake(b)
    assert same_rotation(frames.quaternion_multiply(a, b), product.ToQuaternion().wxyz())


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-8, 2e-8, 1e-3, 1.0, 3.0, 7.0])
def test_quaternion_from_rotation_vector(angle):
    r = angle * np.array([1.0, -2.0, 2.0]) / 3.0
    q = frames.quaternion_from_rotation_vector(r)
    expected = np.roll(Rotation.from_rotvec(r).as_quat(), 1)
    assert same_rotation(q, expected)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("yaw", np.linspace(-3.1, 3.1, 9))
def test_yaw(yaw):
    level = frames.quaternion_from_yaw(yaw)
    np.testing.assert_allclose(
        frames.rotation_matrix(level), RotationMatrix.MakeZRotation(yaw).matrix(), atol=1e-15
    )
    tilted = RollPitchYaw(0.4, -0.7, yaw).ToQuaternion().wxyz()
    assert frames.yaw_of(tilted) == pytest.approx(yaw, abs=1e-14)


@pytest.mark.parametrize("q_WB", QUATERNIONS)
def test_attitude(q_WB):
    q = frames.attitude_ned_from_world(q_WB)
    expected = R_NED_W @ drake(q_WB) @ R_FRD_B.inverse()
    assert same_rotation(q, expected.ToQuaternion().wxyz())
    assert q[0] >= 0.0
    assert same_rotation(frames.attitude_ned_from_world(q), q_WB)


@pytest.mark.parametrize("yaw", np.linspace(-3.0, 3.0, 7))
def test_heading_in_ned_is_a_right_angle_less_the_yaw(yaw):
    heading = frames.yaw_of(frames.attitude_ned_from_world(frames.quaternion_from_yaw(yaw)))
    assert math.remainder(heading - (math.pi / 2 - yaw), 2 * math.pi) == pytest.approx(0, abs=1e-14)


def test_a_vehicle_facing_north_has_no_rotation_in_ned():
    q = frames.attitude_ned_from_world(frames.quaternion_from_yaw(math.pi / 2))
    np.testing.assert_allclose(q, [1.0, 0.0, 0.0, 0.0], atol=1e-15)


def test_vectors_and_attitude_agree():
    """Rotating in B and W and then changing frames is changing frames and then rotating."""
    for q_WB, v_B in zip(QUATERNIONS, VECTORS, strict=True):
        v_NED = frames.ned_from_world(RigidTransform(drake(q_WB), np.zeros(3)) @ v_B)
        R = frames.rotation_matrix(frames.attitude_ned_from_world(q_WB))
        np.testing.assert_allclose(R @ frames.frd_from_body(v_B), v_NED, atol=1e-14)


@pytest.mark.parametrize(
    "origin", [[47.4, 8.55, 488.0], [39.4, 22.9, 10.0], [-33.9, 151.2, 50.0], [70.0, -179.99, 0.0]]
)
@pytest.mark.parametrize("p_W", [[0.0, 0.0, 0.0], [120.0, -340.0, 56.0], [-5000.0, 9000.0, -3.0]])
def test_geodetic(p_W, origin):
    geodetic = frames.geodetic_from_world(np.array(p_W), np.array(origin))
    p_ecef = np.array(pymap3d.geodetic2ecef(*geodetic))
    np.testing.assert_allclose(p_ecef, pymap3d.enu2ecef(*p_W, *origin), rtol=0, atol=1e-6)
    back = frames.world_from_geodetic(geodetic, np.array(origin))
    np.testing.assert_allclose(back, p_W, rtol=0, atol=1e-6)


def test_geodetic_directions():
    origin = np.array([45.0, 7.0, 100.0])
    east, north, up = (frames.geodetic_from_world(axis, origin) - origin for axis in np.eye(3))
    assert east[1] > 0.0
    assert north[0] > 0.0
    assert up[2] == pytest.approx(1.0, abs=1e-6)

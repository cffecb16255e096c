"""Frames: W (east-north-up) and B (forward-left-up) against PX4's NED and FRD, and WGS84.

The laboratory speaks W and B. PX4's EKF2 works in NED and FRD; the change is
made at that filter's ports, with these functions, and nowhere else.

    v_NED = (v_W.y, v_W.x, −v_W.z)        v_FRD = (v_B.x, −v_B.y, −v_B.z)
    yaw_NED = π/2 − yaw_W

Geodetic positions are by pymap3d on the WGS84 ellipsoid; altitude above mean
sea level is taken as height above the ellipsoid (a constant geoid undulation
cancels in everything done here).
"""

import math

import numpy as np
import pymap3d
from numba import njit

_HALF_SQRT2 = math.sqrt(0.5)


@njit(cache=True)
def ned_from_world(v_W):
    """A vector from W (ENU) to NED or back (the map is its own inverse), shape (3,)."""
    return np.array([v_W[1], v_W[0], -v_W[2]])


@njit(cache=True)
def frd_from_body(v_B):
    """A vector from B (FLU) to FRD or back (the map is its own inverse), shape (3,)."""
    return np.array([v_B[0], -v_B[1], -v_B[2]])


@njit(cache=True)
def quaternion_multiply(a, b):
    """The Hamilton product a ⊗ b of two quaternions, w first, shape (4,)."""
    return np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


@njit(cache=True)
def rotation_matrix(q):
    """The rotation matrix of a unit quaternion, w first: v_A = R_AB v_B, shape (3, 3)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@njit(cache=True)
def quaternion_from_rotation_vector(r):
    """The unit quaternion, w first, of a rotation vector (rad), shape (3,) to (4,)."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    if angle < 1e-8:
        scale = 0.5 - angle * angle / 48.0
    else:
        scale = math.sin(0.5 * angle) / angle
    return np.array([math.cos(0.5 * angle), scale * r[0], scale * r[1], scale * r[2]])


@njit(cache=True)
def yaw_of(q):
    """The heading of the x axis (rad, counter-clockwise from the first axis), q w first."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@njit(cache=True)
def quaternion_from_yaw(yaw):
    """The unit quaternion, w first, of a rotation by `yaw` (rad) about the third axis."""
    return np.array([math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])


@njit(cache=True)
def attitude_ned_from_world(q_WB):
    """The attitude FRD to NED from the attitude B to W, or back (its own inverse), shape (4,).

    q_NED,FRD = q_NED,W ⊗ q_WB ⊗ q_B,FRD, with q_NED,W = (0, √½, √½, 0), a half
    turn about (1, 1, 0), and q_B,FRD = (0, 1, 0, 0), a half turn about x.
    """
    s = _HALF_SQRT2
    left = quaternion_multiply(np.array([0.0, s, s, 0.0]), q_WB)
    q = quaternion_multiply(left, np.array([0.0, 1.0, 0.0, 0.0]))
    if q[0] < 0.0:
        return -q
    return q


def geodetic_from_world(p_W: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Latitude (deg), longitude (deg) and altitude (m) of a point p_W (m), shape (3,).

    `origin` is the latitude, longitude and altitude of W's origin, shape (3,).
    """
    return np.array(pymap3d.enu2geodetic(*p_W, *origin))


def world_from_geodetic(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The inverse of `geodetic_from_world`, shape (3,) in metres."""
    return np.array(pymap3d.geodetic2enu(*geodetic, *origin))

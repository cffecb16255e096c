"""Frames of the fixed wing: WGS84, ECEF, NED, runway, body and camera (Leonard 2016, 3.1).

| subscript | frame | axes |
|---|---|---|
| `g` | WGS84 | longitude λ, latitude φ (rad), height h (m) |
| `e` | ECEF | X towards λ = 0, Z towards the pole |
| `n` | NED | north, east, down; origin at the touch-down point |
| `r` | runway | X to the right of the landing direction, Y along it, Z down; left-handed |
| `b` | body | forward, right, down |
| `c` | camera | along the optical axis, right, down |

The formulas are the thesis's; `pymap3d` is the geodesy that the tests hold them
against. Where a printed formula has a slip the right one is used:

* (1) arctan(Y/X) is meant with its quadrant, atan2(Y, X).
* (2) Z = (a²/b² N + h) sin φ is printed upside down: it is (b²/a² N + h) sin φ.
* (3) R_n/e lost the arguments of its last column: cos φ, 0, −sin φ.
* (6) R_n/r, the map from runway to NED coordinates, is no rotation (its
  determinant is −1: the runway frame is left-handed) and its θ runs
  anticlockwise. Here the runway's heading runs clockwise from north, as a
  compass does, which turns the sign of both sines.
* (7), (9) R_b/n and R_c/b are printed as R_ψ R_θ R_φ, which maps body to NED and
  camera to body; the map that is wanted is its transpose. The subscript e in
  (8) is n.
"""

import math

import numpy as np
import pymap3d
from numba import njit
from pydantic import Field

from systems.configuration import Finite, Positive, Vector3, configuration

SEMI_MAJOR_AXIS = 6378137.0  # m, WGS84
SEMI_MINOR_AXIS = 6356752.31424518  # m, WGS84, as printed below (2)
EARTH_RADIUS = 6371008.8  # m, mean radius of the WGS84 ellipsoid, R_T of (11)
GRAVITY = 9.80665  # m/s2

_ECCENTRICITY_2 = (SEMI_MAJOR_AXIS**2 - SEMI_MINOR_AXIS**2) / SEMI_MAJOR_AXIS**2  # e²
_SECOND_ECCENTRICITY_2 = (SEMI_MAJOR_AXIS**2 - SEMI_MINOR_AXIS**2) / SEMI_MINOR_AXIS**2  # e′²


@configuration
class RunwayConfig:
    """Where the runway lies, and the ground station beside it.

    The defaults are an airfield like Le Havre's: on a cliff above the sea, its
    touch-down point 89 m above it (Figs. 8 and 18).
    """

    latitude: Finite = 49.5339  # deg, of the touch-down point
    longitude: Finite = 0.0881  # deg
    altitude: Finite = 89.0  # m above mean sea level (Fig. 18)
    heading: Finite = 42.0  # deg, of the landing direction, clockwise from north
    length: Positive = 1500.0  # m, usable beyond the touch-down point
    width: Positive = 50.0  # m
    # m, runway frame: left of the runway (Fig. 42), on a mast of 10 m
    ground_station: Vector3 = Field(default_factory=lambda: [-150.0, 200.0, -10.0])

    @property
    def heading_radians(self) -> float:
        """The landing direction, rad clockwise from north."""
        return math.radians(self.heading)

    def ground_station_n(self) -> np.ndarray:
        """The antenna of the ground station in NED, shape (3,), m."""
        return ned_from_runway(np.array(self.ground_station), self.heading_radians)


@njit(cache=True)
def ecef_from_geodetic(longitude, latitude, height):
    """WGS84 to ECEF (2): λ, φ (rad) and h (m) to (X, Y, Z)_e, shape (3,), m."""
    N = SEMI_MAJOR_AXIS / math.sqrt(1.0 - _ECCENTRICITY_2 * math.sin(latitude) ** 2)
    horizontal = (N + height) * math.cos(latitude)
    ratio = (SEMI_MINOR_AXIS / SEMI_MAJOR_AXIS) ** 2
    return np.array(
        [
            horizontal * math.cos(longitude),
            horizontal * math.sin(longitude),
            (ratio * N + height) * math.sin(latitude),
        ]
    )


@njit(cache=True)
def geodetic_from_ecef(p_e):
    """ECEF to WGS84 (1), Bowring's formula: p_e (m) to (λ, φ, h) in rad, rad, m, shape (3,)."""
    a, b = SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS
    p = math.hypot(p_e[0], p_e[1])
    theta = math.atan2(p_e[2] * a, p * b)
    latitude = math.atan2(
        p_e[2] + _SECOND_ECCENTRICITY_2 * b * math.sin(theta) ** 3,
        p - _ECCENTRICITY_2 * a * math.cos(theta) ** 3,
    )
    N = a / math.sqrt(1.0 - _ECCENTRICITY_2 * math.sin(latitude) ** 2)
    return np.array([math.atan2(p_e[1], p_e[0]), latitude, p / math.cos(latitude) - N])


@njit(cache=True)
def ned_from_ecef_rotation(longitude, latitude):
    """R_n/e of (3) at the origin of NED (rad), shape (3, 3): v_n = R_n/e v_e."""
    sl, cl = math.sin(longitude), math.cos(longitude)
    sp, cp = math.sin(latitude), math.cos(latitude)
    return np.array([[-sp * cl, -sp * sl, cp], [-sl, cl, 0.0], [-cp * cl, -cp * sl, -sp]])


def ned_from_geodetic(geodetic: np.ndarray, runway: RunwayConfig) -> np.ndarray:
    """Latitude (deg), longitude (deg) and altitude (m), shape (3,), to NED, shape (3,), m."""
    origin = (runway.latitude, runway.longitude, runway.altitude)
    return np.array(pymap3d.geodetic2ned(*geodetic, *origin))


def geodetic_from_ned(p_n: np.ndarray, runway: RunwayConfig) -> np.ndarray:
    """The inverse of `ned_from_geodetic`, shape (3,)."""
    origin = (runway.latitude, runway.longitude, runway.altitude)
    return np.array(pymap3d.ned2geodetic(*p_n, *origin))


@njit(cache=True)
def ned_from_runway(p_r, heading):
    """P_n = R_n/r P_r (5) for a runway's `heading` (rad clockwise from north), shape (3,)."""
    s, c = math.sin(heading), math.cos(heading)
    return np.array([-s * p_r[0] + c * p_r[1], c * p_r[0] + s * p_r[1], p_r[2]])


@njit(cache=True)
def runway_from_ned(p_n, heading):
    """P_r = R_n/r⁻¹ P_n (6); R_n/r is symmetric, a reflection, its own inverse. Shape (3,)."""
    s, c = math.sin(heading), math.cos(heading)
    return np.array([-s * p_n[0] + c * p_n[1], c * p_n[0] + s * p_n[1], p_n[2]])


@njit(cache=True)
def rotation(yaw, pitch, roll):
    """R_ψ R_θ R_φ (below (8)), shape (3, 3): body to NED, or camera to body."""
    sy, cy = math.sin(yaw), math.cos(yaw)
    sp, cp = math.sin(pitch), math.cos(pitch)
    sr, cr = math.sin(roll), math.cos(roll)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@njit(cache=True)
def body_from_ned(p_n, p_body_n, yaw, pitch, roll):
    """P_b = R_b/n (P_n − P_n^body) (7), shape (3,), m."""
    return rotation(yaw, pitch, roll).T @ (p_n - p_body_n)


@njit(cache=True)
def camera_from_body(p_b, p_camera_b, mounting):
    """P_c = R_c/b (P_b − P_b^camera) (9), with mounting angles (ψ, θ, φ) in rad, shape (3,), m."""
    return rotation(mounting[0], mounting[1], mounting[2]).T @ (p_b - p_camera_b)


@njit(cache=True)
def bearing_and_elevation(p_c):
    """The two angles of a point in the camera frame (14): atan2(Y, X), asin(Z/D), rad."""
    distance = math.sqrt(p_c[0] * p_c[0] + p_c[1] * p_c[1] + p_c[2] * p_c[2])
    return math.atan2(p_c[1], p_c[0]), math.asin(p_c[2] / distance)


@njit(cache=True)
def pixel_from_angles(bearing, elevation, optics):
    """The pixel (14) of a direction (rad), from the top left corner.

    `optics` are FOV_H, FOV_V (rad), IFOV_H and IFOV_V (rad/px), shape (4,).
    """
    u = (bearing + 0.5 * optics[0]) / optics[2]
    v = (elevation + 0.5 * optics[1]) / optics[3]
    return u, v


@njit(cache=True)
def angles_from_pixel(u, v, optics):
    """The direction (bearing, elevation; rad) of a pixel, the inverse of (14)."""
    return u * optics[2] - 0.5 * optics[0], v * optics[3] - 0.5 * optics[1]


@njit(cache=True)
def direction_in_camera(p_n, yaw, pitch, roll, camera_b, mounting):
    """The touch-down point, the origin of NED, in the camera frame (7), (9), shape (3,), m."""
    p_b = rotation(yaw, pitch, roll).T @ (-p_n)
    return rotation(mounting[0], mounting[1], mounting[2]).T @ (p_b - camera_b)


@njit(cache=True)
def wrap_angle(angle):
    """The angle (rad) in [−π, π)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi

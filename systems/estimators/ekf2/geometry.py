"""Rotations and the earth, in scalars and tuples (no allocation in the inner loops).

Quaternions are w first and rotate FRD into NED; a rotation matrix is nine
numbers row by row, `m[3 * row + column]`. Radii of curvature are WGS84's; the
local projection is the azimuthal equidistant one on a sphere of 6371 km, as in
PX4 (Snyder, "Map Projections: a Working Manual", USGS 1987, eq. 22-4, 22-5, 5-2
to 5-4, 20-14).
"""

import math

from systems.estimators.ekf2.compiled import kernel

EARTH_RADIUS = 6371000.0  # m, sphere of the local projection
EARTH_SPIN = 7.2921150e-5  # rad/s
_EQUATORIAL_RADIUS = 6378137.0  # m, WGS84
_ECCENTRICITY_SQUARED = 0.0818191908425**2  # WGS84
FLOAT_EPSILON = 1.1920929e-7  # of single precision: thresholds in PX4


@kernel
def wrap_pi(angle):
    """The angle (rad) brought into [−π, π)."""
    if -math.pi <= angle < math.pi:
        return angle
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def limit(value, low, high):
    """The value held between two bounds; NaN stays NaN."""
    if value < low:
        return low
    if value > high:
        return high
    return value


@kernel
def sign(value):
    """−1, 0 or 1."""
    if value > 0.0:
        return 1.0
    return -1.0 if value < 0.0 else 0.0


@kernel
def multiply(a0, a1, a2, a3, b0, b1, b2, b3):
    """The product a ⊗ b of two quaternions."""
    return (
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    )


@kernel
def normalised(q0, q1, q2, q3):
    """The quaternion divided by its norm."""
    scale = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    return q0 * scale, q1 * scale, q2 * scale, q3 * scale


@kernel
def from_rotation_vector(rx, ry, rz):
    """The quaternion of a rotation vector (rad)."""
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    if angle < 1e-10:
        return 1.0, 0.0, 0.0, 0.0
    scale = math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), rx * scale, ry * scale, rz * scale


@kernel
def to_rotation_vector(q0, q1, q2, q3):
    """The rotation vector (rad) of a quaternion; of −q the long way round, as given."""
    norm = math.sqrt(q1 * q1 + q2 * q2 + q3 * q3)
    scale = 2.0 * math.atan2(norm, q0) / norm if norm >= 1e-10 else 2.0 * sign(q0)
    return q1 * scale, q2 * scale, q3 * scale


@kernel
def matrix_of(q0, q1, q2, q3):
    """The rotation matrix of a unit quaternion."""
    return (
        q0 * q0 + q1 * q1 - q2 * q2 - q3 * q3,
        2.0 * (q1 * q2 - q0 * q3),
        2.0 * (q1 * q3 + q0 * q2),
        2.0 * (q1 * q2 + q0 * q3),
        q0 * q0 - q1 * q1 + q2 * q2 - q3 * q3,
        2.0 * (q2 * q3 - q0 * q1),
        2.0 * (q1 * q3 - q0 * q2),
        2.0 * (q2 * q3 + q0 * q1),
        q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3,
    )


@kernel
def quaternion_of(m):
    """The unit quaternion of a rotation matrix (Shepperd's choice of the largest term)."""
    trace = m[0] + m[4] + m[8]
    if trace > 0.0:
        s = math.sqrt(1.0 + trace)
        k = 0.5 / s
        return 0.5 * s, (m[7] - m[5]) * k, (m[2] - m[6]) * k, (m[3] - m[1]) * k
    if m[0] > m[4] and m[0] > m[8]:
        s = math.sqrt(1.0 + m[0] - m[4] - m[8])
        k = 0.5 / s
        return (m[7] - m[5]) * k, 0.5 * s, (m[3] + m[1]) * k, (m[2] + m[6]) * k
    if m[4] > m[8]:
        s = math.sqrt(1.0 - m[0] + m[4] - m[8])
        k = 0.5 / s
        return (m[2] - m[6]) * k, (m[3] + m[1]) * k, 0.5 * s, (m[7] + m[5]) * k
    s = math.sqrt(1.0 - m[0] - m[4] + m[8])
    k = 0.5 / s
    return (m[3] - m[1]) * k, (m[2] + m[6]) * k, (m[7] + m[5]) * k, 0.5 * s


@kernel
def tilt_quaternion(ax, ay, az):
    """The shortest rotation that brings a specific force (m/s2, FRD) upright, to −z of NED."""
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    cx, cy = -ay, ax  # a × (0, 0, −1)
    if math.sqrt(cx * cx + cy * cy) < 1e-5 and az > 0.0:
        # upside down: half a turn about the body axis least aligned with the force
        if abs(ax) < abs(ay):
            return normalised(0.0, 0.0, az, -ay)
        return normalised(0.0, -az, 0.0, ax)
    return normalised(norm - az, cx, cy, 0.0)


@kernel
def rotate(x, matrix, vx, vy, vz):
    """R v for the rotation matrix that stands in the array `x` at `matrix`."""
    return (
        x[matrix] * vx + x[matrix + 1] * vy + x[matrix + 2] * vz,
        x[matrix + 3] * vx + x[matrix + 4] * vy + x[matrix + 5] * vz,
        x[matrix + 6] * vx + x[matrix + 7] * vy + x[matrix + 8] * vz,
    )


@kernel
def rotate_back(x, matrix, vx, vy, vz):
    """Rᵀ v for the rotation matrix that stands in the array `x` at `matrix`."""
    return (
        x[matrix] * vx + x[matrix + 3] * vy + x[matrix + 6] * vz,
        x[matrix + 1] * vx + x[matrix + 4] * vy + x[matrix + 7] * vz,
        x[matrix + 2] * vx + x[matrix + 5] * vy + x[matrix + 8] * vz,
    )


@kernel
def yaw_of(m):
    """The heading (rad) of an attitude: of the order 3-2-1, or 3-1-2 when pitched more than rolled.

    The choice avoids gimbal lock.
    """
    if abs(m[6]) < abs(m[7]):
        return math.atan2(m[3], m[0])
    return math.atan2(-m[1], m[4])


@kernel
def with_yaw(yaw, m):
    """The rotation matrix with its heading replaced by `yaw`, by the same choice as `yaw_of`."""
    c0, s0 = math.cos(yaw), math.sin(yaw)
    if abs(m[6]) < abs(m[7]):
        pitch = math.asin(limit(-m[6], -1.0, 1.0))
        roll = math.atan2(m[7], m[8]) if abs(abs(pitch) - 0.5 * math.pi) >= 1e-3 else 0.0
        c1, s1, c2, s2 = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
        return (
            c1 * c0,
            -c2 * s0 + s2 * s1 * c0,
            s2 * s0 + c2 * s1 * c0,
            c1 * s0,
            c2 * c0 + s2 * s1 * s0,
            -s2 * c0 + c2 * s1 * s0,
            -s1,
            s2 * c1,
            c2 * c1,
        )
    roll = math.asin(limit(m[7], -1.0, 1.0))
    pitch = math.atan2(-m[6], m[8])
    c1, s1, c2, s2 = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return (
        c0 * c2 - s0 * s1 * s2,
        -c1 * s0,
        s2 * c0 + c2 * s1 * s0,
        c2 * s0 + s2 * s1 * c0,
        c0 * c1,
        s0 * s2 - s1 * c0 * c2,
        -s2 * c1,
        s1,
        c2 * c1,
    )


@kernel
def radii(latitude):
    """Radii of curvature (m), along the meridian and across it, at a latitude (rad), as in PX4.

    With w = 1 − e² sin²φ the ellipsoid's meridian has a (1 − e²) / w^1.5. PX4 divides by
    w^2.5, which is 0.4 % more at mid latitudes; the filter must do as PX4 does.
    """
    s = math.sin(latitude)
    w = 1.0 - _ECCENTRICITY_SQUARED * s * s
    root = math.sqrt(w)
    meridian = _EQUATORIAL_RADIUS * (1.0 - _ECCENTRICITY_SQUARED) / (w * w * root)
    return meridian, _EQUATORIAL_RADIUS / root


@kernel
def metres_per_radian(latitude, altitude):
    """Metres north per radian of latitude and metres east per radian of longitude."""
    meridian, transverse = radii(latitude)
    return meridian + altitude, (transverse + altitude) * math.cos(latitude)


@kernel
def normal_gravity(latitude):
    """Gravity (m/s2) on the ellipsoid at a latitude (rad), by Somigliana's formula (WGS84)."""
    s2 = math.sin(latitude) ** 2
    return 9.7803253359 * (1.0 + 0.001931851353 * s2) / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * s2)


@kernel
def project(latitude, longitude, origin_latitude, origin_longitude):
    """Metres north and east of an origin; angles in radians."""
    sin_o, cos_o = math.sin(origin_latitude), math.cos(origin_latitude)
    sin_p, cos_p = math.sin(latitude), math.cos(latitude)
    difference = longitude - origin_longitude
    cos_d = math.cos(difference)
    c = math.acos(limit(sin_o * sin_p + cos_o * cos_p * cos_d, -1.0, 1.0))
    k = c / math.sin(c) if c > 0.0 else 1.0
    return (
        k * (cos_o * sin_p - sin_o * cos_p * cos_d) * EARTH_RADIUS,
        k * cos_p * math.sin(difference) * EARTH_RADIUS,
    )


@kernel
def unproject(north, east, origin_latitude, origin_longitude):
    """The inverse of `project`: latitude and longitude (rad)."""
    n, e = north / EARTH_RADIUS, east / EARTH_RADIUS
    c = math.sqrt(n * n + e * e)
    if c == 0.0:
        return origin_latitude, origin_longitude
    sin_c, cos_c = math.sin(c), math.cos(c)
    sin_o, cos_o = math.sin(origin_latitude), math.cos(origin_latitude)
    return (
        math.asin(cos_c * sin_o + n * sin_c * cos_o / c),
        origin_longitude + math.atan2(e * sin_c, c * cos_o * cos_c - n * sin_o * sin_c),
    )

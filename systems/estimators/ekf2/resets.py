"""Resets: moving a state at once, with its covariance, the output history and the counters."""

import math

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.aiding import north_east_aiding
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import covariance, decorrelate, set_rotation
from systems.estimators.ekf2.geometry import (
    FLOAT_EPSILON,
    matrix_of,
    multiply,
    normalised,
    project,
    quaternion_of,
    unproject,
    with_yaw,
    wrap_pi,
    yaw_of,
)
from systems.estimators.ekf2.output_predictor import shift_output_velocity, turn_output

_LEAST_VARIANCE = 1e-4  # m2 or (m/s)2, of a state after a reset
_MAXIMUM_YAW_CHANGE = 0.3  # rad, the velocity turns with the heading above


@kernel
def local_position(x):
    """North and east (m) of the filter's position from the local origin, or from (0, 0)."""
    if x[at.ORIGIN_SET]:
        return project(
            x[at.LATITUDE], x[at.LONGITUDE], x[at.ORIGIN_LATITUDE], x[at.ORIGIN_LONGITUDE]
        )
    return project(x[at.LATITUDE], x[at.LONGITUDE], 0.0, 0.0)


@kernel
def _first_this_step(x, counter):
    return x[counter] == x[counter + at.RESETS_BEFORE]


@kernel
def _count(x, counter):
    """Count on, in a byte as PX4 does."""
    x[counter] = (x[counter] + 1.0) % 256.0


@kernel
def count_horizontal_position_reset(x, north, east):
    """Note a jump of the horizontal position (m)."""
    if _first_this_step(x, at.R_POSITION_NE):
        x[at.CHANGE_POSITION] = x[at.CHANGE_POSITION + 1] = 0.0
    x[at.CHANGE_POSITION] += north
    x[at.CHANGE_POSITION + 1] += east
    _count(x, at.R_POSITION_NE)


@kernel
def count_vertical_position_reset(x, down):
    """Note a jump of the vertical position (m)."""
    if _first_this_step(x, at.R_POSITION_D):
        x[at.CHANGE_POSITION + 2] = 0.0
    x[at.CHANGE_POSITION + 2] += down
    _count(x, at.R_POSITION_D)


@kernel
def count_terrain_reset(x, down):
    """Note a jump of the terrain (m)."""
    if _first_this_step(x, at.R_TERRAIN):
        x[at.CHANGE_TERRAIN] = 0.0
    x[at.CHANGE_TERRAIN] += down
    _count(x, at.R_TERRAIN)


@kernel
def _shift_vision_bias(x, north, east):
    if x[at.EV_POS]:
        x[at.BIAS_EV_NORTH + at.B_BIAS] -= north
        x[at.BIAS_EV_EAST + at.B_BIAS] -= east


@kernel
def _on_earth(latitude, longitude):
    return abs(latitude) <= 0.5 * math.pi and abs(longitude) <= math.pi


@kernel
def reset_latitude_longitude(x, latitude, longitude, variance_north, variance_east):
    """Move the horizontal position (rad); a variance (m2) that is NaN stays as it is."""
    if not _on_earth(latitude, longitude):
        return
    north, east = local_position(x)
    x[at.LATITUDE] = x[at.OUT_REFERENCE] = latitude
    x[at.LONGITUDE] = x[at.OUT_REFERENCE + 1] = longitude
    new_north, new_east = local_position(x)
    north, east = new_north - north, new_east - east
    count_horizontal_position_reset(x, north, east)
    _shift_vision_bias(x, north, east)
    P = covariance(x)
    if math.isfinite(variance_north):
        decorrelate(P, at.E_POSITION, 1, max(_LEAST_VARIANCE, variance_north))
    if math.isfinite(variance_east):
        decorrelate(P, at.E_POSITION + 1, 1, max(_LEAST_VARIANCE, variance_east))
    x[at.T_HORIZONTAL_POSITION] = x[at.TIME_DELAYED]


@kernel
def reset_horizontal_position(x, north, east, variance_north, variance_east):
    """Move the horizontal position (m from the local origin)."""
    if x[at.ORIGIN_SET]:
        latitude, longitude = unproject(north, east, x[at.ORIGIN_LATITUDE], x[at.ORIGIN_LONGITUDE])
    else:
        latitude, longitude = unproject(north, east, 0.0, 0.0)
    reset_latitude_longitude(x, latitude, longitude, variance_north, variance_east)


@kernel
def reset_to_global_position(x, latitude, longitude, variance):
    """Move the horizontal position to a geodetic one (rad), which also sets the origin if needed.

    If the filter has been navigating already, the origin is laid so that the local
    position stays what it was.
    """
    if not _on_earth(latitude, longitude):
        return
    if x[at.ORIGIN_SET]:
        north, east = local_position(x)
    else:
        north, east = project(x[at.LATITUDE], x[at.LONGITUDE], 0.0, 0.0)
        x[at.ORIGIN_SET] = 1.0
        x[at.ORIGIN_LATITUDE], x[at.ORIGIN_LONGITUDE] = latitude, longitude
        x[at.ORIGIN_TIME] = x[at.TIME_DELAYED]
        if not x[at.HORIZONTAL_EXCEEDED]:
            o_latitude, o_longitude = unproject(-north, -east, latitude, longitude)
            x[at.ORIGIN_LATITUDE], x[at.ORIGIN_LONGITUDE] = o_latitude, o_longitude
    x[at.LATITUDE] = x[at.OUT_REFERENCE] = latitude
    x[at.LONGITUDE] = x[at.OUT_REFERENCE + 1] = longitude
    new_north, new_east = local_position(x)
    north, east = new_north - north, new_east - east
    _shift_vision_bias(x, north, east)
    count_horizontal_position_reset(x, north, east)
    if math.isfinite(variance):
        decorrelate(covariance(x), at.E_POSITION, 2, max(_LEAST_VARIANCE, variance))
    x[at.T_HORIZONTAL_POSITION] = x[at.TIME_DELAYED]


@kernel
def reset_altitude(x, altitude, variance):
    """Move the vertical position (m); the height biases move with it, and the terrain."""
    down = x[at.ALTITUDE] - altitude
    x[at.ALTITUDE] = x[at.OUT_REFERENCE + 2] = altitude
    if math.isfinite(variance):
        decorrelate(covariance(x), at.E_POSITION + 2, 1, max(_LEAST_VARIANCE, variance))
    count_vertical_position_reset(x, down)
    if x[at.BARO_HGT]:
        x[at.BIAS_BARO + at.B_BIAS] += down
    if x[at.EV_HGT]:
        x[at.BIAS_EV_HGT + at.B_BIAS] -= down
    if x[at.GPS_HGT]:
        x[at.BIAS_GNSS_HGT + at.B_BIAS] += down
    count_terrain_reset(x, down)
    x[at.TERRAIN] += down
    x[at.T_HEIGHT] = x[at.TIME_DELAYED]


@kernel
def initialise_altitude(x, altitude, variance):
    """Move the vertical position to an altitude above sea level, setting the origin if needed."""
    if not (-12_000.0 < altitude < 100_000.0):
        return
    if not math.isfinite(x[at.ORIGIN_ALTITUDE]):
        x[at.ORIGIN_ALTITUDE] = altitude
        if not x[at.VERTICAL_POSITION_EXCEEDED]:
            x[at.ORIGIN_ALTITUDE] -= x[at.ALTITUDE]
    reset_altitude(x, altitude, variance)


@kernel
def reset_horizontal_velocity(x, north, east, variance_north, variance_east):
    """Move the horizontal velocity (m/s); a variance that is NaN stays as it is."""
    dn, de = north - x[at.VELOCITY], east - x[at.VELOCITY + 1]
    x[at.VELOCITY], x[at.VELOCITY + 1] = north, east
    P = covariance(x)
    vn = max(_LEAST_VARIANCE, variance_north) if math.isfinite(variance_north) else P[3, 3]
    ve = max(_LEAST_VARIANCE, variance_east) if math.isfinite(variance_east) else P[4, 4]
    pn, pe = P[6, 6], P[7, 7]
    decorrelate(P, at.E_VELOCITY, 1, vn)
    decorrelate(P, at.E_VELOCITY + 1, 1, ve)
    # the position too: without position aiding its correlations would mislead
    decorrelate(P, at.E_POSITION, 1, pn)
    decorrelate(P, at.E_POSITION + 1, 1, pe)
    shift_output_velocity(x, 0, dn)
    shift_output_velocity(x, 1, de)
    if _first_this_step(x, at.R_VELOCITY_NE):
        x[at.CHANGE_VELOCITY] = x[at.CHANGE_VELOCITY + 1] = 0.0
    x[at.CHANGE_VELOCITY] += dn
    x[at.CHANGE_VELOCITY + 1] += de
    _count(x, at.R_VELOCITY_NE)
    x[at.T_HORIZONTAL_VELOCITY] = x[at.TIME_DELAYED]


@kernel
def reset_vertical_velocity(x, down, variance):
    """Move the vertical velocity (m/s); a variance that is NaN stays as it is."""
    change = down - x[at.VELOCITY + 2]
    x[at.VELOCITY + 2] = down
    P = covariance(x)
    if math.isfinite(variance):
        decorrelate(P, at.E_VELOCITY + 2, 1, max(_LEAST_VARIANCE, variance))
    decorrelate(P, at.E_POSITION + 2, 1, P[8, 8])
    shift_output_velocity(x, 2, change)
    if _first_this_step(x, at.R_VELOCITY_D):
        x[at.CHANGE_VELOCITY + 2] = 0.0
    x[at.CHANGE_VELOCITY + 2] += change
    _count(x, at.R_VELOCITY_D)
    x[at.T_VERTICAL_VELOCITY] = x[at.TIME_DELAYED]


@kernel
def reset_vertical_velocity_to_zero(x):
    """Forget the vertical velocity, with a variance that lets it converge quickly."""
    reset_vertical_velocity(x, 0.0, 10.0)


@kernel
def _propagate_attitude_reset(x, b0, b1, b2, b3):
    """Turn everything that hangs on the attitude, which was b before."""
    q = at.QUATERNION
    d0, d1, d2, d3 = multiply(x[q], x[q + 1], x[q + 2], x[q + 3], b0, -b1, -b2, -b3)
    d0, d1, d2, d3 = normalised(d0, d1, d2, d3)
    turn_output(x, d0, d1, d2, d3)
    if x[at.EV_ERROR_SET]:
        e = at.EV_ERROR
        e0, e1, e2, e3 = multiply(d0, d1, d2, d3, x[e], x[e + 1], x[e + 2], x[e + 3])
        x[e], x[e + 1], x[e + 2], x[e + 3] = normalised(e0, e1, e2, e3)
    c = at.CHANGE_QUATERNION
    if _first_this_step(x, at.R_QUATERNION):
        x[c], x[c + 1], x[c + 2], x[c + 3] = d0, d1, d2, d3
    else:
        e0, e1, e2, e3 = multiply(d0, d1, d2, d3, x[c], x[c + 1], x[c + 2], x[c + 3])
        x[c], x[c + 1], x[c + 2], x[c + 3] = normalised(e0, e1, e2, e3)
    _count(x, at.R_QUATERNION)


@kernel
def reset_yaw(x, yaw, variance):
    """Set the heading (rad), keeping roll and pitch."""
    q = at.QUATERNION
    b0, b1, b2, b3 = x[q], x[q + 1], x[q + 2], x[q + 3]
    if math.isfinite(variance) and variance > FLOAT_EPSILON:
        decorrelate(covariance(x), 2, 1, variance)
    before = matrix_of(b0, b1, b2, b3)
    x[q], x[q + 1], x[q + 2], x[q + 3] = quaternion_of(with_yaw(yaw, before))
    set_rotation(x)
    x[at.T_HEADING] = x[at.TIME_DELAYED]
    _propagate_attitude_reset(x, b0, b1, b2, b3)

    change = wrap_pi(yaw - yaw_of(before))
    if not north_east_aiding(x) and abs(change) > _MAXIMUM_YAW_CHANGE:
        P = covariance(x)
        c, s = math.cos(change), math.sin(change)
        vn, ve = x[at.VELOCITY], x[at.VELOCITY + 1]
        variance = max(P[3, 3], P[4, 4])
        reset_horizontal_velocity(x, c * vn - s * ve, s * vn + c * ve, variance, variance)

"""External vision: yaw, velocity, position and height from a camera system, with their biases.

A measurement in NED needs an aligned heading. One in the camera's own frame (FRD,
only the vertical is known) is turned by the low-passed difference of the two
attitudes, unless its yaw is fused too and its frame has become the filter's.
Beside GNSS, vision is relative information: its position carries a bias.
"""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import (
    fuse_bias,
    fuse_height_bias,
    horizontal_sources,
    predict_bias,
    predict_height_bias,
    reset_bias,
)
from systems.estimators.ekf2.buffers import arriving, newest, pop
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    covariance,
    finish_aid,
    fuse_gains,
    fuse_height,
    fuse_horizontal_position,
    fuse_velocity,
    project_covariance,
    set_aid,
    set_height_aid,
    timed_out,
    zero_aid,
)
from systems.estimators.ekf2.geometry import (
    from_rotation_vector,
    limit,
    matrix_of,
    multiply,
    normalised,
    rotate,
    rotate_back,
    sign,
    to_rotation_vector,
    wrap_pi,
    yaw_of,
)
from systems.estimators.ekf2.height import (
    HEIGHT_TIMEOUT,
    SENSOR_EV,
    enabled,
    height_reset_required,
)
from systems.estimators.ekf2.prediction import (
    initialise_covariance,
    reset_gyro_bias_z_covariance,
)
from systems.estimators.ekf2.resets import (
    local_position,
    reset_altitude,
    reset_horizontal_position,
    reset_horizontal_velocity,
    reset_vertical_velocity,
    reset_yaw,
)

_INTERVAL = 200_000.0  # us, longest expected
_NO_AID_TIMEOUT = 1_000_000.0  # us
_BIAS_DENSITY = 0.13  # m/s/√Hz
_RESETS = 5  # available after a start, in the air
_ERROR_ALPHA = 0.01 / (0.01 + 10.0)  # low-pass of 10 s at the nominal filter step
_POSITION, _HEIGHT, _VELOCITY, _YAW = 1, 2, 4, 8  # bits of EKF2_EV_CTRL


@kernel
def _wanted(p, bit):
    return enabled(p, SENSOR_EV) and (int(p[prm.EKF2_EV_CTRL]) & bit) != 0


@kernel
def _update_frame(x, sample, reset):
    """Low-pass the rotation from the camera's frame to the filter's."""
    c, q, e = sample + at.EV_Q, at.QUATERNION, at.EV_ERROR
    d0, d1, d2, d3 = multiply(
        x[q], x[q + 1], x[q + 2], x[q + 3], x[c], -x[c + 1], -x[c + 2], -x[c + 3]
    )
    d0, d1, d2, d3 = normalised(d0, d1, d2, d3)
    if not math.isfinite(d0 + d1 + d2 + d3):
        return
    if reset or not x[at.EV_ERROR_SET]:
        x[e], x[e + 1], x[e + 2], x[e + 3] = d0, d1, d2, d3
        x[at.EV_ERROR_SET] = 1.0
        return
    n0, n1, n2, n3 = multiply(x[e], -x[e + 1], -x[e + 2], -x[e + 3], d0, d1, d2, d3)
    turn = sign(n0) if n0 != 0.0 else 1.0  # the short way round
    rx, ry, rz = to_rotation_vector(turn * n0, turn * n1, turn * n2, turn * n3)
    d0, d1, d2, d3 = from_rotation_vector(_ERROR_ALPHA * rx, _ERROR_ALPHA * ry, _ERROR_ALPHA * rz)
    x[e], x[e + 1], x[e + 2], x[e + 3] = multiply(
        x[e], x[e + 1], x[e + 2], x[e + 3], d0, d1, d2, d3
    )


@kernel
def _lever_arm(p):
    return (
        p[prm.EKF2_EV_POS_X] - p[prm.EKF2_IMU_POS_X],
        p[prm.EKF2_EV_POS_Y] - p[prm.EKF2_IMU_POS_Y],
        p[prm.EKF2_EV_POS_Z] - p[prm.EKF2_IMU_POS_Z],
    )


@kernel
def _alignment_changed(x):
    started_yaw = x[at.EV_YAW] != 0.0 and x[at.EV_YAW + at.BEFORE] == 0.0
    return started_yaw or x[at.YAW_ALIGN] != x[at.YAW_ALIGN + at.BEFORE]


# --- yaw ------------------------------------------------------------------------------------


@kernel
def _fuse_yaw(x, p):
    """Fuse the heading, H = e_z in the global angle error; true if done."""
    aid = at.AID_EV_YAW
    variance, noise = x[aid + at.A_INNOVATION_VARIANCE], x[aid + at.A_VARIANCE]
    if not variance >= noise:
        x[at.BAD_HDG] = 1.0
        initialise_covariance(x, p)
        return False
    x[at.BAD_HDG] = 0.0
    P = covariance(x)
    g = P[2].copy()
    K = g / variance
    if x[aid + at.A_REJECTED]:
        grounded = not x[at.IN_AIR] and timed_out(x, x[at.T_IN_AIR], 5_000_000.0)
        if not grounded or not timed_out(x, x[aid + at.A_LAST_FUSE], 1_000_000.0):
            return False
        # on the ground it may be the gyro bias: pull by no more than the gate, learn it anew
        bound = max(p[prm.EKF2_HDG_GATE], 1.0) * math.sqrt(variance)
        x[aid + at.A_INNOVATION] = limit(x[aid + at.A_INNOVATION], -bound, bound)
        reset_gyro_bias_z_covariance(x, p)
        g = P[2].copy()
    fuse_gains(x, p, K, g, g[2], noise, x[aid + at.A_INNOVATION])
    x[at.T_HEADING] = x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    x[aid + at.A_FUSED] = 1.0
    return True


@kernel
def _reset_to_yaw(x):
    aid = at.AID_EV_YAW
    reset_yaw(x, x[aid + at.A_OBSERVATION], x[aid + at.A_VARIANCE])
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]


@kernel
def _control_yaw(x, p, sample, time, may_start, reset, good):
    aid, c = at.AID_EV_YAW, sample + at.EV_Q
    noise = max(x[sample + at.EV_Q_VAR + 2], p[prm.EKF2_EVA_NOISE] ** 2, 1e-4)
    known = math.isfinite(x[c] + x[c + 1] + x[c + 2] + x[c + 3]) and math.isfinite(noise)
    if known:
        yaw = yaw_of(matrix_of(x[c], x[c + 1], x[c + 2], x[c + 3]))
        R = matrix_of(
            x[at.QUATERNION], x[at.QUATERNION + 1], x[at.QUATERNION + 2], x[at.QUATERNION + 3]
        )
        set_aid(
            x, aid, 0, time, yaw, noise, wrap_pi(yaw_of(R) - yaw),
            covariance(x)[2, 2] + noise, max(p[prm.EKF2_HDG_GATE], 1.0),
        )  # fmt: skip
        finish_aid(x, aid, time)
    if reset:
        x[at.EV_YAW_FAULT] = 0.0
    is_ned = x[sample + at.EV_P_FRAME] == at.FRAME_NED
    gnss = x[at.GNSS_VEL] != 0.0 or x[at.GNSS_POS] != 0.0
    going_on = (
        _wanted(p, _YAW)
        and x[at.TILT_ALIGN] != 0.0
        and x[at.EV_YAW_FAULT] == 0.0
        and known
        and not (gnss and x[at.YAW_ALIGN] != 0.0 and not is_ned)
    )
    if x[at.EV_YAW]:
        if not going_on:
            x[at.EV_YAW] = 0.0
            return
        if reset:
            if not good:
                x[at.EV_YAW] = 0.0
                return
            _reset_to_yaw(x)
        elif good:
            _fuse_yaw(x, p)
        else:
            x[aid + at.A_REJECTED] = 1.0
        if timed_out(x, x[aid + at.A_LAST_FUSE], _NO_AID_TIMEOUT):
            if x[at.EV_YAW_RESETS_LEFT] > 0.0 and good:
                _reset_to_yaw(x)
                if x[at.IN_AIR]:
                    x[at.EV_YAW_RESETS_LEFT] -= 1.0
            else:
                x[at.EV_YAW] = 0.0
        return
    if not (may_start and going_on and timed_out(x, x[aid + at.A_LAST_FUSE], 1_000_000.0)):
        return
    if is_ned and x[at.YAW_ALIGN]:
        x[at.EV_YAW] = _fuse_yaw(x, p)
    else:
        _reset_to_yaw(x)
        x[at.YAW_ALIGN] = is_ned  # the camera's own frame has no north
        x[at.EV_YAW] = 1.0
    if x[at.EV_YAW]:
        x[at.EV_YAW_RESETS_LEFT] = _RESETS


# --- velocity -------------------------------------------------------------------------------


@kernel
def _turned_variances(m, a, b, c):
    """The diagonal of R diag(a, b, c) Rᵀ."""
    return (
        m[0] * m[0] * a + m[1] * m[1] * b + m[2] * m[2] * c,
        m[3] * m[3] * a + m[4] * m[4] * b + m[5] * m[5] * c,
        m[6] * m[6] * a + m[7] * m[7] * b + m[8] * m[8] * c,
    )


@kernel
def _velocity_measurement(x, p, sample, measured, noise):
    """Write velocity (m/s) and variances, in NED or (body frame) FRD; NaN if not usable."""
    rx, ry, rz = _lever_arm(p)
    wx = x[at.IMU_DELTA_ANGLE] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS]
    wy = x[at.IMU_DELTA_ANGLE + 1] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS + 1]
    wz = x[at.IMU_DELTA_ANGLE + 2] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS + 2]
    ox, oy, oz = wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx
    frame = x[sample + at.EV_V_FRAME]
    v, n, q = sample + at.EV_V, sample + at.EV_V_VAR, sample + at.EV_Q_VAR
    vx, vy, vz = x[v], x[v + 1], x[v + 2]
    nx, ny, nz = x[n], x[n + 1], x[n + 2]
    if frame != at.FRAME_BODY:
        ox, oy, oz = rotate(x, at.ROTATION, ox, oy, oz)
    if frame == at.FRAME_NED and not x[at.YAW_ALIGN]:
        vx = math.nan
    if frame == at.FRAME_FRD and not x[at.EV_YAW]:
        m = matrix_of(x[at.EV_ERROR], x[at.EV_ERROR + 1], x[at.EV_ERROR + 2], x[at.EV_ERROR + 3])
        nx, ny, nz = _turned_variances(m, nx, ny, nz)
        # δv = δθ × v of an uncertain attitude
        nx += vz * vz * x[q + 1] + vy * vy * x[q + 2]
        ny += vx * vx * x[q + 2] + vz * vz * x[q]
        nz += vy * vy * x[q] + vx * vx * x[q + 1]
        vx, vy, vz = (
            m[0] * vx + m[1] * vy + m[2] * vz,
            m[3] * vx + m[4] * vy + m[5] * vz,
            m[6] * vx + m[7] * vy + m[8] * vz,
        )
    measured[0], measured[1], measured[2] = vx - ox, vy - oy, vz - oz
    least = max(p[prm.EKF2_EVV_NOISE] ** 2, 1e-4)
    noise[0], noise[1], noise[2] = max(nx, least), max(ny, least), max(nz, least)


@kernel
def _reset_to_velocity(x, measured, noise, body):
    if body:
        vn, ve, vd = rotate(x, at.ROTATION, measured[0], measured[1], measured[2])
        R = at.ROTATION
        m = (x[R], x[R + 1], x[R + 2], x[R + 3], x[R + 4], x[R + 5], x[R + 6], x[R + 7], x[R + 8])
        a, b, c = _turned_variances(m, noise[0], noise[1], noise[2])
        # larger, against correlations that the rotation brings in
        reset_horizontal_velocity(x, vn, ve, 5.0 * a, 5.0 * b)
        reset_vertical_velocity(x, vd, 5.0 * c)
    else:
        reset_horizontal_velocity(x, measured[0], measured[1], noise[0], noise[1])
        reset_vertical_velocity(x, measured[2], noise[2])
    zero_aid(x, at.AID_EV_VEL, 3)


@kernel
def _fuse_body_velocity(x, p, time, measured, noise, gate):
    """Fuse Rᵀ v in the body frame: H_θ = (R e_i) × v, H_v = R e_i."""
    aid = at.AID_EV_VEL
    P = covariance(x)
    R = x[at.ROTATION : at.ROTATION + 9].copy()
    v = x[at.VELOCITY : at.VELOCITY + 3].copy()
    H, g = np.zeros((3, at.ERRORS)), np.empty(at.ERRORS)
    predicted = rotate_back(x, at.ROTATION, v[0], v[1], v[2])
    for i in range(3):
        c0, c1, c2 = R[i], R[3 + i], R[6 + i]
        H[i, 0], H[i, 1], H[i, 2] = (
            c1 * v[2] - c2 * v[1],
            c2 * v[0] - c0 * v[2],
            (c0 * v[1] - c1 * v[0]),
        )
        H[i, 3], H[i, 4], H[i, 5] = c0, c1, c2
        variance = project_covariance(P, H[i], g) + noise[i]
        set_aid(x, aid, i, time, measured[i], noise[i], predicted[i] - measured[i], variance, gate)
    finish_aid(x, aid, time)
    if x[aid + at.A_REJECTED]:
        return False
    for i in range(3):
        a = aid + i * at.A_AXIS
        variance = project_covariance(P, H[i], g)
        if i > 0:
            x[a + at.A_INNOVATION_VARIANCE] = variance + noise[i]
        now = rotate_back(x, at.ROTATION, x[at.VELOCITY], x[at.VELOCITY + 1], x[at.VELOCITY + 2])
        x[a + at.A_INNOVATION] = now[i] - measured[i]
        K = g / x[a + at.A_INNOVATION_VARIANCE]
        fuse_gains(x, p, K, g, variance, noise[i], x[a + at.A_INNOVATION])
    x[aid + at.A_FUSED] = 1.0
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    x[at.T_HORIZONTAL_VELOCITY] = x[at.T_VERTICAL_VELOCITY] = x[at.TIME_DELAYED]
    return True


@kernel
def _fuse_vision_velocity(x, p, time, measured, noise, body, gate):
    if body:
        return _fuse_body_velocity(x, p, time, measured, noise, gate)
    P = covariance(x)
    for i in range(3):
        set_aid(
            x, at.AID_EV_VEL, i, time, measured[i], noise[i], x[at.VELOCITY + i] - measured[i],
            P[3 + i, 3 + i] + noise[i], gate,
        )  # fmt: skip
    finish_aid(x, at.AID_EV_VEL, time)
    return fuse_velocity(x, p, at.AID_EV_VEL)


@kernel
def _control_velocity(x, p, sample, time, may_start, reset, good):
    aid, v = at.AID_EV_VEL, sample + at.EV_V
    measured, noise = np.empty(3), np.empty(3)
    _velocity_measurement(x, p, sample, measured, noise)
    speed2 = x[v] ** 2 + x[v + 1] ** 2 + x[v + 2] ** 2
    body = x[sample + at.EV_V_FRAME] == at.FRAME_BODY
    going_on = (
        _wanted(p, _VELOCITY)
        and x[at.TILT_ALIGN] != 0.0
        and speed2 <= p[prm.EKF2_VEL_LIM] ** 2
        and math.isfinite(measured[0] + measured[1] + measured[2])
        and math.isfinite(noise[0] + noise[1] + noise[2])
    )
    gate = max(p[prm.EKF2_EVV_GATE], 1.0)
    changed = _alignment_changed(x)
    if x[at.EV_VEL]:
        if not going_on:
            x[at.EV_VEL] = 0.0
            return
        only = horizontal_sources(x) <= 1.0
        if (reset and only) or changed:
            if not good:
                x[at.EV_VEL] = 0.0
                return
            _reset_to_velocity(x, measured, noise, body)
        elif good:
            _fuse_vision_velocity(x, p, time, measured, noise, body, gate)
        else:
            x[aid + at.A_REJECTED] = 1.0
        if timed_out(x, x[aid + at.A_LAST_FUSE], _NO_AID_TIMEOUT):
            if x[at.EV_VEL_RESETS_LEFT] > 0.0 and good:
                _reset_to_velocity(x, measured, noise, body)
                if x[at.IN_AIR]:
                    x[at.EV_VEL_RESETS_LEFT] -= 1.0
            else:
                x[at.EV_VEL] = 0.0
        elif height_reset_required(x):
            reset_vertical_velocity(x, measured[2], noise[2])
    elif may_start and going_on:
        aided = horizontal_sources(x) > 0.0
        if not aided or changed:
            _reset_to_velocity(x, measured, noise, body)
            x[at.EV_VEL] = 1.0
        else:
            wide = math.sqrt(10.0) * gate
            x[at.EV_VEL] = _fuse_vision_velocity(x, p, time, measured, noise, body, wide)
        if x[at.EV_VEL]:
            x[at.EV_VEL_RESETS_LEFT] = _RESETS


# --- horizontal position --------------------------------------------------------------------


@kernel
def _reset_position_bias(x):
    reset_bias(x, at.BIAS_EV_NORTH)
    reset_bias(x, at.BIAS_EV_EAST)


@kernel
def _activate_position_bias(x, active):
    x[at.BIAS_EV_NORTH + at.B_ACTIVE] = active
    if active:
        x[at.BIAS_EV_NORTH + at.B_WAS_ACTIVE] = 1.0


@kernel
def _align_position_bias(x, north, east):
    """Set the biases so that the measurement (m) agrees with the filter's position."""
    n, e = local_position(x)
    x[at.BIAS_EV_NORTH + at.B_BIAS] = north - n
    x[at.BIAS_EV_EAST + at.B_BIAS] = east - e


@kernel
def _reset_to_position(x, north, east, variance_north, variance_east):
    """Move the filter to the measurement less its bias."""
    bn, be = at.BIAS_EV_NORTH, at.BIAS_EV_EAST
    reset_horizontal_position(
        x,
        north - x[bn + at.B_BIAS],
        east - x[be + at.B_BIAS],
        variance_north + x[bn + at.B_VARIANCE],
        variance_east + x[be + at.B_VARIANCE],
    )


@kernel
def _position_measurement(x, p, sample):
    """North, east (m) and variances in the filter's frame; also chooses if there is a bias."""
    rx, ry, rz = _lever_arm(p)
    rn, re, _ = rotate(x, at.ROTATION, rx, ry, rz)
    s, n, q = sample + at.EV_P, sample + at.EV_P_VAR, sample + at.EV_Q_VAR
    px, py, pz = x[s], x[s + 1], x[s + 2]
    vx, vy = x[n], x[n + 1]
    is_ned = x[sample + at.EV_P_FRAME] == at.FRAME_NED
    if is_ned and not x[at.YAW_ALIGN]:
        px = py = math.nan
        _activate_position_bias(x, False)
        _reset_position_bias(x)
    elif not is_ned and x[at.EV_YAW]:
        _activate_position_bias(x, False)
        _reset_position_bias(x)
    else:
        if not is_ned:
            e = at.EV_ERROR
            m = matrix_of(x[e], x[e + 1], x[e + 2], x[e + 3])
            vx, vy, _ = _turned_variances(m, x[n], x[n + 1], x[n + 2])
            # δp = δθ × p of an uncertain attitude
            vx += pz * pz * x[q + 1] + py * py * x[q + 2]
            vy += px * px * x[q + 2] + pz * pz * x[q]
            px, py = m[0] * px + m[1] * py + m[2] * pz, m[3] * px + m[4] * py + m[5] * pz
        _activate_position_bias(x, x[at.GNSS_POS] != 0.0)
    least = max(p[prm.EKF2_EVP_NOISE] ** 2, 1e-4)
    if x[at.GNSS_POS]:
        least = max(least, p[prm.EKF2_GPS_P_NOISE] ** 2)
    return px - rn, py - re, max(vx, least), max(vy, least)


@kernel
def _control_position(x, p, sample, time, may_start, reset, good):
    aid, bn, be = at.AID_EV_POS, at.BIAS_EV_NORTH, at.BIAS_EV_EAST
    had_bias = x[bn + at.B_ACTIVE] != 0.0
    north, east, vn, ve = _position_measurement(x, p, sample)
    has_bias = x[bn + at.B_ACTIVE] != 0.0
    valid = math.isfinite(north + east) and math.isfinite(vn + ve)
    n, e = local_position(x)
    if has_bias and not had_bias:
        if good:
            _align_position_bias(x, north, east)
        elif horizontal_sources(x) > x[at.EV_POS]:
            x[at.EV_POS] = 0.0
    P = covariance(x)
    gate = max(p[prm.EKF2_EVP_GATE], 1.0)
    rn, re = vn + x[bn + at.B_VARIANCE], ve + x[be + at.B_VARIANCE]
    on, oe = north - x[bn + at.B_BIAS], east - x[be + at.B_BIAS]
    set_aid(x, aid, 0, time, on, rn, n - on, P[6, 6] + rn, gate)
    set_aid(x, aid, 1, time, oe, re, e - oe, P[7, 7] + re, gate)
    finish_aid(x, aid, time)
    if valid and good and has_bias:
        fuse_bias(x, bn, north - n, vn + P[6, 6], _BIAS_DENSITY, math.sqrt(vn))
        fuse_bias(x, be, east - e, ve + P[7, 7], _BIAS_DENSITY, math.sqrt(ve))

    going_on = _wanted(p, _POSITION) and x[at.TILT_ALIGN] != 0.0 and valid
    if x[at.EV_POS]:
        if going_on:
            jump = reset or _alignment_changed(x) or had_bias != has_bias
            _continue_position(x, p, north, east, vn, ve, good, jump)
        else:
            x[at.EV_POS] = 0.0
    elif may_start and going_on:
        if x[at.GNSS_POS]:
            _align_position_bias(x, north, east)
            _activate_position_bias(x, True)
        elif x[bn + at.B_WAS_ACTIVE]:
            _reset_to_position(x, north, east, vn, ve)
        else:
            reset_horizontal_position(x, north, east, vn, ve)
            _reset_position_bias(x)
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
        x[at.EV_POS_RESETS_LEFT] = _RESETS
        x[at.EV_POS] = 1.0


@kernel
def _continue_position(x, p, north, east, vn, ve, good, jump):
    aid = at.AID_EV_POS
    if jump:
        if not good:
            x[at.EV_POS] = 0.0
            return
        if not x[at.GNSS_POS]:
            _reset_to_position(x, north, east, vn, ve)
        _align_position_bias(x, north, east)
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    elif good:
        fuse_horizontal_position(x, p, aid)
    else:
        x[aid + at.A_REJECTED] = 1.0
    if not timed_out(x, x[aid + at.A_LAST_FUSE], _NO_AID_TIMEOUT):
        return
    if not (x[at.EV_POS_RESETS_LEFT] > 0.0 and good):
        x[at.EV_POS] = 0.0
        return
    held = x[at.GNSS_POS] != 0.0 and not timed_out(x, x[at.T_HORIZONTAL_POSITION], _NO_AID_TIMEOUT)
    if not held:
        _reset_to_position(x, north, east, vn, ve)
    _align_position_bias(x, north, east)
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    if x[at.IN_AIR]:
        x[at.EV_POS_RESETS_LEFT] -= 1.0


# --- height ---------------------------------------------------------------------------------


@kernel
def _stop_height(x):
    if x[at.EV_HGT]:
        if x[at.HEIGHT_REFERENCE] == at.EV:
            x[at.HEIGHT_REFERENCE] = at.UNKNOWN
        x[at.BIAS_EV_HGT + at.B_ACTIVE] = 0.0
        x[at.EV_HGT] = 0.0


@kernel
def _height_measurement(x, p, sample):
    """Down (m) and its variance in the filter's frame."""
    s, n, q = sample + at.EV_P, sample + at.EV_P_VAR, sample + at.EV_Q_VAR
    rx, ry, rz = _lever_arm(p)
    _, _, rd = rotate(x, at.ROTATION, rx, ry, rz)
    down, variance = x[s + 2], x[n + 2]
    own_frame = x[at.EV_YAW] != 0.0 and x[at.EV_POS] != 0.0
    if not own_frame and x[sample + at.EV_P_FRAME] == at.FRAME_FRD:
        e = at.EV_ERROR
        m = matrix_of(x[e], x[e + 1], x[e + 2], x[e + 3])
        down = m[6] * x[s] + m[7] * x[s + 1] + m[8] * x[s + 2]
        _, _, variance = _turned_variances(m, x[n], x[n + 1], x[n + 2])
        variance += x[s + 1] ** 2 * x[q] + x[s] ** 2 * x[q + 1]
    variance = max(variance, p[prm.EKF2_EVP_NOISE] ** 2, 1e-4)
    if x[at.GPS_HGT]:
        variance = max(variance, p[prm.EKF2_GPS_P_NOISE] ** 2)
    return down - rd, variance


@kernel
def _control_height(x, p, sample, time, may_start, reset, good):
    aid, bias = at.AID_EV_HGT, at.BIAS_EV_HGT
    down, variance = _height_measurement(x, p, sample)
    valid = math.isfinite(down) and math.isfinite(variance)
    set_height_aid(
        x, aid, time, down - x[bias + at.B_BIAS], variance + x[bias + at.B_VARIANCE],
        max(p[prm.EKF2_EVP_GATE], 1.0),
    )  # fmt: skip
    if valid and good:
        fuse_height_bias(
            x, bias, at.EV, down + x[at.ALTITUDE],
            variance + covariance(x)[8, 8], _BIAS_DENSITY, math.sqrt(variance),
        )  # fmt: skip
    going_on = _wanted(p, _HEIGHT) and valid
    if x[at.EV_HGT]:
        if going_on:
            _continue_height(x, p, down, variance, reset, good)
        else:
            _stop_height(x)
    elif may_start and going_on:
        if p[prm.EKF2_HGT_REF] == at.EV:
            reset_altitude(x, -down, variance)
            x[at.HEIGHT_REFERENCE] = at.EV
            reset_bias(x, bias)
        else:
            x[bias + at.B_BIAS] = x[at.ALTITUDE] + down
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
        x[bias + at.B_ACTIVE] = 1.0
        x[at.EV_HGT] = 1.0


@kernel
def _continue_height(x, p, down, variance, reset, good):
    aid, bias = at.AID_EV_HGT, at.BIAS_EV_HGT
    if reset:
        if not good:
            _stop_height(x)
            return
        if x[at.HEIGHT_REFERENCE] == at.EV:
            reset_altitude(x, -down, variance)
            reset_bias(x, bias)
        else:
            x[bias + at.B_BIAS] = x[at.ALTITUDE] + down
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    elif good:
        fuse_height(x, p, aid)
    else:
        x[aid + at.A_REJECTED] = 1.0
    failing = timed_out(x, x[aid + at.A_LAST_FUSE], HEIGHT_TIMEOUT)
    if height_reset_required(x) and good and x[at.HEIGHT_REFERENCE] == at.EV:
        reset_altitude(x, -down - x[bias + at.B_BIAS], variance)
        x[bias + at.B_BIAS] = x[at.ALTITUDE] + down
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    elif failing:
        _stop_height(x)


@kernel
def control_external_vision(x, p):
    """Check and fuse a vision sample that the horizon has reached."""
    if x[at.BIAS_EV_NORTH + at.B_ACTIVE]:
        predict_bias(x, at.BIAS_EV_NORTH, x[at.DT_AVERAGE])
        predict_bias(x, at.BIAS_EV_EAST, x[at.DT_AVERAGE])
    predict_height_bias(x, at.BIAS_EV_HGT, at.EV)
    sample = pop(x, at.RING_EV, x[at.TIME_DELAYED])
    if sample < 0:
        fused = x[at.EV_POS] or x[at.EV_VEL] or x[at.EV_YAW] or x[at.EV_HGT]
        if fused and timed_out(x, x[at.EV_PREVIOUS_TIME], 2 * _INTERVAL):
            x[at.EV_POS] = x[at.EV_VEL] = x[at.EV_YAW] = 0.0
            _stop_height(x)
            x[at.EV_ERROR_SET] = 0.0
        return
    time = x[at.RING_EV + at.RING_POPPED_TIME]
    least = p[prm.EKF2_EV_QMIN]
    quality = x[sample + at.EV_QUALITY]
    reset = x[sample + at.EV_RESETS] != x[at.EV_PREVIOUS_RESETS]
    good = least <= 0.0 or quality >= least
    latest = x[newest(x, at.RING_EV) + at.EV_QUALITY]
    may_start = (
        good
        and time - x[at.EV_PREVIOUS_TIME] < _INTERVAL
        and (least <= 0.0 or (x[at.EV_PREVIOUS_QUALITY] >= least and latest >= least))
        and arriving(x, at.RING_EV, _INTERVAL)
    )
    _update_frame(x, sample, reset)
    _control_yaw(x, p, sample, time, may_start, reset, good)
    _control_velocity(x, p, sample, time, may_start, reset, good)
    _control_position(x, p, sample, time, may_start, reset, good)
    _control_height(x, p, sample, time, may_start, reset, good)
    if good:
        x[at.EV_PREVIOUS_TIME] = time
        x[at.EV_PREVIOUS_RESETS] = x[sample + at.EV_RESETS]
        x[at.EV_PREVIOUS_QUALITY] = quality
        x[at.EV_PREVIOUS_POSITION_FRAME] = x[sample + at.EV_P_FRAME]
        x[at.EV_PREVIOUS_VELOCITY_FRAME] = x[sample + at.EV_V_FRAME]

"""The magnetometer: heading at the start, then three axes, and the declination without a north.

Predicted is Rᵀ m_I + m_B. As "heading" (`mag_hdg`) only the heading, its gyro bias and
the fields are corrected, as `mag_3D` (after the alignment in flight) the tilt too,
and with neither flag only the fields are learnt.
"""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import north_east_aiding
from systems.estimators.ekf2.buffers import arriving, pop
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    covariance,
    decorrelate,
    finish_aid,
    fuse_gains,
    project_covariance,
    set_aid,
    timed_out,
    zero_aid,
)
from systems.estimators.ekf2.geometry import (
    FLOAT_EPSILON,
    limit,
    rotate,
    rotate_back,
    sign,
    with_yaw,
    wrap_pi,
    yaw_of,
)
from systems.estimators.ekf2.height import SENSOR_MAG, enabled
from systems.estimators.ekf2.resets import reset_yaw

_INTERVAL = 500_000.0  # us, longest expected
_RESET_TIMEOUT = 7_000_000.0  # us
_MODEL_INTERVAL = 10_000_000.0  # us, between two looks at the world magnetic model
_CHECK_TIME = 1_000_000.0  # us, the field must have passed its checks for so long
_SENSOR_ALPHA = 0.01 / (0.01 + 0.09)  # low-pass of 0.09 s at the nominal filter step
_LEAST_CHANGE = 0.01  # gauss, of the earth field that is worth a reset
_LEAST_VARIANCE = 1e-6  # gauss2
_ANOMALY_HEIGHT = 1.5  # m above the ground, free of local disturbances
_DECLINATION_VARIANCE = 0.25  # rad2
_MEAN_STRENGTH, _MEAN_TOLERANCE = 0.45, 0.40  # gauss, of the earth's field anywhere
_MAXIMUM_HEADING_RATE = math.radians(1.0)  # rad/s, by which the fusion may turn the heading
_AUTO, _HEADING, _NONE, _INIT = 0, 1, 5, 6  # EKF2_MAG_TYPE


@kernel
def _attitude(x):
    R = at.ROTATION
    return (
        x[R], x[R + 1], x[R + 2], x[R + 3], x[R + 4], x[R + 5], x[R + 6], x[R + 7], x[R + 8],
    )  # fmt: skip


@kernel
def _norm(a, b, c):
    return math.sqrt(a * a + b * b + c * c)


@kernel
def _reset_earth_covariance(x, p):
    decorrelate(covariance(x), at.E_MAG_EARTH, 3, p[prm.EKF2_MAG_NOISE] ** 2)


@kernel
def _reset_body_covariance(x, p):
    decorrelate(covariance(x), at.E_MAG_BODY, 3, p[prm.EKF2_MAG_NOISE] ** 2)


@kernel
def stop_magnetometer(x, p):
    """Stop fusing the magnetometer; without another north the heading is not aligned any more."""
    if not x[at.MAG]:
        return
    _reset_earth_covariance(x, p)
    _reset_body_covariance(x, p)
    used = x[at.MAG_3D] or x[at.MAG_HDG]
    if x[at.YAW_ALIGN] and used and not north_east_aiding(x):
        x[at.YAW_ALIGN] = 0.0
    if x[at.MAG_HDG]:
        x[at.BAD_HDG] = 0.0
    x[at.MAG] = x[at.MAG_DEC] = x[at.MAG_3D] = x[at.MAG_HDG] = 0.0
    x[at.MAG_ALIGNED_IN_FLIGHT] = 0.0
    x[at.BAD_MAG] = x[at.BAD_MAG + 1] = x[at.BAD_MAG + 2] = x[at.BAD_MAG_DECL] = 0.0


@kernel
def update_world_model(x, p):
    """Read the world magnetic model; true if it differs from what was known."""
    declination, inclination = p[prm.WORLD_DECLINATION], p[prm.WORLD_INCLINATION]
    strength = p[prm.WORLD_STRENGTH]
    if not math.isfinite(declination + inclination + strength):
        return False
    degree = math.radians(1.0)
    same = (
        abs(declination - x[at.WORLD_DECLINATION]) <= degree
        and abs(inclination - x[at.WORLD_INCLINATION]) <= degree
        and abs(strength - x[at.WORLD_STRENGTH]) <= 0.01
    )
    if same:
        return False
    x[at.WORLD_DECLINATION], x[at.WORLD_INCLINATION] = declination, inclination
    x[at.WORLD_STRENGTH] = strength
    horizontal = strength * math.cos(inclination)
    x[at.WORLD_FIELD] = horizontal * math.cos(declination)
    x[at.WORLD_FIELD + 1] = horizontal * math.sin(declination)
    x[at.WORLD_FIELD + 2] = strength * math.sin(inclination)
    return True


@kernel
def _look_at_world_model(x, p):
    """Read the model when there is a new origin, and every 10 s."""
    if not x[at.ORIGIN_SET]:
        return False
    new_origin = x[at.ORIGIN_TIME] > x[at.AID_MAG + at.A_LAST_FUSE]
    due = not x[at.HORIZONTAL_EXCEEDED] and timed_out(x, x[at.T_WORLD_MODEL], _MODEL_INTERVAL)
    if not new_origin and not due:
        return False
    x[at.T_WORLD_MODEL] = x[at.TIME_DELAYED]
    return update_world_model(x, p)


@kernel
def _world_field_known(x):
    w = at.WORLD_FIELD
    return x[w] != 0.0 or x[w + 1] != 0.0 or x[w + 2] != 0.0


@kernel
def _declination(x, p):
    """The declination (rad) that headings are computed with."""
    if x[at.MAG_ALIGNED_IN_FLIGHT]:
        return math.atan2(x[at.MAG_EARTH + 1], x[at.MAG_EARTH])
    kind = int(p[prm.EKF2_DECL_TYPE])
    if (kind & 1) != 0 and math.isfinite(x[at.WORLD_DECLINATION]):
        return x[at.WORLD_DECLINATION]
    if (kind & 2) != 0:
        return math.radians(p[prm.EKF2_MAG_DECL])
    return 0.0


@kernel
def _measured_heading(x, p, mx, my, mz):
    """The heading (rad) that a field (gauss, FRD) shows at the present tilt."""
    P = covariance(x)
    least, most = math.inf, 0.0
    for i in range(at.E_MAG_BODY, at.E_MAG_BODY + 3):
        least, most = min(least, P[i, i]), max(most, P[i, i])
    if least > 0.0 and most <= p[prm.EKF2_MAG_NOISE] ** 2:
        mx -= x[at.MAG_BODY]
        my -= x[at.MAG_BODY + 1]
        mz -= x[at.MAG_BODY + 2]
    R = with_yaw(0.0, _attitude(x))
    north = R[0] * mx + R[1] * my + R[2] * mz
    east = R[3] * mx + R[4] * my + R[5] * mz
    return _declination(x, p) - math.atan2(east, north)


@kernel
def _reset_heading(x, p):
    b = at.MAG_LPF
    yaw = _measured_heading(x, p, x[b], x[b + 1], x[b + 2])
    reset_yaw(x, yaw, max(p[prm.EKF2_HEAD_NOISE] ** 2, 1e-4))
    x[at.MAG_HEADING_LPF] = 0.0
    x[at.MAG_HEADING_CONSISTENT] = 1.0


@kernel
def _set_earth_field(x, p, mn, me, md):
    """Replace the earth field unless the change is negligible; true if done."""
    e = at.MAG_EARTH
    if not _norm(x[e] - mn, x[e + 1] - me, x[e + 2] - md) > _LEAST_CHANGE:
        return False
    x[e], x[e + 1], x[e + 2] = mn, me, md
    _reset_earth_covariance(x, p)
    return True


@kernel
def _zero_body_field(x, p):
    x[at.MAG_BODY] = x[at.MAG_BODY + 1] = x[at.MAG_BODY + 2] = 0.0
    _reset_body_covariance(x, p)


@kernel
def _reset_fields(x, p, reset_heading):
    """Set the fields, by the world model if it is known, and the heading if asked."""
    b = at.MAG_LPF
    if _world_field_known(x):
        wn, we, wd = x[at.WORLD_FIELD], x[at.WORLD_FIELD + 1], x[at.WORLD_FIELD + 2]
        changed = _set_earth_field(x, p, wn, we, wd)
        if reset_heading or not x[at.YAW_ALIGN]:
            _zero_body_field(x, p)
        elif changed:
            bx, by, bz = rotate_back(x, at.ROTATION, wn, we, wd)
            x[at.MAG_BODY] = x[b] - bx
            x[at.MAG_BODY + 1] = x[b + 1] - by
            x[at.MAG_BODY + 2] = x[b + 2] - bz
            _reset_body_covariance(x, p)
        if reset_heading:
            _reset_heading(x, p)
    else:
        _zero_body_field(x, p)
        if reset_heading:
            _reset_heading(x, p)
        mn, me, md = rotate(x, at.ROTATION, x[b], x[b + 1], x[b + 2])
        _set_earth_field(x, p, mn, me, md)


@kernel
def _check_heading(x, p, mx, my, mz):
    """Whether the heading of the magnetometer agrees with the filter's, seen while it is known."""
    error = wrap_pi(yaw_of(_attitude(x)) - _measured_heading(x, p, mx, my, mz))
    if x[at.YAW_ALIGN]:
        x[at.MAG_HEADING_LPF] += _SENSOR_ALPHA * (error - x[at.MAG_HEADING_LPF])
    else:
        error = 0.0
        x[at.MAG_HEADING_LPF] = 0.0
    bound = p[prm.EKF2_HEAD_NOISE]
    if abs(x[at.MAG_HEADING_LPF]) < bound and abs(error) < bound:
        h, least = at.ACCEL_HORIZONTAL_LPF, p[prm.EKF2_MAG_ACCLIM]
        if north_east_aiding(x) and x[h] ** 2 + x[h + 1] ** 2 > least * least:
            x[at.MAG_HEADING_CONSISTENT] = 1.0
    else:
        x[at.MAG_HEADING_CONSISTENT] = 0.0


@kernel
def _check_field(x, p, mx, my, mz):
    """Whether strength and inclination have been plausible for a second."""
    x[at.MAG_FIELD_DISTURBED] = 0.0
    checks = int(p[prm.EKF2_MAG_CHECK])
    if checks == 0:
        return True
    force_model = (checks & 4) != 0
    failing = False
    strength = _norm(mx, my, mz)
    if (checks & 1) != 0:
        expected, tolerance = x[at.WORLD_STRENGTH], p[prm.EKF2_MAG_CHK_STR]
        known = math.isfinite(expected)
        if not known:
            expected, tolerance = _MEAN_STRENGTH, _MEAN_TOLERANCE
        if not known and force_model:
            failing = True
        elif not abs(strength - expected) <= tolerance:
            x[at.MAG_FIELD_DISTURBED] = 1.0
            failing = True
    if (checks & 2) != 0:
        _, _, down = rotate(x, at.ROTATION, mx, my, mz)
        inclination = math.asin(limit(down / max(strength, 1e-4), -1.0, 1.0))
        if math.isfinite(x[at.WORLD_INCLINATION]):
            error = wrap_pi(inclination - x[at.WORLD_INCLINATION])
            if abs(error) > math.radians(p[prm.EKF2_MAG_CHK_INC]):
                x[at.MAG_FIELD_DISTURBED] = 1.0
                failing = True
        elif force_model:
            failing = True
    if failing or x[at.T_MAG_CHECK_FAILING] == 0.0:
        x[at.T_MAG_CHECK_FAILING] = x[at.TIME_DELAYED]
    return x[at.TIME_DELAYED] - x[at.T_MAG_CHECK_FAILING] > _CHECK_TIME


@kernel
def _keep_gains(K, all_states, tilt):
    """Zero the gains that this mode of fusion must not use."""
    if not all_states:
        K[: at.E_MAG_EARTH] = 0.0
        K[at.E_WIND :] = 0.0
    elif not tilt:
        K[0] = K[1] = 0.0
        K[at.E_GYRO_BIAS] = K[at.E_GYRO_BIAS + 1] = 0.0


@kernel
def _fill_matrix(H, R, m, axis):
    """Write the observation matrix of one axis: H_θ = (R e_i) × m_I, H_I = R e_i, H_B = e_i."""
    c0, c1, c2 = R[axis], R[3 + axis], R[6 + axis]
    H[:] = 0.0
    H[0] = c1 * m[2] - c2 * m[1]
    H[1] = c2 * m[0] - c0 * m[2]
    H[2] = c0 * m[1] - c1 * m[0]
    H[at.E_MAG_EARTH], H[at.E_MAG_EARTH + 1], H[at.E_MAG_EARTH + 2] = c0, c1, c2
    H[at.E_MAG_BODY + axis] = 1.0


@kernel
def _fuse_field(x, p, measured, noise, all_states, tilt):
    """Fuse the three axes one after the other, linearised at the state before; true if done."""
    aid = at.AID_MAG
    if x[aid + at.A_REJECTED]:
        return False
    turn_left = 0.0
    if all_states:
        since = (x[at.TIME_DELAYED] - x[at.T_HEADING]) * 1e-6
        turn_left = _MAXIMUM_HEADING_RATE * limit(since, 1e-4, 0.2)
    R = x[at.ROTATION : at.ROTATION + 9].copy()
    m = x[at.MAG_EARTH : at.MAG_EARTH + 3].copy()
    H, g = np.empty(at.ERRORS), np.empty(at.ERRORS)
    P = covariance(x)
    for i in range(3):
        if i == 2 and x[at.SYNTHETIC_MAG_Z]:
            continue
        _fill_matrix(H, R, m, i)
        predicted = project_covariance(P, H, g)
        a = aid + i * at.A_AXIS
        if i > 0:
            e = at.MAG_EARTH
            field = rotate_back(x, at.ROTATION, x[e], x[e + 1], x[e + 2])
            x[a + at.A_INNOVATION_VARIANCE] = predicted + noise
            x[a + at.A_INNOVATION] = field[i] + x[at.MAG_BODY + i] - measured[i]
        innovation = x[a + at.A_INNOVATION]
        if x[a + at.A_INNOVATION_VARIANCE] < noise:
            if all_states:
                decorrelate(P, 0, 2, max(p[prm.EKF2_ANGERR_INIT], 0.01) ** 2)
                decorrelate(P, 2, 1, p[prm.EKF2_HEAD_NOISE] ** 2)
            _reset_earth_covariance(x, p)
            _reset_body_covariance(x, p)
            return False
        K = g / x[a + at.A_INNOVATION_VARIANCE]
        _keep_gains(K, all_states, tilt)
        turn = abs(K[2] * innovation)
        if turn > turn_left:
            K *= turn_left / max(turn, FLOAT_EPSILON)
            turn_left = 0.0
        else:
            turn_left -= turn
        fuse_gains(x, p, K, g, predicted, noise, innovation)
    x[at.BAD_MAG] = x[at.BAD_MAG + 1] = x[at.BAD_MAG + 2] = 0.0
    x[aid + at.A_FUSED] = 1.0
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    if all_states:
        x[at.T_HEADING] = x[at.TIME_DELAYED]
    return True


@kernel
def _fuse_declination(x, p, declination, all_states, tilt):
    """Fuse the declination (rad): atan2(m_E, m_N) of the earth field."""
    mn, me = x[at.MAG_EARTH], x[at.MAG_EARTH + 1]
    mn += FLOAT_EPSILON * (sign(mn) + 0.5)
    length2 = mn * mn + me * me
    H, g = np.zeros(at.ERRORS), np.empty(at.ERRORS)
    H[at.E_MAG_EARTH] = -me / length2
    H[at.E_MAG_EARTH + 1] = mn / length2
    predicted = project_covariance(covariance(x), H, g)
    variance = predicted + _DECLINATION_VARIANCE
    if variance < _DECLINATION_VARIANCE:
        x[at.BAD_MAG_DECL] = 1.0
        return
    K = g / variance
    _keep_gains(K, all_states, tilt)
    innovation = wrap_pi(math.atan2(me, mn) - declination)
    fuse_gains(x, p, K, g, predicted, _DECLINATION_VARIANCE, innovation)
    x[at.BAD_MAG_DECL] = 0.0


@kernel
def _control_declination(x, p, all_states, tilt):
    kind = int(p[prm.EKF2_DECL_TYPE])
    if (kind & 1) != 0 and math.isfinite(x[at.WORLD_DECLINATION]):
        _fuse_declination(x, p, x[at.WORLD_DECLINATION], all_states, tilt)
    elif (kind & 2) != 0 and abs(p[prm.EKF2_MAG_DECL]) > 0.0:
        _fuse_declination(x, p, math.radians(p[prm.EKF2_MAG_DECL]), all_states, tilt)
    else:
        _fuse_declination(x, p, 0.0, False, False)


@kernel
def _above_anomalies(x):
    """Whether the vehicle has climbed away from the ground and not yet aligned in flight."""
    if not x[at.IN_AIR] or not x[at.YAW_ALIGN] or x[at.MAG_ALIGNED_IN_FLIGHT]:
        return False
    ground = x[at.TERRAIN] if x[at.RNG_TERRAIN_VALID] else x[at.LAST_GROUND_DOWN]
    return ground + x[at.ALTITUDE] > _ANOMALY_HEIGHT


@kernel
def _synthetic_z(x, mx, my):
    """The z component that the model's strength leaves, signed as the attitude predicts."""
    w = at.WORLD_FIELD
    rest = x[w] ** 2 + x[w + 1] ** 2 + x[w + 2] ** 2 - mx * mx - my * my
    size = math.sqrt(max(rest, 0.0))
    R = at.ROTATION
    predicted = x[w] * x[R + 2] + x[w + 1] * x[R + 5] + x[w + 2] * x[R + 8]
    return -size if predicted < 0.0 else size


@kernel
def _choose_mode(x, p):
    """Set `mag_3D`, `mag_hdg` and `mag_dec`."""
    kind = int(p[prm.EKF2_MAG_TYPE])
    aided = north_east_aiding(x)
    consistent = x[at.MAG_HEADING_CONSISTENT] != 0.0 or not aided
    usable = (
        x[at.MAG] != 0.0
        and ((x[at.YAW_ALIGN] != 0.0 and consistent) or x[at.YAW_ALIGN] == 0.0)
        and x[at.MAG_FAULT] == 0.0
        and x[at.MAG_FIELD_DISTURBED] == 0.0
        and x[at.EV_YAW] == 0.0
        and (x[at.YAW_MANUAL] == 0.0 or x[at.MAG_ALIGNED_IN_FLIGHT] != 0.0)
        and x[at.CONSTANT_POS] == 0.0
    )
    in_flight = x[at.MAG_ALIGNED_IN_FLIGHT] != 0.0
    x[at.MAG_3D] = usable and kind == _AUTO and in_flight
    x[at.MAG_HDG] = usable and (kind == _HEADING or (kind == _AUTO and not in_flight))
    x[at.MAG_DEC] = x[at.MAG] != 0.0 and (not aided or x[at.AT_REST] != 0.0)


@kernel
def _continue(x, p, measured, noise, model_changed):
    aid = at.AID_MAG
    no_north = not north_east_aiding(x) or x[at.AT_REST] != 0.0
    used = x[at.MAG_HDG] != 0.0 or x[at.MAG_3D] != 0.0
    if _above_anomalies(x) and (used or x[at.YAW_MANUAL]):
        _reset_fields(x, p, used and not north_east_aiding(x))
        x[at.MAG_ALIGNED_IN_FLIGHT] = 1.0
        x[at.MAG_ALIGN_TIME] = x[at.TIME_DELAYED]
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    elif model_changed and no_north:
        _reset_fields(x, p, used)
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    else:
        tilt = x[at.MAG_3D] != 0.0
        _fuse_field(x, p, measured, noise, used, tilt)
        if used and tilt:
            for i in range(3):
                variance = x[aid + i * at.A_AXIS + at.A_INNOVATION_VARIANCE]
                x[at.BAD_MAG + i] = variance < noise
        if x[at.MAG_DEC]:
            _control_declination(x, p, used, tilt)
    if timed_out(x, x[aid + at.A_LAST_FUSE], _RESET_TIMEOUT):
        if no_north:
            _reset_fields(x, p, x[at.MAG_HDG] != 0.0 or x[at.MAG_3D] != 0.0)
            x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
        else:
            stop_magnetometer(x, p)


@kernel
def _start(x, p, measured, noise, model_changed):
    aid, P = at.AID_MAG, covariance(x)
    e = at.MAG_EARTH
    lost = x[e] == 0.0 and x[e + 1] == 0.0 and x[e + 2] == 0.0
    for i in range(at.E_MAG_EARTH, at.E_MAG_EARTH + 6):
        lost = lost or P[i, i] < _LEAST_VARIANCE
    if not x[at.YAW_ALIGN] or model_changed or lost:
        reset_heading = x[at.YAW_ALIGN] == 0.0
        _reset_fields(x, p, reset_heading)
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
        if reset_heading:
            x[at.YAW_ALIGN] = 1.0
            zero_aid(x, aid, 3)
        x[at.MAG] = 1.0
    elif _fuse_field(x, p, measured, noise, False, False):
        x[at.MAG] = 1.0


@kernel
def control_magnetometer(x, p):
    """Check and fuse a field that the horizon has reached."""
    if x[at.IN_AIR] and not x[at.IN_AIR + at.BEFORE]:
        x[at.MAG_ALIGNED_IN_FLIGHT] = 0.0
    kind = int(p[prm.EKF2_MAG_TYPE])
    if not enabled(p, SENSOR_MAG) or kind == _NONE:
        stop_magnetometer(x, p)
        return
    sample = pop(x, at.RING_MAG, x[at.TIME_DELAYED])
    if sample < 0:
        if not arriving(x, at.RING_MAG, 2 * _INTERVAL):
            stop_magnetometer(x, p)
        return
    time = x[at.RING_MAG + at.RING_POPPED_TIME]
    measured = x[sample + 1 : sample + 4].copy()
    if x[sample + 4] or x[at.MAG_COUNT] == 0.0:
        x[at.MAG_FAULT] = 0.0
        _zero_body_field(x, p)
        stop_magnetometer(x, p)
        for i in range(3):
            x[at.MAG_LPF + i] = measured[i]
        x[at.MAG_COUNT] = 1.0
        if not x[at.IN_AIR]:
            x[at.YAW_ALIGN] = 0.0
    else:
        for i in range(3):
            x[at.MAG_LPF + i] += _SENSOR_ALPHA * (measured[i] - x[at.MAG_LPF + i])
        x[at.MAG_COUNT] += 1.0

    model_changed = _look_at_world_model(x, p)
    synthetic = (
        p[prm.EKF2_SYNT_MAG_Z] != 0.0
        and (int(p[prm.EKF2_DECL_TYPE]) & 1) != 0
        and _world_field_known(x)
    )
    x[at.SYNTHETIC_MAG_Z] = synthetic
    if synthetic:
        measured[2] = _synthetic_z(x, measured[0], measured[1])

    x[at.BAD_MAG] = x[at.BAD_MAG + 1] = x[at.BAD_MAG + 2] = 0.0
    noise = max(p[prm.EKF2_MAG_NOISE] ** 2, 1e-4)
    _test_field(x, p, time, measured, noise)

    length = _norm(measured[0], measured[1], measured[2])
    aligned = x[at.YAW_ALIGN]
    going_on = (
        kind in (_AUTO, _HEADING, _INIT)
        and x[at.TILT_ALIGN] != 0.0
        and (aligned != 0.0 or x[at.EV_YAW] == 0.0)
        and length > 0.0
        and math.isfinite(length)
    )
    starting = (
        going_on
        and _check_field(x, p, measured[0], measured[1], measured[2])
        and x[at.MAG_COUNT] > 3.0
        and aligned == x[at.YAW_ALIGN + at.BEFORE]
        and x[at.R_QUATERNION] == x[at.R_QUATERNION + at.RESETS_BEFORE]
        and arriving(x, at.RING_MAG, _INTERVAL)
    )
    _check_heading(x, p, measured[0], measured[1], measured[2])
    if (
        x[at.MAG_FAULT]
        and x[at.MAG_HEADING_CONSISTENT]
        and x[at.MAG]
        and timed_out(x, x[at.T_HEADING], _RESET_TIMEOUT)
    ):
        x[at.MAG_FAULT] = 0.0
    _choose_mode(x, p)
    if x[at.MAG]:
        if going_on and x[at.YAW_ALIGN]:
            _continue(x, p, measured, noise, model_changed)
        else:
            stop_magnetometer(x, p)
    elif starting:
        _start(x, p, measured, noise, model_changed)


@kernel
def _test_field(x, p, time, measured, noise):
    """Put the innovations of all three axes into the status."""
    e = at.MAG_EARTH
    R = x[at.ROTATION : at.ROTATION + 9].copy()
    m = x[e : e + 3].copy()
    field = rotate_back(x, at.ROTATION, x[e], x[e + 1], x[e + 2])
    H, g = np.empty(at.ERRORS), np.empty(at.ERRORS)
    gate = max(p[prm.EKF2_MAG_GATE], 1.0)
    for i in range(3):
        _fill_matrix(H, R, m, i)
        variance = project_covariance(covariance(x), H, g) + noise
        set_aid(
            x, at.AID_MAG, i, time, measured[i], noise,
            field[i] + x[at.MAG_BODY + i] - measured[i], variance, gate,
        )  # fmt: skip
    finish_aid(x, at.AID_MAG, time)

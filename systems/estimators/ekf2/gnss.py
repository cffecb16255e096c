"""GNSS: quality checks, velocity and horizontal position (the altitude is in `height`)."""

import math

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import (
    horizontal_position_sources,
    horizontal_sources,
    horizontal_velocity_sources,
)
from systems.estimators.ekf2.buffers import arriving, pop
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    covariance,
    finish_aid,
    fuse_horizontal_position,
    fuse_velocity,
    set_aid,
    timed_out,
    zero_aid,
)
from systems.estimators.ekf2.geometry import (
    limit,
    metres_per_radian,
    project,
    rotate,
    wrap_pi,
    yaw_of,
)
from systems.estimators.ekf2.height import SENSOR_GNSS, enabled, stop_gnss_height
from systems.estimators.ekf2.prediction import reset_gyro_bias_z_covariance
from systems.estimators.ekf2.resets import (
    reset_horizontal_velocity,
    reset_to_global_position,
    reset_vertical_velocity,
    reset_yaw,
)
from systems.estimators.ekf2.yaw_estimator import (
    fuse_yaw_estimator,
    predict_yaw_estimator,
    reset_yaw_estimator,
    set_yaw_estimator_bias,
    yaw_estimate_available,
)

_RESET_TIMEOUT = 7_000_000.0  # us
_YAW_RESET_DELAY = 1_000_000.0  # us of failing fusion before the emergency yaw is taken
_YAW_FAILURE = math.radians(25.0)
_DRIFT_TAU = 10.0  # s, low-pass of the drift checks
_HORIZONTAL_POSITION, _VELOCITY = 1, 4  # bits of EKF2_GPS_CTRL

# Entries of CHECKS_FAILED, and the bit of EKF2_GPS_CHECK that enables each.
_FIX, _SATELLITES, _PDOP, _HACC, _VACC, _SACC, _HDRIFT, _VDRIFT = range(8)
_HSPEED, _VSPEED, _SPOOFED, _JAMMED = range(8, 12)
_CHECK_BITS = (1024, 1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 2048)


@kernel
def reset_checks(x):
    """Start the quality checks anew."""
    x[at.CHECKS_PASSED] = x[at.CHECKS_LAST_PASS] = x[at.CHECKS_LAST_FAIL] = 0.0
    _reset_drift(x)


@kernel
def _reset_drift(x):
    for i in range(3):
        x[at.CHECKS_DRIFT + i] = x[at.CHECKS_SPEED + i] = 0.0


@kernel
def _check_drift(x, p):
    """On the ground: position and velocity of a vehicle at rest must stand still."""
    f, s = at.CHECKS_FAILED, at.GNSS_SAMPLE
    if x[at.IN_AIR] or not x[at.AT_REST]:
        if x[at.IN_AIR]:
            x[f + _HDRIFT] = x[f + _VDRIFT] = x[f + _HSPEED] = x[f + _VSPEED] = 0.0
        _reset_drift(x)
        return
    horizontal, vertical = p[prm.EKF2_REQ_HDRIFT], p[prm.EKF2_REQ_VDRIFT]
    previous = at.CHECKS_PREVIOUS
    dt = limit((x[s] - x[previous + 3]) * 1e-6, 0.001, _DRIFT_TAU)
    alpha = dt / _DRIFT_TAU
    north, east, down = 0.0, 0.0, 0.0
    if x[previous + 3] > 0.0:
        north, east = project(
            math.radians(x[s + at.GNSS_LAT]), math.radians(x[s + at.GNSS_LON]),
            x[previous], x[previous + 1],
        )  # fmt: skip
        down = x[previous + 2] - x[s + at.GNSS_ALT]
    d, v = at.CHECKS_DRIFT, at.CHECKS_SPEED
    h10, v10 = 10.0 * horizontal, 10.0 * vertical
    x[d] = limit(north / dt * alpha + x[d] * (1.0 - alpha), -h10, h10)
    x[d + 1] = limit(east / dt * alpha + x[d + 1] * (1.0 - alpha), -h10, h10)
    x[d + 2] = limit(down / dt * alpha + x[d + 2] * (1.0 - alpha), -v10, v10)
    x[f + _HDRIFT] = math.sqrt(x[d] ** 2 + x[d + 1] ** 2) > horizontal
    x[f + _VDRIFT] = abs(x[d + 2]) > vertical
    g = s + at.GNSS_V
    x[v] += alpha * (limit(x[g], -h10, h10) - x[v])
    x[v + 1] += alpha * (limit(x[g + 1], -h10, h10) - x[v + 1])
    x[v + 2] += alpha * (limit(x[g + 2], -v10, v10) - x[v + 2])
    x[f + _HSPEED] = math.sqrt(x[v] ** 2 + x[v + 1] ** 2) > horizontal
    x[f + _VSPEED] = abs(x[v + 2]) > vertical


@kernel
def _passing(x, p, simplified):
    """Run all checks, or those of a receiver that was good before (in flight)."""
    f, s = at.CHECKS_FAILED, at.GNSS_SAMPLE
    x[f + _SPOOFED] = x[s + at.GNSS_SPOOFED]
    x[f + _JAMMED] = x[s + at.GNSS_JAMMED]
    if simplified:
        x[f + _FIX] = x[s + at.GNSS_FIX] < 3.0
        x[f + _HACC] = x[s + at.GNSS_HACC] > 50.0
        x[f + _VACC] = x[s + at.GNSS_VACC] > 50.0
        x[f + _SACC] = x[s + at.GNSS_SACC] > 10.0
    else:
        x[f + _FIX] = x[s + at.GNSS_FIX] < p[prm.EKF2_REQ_FIX]
        x[f + _SATELLITES] = x[s + at.GNSS_SATS] < p[prm.EKF2_REQ_NSATS]
        x[f + _PDOP] = x[s + at.GNSS_PDOP] > p[prm.EKF2_REQ_PDOP]
        x[f + _HACC] = x[s + at.GNSS_HACC] > p[prm.EKF2_REQ_EPH]
        x[f + _VACC] = x[s + at.GNSS_VACC] > p[prm.EKF2_REQ_EPV]
        x[f + _SACC] = x[s + at.GNSS_SACC] > p[prm.EKF2_REQ_SACC]
        _check_drift(x, p)
        g, bound = s + at.GNSS_V, p[prm.EKF2_VEL_LIM]
        if x[g] ** 2 + x[g + 1] ** 2 > bound * bound:
            x[f + _HSPEED] = 1.0
        if abs(x[g + 2]) > bound:
            x[f + _VSPEED] = 1.0
    mask = int(p[prm.EKF2_GPS_CHECK])
    for check in range(12):
        unused = simplified and (check in (_SATELLITES, _PDOP) or _HDRIFT <= check <= _VSPEED)
        if x[f + check] and (mask & _CHECK_BITS[check]) != 0 and not unused:
            return False
    return True


@kernel
def _run_checks(x, p):
    """Check the sample: it must have been good for EKF2_REQ_GPS_H, in flight for a tenth of it.

    Returns whether it may be used.
    """
    now = x[at.TIME_DELAYED]
    if x[at.CHECKS_LAST_FAIL] == 0.0:
        x[at.CHECKS_LAST_FAIL] = now
    if not x[at.IN_AIR]:
        x[at.CHECKS_INITIAL] = 0.0
    needed = p[prm.EKF2_REQ_GPS_H] * 1e6
    passed = False
    simplified = x[at.CHECKS_INITIAL] != 0.0
    if _passing(x, p, simplified):
        if simplified:
            needed = max(1e6, math.floor(0.1 * needed))
        passed = timed_out(x, x[at.CHECKS_LAST_FAIL], needed)
        if passed:
            x[at.CHECKS_INITIAL] = 1.0
    else:
        x[at.CHECKS_LAST_FAIL] = now
    s, previous = at.GNSS_SAMPLE, at.CHECKS_PREVIOUS
    x[previous] = math.radians(x[s + at.GNSS_LAT])
    x[previous + 1] = math.radians(x[s + at.GNSS_LON])
    x[previous + 2] = x[s + at.GNSS_ALT]
    x[previous + 3] = x[s]
    x[at.CHECKS_PASSED] = passed
    if passed:
        x[at.CHECKS_LAST_PASS] = now
    return passed


@kernel
def _lever_arm(p):
    return (
        p[prm.EKF2_GPS_POS_X] - p[prm.EKF2_IMU_POS_X],
        p[prm.EKF2_GPS_POS_Y] - p[prm.EKF2_IMU_POS_Y],
        p[prm.EKF2_GPS_POS_Z] - p[prm.EKF2_IMU_POS_Z],
    )


@kernel
def _test_position(x, p):
    s = at.GNSS_SAMPLE
    rx, ry, rz = _lever_arm(p)
    rn, re, _ = rotate(x, at.ROTATION, rx, ry, rz)
    latitude, longitude = math.radians(x[s + at.GNSS_LAT]), math.radians(x[s + at.GNSS_LON])
    north, east = metres_per_radian(latitude, x[s + at.GNSS_ALT])
    latitude = wrap_pi(latitude - rn / north)
    longitude = wrap_pi(longitude - re / east)
    noise = max(x[s + at.GNSS_HACC], p[prm.EKF2_GPS_P_NOISE])
    if not horizontal_sources(x) > x[at.GNSS_POS]:
        # alone, it also holds the attitude, and must not become too weak for that
        noise = min(noise, p[prm.EKF2_NOAID_NOISE])
    variance = max(noise * noise, 1e-4)
    gate = max(p[prm.EKF2_GPS_P_GATE], 1.0)
    north, east = metres_per_radian(x[at.LATITUDE], x[at.ALTITUDE])
    P = covariance(x)
    aid = at.AID_GNSS_POS
    set_aid(
        x, aid, 0, x[s], math.degrees(latitude), variance,
        wrap_pi(x[at.LATITUDE] - latitude) * north, P[6, 6] + variance, gate,
    )  # fmt: skip
    set_aid(
        x, aid, 1, x[s], math.degrees(longitude), variance,
        wrap_pi(x[at.LONGITUDE] - longitude) * east, P[7, 7] + variance, gate,
    )  # fmt: skip
    finish_aid(x, aid, x[s])


@kernel
def _test_velocity(x, p):
    s = at.GNSS_SAMPLE
    rx, ry, rz = _lever_arm(p)
    wx = x[at.IMU_DELTA_ANGLE] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS]
    wy = x[at.IMU_DELTA_ANGLE + 1] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS + 1]
    wz = x[at.IMU_DELTA_ANGLE + 2] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS + 2]
    lever = rotate(x, at.ROTATION, wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx)
    variance = max(x[s + at.GNSS_SACC], p[prm.EKF2_GPS_V_NOISE], 0.01) ** 2
    gate = max(p[prm.EKF2_GPS_V_GATE], 1.0)
    P = covariance(x)
    aid = at.AID_GNSS_VEL
    for i in range(3):
        noise = 2.25 * variance if i == 2 else variance
        measured = x[s + at.GNSS_V + i] - lever[i]
        set_aid(
            x, aid, i, x[s], measured, noise, x[at.VELOCITY + i] - measured,
            P[3 + i, 3 + i] + noise, gate,
        )  # fmt: skip
    finish_aid(x, aid, x[s])

    ratio = aid + at.A_TEST_RATIO
    only_vertical = x[ratio + 2 * at.A_AXIS] > 1.0 and x[ratio] < 1.0 and x[ratio + at.A_AXIS] < 1.0
    if x[at.BAD_ACC_VERTICAL] and only_vertical and x[s + at.GNSS_SACC] < p[prm.EKF2_REQ_SACC]:
        a = aid + 2 * at.A_AXIS
        bound = gate * math.sqrt(x[a + at.A_INNOVATION_VARIANCE])
        x[a + at.A_INNOVATION] = limit(x[a + at.A_INNOVATION], -bound, bound)
        x[aid + at.A_REJECTED] = 0.0


@kernel
def _stop_velocity(x):
    if x[at.GNSS_VEL]:
        x[at.GNSS_VEL] = 0.0
        if not x[at.GNSS_POS]:
            reset_checks(x)


@kernel
def _stop_position(x):
    if x[at.GNSS_POS]:
        x[at.GNSS_POS] = 0.0
        if not x[at.GNSS_VEL]:
            reset_checks(x)


@kernel
def stop_gnss(x):
    """Stop fusing anything of GNSS."""
    if x[at.GNSS_VEL] or x[at.GNSS_POS]:
        reset_checks(x)
    _stop_velocity(x)
    _stop_position(x)
    stop_gnss_height(x)
    reset_yaw_estimator(x)


@kernel
def _reset_allowed(x, p, flag, sources_of_kind):
    """Whether GNSS may reset the state: not if another source of its kind (or any) aids."""
    if x[at.GNSS_FAULT]:
        return False
    sources = horizontal_sources(x) if p[prm.EKF2_GPS_MODE] == 1.0 else sources_of_kind
    return not sources > x[flag]


@kernel
def _reset_velocity(x):
    a = at.AID_GNSS_VEL
    o, v = a + at.A_OBSERVATION, a + at.A_VARIANCE
    reset_horizontal_velocity(x, x[o], x[o + at.A_AXIS], x[v], x[v + at.A_AXIS])
    reset_vertical_velocity(x, x[o + 2 * at.A_AXIS], x[v + 2 * at.A_AXIS])
    zero_aid(x, a, 3)


@kernel
def _reset_position(x):
    a = at.AID_GNSS_POS
    o, v = a + at.A_OBSERVATION, a + at.A_VARIANCE
    reset_to_global_position(
        x, math.radians(x[o]), math.radians(x[o + at.A_AXIS]), x[v] + x[v + at.A_AXIS]
    )
    zero_aid(x, a, 2)


@kernel
def _control_velocity(x, p, force_reset):
    going_on = (
        (int(p[prm.EKF2_GPS_CTRL]) & _VELOCITY) != 0
        and x[at.TILT_ALIGN] != 0.0
        and x[at.YAW_ALIGN] != 0.0
        and x[at.GNSS_FAULT] == 0.0
        and x[at.GNSS_HGT_FAULT] == 0.0
    )
    aid = at.AID_GNSS_VEL
    allowed = force_reset or _reset_allowed(x, p, at.GNSS_VEL, horizontal_velocity_sources(x))
    if x[at.GNSS_VEL]:
        if not going_on:
            _stop_velocity(x)
            return
        fuse_velocity(x, p, aid)
        if force_reset or timed_out(x, x[aid + at.A_LAST_FUSE], _RESET_TIMEOUT):
            if allowed:
                _reset_velocity(x)
            else:
                _stop_velocity(x)
    elif going_on and x[at.CHECKS_PASSED]:
        ratio = aid + at.A_TEST_RATIO
        gentle = not force_reset and x[at.YAW_ALIGN + at.BEFORE] != 0.0
        started = (
            gentle and x[ratio] < 1.0 and x[ratio + at.A_AXIS] < 1.0 and fuse_velocity(x, p, aid)
        )
        if not started and allowed:
            _reset_velocity(x)
            started = True
        if started:
            x[at.GNSS_VEL] = 1.0


@kernel
def _control_position(x, p, force_reset):
    wanted = (int(p[prm.EKF2_GPS_CTRL]) & _HORIZONTAL_POSITION) != 0
    going_on = (
        wanted
        and x[at.TILT_ALIGN] != 0.0
        and x[at.YAW_ALIGN] != 0.0
        and x[at.GNSS_HGT_FAULT] == 0.0
    )
    aid = at.AID_GNSS_POS
    allowed = _reset_allowed(x, p, at.GNSS_POS, horizontal_position_sources(x))
    if x[at.GNSS_POS]:
        if not going_on:
            _stop_position(x)
            return
        fuse_horizontal_position(x, p, aid)
        if force_reset or timed_out(x, x[aid + at.A_LAST_FUSE], _RESET_TIMEOUT):
            if allowed:
                _reset_position(x)
            else:
                _stop_position(x)
                x[at.GNSS_FAULT] = 1.0
        return
    first_origin = wanted and x[at.CHECKS_PASSED] != 0.0 and x[at.ORIGIN_SET] == 0.0
    if going_on and x[at.CHECKS_PASSED]:
        ratio = aid + at.A_TEST_RATIO
        gentle = x[at.ORIGIN_SET] != 0.0 and not force_reset and x[at.YAW_ALIGN + at.BEFORE] != 0.0
        started = (
            gentle
            and x[ratio] < 1.0
            and x[ratio + at.A_AXIS] < 1.0
            and fuse_horizontal_position(x, p, aid)
        )
        if (not started and allowed) or first_origin:
            _reset_position(x)
            started = True
        if started:
            x[at.GNSS_POS] = 1.0
            x[at.GNSS_FAULT] = 0.0
    elif first_origin:
        _reset_position(x)


@kernel
def _take_emergency_yaw(x):
    """Set the heading to the yaw estimator's; false if that has not converged."""
    if not yaw_estimate_available(x):
        return False
    reset_yaw(x, x[at.GSF_YAW], x[at.GSF_VARIANCE])
    x[at.YAW_ALIGN] = 1.0
    return True


@kernel
def _feed_yaw_estimator(x, p):
    a = at.AID_GNSS_VEL
    variance = x[a + at.A_VARIANCE]
    vn, ve = x[a + at.A_OBSERVATION], x[a + at.A_AXIS + at.A_OBSERVATION]
    accuracy = math.sqrt(variance)
    if not (
        variance > 0.0
        and accuracy < p[prm.EKF2_REQ_SACC]
        and math.isfinite(vn)
        and math.isfinite(ve)
    ):
        return
    fuse_yaw_estimator(x, vn, ve, accuracy)
    wanted = (int(p[prm.EKF2_GPS_CTRL]) & (_VELOCITY | _HORIZONTAL_POSITION)) != 0
    if wanted and not x[at.YAW_ALIGN] and x[at.TILT_ALIGN]:
        _take_emergency_yaw(x)


@kernel
def _failing(x, flag, rejected, time):
    """Whether a source has been rejected since some time after take-off."""
    return (
        x[flag] != 0.0
        and x[rejected + at.A_REJECTED] != 0.0
        and timed_out(x, x[time], _YAW_RESET_DELAY)
        and x[time] > x[at.T_ON_GROUND]
    )


@kernel
def _emergency_yaw_reset(x, p):
    """In flight, take the yaw estimator's heading if GNSS is rejected and the headings differ."""
    if x[at.GNSS_FAULT] or not x[at.IN_AIR] or not yaw_estimate_available(x):
        return False
    R = at.ROTATION
    yaw = yaw_of((x[R], x[R + 1], 0.0, x[R + 3], x[R + 4], 0.0, x[R + 6], x[R + 7], 0.0))
    if abs(wrap_pi(yaw - x[at.GSF_YAW])) <= _YAW_FAILURE:
        return False
    if not (
        _failing(x, at.GNSS_VEL, at.AID_GNSS_VEL, at.T_HORIZONTAL_VELOCITY)
        or _failing(x, at.GNSS_POS, at.AID_GNSS_POS, at.T_HORIZONTAL_POSITION)
    ):
        return False
    if not _take_emergency_yaw(x):
        return False
    reset_gyro_bias_z_covariance(x, p)  # it may well have caused the failure
    if x[at.MAG_HDG] or x[at.MAG_3D]:
        x[at.MAG_FAULT] = 1.0
    if x[at.EV_YAW]:
        x[at.EV_YAW_FAULT] = 1.0
    return True


@kernel
def control_gnss(x, p):
    """Check and fuse a GNSS sample that the horizon has reached."""
    intended = enabled(p, SENSOR_GNSS) and p[prm.EKF2_GPS_CTRL] != 0.0
    if not x[at.RING_GNSS + at.RING_IN_USE] or not intended:
        stop_gnss(x)
        return
    if not x[at.GYRO_BIAS_INHIBITED]:
        set_yaw_estimator_bias(x)
    predict_yaw_estimator(x)

    sample = pop(x, at.RING_GNSS, x[at.TIME_DELAYED])
    x[at.GNSS_READY] = sample >= 0
    using = x[at.GNSS_VEL] != 0.0 or x[at.GNSS_POS] != 0.0
    if sample < 0:
        if using and not arriving(x, at.RING_GNSS, _RESET_TIMEOUT):
            stop_gnss(x)
        return
    x[at.GNSS_SAMPLE] = x[at.RING_GNSS + at.RING_POPPED_TIME]
    for i in range(1, 1 + at.GNSS_FIELDS):
        x[at.GNSS_SAMPLE + i] = x[sample + i]
    if not _run_checks(x, p):
        x[at.GNSS_READY] = 0.0
        if using and timed_out(x, x[at.CHECKS_LAST_PASS], _RESET_TIMEOUT):
            stop_gnss(x)
    _test_position(x, p)
    _test_velocity(x, p)
    if not x[at.GNSS_READY]:
        return
    _feed_yaw_estimator(x, p)
    force_reset = _emergency_yaw_reset(x, p)
    _control_velocity(x, p, force_reset)
    _control_position(x, p, force_reset)

"""Height: barometer, GNSS height, the reference and its fall-back, and a falling strap-down.

One source is the height reference; the others carry a bias against it. If the
reference is lost, the next one in a list takes over; if all fail for 5 s the
height is reset to the reference.
"""

import math

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import (
    fuse_height_bias,
    height_sources,
    predict_height_bias,
    reset_bias,
    vertical_velocity_sources,
)
from systems.estimators.ekf2.buffers import arriving, pop
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    covariance,
    fuse_height,
    recent,
    set_height_aid,
    timed_out,
    zero_aid,
)
from systems.estimators.ekf2.geometry import FLOAT_EPSILON, rotate
from systems.estimators.ekf2.resets import (
    initialise_altitude,
    reset_altitude,
    reset_vertical_velocity_to_zero,
)

HEIGHT_TIMEOUT = 5_000_000.0  # us, without a fused height
_BARO_INTERVAL = 200_000.0  # us, longest expected
_GNSS_INTERVAL = 500_000.0  # us
_BIAS_DENSITY = 0.13  # m/s/√Hz, random walk of a height bias
_BAD_ACCEL_DELAY = 500_000.0  # us
_BAD_ACCEL_PROBATION = 3_000_000.0  # us
_GROUND_EFFECT_TIMEOUT = 10_000_000.0  # us
_SENSOR_ALPHA = 0.01 / (0.01 + 0.09)  # low-pass of 0.09 s at the nominal filter step
_INNOVATION_FAILED, _INNOVATION_SUSPECT = 3.0, 1.0  # standard deviations

# Bits of EKF2_SENS_EN.
SENSOR_GNSS, SENSOR_EV, SENSOR_BARO, SENSOR_RANGE, SENSOR_MAG = 1, 8, 256, 512, 1024


@kernel
def enabled(p, bit):
    """Whether EKF2_SENS_EN allows a sensor."""
    return (int(p[prm.EKF2_SENS_EN]) & bit) != 0


@kernel
def height_reset_required(x):
    """Whether no height has been fused for too long, or the accelerometer is continuously bad."""
    return timed_out(x, x[at.T_GOOD_ACCEL], _BAD_ACCEL_DELAY) or timed_out(
        x, x[at.T_HEIGHT], HEIGHT_TIMEOUT
    )


@kernel
def _innovation_ratio(x, active, aid, axis, factor):
    """An innovation in standard deviations, positive if the filter is too low; 0 if not there."""
    a = aid + axis * at.A_AXIS
    variance = x[a + at.A_INNOVATION_VARIANCE]
    if not x[active] or variance < FLOAT_EPSILON:
        return 0.0
    return factor * x[a + at.A_INNOVATION] / math.sqrt(variance)


@kernel
def _falling(x):
    """How likely the strap-down is falling: 0 not, 1 one source says so, 2 two kinds do."""
    pressure = _innovation_ratio(x, at.BARO_HGT, at.AID_BARO_HGT, 0, 1.0)
    gnss = max(
        _innovation_ratio(x, at.GPS_HGT, at.AID_GNSS_HGT, 0, 1.0),
        _innovation_ratio(x, at.GNSS_VEL, at.AID_GNSS_VEL, 2, 1.0),
    )
    ground = max(
        # a range grows upwards, so its innovation has the other sign
        _innovation_ratio(x, at.RNG_HGT, at.AID_RNG_HGT, 0, -1.0),
        _innovation_ratio(x, at.EV_HGT, at.AID_EV_HGT, 0, 1.0),
        _innovation_ratio(x, at.EV_VEL, at.AID_EV_VEL, 2, 1.0),
    )
    first = max(pressure, gnss, ground)
    if not first > _INNOVATION_FAILED:
        return 0
    suspects = 0
    for ratio in (pressure, gnss, ground):
        if ratio > _INNOVATION_SUSPECT:
            suspects += 1
    return 2 if suspects > 1 else 1


@kernel
def check_vertical_acceleration(x):
    """Find a clipping accelerometer: clipping pulls the mean to zero, so the strap-down falls."""
    falling = _falling(x)
    most = math.floor(1.0 / x[at.DT_AVERAGE])
    warnings = 0
    critical = False
    for i in range(3):
        c = at.CLIP_COUNTER + i
        if x[at.IMU_CLIPPING + i] and x[c] < most:
            x[c] += 1.0
        elif x[c] > 0.0:
            x[c] -= 1.0
        if x[c] >= most // 2:
            warnings += 1
        critical = critical or x[c] >= most
    x[at.BAD_ACC_CLIPPING] = warnings == 3 or critical
    frequent = x[at.CLIP_COUNTER + 2] >= most // 2 or x[at.BAD_ACC_CLIPPING] != 0.0
    bad = (frequent and falling == 1) or falling == 2
    if bad:
        x[at.T_BAD_ACCEL] = x[at.TIME_DELAYED]
    else:
        x[at.T_GOOD_ACCEL] = x[at.TIME_DELAYED]
    if x[at.BAD_ACC_VERTICAL]:
        x[at.BAD_ACC_VERTICAL] = recent(x, x[at.T_BAD_ACCEL], _BAD_ACCEL_PROBATION)
    else:
        x[at.BAD_ACC_VERTICAL] = bad


@kernel
def update_ground_effect(x, p, height_known, height):
    """Set or clear the ground-effect flag, by the height above ground (m) if it is known."""
    if not x[at.IN_AIR] or x[at.FIXED_WING]:
        x[at.GND_EFFECT] = 0.0
    elif height_known:
        x[at.GND_EFFECT] = height < p[prm.EKF2_GND_MAX_HGT]
    elif x[at.GND_EFFECT] and timed_out(x, x[at.T_GROUND_EFFECT], _GROUND_EFFECT_TIMEOUT):
        x[at.GND_EFFECT] = 0.0


@kernel
def _lose_reference(x, source):
    if x[at.HEIGHT_REFERENCE] == source:
        x[at.HEIGHT_REFERENCE] = at.UNKNOWN


@kernel
def _stop_barometer(x):
    if x[at.BARO_HGT]:
        _lose_reference(x, at.BARO)
        x[at.BIAS_BARO + at.B_ACTIVE] = 0.0
        x[at.BARO_HGT] = 0.0


@kernel
def control_barometer(x, p):
    """Fuse the barometer's altitude."""
    bias = at.BIAS_BARO
    predict_height_bias(x, bias, at.BARO)
    sample = pop(x, at.RING_BARO, x[at.TIME_DELAYED])
    if sample < 0:
        if x[at.BARO_HGT] and not arriving(x, at.RING_BARO, 2 * _BARO_INTERVAL):
            _stop_barometer(x)
        return
    aid = at.AID_BARO_HGT
    measurement = x[sample + 1]
    variance = p[prm.EKF2_BARO_NOISE] ** 2
    valid = math.isfinite(measurement)
    if valid:
        if x[at.BARO_COUNT] == 0.0 or x[sample + 2]:
            x[at.BARO_LPF] = measurement
            x[at.BARO_COUNT] = 1.0
            x[at.BARO_FAULT] = 0.0
        else:
            x[at.BARO_LPF] += _SENSOR_ALPHA * (measurement - x[at.BARO_LPF])
            x[at.BARO_COUNT] += 1.0
        if x[at.BARO_COUNT] <= x[at.RING_LENGTH]:
            x[bias + at.B_BIAS] = x[at.BARO_LPF] - x[at.ALTITUDE]
    set_height_aid(
        x,
        aid,
        x[at.RING_BARO + at.RING_POPPED_TIME],
        x[bias + at.B_BIAS] - measurement,
        variance + x[bias + at.B_VARIANCE],
        max(p[prm.EKF2_BARO_GATE], 1.0),
    )
    # the rotor wash raises the pressure near the ground, which looks like sinking
    zone = p[prm.EKF2_GND_EFF_DZ]
    if x[at.GND_EFFECT] and zone > 0.0 and x[aid + at.A_INNOVATION] < 0.0:
        x[aid + at.A_INNOVATION] = min(x[aid + at.A_INNOVATION] + zone, 0.0)
    if valid:
        fuse_height_bias(
            x, bias, at.BARO, measurement - x[at.ALTITUDE],
            variance + covariance(x)[8, 8], _BIAS_DENSITY, math.sqrt(variance),
        )  # fmt: skip

    going_on = (
        enabled(p, SENSOR_BARO)
        and p[prm.EKF2_BARO_CTRL] != 0.0
        and valid
        and x[at.BARO_COUNT] > x[at.RING_LENGTH]
        and x[at.BARO_FAULT] == 0.0
    )
    if x[at.BARO_HGT]:
        if not going_on:
            _stop_barometer(x)
            return
        fuse_height(x, p, aid)
        failing = timed_out(x, x[aid + at.A_LAST_FUSE], HEIGHT_TIMEOUT)
        if height_reset_required(x) and x[at.HEIGHT_REFERENCE] == at.BARO:
            reset_altitude(x, x[at.BARO_LPF] - x[bias + at.B_BIAS], variance)
            x[bias + at.B_BIAS] = x[at.BARO_LPF] - x[at.ALTITUDE]
            zero_aid(x, aid, 1)
            if vertical_velocity_sources(x) == 0.0:
                reset_vertical_velocity_to_zero(x)
        elif failing:
            _stop_barometer(x)
            if recent(x, x[at.T_HEIGHT], HEIGHT_TIMEOUT):
                x[at.BARO_FAULT] = 1.0
    elif going_on and arriving(x, at.RING_BARO, 2 * _BARO_INTERVAL):
        if p[prm.EKF2_HGT_REF] == at.BARO:
            x[at.HEIGHT_REFERENCE] = at.BARO
            initialise_altitude(x, measurement, variance)
            reset_bias(x, bias)
            zero_aid(x, aid, 1)
        else:
            x[bias + at.B_BIAS] = x[at.BARO_LPF] - x[at.ALTITUDE]
        x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
        x[bias + at.B_ACTIVE] = 1.0
        x[at.BARO_HGT] = 1.0


@kernel
def stop_gnss_height(x):
    """Stop fusing the GNSS height."""
    if x[at.GPS_HGT]:
        _lose_reference(x, at.GNSS)
        x[at.BIAS_GNSS_HGT + at.B_ACTIVE] = 0.0
        x[at.GPS_HGT] = 0.0


@kernel
def _gnss_height_reset_allowed(x, p):
    dead_reckoning = p[prm.EKF2_GPS_MODE] == 1.0
    others = height_sources(x) > x[at.GPS_HGT]
    return not (dead_reckoning and others) or not math.isfinite(x[at.ORIGIN_ALTITUDE])


@kernel
def control_gnss_height(x, p):
    """Fuse the GNSS altitude."""
    bias = at.BIAS_GNSS_HGT
    predict_height_bias(x, bias, at.GNSS)
    if not enabled(p, SENSOR_GNSS) or p[prm.EKF2_GPS_CTRL] == 0.0:
        stop_gnss_height(x)
        return
    if not x[at.GNSS_READY]:
        if x[at.GPS_HGT] and not arriving(x, at.RING_GNSS, 2 * _GNSS_INTERVAL):
            stop_gnss_height(x)
        return
    aid = at.AID_GNSS_HGT
    noise = max(x[at.GNSS_SAMPLE + at.GNSS_VACC], 1.5 * p[prm.EKF2_GPS_P_NOISE])
    only_source = x[at.GPS_HGT] != 0.0 and height_sources(x) == 1.0
    if not only_source:
        noise = min(noise, p[prm.EKF2_NOAID_NOISE])
    variance = noise * noise
    _, _, lever = rotate(
        x,
        at.ROTATION,
        p[prm.EKF2_GPS_POS_X] - p[prm.EKF2_IMU_POS_X],
        p[prm.EKF2_GPS_POS_Y] - p[prm.EKF2_IMU_POS_Y],
        p[prm.EKF2_GPS_POS_Z] - p[prm.EKF2_IMU_POS_Z],
    )
    measurement = x[at.GNSS_SAMPLE + at.GNSS_ALT] + lever
    set_height_aid(
        x,
        aid,
        x[at.GNSS_SAMPLE],
        x[bias + at.B_BIAS] - measurement,
        variance + x[bias + at.B_VARIANCE],
        max(p[prm.EKF2_GPS_P_GATE], 1.0),
    )
    possible = (
        math.isfinite(measurement)
        and math.isfinite(variance)
        and x[at.ORIGIN_SET] != 0.0
        and x[at.CHECKS_PASSED] != 0.0
        and x[at.GNSS_FAULT] == 0.0
    )
    going_on = possible and (int(p[prm.EKF2_GPS_CTRL]) & 2) != 0
    is_arriving = arriving(x, at.RING_GNSS, 2 * _GNSS_INTERVAL)
    if x[at.GPS_HGT]:
        if going_on:
            _continue_gnss_height(x, p, measurement, variance)
        else:
            stop_gnss_height(x)
        return
    is_reference = p[prm.EKF2_HGT_REF] == at.GNSS
    starting = going_on and is_arriving
    if possible and is_arriving and is_reference and not math.isfinite(x[at.ORIGIN_ALTITUDE]):
        initialise_altitude(x, measurement, variance)
        reset_bias(x, bias)
        if starting:
            x[at.HEIGHT_REFERENCE] = at.GNSS
            zero_aid(x, aid, 1)
            x[bias + at.B_ACTIVE] = 1.0
            x[at.GPS_HGT] = 1.0
    elif starting:
        _start_gnss_height(x, p, measurement, variance, is_reference)


@kernel
def _start_gnss_height(x, p, measurement, variance, is_reference):
    aid, bias = at.AID_GNSS_HGT, at.BIAS_GNSS_HGT
    if x[at.GNSS_HGT_FAULT]:
        if x[aid + at.A_REJECTED]:
            x[at.T_GNSS_HEIGHT_REJECTED] = x[at.TIME_DELAYED]
        if not timed_out(x, x[at.T_GNSS_HEIGHT_REJECTED], HEIGHT_TIMEOUT):
            return
    if is_reference:
        started = x[aid + at.A_TEST_RATIO] < 1.0 and fuse_height(x, p, aid)
        if not started and _gnss_height_reset_allowed(x, p):
            reset_altitude(x, measurement, variance)
            reset_bias(x, bias)
            zero_aid(x, aid, 1)
            started = True
        if not started:
            return
        x[at.HEIGHT_REFERENCE] = at.GNSS
    else:
        x[bias + at.B_BIAS] = measurement - x[at.ALTITUDE]
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    x[bias + at.B_ACTIVE] = 1.0
    x[at.GPS_HGT] = 1.0
    x[at.GNSS_HGT_FAULT] = 0.0


@kernel
def _continue_gnss_height(x, p, measurement, variance):
    aid, bias = at.AID_GNSS_HGT, at.BIAS_GNSS_HGT
    fuse_height_bias(
        x, bias, at.GNSS, measurement - x[at.ALTITUDE],
        variance + covariance(x)[8, 8], _BIAS_DENSITY, math.sqrt(variance),
    )  # fmt: skip
    fuse_height(x, p, aid)
    failing = timed_out(x, x[aid + at.A_LAST_FUSE], HEIGHT_TIMEOUT)
    if (
        height_reset_required(x)
        and x[at.HEIGHT_REFERENCE] == at.GNSS
        and _gnss_height_reset_allowed(x, p)
    ):
        reset_altitude(x, measurement, variance)
        x[bias + at.B_BIAS] = measurement - x[at.ALTITUDE]
        zero_aid(x, aid, 1)
    elif failing:
        stop_gnss_height(x)
        if not _gnss_height_reset_allowed(x, p):
            x[at.GNSS_HGT_FAULT] = 1.0
            x[at.T_GNSS_HEIGHT_REJECTED] = x[at.TIME_DELAYED]


@kernel
def choose_reference(x, p):
    """If there is no height reference, take the first active source of the list."""
    if x[at.HEIGHT_REFERENCE] != at.UNKNOWN:
        return
    wanted = p[prm.EKF2_HGT_REF]
    order = (at.GNSS, at.BARO, at.EV, at.RANGE)
    if wanted == at.BARO:
        order = (at.BARO, at.GNSS, at.EV, at.RANGE)
    elif wanted == at.RANGE:
        order = (at.RANGE, at.EV, at.BARO, at.GNSS)
    elif wanted == at.EV:
        order = (at.EV, at.RANGE, at.BARO, at.GNSS)
    for source in order:
        if (
            (source == at.BARO and x[at.BARO_HGT])
            or (source == at.GNSS and x[at.GPS_HGT])
            or (source == at.RANGE and x[at.RNG_HGT])
            or (source == at.EV and x[at.EV_HGT])
        ):
            x[at.HEIGHT_REFERENCE] = source
            return

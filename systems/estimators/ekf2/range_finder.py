"""The range finder: checks of its data, height aiding, and the terrain below.

A range observes terrain − position (both down). It estimates the terrain as long
as something else gives the height, and the height when low and slow
(EKF2_RNG_CTRL 1) or always (2).
"""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import horizontal_sources, vertical_velocity_sources
from systems.estimators.ekf2.buffers import arriving, pop
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    covariance,
    decorrelate,
    finish_aid,
    fuse_gains,
    project_covariance,
    recent,
    set_aid,
    timed_out,
    zero_aid,
)
from systems.estimators.ekf2.geometry import limit, rotate, sign
from systems.estimators.ekf2.height import (
    HEIGHT_TIMEOUT,
    SENSOR_RANGE,
    enabled,
    height_reset_required,
)
from systems.estimators.ekf2.resets import (
    count_terrain_reset,
    reset_altitude,
    reset_vertical_velocity_to_zero,
)

_INTERVAL = 200_000.0  # us, longest expected
_COS_MAXIMUM_TILT = 0.7071
_STUCK_AFTER = 10_000_000.0  # us without a valid range
_STUCK_THRESHOLD = 0.1  # m
_FOG_FACTOR = 2.0
_CHECK_TAU = 2.0  # s, low-pass of the kinematic check
_CHECK_SPEED = 0.5  # m/s, vertical speed that proves consistency
_CHECK_HYSTERESIS = 1_000_000.0  # us


@kernel
def height_above_ground(x):
    """The filter's height above the terrain (m)."""
    return x[at.TERRAIN] + x[at.ALTITUDE]


@kernel
def height_above_ground_variance(x):
    """Its variance (m2): H P Hᵀ with H = −1 for the position, 1 for the terrain."""
    P = covariance(x)
    return P[8, 8] + P[at.E_TERRAIN, at.E_TERRAIN] - 2.0 * P[8, at.E_TERRAIN]


@kernel
def height_above_ground_valid(x):
    """Whether the height above ground may be used."""
    return x[at.RNG_TERRAIN_VALID] != 0.0 or x[at.HEIGHT_REFERENCE] == at.RANGE


@kernel
def initialise_terrain(x, p):
    """Put the terrain just below the vehicle."""
    x[at.TERRAIN] = p[prm.EKF2_MIN_RNG] - x[at.ALTITUDE]
    decorrelate(covariance(x), at.E_TERRAIN, 1, p[prm.EKF2_MIN_RNG] ** 2)


@kernel
def control_terrain(x, p):
    """On the ground the terrain is at the feet, and at take-off it starts there."""
    if x[at.IN_AIR]:
        if not x[at.IN_AIR + at.BEFORE]:
            initialise_terrain(x, p)
        return
    x[at.LAST_GROUND_DOWN] = -x[at.ALTITUDE]
    x[at.RNG_FAULT] = 0.0
    unaided = not x[at.RNG_TERRAIN] and timed_out(x, x[at.T_TERRAIN], 1_000_000.0)
    if unaided and x[at.HEIGHT_REFERENCE] != at.RANGE:
        initialise_terrain(x, p)


@kernel
def update_terrain_validity(x):
    """Valid from the first fused range on, as long as the variance is small for the height."""
    ranging = x[at.RNG_TERRAIN] != 0.0 and recent(
        x, x[at.AID_RNG_HGT + at.A_LAST_FUSE], HEIGHT_TIMEOUT
    )
    height = height_above_ground(x)
    positive = False
    small = False
    if x[at.T_TERRAIN] != 0.0:
        variance = height_above_ground_variance(x)
        positive = variance > 0.0
        small = positive and variance < max(0.1 * height, 0.5) ** 2
    if x[at.RNG_TERRAIN_VALID]:
        x[at.RNG_TERRAIN_VALID] = height >= 0.0 and positive and small
    else:
        x[at.RNG_TERRAIN_VALID] = height >= 0.0 and positive and ranging


@kernel
def _distance(x):
    """The range turned upright (m)."""
    return x[at.RNG_RANGE] * x[at.RNG_COS_TILT]


@kernel
def _check_stuck(x):
    """After a long gap, take a range only once it has moved: some sensors repeat an old one."""
    if x[at.RNG_TIME] - x[at.RNG_LAST_VALID] <= _STUCK_AFTER:
        return
    if x[at.RNG_STUCK_MAXIMUM] - x[at.RNG_STUCK_MINIMUM] > _STUCK_THRESHOLD:
        x[at.RNG_STUCK_MINIMUM] = x[at.RNG_STUCK_MAXIMUM] = 0.0
        x[at.RNG_STUCK] = 0.0
        return
    x[at.RNG_STUCK_MAXIMUM] = max(x[at.RNG_STUCK_MAXIMUM], x[at.RNG_RANGE])
    if x[at.RNG_STUCK_MINIMUM] < 0.1 or x[at.RNG_RANGE] < x[at.RNG_STUCK_MINIMUM]:
        x[at.RNG_STUCK_MINIMUM] = x[at.RNG_RANGE]
    x[at.RNG_STUCK] = 1.0


@kernel
def _check_fog(x, longest):
    """Find a sensor that suddenly sees only what is close: fog, dust, dirt."""
    if longest <= 0.0:
        return
    history = x[at.RNG_MEDIAN_HISTORY : at.RNG_MEDIAN_HISTORY + 5]
    history[int(x[at.RNG_MEDIAN_HISTORY + 5])] = _distance(x)
    x[at.RNG_MEDIAN_HISTORY + 5] = (x[at.RNG_MEDIAN_HISTORY + 5] + 1.0) % 5.0
    median = np.sort(history)[2]
    if x[at.RNG_BLOCKED]:
        if median > _FOG_FACTOR * longest:
            x[at.RNG_BLOCKED] = 0.0
    elif median < longest and x[at.RNG_MEDIAN_BEFORE] - median > _FOG_FACTOR * longest:
        x[at.RNG_BLOCKED] = 1.0
    x[at.RNG_MEDIAN_BEFORE] = median


@kernel
def _check_data(x, p):
    """Whether ranges come regularly, and whether the new one is plausible."""
    now = x[at.TIME_DELAYED]
    pitch = p[prm.EKF2_RNG_PITCH]
    x[at.RNG_COS_TILT] = x[at.ROTATION + 6] * math.sin(pitch) + x[at.ROTATION + 8] * math.cos(pitch)
    alpha = 0.005  # half the nominal filter step over a second
    age = now - x[at.RNG_TIME]
    x[at.RNG_DT_LPF] = min(x[at.RNG_DT_LPF] * (1.0 - alpha) + alpha * age, 4e6)
    if age > 2 * _INTERVAL or not x[at.RNG_DT_LPF] < 2e6:
        x[at.RNG_VALID] = x[at.RNG_REGULAR] = 0.0
        return
    x[at.RNG_REGULAR] = 1.0
    if not x[at.RNG_READY]:
        return
    x[at.RNG_VALID] = 0.0
    if x[at.RNG_QUALITY] == 0.0:
        x[at.RNG_BAD_QUALITY] = now
    if not (
        now - x[at.RNG_BAD_QUALITY] > p[prm.EKF2_RNG_QLTY_T] * 1e6
        and x[at.RNG_COS_TILT] > _COS_MAXIMUM_TILT
        and p[prm.RANGE_MINIMUM] <= x[at.RNG_RANGE] <= p[prm.RANGE_MAXIMUM]
    ):
        return
    _check_stuck(x)
    _check_fog(x, p[prm.EKF2_RNG_FOG])
    if not x[at.RNG_STUCK] and not x[at.RNG_BLOCKED]:
        x[at.RNG_VALID] = 1.0
        x[at.RNG_LAST_VALID] = x[at.RNG_TIME]


@kernel
def _check_kinematics(x, p):
    """Compare the rate of the range with the vertical velocity."""
    P = covariance(x)
    now = x[at.TIME_DELAYED]
    speed2 = x[at.VELOCITY] ** 2 + x[at.VELOCITY + 1] ** 2
    if x[at.FIXED_WING] or speed2 > max(P[3, 3] + P[4, 4], 0.1):
        x[at.RNG_CHECK_MOTION] = now
    distance = _distance(x)
    variance = max(p[prm.EKF2_RNG_NOISE] ** 2 + (p[prm.EKF2_RNG_SFE] * distance) ** 2, 0.001)
    dt = (now - x[at.RNG_CHECK_TIME]) * 1e-6
    before = x[at.RNG_CHECK_BEFORE]
    first = x[at.RNG_CHECK_TIME] == 0.0
    x[at.RNG_CHECK_TIME] = now
    x[at.RNG_CHECK_BEFORE] = distance
    if first or dt < 0.001 or dt > 0.5:
        return
    down = x[at.VELOCITY + 2]
    innovation = -(distance - before) / dt - down
    ratio = innovation * innovation / (2.0 * variance / (dt * dt) + P[5, 5])
    ratio /= p[prm.EKF2_RNG_K_GATE] ** 2
    x[at.RNG_CHECK_RATIO] = ratio
    x[at.RNG_CHECK_LPF] += dt / (_CHECK_TAU + dt) * (sign(innovation) * ratio - x[at.RNG_CHECK_LPF])
    if abs(x[at.RNG_CHECK_LPF]) >= 1.0:
        if now - x[at.RNG_CHECK_MOTION] > _CHECK_TAU * 1e6:
            x[at.RNG_CONSISTENT] = 0.0
            x[at.RNG_CHECK_INCONSISTENT] = now
    elif (
        abs(down) > _CHECK_SPEED
        and ratio < 1.0
        and now - x[at.RNG_CHECK_INCONSISTENT] > _CHECK_HYSTERESIS
    ):
        x[at.RNG_CONSISTENT] = 1.0


@kernel
def _take_sample(x, p):
    """Pop a range and check it; a bad one at rest is replaced by the range expected there."""
    sample = pop(x, at.RING_RANGE, x[at.TIME_DELAYED])
    x[at.RNG_READY] = sample >= 0
    if sample >= 0:
        x[at.RNG_TIME] = x[at.RING_RANGE + at.RING_POPPED_TIME]
        x[at.RNG_RANGE], x[at.RNG_QUALITY] = x[sample + 1], x[sample + 2]
    _check_data(x, p)
    if x[at.RNG_READY] and x[at.RNG_VALID]:
        _, _, lever = rotate(
            x,
            at.ROTATION,
            p[prm.EKF2_RNG_POS_X] - p[prm.EKF2_IMU_POS_X],
            p[prm.EKF2_RNG_POS_Y] - p[prm.EKF2_IMU_POS_Y],
            p[prm.EKF2_RNG_POS_Z] - p[prm.EKF2_IMU_POS_Z],
        )
        x[at.RNG_RANGE] += lever / x[at.RNG_COS_TILT]
        if x[at.IN_AIR]:
            _check_kinematics(x, p)
    elif not x[at.IN_AIR] and x[at.AT_REST] and x[at.RNG_REGULAR] and x[at.RNG_READY]:
        x[at.RNG_RANGE] = p[prm.EKF2_MIN_RNG]
        x[at.RNG_VALID] = 1.0
    x[at.RNG_KIN_CONSISTENT] = x[at.RNG_CONSISTENT]


@kernel
def _observation_matrix():
    H = np.zeros(at.ERRORS)
    H[8] = -1.0
    H[at.E_TERRAIN] = 1.0
    return H


@kernel
def _fuse_range(x, p):
    """Fuse the range into the height, or only into the terrain, as the flags say."""
    aid = at.AID_RNG_HGT
    if x[aid + at.A_REJECTED]:
        return
    g = np.empty(at.ERRORS)
    predicted = project_covariance(covariance(x), _observation_matrix(), g)
    K = g / x[aid + at.A_INNOVATION_VARIANCE]
    terrain = K[at.E_TERRAIN] if x[at.RNG_TERRAIN] else 0.0
    if not x[at.RNG_HGT]:
        K[:] = 0.0
    K[at.E_TERRAIN] = terrain
    fuse_gains(x, p, K, g, predicted, x[aid + at.A_VARIANCE], x[aid + at.A_INNOVATION])
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    x[aid + at.A_FUSED] = 1.0
    if x[at.RNG_TERRAIN]:
        x[at.T_TERRAIN] = x[at.TIME_DELAYED]


@kernel
def _reset_terrain(x, p):
    """Put the whole innovation into the terrain, with the height's variance."""
    aid = at.AID_RNG_HGT
    P = covariance(x)
    decorrelate(P, at.E_TERRAIN, 1, 0.0)
    before = x[at.TERRAIN]
    g = np.empty(at.ERRORS)
    predicted = project_covariance(P, _observation_matrix(), g)
    K = np.zeros(at.ERRORS)
    K[at.E_TERRAIN] = 1.0
    fuse_gains(x, p, K, g, predicted, x[aid + at.A_VARIANCE], x[aid + at.A_INNOVATION])
    count_terrain_reset(x, x[at.TERRAIN] - before)
    zero_aid(x, aid, 1)


@kernel
def _low_and_slow(x, p):
    """Whether the range may aid the height, with hysteresis against switching."""
    height, speed, ratio = p[prm.EKF2_RNG_A_HMAX], p[prm.EKF2_RNG_A_VMAX], 1.0
    if not x[at.RNG_HGT]:
        height, speed, ratio = 0.7 * height, 0.7 * speed, 0.01
    slow = True
    if horizontal_sources(x) > 0.0:
        slow = x[at.VELOCITY] ** 2 + x[at.VELOCITY + 1] ** 2 <= speed * speed
    return height_above_ground(x) < height and x[at.AID_RNG_HGT + at.A_TEST_RATIO] < ratio and slow


@kernel
def _stop_height(x):
    if x[at.RNG_HGT]:
        if x[at.HEIGHT_REFERENCE] == at.RANGE:
            x[at.HEIGHT_REFERENCE] = at.UNKNOWN
        x[at.RNG_HGT] = 0.0


@kernel
def control_range_finder(x, p):
    """Fuse the range finder."""
    if not x[at.RING_RANGE + at.RING_IN_USE]:
        return
    _take_sample(x, p)
    aid = at.AID_RNG_HGT
    if not x[at.RNG_READY]:
        fused = x[at.RNG_HGT] != 0.0 or x[at.RNG_TERRAIN] != 0.0
        if fused and not arriving(x, at.RING_RANGE, 2 * _INTERVAL):
            _stop_height(x)
            x[at.RNG_TERRAIN] = 0.0
        return

    healthy = x[at.RNG_VALID] != 0.0
    measurement = max(_distance(x), p[prm.EKF2_MIN_RNG])
    variance = (
        covariance(x)[8, 8]
        + p[prm.EKF2_RNG_NOISE] ** 2
        + (p[prm.EKF2_RNG_SFE] * x[at.RNG_RANGE]) ** 2
    )
    innovation_variance = height_above_ground_variance(x) + variance
    gate = max(p[prm.EKF2_RNG_GATE], 1.0)
    set_aid(
        x, aid, 0, x[at.RNG_TIME], measurement, variance,
        height_above_ground(x) - measurement, innovation_variance, gate,
    )  # fmt: skip
    finish_aid(x, aid, x[at.RNG_TIME])
    valid = math.isfinite(measurement) and math.isfinite(variance)
    if x[at.BAD_ACC_VERTICAL] and x[aid + at.A_REJECTED] and valid and healthy:
        bound = gate * math.sqrt(innovation_variance)
        x[aid + at.A_INNOVATION] = limit(x[aid + at.A_INNOVATION], -bound, bound)
        x[aid + at.A_REJECTED] = 0.0

    control = p[prm.EKF2_RNG_CTRL]
    going_on = enabled(p, SENSOR_RANGE) and control != 0.0 and x[at.TILT_ALIGN] != 0.0 and valid
    starting = (
        going_on
        and arriving(x, at.RING_RANGE, 2 * _INTERVAL)
        and x[at.RNG_REGULAR] != 0.0
        and healthy
    )
    active = x[at.RNG_TERRAIN] != 0.0 or x[at.RNG_HGT] != 0.0
    conditional = active and control == 1.0 and _low_and_slow(x, p)
    always = active and control == 2.0

    if x[at.RNG_HGT]:
        if not (conditional or always):
            _stop_height(x)
    elif starting and (conditional or always):
        _start_height(x, p, conditional)

    if x[at.RNG_HGT] or x[at.RNG_TERRAIN]:
        if going_on:
            _continue(x, p, conditional, starting, healthy)
        else:
            _stop_height(x)
            x[at.RNG_TERRAIN] = 0.0
    elif starting:
        if x[aid + at.A_REJECTED]:
            _reset_terrain(x, p)
        x[at.RNG_TERRAIN] = 1.0


@kernel
def _start_height(x, p, conditional):
    aid = at.AID_RNG_HGT
    if p[prm.EKF2_HGT_REF] == at.RANGE and not conditional:
        # the ground is the datum of height from now on
        x[at.HEIGHT_REFERENCE] = at.RANGE
        reset_altitude(x, x[aid + at.A_OBSERVATION], x[aid + at.A_VARIANCE])
        x[at.TERRAIN] = 0.0
        zero_aid(x, aid, 1)
        x[at.RNG_HGT] = 1.0
        x[at.RNG_TERRAIN] = 0.0
        return
    x[at.RNG_HGT] = 1.0
    if p[prm.EKF2_HGT_REF] == at.RANGE:
        x[at.HEIGHT_REFERENCE] = at.RANGE
        x[at.RNG_TERRAIN] = 0.0
    if x[aid + at.A_REJECTED]:
        _reset_terrain(x, p)


@kernel
def _continue(x, p, conditional, starting, healthy):
    aid = at.AID_RNG_HGT
    if conditional:
        x[at.HEIGHT_REFERENCE] = at.RANGE
    elif x[at.HEIGHT_REFERENCE] == at.RANGE:
        x[at.HEIGHT_REFERENCE] = at.UNKNOWN
    if healthy and x[at.RNG_KIN_CONSISTENT]:
        _fuse_range(x, p)
    failing = timed_out(x, x[aid + at.A_LAST_FUSE], HEIGHT_TIMEOUT)
    if (
        height_reset_required(x)
        and x[at.RNG_HGT]
        and x[at.HEIGHT_REFERENCE] == at.RANGE
        and starting
    ):
        reset_altitude(x, x[aid + at.A_OBSERVATION] - x[at.TERRAIN], math.nan)
        zero_aid(x, aid, 1)
        if vertical_velocity_sources(x) == 0.0:
            reset_vertical_velocity_to_zero(x)
    elif failing and starting:
        _reset_terrain(x, p)

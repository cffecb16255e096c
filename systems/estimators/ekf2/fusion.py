"""Fusion of one scalar observation after the other, gates, and the status of each source.

Sign convention: innovation = predicted − measured, δx = −K · innovation. The
covariance is updated in Joseph's form, (I − K H) P (I − K H)ᵀ + K R Kᵀ, which stays
right for gains that were zeroed. With g = P Hᵀ and s = H g + R it is

    P − K gᵀ − g Kᵀ + s K Kᵀ

so that one pass over half the matrix does it.
"""

import math

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.geometry import (
    from_rotation_vector,
    limit,
    matrix_of,
    metres_per_radian,
    multiply,
    normalised,
    sign,
    wrap_pi,
)

_AID_TAU = 0.5  # s, low-pass of the test ratios
_AID_RATIO_LIMIT = 4.0  # of the filtered test ratio
_MAXIMUM_RATIO = 1e6  # between the variances of a group
_MAG_BIAS_LIMIT = 0.5  # gauss


@kernel
def covariance(x):
    """The covariance as a view of shape (24, 24)."""
    return x[at.COVARIANCE : at.COVARIANCE + at.ERRORS * at.ERRORS].reshape(at.ERRORS, at.ERRORS)


@kernel
def set_rotation(x):
    """Bring the rotation matrix up to date with the quaternion."""
    q = at.QUATERNION
    m = matrix_of(x[q], x[q + 1], x[q + 2], x[q + 3])
    for i in range(9):
        x[at.ROTATION + i] = m[i]


@kernel
def move(x, north, east, down):
    """Move the position by metres."""
    per_latitude, per_longitude = metres_per_radian(x[at.LATITUDE], x[at.ALTITUDE])
    x[at.LATITUDE] = wrap_pi(x[at.LATITUDE] + north / per_latitude)
    x[at.LONGITUDE] = wrap_pi(x[at.LONGITUDE] + east / per_longitude)
    x[at.ALTITUDE] -= down


@kernel
def decorrelate(P, first, count, variance):
    """Make `count` errors from `first` on independent of all others, with one variance."""
    for i in range(first, first + count):
        for j in range(at.ERRORS):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(first, first + count):
        P[i, i] = variance


@kernel
def decorrelate_heading(x, p):
    """Make the heading error independent and limit its variance: nothing observes it."""
    P = covariance(x)
    decorrelate(P, 2, 1, min(P[2, 2], p[prm.EKF2_HEAD_NOISE] ** 2))


@kernel
def joseph(P, K, g, s):
    """Update the covariance for gains K; g = P Hᵀ and s = H P Hᵀ + R from before."""
    for i in range(at.ERRORS):
        a = K[i] * s - g[i]
        b = K[i]
        for j in range(i + 1):
            P[i, j] += a * K[j] - b * g[j]
    for i in range(at.ERRORS):
        for j in range(i):
            P[j, i] = P[i, j]


@kernel
def _constrain(x, P, first, count, low, high):
    """Hold variances between two bounds: raise small ones, fuse large ones down."""
    for i in range(first, first + count):
        if P[i, i] < low:
            P[i, i] = low
        elif P[i, i] > high:
            # clipping would strengthen the correlations, so fuse "no innovation" with 10 P
            noise = 10.0 * P[i, i]
            g = P[i].copy()
            K = g / (g[i] + noise)
            inhibit(x, K)
            joseph(P, K, g, g[i] + noise)


@kernel
def _constrain_ratio(x, P, first, count, low, high):
    """Hold variances between bounds and within a factor of 1e6 of each other."""
    largest = 0.0
    for i in range(first, first + count):
        largest = max(largest, P[i, i])
    top = limit(largest, low, high)
    _constrain(x, P, first, count, limit(top / _MAXIMUM_RATIO, low, high), top)


@kernel
def constrain_variances(x, p):
    """Hold all variances within their bounds."""
    P = covariance(x)
    _constrain(x, P, at.E_ROTATION, 3, 1e-9, 1.0)
    if not x[at.HEADING_OBSERVABLE]:
        decorrelate_heading(x, p)
    _constrain(x, P, at.E_VELOCITY, 3, 1e-6, 1e6)
    _constrain(x, P, at.E_POSITION, 3, 1e-6, 1e6)
    _constrain_ratio(x, P, at.E_GYRO_BIAS, 3, 1e-9, 1.0)
    _constrain_ratio(x, P, at.E_ACCEL_BIAS, 3, 1e-9, 1.0)
    if x[at.MAG]:
        _constrain_ratio(x, P, at.E_MAG_EARTH, 3, 1e-6, 1.0)
        _constrain_ratio(x, P, at.E_MAG_BODY, 3, 1e-6, 1.0)
    if x[at.WIND_ESTIMATED]:
        _constrain_ratio(x, P, at.E_WIND, 2, 1e-6, 1e6)
    _constrain_ratio(x, P, at.E_TERRAIN, 1, 0.0, 1e4)


@kernel
def inhibit(x, K):
    """Zero the gains of states that must not be corrected now."""
    if not x[at.HEADING_OBSERVABLE]:
        K[2] = 0.0
    for i in range(3):
        if x[at.GYRO_BIAS_INHIBITED]:
            K[at.E_GYRO_BIAS + i] = 0.0
        if x[at.ACCEL_BIAS_INHIBITED + i]:
            K[at.E_ACCEL_BIAS + i] = 0.0
        if not x[at.MAG]:
            K[at.E_MAG_EARTH + i] = 0.0
            K[at.E_MAG_BODY + i] = 0.0


@kernel
def correct_state(x, p, K, innovation):
    """Apply δx = −K · innovation to the nominal state."""
    d0, d1, d2, d3 = from_rotation_vector(
        -K[0] * innovation, -K[1] * innovation, -K[2] * innovation
    )
    q = at.QUATERNION
    n0, n1, n2, n3 = multiply(d0, d1, d2, d3, x[q], x[q + 1], x[q + 2], x[q + 3])
    x[q], x[q + 1], x[q + 2], x[q + 3] = normalised(n0, n1, n2, n3)
    set_rotation(x)
    move(x, -K[6] * innovation, -K[7] * innovation, -K[8] * innovation)
    gyro_limit, accel_limit = p[prm.EKF2_GYR_B_LIM], p[prm.EKF2_ABL_LIM]
    for i in range(3):
        v = at.VELOCITY + i
        x[v] = limit(x[v] - K[at.E_VELOCITY + i] * innovation, -1e3, 1e3)
        b = at.GYRO_BIAS + i
        x[b] = limit(x[b] - K[at.E_GYRO_BIAS + i] * innovation, -gyro_limit, gyro_limit)
        b = at.ACCEL_BIAS + i
        x[b] = limit(x[b] - K[at.E_ACCEL_BIAS + i] * innovation, -accel_limit, accel_limit)
        if x[at.MAG]:
            m = at.MAG_EARTH + i
            x[m] = limit(x[m] - K[at.E_MAG_EARTH + i] * innovation, -1.0, 1.0)
            m = at.MAG_BODY + i
            x[m] = limit(
                x[m] - K[at.E_MAG_BODY + i] * innovation, -_MAG_BIAS_LIMIT, _MAG_BIAS_LIMIT
            )
    if x[at.WIND_ESTIMATED]:
        for i in range(2):
            w = at.WIND + i
            x[w] = limit(x[w] - K[at.E_WIND + i] * innovation, -1e2, 1e2)
    x[at.TERRAIN] = limit(x[at.TERRAIN] - K[at.E_TERRAIN] * innovation, -1e4, 1e4)


@kernel
def fuse_state(x, p, error, innovation, innovation_variance, noise):
    """Fuse a direct observation of one state.

    Parameters
    ----------
    error : int
        Which error state is observed.
    innovation, innovation_variance : float
        Predicted minus measured, and its variance for the gain.
    noise : float
        The variance of the observation for the covariance.
    """
    P = covariance(x)
    g = P[error].copy()
    K = g / innovation_variance
    inhibit(x, K)
    joseph(P, K, g, g[error] + noise)
    constrain_variances(x, p)
    correct_state(x, p, K, innovation)


@kernel
def fuse_gains(x, p, K, g, predicted_variance, noise, innovation):
    """Fuse an observation with gains K; g = P Hᵀ, predicted_variance = H P Hᵀ."""
    inhibit(x, K)
    joseph(covariance(x), K, g, predicted_variance + noise)
    constrain_variances(x, p)
    correct_state(x, p, K, innovation)


@kernel
def project_covariance(P, H, g):
    """Write P Hᵀ into `g` and return H P Hᵀ."""
    g[:] = 0.0
    for k in range(at.ERRORS):
        if H[k] != 0.0:
            for j in range(at.ERRORS):
                g[j] += H[k] * P[k, j]
    variance = 0.0
    for k in range(at.ERRORS):
        variance += H[k] * g[k]
    return variance


@kernel
def set_aid(x, aid, axis, time, observation, variance, innovation, innovation_variance, gate):
    """Put one axis of an observation into its source's status and test its innovation.

    The axes must come in order, and `finish_aid` after the last one.
    """
    a = aid + axis * at.A_AXIS
    ratio = innovation * innovation / (gate * gate * innovation_variance)
    before = x[aid + at.A_TIME]
    if before > 0.0 and time > before:
        dt = limit((time - before) * 1e-6, 0.001, 1.0)
        filtered = x[a + at.A_TEST_RATIO_FILTERED]
        if math.isfinite(filtered):
            filtered += dt / (dt + _AID_TAU) * (sign(innovation) * ratio - filtered)
        else:
            filtered = ratio
        if ratio > _AID_RATIO_LIMIT:
            filtered = limit(filtered, -_AID_RATIO_LIMIT, _AID_RATIO_LIMIT)
        x[a + at.A_TEST_RATIO_FILTERED] = filtered
    else:
        x[a + at.A_TEST_RATIO_FILTERED] = ratio
    x[a + at.A_TEST_RATIO] = ratio
    x[a + at.A_OBSERVATION] = observation
    x[a + at.A_VARIANCE] = variance
    x[a + at.A_INNOVATION] = innovation
    x[a + at.A_INNOVATION_VARIANCE] = innovation_variance
    bad = not (ratio <= 1.0 and math.isfinite(innovation) and math.isfinite(innovation_variance))
    if axis == 0:
        x[aid + at.A_REJECTED] = bad
        x[aid + at.A_FUSED] = 0.0
    elif bad:
        x[aid + at.A_REJECTED] = 1.0


@kernel
def finish_aid(x, aid, time):
    """Stamp the status of a source after its last axis."""
    x[aid + at.A_TIME] = time


@kernel
def zero_aid(x, aid, axes):
    """Note that the state was reset to the observation: innovation zero, fused now."""
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    x[aid + at.A_REJECTED] = 0.0
    x[aid + at.A_FUSED] = 1.0
    for axis in range(axes):
        a = aid + axis * at.A_AXIS
        x[a + at.A_INNOVATION] = 0.0
        x[a + at.A_INNOVATION_VARIANCE] = x[a + at.A_VARIANCE]
        x[a + at.A_TEST_RATIO] = 0.0
        x[a + at.A_TEST_RATIO_FILTERED] = 0.0


@kernel
def fuse_aid(x, p, aid, axes, first_error):
    """Fuse the axes of a source into consecutive states unless it was rejected."""
    if x[aid + at.A_REJECTED]:
        x[aid + at.A_FUSED] = 0.0
        return False
    for axis in range(axes):
        a = aid + axis * at.A_AXIS
        fuse_state(
            x,
            p,
            first_error + axis,
            x[a + at.A_INNOVATION],
            x[a + at.A_INNOVATION_VARIANCE],
            x[a + at.A_VARIANCE],
        )
    x[aid + at.A_FUSED] = 1.0
    x[aid + at.A_LAST_FUSE] = x[at.TIME_DELAYED]
    return True


@kernel
def fuse_horizontal_position(x, p, aid):
    """Fuse north and east; true if done."""
    fused = fuse_aid(x, p, aid, 2, at.E_POSITION)
    if fused:
        x[at.T_HORIZONTAL_POSITION] = x[at.TIME_DELAYED]
    return fused


@kernel
def fuse_height(x, p, aid):
    """Fuse the vertical position; true if done."""
    fused = fuse_aid(x, p, aid, 1, at.E_POSITION + 2)
    if fused:
        x[at.T_HEIGHT] = x[at.TIME_DELAYED]
    return fused


@kernel
def fuse_velocity(x, p, aid):
    """Fuse a velocity in NED; true if done."""
    fused = fuse_aid(x, p, aid, 3, at.E_VELOCITY)
    if fused:
        x[at.T_HORIZONTAL_VELOCITY] = x[at.T_VERTICAL_VELOCITY] = x[at.TIME_DELAYED]
    return fused


@kernel
def set_height_aid(x, aid, time, observation, variance, gate):
    """Test an observation of the vertical position (m, down).

    With a bad accelerometer the innovation is limited instead of rejected.
    """
    predicted_variance = covariance(x)[8, 8] + variance
    set_aid(
        x, aid, 0, time, observation, variance, -x[at.ALTITUDE] - observation,
        predicted_variance, gate,
    )  # fmt: skip
    finish_aid(x, aid, time)
    if x[at.BAD_ACC_VERTICAL] and x[aid + at.A_REJECTED]:
        bound = gate * math.sqrt(predicted_variance)
        x[aid + at.A_INNOVATION] = limit(x[aid + at.A_INNOVATION], -bound, bound)
        x[aid + at.A_REJECTED] = 0.0


@kernel
def timed_out(x, time, period):
    """Whether `time` (us; 0 never) is more than `period` behind the horizon."""
    return time == 0.0 or time + period < x[at.TIME_DELAYED]


@kernel
def recent(x, time, period):
    """Whether `time` (us; 0 never) is less than `period` behind the horizon."""
    return time != 0.0 and time + period > x[at.TIME_DELAYED]

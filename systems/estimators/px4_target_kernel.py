"""One axis of PX4's two landing-target filters, compiled; see `px4_target` for the equations."""

import numpy as np
from numba import njit

from systems.signals.measurement import (
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    VALID,
    VEHICLE_ESTIMATE,
    Layout,
)

# landing_target_estimator: an axis is [r, v, P_rr, P_rv, P_vv]
AXIS = 5


@njit(cache=True)
def initialise_axis(a, position, velocity, position_variance, velocity_variance):
    """Set the axis a (5,) to a position and velocity that are not correlated."""
    a[0], a[1] = position, velocity
    a[2], a[3], a[4] = position_variance, 0.0, velocity_variance


@njit(cache=True)
def predict_axis(a, dt, acceleration, acceleration_variance):
    """Predict the axis a (5,) by dt under a known acceleration with a variance."""
    a[0] += a[1] * dt + 0.5 * dt * dt * acceleration
    a[1] += acceleration * dt
    g = 0.5 * dt * dt
    a[2] += dt * (2.0 * a[3] + dt * a[4]) + g * g * acceleration_variance
    a[3] += dt * a[4] + g * dt * acceleration_variance
    a[4] += dt * dt * acceleration_variance


@njit(cache=True)
def fuse_axis(a, position, variance, gate):
    """Fuse a measured position into the axis a (5,) unless its NIS exceeds the gate.

    Returns innovation, innovation variance and whether it was fused.
    """
    innovation = position - a[0]
    total = a[2] + variance
    if innovation * innovation / total > gate:
        return innovation, total, False
    k0, k1 = a[2] / total, a[3] / total
    a[0] += k0 * innovation
    a[1] += k1 * innovation
    a[4] -= k1 * a[3]
    a[3] -= k0 * a[3]
    a[2] -= k0 * a[2]
    return innovation, total, True


# vision_target_estimator: an axis is a table of snapshots, the last row the present.
# A row is [time, r, v, b, P row by row (9), acceleration on the way to it].
SNAPSHOT = 14
_TIME, _STATE, _P, _ACCELERATION = 0, 1, 4, 13
HISTORY_TIME = 0.5  # s, older measurements are rejected
_MINIMUM_VARIANCE = 1e-9

FUSED_NOW, FUSED_LATE, REJECTED_GATE, REJECTED_OLD, REJECTED_EMPTY, REJECTED_NEW, RESET = range(7)


@njit(cache=True)
def start_vision_axis(axis, t, position, velocity, variances):
    """Begin the axis (n + 1, 14) without history at time t; `variances` of r, v, b."""
    axis[:] = 0.0
    axis[:, _TIME] = -1.0
    present = axis[-1]
    present[_TIME] = t
    present[_STATE], present[_STATE + 1] = position, velocity
    for i in range(3):
        present[_P + 4 * i] = variances[i]


@njit(cache=True)
def _predict_row(row, dt, acceleration, input_density, bias_density):
    """Predict by dt: r' = −v, v' = acceleration, b' = 0, with white noise on the latter two."""
    r, v = row[_STATE], row[_STATE + 1]
    row[_STATE] = r - dt * v - 0.5 * dt * dt * acceleration
    row[_STATE + 1] = v + dt * acceleration
    P = row[_P : _P + 9].reshape(3, 3)
    for j in range(3):
        P[0, j] -= dt * P[1, j]
    for i in range(3):
        P[i, 0] -= dt * P[i, 1]
    P[0, 0] += dt * dt * dt / 3.0 * input_density
    P[0, 1] -= 0.5 * dt * dt * input_density
    P[1, 0] -= 0.5 * dt * dt * input_density
    P[1, 1] += dt * input_density
    P[2, 2] += dt * bias_density


@njit(cache=True)
def _correct_row(row, k, innovation, total):
    P = row[_P : _P + 9].reshape(3, 3)
    for i in range(3):
        row[_STATE + i] += k[i] * innovation
        for j in range(3):
            P[i, j] -= k[i] * k[j] * total
    for i in range(3):
        P[i, i] = max(P[i, i], _MINIMUM_VARIANCE)


@njit(cache=True)
def predict_vision_axis(axis, t, acceleration, input_density, bias_density):
    """Predict the present row of the axis to time t under the vehicle's acceleration."""
    present = axis[-1]
    _predict_row(present, t - present[_TIME], acceleration, input_density, bias_density)
    present[_TIME] = t
    present[_ACCELERATION] = acceleration


@njit(cache=True)
def keep_snapshot(axis):
    """Append the present row to the history, the oldest snapshot of a full one being lost."""
    n = axis.shape[0] - 1
    for i in range(n):
        axis[i] = axis[i + 1]


@njit(cache=True)
def _gain(row, h, value, variance, gate, k):
    """Innovation, its variance, and whether it passes the gate; writes the gain."""
    P = row[_P : _P + 9].reshape(3, 3)
    innovation, total = value, variance
    for i in range(3):
        innovation -= h[i] * row[_STATE + i]
        k[i] = 0.0
        for j in range(3):
            k[i] += P[i, j] * h[j]
    for i in range(3):
        total += h[i] * k[i]
    for i in range(3):
        k[i] /= total
    return innovation, total, innovation * innovation / total <= gate


@njit(cache=True)
def fuse_vision_axis(axis, t_measured, value, variance, h, gate, step, input_density, bias_density):
    """Fuse z = h·[r, v, b] of a past time; the correction is carried on to the present.

    A measurement older than one step is fused into a snapshot predicted to its time, which
    stays in the history; every later row is corrected with the gain that its transition
    matrix makes of the first, k_i = Φ k.

    Parameters
    ----------
    axis : array of shape (n + 1, 14)
    t_measured, value, variance : float
    h : array of shape (3,)
    gate : float
        On the NIS.
    step : float
        s, a measurement nearer to the present than this is fused as a present one.
    input_density, bias_density : float
        As in the prediction.

    Returns
    -------
    status, innovation, innovation variance
        The latter two 0 where the measurement was not looked at.
    """
    n = axis.shape[0] - 1
    present = axis[n]
    t = present[_TIME]
    k = np.empty(3)
    if abs(t - t_measured) < step:
        innovation, total, passed = _gain(present, h, value, variance, gate, k)
        if passed:
            _correct_row(present, k, innovation, total)
        return (FUSED_NOW if passed else REJECTED_GATE), innovation, total
    first = n
    while first > 0 and axis[first - 1, _TIME] >= 0.0:
        first -= 1
    if first == n:
        return REJECTED_EMPTY, 0.0, 0.0
    if t - axis[n - 1, _TIME] > HISTORY_TIME:
        axis[:n, _TIME] = -1.0
        return RESET, 0.0, 0.0
    if t_measured > t:
        return REJECTED_NEW, 0.0, 0.0
    if t - t_measured > HISTORY_TIME or t_measured < axis[first, _TIME]:
        return REJECTED_OLD, 0.0, 0.0
    floor = n - 1
    while axis[floor, _TIME] > t_measured:
        floor -= 1

    row = axis[floor].copy()
    acceleration = axis[floor + 1, _ACCELERATION]
    if t_measured > row[_TIME]:
        _predict_row(row, t_measured - row[_TIME], acceleration, input_density, bias_density)
    innovation, total, passed = _gain(row, h, value, variance, gate, k)
    if not passed:
        return REJECTED_GATE, innovation, total
    _correct_row(row, k, innovation, total)
    later = floor + 1
    if t_measured > row[_TIME]:
        row[_TIME] = t_measured
        row[_ACCELERATION] = acceleration
        # The oldest snapshot (or the unused row before it) makes room.
        for i in range(floor):
            axis[i] = axis[i + 1]
    axis[floor] = row
    previous = t_measured
    for i in range(later, n + 1):
        k[0] -= (axis[i, _TIME] - previous) * k[1]
        previous = axis[i, _TIME]
        _correct_row(axis[i], k, innovation, total)
    return FUSED_LATE, innovation, total


# The filters as a whole, on the layouts of the ports.

PARAMETERS = Layout(
    "PX4TargetParameters",
    (
        "acceleration_variance",  # (m/s2)2
        "measurement_variance",  # 1, R = this · height²
        "initial_position_variance",  # m2
        "initial_velocity_variance",  # (m/s)2
        "gate",  # on the NIS of each axis
        "lost_time",  # s
        "period",  # s
    ),
)
MEMORY = Layout(
    "PX4TargetMemory",
    (
        "last_arrival",  # s
        "initialised",  # 0/1
        "last_update",  # s
        "rejected",  # measurements in a row
        "vertical",  # m, p_BP_W z
        *(f"{axis}_{name}" for axis in "xy" for name in ("r", "v", "prr", "prv", "pvv")),
    ),
)
VISION_PARAMETERS = Layout(
    "PX4VisionTargetParameters",
    (
        "acceleration_density",  # m2/s3
        "bias_density",  # m2/s
        "initial_position_variance",  # m2
        "initial_velocity_variance",  # (m/s)2
        "initial_bias_variance",  # m2
        "minimum_position_variance",  # m2
        "gate",
        "lost_time",  # s
        "stop_time",  # s
        "period",  # s
    ),
)
SNAPSHOTS = 32  # 0.64 s of 20 ms
VISION_MEMORY = Layout(
    "PX4VisionTargetMemory",
    (
        "last_arrival",  # s
        "initialised",  # 0/1, 2 with a measurement fused since
        "last_update",  # s
        "rejected",  # measurements in a row
        *(
            f"axis_{axis}_{row}_{entry}"
            for axis in "xyz"
            for row in range(SNAPSHOTS + 1)
            for entry in range(SNAPSHOT)
        ),
    ),
)

_ARRIVAL, _INITIALISED, _UPDATE, _REJECTED, _Z, _AXES = range(6)
_ROWS = 4  # where the snapshots begin in VISION_MEMORY
_CONFIRMED = 2.0
_E_VALID = VEHICLE_ESTIMATE.index("horizontal_valid")
_E_V = VEHICLE_ESTIMATE.index("v_WB_x")
_E_A = VEHICLE_ESTIMATE.index("a_WB_x")
_M_P = TARGET_MEASUREMENT.index("p_BP_W_x")
_M_VARIANCE = (
    TARGET_MEASUREMENT.index("covariance_xx"),
    TARGET_MEASUREMENT.index("covariance_yy"),
    TARGET_MEASUREMENT.index("covariance_zz"),
)
_M_SOURCE = TARGET_MEASUREMENT.index("source")
_VALIDITY, _ACQUIRED, _FUSED, _OUT_P = range(4)
_OUT_V = TARGET_ESTIMATE.index("v_BP_W_x")
_OUT_P_VARIANCE = TARGET_ESTIMATE.index("position_variance_x")
_OUT_V_VARIANCE = TARGET_ESTIMATE.index("velocity_variance_x")
_OUT_RATIO = TARGET_ESTIMATE.index("innovation_test_ratio")
_OUT_REJECTED = TARGET_ESTIMATE.index("rejected_count")
_OUT_SOURCE = TARGET_ESTIMATE.index("source")
_POSITION = np.array([1.0, 0.0, 0.0])  # h of z = r


@njit(cache=True)
def step(target, m, t, measurement, estimate, parameters):
    """One update of `landing_target_estimator` at time t.

    Parameters
    ----------
    target : array of shape (TARGET_ESTIMATE.size,)
        Updated in place.
    m : array of shape (MEMORY.size,)
        Updated in place.
    t : float
        s.
    measurement, estimate : arrays
        Of the layouts TARGET_MEASUREMENT and VEHICLE_ESTIMATE.
    parameters : array of shape (PARAMETERS.size,)
    """
    (
        acceleration_variance,
        measurement_variance,
        position_variance,
        velocity_variance,
        gate,
        lost_time,
        dt,
    ) = parameters
    if t - m[_UPDATE] > lost_time:
        m[_INITIALISED] = target[_ACQUIRED] = 0.0
    m[_Z] -= estimate[_E_V + 2] * dt
    if m[_INITIALISED] > 0.0:
        for i in range(2):
            axis = m[_AXES + AXIS * i : _AXES + AXIS * (i + 1)]
            predict_axis(axis, dt, -estimate[_E_A + i], acceleration_variance)

    if measurement[VALID] > 0.0 and measurement[TIME_OF_ARRIVAL] != m[_ARRIVAL]:
        m[_ARRIVAL] = measurement[TIME_OF_ARRIVAL]
        m[_Z] = measurement[_M_P + 2]
        target[_OUT_SOURCE] = measurement[_M_SOURCE]
        target[_OUT_P_VARIANCE + 2] = measurement[_M_VARIANCE[2]]
        if m[_INITIALISED] == 0.0:
            for i in range(2):
                axis = m[_AXES + AXIS * i : _AXES + AXIS * (i + 1)]
                velocity = -estimate[_E_V + i] if estimate[_E_VALID] > 0.0 else 0.0
                position = measurement[_M_P + i]
                initialise_axis(axis, position, velocity, position_variance, velocity_variance)
            m[_INITIALISED] = 1.0
            m[_UPDATE] = t
            m[_REJECTED] = 0.0
        else:
            variance = measurement_variance * measurement[_M_P + 2] * measurement[_M_P + 2]
            both = True
            target[_OUT_RATIO] = 0.0
            for i in range(2):
                axis = m[_AXES + AXIS * i : _AXES + AXIS * (i + 1)]
                innovation, total, fused = fuse_axis(axis, measurement[_M_P + i], variance, gate)
                both &= fused
                ratio = innovation * innovation / total / gate
                target[_OUT_RATIO] = max(target[_OUT_RATIO], ratio)
            if both:
                m[_UPDATE] = t
                m[_REJECTED] = 0.0
                target[_ACQUIRED] = 1.0
                target[_FUSED] = measurement[TIME_OF_VALIDITY]
            else:
                m[_REJECTED] += 1.0

    target[_VALIDITY] = t
    target[_OUT_REJECTED] = m[_REJECTED]
    if m[_INITIALISED] == 0.0:
        return
    for i in range(2):
        axis = m[_AXES + AXIS * i : _AXES + AXIS * (i + 1)]
        target[_OUT_P + i], target[_OUT_V + i] = axis[0], axis[1]
        target[_OUT_P_VARIANCE + i], target[_OUT_V_VARIANCE + i] = axis[2], axis[4]
    target[_OUT_P + 2] = m[_Z]
    target[_OUT_V + 2] = -estimate[_E_V + 2]


@njit(cache=True)
def vision_step(target, m, t, measurement, estimate, parameters):
    """One update of `vision_target_estimator` at time t; parameters as in `step`."""
    (
        input_density,
        bias_density,
        position_variance,
        velocity_variance,
        bias_variance,
        minimum_position_variance,
        gate,
        lost_time,
        stop_time,
        dt,
    ) = parameters
    axes = m[_ROWS:].reshape(3, SNAPSHOTS + 1, SNAPSHOT)
    target[_VALIDITY] = t
    new = measurement[VALID] > 0.0 and measurement[TIME_OF_ARRIVAL] != m[_ARRIVAL]
    if t - m[_UPDATE] > stop_time:
        m[_INITIALISED] = 0.0
    if m[_INITIALISED] == 0.0:
        target[_ACQUIRED] = 0.0
        if not new:
            return
        # The first measurement is carried on to now with the vehicle's velocity.
        variances = np.array([position_variance, velocity_variance, bias_variance])
        age = t - measurement[TIME_OF_VALIDITY]
        for i in range(3):
            speed = estimate[_E_V + i]
            position = measurement[_M_P + i] - age * speed
            start_vision_axis(axes[i], t, position, speed, variances)
        m[_ARRIVAL] = measurement[TIME_OF_ARRIVAL]
        m[_INITIALISED] = 1.0
        m[_UPDATE] = t
        m[_REJECTED] = 0.0
    else:
        for i in range(3):
            predict_vision_axis(axes[i], t, estimate[_E_A + i], input_density, bias_density)
        if new:
            m[_ARRIVAL] = measurement[TIME_OF_ARRIVAL]
            all_fused = True
            target[_OUT_RATIO] = 0.0
            for i in range(3):
                status, innovation, total = fuse_vision_axis(
                    axes[i],
                    measurement[TIME_OF_VALIDITY],
                    measurement[_M_P + i],
                    max(measurement[_M_VARIANCE[i]], minimum_position_variance),
                    _POSITION,
                    gate,
                    dt,
                    input_density,
                    bias_density,
                )
                all_fused &= status <= FUSED_LATE
                if total > 0.0:
                    ratio = innovation * innovation / total / gate
                    target[_OUT_RATIO] = max(target[_OUT_RATIO], ratio)
            target[_OUT_SOURCE] = measurement[_M_SOURCE]
            if all_fused:
                m[_UPDATE] = t
                m[_INITIALISED] = _CONFIRMED
                m[_REJECTED] = 0.0
                target[_FUSED] = measurement[TIME_OF_VALIDITY]
            else:
                m[_REJECTED] += 1.0
        seen = m[_INITIALISED] == _CONFIRMED and t - m[_UPDATE] <= lost_time
        target[_ACQUIRED] = 1.0 if seen else 0.0

    target[_OUT_REJECTED] = m[_REJECTED]
    for i in range(3):
        present = axes[i, SNAPSHOTS]
        target[_OUT_P + i] = present[_STATE]
        target[_OUT_V + i] = -present[_STATE + 1]
        target[_OUT_P_VARIANCE + i] = present[_P]
        target[_OUT_V_VARIANCE + i] = present[_P + 4]
        keep_snapshot(axes[i])

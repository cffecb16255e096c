"""An emergency yaw from IMU and GNSS velocity alone: a Gaussian sum of five small filters.

Each model is an attitude by gyros and gravity with a heading of its own, and a
three-state Kalman filter of north velocity, east velocity and yaw; the models start
72 degrees apart and are weighted by the likelihood of their velocity innovations.
As soon as the vehicle accelerates, one of them wins.
"""

import math

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.geometry import (
    FLOAT_EPSILON,
    from_rotation_vector,
    limit,
    matrix_of,
    multiply,
    normalised,
    quaternion_of,
    tilt_quaternion,
    with_yaw,
    wrap_pi,
    yaw_of,
)

_GYRO_NOISE = 0.1  # rad/s
_ACCEL_NOISE = 2.0  # m/s2
_TILT_GAIN = 0.2  # 1/s
_GYRO_BIAS_GAIN = 0.04  # 1/s
_GYRO_BIAS_LIMIT = 0.05  # rad/s
_MAXIMUM_SPIN = math.radians(10.0)  # rad/s, no bias learning above
_LEAST_VARIANCE = 1e-6
_LEAST_WEIGHT = 1e-5
_INNOVATION_LIMIT = 25.0  # 5 sigma, squared
_MAXIMUM_VARIANCE = 0.262**2  # rad2, of a converged estimate


@kernel
def reset_yaw_estimator(x):
    """Wait for velocities again."""
    x[at.GSF_STARTED] = 0.0
    x[at.GSF_VARIANCE] = math.inf


@kernel
def yaw_estimate_available(x):
    """Whether the estimate has converged."""
    return bool(x[at.GSF_STARTED]) and 0.0 < x[at.GSF_VARIANCE] < _MAXIMUM_VARIANCE


@kernel
def set_yaw_estimator_bias(x):
    """Give the main filter's gyro bias to all models, until they run or while at rest."""
    if x[at.GSF_TILT_ALIGNED] and x[at.GSF_STARTED] and not x[at.AT_REST]:
        return
    for model in range(at.MODELS):
        m = at.GSF + model * at.G_SIZE
        for i in range(3):
            x[m + at.G_GYRO_BIAS + i] = x[at.GYRO_BIAS + i]


@kernel
def predict_yaw_estimator(x):
    """Advance all models by the sample at the horizon."""
    dt = x[at.IMU_VELOCITY_DT]
    if dt <= 0.001:
        return
    a = at.GSF_ACCEL
    alpha = min(10.0 * dt * _TILT_GAIN, 1.0)
    raw2 = 0.0
    filtered2 = 0.0
    for i in range(3):
        accel = x[at.IMU_DELTA_VELOCITY + i] / dt
        x[a + i] += alpha * (accel - x[a + i])
        raw2 += accel * accel
        filtered2 += x[a + i] * x[a + i]
    g2 = at.STANDARD_GRAVITY * at.STANDARD_GRAVITY
    if not x[at.GSF_TILT_ALIGNED]:
        if not (0.81 * g2 < raw2 < 1.21 * g2 and 0.81 * g2 < filtered2 < 1.21 * g2):
            return
        v = at.IMU_DELTA_VELOCITY
        q0, q1, q2, q3 = tilt_quaternion(x[v], x[v + 1], x[v + 2])
        for model in range(at.MODELS):
            m = at.GSF + model * at.G_SIZE
            x[m], x[m + 1], x[m + 2], x[m + 3] = q0, q1, q2, q3
        x[at.GSF_TILT_ALIGNED] = 1.0
    norm = math.sqrt(filtered2)
    off = min(2.0 * abs(norm / at.STANDARD_GRAVITY - 1.0), 1.0)
    gain = _TILT_GAIN * (1.0 - off) ** 2
    in_air = x[at.IN_AIR] and not x[at.AT_REST]
    for model in range(at.MODELS):
        m = at.GSF + model * at.G_SIZE
        _predict_attitude(x, m, gain / norm if gain > 0.0 else 0.0)
        if x[at.GSF_STARTED]:
            _predict_model(x, m, _ACCEL_NOISE if in_air else 2.0 * _ACCEL_NOISE)


@kernel
def _predict_attitude(x, m, gain):
    """Complementary filter of one model: gyros, pulled upright by the mean acceleration."""
    q0, q1, q2, q3 = x[m], x[m + 1], x[m + 2], x[m + 3]
    dt = x[at.IMU_ANGLE_DT]
    # direction of gravity in the body frame, the last row of the rotation matrix
    gx, gy = 2.0 * (q1 * q3 - q0 * q2), 2.0 * (q2 * q3 + q0 * q1)
    gz = q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
    ax, ay, az = x[at.GSF_ACCEL], x[at.GSF_ACCEL + 1], x[at.GSF_ACCEL + 2]
    tx, ty, tz = gain * (gy * az - gz * ay), gain * (gz * ax - gx * az), gain * (gx * ay - gy * ax)
    b = m + at.G_GYRO_BIAS
    step = max(dt, 0.001)
    spin2 = 0.0
    for i in range(3):
        spin2 += (x[at.IMU_DELTA_ANGLE + i] / step - x[b + i]) ** 2
    if spin2 < _MAXIMUM_SPIN * _MAXIMUM_SPIN:
        k = _GYRO_BIAS_GAIN * dt
        x[b] = limit(x[b] - tx * k, -_GYRO_BIAS_LIMIT, _GYRO_BIAS_LIMIT)
        x[b + 1] = limit(x[b + 1] - ty * k, -_GYRO_BIAS_LIMIT, _GYRO_BIAS_LIMIT)
        x[b + 2] = limit(x[b + 2] - tz * k, -_GYRO_BIAS_LIMIT, _GYRO_BIAS_LIMIT)
    d0, d1, d2, d3 = from_rotation_vector(
        x[at.IMU_DELTA_ANGLE] + (tx - x[b]) * dt,
        x[at.IMU_DELTA_ANGLE + 1] + (ty - x[b + 1]) * dt,
        x[at.IMU_DELTA_ANGLE + 2] + (tz - x[b + 2]) * dt,
    )
    n0, n1, n2, n3 = multiply(q0, q1, q2, q3, d0, d1, d2, d3)
    x[m], x[m + 1], x[m + 2], x[m + 3] = normalised(n0, n1, n2, n3)


@kernel
def _predict_model(x, m, accel_noise):
    """Velocity and yaw of one model; F differs from I in ∂v/∂ψ, the turned delta velocity."""
    R = matrix_of(x[m], x[m + 1], x[m + 2], x[m + 3])
    v = at.IMU_DELTA_VELOCITY
    dn = R[0] * x[v] + R[1] * x[v + 1] + R[2] * x[v + 2]
    de = R[3] * x[v] + R[4] * x[v + 1] + R[5] * x[v + 2]
    s = m + at.G_STATE
    x[s + 2] = yaw_of(R)
    velocity_noise = (accel_noise * x[at.IMU_VELOCITY_DT]) ** 2
    yaw_noise = (_GYRO_NOISE * x[at.IMU_ANGLE_DT]) ** 2
    c = m + at.G_COVARIANCE  # 3 x 3, symmetric
    p02 = x[c + 2] - de * x[c + 8]
    p12 = x[c + 5] + dn * x[c + 8]
    p00 = x[c] - de * x[c + 2] - de * p02 + velocity_noise
    p01 = x[c + 1] - de * x[c + 5] + dn * p02
    p11 = x[c + 4] + dn * x[c + 5] + dn * p12 + velocity_noise
    _set_covariance(x, c, p00, p01, p02, p11, p12, x[c + 8] + yaw_noise)
    x[s] += dn
    x[s + 1] += de


@kernel
def _set_covariance(x, c, p00, p01, p02, p11, p12, p22):
    x[c] = max(p00, _LEAST_VARIANCE)
    x[c + 1] = x[c + 3] = p01
    x[c + 2] = x[c + 6] = p02
    x[c + 4] = max(p11, _LEAST_VARIANCE)
    x[c + 5] = x[c + 7] = p12
    x[c + 8] = max(p22, _LEAST_VARIANCE)


@kernel
def _start_models(x, vn, ve, accuracy):
    x[at.GSF_YAW] = 0.0
    x[at.GSF_VARIANCE] = (0.5 * math.pi) ** 2
    spacing = 2.0 * math.pi / at.MODELS
    variance = max(accuracy, 0.01) ** 2
    for model in range(at.MODELS):
        m = at.GSF + model * at.G_SIZE
        yaw = -math.pi + (model + 0.5) * spacing
        x[m + at.G_STATE], x[m + at.G_STATE + 1], x[m + at.G_STATE + 2] = vn, ve, yaw
        x[m + at.G_COVARIANCE : m + at.G_WEIGHT] = 0.0
        x[m + at.G_COVARIANCE] = x[m + at.G_COVARIANCE + 4] = variance
        x[m + at.G_COVARIANCE + 8] = (0.5 * spacing) ** 2
        x[m + at.G_WEIGHT] = 1.0 / at.MODELS
        R = with_yaw(wrap_pi(yaw), matrix_of(x[m], x[m + 1], x[m + 2], x[m + 3]))
        x[m], x[m + 1], x[m + 2], x[m + 3] = quaternion_of(R)


@kernel
def _update_model(x, m, vn, ve, noise):
    """Fuse the velocity into one model, as two observations at once."""
    c, s = m + at.G_COVARIANCE, m + at.G_STATE
    p00, p01, p02, p11, p12, p22 = x[c], x[c + 1], x[c + 2], x[c + 4], x[c + 5], x[c + 8]
    s00, s11 = p00 + noise, p11 + noise
    inverse = 1.0 / (s00 * s11 - p01 * p01)
    inverse += FLOAT_EPSILON * (1.0 if inverse >= 0.0 else -1.0)
    x[m + at.G_DETERMINANT] = inverse
    i00, i01, i11 = s11 * inverse, -p01 * inverse, s00 * inverse
    k00, k01 = p00 * i00 + p01 * i01, p00 * i01 + p01 * i11
    k10, k11 = p01 * i00 + p11 * i01, p01 * i01 + p11 * i11
    k20, k21 = p02 * i00 + p12 * i01, p02 * i01 + p12 * i11
    _set_covariance(
        x,
        c,
        p00 - k00 * p00 - k01 * p01,
        p01 - k00 * p01 - k01 * p11,
        p02 - k00 * p02 - k01 * p12,
        p11 - k10 * p01 - k11 * p11,
        p12 - k10 * p02 - k11 * p12,
        p22 - k20 * p02 - k21 * p12,
    )
    n, e = x[s] - vn, x[s + 1] - ve
    nis = n * (i00 * n + i01 * e) + e * (i01 * n + i11 * e)
    if nis > _INNOVATION_LIMIT:
        shrink = math.sqrt(_INNOVATION_LIMIT / nis)
        n, e, nis = n * shrink, e * shrink, _INNOVATION_LIMIT
    x[m + at.G_INNOVATION], x[m + at.G_INNOVATION + 1], x[m + at.G_NIS] = n, e, nis
    turn = -(k20 * n + k21 * e)
    x[s] -= k00 * n + k01 * e
    x[s + 1] -= k10 * n + k11 * e
    x[s + 2] = wrap_pi(x[s + 2] + turn)
    n0, n1, n2, n3 = multiply(
        math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn), x[m], x[m + 1], x[m + 2], x[m + 3]
    )
    x[m], x[m + 1], x[m + 2], x[m + 3] = normalised(n0, n1, n2, n3)


@kernel
def fuse_yaw_estimator(x, vn, ve, accuracy):
    """Fuse a velocity (m/s, north and east) of the given sigma into all models."""
    if not x[at.GSF_STARTED]:
        _start_models(x, vn, ve, accuracy)
        # in the air, or on the ground once it moves
        if x[at.IN_AIR] or vn * vn + ve * ve > accuracy * accuracy:
            x[at.GSF_STARTED] = 1.0
        return
    noise = max(accuracy, 0.01) ** 2
    total = 0.0
    for model in range(at.MODELS):
        m = at.GSF + model * at.G_SIZE
        _update_model(x, m, vn, ve, noise)
        density = math.sqrt(x[m + at.G_DETERMINANT]) * math.exp(-0.5 * x[m + at.G_NIS])
        x[m + at.G_WEIGHT] = max(x[m + at.G_WEIGHT] * density / (2.0 * math.pi), _LEAST_WEIGHT)
        total += x[m + at.G_WEIGHT]
    north = 0.0
    east = 0.0
    for model in range(at.MODELS):
        m = at.GSF + model * at.G_SIZE
        x[m + at.G_WEIGHT] /= total
        north += x[m + at.G_WEIGHT] * math.cos(x[m + at.G_STATE + 2])
        east += x[m + at.G_WEIGHT] * math.sin(x[m + at.G_STATE + 2])
    x[at.GSF_YAW] = math.atan2(east, north)
    variance = 0.0
    for model in range(at.MODELS):
        m = at.GSF + model * at.G_SIZE
        off = wrap_pi(x[m + at.G_STATE + 2] - x[at.GSF_YAW])
        variance += x[m + at.G_WEIGHT] * (x[m + at.G_COVARIANCE + 8] + off * off)
    x[at.GSF_VARIANCE] = variance
    if not (variance > 0.0 and math.isfinite(variance)):
        reset_yaw_estimator(x)

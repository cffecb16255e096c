"""The output predictor: the state now, from the filter's state at the delayed horizon.

A strap-down of its own runs at the IMU's rate with the filter's last biases. What
it said at the horizon is compared with what the filter says there; the difference
turns it by small corrections: attitude through every following delta angle,
velocity and position through the whole history at once, so that the delay stands
outside the loop. A second history for the vertical axis carries a velocity that
is the derivative of the position. (After Khosravian, Trumpf, Mahony and Hamel,
"Recursive Attitude Estimation in the Presence of Multi-rate and Multi-delay
Vector Measurements", ACC 2015, as PX4 does it.) A reset of the filter's state
shifts the history, so there is no transient.
"""

import math

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.buffers import oldest, push
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.geometry import (
    from_rotation_vector,
    limit,
    matrix_of,
    metres_per_radian,
    multiply,
    normalised,
    rotate,
    wrap_pi,
)

# Fields of an entry of RING_OUTPUT and RING_VERTICAL behind the time.
_Q, _V, _P = 1, 5, 8
_SPEED, _INTEGRAL, _DT = 1, 2, 3


@kernel
def _store_quaternion(x, index, q0, q1, q2, q3):
    x[index], x[index + 1], x[index + 2], x[index + 3] = q0, q1, q2, q3


@kernel
def _turn(x, index, d0, d1, d2, d3):
    """Replace the quaternion at `index` by d ⊗ q."""
    a0, a1, a2, a3 = multiply(d0, d1, d2, d3, x[index], x[index + 1], x[index + 2], x[index + 3])
    _store_quaternion(x, index, a0, a1, a2, a3)


@kernel
def _entries(x):
    data = int(x[at.RING_OUTPUT + at.RING_DATA])
    width = int(x[at.RING_OUTPUT + at.RING_WIDTH])
    return data, width, data + width * int(x[at.RING_OUTPUT + at.RING_ENTRIES])


@kernel
def _newest_to_output(x):
    """Take the corrected newest entry of the history as the present output."""
    entry = int(
        x[at.RING_OUTPUT + at.RING_DATA]
        + x[at.RING_OUTPUT + at.RING_HEAD] * x[at.RING_OUTPUT + at.RING_WIDTH]
    )
    for i in range(1 + at.OUTPUT_FIELDS):
        x[at.OUT_TIME + i] = x[entry + i]


@kernel
def align_output(x):
    """Lay the whole history onto the filter's first state."""
    delayed = oldest(x, at.RING_OUTPUT)
    q = at.QUATERNION
    d0, d1, d2, d3 = multiply(
        x[q], x[q + 1], x[q + 2], x[q + 3],
        x[delayed + _Q], -x[delayed + _Q + 1], -x[delayed + _Q + 2], -x[delayed + _Q + 3],
    )  # fmt: skip
    d0, d1, d2, d3 = normalised(d0, d1, d2, d3)
    dvx = x[at.VELOCITY] - x[delayed + _V]
    dvy = x[at.VELOCITY + 1] - x[delayed + _V + 1]
    dvz = x[at.VELOCITY + 2] - x[delayed + _V + 2]
    px, py, pz = x[delayed + _P], x[delayed + _P + 1], x[delayed + _P + 2]
    for i in range(3):
        x[at.OUT_REFERENCE + i] = x[at.LATITUDE + i]
    first, width, end = _entries(x)
    for entry in range(first, end, width):
        _turn(x, entry + _Q, d0, d1, d2, d3)
        n0, n1, n2, n3 = normalised(
            x[entry + _Q], x[entry + _Q + 1], x[entry + _Q + 2], x[entry + _Q + 3]
        )
        _store_quaternion(x, entry + _Q, n0, n1, n2, n3)
        x[entry + _V] += dvx
        x[entry + _V + 1] += dvy
        x[entry + _V + 2] += dvz
        x[entry + _P] -= px
        x[entry + _P + 1] -= py
        x[entry + _P + 2] -= pz
    _newest_to_output(x)


@kernel
def turn_output(x, d0, d1, d2, d3):
    """Turn the history and the output by a reset of the attitude."""
    first, width, end = _entries(x)
    for entry in range(first, end, width):
        _turn(x, entry + _Q, d0, d1, d2, d3)
    _turn(x, at.OUT_QUATERNION, d0, d1, d2, d3)


@kernel
def shift_output_velocity(x, axis, change):
    """Shift the history and the output by a reset of one component of velocity (m/s)."""
    first, width, end = _entries(x)
    for entry in range(first, end, width):
        x[entry + _V + axis] += change
    x[at.OUT_VELOCITY + axis] += change
    if axis == 2:
        data = int(x[at.RING_VERTICAL + at.RING_DATA])
        width = int(x[at.RING_VERTICAL + at.RING_WIDTH])
        for k in range(int(x[at.RING_VERTICAL + at.RING_ENTRIES])):
            x[data + k * width + _SPEED] += change
        x[at.OUT_VERTICAL + _SPEED] += change


@kernel
def predict_output(x, imu):
    """Advance the output by one IMU sample (as in `buffers.down_sample`)."""
    time = imu[0]
    if x[at.OUT_LAST_UPDATE] != 0.0:
        dt = limit((time - x[at.OUT_LAST_UPDATE]) * 1e-6, 0.0001, 0.03)
        x[at.OUT_IMU_DT] = 0.8 * x[at.OUT_IMU_DT] + 0.2 * dt
    x[at.OUT_LAST_UPDATE] = time

    angle_dt, velocity_dt = imu[7], imu[8]
    q0, q1 = x[at.OUT_QUATERNION], x[at.OUT_QUATERNION + 1]
    q2, q3 = x[at.OUT_QUATERNION + 2], x[at.OUT_QUATERNION + 3]
    ux = imu[1] - x[at.OUT_GYRO_BIAS] * angle_dt
    uy = imu[2] - x[at.OUT_GYRO_BIAS + 1] * angle_dt
    uz = imu[3] - x[at.OUT_GYRO_BIAS + 2] * angle_dt
    cx = ux + x[at.OUT_ANGLE_CORRECTION]
    cy = uy + x[at.OUT_ANGLE_CORRECTION + 1]
    cz = uz + x[at.OUT_ANGLE_CORRECTION + 2]
    x[at.OUT_TIME] = x[at.OUT_VERTICAL] = time

    d0, d1, d2, d3 = from_rotation_vector(cx, cy, cz)
    n0, n1, n2, n3 = multiply(q0, q1, q2, q3, d0, d1, d2, d3)
    n0, n1, n2, n3 = normalised(n0, n1, n2, n3)
    _store_quaternion(x, at.OUT_QUATERNION, n0, n1, n2, n3)
    m = matrix_of(n0, n1, n2, n3)
    for i in range(9):
        x[at.OUT_ROTATION + i] = m[i]

    vx, vy, vz = rotate(
        x,
        at.OUT_ROTATION,
        imu[4] - x[at.OUT_ACCEL_BIAS] * velocity_dt,
        imu[5] - x[at.OUT_ACCEL_BIAS + 1] * velocity_dt,
        imu[6] - x[at.OUT_ACCEL_BIAS + 2] * velocity_dt,
    )
    vz += x[at.OUT_GRAVITY] * velocity_dt
    v, position = at.OUT_VELOCITY, at.OUT_POSITION
    half = 0.5 * velocity_dt
    x[position] += (2.0 * x[v] + vx) * half
    x[position + 1] += (2.0 * x[v + 1] + vy) * half
    climb = (2.0 * x[v + 2] + vz) * half
    x[position + 2] += climb
    x[v] += vx
    x[v + 1] += vy
    x[v + 2] += vz
    x[at.OUT_VERTICAL + _SPEED] += vz
    x[at.OUT_VERTICAL + _INTEGRAL] += climb
    x[at.OUT_VERTICAL + _DT] += velocity_dt
    if velocity_dt > 0.0:
        x[at.OUT_ACCELERATION] = vx / velocity_dt
        x[at.OUT_ACCELERATION + 1] = vy / velocity_dt
        x[at.OUT_ACCELERATION + 2] = vz / velocity_dt
    if angle_dt > 0.0:
        x[at.OUT_ANGULAR_VELOCITY] = ux / angle_dt
        x[at.OUT_ANGULAR_VELOCITY + 1] = uy / angle_dt
        x[at.OUT_ANGULAR_VELOCITY + 2] = uz / angle_dt

    # the heading by the gyros alone, without the corrections
    e0, e1, e2, e3 = from_rotation_vector(ux, uy, uz)
    e0, e1, e2, e3 = multiply(q0, q1, q2, q3, e0, e1, e2, e3)
    before = math.atan2(2.0 * (q0 * q3 + q1 * q2), 1.0 - 2.0 * (q2 * q2 + q3 * q3))
    after = math.atan2(2.0 * (e0 * e3 + e1 * e2), 1.0 - 2.0 * (e2 * e2 + e3 * e3))
    x[at.OUT_UNAIDED_YAW] = wrap_pi(x[at.OUT_UNAIDED_YAW] + after - before)


@kernel
def predict_lever_arm(x, p, imu):
    """The velocity of the IMU from the body origin (m/s, NED), from one IMU sample."""
    if imu[7] <= 0.001:
        return
    wx = (imu[1] + x[at.OUT_ANGLE_CORRECTION]) / imu[7] - x[at.OUT_GYRO_BIAS]
    wy = (imu[2] + x[at.OUT_ANGLE_CORRECTION + 1]) / imu[7] - x[at.OUT_GYRO_BIAS + 1]
    wz = (imu[3] + x[at.OUT_ANGLE_CORRECTION + 2]) / imu[7] - x[at.OUT_GYRO_BIAS + 2]
    rx, ry, rz = p[prm.EKF2_IMU_POS_X], p[prm.EKF2_IMU_POS_Y], p[prm.EKF2_IMU_POS_Z]
    vx, vy, vz = rotate(x, at.OUT_ROTATION, wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx)
    x[at.OUT_IMU_VELOCITY] = vx
    x[at.OUT_IMU_VELOCITY + 1] = vy
    x[at.OUT_IMU_VELOCITY + 2] = vz


@kernel
def _gain(dt, tau):
    return dt / limit(tau, dt, 10.0)


@kernel
def _correct_vertical(x, correction, reference_down):
    """Add a velocity to the vertical history and integrate it anew, from the oldest entry on."""
    ring = at.RING_VERTICAL
    data, width = int(x[ring + at.RING_DATA]), int(x[ring + at.RING_WIDTH])
    entries = int(x[ring + at.RING_ENTRIES])
    index = int(x[ring + at.RING_TAIL])
    entry = data + index * width
    x[entry + _SPEED] += correction
    for _ in range(entries - 1):
        index = index + 1 if index + 1 < entries else 0
        following = data + index * width
        x[following + _SPEED] += correction
        mean = 0.5 * (x[entry + _SPEED] + x[following + _SPEED])
        x[following + _INTEGRAL] = x[entry + _INTEGRAL] + mean * x[following + _DT] - reference_down
        entry = following
    newest = data + int(x[ring + at.RING_HEAD]) * width
    for i in range(1 + at.VERTICAL_FIELDS):
        x[at.OUT_VERTICAL + i] = x[newest + i]
    x[at.OUT_VERTICAL + _DT] = 0.0


@kernel
def remember_output(x):
    """Store the output in the history."""
    entry = push(x, at.RING_OUTPUT, x[at.OUT_TIME])
    for i in range(1, 1 + at.OUTPUT_FIELDS):
        x[entry + i] = x[at.OUT_TIME + i]
    entry = push(x, at.RING_VERTICAL, x[at.OUT_VERTICAL])
    for i in range(1, 1 + at.VERTICAL_FIELDS):
        x[entry + i] = x[at.OUT_VERTICAL + i]


@kernel
def align_vertical_output(x):
    """Lay the vertical history onto the filter's state, from its oldest entry on."""
    ring = at.RING_VERTICAL
    delayed = oldest(x, ring)
    speed = x[at.VELOCITY + 2] - x[delayed + _SPEED]
    integral = x[delayed + _INTEGRAL]
    data, width = int(x[ring + at.RING_DATA]), int(x[ring + at.RING_WIDTH])
    for k in range(int(x[ring + at.RING_ENTRIES])):
        x[data + k * width + _SPEED] += speed
        x[data + k * width + _INTEGRAL] -= integral
    x[at.OUT_VERTICAL + _SPEED] += speed
    x[at.OUT_VERTICAL + _INTEGRAL] -= integral


@kernel
def correct_output(x, p):
    """Store the output in the history and correct it by the filter's new state at the horizon."""
    horizon = x[at.TIME_DELAYED]
    if x[at.OUT_LAST_CORRECTION] != 0.0:
        dt = limit((horizon - x[at.OUT_LAST_CORRECTION]) * 1e-6, 0.0001, 0.03)
        x[at.OUT_FILTER_DT] = 0.8 * x[at.OUT_FILTER_DT] + 0.2 * dt
    x[at.OUT_LAST_CORRECTION] = horizon
    for i in range(3):
        x[at.OUT_GYRO_BIAS + i] = x[at.GYRO_BIAS + i]
        x[at.OUT_ACCEL_BIAS + i] = x[at.ACCEL_BIAS + i]

    remember_output(x)
    delayed = oldest(x, at.RING_OUTPUT)
    vertical = oldest(x, at.RING_VERTICAL)

    # attitude: error at the horizon, spread over the delay
    q = at.QUATERNION
    e0, e1, e2, e3 = multiply(
        x[q], -x[q + 1], -x[q + 2], -x[q + 3],
        x[delayed + _Q], x[delayed + _Q + 1], x[delayed + _Q + 2], x[delayed + _Q + 3],
    )  # fmt: skip
    e0, e1, e2, e3 = normalised(e0, e1, e2, e3)
    scale = -2.0 if e0 >= 0.0 else 2.0
    delay = max((x[at.OUT_LAST_UPDATE] - horizon) * 1e-6, x[at.OUT_IMU_DT])
    gain = scale * 0.5 * x[at.OUT_IMU_DT] / delay
    x[at.OUT_ANGLE_CORRECTION] = e1 * gain
    x[at.OUT_ANGLE_CORRECTION + 1] = e2 * gain
    x[at.OUT_ANGLE_CORRECTION + 2] = e3 * gain
    x[at.OUT_TRACKING_ERROR] = 2.0 * math.sqrt(e1 * e1 + e2 * e2 + e3 * e3)

    dt = x[at.OUT_FILTER_DT]
    velocity_gain = _gain(dt, p[prm.EKF2_TAU_VEL])
    position_gain = _gain(dt, p[prm.EKF2_TAU_POS])
    north, east = metres_per_radian(x[at.LATITUDE], x[at.ALTITUDE])
    moved = (
        wrap_pi(x[at.LATITUDE] - x[at.OUT_REFERENCE]) * north,
        wrap_pi(x[at.LONGITUDE] - x[at.OUT_REFERENCE + 1]) * east,
        x[at.OUT_REFERENCE + 2] - x[at.ALTITUDE],
    )
    _correct_vertical(
        x,
        (moved[2] - x[vertical + _INTEGRAL]) * position_gain
        + (x[at.VELOCITY + 2] - x[vertical + _SPEED]) * velocity_gain * 1.1,
        moved[2],
    )

    first, width, end = _entries(x)
    velocity_error = 0.0
    position_error = 0.0
    for i in range(3):
        error = x[at.VELOCITY + i] - x[delayed + _V + i]
        velocity_error += error * error
        x[at.OUT_VELOCITY_INTEGRAL + i] += error
        dv = (
            error * velocity_gain
            + x[at.OUT_VELOCITY_INTEGRAL + i] * velocity_gain * velocity_gain * 0.1
        )
        error = moved[i] - x[delayed + _P + i]
        position_error += error * error
        x[at.OUT_POSITION_INTEGRAL + i] += error
        dp = (
            error * position_gain
            + x[at.OUT_POSITION_INTEGRAL + i] * position_gain * position_gain * 0.1
            - moved[i]
        )
        for entry in range(first, end, width):
            x[entry + _V + i] += dv
            x[entry + _P + i] += dp
    x[at.OUT_TRACKING_ERROR + 1] = math.sqrt(velocity_error)
    x[at.OUT_TRACKING_ERROR + 2] = math.sqrt(position_error)
    _newest_to_output(x)
    for i in range(3):
        x[at.OUT_REFERENCE + i] = x[at.LATITUDE + i]


@kernel
def output_position(x, p):
    """Latitude, longitude (rad) and altitude (m) of the body origin now."""
    px, py, pz = rotate(
        x, at.OUT_ROTATION, p[prm.EKF2_IMU_POS_X], p[prm.EKF2_IMU_POS_Y], p[prm.EKF2_IMU_POS_Z]
    )
    north, east = metres_per_radian(x[at.OUT_REFERENCE], x[at.OUT_REFERENCE + 2])
    return (
        wrap_pi(x[at.OUT_REFERENCE] + (x[at.OUT_POSITION] - px) / north),
        wrap_pi(x[at.OUT_REFERENCE + 1] + (x[at.OUT_POSITION + 1] - py) / east),
        x[at.OUT_REFERENCE + 2] - (x[at.OUT_POSITION + 2] - pz),
    )

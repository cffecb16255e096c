"""What the filter does without aiding: gravity, standstill, fake observations, dead reckoning."""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import (
    height_sources,
    horizontal_sources,
    vertical_velocity_sources,
)
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    covariance,
    finish_aid,
    fuse_aid,
    fuse_gains,
    fuse_state,
    project_covariance,
    recent,
    set_aid,
    set_height_aid,
    timed_out,
)
from systems.estimators.ekf2.geometry import limit, metres_per_radian, wrap_pi
from systems.estimators.ekf2.resets import (
    reset_altitude,
    reset_horizontal_velocity,
    reset_latitude_longitude,
    reset_vertical_velocity_to_zero,
)

_INTERVAL = 200_000.0  # us, between two zero velocities or fake observations
_FAILING = 400_000.0  # us, without a fake observation: reset
_ZERO_GYRO_INTERVAL = 0.2  # s
_GRAVITY_GATE = 0.25
_FAKE_GATE = 3.0
_ALIGNED = math.radians(3.0) ** 2  # rad2, tilt variance of an aligned filter
_NO_AID_TIMEOUT = 1_000_000.0  # us
_RESET_VELOCITY_VARIANCE = 25.0  # (m/s)2


@kernel
def tilt_variance(x):
    """The variance of roll plus that of pitch (rad2)."""
    P = covariance(x)
    return P[0, 0] + P[1, 1]


@kernel
def control_gravity(x, p):
    """Fuse the direction of gravity: predicted is Rᵀ (0, 0, −1), H_θ = −Rᵀ [(0, 0, 1)]×."""
    measured = np.empty(3)
    norm2 = 0.0
    for i in range(3):
        measured[i] = x[at.IMU_DELTA_VELOCITY + i] / x[at.IMU_VELOCITY_DT] - x[at.ACCEL_BIAS + i]
        norm2 += measured[i] * measured[i]
    measured /= math.sqrt(norm2)
    noise = max(p[prm.EKF2_GRAV_NOISE] ** 2, 1e-4)

    a = at.ACCEL_LPF
    ratio2 = (x[a] ** 2 + x[a + 1] ** 2 + x[a + 2] ** 2) / at.STANDARD_GRAVITY**2
    x[at.GRAVITY_VECTOR] = (
        (int(p[prm.EKF2_IMU_CTRL]) & 4) != 0
        and (0.81 < ratio2 < 1.21 or x[at.AT_REST] != 0.0)
        and horizontal_sources(x) == 0.0
        and x[at.TILT_ALIGN] != 0.0
    )

    P = covariance(x)
    R = x[at.ROTATION : at.ROTATION + 9].copy().reshape(3, 3)  # all axes: the state before
    for i in range(3):
        h0, h1 = -R[1, i], R[0, i]
        variance = h0 * h0 * P[0, 0] + h1 * h1 * P[1, 1] + 2.0 * h0 * h1 * P[0, 1]
        set_aid(
            x, at.AID_GRAVITY, i, x[at.TIME_DELAYED], measured[i], noise,
            -R[2, i] - measured[i], variance + noise, _GRAVITY_GATE,
        )  # fmt: skip
    finish_aid(x, at.AID_GRAVITY, x[at.TIME_DELAYED])

    clipping = x[at.IMU_CLIPPING] or x[at.IMU_CLIPPING + 1] or x[at.IMU_CLIPPING + 2]
    if not x[at.GRAVITY_VECTOR] or x[at.AID_GRAVITY + at.A_REJECTED] or clipping:
        return
    H = np.zeros(at.ERRORS)
    g = np.empty(at.ERRORS)
    for i in range(3):
        H[0], H[1] = -R[1, i], R[0, i]
        variance = project_covariance(P, H, g)
        axis = at.AID_GRAVITY + i * at.A_AXIS
        x[axis + at.A_INNOVATION] = -x[at.ROTATION + 6 + i] - measured[i]
        x[axis + at.A_INNOVATION_VARIANCE] = variance + noise
        fuse_gains(x, p, g / (variance + noise), g, variance, noise, x[axis + at.A_INNOVATION])
    x[at.AID_GRAVITY + at.A_FUSED] = 1.0
    x[at.AID_GRAVITY + at.A_LAST_FUSE] = x[at.TIME_DELAYED]


@kernel
def update_zero_velocity(x, p):
    """At rest, fuse a velocity of zero five times a second."""
    if x[at.T_ZERO_VELOCITY] + _INTERVAL >= x[at.TIME_DELAYED]:
        return
    resting = x[at.AT_REST] and x[at.AT_REST + at.BEFORE]
    # an aligned filter with velocity aiding would follow a drift of position too stiffly
    if not resting or (vertical_velocity_sources(x) > 0.0 and x[at.TILT_ALIGN]):
        return
    noise = 0.04 if x[at.TILT_ALIGN] else 1e-6  # (m/s)2
    P = covariance(x)
    vx, vy, vz = P[3, 3] + noise, P[4, 4] + noise, P[5, 5] + noise
    fuse_state(x, p, at.E_VELOCITY, x[at.VELOCITY], vx, noise)
    fuse_state(x, p, at.E_VELOCITY + 1, x[at.VELOCITY + 1], vy, noise)
    fuse_state(x, p, at.E_VELOCITY + 2, x[at.VELOCITY + 2], vz, noise)
    x[at.T_ZERO_VELOCITY] = x[at.TIME_DELAYED]


@kernel
def update_zero_gyro(x, p):
    """At rest, fuse the mean of the gyros over 0.2 s as their bias."""
    z = at.ZERO_GYRO_ANGLE
    if x[at.AT_REST]:
        for i in range(3):
            x[z + i] += x[at.IMU_DELTA_ANGLE + i]
        # in single precision, whose last bit decides whether 50 steps of 4 ms are 0.2 s
        x[at.ZERO_GYRO_DT] = np.float32(x[at.ZERO_GYRO_DT]) + np.float32(x[at.IMU_ANGLE_DT])
        dt = x[at.ZERO_GYRO_DT]
        if dt < np.float32(_ZERO_GYRO_INTERVAL):
            return
        noise = limit(p[prm.EKF2_GYR_NOISE], 0.0, 1.0) ** 2
        for i in range(3):
            variance = covariance(x)[at.E_GYRO_BIAS + i, at.E_GYRO_BIAS + i] + noise
            innovation = x[at.GYRO_BIAS + i] - x[z + i] / dt
            fuse_state(x, p, at.E_GYRO_BIAS + i, innovation, variance, noise)
    elif not x[at.AT_REST + at.BEFORE]:
        return
    x[z] = x[z + 1] = x[z + 2] = 0.0
    x[at.ZERO_GYRO_DT] = 0.0


@kernel
def _reset_fake_position(x, p):
    x[at.LAST_KNOWN], x[at.LAST_KNOWN + 1] = x[at.LATITUDE], x[at.LONGITUDE]
    variance = p[prm.EKF2_NOAID_NOISE] ** 2
    reset_latitude_longitude(x, x[at.LAST_KNOWN], x[at.LAST_KNOWN + 1], variance, variance)
    reset_horizontal_velocity(x, 0.0, 0.0, _RESET_VELOCITY_VARIANCE, _RESET_VELOCITY_VARIANCE)
    x[at.AID_FAKE_POS + at.A_LAST_FUSE] = x[at.TIME_DELAYED]


@kernel
def _run_fake_position(x, p, enabled, active):
    """One of the two modes of fake position; returns whether it goes on."""
    if active and enabled:
        if not x[at.AID_FAKE_POS + at.A_REJECTED]:
            fuse_aid(x, p, at.AID_FAKE_POS, 2, at.E_POSITION)
        if timed_out(x, x[at.AID_FAKE_POS + at.A_LAST_FUSE], _FAILING):
            _reset_fake_position(x, p)
    elif enabled:
        _reset_fake_position(x, p)
    return enabled


@kernel
def control_fake_position(x, p):
    """Without horizontal aiding, hold the last known position.

    `valid_fake_pos` is a position that is known to stay (at rest), `fake_pos` only
    bounds the drift while the tilt is uncertain.
    """
    aided = horizontal_sources(x) > 0.0
    if aided:
        x[at.FAKE_POS] = x[at.VALID_FAKE_POS] = 0.0
        return
    if not timed_out(x, x[at.AID_FAKE_POS + at.A_LAST_FUSE], _INTERVAL):
        return
    if x[at.IN_AIR] and x[at.TILT_ALIGN]:
        noise = max(p[prm.EKF2_NOAID_NOISE], 1.0) ** 2
    elif not x[at.IN_AIR] and x[at.AT_REST]:
        noise = 1e-4  # m2, levels faster
    else:
        noise = 0.25  # m2
    north, east = metres_per_radian(x[at.LATITUDE], x[at.ALTITUDE])
    P = covariance(x)
    time = x[at.TIME_DELAYED]
    set_aid(
        x, at.AID_FAKE_POS, 0, time, math.degrees(x[at.LATITUDE]), noise,
        wrap_pi(x[at.LATITUDE] - x[at.LAST_KNOWN]) * north, P[6, 6] + noise, _FAKE_GATE,
    )  # fmt: skip
    set_aid(
        x, at.AID_FAKE_POS, 1, time, math.degrees(x[at.LONGITUDE]), noise,
        wrap_pi(x[at.LONGITUDE] - x[at.LAST_KNOWN + 1]) * east, P[7, 7] + noise, _FAKE_GATE,
    )  # fmt: skip
    finish_aid(x, at.AID_FAKE_POS, time)

    known = x[at.CONSTANT_POS] != 0.0 or x[at.AT_REST] != 0.0
    bounding = (
        not known
        and tilt_variance(x) > _ALIGNED
        and x[at.GRAVITY_VECTOR] == 0.0
        and x[at.HORIZONTAL_EXCEEDED] != 0.0
    )
    x[at.FAKE_POS] = _run_fake_position(x, p, bounding, x[at.FAKE_POS] != 0.0)
    x[at.VALID_FAKE_POS] = _run_fake_position(x, p, known, x[at.VALID_FAKE_POS] != 0.0)


@kernel
def _reset_fake_height(x, p):
    x[at.LAST_KNOWN + 2] = x[at.ALTITUDE]
    reset_vertical_velocity_to_zero(x)
    reset_altitude(x, x[at.LAST_KNOWN + 2], p[prm.EKF2_NOAID_NOISE] ** 2)
    x[at.AID_FAKE_HGT + at.A_LAST_FUSE] = x[at.TIME_DELAYED]


@kernel
def control_fake_height(x, p):
    """Without vertical aiding, hold the last known height."""
    if height_sources(x) + vertical_velocity_sources(x) > 0.0:
        x[at.FAKE_HGT] = 0.0
        return
    aid = at.AID_FAKE_HGT
    if not timed_out(x, x[aid + at.A_LAST_FUSE], _INTERVAL):
        return
    set_height_aid(
        x, aid, x[at.TIME_DELAYED], -x[at.LAST_KNOWN + 2], p[prm.EKF2_NOAID_NOISE] ** 2, _FAKE_GATE
    )
    if x[at.FAKE_HGT]:
        if x[aid + at.A_TEST_RATIO] < (100.0 / _FAKE_GATE) ** 2:
            fuse_aid(x, p, aid, 1, at.E_POSITION + 2)
        if timed_out(x, x[aid + at.A_LAST_FUSE], _FAILING):
            _reset_fake_height(x, p)
    elif x[at.VERTICAL_VELOCITY_EXCEEDED] and x[at.VERTICAL_POSITION_EXCEEDED]:
        x[at.FAKE_HGT] = 1.0
        _reset_fake_height(x, p)


@kernel
def update_dead_reckoning(x, p):
    """Note how long nothing has constrained the drift, and which estimates are valid."""
    time = x[at.TIME_DELAYED]
    allowed = p[prm.EKF2_NOAID_TOUT]
    velocity_aided = (x[at.GNSS_VEL] or x[at.EV_VEL]) and recent(
        x, x[at.T_HORIZONTAL_VELOCITY], _NO_AID_TIMEOUT
    )
    position_aided = (x[at.GNSS_POS] or x[at.EV_POS]) and recent(
        x, x[at.T_HORIZONTAL_POSITION], _NO_AID_TIMEOUT
    )
    if velocity_aided or position_aided:
        if time > _NO_AID_TIMEOUT:
            x[at.T_HORIZONTAL_AIDING] = time - _NO_AID_TIMEOUT
        x[at.HORIZONTAL_EXCEEDED] = 0.0
        x[at.INERTIAL_DEAD_RECKONING] = 0.0
    else:
        if timed_out(x, x[at.T_HORIZONTAL_AIDING], allowed):
            x[at.HORIZONTAL_EXCEEDED] = 1.0
        x[at.INERTIAL_DEAD_RECKONING] = 1.0

    if height_sources(x) > 0.0:
        x[at.T_VERTICAL_POSITION_AIDING] = x[at.T_HEIGHT]
        x[at.VERTICAL_POSITION_EXCEEDED] = 0.0
    elif timed_out(x, x[at.T_VERTICAL_POSITION_AIDING], allowed):
        x[at.VERTICAL_POSITION_EXCEEDED] = 1.0
    if vertical_velocity_sources(x) > 0.0:
        x[at.T_VERTICAL_VELOCITY_AIDING] = x[at.T_VERTICAL_VELOCITY]
        x[at.VERTICAL_VELOCITY_EXCEEDED] = 0.0
    elif (
        timed_out(x, x[at.T_VERTICAL_VELOCITY_AIDING], allowed) and x[at.VERTICAL_POSITION_EXCEEDED]
    ):
        x[at.VERTICAL_VELOCITY_EXCEEDED] = 1.0

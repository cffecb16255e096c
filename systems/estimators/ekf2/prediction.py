"""Start and prediction of the filter: tilt from gravity, strap-down, covariance.

The error state is δx = (δθ, δv, δp, δb_g, δb_a, δm_I, δm_B, δw, δh), where δθ turns
the attitude from the left (in NED): q_true = exp(δθ/2) ⊗ q. With R the attitude,
f = a − b_a the specific force and Δt the step, the error propagates to first order
in Δt (Solà, "Quaternion kinematics for the error-state Kalman filter",
arXiv:1711.02508, section 7.2, global angular errors) as

    δθ′ = δθ − R δb_g Δt
    δv′ = δv − [R f]× δθ Δt − R δb_a Δt
    δp′ = δp + δv Δt

and all others stay. Only the first nine rows of the transition are not the identity.
"""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import (
    constrain_variances,
    covariance,
    decorrelate,
    decorrelate_heading,
    move,
    set_rotation,
)
from systems.estimators.ekf2.geometry import (
    EARTH_SPIN,
    from_rotation_vector,
    limit,
    multiply,
    normal_gravity,
    normalised,
    radii,
    rotate,
    rotate_back,
    tilt_quaternion,
)

_BAD_ACCEL_NOISE = 4.9  # m/s2, of a clipping or otherwise bad accelerometer
_INITIAL_WIND_VARIANCE = 1.0  # (m/s)2
_WIND_CLIMB_SCALE = 0.5  # growth of the wind's drift with the vertical speed, s/m
_HEIGHT_RATE_TAU = 10.0  # s
_ACCEL_HORIZONTAL_TAU = 1.0  # s
_MAXIMUM_START_RATE = math.radians(15.0)  # rad/s
_GRAVITY_ALIGNED = 0.966  # cos 15 deg


@kernel
def initialise_tilt(x):
    """Take roll and pitch from gravity; false while the vehicle accelerates or turns."""
    a, g = at.ACCEL_LPF, at.GYRO_LPF
    accel = math.sqrt(x[a] ** 2 + x[a + 1] ** 2 + x[a + 2] ** 2)
    rate = math.sqrt(x[g] ** 2 + x[g + 1] ** 2 + x[g + 2] ** 2)
    if (
        accel < 0.8 * at.STANDARD_GRAVITY
        or accel > 1.2 * at.STANDARD_GRAVITY
        or rate > _MAXIMUM_START_RATE
    ):
        return False
    q = at.QUATERNION
    x[q], x[q + 1], x[q + 2], x[q + 3] = tilt_quaternion(x[a], x[a + 1], x[a + 2])
    set_rotation(x)
    return True


@kernel
def initialise_covariance(x, p):
    """Set the covariance to what is known without any observation."""
    P = covariance(x)
    P[:, :] = 0.0
    tilt = max(p[prm.EKF2_ANGERR_INIT], 0.01) ** 2
    P[0, 0] = P[1, 1] = tilt  # the heading starts at zero, for a better levelling
    velocity = max(p[prm.EKF2_GPS_V_NOISE], 0.01) ** 2
    P[3, 3] = P[4, 4] = velocity
    P[5, 5] = 2.25 * velocity
    P[6, 6] = P[7, 7] = max(p[prm.EKF2_GPS_P_NOISE], 0.01) ** 2
    if x[at.RNG_HGT]:
        P[8, 8] = max(p[prm.EKF2_RNG_NOISE], 0.01) ** 2
    elif x[at.GPS_HGT]:
        P[8, 8] = max(1.5 * p[prm.EKF2_GPS_P_NOISE], 0.01) ** 2
    else:
        P[8, 8] = max(p[prm.EKF2_BARO_NOISE], 0.01) ** 2
    for i in range(3):
        P[at.E_GYRO_BIAS + i, at.E_GYRO_BIAS + i] = p[prm.EKF2_GBIAS_INIT] ** 2
        P[at.E_ACCEL_BIAS + i, at.E_ACCEL_BIAS + i] = p[prm.EKF2_ABIAS_INIT] ** 2
        P[at.E_MAG_EARTH + i, at.E_MAG_EARTH + i] = p[prm.EKF2_MAG_NOISE] ** 2
        P[at.E_MAG_BODY + i, at.E_MAG_BODY + i] = p[prm.EKF2_MAG_NOISE] ** 2
    P[at.E_WIND, at.E_WIND] = P[at.E_WIND + 1, at.E_WIND + 1] = _INITIAL_WIND_VARIANCE
    P[at.E_TERRAIN, at.E_TERRAIN] = p[prm.EKF2_MIN_RNG] ** 2


@kernel
def reset_gyro_bias_z_covariance(x, p):
    """Let the filter learn the gyro bias about z anew."""
    decorrelate(covariance(x), at.E_GYRO_BIAS + 2, 1, p[prm.EKF2_GBIAS_INIT] ** 2)


@kernel
def inhibit_biases(x, p):
    """Decide which IMU biases may be learnt in this step."""
    w2 = 0.0
    a2 = 0.0
    for i in range(3):
        w2 += (x[at.IMU_DELTA_ANGLE + i] / x[at.IMU_ANGLE_DT] - x[at.GYRO_BIAS + i]) ** 2
        a2 += (x[at.IMU_DELTA_VELOCITY + i] / x[at.IMU_VELOCITY_DT] - x[at.ACCEL_BIAS + i]) ** 2
    tau = p[prm.EKF2_ABL_TAU]
    decay = 1.0 - limit(x[at.IMU_ANGLE_DT] / tau, 0.0, 1.0)
    x[at.GYRO_ENVELOPE] = max(math.sqrt(w2), decay * x[at.GYRO_ENVELOPE])
    decay = 1.0 - limit(x[at.IMU_VELOCITY_DT] / tau, 0.0, 1.0)
    x[at.ACCEL_ENVELOPE] = max(math.sqrt(a2), decay * x[at.ACCEL_ENVELOPE])

    control = int(p[prm.EKF2_IMU_CTRL])
    x[at.GYRO_BIAS_INHIBITED] = (control & 1) == 0
    all_axes = (
        (control & 2) == 0
        or x[at.GYRO_ENVELOPE] > p[prm.EKF2_ABL_GYRLIM]
        or x[at.ACCEL_ENVELOPE] > p[prm.EKF2_ABL_ACCLIM]
        or x[at.BAD_ACC_VERTICAL] != 0.0
    )
    for i in range(3):
        observable = True
        if not x[at.AT_REST]:
            if x[at.FAKE_HGT]:
                observable = False
            elif x[at.FAKE_POS] or x[at.GRAVITY_VECTOR]:
                observable = abs(x[at.ROTATION + 6 + i]) > _GRAVITY_ALIGNED
        x[at.ACCEL_BIAS_INHIBITED + i] = all_axes or x[at.IMU_CLIPPING + i] != 0.0 or not observable


@kernel
def predict_covariance(x, p):
    """Propagate the covariance over one step, linearised at the state before the step."""
    P = covariance(x)
    dt = 0.5 * (x[at.IMU_VELOCITY_DT] + x[at.IMU_ANGLE_DT])
    gyro_variance = p[prm.EKF2_GYR_NOISE] ** 2
    accel_variance = np.empty(3)
    for i in range(3):
        bad = x[at.BAD_ACC_VERTICAL] or x[at.IMU_CLIPPING + i]
        accel_variance[i] = (_BAD_ACCEL_NOISE if bad else p[prm.EKF2_ACC_NOISE]) ** 2

    fx, fy, fz = rotate(
        x,
        at.ROTATION,
        x[at.IMU_DELTA_VELOCITY] / x[at.IMU_VELOCITY_DT] - x[at.ACCEL_BIAS],
        x[at.IMU_DELTA_VELOCITY + 1] / x[at.IMU_VELOCITY_DT] - x[at.ACCEL_BIAS + 1],
        x[at.IMU_DELTA_VELOCITY + 2] / x[at.IMU_VELOCITY_DT] - x[at.ACCEL_BIAS + 2],
    )
    fx, fy, fz = fx * dt, fy * dt, fz * dt
    R = x[at.ROTATION : at.ROTATION + 9].reshape(3, 3) * dt

    # M = A P, its first nine rows
    M = np.empty((9, at.ERRORS))
    for j in range(at.ERRORS):
        for i in range(3):
            gyro = (
                R[i, 0] * P[at.E_GYRO_BIAS, j]
                + R[i, 1] * P[at.E_GYRO_BIAS + 1, j]
                + R[i, 2] * P[at.E_GYRO_BIAS + 2, j]
            )
            accel = (
                R[i, 0] * P[at.E_ACCEL_BIAS, j]
                + R[i, 1] * P[at.E_ACCEL_BIAS + 1, j]
                + R[i, 2] * P[at.E_ACCEL_BIAS + 2, j]
            )
            M[i, j] = P[i, j] - gyro
            M[3 + i, j] = P[3 + i, j] - accel
            M[6 + i, j] = P[6 + i, j] + dt * P[3 + i, j]
        # −[R f]× δθ = δθ × R f
        M[3, j] += P[1, j] * fz - P[2, j] * fy
        M[4, j] += P[2, j] * fx - P[0, j] * fz
        M[5, j] += P[0, j] * fy - P[1, j] * fx

    # M Aᵀ, its first nine columns on and above the diagonal; right of them Aᵀ is the identity
    for i in range(9):
        for k in range(3):
            gyro = (
                R[k, 0] * M[i, at.E_GYRO_BIAS]
                + R[k, 1] * M[i, at.E_GYRO_BIAS + 1]
                + R[k, 2] * M[i, at.E_GYRO_BIAS + 2]
            )
            accel = (
                R[k, 0] * M[i, at.E_ACCEL_BIAS]
                + R[k, 1] * M[i, at.E_ACCEL_BIAS + 1]
                + R[k, 2] * M[i, at.E_ACCEL_BIAS + 2]
            )
            P[i, k] = M[i, k] - gyro
            P[i, 3 + k] = M[i, 3 + k] - accel
            P[i, 6 + k] = M[i, 6 + k] + dt * M[i, 3 + k]
        P[i, 3] += M[i, 1] * fz - M[i, 2] * fy
        P[i, 4] += M[i, 2] * fx - M[i, 0] * fz
        P[i, 5] += M[i, 0] * fy - M[i, 1] * fx
        for j in range(9, at.ERRORS):
            P[i, j] = M[i, j]

    # noise of the IMU: EKF2_GYR_NOISE and EKF2_ACC_NOISE act as standard deviations a step
    for i in range(3):
        P[i, i] += gyro_variance * dt * dt
        for k in range(i, 3):
            P[3 + i, 3 + k] += (
                R[i, 0] * accel_variance[0] * R[k, 0]
                + R[i, 1] * accel_variance[1] * R[k, 1]
                + R[i, 2] * accel_variance[2] * R[k, 2]
            )
    for i in range(9):
        for j in range(i + 1, at.ERRORS):
            P[j, i] = P[i, j]

    if not x[at.HEADING_OBSERVABLE]:
        decorrelate_heading(x, p)
    _add_process_noise(x, p, P, dt, gyro_variance, accel_variance)
    constrain_variances(x, p)


@kernel
def _add_process_noise(x, p, P, dt, gyro_variance, accel_variance):
    """Let biases, fields, wind and terrain drift, each up to a variance of its own."""
    gyro = (dt * p[prm.EKF2_GYR_B_NOISE]) ** 2
    accel = (dt * p[prm.EKF2_ACC_B_NOISE]) ** 2
    earth = (dt * p[prm.EKF2_MAG_E_NOISE]) ** 2
    body = (dt * p[prm.EKF2_MAG_B_NOISE]) ** 2
    field_limit = p[prm.EKF2_MAG_NOISE] ** 2
    for i in range(3):
        if P[at.E_GYRO_BIAS + i, at.E_GYRO_BIAS + i] < gyro_variance:
            P[at.E_GYRO_BIAS + i, at.E_GYRO_BIAS + i] += gyro
        if P[at.E_ACCEL_BIAS + i, at.E_ACCEL_BIAS + i] < accel_variance[i]:
            P[at.E_ACCEL_BIAS + i, at.E_ACCEL_BIAS + i] += accel
        if P[at.E_MAG_EARTH + i, at.E_MAG_EARTH + i] < field_limit:
            P[at.E_MAG_EARTH + i, at.E_MAG_EARTH + i] += earth
        if P[at.E_MAG_BODY + i, at.E_MAG_BODY + i] < field_limit:
            P[at.E_MAG_BODY + i, at.E_MAG_BODY + i] += body

    alpha = x[at.IMU_VELOCITY_DT] / (_HEIGHT_RATE_TAU + x[at.IMU_VELOCITY_DT])
    x[at.HEIGHT_RATE_LPF] += alpha * (x[at.VELOCITY + 2] - x[at.HEIGHT_RATE_LPF])
    density = p[prm.EKF2_WIND_NSD] * (1.0 + _WIND_CLIMB_SCALE * abs(x[at.HEIGHT_RATE_LPF]))
    for i in range(at.E_WIND, at.E_WIND + 2):
        if P[i, i] < _INITIAL_WIND_VARIANCE:
            P[i, i] += density * density * dt
    if x[at.HEIGHT_REFERENCE] != at.RANGE:
        speed2 = x[at.VELOCITY] ** 2 + x[at.VELOCITY + 1] ** 2
        P[at.E_TERRAIN, at.E_TERRAIN] += x[at.IMU_VELOCITY_DT] ** 2 * (
            p[prm.EKF2_TERR_NOISE] ** 2 + p[prm.EKF2_TERR_GRAD] ** 2 * speed2
        )


@kernel
def predict_state(x, p):
    """Propagate the nominal state over one step: the strap-down on the turning earth."""
    latitude = x[at.LATITUDE]
    if abs(latitude - x[at.EARTH_RATE_LATITUDE]) > math.radians(1.0):
        x[at.EARTH_RATE_LATITUDE] = latitude
        x[at.EARTH_RATE] = EARTH_SPIN * math.cos(latitude)
        x[at.EARTH_RATE + 2] = -EARTH_SPIN * math.sin(latitude)
        x[at.GRAVITY] = x[at.OUT_GRAVITY] = normal_gravity(latitude)
    earth_north, earth_down = x[at.EARTH_RATE], x[at.EARTH_RATE + 2]

    angle_dt, dt = x[at.IMU_ANGLE_DT], x[at.IMU_VELOCITY_DT]
    ex, ey, ez = rotate_back(x, at.ROTATION, earth_north, 0.0, earth_down)
    d0, d1, d2, d3 = from_rotation_vector(
        x[at.IMU_DELTA_ANGLE] - (x[at.GYRO_BIAS] + ex) * angle_dt,
        x[at.IMU_DELTA_ANGLE + 1] - (x[at.GYRO_BIAS + 1] + ey) * angle_dt,
        x[at.IMU_DELTA_ANGLE + 2] - (x[at.GYRO_BIAS + 2] + ez) * angle_dt,
    )
    q = at.QUATERNION
    n0, n1, n2, n3 = multiply(x[q], x[q + 1], x[q + 2], x[q + 3], d0, d1, d2, d3)
    x[q], x[q + 1], x[q + 2], x[q + 3] = normalised(n0, n1, n2, n3)
    set_rotation(x)

    fn, fe, fd = rotate(
        x,
        at.ROTATION,
        x[at.IMU_DELTA_VELOCITY] - x[at.ACCEL_BIAS] * dt,
        x[at.IMU_DELTA_VELOCITY + 1] - x[at.ACCEL_BIAS + 1] * dt,
        x[at.IMU_DELTA_VELOCITY + 2] - x[at.ACCEL_BIAS + 2] * dt,
    )
    vn, ve, vd = x[at.VELOCITY], x[at.VELOCITY + 1], x[at.VELOCITY + 2]
    # Coriolis −2 ω_earth × v, and the transport rate −ω_frame × v
    meridian, transverse = radii(latitude)
    rate_n = ve / (transverse + x[at.ALTITUDE])
    rate_e = -vn / (meridian + x[at.ALTITUDE])
    rate_d = -ve * math.tan(latitude) / (transverse + x[at.ALTITUDE])
    wn, we, wd = 2.0 * earth_north + rate_n, rate_e, 2.0 * earth_down + rate_d
    after_n = vn + fn - (we * vd - wd * ve) * dt
    after_e = ve + fe - (wd * vn - wn * vd) * dt
    after_d = vd + fd + (x[at.GRAVITY] - (wn * ve - we * vn)) * dt

    half = 0.5 * dt
    move(x, (vn + after_n) * half, (ve + after_e) * half, (vd + after_d) * half)
    bound = p[prm.EKF2_VEL_LIM]
    x[at.VELOCITY] = limit(after_n, -bound, bound)
    x[at.VELOCITY + 1] = limit(after_e, -bound, bound)
    x[at.VELOCITY + 2] = limit(after_d, -bound, bound)

    alpha = dt / (_ACCEL_HORIZONTAL_TAU + dt)
    h = at.ACCEL_HORIZONTAL_LPF
    x[h] += alpha * (fn / dt - x[h])
    x[h + 1] += alpha * (fe / dt - x[h + 1])

"""The cascade's hot loop: from estimate, gyro and setpoint to rotor commands, compiled.

`cascade_step` is one event of `MultirotorCascade`; the stages it calls are functions
of their own, so that each is tested against a plain reference. Everything is a
scalar or a flat float64 array; nothing is allocated.

The indices into the layouts of `systems.signals.measurement` are repeated here as
literals, because numba's cache does not see a change in another module; a test
holds them equal to the layouts.
"""

import math

from numba import njit

from systems.signals.measurement import Layout, vector

GRAVITY = 9.80665  # m/s2, standard gravity
VELOCITY_SMOOTHING = 4.0  # 1/s, speed error to acceleration near the target speed of an S-curve
TAKEOFF_HEIGHT = 0.3  # m, a setpoint this far above the vehicle starts the take-off ramp
TAKEOFF_CLIMB = 0.1  # m/s, or a climb rate above this

# What one event needs to know besides its inputs; filled in by `MultirotorCascade`.
PARAMETERS = Layout(
    "CascadeParameters",
    (
        "period",  # s
        "hover_thrust",  # collective thrust that carries the weight, as a fraction of the maximum
        "thrust_minimum",  # fraction, in flight
        "thrust_maximum",  # fraction
        "thrust_horizontal_margin",  # fraction kept for horizontal control
        "thrust_contact",  # fraction below which the ground may be carrying the vehicle
        "tilt_flight",  # rad
        "tilt_takeoff",  # rad
        "position_xy",  # 1/s
        "position_z",  # 1/s
        "velocity_p_xy",  # 1/s
        "velocity_p_z",  # 1/s
        "velocity_i_xy",  # 1/s2
        "velocity_i_z",  # 1/s2
        "velocity_d_xy",  # 1
        "velocity_d_z",  # 1
        "velocity_derivative_gain",  # 1, of the derivative's low pass, per event
        "correction_gain",  # 1, of the horizontal correction's low pass, per event
        "speed_xy_maximum",  # m/s
        "speed_xy_cruise",  # m/s, when the setpoint names none
        "speed_up",  # m/s
        "speed_down",  # m/s
        "acceleration_xy",  # m/s2, of the trajectory
        "acceleration_up",  # m/s2
        "acceleration_down",  # m/s2
        "jerk",  # m/s3
        "trajectory_gain",  # 1/s, distance to speed close to the target
        "trajectory_error",  # m, distance between vehicle and trajectory that stops the latter
        "takeoff_ramp",  # s
        "takeoff_speed",  # m/s
        *vector("attitude"),  # 1/s
        "yaw_weight",  # 1
        *vector("rate_limit"),  # rad/s
        "yaw_rate",  # rad/s, limit of the yaw trajectory
        "yaw_acceleration",  # rad/s2
        *vector("rate_p"),  # (rad/s2)/(rad/s)
        *vector("rate_i"),  # (rad/s2)/rad
        *vector("rate_d"),  # (rad/s2)/(rad/s2)
        *vector("rate_integral_limit"),  # rad/s2
        *vector("gyro_b", "012"),  # 1, numerator of the gyro's low pass
        *vector("gyro_a", "12"),  # 1, its denominator
        "rate_derivative_gain",  # 1, of the D term's low pass, per event
        "gyro_bias_gain",  # 1, of the bias's low pass, per event
        "thrust_model_factor",  # 0 a thrust linear in the command … 1 quadratic
        "yaw_margin",  # fraction of collective thrust that yaw may take
        "contact_time",  # s, low thrust for so long is a contact with the ground
        "contact_speed",  # m/s, and vertical motion below this
    ),
)

# The state between two events, apart from the outputs.
STATE = Layout(
    "CascadeState",
    (
        "begun",  # 0 before the first event
        "takeoff",  # 0 on the ground … 1 in flight
        "contact_time",  # s, since when the ground seems to carry the vehicle
        *vector("p_ref"),  # m, W, the trajectory
        *vector("v_ref"),  # m/s
        *vector("a_ref"),  # m/s2
        "yaw_ref",  # rad
        "yaw_rate_ref",  # rad/s
        *vector("velocity_integral"),  # m/s2
        *vector("correction", "xy"),  # m/s2, asked for on top of the trajectory, low-passed
        *vector("v_last"),  # m/s
        *vector("v_derivative"),  # m/s2, low-passed
        "gyro_known",  # 0/1, gyro_last holds a sample
        "bias_known",  # 0/1
        *vector("gyro_last"),  # rad/s, as measured
        *vector("gyro_bias"),  # rad/s
        *vector("filter_1"),  # rad/s, the gyro's low pass, transposed direct form II
        *vector("filter_2"),  # rad/s
        *vector("w_last"),  # rad/s, low-passed
        *vector("w_derivative"),  # rad/s2, low-passed
        *vector("rate_integral"),  # rad/s2
        "horizontal_known",  # 0/1, the estimate was valid at the last event
        "vertical_known",  # 0/1
        "horizontal_reset_counter",
        "vertical_reset_counter",
    ),
)

# What the stages asked of each other, for logs.
CASCADE_SETPOINTS = Layout(
    "CascadeSetpoints",
    (
        *vector("p_WB"),  # m, the trajectory; NaN where the position is not controlled
        *vector("v_WB"),  # m/s, after the position controller
        *vector("a_WB"),  # m/s2, after the velocity controller, not yet limited
        *vector("q_WB", "wxyz"),
        "thrust",  # collective thrust as a fraction of the maximum
        *vector("w_WB_B"),  # rad/s, after the attitude controller
        *vector("angular_acceleration"),  # rad/s2, B, after the rate controller
        "roll_pitch_share",  # 0..1, of the roll and pitch demand that the rotors can give
        "yaw_share",  # 0..1, the same for yaw
        "takeoff",  # 0 on the ground … 1 in flight
        "ground_contact",  # 0/1, as the controller believes
    ),
)

# Where the fields lie in VEHICLE_ESTIMATE, INERTIAL and SETPOINT.
_ATTITUDE_VALID, _HORIZONTAL_VALID, _VERTICAL_VALID = 1, 2, 3
_Q, _P, _V, _W = 4, 8, 11, 14
_HORIZONTAL_RESET_COUNTER, _HORIZONTAL_RESET = 31, 32
_VERTICAL_RESET_COUNTER, _VERTICAL_RESET = 34, 35
_IMU_VALID, _DELTA_ANGLE, _DELTA_ANGLE_DT = 3, 4, 10
_P_SP, _V_SP, _YAW_SP, _ARMED, _MAXIMUM_SPEED, _A_SP = 0, 3, 6, 7, 8, 9

_index = PARAMETERS.index
_DT = _index("period")
_HOVER = _index("hover_thrust")
_THR_MIN = _index("thrust_minimum")
_THR_MAX = _index("thrust_maximum")
_THR_MARGIN = _index("thrust_horizontal_margin")
_THR_CONTACT = _index("thrust_contact")
_TILT_FLIGHT = _index("tilt_flight")
_TILT_TAKEOFF = _index("tilt_takeoff")
_POS_XY = _index("position_xy")
_POS_Z = _index("position_z")
_VEL_P_XY = _index("velocity_p_xy")
_VEL_P_Z = _index("velocity_p_z")
_VEL_I_XY = _index("velocity_i_xy")
_VEL_I_Z = _index("velocity_i_z")
_VEL_D_XY = _index("velocity_d_xy")
_VEL_D_Z = _index("velocity_d_z")
_VEL_LP = _index("velocity_derivative_gain")
_CORR_LP = _index("correction_gain")
_SPEED_XY = _index("speed_xy_maximum")
_CRUISE = _index("speed_xy_cruise")
_SPEED_UP = _index("speed_up")
_SPEED_DOWN = _index("speed_down")
_ACC_XY = _index("acceleration_xy")
_ACC_UP = _index("acceleration_up")
_ACC_DOWN = _index("acceleration_down")
_JERK = _index("jerk")
_TRAJ_P = _index("trajectory_gain")
_TRAJ_ERR = _index("trajectory_error")
_TKO_RAMP = _index("takeoff_ramp")
_TKO_SPEED = _index("takeoff_speed")
_ATT_P = _index("attitude_x")
_YAW_WEIGHT = _index("yaw_weight")
_RATE_LIMIT = _index("rate_limit_x")
_YAW_RATE = _index("yaw_rate")
_YAW_ACC = _index("yaw_acceleration")
_RATE_P = _index("rate_p_x")
_RATE_I = _index("rate_i_x")
_RATE_D = _index("rate_d_x")
_RATE_I_LIMIT = _index("rate_integral_limit_x")
_GYRO_B = _index("gyro_b_0")
_GYRO_A = _index("gyro_a_1")
_RATE_LP = _index("rate_derivative_gain")
_BIAS_LP = _index("gyro_bias_gain")
_THR_MDL = _index("thrust_model_factor")
_YAW_MARGIN = _index("yaw_margin")
_CONTACT_TIME = _index("contact_time")
_CONTACT_SPEED = _index("contact_speed")

_SIZE = STATE.size
_index = STATE.index
_BEGUN = _index("begun")
_TAKEOFF = _index("takeoff")
_CONTACT = _index("contact_time")
_P_REF = _index("p_ref_x")
_V_REF = _index("v_ref_x")
_A_REF = _index("a_ref_x")
_YAW_REF = _index("yaw_ref")
_YAW_RATE_REF = _index("yaw_rate_ref")
_VEL_INT = _index("velocity_integral_x")
_CORRECTION = _index("correction_x")
_V_LAST = _index("v_last_x")
_V_DOT = _index("v_derivative_x")
_GYRO_KNOWN = _index("gyro_known")
_BIAS_KNOWN = _index("bias_known")
_GYRO_LAST = _index("gyro_last_x")
_GYRO_BIAS = _index("gyro_bias_x")
_FILTER_1 = _index("filter_1_x")
_FILTER_2 = _index("filter_2_x")
_W_LAST = _index("w_last_x")
_W_DOT = _index("w_derivative_x")
_RATE_INT = _index("rate_integral_x")
_H_KNOWN = _index("horizontal_known")
_V_KNOWN = _index("vertical_known")
_H_COUNTER = _index("horizontal_reset_counter")
_V_COUNTER = _index("vertical_reset_counter")

_index = CASCADE_SETPOINTS.index
_OUT_P = _index("p_WB_x")
_OUT_V = _index("v_WB_x")
_OUT_A = _index("a_WB_x")
_OUT_Q = _index("q_WB_w")
_OUT_THRUST = _index("thrust")
_OUT_W = _index("w_WB_B_x")
_OUT_ALPHA = _index("angular_acceleration_x")
_OUT_SHARE = _index("roll_pitch_share")
_OUT_YAW_SHARE = _index("yaw_share")
_OUT_TAKEOFF = _index("takeoff")
_OUT_CONTACT = _index("ground_contact")


@njit(cache=True)
def square_root_law(error, gain, limit):
    """A proportional law whose output never needs to change faster than `limit`.

    gain·error while |error| ≤ limit/gain², beyond it √(2·limit·(|error| − limit/(2 gain²))):
    with output = d error/dt, the second derivative stays within `limit` (m/s2 for a distance).
    """
    linear = limit / (gain * gain)
    if abs(error) <= linear:
        return gain * error
    return math.copysign(math.sqrt(2.0 * limit * (abs(error) - 0.5 * linear)), error)


@njit(cache=True)
def clamp(value, low, high):
    """`value`, but not below `low` and not above `high`."""
    return min(max(value, low), high)


@njit(cache=True)
def wrap_angle(angle):
    """The same angle in [−π, π] (rad)."""
    return angle - 2.0 * math.pi * round(angle / (2.0 * math.pi))


@njit(cache=True)
def smooth_velocity(v, a, v_target, acceleration, jerk, dt):
    """One step of an S-curve of one axis towards `v_target`; returns the new v and a.

    The acceleration follows a square-root law of the speed error, with at most
    `acceleration`, and changes by at most `jerk`·dt.
    """
    wanted = square_root_law(v_target - v, VELOCITY_SMOOTHING, jerk)
    wanted = clamp(wanted, -acceleration, acceleration)
    a_new = a + clamp(wanted - a, -jerk * dt, jerk * dt)
    return v + 0.5 * (a + a_new) * dt, a_new


@njit(cache=True)
def smooth_velocity_plane(vx, vy, ax, ay, tx, ty, acceleration, jerk, dt):
    """`smooth_velocity` in the plane: the limits hold for the vectors' lengths."""
    ex, ey = tx - vx, ty - vy
    error = math.hypot(ex, ey)
    scale = 0.0
    if error > 0.0:
        scale = min(square_root_law(error, VELOCITY_SMOOTHING, jerk), acceleration) / error
    jx, jy = ex * scale - ax, ey * scale - ay
    change = math.hypot(jx, jy)
    scale = min(1.0, jerk * dt / change) if change > 0.0 else 0.0
    ax_new, ay_new = ax + jx * scale, ay + jy * scale
    return vx + 0.5 * (ax + ax_new) * dt, vy + 0.5 * (ay + ay_new) * dt, ax_new, ay_new


@njit(cache=True)
def thrust_vector(ax, ay, az, hover, low, high, margin, tilt):
    """Collective thrust and tilt that give an acceleration, within their limits.

    The tilt is that of (ax, ay, g), so that vertical corrections do not change it
    (PX4's MPC_ACC_DECOUPLE), and at most `tilt`; vertical thrust goes before
    horizontal thrust but for `margin`.

    Returns
    -------
    collective : float
        Fraction of the maximum thrust.
    tx, ty : float
        Tangent of the tilt towards x and y: the thrust points along (tx, ty, 1).
    vertical : float
        Vertical component of the collective thrust before limits, a fraction.
    vertical_high : float
        The most that vertical component may be.
    """
    tangent = math.hypot(ax, ay) / GRAVITY
    limited = min(tangent, math.tan(tilt))
    vertical = hover * (az / GRAVITY + 1.0)
    kept = min(max(vertical, 0.0) * limited, margin)
    vertical_high = math.sqrt(max(high * high - kept * kept, 0.0))
    upward = clamp(vertical, low, max(vertical_high, low))
    if upward > 0.0:
        room = math.sqrt(max(high * high - upward * upward, 0.0)) / upward
        limited = min(limited, room)
    scale = limited / (tangent * GRAVITY) if tangent > 0.0 else 0.0
    collective = upward * math.sqrt(1.0 + limited * limited)
    return collective, ax * scale, ay * scale, vertical, vertical_high


@njit(cache=True)
def attitude_of_thrust(tx, ty, yaw):
    """The attitude whose z axis points along (tx, ty, 1) and whose x axis heads to `yaw`.

    The y axis is normal to z and to the heading (Mellinger, Kumar, "Minimum snap
    trajectory generation and control for quadrotors", ICRA 2011, section IV).
    Returns the quaternion w, x, y, z with w ≥ 0.
    """
    norm = 1.0 / math.sqrt(tx * tx + ty * ty + 1.0)
    zx, zy, zz = tx * norm, ty * norm, norm
    c, s = math.cos(yaw), math.sin(yaw)
    # y = z × heading, heading = (c, s, 0); zz > 0, so that y never vanishes
    yx, yy, yz = -zz * s, zz * c, zx * s - zy * c
    norm = 1.0 / math.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx * norm, yy * norm, yz * norm
    xx, xy, xz = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    # Shepperd's method, by the largest component
    trace = xx + yy + zz
    if trace >= xx and trace >= yy and trace >= zz:
        r = math.sqrt(1.0 + trace)
        k = 0.5 / r
        w, x, y, z = 0.5 * r, (yz - zy) * k, (zx - xz) * k, (xy - yx) * k
    elif xx >= yy and xx >= zz:
        r = math.sqrt(1.0 + xx - yy - zz)
        k = 0.5 / r
        w, x, y, z = (yz - zy) * k, 0.5 * r, (yx + xy) * k, (zx + xz) * k
    elif yy >= zz:
        r = math.sqrt(1.0 - xx + yy - zz)
        k = 0.5 / r
        w, x, y, z = (zx - xz) * k, (yx + xy) * k, 0.5 * r, (zy + yz) * k
    else:
        r = math.sqrt(1.0 - xx - yy + zz)
        k = 0.5 / r
        w, x, y, z = (xy - yx) * k, (zx + xz) * k, (zy + yz) * k, 0.5 * r
    if w < 0.0:
        return -w, -x, -y, -z
    return w, x, y, z


@njit(cache=True)
def _multiply(aw, ax, ay, az, bw, bx, by, bz):
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@njit(cache=True)
def attitude_error(qw, qx, qy, qz, dw, dx, dy, dz, yaw_weight):
    """Twice the vector part of the attitude error, with tilt before yaw (rad, in B).

    The shortest turn that brings the body's z axis where the setpoint d has it is
    taken whole, the turn about that axis which is left is multiplied by
    `yaw_weight` (Brescianini, Hehn, D'Andrea, "Nonlinear quadrocopter attitude
    control", technical report, ETH Zürich 2013: reduced and full attitude).
    """
    # z axes of body and setpoint in W
    zx, zy, zz = 2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy)
    ux, uy, uz = 2 * (dx * dz + dw * dy), 2 * (dy * dz - dw * dx), 1 - 2 * (dx * dx + dy * dy)
    w = 1.0 + zx * ux + zy * uy + zz * uz
    if w > 1e-6:
        x, y, z = zy * uz - zz * uy, zz * ux - zx * uz, zx * uy - zy * ux
        norm = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
        rw, rx, ry, rz = _multiply(
            w * norm, x * norm, y * norm, z * norm, qw, qx, qy, qz
        )  # the reduced attitude: tilt of the setpoint, no turn about z
        mw, _, _, mz = _multiply(rw, -rx, -ry, -rz, dw, dx, dy, dz)
        if mw < 0.0:
            mw, mz = -mw, -mz
        half = yaw_weight * math.atan2(mz, mw)
        dw, dx, dy, dz = _multiply(rw, rx, ry, rz, math.cos(half), 0.0, 0.0, math.sin(half))
    ew, ex, ey, ez = _multiply(qw, -qx, -qy, -qz, dw, dx, dy, dz)
    sign = 2.0 if ew >= 0.0 else -2.0
    return sign * ex, sign * ey, sign * ez


@njit(cache=True)
def allocate(thrust, roll, pitch, yaw, mixer, yaw_margin, rotors):
    """Rotor thrusts in [0, 1] for a demand, with roll and pitch before thrust before yaw.

    rotors = mixer (thrust, roll, pitch, yaw), unless that leaves [0, 1]. Then the
    largest share s ≤ 1 of roll and pitch is given for which some collective thrust
    t ≤ `thrust` keeps all rotors inside (so thrust is lowered but never raised:
    PX4's default without air mode), and of yaw the largest share that still fits,
    for which t may be lowered by at most `yaw_margin`.

    With p the thrust's column of the mixer and r the rotors' part of roll and
    pitch: t p + s r ≥ 0 asks for t ≥ s λ, λ = max(−rᵢ/pᵢ), and t p + s r ≤ 1 for
    t ≤ min (1 − s rᵢ)/pᵢ. Both meet in s = min(1, thrust/λ, 1/max(λ pᵢ + rᵢ)).

    Parameters
    ----------
    thrust : float
        Fraction of the maximum, in [0, 1].
    roll, pitch, yaw : float
        Angular accelerations about B's axes, rad/s2.
    mixer : array (N, 4)
        The rotors' shares of each; its first column is positive.
    yaw_margin : float
        Fraction of collective thrust.
    rotors : array (N,)
        Overwritten with the rotors' thrusts as fractions of each rotor's maximum.

    Returns
    -------
    thrust, share, yaw_share : float
        The collective thrust given, and the shares of roll and pitch and of yaw.
    """
    count = mixer.shape[0]
    lowest = 0.0  # λ
    for i in range(count):
        lowest = max(lowest, -(mixer[i, 1] * roll + mixer[i, 2] * pitch) / mixer[i, 0])
    share = 1.0
    if lowest > thrust:
        share = thrust / lowest
    for i in range(count):
        span = lowest * mixer[i, 0] + mixer[i, 1] * roll + mixer[i, 2] * pitch
        if span * share > 1.0:
            share = 1.0 / span
    given = thrust
    for i in range(count):
        rotors[i] = share * (mixer[i, 1] * roll + mixer[i, 2] * pitch)
        given = min(given, (1.0 - rotors[i]) / mixer[i, 0])
    # yaw: lower the thrust where yaw asks for room at the top, then scale yaw to what fits
    excess = 0.0
    for i in range(count):
        over = given * mixer[i, 0] + rotors[i] + mixer[i, 3] * yaw - 1.0
        excess = max(excess, over / mixer[i, 0])
    given -= min(excess, yaw_margin, max(given - share * lowest, 0.0))
    yaw_share = 1.0
    for i in range(count):
        rotors[i] = clamp(rotors[i] + given * mixer[i, 0], 0.0, 1.0)
        part = mixer[i, 3] * yaw
        if rotors[i] + part > 1.0:
            yaw_share = min(yaw_share, (1.0 - rotors[i]) / part)
        elif rotors[i] + part < 0.0:
            yaw_share = min(yaw_share, -rotors[i] / part)
    for i in range(count):
        rotors[i] = clamp(rotors[i] + yaw_share * mixer[i, 3] * yaw, 0.0, 1.0)
    return given, share, yaw_share


@njit(cache=True)
def command_of_thrust(thrust, factor):
    """The command c of a rotor with factor·c² + (1 − factor)·c = thrust, both in [0, 1].

    `factor` is PX4's THR_MDL_FAC: 0 a thrust linear in the command, 1 quadratic.
    """
    if factor == 0.0:
        return thrust
    rest = 1.0 - factor
    return (math.sqrt(rest * rest + 4.0 * factor * thrust) - rest) / (2.0 * factor)


@njit(cache=True)
def _body_rate(x, estimate, imu, k):
    """Filtered rate and its derivative into `x`; see `MultirotorCascade` on the bias."""
    dt = k[_DT]
    measured = imu[_IMU_VALID] > 0.5 and imu[_DELTA_ANGLE_DT] > 0.0
    gain = 1.0
    if measured and x[_GYRO_KNOWN] > 0.5:
        gain = k[_BIAS_LP] if x[_BIAS_KNOWN] > 0.5 else 1.0
        x[_BIAS_KNOWN] = 1.0
        for i in range(3):
            bias = x[_GYRO_LAST + i] - estimate[_W + i]
            x[_GYRO_BIAS + i] += gain * (bias - x[_GYRO_BIAS + i])
    for i in range(3):
        rate = estimate[_W + i]
        if measured:
            gyro = imu[_DELTA_ANGLE + i] / imu[_DELTA_ANGLE_DT]
            x[_GYRO_LAST + i] = gyro
            if x[_BIAS_KNOWN] > 0.5:
                rate = gyro - x[_GYRO_BIAS + i]
        if x[_BEGUN] < 0.5:  # the filter's steady state
            x[_FILTER_2 + i] = (k[_GYRO_B + 2] - k[_GYRO_A + 1]) * rate
            x[_FILTER_1 + i] = (1.0 - k[_GYRO_B]) * rate
            x[_W_LAST + i] = rate
        w = k[_GYRO_B] * rate + x[_FILTER_1 + i]
        x[_FILTER_1 + i] = k[_GYRO_B + 1] * rate - k[_GYRO_A] * w + x[_FILTER_2 + i]
        x[_FILTER_2 + i] = k[_GYRO_B + 2] * rate - k[_GYRO_A + 1] * w
        x[_W_DOT + i] += k[_RATE_LP] * ((w - x[_W_LAST + i]) / dt - x[_W_DOT + i])
        x[_W_LAST + i] = w
    x[_GYRO_KNOWN] = 1.0 if measured else 0.0


@njit(cache=True)
def _follow_vehicle(x, estimate):
    """Put the trajectory where the vehicle is, at rest, and forget the integrals."""
    for i in range(3):
        x[_P_REF + i] = estimate[_P + i]
        x[_V_REF + i] = x[_A_REF + i] = 0.0
        x[_VEL_INT + i] = x[_RATE_INT + i] = 0.0
    q = estimate
    x[_YAW_REF] = math.atan2(
        2 * (q[_Q] * q[_Q + 3] + q[_Q + 1] * q[_Q + 2]),
        1 - 2 * (q[_Q + 2] * q[_Q + 2] + q[_Q + 3] * q[_Q + 3]),
    )
    x[_YAW_RATE_REF] = 0.0


@njit(cache=True)
def _follow_resets(x, estimate):
    """A jump of the estimate is not a motion of the vehicle: the trajectory jumps with it."""
    horizontal, vertical = estimate[_HORIZONTAL_VALID] > 0.5, estimate[_VERTICAL_VALID] > 0.5
    for i in range(3):
        if (vertical and x[_V_KNOWN] < 0.5) if i == 2 else (horizontal and x[_H_KNOWN] < 0.5):
            x[_P_REF + i] = estimate[_P + i]
            x[_V_REF + i] = estimate[_V + i]
            x[_A_REF + i] = 0.0
        elif i < 2 and x[_H_COUNTER] != estimate[_HORIZONTAL_RESET_COUNTER]:
            x[_P_REF + i] += estimate[_HORIZONTAL_RESET + i]
        elif i == 2 and x[_V_COUNTER] != estimate[_VERTICAL_RESET_COUNTER]:
            x[_P_REF + 2] += estimate[_VERTICAL_RESET]
    x[_H_KNOWN] = 1.0 if horizontal else 0.0
    x[_V_KNOWN] = 1.0 if vertical else 0.0
    x[_H_COUNTER] = estimate[_HORIZONTAL_RESET_COUNTER]
    x[_V_COUNTER] = estimate[_VERTICAL_RESET_COUNTER]


@njit(cache=True)
def _trajectory(x, estimate, setpoint, k):
    """Move the trajectory towards the setpoint by one period, within speed, acceleration, jerk."""
    dt, jerk = k[_DT], k[_JERK]
    ex = ey = ez = tx = ty = tz = 0.0
    if math.isfinite(setpoint[_P_SP]):
        ex = setpoint[_P_SP] - x[_P_REF]
    if math.isfinite(setpoint[_P_SP + 1]):
        ey = setpoint[_P_SP + 1] - x[_P_REF + 1]
    if math.isfinite(setpoint[_P_SP + 2]):
        ez = setpoint[_P_SP + 2] - x[_P_REF + 2]
    if math.isfinite(setpoint[_V_SP]):
        tx = setpoint[_V_SP]
    if math.isfinite(setpoint[_V_SP + 1]):
        ty = setpoint[_V_SP + 1]
    if math.isfinite(setpoint[_V_SP + 2]):
        tz = setpoint[_V_SP + 2]

    # Half of the acceleration is kept for the time that the jerk limit costs.
    distance = math.hypot(ex, ey)
    if distance > 0.0:
        limit = setpoint[_MAXIMUM_SPEED]
        if not limit > 0.0:  # NaN too
            limit = k[_CRUISE]
        speed = min(square_root_law(distance, k[_TRAJ_P], 0.5 * k[_ACC_XY]), limit)
        tx += ex / distance * speed
        ty += ey / distance * speed
    speed = math.hypot(tx, ty)
    if speed > k[_SPEED_XY]:
        tx *= k[_SPEED_XY] / speed
        ty *= k[_SPEED_XY] / speed
    limit = k[_ACC_UP] if ez < 0.0 else k[_ACC_DOWN]  # of the braking at its end
    tz = clamp(tz + square_root_law(ez, k[_TRAJ_P], 0.5 * limit), -k[_SPEED_DOWN], k[_SPEED_UP])

    vx, vy, vz = x[_V_REF], x[_V_REF + 1], x[_V_REF + 2]
    x[_V_REF], x[_V_REF + 1], x[_A_REF], x[_A_REF + 1] = smooth_velocity_plane(
        vx, vy, x[_A_REF], x[_A_REF + 1], tx, ty, k[_ACC_XY], jerk, dt
    )
    limit = k[_ACC_UP] if tz > vz else k[_ACC_DOWN]
    x[_V_REF + 2], x[_A_REF + 2] = smooth_velocity(vz, x[_A_REF + 2], tz, limit, jerk, dt)

    # The trajectory waits for a vehicle that lags behind on the way.
    ahead = 0.0
    speed = math.hypot(vx, vy)
    if speed > 0.0:
        ahead = ((x[_P_REF] - estimate[_P]) * vx + (x[_P_REF + 1] - estimate[_P + 1]) * vy) / speed
    pace = dt * clamp(1.0 - ahead / k[_TRAJ_ERR], 0.0, 1.0)
    x[_P_REF] += 0.5 * (vx + x[_V_REF]) * pace
    x[_P_REF + 1] += 0.5 * (vy + x[_V_REF + 1]) * pace
    ahead = math.copysign(1.0, vz) * (x[_P_REF + 2] - estimate[_P + 2])
    pace = dt * clamp(1.0 - ahead / k[_TRAJ_ERR], 0.0, 1.0)
    x[_P_REF + 2] += 0.5 * (vz + x[_V_REF + 2]) * pace
    for i in range(3):
        if not math.isfinite(setpoint[_P_SP + i]):
            x[_P_REF + i] = estimate[_P + i]


@njit(cache=True)
def _yaw_trajectory(x, setpoint, k):
    """Turn the yaw setpoint towards what is asked, within rate and acceleration."""
    dt = k[_DT]
    wanted = 0.0
    if math.isfinite(setpoint[_YAW_SP]):
        error = wrap_angle(setpoint[_YAW_SP] - x[_YAW_REF])
        wanted = square_root_law(error, k[_ATT_P + 2], k[_YAW_ACC])
        wanted = clamp(wanted, -k[_YAW_RATE], k[_YAW_RATE])
    step = k[_YAW_ACC] * dt
    rate = x[_YAW_RATE_REF] + clamp(wanted - x[_YAW_RATE_REF], -step, step)
    x[_YAW_REF] = wrap_angle(x[_YAW_REF] + 0.5 * (x[_YAW_RATE_REF] + rate) * dt)
    x[_YAW_RATE_REF] = rate


@njit(cache=True)
def _position_and_velocity(x, out, estimate, setpoint, k, flying):
    """Position P, velocity PID: setpoints of velocity and acceleration into `out`.

    A velocity that is not controlled, or not known, asks for no acceleration and
    lets its trajectory follow the vehicle.
    """
    for i in range(3):
        valid = estimate[_VERTICAL_VALID if i == 2 else _HORIZONTAL_VALID] > 0.5
        position = math.isfinite(setpoint[_P_SP + i])
        v = x[_V_REF + i]
        out[_OUT_P + i] = math.nan
        if flying and position and valid:
            out[_OUT_P + i] = x[_P_REF + i]
            v += k[_POS_Z if i == 2 else _POS_XY] * (x[_P_REF + i] - estimate[_P + i])
        wanted = position or math.isfinite(setpoint[_V_SP + i]) or not flying
        if not (valid and wanted):
            x[_P_REF + i] = estimate[_P + i]
            x[_V_REF + i] = estimate[_V + i]
            x[_A_REF + i] = 0.0
            v = math.nan
        out[_OUT_V + i] = v
    speed = math.hypot(out[_OUT_V], out[_OUT_V + 1])
    if speed > k[_SPEED_XY]:
        out[_OUT_V] *= k[_SPEED_XY] / speed
        out[_OUT_V + 1] *= k[_SPEED_XY] / speed
    if flying and not math.isnan(out[_OUT_V + 2]):
        out[_OUT_V + 2] = clamp(out[_OUT_V + 2], -k[_SPEED_DOWN], k[_SPEED_UP])
    for i in range(3):
        correction = 0.0
        controlled = not math.isnan(out[_OUT_V + i])
        if controlled:
            correction = (
                k[_VEL_P_Z if i == 2 else _VEL_P_XY] * (out[_OUT_V + i] - estimate[_V + i])
                + x[_VEL_INT + i]
                - k[_VEL_D_Z if i == 2 else _VEL_D_XY] * x[_V_DOT + i]
            )
        if i < 2:
            x[_CORRECTION + i] += k[_CORR_LP] * (correction - x[_CORRECTION + i])
            correction = x[_CORRECTION + i]
        out[_OUT_A + i] = correction
        if controlled:
            out[_OUT_A + i] += x[_A_REF + i]
            if flying and math.isfinite(setpoint[_A_SP + i]):
                out[_OUT_A + i] += setpoint[_A_SP + i]


@njit(cache=True)
def cascade_step(x, rotors, out, estimate, imu, setpoint, k, mixer):
    """One event of the cascade; the equations are those of `MultirotorCascade`.

    Parameters
    ----------
    x : array (STATE.size,)
        The state, updated in place.
    rotors : array (N,)
        Overwritten with the rotor commands, in [0, 1].
    out : array (CASCADE_SETPOINTS.size,)
        Overwritten with the setpoints between the stages.
    estimate, imu, setpoint : arrays
        Of the layouts VEHICLE_ESTIMATE, INERTIAL and SETPOINT.
    k : array (PARAMETERS.size,)
    mixer : array (N, 4)
        See `allocate`.
    """
    dt = k[_DT]
    armed = setpoint[_ARMED] > 0.5
    if x[_BEGUN] < 0.5 and not estimate[_ATTITUDE_VALID] > 0.5:
        if not armed:
            x[_TAKEOFF] = 0.0
            rotors[:] = 0.0
        return
    _body_rate(x, estimate, imu, k)
    if x[_BEGUN] < 0.5:
        x[_BEGUN] = 1.0
        _follow_vehicle(x, estimate)
        for i in range(3):
            x[_V_LAST + i] = estimate[_V + i]
    for i in range(3):
        derivative = (estimate[_V + i] - x[_V_LAST + i]) / dt
        x[_V_DOT + i] += k[_VEL_LP] * (derivative - x[_V_DOT + i])
        x[_V_LAST + i] = estimate[_V + i]

    _follow_resets(x, estimate)

    if armed and x[_TAKEOFF] == 0.0:
        if math.isfinite(setpoint[_P_SP + 2]):
            up = setpoint[_P_SP + 2] - estimate[_P + 2] > TAKEOFF_HEIGHT
        else:
            up = setpoint[_V_SP + 2] > TAKEOFF_CLIMB
        armed = up and estimate[_VERTICAL_VALID] > 0.5  # or waits with stopped rotors
    if not armed:
        _follow_vehicle(x, estimate)
        x[_TAKEOFF] = x[_CONTACT] = 0.0
        x[_CORRECTION] = x[_CORRECTION + 1] = 0.0
        rotors[:] = 0.0
        out[:] = 0.0
        out[_OUT_Q] = 1.0
        return

    flying = x[_TAKEOFF] >= 1.0
    if flying:
        _trajectory(x, estimate, setpoint, k)
        _yaw_trajectory(x, setpoint, k)
    else:
        # The climb rate rises from the one at which the velocity controller wants no thrust.
        _follow_vehicle(x, estimate)
        x[_TAKEOFF] += 1.0 if k[_TKO_RAMP] <= dt else dt / k[_TKO_RAMP]
        if x[_TAKEOFF] >= 1.0:
            x[_TAKEOFF] = 1.0
        start = -GRAVITY / k[_VEL_P_Z]
        x[_V_REF + 2] = start + x[_TAKEOFF] * (k[_TKO_SPEED] - start)
    contact = x[_CONTACT] >= k[_CONTACT_TIME]

    _position_and_velocity(x, out, estimate, setpoint, k, flying)
    ax, ay, az = out[_OUT_A], out[_OUT_A + 1], out[_OUT_A + 2]
    if contact:
        ax = ay = 0.0

    # acceleration to thrust and attitude
    collective, tx, ty, vertical, vertical_high = thrust_vector(
        ax,
        ay,
        az,
        k[_HOVER],
        k[_THR_MIN] if flying else 0.0,
        k[_THR_MAX],
        k[_THR_MARGIN],
        k[_TILT_FLIGHT] if flying else k[_TILT_TAKEOFF],
    )
    down = flying and out[_OUT_V + 2] < 0.0 and collective < k[_THR_CONTACT]
    if down and abs(estimate[_V + 2]) < k[_CONTACT_SPEED]:
        x[_CONTACT] += dt
    else:
        x[_CONTACT] = 0.0
    qw, qx, qy, qz = attitude_of_thrust(tx, ty, x[_YAW_REF])
    integrate = flying and collective >= k[_THR_CONTACT]
    if integrate:
        for i in range(3):
            error = out[_OUT_V + i] - estimate[_V + i]
            if math.isnan(error):
                continue
            if i < 2:
                # back-calculation (Åström, Murray, "Feedback Systems", 2nd ed., section 11.4)
                produced = GRAVITY * (tx if i == 0 else ty)
                error -= 2.0 / k[_VEL_P_XY] * (out[_OUT_A + i] - produced)
                x[_VEL_INT + i] += k[_VEL_I_XY] * error * dt
            else:
                if (vertical > vertical_high and error > 0.0) or (
                    vertical < k[_THR_MIN] and error < 0.0
                ):
                    continue  # clamping: no deeper into saturation
                integral = x[_VEL_INT + 2] + k[_VEL_I_Z] * error * dt
                x[_VEL_INT + 2] = clamp(integral, -GRAVITY, GRAVITY)

    # attitude P
    bw, bx, by, bz = estimate[_Q], estimate[_Q + 1], estimate[_Q + 2], estimate[_Q + 3]
    ex, ey, ez = attitude_error(bw, bx, by, bz, qw, qx, qy, qz, k[_YAW_WEIGHT])
    yaw_rate = x[_YAW_RATE_REF]
    # the yaw trajectory's rate, about W's z axis, expressed in B
    wx = k[_ATT_P] * ex + 2 * (bx * bz - bw * by) * yaw_rate
    wy = k[_ATT_P + 1] * ey + 2 * (by * bz + bw * bx) * yaw_rate
    wz = k[_ATT_P + 2] / max(k[_YAW_WEIGHT], 0.1) * ez + (1 - 2 * (bx * bx + by * by)) * yaw_rate
    out[_OUT_W] = clamp(wx, -k[_RATE_LIMIT], k[_RATE_LIMIT])
    out[_OUT_W + 1] = clamp(wy, -k[_RATE_LIMIT + 1], k[_RATE_LIMIT + 1])
    out[_OUT_W + 2] = clamp(wz, -k[_RATE_LIMIT + 2], k[_RATE_LIMIT + 2])

    # rate PID and allocation
    for i in range(3):
        out[_OUT_ALPHA + i] = (
            k[_RATE_P + i] * (out[_OUT_W + i] - x[_W_LAST + i])
            + x[_RATE_INT + i]
            - k[_RATE_D + i] * x[_W_DOT + i]
        )
    given, share, yaw_share = allocate(
        collective,
        out[_OUT_ALPHA],
        out[_OUT_ALPHA + 1],
        out[_OUT_ALPHA + 2],
        mixer,
        k[_YAW_MARGIN],
        rotors,
    )
    for i in range(mixer.shape[0]):
        rotors[i] = command_of_thrust(rotors[i], k[_THR_MDL])
    if integrate:
        for i in range(3):
            error = out[_OUT_W + i] - x[_W_LAST + i]
            if (yaw_share if i == 2 else share) < 1.0 and error * out[_OUT_ALPHA + i] > 0.0:
                continue  # clamping
            integral = x[_RATE_INT + i] + k[_RATE_I + i] * error * dt
            x[_RATE_INT + i] = clamp(integral, -k[_RATE_I_LIMIT + i], k[_RATE_I_LIMIT + i])

    out[_OUT_Q], out[_OUT_Q + 1], out[_OUT_Q + 2], out[_OUT_Q + 3] = qw, qx, qy, qz
    out[_OUT_THRUST] = given
    out[_OUT_SHARE] = share
    out[_OUT_YAW_SHARE] = yaw_share
    out[_OUT_TAKEOFF] = x[_TAKEOFF]
    out[_OUT_CONTACT] = 1.0 if contact else 0.0


@njit(cache=True)
def cascade_event(memory, rotors, estimate, imu, setpoint, k, mixer):
    """`cascade_step` for a `memory` that holds the state and behind it the setpoints."""
    cascade_step(memory[:_SIZE], rotors, memory[_SIZE:], estimate, imu, setpoint, k, mixer)

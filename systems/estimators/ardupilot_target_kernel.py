"""ArduPilot's landing-target filters, compiled; see `ardupilot_target` for the equations."""

import math

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

PARAMETERS = Layout(
    "ArduPilotTargetParameters",
    (
        "kalman",  # 0/1
        "acceleration_noise",  # m/s2
        "buffer_length",  # frames
        "gate",  # on the largest NIS
        "rejections",  # in a row before the next measurement is fused anyway
        "acquisition_time",  # s
        "acquisition_interval",  # s, between updates during acquisition
        "lost_time",  # s
        "moving_target",  # 0/1
        "period",  # s
    ),
)
FRAMES = 16  # 0.32 s of 20 ms; the longest lag is 0.25 s
_FRAME = 5  # delta velocity E, N; velocity E, N; velocity valid
MEMORY = Layout(
    "ArduPilotTargetMemory",
    (
        "last_arrival",  # s
        "initialised",  # 0/1
        "initialised_at",  # s
        "last_update",  # s
        "rejected",  # measurements in a row
        "steps",  # updates so far
        "vertical",  # m, p_BP_W z
        # m, m/s at the delayed horizon; variances m2, m2/s, m2/s2
        *(f"{axis}_{name}" for axis in "xy" for name in ("r", "v", "prr", "prv", "pvv")),
        *(
            f"frame_{i}_{name}"
            for i in range(FRAMES)
            for name in ("dvx", "dvy", "vx", "vy", "valid")
        ),
    ),
)

(
    _KALMAN,
    _NOISE,
    _LENGTH,
    _GATE,
    _REJECTIONS,
    _ACQUISITION,
    _INTERVAL,
    _LOST,
    _MOVING,
    _PERIOD,
) = range(PARAMETERS.size)
(_ARRIVAL, _INITIALISED, _INITIALISED_AT, _UPDATE, _REJECTED, _STEPS, _Z, _X) = range(8)
_Y = _X + 5
_BUFFER = _Y + 5
_INITIAL_SPEED = 2.0  # m/s, one sigma, with a valid velocity
_INITIAL_SPEED_BLIND = 10.0  # m/s, without

_E_VALID = VEHICLE_ESTIMATE.index("horizontal_valid")
_E_V = VEHICLE_ESTIMATE.index("v_WB_x")
_E_W = VEHICLE_ESTIMATE.index("w_WB_B_x")
_E_A = VEHICLE_ESTIMATE.index("a_WB_x")
_M_P = TARGET_MEASUREMENT.index("p_BP_W_x")
_M_ZZ = TARGET_MEASUREMENT.index("covariance_zz")
_M_SOURCE = TARGET_MEASUREMENT.index("source")
_VALIDITY, _ACQUIRED, _FUSED, _P = range(4)
_V = TARGET_ESTIMATE.index("v_BP_W_x")
_V_PAD = TARGET_ESTIMATE.index("v_WP_x")
_P_VARIANCE = TARGET_ESTIMATE.index("position_variance_x")
_V_VARIANCE = TARGET_ESTIMATE.index("velocity_variance_x")
_RATIO = TARGET_ESTIMATE.index("innovation_test_ratio")
_REJECTED_OUT = TARGET_ESTIMATE.index("rejected_count")
_SOURCE = TARGET_ESTIMATE.index("source")


@njit(cache=True)
def predict(m, i, dt, delta_velocity, noise):
    """Predict the axis at m[i:i+5] by dt; `noise` is one sigma of the velocity change."""
    m[i] += m[i + 1] * dt
    m[i + 1] += delta_velocity
    m[i + 2] += dt * (2.0 * m[i + 3] + dt * m[i + 4])
    m[i + 3] += dt * m[i + 4]
    m[i + 4] += noise * noise


@njit(cache=True)
def fuse(m, i, position, variance):
    """Fuse a measured position into the axis at m[i:i+5]."""
    innovation = position - m[i]
    total = m[i + 2] + variance
    k0, k1 = m[i + 2] / total, m[i + 3] / total
    m[i] += k0 * innovation
    m[i + 1] += k1 * innovation
    m[i + 4] -= k1 * m[i + 3]
    m[i + 3] -= k0 * m[i + 3]
    m[i + 2] -= k0 * m[i + 2]


@njit(cache=True)
def _initialise(m, i, position, variance, speed, speed_sigma):
    m[i], m[i + 1] = position, speed
    m[i + 2], m[i + 3], m[i + 4] = variance, 0.0, speed_sigma * speed_sigma


@njit(cache=True)
def step(target, m, t, measurement, estimate, parameters):
    """One update at time t.

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
    dt = parameters[_PERIOD]
    kalman = parameters[_KALMAN] > 0.0
    length = int(parameters[_LENGTH])
    steps = int(m[_STEPS])
    newest = _BUFFER + _FRAME * (steps % FRAMES)
    for i in range(2):
        m[newest + i] = estimate[_E_A + i] * dt
        m[newest + 2 + i] = estimate[_E_V + i]
    m[newest + 4] = estimate[_E_VALID]
    m[_STEPS] += 1.0
    oldest_step = max(steps - length + 1, 0)
    oldest = _BUFFER + _FRAME * (oldest_step % FRAMES)

    velocity_known = True
    for k in range(oldest_step, steps + 1):
        velocity_known &= m[_BUFFER + _FRAME * (k % FRAMES) + 4] > 0.0
    if t - m[_UPDATE] > parameters[_LOST]:
        m[_INITIALISED] = 0.0
        target[_ACQUIRED] = 0.0
    usable = kalman or velocity_known
    if not usable:
        target[_ACQUIRED] = 0.0

    m[_Z] -= estimate[_E_V + 2] * dt
    if kalman and m[_INITIALISED] > 0.0:
        for i in range(2):
            predict(m, _X + 5 * i, dt, -m[oldest + i], parameters[_NOISE] * dt)
    elif target[_ACQUIRED] > 0.0:
        for i in range(2):
            m[_X + 5 * i] -= m[oldest + 2 + i] * dt
            m[_X + 5 * i + 1] = -m[oldest + 2 + i]

    if (
        usable
        and measurement[VALID] > 0.0
        and measurement[TIME_OF_ARRIVAL] != m[_ARRIVAL]
        and measurement[_M_P + 2] < 0.0
    ):
        _take(target, m, t, measurement, estimate, parameters, oldest)

    if kalman and m[_INITIALISED] > 0.0 and target[_ACQUIRED] == 0.0:
        if t - m[_UPDATE] > parameters[_INTERVAL]:
            m[_INITIALISED] = 0.0
        elif t - m[_INITIALISED_AT] > parameters[_ACQUISITION]:
            target[_ACQUIRED] = 1.0

    target[_VALIDITY] = t
    target[_REJECTED_OUT] = m[_REJECTED]
    if m[_INITIALISED] == 0.0:
        return
    for i in range(2):
        r, v = m[_X + 5 * i], m[_X + 5 * i + 1]
        for k in range(oldest_step + 1, steps + 1):
            v -= m[_BUFFER + _FRAME * (k % FRAMES) + i]
            r += v * dt
        target[_P + i] = r
        target[_V + i] = v
        moving = kalman and parameters[_MOVING] > 0.0 and target[_ACQUIRED] > 0.0
        target[_V_PAD + i] = v + estimate[_E_V + i] if moving else 0.0
        target[_P_VARIANCE + i] = m[_X + 5 * i + 2]
        target[_V_VARIANCE + i] = m[_X + 5 * i + 4]
    target[_P + 2] = m[_Z]
    target[_V + 2] = -estimate[_E_V + 2]


@njit(cache=True)
def _take(target, m, t, measurement, estimate, parameters, oldest):
    """Take a new measurement into the filters, if it passes the gate."""
    m[_ARRIVAL] = measurement[TIME_OF_ARRIVAL]
    w = estimate[_E_W : _E_W + 3]
    rate = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    height = -measurement[_M_P + 2]
    sigma = height * (0.01 + 0.01 * rate) + 0.02
    variance = sigma * sigma
    target[_SOURCE] = measurement[_M_SOURCE]
    target[_P_VARIANCE + 2] = measurement[_M_ZZ]
    m[_Z] = -height

    if parameters[_KALMAN] == 0.0 or m[_INITIALISED] == 0.0:
        known = m[oldest + 4] > 0.0
        for i in range(2):
            _initialise(
                m,
                _X + 5 * i,
                measurement[_M_P + i],
                variance,
                -m[oldest + 2 + i] if known else 0.0,
                _INITIAL_SPEED if known else _INITIAL_SPEED_BLIND,
            )
        if m[_INITIALISED] == 0.0:
            m[_INITIALISED] = 1.0
            m[_INITIALISED_AT] = t
        if parameters[_KALMAN] == 0.0:
            target[_ACQUIRED] = 1.0
        target[_RATIO] = 0.0
        m[_REJECTED] = 0.0
    else:
        nis = 0.0
        for i in range(2):
            innovation = measurement[_M_P + i] - m[_X + 5 * i]
            nis = max(nis, innovation * innovation / (m[_X + 5 * i + 2] + variance))
        target[_RATIO] = nis / parameters[_GATE]
        if nis >= parameters[_GATE] and m[_REJECTED] < parameters[_REJECTIONS]:
            m[_REJECTED] += 1.0
            return
        m[_REJECTED] = 0.0
        for i in range(2):
            fuse(m, _X + 5 * i, measurement[_M_P + i], variance)
    m[_UPDATE] = t
    target[_FUSED] = measurement[TIME_OF_VALIDITY]

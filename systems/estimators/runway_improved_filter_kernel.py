"""The improved filter (what Leonard 2016, chapter 7 leaves to do) as a pure function of arrays.

Thirteen states: the thesis's five errors and the constant errors that its tuning
hides in a hundredfold measurement noise,

    x = (ϵX, ϵY, ϵZ, ϵVN, ϵVE, ϵφN, ϵφE, β, ε, a, e, s, ϵψ)

with the attitude error of the inertial navigation (11), the camera's bearing
and elevation bias β and ε (harmonisation, pitch bias, the operator's click), the
antenna's azimuth and elevation bias a and e, the altimeter's scale factor s and
the heading's bias ϵψ. In level flight β and ϵψ look alike; in a bank the
heading's bias moves the elevation, too, and a filter that takes both for one becomes
sure of a wrong position. Between measurements

    ϵP′ = ϵV,  ϵZ′ = s V_Z,  ϵV′ = −g ϵφ,  ϵφ′ = ϵV/R_T + noise

* **Synchronised**: the inertial navigation is kept for a second; a measurement
  is compared with the navigation at the time it speaks of. The error moves
  little in between: x(t − τ) = x(t) − τ ẋ, so a row gets −τ times its position
  part in the columns of speed. The baro-inertial altitude is carried to now by
  the vertical speed.
* **Faulty measurements**: a scalar whose innovation exceeds `GATE` times its
  own standard deviation is refused. After `PATIENCE` seconds of refusals one
  is taken with a covariance that explains it: the filter might be the wrong one.
* **Antenna**: azimuth and elevation; with the altitude known, the elevation is
  a distance. Used in the air all the time.
* **Roll and place of the camera** are constant but no states: their share of the
  noise counts as often as pictures come in a second or two.
* **Laser**: its noise grows with the distance from the runway, for nobody knows
  the terrain there, and is multiplied for being correlated from sample to sample.
* **Wind and magnetic declination**: averages of what air data, compass and
  inertial navigation say of each other; the latter steers on the ground.
* **Ground phase**: the wheels' speed along the heading, and the runway's height.
"""

import math

import numpy as np
from numba import njit

from systems.estimators.runway_kalman import fuse, innovation_variance, sight, write_covariance
from systems.runway_frames import EARTH_RADIUS, GRAVITY, angles_from_pixel, wrap_angle
from systems.signals.runway_measurement import (
    AIRSPEED_AT,
    ANTENNA_AT,
    BARO_AT,
    FIX_AT,
    HEADING_AT,
    LASER_AT,
    MEASUREMENTS_END,
    PHASE_AT,
    PICTURE_AT,
    WHEELS_AT,
)

STATES = 13
HISTORY = 128  # entries of inertial navigation kept, 1.28 s
_ENTRY = 7  # time, X, Y, Z, yaw, pitch, roll

# entries of the memory
_X = 0
_P = _X + STATES
_SEEN = _P + STATES * STATES  # arrivals: fix, antenna, picture, laser, heading, wheels, airspeed
_PROPAGATED = _SEEN + 7  # s
_ACCEPTED = _PROPAGATED + 1  # s, the last picture that passed the gate
_CLICK = _ACCEPTED + 1
_DECLINATION = _CLICK + 1  # its average and the number of samples in it
_WINDS = _DECLINATION + 2  # samples in the wind's average
_HEAD = _WINDS + 1
_HISTORY = _HEAD + 1
MEMORY = _HISTORY + _ENTRY * HISTORY

# entries of the parameters
(
    Q_SPEED,  # (m/s)2/s
    Q_TILT,  # rad2/s
    Q_ALTITUDE,  # m2/s
    Q_CAMERA,  # rad2/s
    TILT,  # rad, initial standard deviations
    CAMERA_BEARING,  # rad
    CAMERA_ELEVATION,  # rad
    ANTENNA_AZIMUTH,  # rad
    ANTENNA_ELEVATION,  # rad
    SCALE,  # 1
    HEADING,  # rad
    ROLL,  # rad, of camera and inertial navigation together, not estimated
    CLICK,  # rad, a new click
    R_BEARING,  # rad2
    R_ELEVATION,  # rad2
    CAMERA_SHIFT,  # m, of the camera's position
    PICTURE_CORRELATION,  # pictures, for what is constant but no state
    R_ANTENNA,  # rad2
    R_LASER,  # m2
    TERRAIN,  # 1, standard deviation of the elevation per distance
    FLAT_WITHIN,  # m before the touch-down point
    LASER_CORRELATION,  # samples
    GATE,  # standard deviations
    PATIENCE,  # s
    CAMERA_LATENCY,  # s, known part of L_ti
    R_WHEELS,  # (m/s)2
    GEAR,  # m
    STATION_N,  # m
    STATION_E,  # m
    STATION_D,  # m
    FOV_H,  # rad
    FOV_V,  # rad
    IFOV_H,  # rad/px
    IFOV_V,  # rad/px
) = range(34)
CAMERA = 34  # position (3, m) and mounting (3, rad)
PARAMETERS = 40


def initial_memory() -> np.ndarray:
    """Nothing seen, nothing kept, shape (MEMORY,)."""
    memory = np.zeros(MEMORY)
    memory[_SEEN : _CLICK + 1] = -1.0
    memory[_HISTORY:] = -1.0
    return memory


@njit(cache=True)
def navigation_at(memory, time):
    """The kept inertial navigation nearest to a time (s), shape (7,), see `_ENTRY`."""
    best = int(memory[_HEAD])
    gap = 1e9
    for i in range(HISTORY):
        entry = _HISTORY + _ENTRY * i
        if memory[entry] >= 0.0 and abs(memory[entry] - time) < gap:
            gap = abs(memory[entry] - time)
            best = i
    entry = _HISTORY + _ENTRY * best
    return memory[entry : entry + _ENTRY]


@njit(cache=True)
def propagate(x, P, vertical_speed, dt, parameters):
    """Move state and covariance on by `dt` (s), in place."""
    rows = (0, 1, 2, 3, 4, 5, 6)
    columns = (3, 4, 11, 5, 6, 3, 4)
    turn = dt / EARTH_RADIUS
    steps = (dt, dt, vertical_speed * dt, -GRAVITY * dt, -GRAVITY * dt, turn, turn)
    for k in range(7):
        i, j, a = rows[k], columns[k], steps[k]
        x[i] += a * x[j]
        for m in range(STATES):
            P[i, m] += a * P[j, m]
        for m in range(STATES):
            P[m, i] += a * P[m, j]
    P[2, 2] += parameters[Q_ALTITUDE] * dt
    for i in range(2):
        P[3 + i, 3 + i] += parameters[Q_SPEED] * dt
        P[5 + i, 5 + i] += parameters[Q_TILT] * dt
        P[7 + i, 7 + i] += parameters[Q_CAMERA] * dt


@njit(cache=True)
def step(estimate, memory, measurements, parameters):
    """One step of the filter, in place.

    Parameters
    ----------
    estimate : array
        Layout `NAVIGATION_ESTIMATE`.
    memory : array, shape (MEMORY,)
    measurements : array
        Layout `MEASUREMENTS`.
    parameters : array, shape (PARAMETERS,)
    """
    inertial, baro = measurements[:BARO_AT], measurements[BARO_AT:FIX_AT]
    fix, antenna = measurements[FIX_AT:ANTENNA_AT], measurements[ANTENNA_AT:PICTURE_AT]
    picture, laser = measurements[PICTURE_AT:LASER_AT], measurements[LASER_AT:PHASE_AT]
    phase, heading = measurements[PHASE_AT], measurements[HEADING_AT:WHEELS_AT]
    wheels = measurements[WHEELS_AT:AIRSPEED_AT]
    airspeed = measurements[AIRSPEED_AT:MEASUREMENTS_END]
    if inertial[3] == 0.0 or baro[3] == 0.0:
        return
    x = memory[_X:_P]
    P = memory[_P:_SEEN].reshape(STATES, STATES)
    now = inertial[10]
    z_now = -baro[4] + inertial[9] * (now - baro[0])
    ahead = now - inertial[0]  # attitude comes twice as often as the rest
    head = (int(memory[_HEAD]) + 1) % HISTORY
    memory[_HEAD] = head
    entry = memory[_HISTORY + _ENTRY * head : _HISTORY + _ENTRY * (head + 1)]
    entry[0] = now
    entry[1] = inertial[4] + inertial[7] * ahead
    entry[2] = inertial[5] + inertial[8] * ahead
    entry[3] = z_now
    entry[4:7] = inertial[11:14]

    if estimate[1] > 0.0:
        propagate(x, P, inertial[9], now - memory[_PROPAGATED], parameters)
    memory[_PROPAGATED] = now

    if phase == 0.0 and fix[3] > 0.0 and fix[1] > memory[_SEEN]:
        memory[_SEEN] = fix[1]
        _fuse_fix(estimate, memory, x, P, inertial, fix, parameters)
    if estimate[1] == 0.0:
        return

    on_ground = phase >= 4.0 and wheels[3] > 0.0
    if 1.0 <= phase < 5.0:
        if not on_ground and antenna[3] > 0.0 and antenna[1] > memory[_SEEN + 1]:
            _fuse_antenna(estimate, memory, x, P, antenna, now, parameters)
        memory[_SEEN + 1] = antenna[1]
    if 2.0 <= phase < 5.0:
        if picture[3] > 0.0 and picture[1] > memory[_SEEN + 2]:
            _fuse_picture(estimate, memory, x, P, picture, now, parameters)
        memory[_SEEN + 2] = picture[1]
    if 3.0 <= phase < 5.0:
        if laser[3] > 0.0 and laser[1] > memory[_SEEN + 3]:
            _fuse_laser(estimate, memory, x, P, laser, now, parameters)
        memory[_SEEN + 3] = laser[1]
    yaw = inertial[11]
    if heading[1] > memory[_SEEN + 4]:
        memory[_SEEN + 4] = heading[1]
        if not on_ground:
            count = min(memory[_DECLINATION + 1] + 1.0, 2000.0)
            memory[_DECLINATION + 1] = count
            gap = wrap_angle(yaw - heading[4] - memory[_DECLINATION])
            memory[_DECLINATION] = wrap_angle(memory[_DECLINATION] + gap / count)
    if phase < 5.0 and airspeed[3] > 0.0 and airspeed[1] > memory[_SEEN + 6]:
        memory[_SEEN + 6] = airspeed[1]
        count = min(memory[_WINDS] + 1.0, 250.0)
        memory[_WINDS] = count
        level = math.sqrt(max(airspeed[4] ** 2 - inertial[9] ** 2, 1.0))
        wind_n = inertial[7] - x[3] - level * math.cos(yaw)
        wind_e = inertial[8] - x[4] - level * math.sin(yaw)
        estimate[38] += (wind_n - estimate[38]) / count
        estimate[39] += (wind_e - estimate[39]) / count
    if on_ground and wheels[1] > memory[_SEEN + 5]:
        # inertial navigation and compass, the latter freed of its declination in flight
        magnetic = wrap_angle(heading[4] + memory[_DECLINATION] - yaw)
        _fuse_wheels(estimate, memory, x, P, inertial, wheels, yaw + 0.5 * magnetic, parameters)
        memory[_SEEN + 5] = wheels[1]

    estimate[0] = now
    estimate[2] = entry[1] - x[0]
    estimate[3] = entry[2] - x[1]
    estimate[4] = z_now - x[2]
    estimate[5] = inertial[7] - x[3]
    estimate[6] = inertial[8] - x[4]
    estimate[7] = inertial[9]
    estimate[8:11] = inertial[11:14]
    estimate[11:16] = x[:5]
    write_covariance(P, estimate, 16)
    estimate[40] = memory[_DECLINATION]


@njit(cache=True)
def _fuse_fix(estimate, memory, x, P, inertial, fix, parameters):
    past = navigation_at(memory, fix[0])
    y = np.array(
        [
            past[1] - fix[4],
            past[2] - fix[5],
            past[3] - fix[6],
            inertial[7] - fix[7],
            inertial[8] - fix[8],
        ]
    )
    R = np.array([fix[9] ** 2, fix[9] ** 2, fix[10] ** 2, fix[11] ** 2, fix[11] ** 2])
    if estimate[1] == 0.0:
        estimate[1] = 1.0
        x[:] = 0.0
        x[:5] = y
        P[:] = 0.0
        sigmas = (
            parameters[TILT],
            parameters[TILT],
            parameters[CAMERA_BEARING],
            parameters[CAMERA_ELEVATION],
            parameters[ANTENNA_AZIMUTH],
            parameters[ANTENNA_ELEVATION],
            parameters[SCALE],
            parameters[HEADING],
        )
        for i in range(5):
            P[i, i] = R[i]
        for i in range(8):
            P[5 + i, 5 + i] = sigmas[i] ** 2
        return
    prior = x.copy()
    for i in range(5):
        H = np.zeros(STATES)
        H[i] = 1.0
        fuse(x, P, prior, H, y[i] - prior[i], R[i])


@njit(cache=True)
def _fuse_gated(estimate, x, P, prior, H, innovation, variance, parameters):
    """Fuse unless the innovation is faulty; returns whether it was taken."""
    S = innovation_variance(P, H, variance)
    if innovation * innovation > parameters[GATE] ** 2 * S:
        estimate[37] += 1.0
        return False
    fuse(x, P, prior, H, innovation, variance)
    return True


@njit(cache=True)
def _fuse_antenna(estimate, memory, x, P, antenna, now, parameters):
    past = navigation_at(memory, antenna[0])
    age = now - antenna[0]
    prior = x.copy()
    X = past[1] - (x[0] - age * x[3]) - parameters[STATION_N]
    Y = past[2] - (x[1] - age * x[4]) - parameters[STATION_E]
    Z = past[3] - x[2] - parameters[STATION_D]
    rho2 = X * X + Y * Y
    rho = math.sqrt(rho2)
    if rho < 50.0:
        return
    # rows by ϵ: the position is navigation less ϵ, so their signs are turned
    H = np.zeros(STATES)
    H[0], H[1] = Y / rho2, -X / rho2
    H[3], H[4] = -age * H[0], -age * H[1]
    H[9] = 1.0
    innovation = wrap_angle(antenna[4] - math.atan2(Y, X) - x[9])
    _fuse_gated(estimate, x, P, prior, H, innovation, parameters[R_ANTENNA], parameters)
    d2 = rho2 + Z * Z
    H = np.zeros(STATES)
    H[0], H[1], H[2] = -X * Z / (rho * d2), -Y * Z / (rho * d2), rho / d2
    H[3], H[4] = -age * H[0], -age * H[1]
    H[10] = 1.0
    innovation = antenna[5] - math.atan2(-Z, rho) - prior[10]
    _fuse_gated(estimate, x, P, prior, H, innovation, parameters[R_ANTENNA], parameters)


@njit(cache=True)
def _fuse_picture(estimate, memory, x, P, picture, now, parameters):
    taken = picture[0] - parameters[CAMERA_LATENCY]
    past = navigation_at(memory, taken)
    age = now - taken
    if picture[6] != memory[_CLICK]:
        if memory[_CLICK] > 0.0:  # the new error takes the place of the old one
            for i in range(2):
                P[7 + i, 7 + i] += 2.0 * parameters[CLICK] ** 2
        memory[_CLICK] = picture[6]
    if memory[_ACCEPTED] < 0.0:
        memory[_ACCEPTED] = now
    prior = x.copy()
    p = np.array([past[1] - (x[0] - age * x[3]), past[2] - (x[1] - age * x[4]), past[3] - x[2]])
    bearing, elevation, G = sight(
        p, past[4], past[5], past[6], parameters[CAMERA : CAMERA + 3], parameters[CAMERA + 3 :]
    )
    seen = angles_from_pixel(picture[4], picture[5], parameters[FOV_H : FOV_H + 4])
    d2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    many = parameters[PICTURE_CORRELATION]
    shift = many * parameters[CAMERA_SHIFT] ** 2 / d2
    # a roll error turns the picture about its centre
    R = (
        parameters[R_BEARING] + shift + many * (parameters[ROLL] * seen[1]) ** 2,
        parameters[R_ELEVATION] + shift + many * (parameters[ROLL] * seen[0]) ** 2,
    )
    rows = np.zeros((2, STATES))
    innovations = np.empty(2)
    for k in range(2):
        rows[k, :3] = G[k]
        rows[k, 3] = -age * G[k, 0]
        rows[k, 4] = -age * G[k, 1]
        rows[k, 7 + k] = 1.0
        # a heading bias turns the sight line about the vertical, also in a bank
        rows[k, 12] = p[1] * G[k, 0] - p[0] * G[k, 1]
    innovations[0] = wrap_angle(seen[0] - bearing - x[7] - rows[0, 12] * x[12])
    innovations[1] = seen[1] - elevation - x[8] - rows[1, 12] * x[12]
    lost = now - memory[_ACCEPTED] > parameters[PATIENCE]
    faulty = False
    for k in range(2):
        S = innovation_variance(P, rows[k], R[k])
        estimate[31 + 2 * k] = innovations[k]
        estimate[32 + 2 * k] = S
        excess = innovations[k] ** 2 - parameters[GATE] ** 2 * S
        if excess > 0.0:
            faulty = True
            if lost:  # perhaps it is the filter that is wrong
                P[0, 0] += excess * d2
                P[1, 1] += excess * d2
                P[7 + k, 7 + k] += excess
    if faulty and not lost:  # both angles come from the same match
        estimate[37] += 1.0
        return
    memory[_ACCEPTED] = now
    for k in range(2):
        fuse(x, P, prior, rows[k], innovations[k], R[k])


@njit(cache=True)
def _fuse_laser(estimate, memory, x, P, laser, now, parameters):
    past = navigation_at(memory, laser[0])
    distance = math.hypot(past[1] - x[0], past[2] - x[1])
    sigma = parameters[TERRAIN] * max(distance - parameters[FLAT_WITHIN], 0.0)
    R = (parameters[R_LASER] + sigma * sigma) * parameters[LASER_CORRELATION]
    H = np.zeros(STATES)
    H[2] = 1.0
    estimate[35] = laser[4] + past[3] - x[2]
    estimate[36] = innovation_variance(P, H, R)
    # the gate by a single sample: correlation is no excuse for an obstacle
    single = innovation_variance(P, H, parameters[R_LASER] + sigma * sigma)
    if estimate[35] ** 2 > parameters[GATE] ** 2 * single:
        estimate[37] += 1.0
        return
    fuse(x, P, x.copy(), H, estimate[35], R)


@njit(cache=True)
def _fuse_wheels(estimate, memory, x, P, inertial, wheels, yaw, parameters):
    prior = x.copy()
    H = np.zeros(STATES)
    H[3] = 1.0
    y = inertial[7] - wheels[4] * math.cos(yaw)
    fuse(x, P, prior, H, y - prior[3], parameters[R_WHEELS])
    H = np.zeros(STATES)
    H[4] = 1.0
    y = inertial[8] - wheels[4] * math.sin(yaw)
    fuse(x, P, prior, H, y - prior[4], parameters[R_WHEELS])
    H = np.zeros(STATES)
    H[2] = 1.0
    z = memory[_HISTORY + _ENTRY * int(memory[_HEAD]) + 3]
    fuse(x, P, prior, H, z + parameters[GEAR] - prior[2], 0.25)

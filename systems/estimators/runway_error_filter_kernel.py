"""The thesis's five-state error filter as a pure function of flat arrays.

    x = (ϵX, ϵY, ϵZ, ϵVN, ϵVE): what the inertial navigation says less what is (17)
    x_{k+1} = F x_k + v_k,  F = I + dt on (X, VN) and (Y, VE)                    (18)

Each phase has its own measurement (Leonard 2016, Eqs. 20 to 24):

| phase | y | h(x) |
|---|---|---|
| Standby | inertial navigation less fix | x |
| Return | direction from the aircraft to the ground station | (−X, −Y)/D |
| Final | bearing and elevation of the touch-down point | f of the direction −(X, Y, Z)/D |
| Final with laser | and the height | −Z |
| Short Final, Braking | none | |

with (X, Y, Z) the inertial navigation's position less x. In print (17) repeats
rows, and in (21) and (22) the factor 1/D stands before a minus sign.

A measurement counts when it arrives, whatever the time it speaks of, except
that the attitude used with a picture is the one at the picture's time stamp
(4.2).
"""

import math

import numpy as np
from numba import njit

from systems.estimators.runway_kalman import fuse, sight, write_covariance
from systems.runway_frames import angles_from_pixel
from systems.signals.runway_measurement import (
    ANTENNA_AT,
    BARO_AT,
    FIX_AT,
    LASER_AT,
    PHASE_AT,
    PICTURE_AT,
)

STATES = 5
HISTORY = 128  # attitudes kept, 1.28 s

# entries of the memory
_X = 0
_P = _X + STATES
_SEEN = _P + STATES * STATES  # arrivals of fix, antenna, picture, laser; validity of navigation
_PHASE = _SEEN + 5
_HEAD = _PHASE + 1
_HISTORY = _HEAD + 1  # (time, yaw, pitch, roll) of each attitude
MEMORY = _HISTORY + 4 * HISTORY

# entries of the parameters
(
    Q_POSITION,  # m2, q1 and q2 of one step
    Q_ALTITUDE,  # m2, q3
    Q_SPEED,  # (m/s)2, q4 and q5
    R_RETURN,  # 1, r of the direction's components
    R_FINAL,  # rad2
    R_LASER,  # m2
    RESET_SHARE,  # 0..1, of the altitude's innovation taken over when the laser is activated
    INCREASE,  # m2, added to the altitude's variance then
    STATION_N,  # m
    STATION_E,  # m
    FOV_H,  # rad
    FOV_V,  # rad
    IFOV_H,  # rad/px
    IFOV_V,  # rad/px
) = range(14)
CAMERA = 14  # position (3, m) and mounting (3, rad) of the camera as known on board
PARAMETERS = 20


def initial_memory() -> np.ndarray:
    """Nothing seen, no attitude kept, shape (MEMORY,)."""
    memory = np.zeros(MEMORY)
    memory[_SEEN:_HEAD] = -1.0
    memory[_HISTORY:] = -1.0
    return memory


@njit(cache=True)
def attitude_at(memory, time):
    """The kept attitude nearest to a time (s): yaw, pitch, roll (rad)."""
    best = int(memory[_HEAD])
    gap = 1e9
    for i in range(HISTORY):
        entry = _HISTORY + 4 * i
        if memory[entry] >= 0.0:
            g = abs(memory[entry] - time)
            if g < gap:
                gap = g
                best = i
    entry = _HISTORY + 4 * best
    return memory[entry + 1], memory[entry + 2], memory[entry + 3]


@njit(cache=True)
def step(estimate, memory, measurements, parameters):
    """One step of the filter, in place.

    Parameters
    ----------
    estimate : array
        Layout `NAVIGATION_ESTIMATE`.
    memory : array, shape (MEMORY,)
        State, covariance, what was seen, attitudes.
    measurements : array
        Layout `MEASUREMENTS`.
    parameters : array, shape (PARAMETERS,)
    """
    inertial, baro = measurements[:BARO_AT], measurements[BARO_AT:FIX_AT]
    fix, antenna = measurements[FIX_AT:ANTENNA_AT], measurements[ANTENNA_AT:PICTURE_AT]
    picture, laser = measurements[PICTURE_AT:LASER_AT], measurements[LASER_AT:PHASE_AT]
    phase = measurements[PHASE_AT]
    if inertial[3] == 0.0 or baro[3] == 0.0:
        return
    x = memory[_X:_P]
    P = memory[_P:_SEEN].reshape(STATES, STATES)
    head = (int(memory[_HEAD]) + 1) % HISTORY
    memory[_HEAD] = head
    memory[_HISTORY + 4 * head : _HISTORY + 4 * head + 4] = inertial[10:14]

    z_imu = -baro[4]
    if estimate[1] > 0.0 and inertial[0] > memory[_SEEN + 4]:
        _propagate(x, P, inertial[0] - memory[_SEEN + 4], parameters)
    memory[_SEEN + 4] = inertial[0]

    if phase == 0.0 and fix[3] > 0.0 and fix[1] > memory[_SEEN]:
        memory[_SEEN] = fix[1]
        _standby(estimate, x, P, inertial, z_imu, fix)
    if estimate[1] == 0.0:
        return

    if phase == 1.0:
        if antenna[3] > 0.0 and antenna[1] > memory[_SEEN + 1]:
            _return(x, P, inertial, antenna, parameters)
        memory[_SEEN + 1] = antenna[1]

    final = phase == 2.0 or phase == 3.0
    with_laser = phase == 3.0 and laser[3] > 0.0 and laser[1] > memory[_SEEN + 3]
    with_picture = final and picture[3] > 0.0 and picture[1] > memory[_SEEN + 2]
    if phase == 3.0 and memory[_PHASE] != 3.0 and laser[3] > 0.0:
        innovation = laser[4] + z_imu - x[2]
        x[2] += parameters[RESET_SHARE] * innovation
        P[2, 2] += parameters[INCREASE]
        with_laser = True
    if with_picture or with_laser:
        _final(
            estimate, memory, x, P, inertial, z_imu, picture, laser, with_picture, with_laser,
            parameters,
        )  # fmt: skip
    if final:
        memory[_SEEN + 2] = picture[1]
    if phase == 3.0:
        memory[_SEEN + 3] = laser[1]
    memory[_PHASE] = phase

    estimate[0] = inertial[0]
    estimate[2] = inertial[4] - x[0]
    estimate[3] = inertial[5] - x[1]
    estimate[4] = z_imu - x[2]
    estimate[5] = inertial[7] - x[3]
    estimate[6] = inertial[8] - x[4]
    estimate[7] = inertial[9]
    estimate[8:11] = inertial[11:14]
    estimate[11:16] = x
    write_covariance(P, estimate, 16)


@njit(cache=True)
def _propagate(x, P, dt, parameters):
    for i in range(2):
        x[i] += dt * x[3 + i]
    for i in range(2):  # F P
        for j in range(STATES):
            P[i, j] += dt * P[3 + i, j]
    for i in range(STATES):  # (F P) Fᵀ
        for j in range(2):
            P[i, j] += dt * P[i, 3 + j]
    P[0, 0] += parameters[Q_POSITION]
    P[1, 1] += parameters[Q_POSITION]
    P[2, 2] += parameters[Q_ALTITUDE]
    P[3, 3] += parameters[Q_SPEED]
    P[4, 4] += parameters[Q_SPEED]


@njit(cache=True)
def _standby(estimate, x, P, inertial, z_imu, fix):
    y = np.array(
        [
            inertial[4] - fix[4],
            inertial[5] - fix[5],
            z_imu - fix[6],
            inertial[7] - fix[7],
            inertial[8] - fix[8],
        ]
    )
    R = np.array([fix[9] ** 2, fix[9] ** 2, fix[10] ** 2, fix[11] ** 2, fix[11] ** 2])
    if estimate[1] == 0.0:
        estimate[1] = 1.0
        x[:] = y
        P[:] = np.diag(R)
        return
    prior = x.copy()
    for i in range(STATES):
        H = np.zeros(STATES)
        H[i] = 1.0
        fuse(x, P, prior, H, y[i] - prior[i], R[i])


@njit(cache=True)
def _return(x, P, inertial, antenna, parameters):
    X = inertial[4] - x[0] - parameters[STATION_N]
    Y = inertial[5] - x[1] - parameters[STATION_E]
    D = math.sqrt(X * X + Y * Y)
    prior = x.copy()
    # from the aircraft to the station: opposite to the azimuth that the station measures
    y = (-math.cos(antenna[4]), -math.sin(antenna[4]))
    D3 = D * D * D
    H = np.zeros(STATES)
    H[0] = Y * Y / D3
    H[1] = -X * Y / D3
    fuse(x, P, prior, H, y[0] + X / D, parameters[R_RETURN])
    H[0] = -X * Y / D3
    H[1] = X * X / D3
    fuse(x, P, prior, H, y[1] + Y / D, parameters[R_RETURN])


@njit(cache=True)
def _final(
    estimate, memory, x, P, inertial, z_imu, picture, laser, with_picture, with_laser, parameters
):
    prior = x.copy()
    if with_picture:
        yaw, pitch, roll = attitude_at(memory, picture[0])
        p = np.array([inertial[4] - x[0], inertial[5] - x[1], z_imu - x[2]])
        bearing, elevation, G = sight(
            p, yaw, pitch, roll, parameters[CAMERA : CAMERA + 3], parameters[CAMERA + 3 :]
        )
        seen_bearing, seen_elevation = angles_from_pixel(
            picture[4], picture[5], parameters[FOV_H : FOV_H + 4]
        )
        H = np.zeros(STATES)
        H[:3] = G[0]
        estimate[31] = seen_bearing - bearing
        estimate[32] = fuse(x, P, prior, H, estimate[31], parameters[R_FINAL])
        H[:3] = G[1]
        estimate[33] = seen_elevation - elevation
        estimate[34] = fuse(x, P, prior, H, estimate[33], parameters[R_FINAL])
    if with_laser:
        H = np.zeros(STATES)
        H[2] = 1.0  # height = −Z = −z_imu + ϵZ
        estimate[35] = laser[4] + z_imu - prior[2]
        estimate[36] = fuse(x, P, prior, H, estimate[35], parameters[R_LASER])

"""The judge's rules, compiled: what `plants.touchdown.TouchdownObserver` does every 40 ms."""

import math

from numba import njit

RUNNING = 0
LANDED = 1
TILTED = 2
HIT_HARD = 3
STOPPED_IN_THE_AIR = 4
TIME_LIMIT_FLYING = 5
TIME_LIMIT_NOT_AT_REST = 6
NEVER_TOOK_OFF = 7
LEFT_THE_ARENA = 8

# The judge's memory.
(
    AIRBORNE,  # 0/1, has been up since the start or the last touchdown
    FLOWN,  # 0/1, has been up at all
    RESTED,  # s, at rest so far
    LAST_VERTICAL,  # m/s, downwards relative to the pad at the last look
    VERTICAL,  # m/s, the same where it would touch before the next look
    HORIZONTAL,  # m/s, relative to the pad at the last look in the air
) = range(6)
MEMORY_SIZE = 6

# The parameter vector.
(
    REFERENCE_X,  # m, the reference point in B
    REFERENCE_Y,
    REFERENCE_Z,
    TIME_LIMIT,  # s
    TILT_LIMIT,  # rad
    SPEED_LIMIT,  # m/s, downwards at contact
    ARENA_RADIUS,  # m
    ARENA_HEIGHT,  # m
    AIRBORNE_HEIGHT,  # m, of the lowest foot
    STOPPED_SPEED,  # rad/s
    REST_SPEED,  # m/s, and rad/s
    REST_TIME,  # s
    FEET_Z,  # m, height of the feet in B
    PERIOD,  # s, between looks
) = range(14)
PARAMETERS = 14

# The verdict, in the order of the layout TOUCHDOWN.
_LANDED, _REASON, _TIME, _OFFSET_X, _OFFSET_Y, _VERTICAL, _HORIZONTAL, _TILT = range(8)


@njit(cache=True)
def judge(verdict, memory, body, pad, fastest_rotor, disarmed, time, parameters):
    """Look once: updates `verdict` (TOUCHDOWN) and `memory` (6,) in place.

    Parameters
    ----------
    body, pad : array
        `BODY_STATE` and `PAD_STATE`.
    fastest_rotor : float
        rad/s, the speed of the fastest rotor.
    disarmed : bool
        Whether the vehicle says that it has stopped its rotors.
    time : float
        Now, s.
    parameters : array
        From `TouchdownConfig.parameters`.
    """
    p = parameters
    if verdict[_REASON] != RUNNING:
        return
    qw, qx, qy, qz = body[0], body[1], body[2], body[3]
    r20 = 2.0 * (qx * qz - qw * qy)
    r21 = 2.0 * (qy * qz + qw * qx)
    r22 = 1.0 - 2.0 * (qx * qx + qy * qy)
    tilt = math.acos(min(1.0, max(-1.0, r22)))
    contact = body[16] > 0.0

    # The pad's motion where the vehicle is; beside the pad it is the ground's.
    dx, dy = body[4] - pad[0], body[5] - pad[1]
    half = 0.5 * pad[8]
    over_pad = dx * dx + dy * dy <= 2.0 * half * half
    surface = pad[2] if over_pad else 0.0
    vx, vy, vz = body[7], body[8], body[9]
    spin_x = spin_y = spin_z = 0.0
    if over_pad:
        vx -= pad[4] - pad[7] * dy
        vy -= pad[5] + pad[7] * dx
        vz -= pad[6]
        spin_x, spin_y, spin_z = r20 * pad[7], r21 * pad[7], r22 * pad[7]
    horizontal = math.hypot(vx, vy)
    stopped = fastest_rotor < p[STOPPED_SPEED]

    height = body[6] + p[FEET_Z] - surface  # of the feet
    if not contact and height > p[AIRBORNE_HEIGHT]:
        memory[AIRBORNE] = memory[FLOWN] = 1.0
        verdict[_TIME] = -1.0  # it has gone up again: only the last touchdown counts
        if disarmed and stopped:
            verdict[_REASON] = STOPPED_IN_THE_AIR
    elif contact and memory[AIRBORNE] == 1.0:
        memory[AIRBORNE] = 0.0
        verdict[_TIME] = time
        verdict[_VERTICAL] = memory[VERTICAL]
        verdict[_HORIZONTAL] = memory[HORIZONTAL]
        verdict[_TILT] = tilt
        if memory[VERTICAL] > p[SPEED_LIMIT]:
            verdict[_REASON] = HIT_HARD
    if not contact:
        # Until it touches, or until the next look, the speed goes on changing as it did.
        share = min(max(height, 0.0) / max(-vz * p[PERIOD], 1e-9), 1.0)
        memory[VERTICAL] = -vz + share * (-vz - memory[LAST_VERTICAL])
        memory[HORIZONTAL] = horizontal
    memory[LAST_VERTICAL] = -vz

    wx, wy, wz = body[10] - spin_x, body[11] - spin_y, body[12] - spin_z
    moving = max(horizontal, abs(vz), math.sqrt(wx * wx + wy * wy + wz * wz))
    if contact and stopped and moving < p[REST_SPEED]:
        memory[RESTED] += p[PERIOD]
    else:
        memory[RESTED] = 0.0

    if verdict[_REASON] == RUNNING:
        if contact and tilt > p[TILT_LIMIT]:
            verdict[_REASON] = TILTED
            if verdict[_TIME] < 0.0:
                verdict[_TIME] = time
        elif memory[FLOWN] == 1.0 and memory[RESTED] >= p[REST_TIME] - 0.5 * p[PERIOD]:
            verdict[_REASON] = LANDED
            verdict[_LANDED] = 1.0
        elif math.hypot(dx, dy) > p[ARENA_RADIUS] or body[6] > p[ARENA_HEIGHT]:
            verdict[_REASON] = LEFT_THE_ARENA
        elif time >= p[TIME_LIMIT]:
            if memory[FLOWN] == 0.0:
                verdict[_REASON] = NEVER_TOOK_OFF
            elif verdict[_TIME] < 0.0:
                verdict[_REASON] = TIME_LIMIT_FLYING
            else:
                verdict[_REASON] = TIME_LIMIT_NOT_AT_REST

    # Where the reference point is, relative to the pad: from the touchdown on, to the end.
    if verdict[_TIME] >= 0.0 or verdict[_REASON] != RUNNING:
        rx, ry, rz = p[REFERENCE_X], p[REFERENCE_Y], p[REFERENCE_Z]
        verdict[_OFFSET_X] = (
            dx
            + (1.0 - 2.0 * (qy * qy + qz * qz)) * rx
            + 2.0 * (qx * qy - qw * qz) * ry
            + 2.0 * (qx * qz + qw * qy) * rz
        )
        verdict[_OFFSET_Y] = (
            dy
            + 2.0 * (qx * qy + qw * qz) * rx
            + (1.0 - 2.0 * (qx * qx + qz * qz)) * ry
            + 2.0 * (qy * qz - qw * qx) * rz
        )

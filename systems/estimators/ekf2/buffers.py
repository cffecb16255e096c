"""The rings between the sensors and the delayed horizon, and the IMU down-sampler.

Every IMU sample goes into the down-sampler; a completed one enters the IMU ring,
whose oldest entry is the filter's "now": the delayed horizon. An observation
waits in the ring of its sensor until the horizon has passed its time.

Sums of time steps are kept in single precision, as in PX4: whole-microsecond stamps
and ties (250 Hz into steps of 10 ms are two samples and a half) hang on their last bit.
"""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.geometry import (
    from_rotation_vector,
    limit,
    multiply,
    normalised,
    to_rotation_vector,
)

_POP_WINDOW = 100_000  # us, an older observation is not fused any more


@kernel
def push(x, ring, time):
    """Make room for a new entry of a ring, stamped `time` (us).

    Returns
    -------
    int
        The index in `x` of the entry's time; the caller writes the fields behind it.
    """
    entries = int(x[ring + at.RING_ENTRIES])
    head, tail = int(x[ring + at.RING_HEAD]), int(x[ring + at.RING_TAIL])
    empty = x[ring + at.RING_EMPTY] != 0.0
    if not empty:
        head = head + 1 if head + 1 < entries else 0
    x[ring + at.RING_HEAD] = head
    if head == tail and not empty:
        x[ring + at.RING_TAIL] = tail + 1 if tail + 1 < entries else 0
    x[ring + at.RING_EMPTY] = 0.0
    entry = int(x[ring + at.RING_DATA]) + head * int(x[ring + at.RING_WIDTH])
    x[entry] = time
    return entry


@kernel
def newest(x, ring):
    """The index of the newest entry; its time is 0 once it was popped."""
    return int(x[ring + at.RING_DATA] + x[ring + at.RING_HEAD] * x[ring + at.RING_WIDTH])


@kernel
def oldest(x, ring):
    """The index of the oldest entry."""
    return int(x[ring + at.RING_DATA] + x[ring + at.RING_TAIL] * x[ring + at.RING_WIDTH])


@kernel
def pop(x, ring, horizon):
    """Take the newest entry that the horizon (us) has passed by less than 100 ms.

    It and everything older leave the ring.

    Returns
    -------
    int
        The index of the entry, whose fields stay readable until the next `push`
        and whose time is now at `RING_POPPED_TIME`; −1 if there is none.
    """
    if not x[ring + at.RING_IN_USE]:
        return -1
    entries, width = int(x[ring + at.RING_ENTRIES]), int(x[ring + at.RING_WIDTH])
    data, head = int(x[ring + at.RING_DATA]), int(x[ring + at.RING_HEAD])
    tail = int(x[ring + at.RING_TAIL])
    index = head
    for _ in range(entries):
        entry = data + index * width
        time = x[entry]
        if time <= horizon < time + _POP_WINDOW:
            if index == head:
                x[ring + at.RING_TAIL] = head
                x[ring + at.RING_EMPTY] = 1.0
            else:
                x[ring + at.RING_TAIL] = index + 1 if index + 1 < entries else 0
            x[entry] = 0.0
            x[ring + at.RING_POPPED_TIME] = time
            return entry
        if index == tail:
            return -1
        index = index - 1 if index > 0 else entries - 1
    return -1


@kernel
def half_step(x):
    """Half a mean filter step in whole microseconds, cut off in single precision as in PX4."""
    return math.floor(np.float32(x[at.DT_AVERAGE]) * np.float32(5e5))


@kernel
def push_observation(x, ring, time, delay_ms):
    """Make room for an observation stamped `time` (us) that is `delay_ms` behind the IMU.

    Half a filter step is taken off besides: the horizon stands for the middle of
    its step.

    Returns
    -------
    int
        As `push`; −1 if the observation is dropped because it comes too soon
        after the last one, or before the first IMU sample.
    """
    if not x[at.INITIALISED]:
        return -1
    x[ring + at.RING_IN_USE] = 1.0
    stamp = time - math.floor(delay_ms * 1000.0) - half_step(x)
    if stamp < x[newest(x, ring)] + x[at.MINIMUM_INTERVAL]:
        return -1
    x[ring + at.RING_PUSH_TIME] = x[at.TIME_LATEST]
    return push(x, ring, stamp)


@kernel
def arriving(x, ring, interval):
    """Whether the ring got a sample within the last `interval` (us) of real time."""
    time = x[ring + at.RING_PUSH_TIME]
    return time != 0.0 and time + interval > x[at.TIME_LATEST]


@kernel
def reset_down_sampler(x, p):
    """Start a new accumulation; the number of samples follows from their mean period."""
    x[at.DS_DELTA_ANGLE] = 1.0
    x[at.DS_DELTA_ANGLE + 1 : at.DS_COUNT + 1] = 0.0
    average = np.float32(x[at.DS_AVERAGE_DT])
    target = np.float32(limit(p[prm.EKF2_PREDICT_US], 1e3, 1e5)) * np.float32(1e-6)
    required = np.float32(max(math.floor(target / average + 0.5), 1.0))
    x[at.DS_REQUIRED] = required
    x[at.DS_TARGET_DT] = required * average
    x[at.DS_MINIMUM_DT] = max(average * (required - np.float32(1.0)), np.float32(0.5) * average)


@kernel
def down_sample(x, imu):
    """Add an IMU sample; true if the accumulation is complete.

    The delta angles are composed as rotations. The delta velocity so far is turned
    into the newest body frame, and the new one counts as the mean of itself
    before and after the rotation of its own sample.

    Parameters
    ----------
    imu : np.ndarray
        Time (us), delta angle 3 (rad), delta velocity 3 (m/s), the two time
        steps (s), clipping 3, all FRD, shape (12,).
    """
    angle_dt = np.float32(imu[7])
    x[at.DS_AVERAGE_DT] = (
        np.float32(0.9) * np.float32(x[at.DS_AVERAGE_DT]) + np.float32(0.1) * angle_dt
    )
    x[at.DS_ANGLE_DT] = np.float32(x[at.DS_ANGLE_DT]) + angle_dt
    x[at.DS_VELOCITY_DT] = np.float32(x[at.DS_VELOCITY_DT]) + np.float32(imu[8])
    for i in range(3):
        if imu[9 + i]:
            x[at.DS_CLIPPING + i] = 1.0
    q = at.DS_DELTA_ANGLE
    d0, d1, d2, d3 = from_rotation_vector(imu[1], imu[2], imu[3])
    a0, a1, a2, a3 = multiply(x[q], x[q + 1], x[q + 2], x[q + 3], d0, d1, d2, d3)
    x[q], x[q + 1], x[q + 2], x[q + 3] = normalised(a0, a1, a2, a3)

    v = at.DS_DELTA_VELOCITY
    ux, uy, uz = x[v] + 0.5 * imu[4], x[v + 1] + 0.5 * imu[5], x[v + 2] + 0.5 * imu[6]
    # Rᵀ(d) u = u − 2 d₀ (d × u) + 2 d × (d × u)
    cx, cy, cz = d2 * uz - d3 * uy, d3 * ux - d1 * uz, d1 * uy - d2 * ux
    x[v] = ux - 2.0 * d0 * cx + 2.0 * (d2 * cz - d3 * cy) + 0.5 * imu[4]
    x[v + 1] = uy - 2.0 * d0 * cy + 2.0 * (d3 * cx - d1 * cz) + 0.5 * imu[5]
    x[v + 2] = uz - 2.0 * d0 * cz + 2.0 * (d1 * cy - d2 * cx) + 0.5 * imu[6]
    x[at.DS_COUNT] += 1.0

    dt = x[at.DS_ANGLE_DT]
    enough = x[at.DS_COUNT] >= x[at.DS_REQUIRED] and dt > x[at.DS_MINIMUM_DT]
    return enough or dt > x[at.DS_TARGET_DT]


@kernel
def push_down_sampled(x, p, time):
    """Move the completed sample into the IMU ring and the horizon forward."""
    shortest = 0.5e-6 * p[prm.EKF2_PREDICT_US]
    q = at.DS_DELTA_ANGLE
    entry = push(x, at.RING_IMU, time)
    rx, ry, rz = to_rotation_vector(x[q], x[q + 1], x[q + 2], x[q + 3])
    x[entry + 1], x[entry + 2], x[entry + 3] = rx, ry, rz
    for i in range(3):
        x[entry + 4 + i] = x[at.DS_DELTA_VELOCITY + i]
        x[entry + 9 + i] = x[at.DS_CLIPPING + i]
    x[entry + 7] = limit(x[at.DS_ANGLE_DT], shortest, 4.0 * shortest)
    x[entry + 8] = limit(x[at.DS_VELOCITY_DT], shortest, 4.0 * shortest)
    reset_down_sampler(x, p)

    x[at.IMU_UPDATED] = 1.0
    x[at.TIME_DELAYED] = x[oldest(x, at.RING_IMU)]
    horizon = x[at.TIME_LATEST] - x[at.TIME_DELAYED]
    x[at.MINIMUM_INTERVAL] = math.floor(horizon / (x[at.RING_LENGTH] - 1.0))

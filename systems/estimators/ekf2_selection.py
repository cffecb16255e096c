"""Which of several EKF2 instances to believe: the decision, without Drake.

Facts: PX4's `EKF2Selector`, `Ekf::get…InnovationTestRatio` and `VotedSensorsUpdate` (main branch of
August 2026). Per instance:

    ρ ← ρ + dt/(dt + 0.5 s) (sign(ν) ν²/(gate² S) − ρ)     every observation, every axis
    velocity, position = √ max |ρ| of the sources in use,  height = mean √|ρ| of those in use
    combined = max(½ (velocity + position), height)        1 where there is no source

Relative error of the others against the selected one, every filter step:

    Δ = combined − combined of the selected one
    e ← clip(e + Δ, −1, 1)   where Δ > 0 or Δ < −EKF2_SEL_ERR_RED

And the inertial sensors against each other, d their low-passed difference from the mean:

    E ← max(0, E + (|d| − threshold) dt)

The one with the largest E beyond its limit is faulty if there are three; of two nobody knows.

One difference: an instance is not taken again for 10 s after it was left. PX4 means the same, but
counts from when the instance was chosen.
"""

import math

import numpy as np
from numba import njit

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.messages import INNOVATIONS, STATUS
from systems.signals.measurement import INERTIAL

FILTER_STEP = 0.01  # s, EKF2_PREDICT_US: so often PX4 adds to the relative error
SCORE_LIMIT, SCORE_TO_CHANGE = 1.0, 0.5
LEAST_REDUCTION = 0.05  # of EKF2_SEL_ERR_RED
RECOVERY = 1.0  # s without a fault until an instance is healthy again
WARNED = 1.0  # s at a combined ratio of 1 or more until it may be left early
TIMEOUT = 0.05  # s without a new state
TEST_RATIO_TAU = 0.5  # s, low-pass filter of the test ratios
TEST_RATIO_LIMIT = 4.0  # of what is filtered
INCONSISTENCY_TAU = 0.0975  # s; 0.95 of the old value a sample, 200 samples a second
NOBODY, UNKNOWN = -1, -2  # faulty inertial sensor

# Sources, by kind; the flag of their use has the same name but for GNSS height.
_VELOCITY, _POSITION, _HEIGHT = range(3)
_SOURCES = {
    "gnss_vel": _VELOCITY,
    "ev_vel": _VELOCITY,
    "gnss_pos": _POSITION,
    "ev_pos": _POSITION,
    "gnss_hgt": _HEIGHT,
    "baro_hgt": _HEIGHT,
    "rng_hgt": _HEIGHT,
    "ev_hgt": _HEIGHT,
}
_KIND = np.array(list(_SOURCES.values()))
_FIRST = np.array([INNOVATIONS.index(f"{source}_time") for source in _SOURCES])
_AXES = np.array([at.AID_AXES[at.AID_NAMES.index(source)] for source in _SOURCES])
_FLAGS = {"gnss_hgt": "gps_hgt"}
_IN_USE = np.array([STATUS.index(_FLAGS.get(source, source)) for source in _SOURCES])
_FAULT = STATUS.index(at.FAULT_NAMES[0])
_FAULTS = at.FAULT_COUNT
_STAMP = STATUS.index("time_of_validity")
_DELTA_ANGLE = INERTIAL.index("delta_angle_x")
_DELTA_VELOCITY = INERTIAL.index("delta_velocity_x")
_DELTA_ANGLE_DT = INERTIAL.index("delta_angle_dt")
_DELTA_VELOCITY_DT = INERTIAL.index("delta_velocity_dt")

# The memory of the decision, then a row for each instance.
SELECTED, CHANGED, GYRO_FAULT, ACCELEROMETER_FAULT, INSTANCES = range(5)
(
    COMBINED,  # test ratio
    RELATIVE,  # error against the selected one
    HEALTHY,  # 0/1
    FAULTLESS_SINCE,  # s; infinite while there is a fault
    LAST_SELECTED,  # s, when it was believed
    LAST_CALM,  # s, when its combined ratio was below 1
    LAST_STAMP,  # s, of its newest state
    LAST_HEARD,  # s, when that was new
    GYRO_ERROR,  # rad, accumulated
    ACCELEROMETER_ERROR,  # m/s, accumulated
    GYRO_DIFFERENCE,  # rad/s, three axes, from the mean of all
) = range(11)
ACCELEROMETER_DIFFERENCE = GYRO_DIFFERENCE + 3  # m/s2, three axes
_TIMES = ACCELEROMETER_DIFFERENCE + 3  # s, of the sources' newest observation
_RATIOS = _TIMES + len(_SOURCES)  # filtered, of each axis
ROW = _RATIOS + int(_AXES.sum())


def initial_memory(instances: int) -> np.ndarray:
    """The memory before the first look: instance 0 is selected, none is healthy yet."""
    memory = np.zeros(INSTANCES + ROW * instances)
    memory[GYRO_FAULT] = memory[ACCELEROMETER_FAULT] = NOBODY
    rows = memory[INSTANCES:].reshape(instances, ROW)
    rows[:, FAULTLESS_SINCE] = math.inf
    rows[:, LAST_STAMP] = -1.0
    rows[:, COMBINED] = 1.0
    return memory


@njit(cache=True)
def filter_test_ratios(row, innovations):
    """Low-pass the signed test ratios of the observations that are new."""
    to = _RATIOS
    for source in range(_FIRST.size):
        first = _FIRST[source]
        time, last = innovations[first], row[_TIMES + source]
        dt = min(max(time - last, 0.001), 1.0)
        gain = dt / (dt + TEST_RATIO_TAU) if last > 0.0 else 1.0
        for axis in range(_AXES[source]):
            entry = first + 3 + 3 * axis
            if time > last:
                ratio = math.copysign(innovations[entry + 2], innovations[entry])
                ratio = row[to] + gain * (ratio - row[to])
                if not math.isfinite(ratio):
                    ratio = 0.0
                row[to] = min(max(ratio, -TEST_RATIO_LIMIT), TEST_RATIO_LIMIT)
            to += 1
        row[_TIMES + source] = max(time, last)


@njit(cache=True)
def combined_test_ratio(row, status):
    """The error of an instance, from the filtered ratios of the sources that it uses."""
    worst = np.full(2, np.nan)
    heights, count = 0.0, 0
    to = _RATIOS
    for source in range(_FIRST.size):
        largest = 0.0
        for _ in range(_AXES[source]):
            largest = max(largest, abs(row[to]))
            to += 1
        if status[_IN_USE[source]] == 0.0:
            continue
        if _KIND[source] == _HEIGHT:
            heights += math.sqrt(largest)
            count += 1
        else:
            known = worst[_KIND[source]]
            worst[_KIND[source]] = math.sqrt(largest) if math.isnan(known) else max(
                known, math.sqrt(largest)
            )  # fmt: skip
    velocity, position = worst[_VELOCITY], worst[_POSITION]
    height = heights / count if count > 0 else 1.0
    # Nothing has been observed where there is no source or its ratio is exactly zero.
    velocity = velocity if velocity > 0.0 else 1.0
    position = position if position > 0.0 else 1.0
    height = height if height > 0.0 else 1.0
    return max(0.5 * (velocity + position), height)


@njit(cache=True)
def compare_sensors(rows, imus, first, first_dt, difference, error, threshold, limit, dt):
    """Accumulate the differences of one kind of sensor from the mean; the faulty one, or a code.

    Parameters
    ----------
    rows : array of shape (n, ROW)
        Changed in place.
    imus : array of shape (n, 13)
        `INERTIAL`; NaN for a sensor that is not connected.
    first, first_dt : int
        Where the increments and the time that they cover stand in `INERTIAL`.
    difference, error : int
        Where the low-passed difference and the accumulated error stand in a row.
    threshold, limit : float
        rad/s or m/s2 that count, and rad or m/s that are too much.
    dt : float
        s, since the last comparison.
    """
    mean, sensors = np.zeros(3), 0
    for i in range(imus.shape[0]):
        if imus[i, first_dt] > 0.0:
            sensors += 1
            for axis in range(3):
                mean[axis] += imus[i, first + axis] / imus[i, first_dt]
    if sensors < 2:
        return NOBODY
    mean /= sensors
    gain = 1.0 - math.exp(-dt / INCONSISTENCY_TAU)
    worst, largest, faulty = NOBODY, 0.0, False
    for i in range(imus.shape[0]):
        if not imus[i, first_dt] > 0.0:
            continue
        square = 0.0
        for axis in range(3):
            d = imus[i, first + axis] / imus[i, first_dt] - mean[axis]
            rows[i, difference + axis] += gain * (d - rows[i, difference + axis])
            square += rows[i, difference + axis] ** 2
        rows[i, error] = max(0.0, rows[i, error] + (math.sqrt(square) - threshold) * dt)
        faulty = faulty or rows[i, error] > limit
        if rows[i, error] > largest:
            worst, largest = i, rows[i, error]
    if not faulty:
        return NOBODY
    return worst if sensors >= 3 else UNKNOWN


@njit(cache=True)
def choose(memory, now, dt, innovations, status, aligned, imus, limits):
    """Look at all instances and return the one to believe from now on.

    Parameters
    ----------
    memory : array of shape (INSTANCES + n * ROW,)
        See `initial_memory`; changed in place.
    now, dt : float
        s, and since the last look.
    innovations, status : arrays of shape (n, ...)
        `INNOVATIONS` and `STATUS` of the instances.
    aligned : array of shape (n,)
        Whether their attitude is valid.
    imus : array of shape (n, 13)
        `INERTIAL` of theirs; NaN where unknown.
    limits : array of shape (6,)
        EKF2_SEL_ERR_RED, change interval (s), then rad/s, rad, m/s2, m/s of `compare_sensors`.

    Returns
    -------
    int
        The selected instance, which `memory` has already.
    """
    n = aligned.size
    rows = memory[INSTANCES:].reshape(n, ROW)
    gyro = compare_sensors(
        rows, imus, _DELTA_ANGLE, _DELTA_ANGLE_DT, GYRO_DIFFERENCE, GYRO_ERROR,
        limits[2], limits[3], dt,
    )  # fmt: skip
    accelerometer = compare_sensors(
        rows, imus, _DELTA_VELOCITY, _DELTA_VELOCITY_DT, ACCELEROMETER_DIFFERENCE,
        ACCELEROMETER_ERROR, limits[4], limits[5], dt,
    )  # fmt: skip
    memory[GYRO_FAULT], memory[ACCELEROMETER_FAULT] = gyro, accelerometer
    for i in range(n):
        row = rows[i]
        filter_test_ratios(row, innovations[i])
        row[COMBINED] = combined_test_ratio(row, status[i])
        if row[COMBINED] < 1.0:
            row[LAST_CALM] = now
        if status[i, _STAMP] > row[LAST_STAMP]:
            row[LAST_STAMP], row[LAST_HEARD] = status[i, _STAMP], now
        faulty = i in (gyro, accelerometer) or now - row[LAST_HEARD] > max(TIMEOUT, 1.5 * dt)
        faulty = faulty or not aligned[i] or np.any(status[i, _FAULT : _FAULT + _FAULTS] != 0.0)
        if faulty:
            row[FAULTLESS_SINCE] = math.inf
        elif row[FAULTLESS_SINCE] == math.inf:
            row[FAULTLESS_SINCE] = now
        # Left at once, trusted again after a while.
        row[HEALTHY] = now - row[FAULTLESS_SINCE] >= RECOVERY - 1e-9
    selected = int(memory[SELECTED])
    rows[selected, LAST_SELECTED] = now
    # When a gyro is faulty, every advantage counts.
    reduction = 0.0 if gyro != NOBODY else max(limits[0], LEAST_REDUCTION)
    for i in range(n):
        advantage = rows[i, COMBINED] - rows[selected, COMBINED]
        if i != selected and (advantage > 0.0 or advantage < -reduction):
            relative = rows[i, RELATIVE] + advantage * dt / FILTER_STEP
            rows[i, RELATIVE] = min(max(relative, -SCORE_LIMIT), SCORE_LIMIT)
    best = alternative = selected
    least, lowest = math.inf, -SCORE_TO_CHANGE
    for i in range(n):
        if i == selected or rows[i, HEALTHY] == 0.0:
            continue
        if rows[i, COMBINED] < least:
            best, least = i, rows[i, COMBINED]
        level = rows[i, RELATIVE] == lowest and rows[i, COMBINED] < rows[alternative, COMBINED]
        rested = now - rows[i, LAST_SELECTED] > limits[1]
        if rested and (rows[i, RELATIVE] < lowest or level):
            alternative, lowest = i, rows[i, RELATIVE]
    warned = rows[selected, COMBINED] >= 1.0 and now - rows[selected, LAST_CALM] > WARNED
    chosen = selected
    if rows[selected, HEALTHY] == 0.0:
        chosen = best
    elif warned or now - memory[CHANGED] > limits[1]:
        chosen = alternative
    if chosen != selected:
        memory[SELECTED], memory[CHANGED] = chosen, now
        rows[:, RELATIVE] = 0.0
    return chosen

"""The fused sensor's fusion logic, compiled: four cases, freshness, levelling with the attitude."""

import math

import numpy as np
from numba import njit

from systems.signals.measurement import (
    RANGE_FINDER,
    SEQUENCE_NUMBER,
    TARGET_MEASUREMENT,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    VALID,
    VEHICLE_ESTIMATE,
    Layout,
)
from systems.vision.infrared_blobs import pad_position_from_infrared
from systems.vision.planar_pose import pad_position_from_marker

INFRARED_SOURCE, MARKER_SOURCE = 1, 2  # bits of TARGET_MEASUREMENT's source

PARAMETERS = Layout(
    "FusedSensorParameters",
    (
        "sources",  # bits of the sensors that are listened to
        "infrared_weight",  # of the pair; the marker has the rest
        "freshness",  # s
        "attitude_steps",  # polls by which the attitude is delayed
        "infrared_angle_noise",  # rad
        "height_noise",  # m
        "range_timeout",  # s
        "range_finder_x",  # m, place of the range finder in B
        "range_finder_y",
        "range_finder_z",
    ),
)
ATTITUDES = 17  # polls that are remembered: 0.32 s and now
MEMORY = Layout(
    "FusedSensorMemory",
    (
        "infrared_arrival",  # s, of the newest measurement taken
        "marker_arrival",
        "polls",  # so far
        *(f"attitude_{i}_{component}" for i in range(ATTITUDES) for component in "wxyz"),
    ),
)

(_SOURCES, _WEIGHT, _FRESHNESS, _STEPS, _ANGLE_NOISE, _HEIGHT_NOISE, _RANGE_TIMEOUT, _ARM) = range(
    8
)
_IR_ARRIVAL, _MARKER_ARRIVAL, _POLLS, _RING = range(4)
_RANGE = RANGE_FINDER.index("range")
_Q = VEHICLE_ESTIMATE.index("q_WB_w")
_HEIGHT = VEHICLE_ESTIMATE.index("height_above_ground")
_HEIGHT_VALID = VEHICLE_ESTIMATE.index("height_above_ground_valid")
_POSITION = TARGET_MEASUREMENT.index("p_BP_W_x")
_SOURCE = TARGET_MEASUREMENT.index("source")


@njit(cache=True)
def _height(t, ranging, estimate, q, parameters):
    """The height of B's origin above the ground, m; NaN where it is not known."""
    if ranging[VALID] > 0.0 and t - ranging[TIME_OF_ARRIVAL] <= parameters[_RANGE_TIMEOUT]:
        # The beam goes along −z_B from p_BR: its foot lies R_WB (p_BR − r z_B) below B.
        w, x, y, z = q[0], q[1], q[2], q[3]
        zx, zy, zz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        arm = zx * parameters[_ARM] + zy * parameters[_ARM + 1]
        return zz * (ranging[_RANGE] - parameters[_ARM + 2]) - arm
    if estimate[_HEIGHT_VALID] > 0.0:
        return estimate[_HEIGHT]
    return math.nan


@njit(cache=True)
def poll(output, memory, t, infrared, marker, ranging, estimate, parameters, X_BI, X_BM):
    """One poll of the front end at time t.

    Parameters
    ----------
    output : array of shape (TARGET_MEASUREMENT.size,)
        The value that is kept; updated in place.
    memory : array of shape (MEMORY.size,)
        Updated in place.
    t : float
        s.
    infrared, marker, ranging, estimate : arrays
        Of the layouts INFRARED, MARKER, RANGE_FINDER and VEHICLE_ESTIMATE.
    parameters : array of shape (PARAMETERS.size,)
    X_BI, X_BM : arrays of shape (3, 4)
        Mounts of the infrared and of the marker camera.
    """
    polls = int(memory[_POLLS])
    newest = _RING + 4 * (polls % ATTITUDES)
    memory[newest : newest + 4] = estimate[_Q : _Q + 4]
    memory[_POLLS] += 1.0
    delayed = _RING + 4 * (max(polls - int(parameters[_STEPS]), 0) % ATTITUDES)
    q = memory[delayed : delayed + 4]

    sources = int(parameters[_SOURCES])
    found = 0
    p = np.zeros(9)
    p_marker = np.zeros(9)
    if (
        sources & MARKER_SOURCE
        and marker[VALID] > 0.0
        and marker[TIME_OF_ARRIVAL] != memory[_MARKER_ARRIVAL]
    ):
        memory[_MARKER_ARRIVAL] = marker[TIME_OF_ARRIVAL]
        p_marker = pad_position_from_marker(marker, q, X_BM)
        found |= MARKER_SOURCE
    if (
        sources & INFRARED_SOURCE
        and infrared[VALID] > 0.0
        and infrared[TIME_OF_ARRIVAL] != memory[_IR_ARRIVAL]
    ):
        memory[_IR_ARRIVAL] = infrared[TIME_OF_ARRIVAL]
        height = -p_marker[2] if found else _height(t, ranging, estimate, q, parameters)
        height_noise = math.sqrt(p_marker[8]) if found else parameters[_HEIGHT_NOISE]
        p = pad_position_from_infrared(
            infrared, q, height, X_BI, 0, parameters[_ANGLE_NOISE], height_noise
        )
        if math.isfinite(p[0]):
            found |= INFRARED_SOURCE

    if found == 0:
        if t - output[TIME_OF_ARRIVAL] > parameters[_FRESHNESS]:
            output[VALID] = 0.0
        return
    if found == MARKER_SOURCE:
        p = p_marker
        validity = marker[TIME_OF_VALIDITY]
    elif found == INFRARED_SOURCE:
        validity = infrared[TIME_OF_VALIDITY]
    else:
        a = parameters[_WEIGHT]
        b = 1.0 - a
        validity = a * infrared[TIME_OF_VALIDITY] + b * marker[TIME_OF_VALIDITY]
        p[:2] = a * p[:2] + b * p_marker[:2]
        p[3:6] = a * a * p[3:6] + b * b * p_marker[3:6]
        # The infrared position is scaled with the marker's height: both errors share it.
        p[6:8] = a * p[6:8] + b * p_marker[6:8]
        p[2] = p_marker[2]
        p[8] = p_marker[8]
    output[TIME_OF_VALIDITY] = validity
    output[TIME_OF_ARRIVAL] = t
    output[SEQUENCE_NUMBER] += 1.0
    output[VALID] = 1.0
    output[_POSITION : _POSITION + 9] = p
    output[_SOURCE] = found

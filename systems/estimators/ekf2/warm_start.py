"""Starting from another filter's state, for a log that begins when its filter had long run.

PX4's filter starts when the vehicle is switched on, its log (by default) when it is armed:
at the log's first sample that filter has its heading, biases, magnetic fields and origin.
`with_start` puts such a state beside an empty filter, and `take_over` takes it when the
delayed horizon reaches its time; until then samples are only buffered. What no log holds
starts anew: the correlations (the covariance begins diagonal), low-passed innovations, and
the yaw estimator's five filters.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import covariance, set_rotation
from systems.estimators.ekf2.geometry import rotate_back
from systems.estimators.ekf2.height import choose_reference
from systems.estimators.ekf2.magnetometer import update_world_model
from systems.estimators.ekf2.output_predictor import align_output, align_vertical_output
from systems.estimators.ekf2.prediction import initialise_covariance, predict_state

# Flags that are carried over; the others belong to sources that are not built, or to faults.
FLAGS = (
    "tilt_align", "yaw_align", "gnss_pos", "gnss_vel", "gps_hgt", "baro_hgt", "rng_hgt", "ev_pos",
    "ev_vel", "ev_yaw", "ev_hgt", "mag", "mag_hdg", "mag_3D", "mag_dec", "in_air", "fixed_wing",
    "gnd_effect", "vehicle_at_rest", "mag_aligned_in_flight", "mag_heading_consistent",
)  # fmt: skip
BIASES = ("baro", "gnss_hgt", "ev_hgt", "ev_north", "ev_east")  # in the order of START_BIASES
_BIAS_PLACES = (
    at.BIAS_BARO, at.BIAS_GNSS_HGT, at.BIAS_EV_HGT, at.BIAS_EV_NORTH, at.BIAS_EV_EAST,
)  # fmt: skip
_BIAS_FLAGS = (at.BARO_HGT, at.GPS_HGT, at.EV_HGT, at.EV_POS, at.EV_POS)
_BIASES = len(BIASES)
_HEIGHTS = (at.BARO, at.GNSS, at.EV)  # the first of BIASES, as height references
_REFERENCE_FLAGS = (at.BARO_HGT, at.GPS_HGT, at.RNG_HGT, at.EV_HGT)  # by EKF2_HGT_REF


@dataclass(frozen=True, eq=False)
class Start:
    """The state of a filter at one time.

    Attributes
    ----------
    time : float
        us, of its delayed horizon.
    nominal : np.ndarray
        As `layout.QUATERNION` and following: quaternion FRD to NED, velocity (m/s), position
        (not looked at), biases, fields, wind, terrain, shape (25,).
    place : np.ndarray
        Latitude, longitude (deg), altitude (m), shape (3,); without an origin, from (0, 0).
    variances : np.ndarray
        Of the errors, shape (24,).
    origin : np.ndarray
        Latitude, longitude (deg), altitude (m), NaN where there is none, shape (3,).
    flags : sequence of str
        Those of `FLAGS` that are set.
    biases : np.ndarray
        Bias and variance of each of `BIASES` (m, m2), NaN where not known, shape (5, 2).
    """

    time: float
    nominal: np.ndarray
    place: np.ndarray
    variances: np.ndarray
    origin: np.ndarray
    flags: Sequence[str]
    biases: np.ndarray


def with_start(x: np.ndarray, start: Start) -> np.ndarray:
    """An empty filter that will start from a state.

    Parameters
    ----------
    x : np.ndarray
        From `filter.initialise`; not changed.
    start : Start
        The state; its time must lie behind the first IMU sample.
    """
    x = x.copy()
    to_radians = np.array([math.pi / 180.0, math.pi / 180.0, 1.0])
    x[at.START_TIME] = start.time
    x[at.START_NOMINAL : at.START_NOMINAL + at.NOMINAL_SIZE] = start.nominal
    x[at.START_PLACE : at.START_PLACE + 3] = start.place * to_radians
    x[at.START_VARIANCES : at.START_VARIANCES + at.ERRORS] = start.variances
    origin = start.origin * to_radians
    if np.isfinite(origin[:2]).all():
        x[at.ORIGIN_SET] = 1.0
        x[at.ORIGIN_LATITUDE], x[at.ORIGIN_LONGITUDE] = origin[:2]
        x[at.ORIGIN_TIME] = start.time
    x[at.ORIGIN_ALTITUDE] = origin[2]
    for name in start.flags:
        x[at.START_FLAGS + at.FLAG_NAMES.index(name)] = 1.0
    x[at.START_BIASES : at.START_BIASES + 2 * _BIASES] = start.biases.ravel()
    # the output until then: no history of the vehicle's motion is better known than this
    x[at.OUT_QUATERNION : at.OUT_QUATERNION + 4] = start.nominal[:4]
    x[at.OUT_VELOCITY : at.OUT_VELOCITY + 3] = start.nominal[at.VELOCITY : at.VELOCITY + 3]
    x[at.OUT_VERTICAL + 1] = start.nominal[at.VELOCITY + 2]
    x[at.OUT_REFERENCE : at.OUT_REFERENCE + 3] = start.place * to_radians
    for own, state in ((at.OUT_GYRO_BIAS, at.GYRO_BIAS), (at.OUT_ACCEL_BIAS, at.ACCEL_BIAS)):
        x[own : own + 3] = start.nominal[state : state + 3]
    return x


@kernel
def take_over(x, p):
    """Take the state that waits; the horizon has just reached or passed its time."""
    now = x[at.TIME_DELAYED]
    for i in range(at.NOMINAL_SIZE):
        x[i] = x[at.START_NOMINAL + i]
    set_rotation(x)
    for i in range(3):
        x[at.LATITUDE + i] = x[at.LAST_KNOWN + i] = x[at.START_PLACE + i]
    x[at.LAST_GROUND_DOWN] = x[at.TERRAIN]
    initialise_covariance(x, p)
    P = covariance(x)
    for i in range(at.ERRORS):
        P[i, i] = x[at.START_VARIANCES + i]
    if x[at.ORIGIN_SET]:
        x[at.T_WORLD_MODEL] = now
        update_world_model(x, p)
    for i in range(at.FLAG_COUNT):
        x[at.FLAGS + i] = x[at.START_FLAGS + i]
    _start_timers(x, p, now)
    _start_sources(x, p)
    for i in range(at.FLAGS, at.FLAGS + at.FLAG_COUNT):
        x[i + at.BEFORE] = x[i]
    _propagate(x, p, now)
    align_output(x)
    align_vertical_output(x)
    x[at.START_TIME] = 0.0


@kernel
def _start_timers(x, p, now):
    for timer in range(at.T_HORIZONTAL_AIDING, at.T_TERRAIN + 1):
        x[timer] = now
    x[at.T_IN_AIR if x[at.IN_AIR] else at.T_ON_GROUND] = now
    x[at.T_GOOD_ACCEL] = x[at.T_GROUND_EFFECT] = now
    for aid in range(at.AID, at.AID + at.A_SIZE * len(at.AID_AXES), at.A_SIZE):
        x[aid + at.A_LAST_FUSE] = now
    aided = x[at.GNSS_POS] or x[at.GNSS_VEL] or x[at.EV_POS] or x[at.EV_VEL]
    x[at.HORIZONTAL_EXCEEDED] = not aided
    x[at.HEADING_OBSERVABLE] = bool(aided or x[at.MAG_HDG] or x[at.MAG_3D] or x[at.EV_YAW])
    height = x[at.GPS_HGT] or x[at.BARO_HGT] or x[at.RNG_HGT] or x[at.EV_HGT]
    x[at.VERTICAL_POSITION_EXCEEDED] = not height
    x[at.VERTICAL_VELOCITY_EXCEEDED] = not (x[at.GNSS_VEL] or x[at.EV_VEL])
    if x[at.GNSS_POS] or x[at.GNSS_VEL]:  # GNSS has passed its checks long ago
        x[at.CHECKS_PASSED] = x[at.CHECKS_INITIAL] = 1.0
        x[at.CHECKS_LAST_PASS] = now
        x[at.CHECKS_LAST_FAIL] = max(now - 1e6 * p[prm.EKF2_REQ_GPS_H] - 1.0, 1.0)


@kernel
def _start_sources(x, p):
    wanted = int(p[prm.EKF2_HGT_REF])
    for source in range(len(_REFERENCE_FLAGS)):
        if source == wanted and x[_REFERENCE_FLAGS[source]]:
            x[at.HEIGHT_REFERENCE] = source
    choose_reference(x, p)
    for i in range(_BIASES):
        bias, known = _BIAS_PLACES[i], at.START_BIASES + 2 * i
        if math.isfinite(x[known] + x[known + 1]):
            x[bias + at.B_BIAS] = x[bias + at.B_REPORTED] = x[known]
            x[bias + at.B_VARIANCE] = x[known + 1]
        elif i < len(_HEIGHTS) and x[at.HEIGHT_REFERENCE] != _HEIGHTS[i]:
            x[_BIAS_FLAGS[i]] = 0.0  # it starts again, with a bias of its own finding
        x[bias + at.B_ACTIVE] = x[_BIAS_FLAGS[i]]
    for bias in (at.BIAS_EV_NORTH, at.BIAS_EV_EAST):  # only beside GNSS
        x[bias + at.B_ACTIVE] = x[at.EV_POS] != 0.0 and x[at.GNSS_POS] != 0.0
        x[bias + at.B_WAS_ACTIVE] = x[bias + at.B_ACTIVE]
    if x[at.BARO_HGT]:  # its low-pass is full, at what the bias says
        x[at.BARO_COUNT] = x[at.RING_LENGTH] + 1.0
        x[at.BARO_LPF] = x[at.ALTITUDE] + x[at.BIAS_BARO + at.B_BIAS]
    for active, ring in (
        (x[at.GNSS_POS] + x[at.GNSS_VEL] + x[at.GPS_HGT], at.RING_GNSS),
        (x[at.BARO_HGT], at.RING_BARO),
        (x[at.MAG], at.RING_MAG),
        (x[at.RNG_HGT], at.RING_RANGE),
        (x[at.EV_POS] + x[at.EV_VEL] + x[at.EV_YAW] + x[at.EV_HGT], at.RING_EV),
    ):
        if active:  # a source in use had delivered just before the log began
            x[ring + at.RING_IN_USE] = 1.0
            x[ring + at.RING_PUSH_TIME] = x[at.TIME_LATEST]
    if x[at.MAG]:
        e = at.MAG_EARTH
        fx, fy, fz = rotate_back(x, at.ROTATION, x[e], x[e + 1], x[e + 2])
        x[at.MAG_COUNT] = 4.0  # samples seen, more than a start needs
        x[at.MAG_LPF] = fx + x[at.MAG_BODY]
        x[at.MAG_LPF + 1] = fy + x[at.MAG_BODY + 1]
        x[at.MAG_LPF + 2] = fz + x[at.MAG_BODY + 2]


@kernel
def _propagate(x, p, now):
    """Move the state from its time to the horizon, by a part of the horizon's IMU sample."""
    late = 1e-6 * (now - x[at.START_TIME])
    step = x[at.IMU_VELOCITY_DT]
    part = min(late / step, 1.0)
    first = at.IMU_DELTA_ANGLE
    sample = x[first : first + 8].copy()  # increments and their time steps
    if part > 0.0:
        for i in range(8):
            x[first + i] = sample[i] * part
        predict_state(x, p)
        for i in range(8):
            x[first + i] = sample[i]

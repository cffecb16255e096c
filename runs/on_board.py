"""What the vehicle's own filter said: to compare a replay with, and to start it from."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from runs.ulog_fields import Fields, Topic, sample_times
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.geometry import unproject
from systems.estimators.ekf2.warm_start import BIASES, FLAGS, Start

_LATEST_START_US = 2e6  # us after the first IMU sample
_BEFORE_END_US = 1e6  # us, of log that must follow
_LARGEST = 1e5  # of any number of a state, in its unit
_OLDER_NAMES = {"gnss_pos": "gps", "gnss_vel": "gps"}  # of flags, until PX4 1.16
_BIAS_TOPICS = {
    "baro": ("estimator_baro_bias", ""),
    "gnss_hgt": ("estimator_gnss_hgt_bias", ""),
    "ev_hgt": ("estimator_ev_pos_bias", "[2]"),
    "ev_north": ("estimator_ev_pos_bias", "[0]"),
    "ev_east": ("estimator_ev_pos_bias", "[1]"),
}


@dataclass(frozen=True)
class OnBoard:
    """What the vehicle's own filter estimated.

    Attributes
    ----------
    attitude : np.ndarray
        Time (us), quaternion FRD to NED, w first, shape (n, 5).
    motion : np.ndarray
        Time (us), velocity NED (m/s), position NED (m), shape (m, 7).
    reference : np.ndarray
        Latitude, longitude (deg), altitude (m) that each position is relative to; NaN where
        there is none, shape (m, 3).
    """

    attitude: np.ndarray
    motion: np.ndarray
    reference: np.ndarray


def read_estimate(topics: Mapping[str, Topic]) -> OnBoard | None:
    """The estimates of a log, if it has them."""
    attitude = Fields(topics, "vehicle_attitude", "estimator_attitude")
    motion = Fields(topics, "vehicle_local_position", "estimator_local_position")
    if not attitude or not motion:
        return None
    q = np.column_stack([sample_times(attitude), attitude.vector("q", 4)])
    names = ("vx", "vy", "vz", "x", "y", "z")
    moved = np.column_stack([sample_times(motion), *(motion(name) for name in names)])
    reference = np.column_stack(
        [motion(name, default=math.nan) for name in ("ref_lat", "ref_lon", "ref_alt")]
    )
    sane = np.isfinite(moved).all(axis=1)
    return OnBoard(q[np.isfinite(q).all(axis=1)], moved[sane], reference[sane])


def read_start(topics: Mapping[str, Topic], imu: np.ndarray) -> Start | None:
    """The first state of the filter on board that a replay can start from.

    It must have the 24 errors of PX4 1.15 and later, be aligned, and lie within the first two
    seconds of the log.

    Parameters
    ----------
    topics : mapping
        All topics of the log.
    imu : np.ndarray
        Times of arrival (us) of the IMU's samples, shape (n,).
    """
    states = Fields(topics, "estimator_states")
    status = Fields(topics, "estimator_status_flags")
    local = Fields(topics, "vehicle_local_position", "estimator_local_position")
    if not (states and status and local) or len(imu) == 0:
        return None
    if f"states[{at.NOMINAL_SIZE - 1}]" not in states or "timestamp_sample" not in states:
        return None
    times, moved = states("timestamp_sample"), sample_times(local)
    earliest = max(imu[0], moved[0])
    first = int(np.argmax(times > earliest))
    time = float(times[first])
    if not earliest < time < min(imu[0] + _LATEST_START_US, imu[-1] - _BEFORE_END_US, moved[-1]):
        return None
    flags = _flags(status, time)
    if not {"tilt_align", "yaw_align"} <= set(flags):
        return None
    place, origin = _place(local, moved, time)
    start = Start(
        time,
        states.vector("states", at.NOMINAL_SIZE)[first],
        place,
        states.vector("covariances", at.ERRORS)[first],
        origin,
        flags,
        np.array([_bias(topics, name, time) for name in BIASES]),
    )
    return start if _believable(start) else None


def _flags(status: Fields, time: float) -> list[str]:
    """The flags at a time; PX4 logs them when they change and once a second."""
    row = max(int(np.searchsorted(sample_times(status), time, side="right")) - 1, 0)
    own = []
    for name in FLAGS:
        names = [f"cs_{name.lower()}"]
        if name in _OLDER_NAMES:
            names.append(f"cs_{_OLDER_NAMES[name]}")
        if status(*names, default=0.0)[row] != 0.0:
            own.append(name)
    return own


def _place(local: Fields, moved: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Latitude, longitude, altitude of vehicle and origin (NaN without), at a time."""
    north, east, down = (np.interp(time, moved, local(axis)) for axis in "xyz")
    row = max(int(np.searchsorted(moved, time, side="right")) - 1, 0)
    origin = np.array(
        [local(name, default=math.nan)[row] for name in ("ref_lat", "ref_lon", "ref_alt")]
    )
    known = np.where(np.isfinite(origin), origin, 0.0)
    latitude, longitude = unproject(north, east, math.radians(known[0]), math.radians(known[1]))
    place = np.array([math.degrees(latitude), math.degrees(longitude), known[2] - down])
    return place, origin


def _bias(topics: Mapping[str, Topic], name: str, time: float) -> tuple[float, float]:
    """Bias and variance of a source at a time, NaN where they were not logged."""
    topic, axis = _BIAS_TOPICS[name]
    bias = Fields(topics, topic)
    if not bias:
        return math.nan, math.nan
    row = max(int(np.searchsorted(sample_times(bias), time, side="right")) - 1, 0)
    value, variance = (bias(f"{field}{axis}", default=math.nan) for field in ("bias", "bias_var"))
    return float(value[row]), float(variance[row])


def _believable(start: Start) -> bool:
    numbers = np.concatenate([start.nominal, start.variances, start.place])
    return bool(
        np.isfinite(numbers).all()
        and np.abs(numbers).max() < _LARGEST
        and abs(np.linalg.norm(start.nominal[:4]) - 1.0) < 0.01
        and (start.variances >= 0.0).all()
        and abs(start.place[0]) <= 90.0
        and abs(start.place[1]) <= 180.0
        and not (np.abs(start.origin) > _LARGEST).any()
        and not (np.abs(start.biases) > _LARGEST).any()
    )

"""The reference streams of PX4's own EKF2 (see their README), fed to the kernels."""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.signals.measurement import (
    BAROMETER,
    EXTERNAL_VISION,
    GNSS,
    INERTIAL,
    MAGNETOMETER,
)
from tests.shared_data import shared

FLIGHT = {
    "EKF2_MAG_DECL": 3.40560555,
    "EKF2_DELAY_MAX": 300,
    "EKF2_EV_CTRL": 3,
    "EKF2_EV_DELAY": 200,
    "EKF2_EVP_GATE": 5,
}
FLIGHT_FIELD = (3.4056, 63.157, 0.48239)  # deg, deg, gauss; README of the streams

_PUSH = {
    "imu": kernels.push_imu,
    "mag": kernels.push_magnetometer,
    "baro": kernels.push_barometer,
    "gps": kernels.push_gnss,
    "ev": kernels.push_external_vision,
    "flags": kernels.push_status,
}


def table(name: str) -> pd.DataFrame:
    """One of the streams' tables."""
    return pd.read_csv(shared(f"data/px4-ekf2/{name}.csv.gz"))


def _row(kind: str, stamp: float, v: np.ndarray) -> np.ndarray:
    nan = np.nan
    rows = {
        "imu": (*v[:8], 0.0, 0.0, 0.0),
        "mag": (*v[:3], 0.0),
        "baro": (v[0], 0.0),
        "gps": (*v[:12], 0.0, 0.0),
        "ev": (
            *v[:3], *(nan,) * 7, *v[3:6], *(nan,) * 6, at.FRAME_NED, at.FRAME_NED, *v[6:8],
        ),
        "flags": (*v[:3], 0.0, 0.0),
        "in_air_direct": (v[0],),
    }  # fmt: skip
    return np.array([stamp, *rows[kind]])


@dataclass
class Samples:
    """An input stream: arrival times (us), kinds and rows as the `push_…` functions take them."""

    arrivals: list[int] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    rows: list[np.ndarray] = field(default_factory=list)


def samples(name: str, seconds: float = np.inf) -> Samples:
    """The samples of an input stream, up to a time after its start."""
    frame = table(f"{name}_input")
    frame = frame[frame.t_arrival_us <= frame.t_arrival_us.iloc[0] + seconds * 1e6]
    values = frame.filter(regex=r"^v\d").to_numpy(float)
    stream = Samples()
    for arrival, kind, stamp, v in zip(
        frame.t_arrival_us, frame.type, frame.t_stamp_us, values, strict=True
    ):
        stream.arrivals.append(int(arrival))
        stream.kinds.append(kind)
        stream.rows.append(_row(kind, float(stamp), v))
    return stream


@dataclass
class Replay:
    """What the filter answered: rows by arrival time, and the last state of the array."""

    steps: dict[int, np.ndarray] = field(default_factory=dict)  # the array's fixed part
    outputs: dict[int, np.ndarray] = field(default_factory=dict)  # the same after each IMU sample
    aids: list[tuple] = field(default_factory=list)  # source, axis, time and status
    x: np.ndarray = field(default_factory=lambda: np.empty(0))


def replay(stream: Samples, p: np.ndarray) -> Replay:
    """Feed a stream: all samples of one arrival time in order, then one update."""
    result = Replay(x=kernels.initialise(p))
    x = result.x
    seen = dict.fromkeys(at.AID_NAMES, 0.0)
    last = len(stream.rows) - 1
    has_imu = False
    for i, (arrival, kind, row) in enumerate(
        zip(stream.arrivals, stream.kinds, stream.rows, strict=True)
    ):
        if kind == "in_air_direct":
            kernels.set_in_air(x, row[1])
        else:
            _PUSH[kind](x, p, row)
            has_imu |= kind == "imu"
        if i < last and stream.arrivals[i + 1] == arrival:
            continue
        if kernels.update(x, p):
            result.steps[arrival] = x[: at.FIXED_SIZE].copy()
            _note_aids(result, arrival, x, seen)
        if has_imu:
            result.outputs[arrival] = x[: at.FIXED_SIZE].copy()
            has_imu = False
    return result


def _note_aids(result: Replay, arrival: int, x: np.ndarray, seen: dict[str, float]) -> None:
    for number, (name, axes) in enumerate(zip(at.AID_NAMES, at.AID_AXES, strict=True)):
        aid = at.AID + number * at.A_SIZE
        if x[aid + at.A_TIME] == seen[name]:
            continue
        seen[name] = x[aid + at.A_TIME]
        for axis in range(axes):
            a = aid + axis * at.A_AXIS
            result.aids.append(
                (
                    arrival, name, axis, x[aid + at.A_TIME], x[a + at.A_INNOVATION],
                    x[a + at.A_INNOVATION_VARIANCE], x[a + at.A_TEST_RATIO],
                    int(x[aid + at.A_REJECTED]), int(x[aid + at.A_FUSED]),
                    x[aid + at.A_LAST_FUSE],
                )
            )  # fmt: skip


def flight_parameters(**values: float) -> np.ndarray:
    """The parameters of the `flight` streams, with changes."""
    return prm.parameter_array(FLIGHT | values, "module", earth_field=FLIGHT_FIELD)


def messages_by_tick(stream: Samples, period: float) -> dict[int, list[tuple[str, np.ndarray]]]:
    """The same samples as the laboratory's messages in W and B, by tick of arrival."""
    ticks: dict[int, list[tuple[str, np.ndarray]]] = {}
    for arrival, kind, row in zip(stream.arrivals, stream.kinds, stream.rows, strict=True):
        port, layout, fields = _MESSAGES[kind]
        message = fields(row)
        if layout is not None:
            header = (row[0] * 1e-6, arrival * 1e-6, 0.0, 1.0)
            message = np.array([*header, *message])
            assert message.size == layout.size
        ticks.setdefault(round(arrival * 1e-6 / period), []).append((port, message))
    return ticks


_flip = np.array([1.0, -1.0, -1.0])  # FRD to FLU


def _world(v: np.ndarray) -> tuple[float, float, float]:
    return v[1], v[0], -v[2]


_MESSAGES = {
    "imu": ("imu", INERTIAL, lambda r: (*(r[1:4] * _flip), *(r[4:7] * _flip), *r[7:9], r[9])),
    "mag": ("magnetometer", MAGNETOMETER, lambda r: r[1:4] * _flip),
    "baro": ("barometer", BAROMETER, lambda r: r[1:2]),
    "gps": ("gnss", GNSS, lambda r: (*r[1:4], *_world(r[4:7]), *r[7:13])),
    "ev": (
        "external_vision",
        EXTERNAL_VISION,
        lambda r: (*_world(r[1:4]), *r[11:14], *(np.nan,) * 8, *r[22:24]),
    ),
    "flags": ("vehicle_status", None, lambda r: r[1:4]),
}

"""Damaged logs, by number: the same seed gives the same damage."""

import gzip
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from runs.flight_log import ReplayError
from runs.log_sources import read_log
from runs.replay import parameter_array, parameter_values, play
from runs.replay_diagnosis import diagnosis, summaries
from runs.replay_tables import against_on_board
from runs.ulog import write_ulog

Topics = dict[str, np.ndarray]
_WORDS = (b"nan", b"1e300", b"-inf", b"", b"imu", b"gps", b"\x00", b"99999999999999999999", b"x,y")


def csv_stream(seconds: float = 2.0) -> bytes:
    """A vehicle at rest: IMU 250 Hz, barometer 25 Hz, GNSS 5 Hz, vision 10 Hz."""
    lines = ["t_arrival_us,type,t_stamp_us," + ",".join(f"v{i}" for i in range(12))]

    def line(arrival: int, kind: str, stamp: int, *values: float) -> None:
        cells = [*map(repr, values), *[""] * (12 - len(values))]
        lines.append(f"{arrival},{kind},{stamp}," + ",".join(cells))

    for i in range(1, int(seconds * 250)):
        t = 1_000_000 + 4000 * i
        line(t, "imu", t, 0.0, 0.0, 0.0, 0.0, 0.0, -0.0392266, 0.004, 0.004)
        if i % 5 == 0:
            line(t, "mag", t, 0.22, 0.0, 0.43)
        if i % 10 == 0:
            line(t, "baro", t, 500.0)
        if i % 50 == 0:
            line(t, "gps", t - 110_000, 47.4, 8.5, 500.0, 0.0, 0.0, 0.0, 0.5, 0.8, 0.3, 3, 14, 1.1)
            line(t, "flags", t, 1, 0, 0)
        if i % 25 == 0:
            line(t, "ev", t, 0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 0, 100)
    return ("\n".join(lines) + "\n").encode()


def ulog_stream(seconds: float = 2.0, change: Callable[[Topics], None] | None = None) -> bytes:
    """The same vehicle as a ULog; `change` may alter its topics."""

    def table(period: int, **fields: tuple[str, Any]) -> np.ndarray:
        stamps = np.arange(1_000_000, 1_000_000 + int(seconds * 1e6), period)
        types: list[Any] = [("timestamp", "u8")]
        types += [(n, k, np.shape(v)) for n, (k, v) in fields.items()]
        rows = np.zeros(len(stamps), dtype=types)
        rows["timestamp"] = stamps
        for name, (_, value) in fields.items():
            rows[name] = value
        return rows

    topics = {
        "sensor_combined": table(
            4000,
            gyro_rad=("f4", [0.0] * 3),
            gyro_integral_dt=("u4", 4000),
            accelerometer_m_s2=("f4", [0.0, 0.0, -9.8]),
            accelerometer_integral_dt=("u4", 4000),
        ),
        "sensor_gps": table(
            200_000,
            latitude_deg=("f8", 47.4),
            longitude_deg=("f8", 8.5),
            altitude_msl_m=("f8", 500.0),
            vel_n_m_s=("f4", 0.0),
            vel_e_m_s=("f4", 0.0),
            vel_d_m_s=("f4", 0.0),
            eph=("f4", 0.5),
            epv=("f4", 0.8),
            s_variance_m_s=("f4", 0.3),
            fix_type=("u1", 3),
            satellites_used=("u1", 14),
        ),
        "vehicle_air_data": table(40_000, baro_alt_meter=("f4", 500.0)),
        "vehicle_magnetometer": table(20_000, magnetometer_ga=("f4", [0.22, 0.0, 0.43])),
        "vehicle_land_detected": table(500_000, landed=("?", True), at_rest=("?", True)),
        # what the filter on board knew, so that the replay starts from it
        "estimator_states": table(
            100_000,
            timestamp_sample=("u8", 0),
            states=("f4", [1.0, *[0.0] * 8, -500.0, *[0.0] * 6, 0.22, 0.0, 0.43, *[0.0] * 6]),
            covariances=("f4", [1e-3] * 24),
        ),
        "estimator_status_flags": table(
            100_000,
            **{
                f"cs_{name}": ("?", True) for name in ("tilt_align", "yaw_align", "baro_hgt", "mag")
            },
        ),
        "estimator_baro_bias": table(100_000, bias=("f4", 0.0), bias_var=("f4", 0.1)),
        "vehicle_attitude": table(50_000, q=("f4", [1.0, 0.0, 0.0, 0.0])),
        "vehicle_local_position": table(
            100_000,
            **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), ("f4", 0.0)),
            ref_lat=("f8", 47.4),
            ref_lon=("f8", 8.5),
            ref_alt=("f4", 500.0),
        ),
    }
    states = topics["estimator_states"]
    states["timestamp_sample"] = states["timestamp"] + 50_000
    if change is not None:
        change(topics)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.ulg"
        write_ulog(path, topics, {"EKF2_GPS_DELAY": 110.0})
        return path.read_bytes()


def damaged(data: bytes, seed: int) -> bytes:
    """`data` with some damage: bytes changed, cut, removed, doubled, words or columns swapped."""
    draw = np.random.default_rng(seed)
    kind = draw.integers(7)
    first, last = sorted(draw.integers(len(data), size=2))
    last = min(last, first + 400)
    if kind == 0:
        changed = bytearray(data)
        for i in draw.integers(len(data), size=draw.integers(1, 20)):
            changed[i] = draw.integers(256)
        return bytes(changed)
    if kind == 1:
        return data[:first]
    if kind == 2:
        return data[:first] + data[last:]
    if kind == 3:
        return data[:last] + data[first:last] + data[last:]
    if kind == 4 and data[:4] != b"ULog":
        lines = data.split(b"\n")
        line = int(draw.integers(len(lines)))
        cells = lines[line].split(b",")
        cells[draw.integers(len(cells))] = _WORDS[draw.integers(len(_WORDS))]
        lines[line] = b",".join(cells)
        return b"\n".join(lines)
    if kind == 5 and data[:4] != b"ULog":
        a, b = draw.integers(15, size=2)
        rows = [line.split(b",") for line in data.split(b"\n")]
        for row in rows[int(draw.integers(2)) :]:
            if len(row) > max(a, b):
                row[a], row[b] = row[b], row[a]
        return b"\n".join(b",".join(row) for row in rows)
    return gzip.compress(data)[: int(draw.integers(2, 2000))]


def outcome(data: bytes, path: Path) -> str:
    """What replaying the bytes ends in: "" for a result, the sentence otherwise."""
    path.write_bytes(data)
    try:
        log = read_log(path)
        p = parameter_array(log, parameter_values(log))
        replay = play(log.samples, p, log.start)
        diagnosis(log, replay, p)
        summaries(replay)
        against_on_board(replay, log)
    except ReplayError as error:
        return str(error)
    return ""

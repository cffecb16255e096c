"""Reading flight logs: CSV streams and PX4's ULog, into one table in order of arrival.

A log that cannot be replayed ends in a `ReplayError`, one sentence that names the
file, the line or topic, and what was expected.
"""

import contextlib
import csv
import gzip
import io
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog

from runs.on_board import OnBoard, read_estimate, read_start
from runs.ulog_fields import Fields, MissingFieldError, Topic, sample_times
from systems.estimators.ekf2.warm_start import Start
from systems.signals import sensor_log as logs
from systems.signals.sensor_log import SensorLog

Parameters = dict[str, int | float]


class ReplayError(ValueError):
    """A log, or what was asked of it, cannot be replayed."""


@dataclass(frozen=True)
class FlightLog:
    """A log that can be replayed.

    Attributes
    ----------
    name : str
        Of the file.
    samples : SensorLog
        Of all sensors.
    parameters : dict
        The `EKF2_…` parameters of the flight.
    on_board : OnBoard or None
        The estimates of the flight.
    start : Start or None
        The state that the filter on board had when the log began, if it was aligned by then;
        a replay starts from it.
    range_limits : tuple of float
        Shortest and longest range (m) of the range finder.
    notes : tuple of str
        Sentences about what was read differently from how it was logged.
    """

    name: str
    samples: SensorLog
    parameters: Parameters = field(default_factory=dict)
    on_board: OnBoard | None = None
    start: Start | None = None
    range_limits: tuple[float, float] = (0.1, 40.0)
    notes: tuple[str, ...] = ()


def read_log(path: Path) -> FlightLog:
    """Read a log: ULog by its first bytes, CSV (plain or gzip) otherwise.

    Raises
    ------
    ReplayError
        If the file cannot be read or holds nothing that can be replayed.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ReplayError(f"{path}: cannot be read: {error.strerror}") from None
    if data[:4] == b"ULog":
        return _read_ulog(path, data)
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (EOFError, OSError, zlib.error) as error:
            raise ReplayError(f"{path}: the gzip file is damaged or cut: {error}") from None
    return _read_csv(path, data)


# ---------------------------------------------------------------------------- limits

_LATEST_US = 4e15  # us; float64 counts whole microseconds to 9e15
_LONGEST_DELAY_US = 10e6
_GAP_US = 10e6  # longest hole in the IMU's samples
_IMU_PERIOD_US = (400.0, 50_000.0)  # 2500 to 20 Hz
_SPECIFIC_FORCE = (4.0, 25.0)  # m/s2, median over a flight

# Largest believable magnitudes: (columns, limit, what).
_LIMITS: dict[int, tuple[tuple[slice, float, str], ...]] = {
    logs.GNSS: (
        (slice(1, 2), 90.0, "latitude (deg)"),
        (slice(2, 3), 180.0, "longitude (deg)"),
        (slice(3, 4), 1e6, "altitude (m)"),
        (slice(4, 7), 1e3, "velocity (m/s)"),
        (slice(7, 10), 1e7, "accuracy"),
        (slice(10, 12), 255.0, "fix type or satellites"),
        (slice(12, 13), 1e3, "PDOP"),
    ),
    logs.BAROMETER: ((slice(1, 2), 1e5, "altitude (m)"),),
    logs.MAGNETOMETER: ((slice(1, 4), 100.0, "field (gauss)"),),
    logs.RANGE_FINDER: ((slice(1, 2), 1e4, "range (m)"), (slice(2, 3), 127.0, "quality")),
    logs.EXTERNAL_VISION: (
        (slice(1, 4), 1e6, "position (m)"),
        (slice(4, 7), 1e3, "velocity (m/s)"),
        (slice(7, 11), 1.01, "quaternion"),
        (slice(11, 20), 1e6, "variance"),
        (slice(22, 24), 255.0, "reset counter or quality"),
    ),
    logs.STATUS: ((slice(1, 6), 1.0, "flag"),),
    logs.IN_AIR: ((slice(1, 2), 1.0, "flag"),),
}
_GYRO_LIMIT, _ACCELEROMETER_LIMIT = 100.0, 1000.0  # rad/s, m/s2
_NOT_NEGATIVE = {logs.GNSS: slice(7, 13), logs.EXTERNAL_VISION: slice(11, 20)}


def _checked(samples: SensorLog, where: list[str], name: str) -> SensorLog:
    """The same samples if they are believable; `where` says of each which line it is."""

    def fail(row: int, sentence: str) -> None:
        raise ReplayError(f"{name}, {where[row]}: {sentence}")

    kinds, arrivals, rows = samples.kinds, samples.arrivals, samples.rows
    stamps = rows[:, 0]
    with np.errstate(invalid="ignore"):
        _first(
            ~((arrivals >= 0.0) & (arrivals <= _LATEST_US)),
            lambda i: fail(i, f"expected a time of arrival in microseconds, not {arrivals[i]:g}"),
        )
        _first(
            np.diff(arrivals, prepend=-1.0) < 0.0,
            lambda i: fail(i, f"arrives before its predecessor ({arrivals[i]:.0f} us)"),
        )
        _first(
            (kinds != logs.IN_AIR)
            & ~((stamps <= arrivals + 1e5) & (stamps >= arrivals - _LONGEST_DELAY_US)),
            lambda i: fail(
                i,
                f"expected a time stamp up to {_LONGEST_DELAY_US * 1e-6:.0f} s before the arrival "
                f"at {arrivals[i]:.0f} us, not {stamps[i]:.0f} us",
            ),
        )
    for kind, limits in _LIMITS.items():
        own = np.flatnonzero(kinds == kind)
        optional = kind == logs.EXTERNAL_VISION
        for columns, limit, what in limits:
            values = rows[own, columns]
            bad = ~(np.abs(values) <= limit)
            if optional:
                bad &= ~np.isnan(values)
            _first(
                bad.any(axis=1),
                lambda i, own=own, columns=columns, limit=limit, what=what, kind=kind: fail(
                    own[i],
                    f"{logs.KINDS[kind]}: expected {what} of magnitude up to {limit:g}, "
                    f"not {_worst(rows[own[i], columns])}",
                ),
            )
        if kind in _NOT_NEGATIVE:
            values = rows[own, _NOT_NEGATIVE[kind]]
            _first(
                (values < 0.0).any(axis=1),
                lambda i, own=own, kind=kind: fail(
                    own[i], f"{logs.KINDS[kind]}: a standard deviation or variance is negative"
                ),
            )
    _check_imu(samples, fail, name)
    return samples


def _worst(values: np.ndarray) -> str:
    if np.isnan(values).any():
        return "NaN"
    return f"{values[np.argmax(np.abs(values))]:g}"


def _first(bad: Any, fail: Any) -> None:
    """Call `fail` with the first index that is bad, if any."""
    if bad.any():
        fail(int(np.argmax(bad)))


def _check_imu(samples: SensorLog, fail: Any, name: str) -> None:
    own = np.flatnonzero(samples.kinds == logs.IMU)
    if len(own) < 10:
        raise ReplayError(f"{name}: expected IMU samples, found {len(own)}")
    rows = samples.rows[own]
    periods = np.diff(rows[:, 0])
    steps = rows[:, 7:9]
    _first(
        ~((steps >= 1e-5) & (steps <= 1.0)).all(axis=1),
        lambda i: fail(own[i], f"IMU: expected time steps of 10 us to 1 s, not {steps[i]} s"),
    )
    for first, step, limit, what in (
        (1, 7, _GYRO_LIMIT, "turn rate (rad/s)"),
        (4, 8, _ACCELEROMETER_LIMIT, "specific force (m/s2)"),
    ):
        with np.errstate(over="ignore"):
            values = rows[:, first : first + 3] / rows[:, step : step + 1]
        _first(
            ~(np.abs(values) <= limit).all(axis=1),
            lambda i, values=values, limit=limit, what=what: fail(
                own[i], f"IMU: expected a {what} up to {limit:g}, not {_worst(values[i])}"
            ),
        )
    _first(
        periods < 0.0,
        lambda i: fail(own[i + 1], "IMU: its time stamp is earlier than its predecessor's"),
    )
    _first(
        periods > _GAP_US,
        lambda i: fail(own[i + 1], f"IMU: {periods[i] * 1e-6:.0f} s without a sample before it"),
    )
    period = float(np.median(periods))
    if not _IMU_PERIOD_US[0] <= period <= _IMU_PERIOD_US[1]:
        raise ReplayError(
            f"{name}: expected IMU samples every {_IMU_PERIOD_US[0] * 1e-3:g} to "
            f"{_IMU_PERIOD_US[1] * 1e-3:g} ms, they come every {period * 1e-3:g} ms"
        )
    integrated = 1e6 * float(np.median(steps))
    if not 0.5 <= integrated / period <= 2.0:
        raise ReplayError(
            f"{name}: IMU samples come every {period * 1e-3:g} ms but integrate over "
            f"{integrated * 1e-3:g} ms: the time steps have another unit or stand in another column"
        )
    force = float(np.median(np.linalg.norm(rows[:, 4:7], axis=1) / rows[:, 8]))
    if not _SPECIFIC_FORCE[0] <= force <= _SPECIFIC_FORCE[1]:
        raise ReplayError(
            f"{name}: the accelerometer shows {force:.3g} m/s2 in the median where gravity is 9.8: "
            "columns are swapped or have another unit"
        )


# ------------------------------------------------------------------------------- CSV

_CSV_HEADER = ("t_arrival_us", "type", "t_stamp_us")
# Kind of each type and how many values it must have.
_CSV_TYPES = {
    "imu": (logs.IMU, 8),
    "mag": (logs.MAGNETOMETER, 3),
    "baro": (logs.BAROMETER, 1),
    "gps": (logs.GNSS, 12),
    "ev": (logs.EXTERNAL_VISION, 8),
    "range": (logs.RANGE_FINDER, 2),
    "flags": (logs.STATUS, 3),
    "in_air_direct": (logs.IN_AIR, 1),
}


def _read_csv(path: Path, data: bytes) -> FlightLog:
    name = str(path)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        raise ReplayError(f"{name}: is neither a ULog nor a CSV file") from None
    reader = csv.reader(io.StringIO(text))
    kinds: list[int] = []
    arrivals: list[float] = []
    rows: list[list[float]] = []
    lines: list[str] = []
    try:
        header = [cell.strip() for cell in next(reader, [])]
        for column in (*_CSV_HEADER, "v0"):
            if header.count(column) != 1:
                raise ReplayError(
                    f"{name}, line 1: expected the columns t_arrival_us, type, t_stamp_us, "
                    f"v0, v1 …; "
                    f"{column} is {'missing' if column not in header else 'there twice'}"
                )
        at_arrival, at_type, at_stamp = (header.index(column) for column in _CSV_HEADER)
        at_values: list[int] = []
        while f"v{len(at_values)}" in header:
            at_values.append(header.index(f"v{len(at_values)}"))
        for cells in reader:
            if not cells:
                continue
            line = f"line {reader.line_num}"
            if len(cells) != len(header):
                raise ReplayError(
                    f"{name}, {line}: expected {len(header)} columns, found {len(cells)}"
                )
            kind, count = _csv_type(cells[at_type].strip(), f"{name}, {line}")
            if count > len(at_values):
                raise ReplayError(
                    f"{name}, line 1: expected columns up to v{count - 1} for {cells[at_type]}"
                )
            columns = [at_arrival, at_stamp, *at_values[:count]]
            numbers = [_number(cells[c], header[c], f"{name}, {line}") for c in columns]
            kinds.append(kind)
            arrivals.append(numbers[0])
            rows.append(_csv_row(kind, numbers[1:]))
            lines.append(line)
    except csv.Error as error:
        raise ReplayError(f"{name}, line {reader.line_num}: is not CSV: {error}") from None
    if not rows:
        raise ReplayError(f"{name}: holds no samples")
    samples = SensorLog(np.array(kinds, dtype=np.int64), np.array(arrivals), np.array(rows))
    return FlightLog(path.name, _checked(samples, lines, name))


def _csv_type(name: str, where: str) -> tuple[int, int]:
    if name not in _CSV_TYPES:
        raise ReplayError(f"{where}: expected a type of {', '.join(_CSV_TYPES)}, not {name!r}")
    return _CSV_TYPES[name]


def _number(text: str, column: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ReplayError(f"{where}, {column}: expected a number, not {text!r}") from None
    if not math.isfinite(value):
        raise ReplayError(f"{where}, {column}: expected a finite number, not {text}")
    return value


def _csv_row(kind: int, values: list[float]) -> list[float]:
    """The row of a sample, from its time stamp and values."""
    if kind == logs.EXTERNAL_VISION:
        stamp, position, variance = values[0], values[1:4], values[4:7]
        row = [stamp, *position, *[math.nan] * 7, *variance, *[math.nan] * 6]
        row += [logs.LOCAL_NED, logs.BODY_FRD, *values[7:9]]
    else:
        row = values
    return row + [0.0] * (logs.ROW - len(row))


# ------------------------------------------------------------------------------ ULog

_DOWNWARD = 25  # distance_sensor: ROTATION_DOWNWARD_FACING
_ESTIMATED_FRAMES = {1: logs.LOCAL_NED, 2: logs.LOCAL_FRD, 3: logs.BODY_FRD}  # odometry's frames
_SHORT_READS = 1000
_VISION_PERIOD_US = 100_000.0  # us, of interpolated observations: EKF2 needs 200 ms or less


def _read_ulog(path: Path, data: bytes) -> FlightLog:
    name = str(path)
    try:
        # pyulog tells about damage on standard output
        with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
            ulog = ULog(_Bytes(data))
    except Exception as error:  # whatever damaged bytes do to the parser
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ReplayError(f"{name}: the ULog file is damaged: {reason}") from None
    topics: dict[str, Topic] = {}
    for dataset in sorted(ulog.data_list, key=lambda entry: entry.multi_id):
        topics.setdefault(dataset.name, dataset.data)
    notes: list[str] = []
    if ulog.file_corruption:
        notes.append("The file is damaged in places; what could be read was replayed.")
    parameters = _ulog_parameters(ulog, notes)
    try:
        with np.errstate(all="ignore"):
            samples, where = _ulog_samples(topics, parameters, notes)
            on_board = read_estimate(topics)
            start = read_start(topics, samples.of(logs.IMU)[0])
            limits = _range_limits(topics)
    except MissingFieldError as error:
        raise ReplayError(f"{name}: {error}") from None
    return FlightLog(
        path.name, _checked(samples, where, name), parameters, on_board, start, limits, tuple(notes)
    )


class _CutError(Exception):
    pass


class _Bytes(io.BytesIO):
    """A file that gives up when it is read beyond its end again and again.

    pyulog looks for the next message by going back from where one should have ended; in a
    file that is cut inside its definitions it does so for ever.
    """

    _beyond = 0

    def read(self, size: int | None = -1, /) -> bytes:
        """As `io.BytesIO.read`; raises `_CutError` at the thousandth short read."""
        data = super().read(size)
        if size is not None and len(data) < size:
            self._beyond += 1
            if self._beyond > _SHORT_READS:
                raise _CutError("it ends inside a message")
        return data


def _ulog_parameters(ulog: Any, notes: list[str]) -> Parameters:
    """The EKF2 parameters, those that another version of PX4 had left out."""
    from systems.estimators.ekf2.parameters import INDEX, NOT_BUILT

    own = {
        name: float(value) if isinstance(value, float) else int(value)
        for name, value in ulog.initial_parameters.items()
        if name.startswith("EKF2_") and isinstance(value, int | float) and math.isfinite(value)
    }
    unknown = sorted(name for name in own if name not in INDEX and name not in NOT_BUILT)
    if unknown:
        notes.append(f"Parameters of another PX4 version are not used: {', '.join(unknown)}.")
    return {name: value for name, value in own.items() if name in INDEX}


def _ulog_samples(
    topics: Mapping[str, Topic], parameters: Parameters, notes: list[str]
) -> tuple[SensorLog, list[str]]:
    blocks: list[tuple[int, str, np.ndarray, np.ndarray]] = []

    def add(kind: int, topic: str, arrival: np.ndarray, columns: list[np.ndarray]) -> None:
        rows = np.zeros((len(arrival), logs.ROW))
        filled = np.column_stack(columns)
        rows[:, : filled.shape[1]] = filled
        blocks.append((kind, topic, arrival, rows))

    imu = Fields(topics, "sensor_combined")
    if not imu:
        raise MissingFieldError("expected the topic sensor_combined, the IMU, found none")
    time = imu("timestamp")
    gyro_dt = imu("gyro_integral_dt") * 1e-6
    accel_dt = imu("accelerometer_integral_dt") * 1e-6
    bits = imu("accelerometer_clipping", default=0.0)
    clipping = [np.floor(bits / 2.0**axis) % 2.0 for axis in range(3)]
    turn = imu.vector("gyro_rad", 3) * gyro_dt[:, None]
    push = imu.vector("accelerometer_m_s2", 3) * accel_dt[:, None]
    add(logs.IMU, imu.name, time, [time, turn, push, gyro_dt, accel_dt, *clipping])

    gnss = Fields(topics, "vehicle_gps_position", "sensor_gps")
    by_arrival = False
    if gnss:
        by_arrival = _add_gnss(gnss, parameters, add)
    barometer = Fields(topics, "vehicle_air_data")
    if barometer:
        altitude = [sample_times(barometer), barometer("baro_alt_meter")]
        add(logs.BAROMETER, barometer.name, barometer("timestamp"), altitude)
    magnetometer = Fields(topics, "vehicle_magnetometer")
    if magnetometer:
        strength = [sample_times(magnetometer), magnetometer.vector("magnetometer_ga", 3)]
        add(logs.MAGNETOMETER, magnetometer.name, magnetometer("timestamp"), strength)
    ranging = Fields(topics, "distance_sensor")
    if ranging:
        down = ranging("orientation", default=_DOWNWARD) == _DOWNWARD
        columns = [ranging("timestamp"), ranging("current_distance")]
        columns.append(ranging("signal_quality", default=-1.0))
        add(logs.RANGE_FINDER, ranging.name, columns[0][down], [c[down] for c in columns])
    vision = Fields(topics, "vehicle_visual_odometry")
    if vision:
        _add_vision(vision, add)
    else:
        _add_fused_vision(topics, parameters, add, notes)
    landed = Fields(topics, "vehicle_land_detected")
    if landed:
        # what was true when the log began is known from its first sample on
        status_time = np.maximum(landed("timestamp"), time[0])
        flags = [status_time, landed("at_rest", default=0.0), 1.0 - landed("landed")]
        flags.append(landed("in_ground_effect", default=0.0))
        add(logs.STATUS, landed.name, status_time, flags)
    return _merged(blocks, by_arrival)


def _merged(
    blocks: list[tuple[int, str, np.ndarray, np.ndarray]], by_arrival: bool
) -> tuple[SensorLog, list[str]]:
    """All samples from a second before the IMU's first to its last, in order of arrival."""
    imu = blocks[0][2]
    kept = []
    for kind, topic, arrival, rows in blocks:
        own = (arrival >= imu[0] - 1e6) & (arrival <= imu[-1])
        repeated = np.append(np.diff(arrival) == 0.0, False) if kind == logs.STATUS else ~own
        own &= ~repeated
        kept.append((kind, topic, arrival[own], rows[own]))
    kinds = np.concatenate([np.full(len(t), kind, dtype=np.int64) for kind, _, t, _ in kept])
    arrivals = np.concatenate([t for _, _, t, _ in kept])
    where = [f"{topic} at {t * 1e-6:.3f} s" for _, topic, times, _ in kept for t in times]
    order = np.lexsort((kinds, arrivals))
    rows = np.concatenate([rows for *_, rows in kept])[order]
    return SensorLog(kinds[order], arrivals[order], rows, by_arrival), [where[i] for i in order]


def _add_gnss(gnss: Fields, parameters: Parameters, add: Any) -> bool:
    """Add GNSS samples; whether they are stamped with their arrival."""
    published = gnss("timestamp")
    by_arrival = (
        "EKF2_GPS_DELAY" in parameters or not (gnss("timestamp_sample", default=0) > 0).all()
    )
    if "latitude_deg" in gnss:
        place = [gnss("latitude_deg"), gnss("longitude_deg"), gnss("altitude_msl_m")]
    else:  # integers until 2023
        place = [gnss("lat") * 1e-7, gnss("lon") * 1e-7, gnss("alt") * 1e-3]
    dilution = np.hypot(gnss("hdop", default=0.0), gnss("vdop", default=0.0))
    columns = [
        published if by_arrival else sample_times(gnss),
        *place,
        *(gnss(f"vel_{axis}_m_s") for axis in "ned"),
        *(gnss(name) for name in ("eph", "epv", "s_variance_m_s", "fix_type", "satellites_used")),
        dilution,
        gnss("spoofing_state", default=0.0) == 3,  # PX4: detected
        np.zeros(len(published)),
    ]
    finite = np.isfinite(np.column_stack(columns)).all(axis=1)  # a receiver without a fix has NaN
    add(logs.GNSS, gnss.name, published[finite], [column[finite] for column in columns])
    return by_arrival


def _add_vision(vision: Fields, add: Any) -> None:
    """Add odometry; before 2022 it had other names (x, y, z, covariances)."""
    published = vision("timestamp")
    if "position[0]" in vision:
        position, velocity = vision.vector("position", 3), vision.vector("velocity", 3)
        variances = [
            vision.vector(f"{what}_variance", 3, default=math.nan)
            for what in ("position", "velocity", "orientation")
        ]
        frames = vision("pose_frame"), vision("velocity_frame", default=3.0)
        known = _ESTIMATED_FRAMES
    else:
        position = np.column_stack([vision(axis) for axis in "xyz"])
        velocity = np.column_stack([vision(f"v{axis}") for axis in "xyz"])
        pose = [vision(f"pose_covariance[{i}]", default=math.nan) for i in (0, 6, 11, 15, 18, 20)]
        speed = [vision(f"velocity_covariance[{i}]", default=math.nan) for i in (0, 6, 11)]
        variances = [np.column_stack(v) for v in (pose[:3], speed, pose[3:])]
        frames = vision("local_frame", default=0.0), vision("velocity_frame", default=0.0)
        known = {0: logs.LOCAL_NED, 1: logs.LOCAL_FRD, 3: logs.BODY_FRD}
    translated = []
    for frame in frames:
        codes = np.full(len(frame), float(logs.LOCAL_FRD))
        for code, own in known.items():
            codes[frame == code] = own
        translated.append(codes)
    columns = [
        sample_times(vision), position, velocity, vision.vector("q", 4), *variances, *translated,
        vision("reset_counter", default=0.0), np.clip(vision("quality", default=100.0), 0.0, 100.0),
    ]  # fmt: skip
    add(logs.EXTERNAL_VISION, vision.name, published, columns)


def _add_fused_vision(
    topics: Mapping[str, Topic], parameters: Parameters, add: Any, notes: list[str]
) -> None:
    """Without the camera's own topic: the observations that the filter on board logged.

    They were logged slower than the filter needs them, so they are interpolated.
    """
    position = Fields(topics, "estimator_aid_src_ev_pos")
    if not position:
        return
    delay = 1e3 * parameters.get("EKF2_EV_DELAY", 0.0)
    time = position("timestamp_sample")
    used, first = np.unique(time, return_index=True)
    if len(used) < 2 or not np.isfinite(used).all() or np.ptp(used) > 1e11 or used[0] <= 0:
        return
    grid = np.arange(used[0], used[-1], _VISION_PERIOD_US)

    def interpolated(topic: Fields, values: np.ndarray) -> np.ndarray:
        stamps, own = np.unique(topic("timestamp_sample"), return_index=True)
        return np.interp(grid, stamps, values[own])

    absent = np.full(len(grid), math.nan)
    north, east, variance_n, variance_e = (
        np.interp(grid, used, position(f"{what}[{i}]")[first])
        for what in ("observation", "observation_variance")
        for i in (0, 1)
    )
    down = variance_d = yaw = variance_yaw = absent
    height = Fields(topics, "estimator_aid_src_ev_hgt")
    if height:
        down, variance_d = (
            interpolated(height, height(name)) for name in ("observation", "observation_variance")
        )
    heading = Fields(topics, "estimator_aid_src_ev_yaw")
    if heading:
        yaw = interpolated(heading, np.unwrap(heading("observation")))
        variance_yaw = interpolated(heading, heading("observation_variance"))
    zeros = np.where(np.isfinite(yaw), 0.0, math.nan)
    arrival = grid + delay
    add(
        logs.EXTERNAL_VISION, position.name, arrival,
        [arrival, north, east, down, absent, absent, absent,
         np.cos(0.5 * yaw), zeros, zeros, np.sin(0.5 * yaw), variance_n, variance_e, variance_d,
         absent, absent, absent, zeros, zeros, variance_yaw,
         np.full(len(grid), float(logs.LOCAL_NED)), np.full(len(grid), float(logs.LOCAL_NED)),
         np.zeros(len(grid)), np.full(len(grid), 100.0)],
    )  # fmt: skip
    rate = 1e6 * (len(used) - 1) / (used[-1] - used[0])
    notes.append(
        "The log has no vehicle_visual_odometry: vision is what the filter on board logged of it, "
        f"{rate:.1f} a second, interpolated to {1e6 / _VISION_PERIOD_US:.0f} a second."
    )


def _range_limits(topics: Mapping[str, Topic]) -> tuple[float, float]:
    ranging = Fields(topics, "distance_sensor")
    if not ranging:
        return FlightLog.range_limits
    shortest = float(np.median(ranging("min_distance", default=0.1)))
    longest = float(np.median(ranging("max_distance", default=40.0)))
    return (shortest, longest) if 0.0 <= shortest < longest else FlightLog.range_limits

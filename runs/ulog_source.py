"""PX4's ULog: its topics, under the names of several versions, as samples in order of arrival."""

import contextlib
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog

from runs.flight_log import FlightLog, Parameters, ReplayError
from runs.log_checks import checked
from runs.on_board import read_estimate, read_start
from runs.ulog_fields import Fields, MissingFieldError, Topic, sample_times
from systems.estimators.ekf2.parameters import INDEX, NOT_BUILT
from systems.signals import sensor_log as logs
from systems.signals.sensor_log import SensorLog

_DOWNWARD = 25  # distance_sensor: ROTATION_DOWNWARD_FACING
_ESTIMATED_FRAMES = {1: logs.LOCAL_NED, 2: logs.LOCAL_FRD, 3: logs.BODY_FRD}  # odometry's frames
_SHORT_READS = 1000
_VISION_PERIOD_US = 100_000.0  # us, of interpolated observations: EKF2 needs 200 ms or less


def read_ulog(path: Path, data: bytes) -> FlightLog:
    """The log in the bytes of a ULog file; raises `ReplayError` if they hold none."""
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
    parameters = _parameters(ulog, notes)
    try:
        with np.errstate(all="ignore"):
            samples, where = _samples(topics, parameters, notes)
            on_board = read_estimate(topics)
            start = read_start(topics, samples.of(logs.IMU)[0])
            limits = _range_limits(topics)
    except MissingFieldError as error:
        raise ReplayError(f"{name}: {error}") from None
    return FlightLog(
        path.name, checked(samples, where, name), parameters, on_board, start, limits, tuple(notes)
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


def _parameters(ulog: Any, notes: list[str]) -> Parameters:
    """The EKF2 parameters, those that another version of PX4 had left out."""
    own = {
        name: float(value) if isinstance(value, float) else int(value)
        for name, value in ulog.initial_parameters.items()
        if name.startswith("EKF2_") and isinstance(value, int | float) and math.isfinite(value)
    }
    unknown = sorted(name for name in own if name not in INDEX and name not in NOT_BUILT)
    if unknown:
        notes.append(f"Parameters of another PX4 version are not used: {', '.join(unknown)}.")
    return {name: value for name, value in own.items() if name in INDEX}


def _samples(
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

"""A flight log through PX4's EKF2, at the speed of C.

`play` hands the filter every sample in the order of the log — all samples of one time
of arrival first, then one update — and records what it did. `diagrams.replay` does the
same with Drake's systems; both end in the same bits.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runs.flight_log import FlightLog, ReplayError
from systems.estimators.ekf2 import compiled, parameters
from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.fusion import covariance
from systems.estimators.ekf2.geometry import project
from systems.estimators.ekf2.output_predictor import output_position
from systems.estimators.ekf2.parameters import Defaults, ParameterError, Value
from systems.estimators.ekf2.warm_start import Start, with_start
from systems.estimators.ekf2.world_model import earth_field
from systems.signals import sensor_log as logs
from systems.signals.sensor_log import SensorLog

RESETS = ("rst_posNE", "rst_posD", "rst_velNE", "rst_velD", "rst_quat")
DELAYED_COLUMNS = (
    "t_arrival_us", "t_delayed_us", "dt_ekf_avg", "q0", "q1", "q2", "q3", "vn", "ve", "vd",
    "pn", "pe", "pd", "gbx", "gby", "gbz", "abx", "aby", "abz", "magn", "mage", "magd",
    "mbx", "mby", "mbz", "wn", "we", "terrain", *(f"P{i}" for i in range(at.ERRORS)),
    "lat_deg", "lon_deg", "alt_m", "control_status", "fault_status", "height_ref",
    "baro_bias", "gps_hgt_bias", "ev_hgt_bias", "ev_pos_bias_n", "ev_pos_bias_e",
    *RESETS, "hpos_valid",
)  # fmt: skip
OUTPUT_COLUMNS = (
    "t_us", "q0", "q1", "q2", "q3", "vn", "ve", "vd", "pn", "pe", "pd", "vert_pos_deriv",
    "unaided_yaw", "trk_ang", "trk_vel", "trk_pos", "ekf_updated", "lat_deg", "lon_deg", "alt_m",
)  # fmt: skip
AID_COLUMNS = (
    "t_arrival_us", "t_delayed_us", "source", "axis", "timestamp_sample_us", "observation",
    "obs_var", "innov", "innov_var", "test_ratio", "test_ratio_filtered", "innov_rejected",
    "fused", "time_last_fuse_us",
)  # fmt: skip
STATUS_COLUMN = DELAYED_COLUMNS.index("control_status")
_FIRST_BIAS = DELAYED_COLUMNS.index("baro_bias")
_FIRST_RESET = DELAYED_COLUMNS.index("rst_posNE")
_SOURCES = len(at.AID_NAMES)
_AXES = np.array(at.AID_AXES)
_ROWS_A_STEP = int(_AXES.sum())


def _kernel(function):
    """A compiled function, cached on disk until this file or the filter's sources change."""
    dispatcher = compiled.kernel(function)
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    dispatcher._cache._cache_file._source_stamp += own
    return dispatcher


@_kernel
def push(x, p, kind, row, gnss_delay):
    """Feed the filter one sample of a `SensorLog`; `gnss_delay` (us) is taken off a GNSS stamp."""
    if kind == logs.IMU:
        kernels.push_imu(x, p, row)
    elif kind == logs.GNSS:
        sample = row.copy()
        sample[0] -= gnss_delay
        kernels.push_gnss(x, p, sample)
    elif kind == logs.BAROMETER:
        kernels.push_barometer(x, p, row)
    elif kind == logs.MAGNETOMETER:
        kernels.push_magnetometer(x, p, row)
    elif kind == logs.RANGE_FINDER:
        kernels.push_range(x, p, row)
    elif kind == logs.EXTERNAL_VISION:
        kernels.push_external_vision(x, p, row)
    elif kind == logs.STATUS:
        kernels.push_status(x, p, row)
    else:
        kernels.set_in_air(x, row[1])


@_kernel
def record_delayed(x, arrival, row):
    """Write the state at the horizon as `DELAYED_COLUMNS`."""
    row[0], row[1], row[2] = arrival, x[at.TIME_DELAYED], x[at.DT_AVERAGE]
    to = 3
    for i in range(at.NOMINAL_SIZE):
        row[to + i] = x[i]
    to += at.NOMINAL_SIZE
    P = covariance(x)
    for i in range(at.ERRORS):
        row[to + i] = P[i, i]
    to += at.ERRORS
    row[to], row[to + 1] = np.degrees(x[at.LATITUDE]), np.degrees(x[at.LONGITUDE])
    row[to + 2] = x[at.ALTITUDE]
    for first, count, column in (
        (at.FLAGS, at.FLAG_COUNT, STATUS_COLUMN),
        (at.FAULTS, at.FAULT_COUNT, STATUS_COLUMN + 1),
    ):
        row[column] = 0.0
        for i in range(count):
            if x[first + i] != 0.0:
                row[column] += 2.0**i  # 51 bits, float64 has 53
    row[STATUS_COLUMN + 2] = x[at.HEIGHT_REFERENCE]
    to = _FIRST_BIAS
    for bias in (at.BIAS_BARO, at.BIAS_GNSS_HGT, at.BIAS_EV_HGT, at.BIAS_EV_NORTH, at.BIAS_EV_EAST):
        row[to] = x[bias + at.B_REPORTED]
        to += 1
    for counter in (
        at.R_POSITION_NE,
        at.R_POSITION_D,
        at.R_VELOCITY_NE,
        at.R_VELOCITY_D,
        at.R_QUATERNION,
    ):
        row[to] = x[counter]
        to += 1
    row[to] = 1.0 - x[at.HORIZONTAL_EXCEEDED]


@_kernel
def record_output(x, p, arrival, updated, row):
    """Write the output predictor's state as `OUTPUT_COLUMNS`."""
    row[0] = arrival
    for i in range(4):
        row[1 + i] = x[at.OUT_QUATERNION + i]
    for i in range(3):
        row[5 + i] = x[at.OUT_VELOCITY + i] - x[at.OUT_IMU_VELOCITY + i]
        row[13 + i] = x[at.OUT_TRACKING_ERROR + i]
    row[11] = x[at.OUT_VERTICAL + 1] - x[at.OUT_IMU_VELOCITY + 2]
    row[12] = x[at.OUT_UNAIDED_YAW]
    row[16] = updated
    latitude, longitude, altitude = output_position(x, p)
    row[17], row[18], row[19] = np.degrees(latitude), np.degrees(longitude), altitude
    if x[at.ORIGIN_SET]:
        origin = x[at.ORIGIN_LATITUDE], x[at.ORIGIN_LONGITUDE]
    else:
        origin = 0.0, 0.0
    row[8], row[9] = project(latitude, longitude, origin[0], origin[1])
    datum = x[at.ORIGIN_ALTITUDE]
    row[10] = (datum if np.isfinite(datum) else 0.0) - altitude


@_kernel
def record_aid(x, arrival, latest, rows):
    """Write an `AID_COLUMNS` row for each axis of each new observation; how many.

    `latest` holds the newest time stamp of each source, shape (sources,), changed in place.
    """
    count = 0
    for source in range(_SOURCES):
        aid = at.AID + source * at.A_SIZE
        if x[aid + at.A_TIME] == latest[source]:
            continue
        latest[source] = x[aid + at.A_TIME]
        for axis in range(_AXES[source]):
            row = rows[count]
            row[0], row[1], row[2], row[3] = arrival, x[at.TIME_DELAYED], source, axis
            row[4] = x[aid + at.A_TIME]
            for i in range(6):
                row[5 + i] = x[aid + at.A_OBSERVATION + axis * at.A_AXIS + i]
            row[11], row[12] = x[aid + at.A_REJECTED], x[aid + at.A_FUSED]
            row[13] = x[aid + at.A_LAST_FUSE]
            count += 1
    return count


@_kernel
def _play(x, p, kinds, arrivals, samples, gnss_delay, latest, delayed, output, aid, counts):
    steps = moves = observations = i = 0
    while i < kinds.size:
        arrival = arrivals[i]
        moved = False
        while i < kinds.size and arrivals[i] == arrival:
            push(x, p, kinds[i], samples[i], gnss_delay)
            moved |= kinds[i] == logs.IMU
            i += 1
        updated = kernels.update(x, p)
        if updated:
            record_delayed(x, arrival, delayed[steps])
            observations += record_aid(x, arrival, latest, aid[observations:])
            steps += 1
        if moved:
            record_output(x, p, arrival, updated, output[moves])
            moves += 1
    counts[0], counts[1], counts[2] = steps, moves, observations


@dataclass(frozen=True)
class Replay:
    """What the filter did with a log.

    Attributes
    ----------
    delayed : np.ndarray
        The state at the horizon after every filter step, shape (n, DELAYED_COLUMNS).
    output : np.ndarray
        The output predictor after every IMU sample, shape (m, OUTPUT_COLUMNS).
    aid : np.ndarray
        Every observation and axis, shape (k, AID_COLUMNS); the source is an index into
        `layout.AID_NAMES`.
    state : np.ndarray
        The filter's flat array at the end.
    """

    delayed: np.ndarray
    output: np.ndarray
    aid: np.ndarray
    state: np.ndarray

    def column(self, name: str) -> np.ndarray:
        """A column of `delayed`, shape (n,)."""
        return self.delayed[:, DELAYED_COLUMNS.index(name)]

    def flag(self, name: str) -> np.ndarray:
        """A control status flag at every filter step, shape (n,)."""
        bits = self.delayed[:, STATUS_COLUMN].astype(np.int64)
        return (bits >> at.FLAG_NAMES.index(name)) & 1 == 1

    def events(self) -> list[tuple[int, int, str, int]]:
        """Arrival (us), horizon (us), name and new value of each flag, reset or height reference.

        The first filter step is what changes are counted from.
        """
        names = [*at.FLAG_NAMES, *RESETS, "height_ref", "hpos_valid"]
        bits = self.delayed[:, STATUS_COLUMN].astype(np.int64)
        flags = (bits[:, None] >> np.arange(at.FLAG_COUNT)) & 1
        resets = self.delayed[:, _FIRST_RESET : _FIRST_RESET + len(RESETS) + 1]
        reference = self.column("height_ref")[:, None]
        values = np.hstack([flags, resets[:, :-1], reference, resets[:, -1:]]).astype(np.int64)
        changed = np.argwhere(np.diff(values, axis=0) != 0)
        return [
            (
                int(self.delayed[step + 1, 0]),
                int(self.delayed[step + 1, 1]),
                names[which],
                int(values[step + 1, which]),
            )
            for step, which in changed
        ]


def parameter_values(
    log: FlightLog, file: Path | None = None, overrides: Mapping[str, Value] | None = None
) -> dict[str, Value]:
    """The parameters of a replay: the log's, then a file's, then the overrides.

    Raises
    ------
    ReplayError
        If the file cannot be read or names something unknown.
    """
    values: dict[str, Value] = dict(log.parameters)
    try:
        if file is not None:
            values |= parameters.read_parameter_file(file)
        values |= parameters.checked(overrides or {})
    except ParameterError as error:
        raise ReplayError(str(error)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(f"{file}: cannot be read: {error}") from None
    return values


def parameter_array(
    log: FlightLog, values: Mapping[str, Value], defaults: Defaults = "module"
) -> np.ndarray:
    """The filter's parameters, with the earth's field where the log was flown.

    Raises
    ------
    ReplayError
        If the values do not fit together.
    """
    origin = log.samples.origin()
    field = None if origin is None else earth_field(float(origin[0]), float(origin[1]))
    try:
        return parameters.parameter_array(values, defaults, log.range_limits, field)
    except ParameterError as error:
        raise ReplayError(str(error)) from None


def gnss_delay(samples: SensorLog, p: np.ndarray) -> float:
    """What is taken off the stamps of GNSS samples (us)."""
    return 1e3 * float(p[prm.EKF2_GPS_DELAY]) if samples.gnss_by_arrival else 0.0


def initial_state(p: np.ndarray, start: Start | None = None) -> np.ndarray:
    """The filter's array before the first sample, empty or to be started from a state."""
    x = kernels.initialise(p)
    return x if start is None else with_start(x, start)


def play(samples: SensorLog, p: np.ndarray, start: Start | None = None) -> Replay:
    """Run the filter over a log.

    Parameters
    ----------
    samples : SensorLog
        All samples.
    p : np.ndarray
        From `parameter_array`.
    start : Start, optional
        The state to start from, e.g. that of the filter on board; by default it starts anew.
    """
    (replay,) = play_in_pieces(samples, p, [], start)
    return replay


def play_in_pieces(
    samples: SensorLog, p: np.ndarray, times: Sequence[float], start: Start | None = None
) -> Iterator[Replay]:
    """Run the filter over a log and stop in between, to look at all of its state.

    Parameters
    ----------
    samples, p, start
        As for `play`.
    times : sequence of float
        us, in order; a piece ends before the first arrival after each, the last one at the
        log's end.

    Yields
    ------
    Replay
        Of one piece; its `state` is the filter's own array, which the next piece goes on with.
    """
    x = initial_state(p, start)
    latest = np.zeros(_SOURCES)
    delay = gnss_delay(samples, p)
    ends = [*np.searchsorted(samples.arrivals, times, side="right"), len(samples.arrivals)]
    for first, last in zip([0, *ends], ends, strict=False):
        kinds = samples.kinds[first:last]
        moves = int(np.count_nonzero(kinds == logs.IMU))
        delayed = np.empty((moves, len(DELAYED_COLUMNS)))
        output = np.empty((moves, len(OUTPUT_COLUMNS)))
        aid = np.empty((moves * _ROWS_A_STEP, len(AID_COLUMNS)))
        counts = np.zeros(3, dtype=np.int64)
        _play(
            x, p, kinds, samples.arrivals[first:last], samples.rows[first:last], delay, latest,
            delayed, output, aid, counts,
        )  # fmt: skip
        steps, moves, observations = counts.tolist()
        yield Replay(delayed[:steps].copy(), output[:moves].copy(), aid[:observations].copy(), x)

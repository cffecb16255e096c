"""What a replay leaves behind: CSV tables, a ULog, and its distance from the on-board estimate."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from runs.flight_log import FlightLog
from runs.replay import AID_COLUMNS, DELAYED_COLUMNS, OUTPUT_COLUMNS, Replay
from runs.ulog import write_ulog
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.parameters import Value

_WHOLE = frozenset(
    ["source", "axis", "control_status", "fault_status", "height_ref", "hpos_valid",
     "innov_rejected", "fused", "ekf_updated"]
)  # fmt: skip
_EARTH_RADIUS = 6371000.0  # m, as PX4's local projection


def write_tables(folder: Path, replay: Replay) -> None:
    """Write `delayed.csv`, `output.csv`, `aid.csv` and `events.csv`.

    Their columns are those of the reference streams of PX4's EKF2; the rows are all filter
    steps, IMU samples and observations.
    """
    _write(folder / "delayed.csv", DELAYED_COLUMNS, replay.delayed)
    reference = OUTPUT_COLUMNS.index("lat_deg")  # the reference has no geodetic position
    _write(folder / "output.csv", OUTPUT_COLUMNS[:reference], replay.output[:, :reference])
    _write(folder / "aid.csv", AID_COLUMNS, replay.aid)
    events = ["t_arrival_us,t_delayed_us,event,value"]
    events += [",".join(map(str, event)) for event in replay.events()]
    (folder / "events.csv").write_text("\n".join(events) + "\n", encoding="utf-8")


def _write(path: Path, columns: Sequence[str], rows: np.ndarray) -> None:
    arrays = []
    for name, values in zip(columns, rows.T, strict=True):
        if name == "source":
            arrays.append(pa.array(np.array(at.AID_NAMES)[values.astype(int)]))
        elif name.endswith("_us") or name.startswith("rst_") or name in _WHOLE:
            arrays.append(pa.array(np.nan_to_num(values).astype(np.int64)))
        else:
            arrays.append(pa.array(values))
    options = pa.csv.WriteOptions(include_header=False, quoting_style="none")
    with path.open("wb") as file:
        file.write((",".join(columns) + "\n").encode())  # pyarrow would quote the names
        pa.csv.write_csv(pa.table(arrays, names=list(columns)), file, options)


def write_replay_ulog(path: Path, replay: Replay, parameters: dict[str, Value]) -> None:
    """Write the replayed estimates and innovations under PX4's topic names."""
    output, delayed, aid = replay.output, replay.delayed, replay.aid
    stamps = output[:, 0]
    column = OUTPUT_COLUMNS.index
    local = [
        (name, "f4", output[:, column(own)])
        for name, own in zip(
            ("x", "y", "z", "vx", "vy", "vz", "z_deriv", "unaided_heading"),
            ("pn", "pe", "pd", "vn", "ve", "vd", "vert_pos_deriv", "unaided_yaw"),
            strict=True,
        )
    ]
    states = delayed[:, DELAYED_COLUMNS.index("q0") : DELAYED_COLUMNS.index("terrain") + 1]
    first = DELAYED_COLUMNS.index("P0")
    topics: dict[str, np.ndarray] = {
        "vehicle_attitude": _topic(stamps, [("q", "f4", output[:, 1:5])]),
        "vehicle_local_position": _topic(stamps, local),
        "vehicle_global_position": _topic(
            stamps,
            [
                ("lat", "f8", output[:, 17]),
                ("lon", "f8", output[:, 18]),
                ("alt", "f4", output[:, 19]),
            ],
        ),
        "estimator_states": _topic(
            delayed[:, 0],
            [
                ("timestamp_sample", "u8", delayed[:, 1]),
                ("states", "f4", states),
                ("covariances", "f4", delayed[:, first : first + at.ERRORS]),
                ("n_states", "u1", np.full(len(delayed), states.shape[1])),
            ],
        ),
    }
    for source, (name, axes) in enumerate(zip(at.AID_NAMES, at.AID_AXES, strict=True)):
        rows = aid[aid[:, 2] == source]
        if not len(rows):
            continue
        rows = rows.reshape(-1, axes, len(AID_COLUMNS))
        fields = [("timestamp_sample", "u8", rows[:, 0, 4])]
        for index, field in enumerate(
            (
                "observation",
                "observation_variance",
                "innovation",
                "innovation_variance",
                "test_ratio",
            )
        ):
            values = rows[:, :, 5 + index]
            fields.append((field, "f4", values if axes > 1 else values[:, 0]))
        fields.append(("innovation_rejected", "?", rows[:, 0, 11]))
        fields.append(("fused", "?", rows[:, 0, 12]))
        topics[f"estimator_aid_src_{name}"] = _topic(rows[:, 0, 0], fields)
    write_ulog(path, topics, parameters, {"sys_name": "Plumbline", "ver_sw": "EKF2 replay"})


def _topic(stamps: np.ndarray, fields: Sequence[tuple[str, str, np.ndarray]]) -> np.ndarray:
    types = [("timestamp", "u8", ())] + [(name, kind, v.shape[1:]) for name, kind, v in fields]
    table = np.zeros(len(stamps), dtype=types)
    table["timestamp"] = stamps
    with np.errstate(over="ignore", invalid="ignore"):
        for name, _, values in fields:
            table[name] = values
    return table


def against_on_board(replay: Replay, log: FlightLog) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """How far the replay is from the on-board estimates, at their times.

    Returns
    -------
    dict
        "attitude" (deg, the angle, shape (n, 1)), "velocity" (m/s, NED) and "position" (m, NED),
        each with its times (s, shape (n,)); empty where the log has none. Positions are
        compared on the earth; they are NaN while only one of the two has an origin.
    """
    if log.on_board is None or len(replay.output) < 2:
        return {}
    ours = replay.output
    attitude, motion = log.on_board.attitude, log.on_board.motion
    reference = log.on_board.reference
    result = {}
    inside = (attitude[:, 0] >= ours[0, 0]) & (attitude[:, 0] <= ours[-1, 0])
    if inside.any():
        theirs = attitude[inside]
        newest = np.searchsorted(ours[:, 0], theirs[:, 0], side="right") - 1
        dot = np.abs(np.sum(theirs[:, 1:] * ours[newest, 1:5], axis=1))
        dot /= np.linalg.norm(theirs[:, 1:], axis=1) * np.linalg.norm(ours[newest, 1:5], axis=1)
        angle = np.degrees(2.0 * np.arccos(np.clip(dot, 0.0, 1.0)))
        result["attitude"] = theirs[:, 0] * 1e-6, angle[:, None]
    inside = (motion[:, 0] >= ours[0, 0]) & (motion[:, 0] <= ours[-1, 0])
    if inside.any():
        theirs, origin = motion[inside], reference[inside]
        at_time = [np.interp(theirs[:, 0], ours[:, 0], ours[:, i]) for i in range(20)]
        time = theirs[:, 0] * 1e-6
        velocity = np.column_stack(at_time[5:8]) - theirs[:, 1:4]
        # without an origin both count latitude and longitude from zero
        known = np.isfinite(origin).all(axis=1)
        ours_known = np.abs(at_time[17]) > 1e-2
        origin = np.where(known[:, None], origin, 0.0)
        north = np.radians(at_time[17] - origin[:, 0]) * _EARTH_RADIUS
        east = np.radians(at_time[18] - origin[:, 1]) * _EARTH_RADIUS
        east *= np.cos(np.radians(origin[:, 0]))
        position = np.column_stack([north, east, origin[:, 2] - at_time[19]]) - theirs[:, 4:7]
        position[known != ours_known] = np.nan
        result["velocity"], result["position"] = (time, velocity), (time, position)
    return result

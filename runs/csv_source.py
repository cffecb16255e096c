"""CSV streams of sensor samples: a line a sample, in order of arrival."""

import csv
import io
import math
from pathlib import Path

import numpy as np

from runs.flight_log import FlightLog, ReplayError
from runs.log_checks import checked
from systems.signals import sensor_log as logs
from systems.signals.sensor_log import SensorLog

_HEADER = ("t_arrival_us", "type", "t_stamp_us")
# Kind of each type and how many values it must have.
_TYPES = {
    "imu": (logs.IMU, 8),
    "mag": (logs.MAGNETOMETER, 3),
    "baro": (logs.BAROMETER, 1),
    "gps": (logs.GNSS, 12),
    "ev": (logs.EXTERNAL_VISION, 8),
    "range": (logs.RANGE_FINDER, 2),
    "flags": (logs.STATUS, 3),
    "in_air_direct": (logs.IN_AIR, 1),
}


def read_csv(path: Path, data: bytes) -> FlightLog:
    """The log in the bytes of a CSV file; raises `ReplayError` if they are none."""
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
        for column in (*_HEADER, "v0"):
            if header.count(column) != 1:
                raise ReplayError(
                    f"{name}, line 1: expected the columns {', '.join(_HEADER)}, v0, v1 …; "
                    f"{column} is {'missing' if column not in header else 'there twice'}"
                )
        at_arrival, at_type, at_stamp = (header.index(column) for column in _HEADER)
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
            kind, count = _type(cells[at_type].strip(), f"{name}, {line}")
            if count > len(at_values):
                raise ReplayError(
                    f"{name}, line 1: expected columns up to v{count - 1} for {cells[at_type]}"
                )
            columns = [at_arrival, at_stamp, *at_values[:count]]
            numbers = [_number(cells[c], header[c], f"{name}, {line}") for c in columns]
            kinds.append(kind)
            arrivals.append(numbers[0])
            rows.append(_row(kind, numbers[1:]))
            lines.append(line)
    except csv.Error as error:
        raise ReplayError(f"{name}, line {reader.line_num}: is not CSV: {error}") from None
    if not rows:
        raise ReplayError(f"{name}: holds no samples")
    samples = SensorLog(np.array(kinds, dtype=np.int64), np.array(arrivals), np.array(rows))
    return FlightLog(path.name, checked(samples, lines, name))


def _type(name: str, where: str) -> tuple[int, int]:
    if name not in _TYPES:
        raise ReplayError(f"{where}: expected a type of {', '.join(_TYPES)}, not {name!r}")
    return _TYPES[name]


def _number(text: str, column: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ReplayError(f"{where}, {column}: expected a number, not {text!r}") from None
    if not math.isfinite(value):
        raise ReplayError(f"{where}, {column}: expected a finite number, not {text}")
    return value


def _row(kind: int, values: list[float]) -> list[float]:
    """The row of a sample, from its time stamp and values."""
    if kind == logs.EXTERNAL_VISION:
        stamp, position, variance = values[0], values[1:4], values[4:7]
        row = [stamp, *position, *[math.nan] * 7, *variance, *[math.nan] * 6]
        row += [logs.LOCAL_NED, logs.BODY_FRD, *values[7:9]]
    else:
        row = values
    return row + [0.0] * (logs.ROW - len(row))

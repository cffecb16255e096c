"""Reading flight logs: CSV streams and PX4's ULog, into one table in order of arrival.

A log that cannot be replayed ends in a `ReplayError`, one sentence that names the
file, the line or topic, and what was expected.
"""

import gzip
import zlib
from pathlib import Path

from runs.csv_source import read_csv
from runs.flight_log import FlightLog, ReplayError
from runs.ulog_source import read_ulog


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
        return read_ulog(path, data)
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (EOFError, OSError, zlib.error) as error:
            raise ReplayError(f"{path}: the gzip file is damaged or cut: {error}") from None
    return read_csv(path, data)

"""`log.parquet`: every recorded port of a run in one table.

One row a time at which anything was recorded, one column `port.field` an entry;
a column is null where its port has no sample at that time. With pandas a single
port is `log.filter(like="estimate.").dropna()`.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from diagrams.recording import Recording


def log_table(
    recording: Recording, samples: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> pa.Table:
    """The table of a run.

    Parameters
    ----------
    recording : Recording
        Names the fields of each port.
    samples : mapping
        Port name to times (n,) and values (n, size), from `Recording.samples`.
    """
    times = np.unique(np.concatenate([port_times for port_times, _ in samples.values()]))
    columns: dict[str, pa.Array] = {"time": pa.array(times)}
    for port in recording.ports:
        port_times, values = samples[port.name]
        rows = np.searchsorted(times, port_times)
        absent = np.ones(len(times), dtype=bool)
        absent[rows] = False
        for index, field in enumerate(port.fields):
            column = np.zeros(len(times))
            column[rows] = values[:, index]
            columns[f"{port.name}.{field}"] = pa.array(column, mask=absent)
    return pa.table(columns)


def write_log(table: pa.Table, path: Path) -> None:
    """Write `log.parquet`; the same table gives the same bytes."""
    pq.write_table(table, path, compression="zstd", write_statistics=False)


def read_log(path: Path) -> pa.Table:
    """Read a `log.parquet`."""
    return pq.read_table(path)


def port_samples(table: pa.Table, port: str) -> dict[str, np.ndarray]:
    """The samples of one port: `time` and each field, shape (n,); raises `KeyError`."""
    prefix = port + "."
    names = [name for name in table.column_names if name.startswith(prefix)]
    if not names:
        known = sorted({n.partition(".")[0] for n in table.column_names if "." in n})
        raise KeyError(f"the log has no port {port!r}, only {', '.join(known)}")
    selected = table.select(["time", *names])
    selected = selected.filter(pa.compute.is_valid(selected[names[0]]))
    return {name.removeprefix(prefix): selected[name].to_numpy() for name in selected.column_names}

"""Where a campaign's rows are kept: each run once, whatever is killed and when.

A campaign's folder holds

* `ledger.sqlite`: the study, the number of runs, and which run lies in which shard;
* `shards/`: finished rows in Parquet files of a few dozen;
* `runs.parquet`, `timings.parquet`: all rows, sorted by run number.

One process writes. A shard is written under a temporary name, flushed to the
disk and renamed; only then does one SQLite transaction enter its runs, whose
number is the primary key. So a run is either entered, and its row is safe, or it is
flown again; a shard that was renamed but not entered is forgotten. Exactly
once does not depend on the executor.

`runs.parquet` is a pure function of the study and the number of runs, to the
byte. What differs from time to time (seconds, who flew it) is in `timings.parquet`.
"""

import contextlib
import errno
import hashlib
import json
import os
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from studies.provenance import provenance, scenario_digest
from studies.study import Study, StudyError

Row = dict[str, bool | int | float | str]

# Columns of every row that depend on who flew it and when.
TIMING_COLUMNS = ("cpu_seconds", "wall_seconds", "worker")
FIRST_COLUMNS = ("run", "pair", "condition", "variant")
LAST_COLUMNS = ("seed", "status", "failure")

_SCHEMA = """
CREATE TABLE study (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE shards (name TEXT PRIMARY KEY, digest TEXT NOT NULL);
CREATE TABLE runs (run INTEGER PRIMARY KEY, shard TEXT NOT NULL REFERENCES shards (name));
"""
_FORMAT = "1"  # of the ledger, for those who read it in ten years


class Ledger:
    """The rows of one campaign in one folder; a context manager.

    Made by `create` or `open`, which hold the folder against other writers until `close`.
    """

    def __init__(self, folder: Path, connection: sqlite3.Connection):
        self.folder = folder
        self._connection = connection

    @classmethod
    def create(cls, folder: Path, study: Study, runs: int) -> "Ledger":
        """Begin a campaign in `folder`, or go on with the same study there.

        Raises
        ------
        StudyError
            The folder cannot be written, holds another study or other files, or is in use.
        """
        with _disk(folder, "cannot be made a folder for a campaign"):
            (folder / "shards").mkdir(parents=True, exist_ok=True)
        ledger = cls(folder, _connect(folder))
        try:
            if ledger._has_begun():
                ledger._go_on()
                if ledger.study.digest != study.digest:
                    raise StudyError(
                        f"{folder} holds another campaign of the study {ledger.study.name} "
                        "(its definition or seed differs): choose another folder"
                    )
                with ledger._transaction() as sql:
                    _put(sql, study=study.to_json(), runs=str(max(runs, ledger.runs)))
            else:
                ledger._begin(study, runs)
        except BaseException:
            ledger.close()
            raise
        return ledger

    @classmethod
    def open(cls, folder: Path) -> "Ledger":
        """Go on with the campaign in `folder`.

        Shards that are missing or damaged are forgotten, so their runs are flown
        again; raises `StudyError` where there is no campaign.
        """
        if not (folder / "ledger.sqlite").is_file():
            raise StudyError(f"{folder}: there is no campaign here (no ledger.sqlite)")
        ledger = cls(folder, _connect(folder))
        try:
            if not ledger._has_begun():
                raise StudyError(f"{folder}: the campaign here was killed before it began")
            ledger._go_on()
        except BaseException:
            ledger.close()
            raise
        return ledger

    def __enter__(self) -> "Ledger":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder."""
        self._connection.close()

    @property
    def study(self) -> Study:
        """The study as it was begun."""
        return Study.from_json(self._get("study"))

    @property
    def runs(self) -> int:
        """How many runs the campaign is to have."""
        return int(self._get("runs"))

    @property
    def provenance(self) -> dict[str, str]:
        """The versions and the digest of the source that fly the runs."""
        return json.loads(self._get("provenance"))

    def require_same_provenance(self) -> None:
        """Raise `StudyError` if this machine would not fly the runs as they were begun."""
        begun, here = self.provenance, _provenance(self.study)
        differing = [key for key in begun if begun[key] != here.get(key)]
        if differing:
            what = ", ".join(
                key if len(begun[key]) > 20 else f"{key} {begun[key]} (here {here.get(key)})"
                for key in differing
            )
            raise StudyError(
                f"{self.folder} was begun with other code ({what} differs), and its runs would "
                "not be comparable: begin anew in another folder, or accept the changed code"
            )

    def accept_provenance(self) -> None:
        """Enter this machine's versions and source as those of the campaign."""
        with self._transaction() as sql:
            _put(sql, provenance=json.dumps(_provenance(self.study)))

    def done(self) -> set[int]:
        """The numbers of the runs whose rows are safe."""
        return {run for (run,) in self._rows("SELECT run FROM runs")}

    def commit(self, rows: Sequence[Row]) -> None:
        """Keep the rows of finished runs.

        Raises
        ------
        StudyError
            The disk is full or cannot be written, or a run is entered twice.
        """
        name = f"{rows[0]['run']:08d}-{rows[-1]['run']:08d}-{os.urandom(4).hex()}.parquet"
        data = _parquet_bytes(_table(rows))
        write_durably(self.folder / "shards" / name, data)
        with self._transaction() as sql:
            sql.execute("INSERT INTO shards VALUES (?, ?)", (name, _digest(data)))
            sql.executemany("INSERT INTO runs VALUES (?, ?)", [(row["run"], name) for row in rows])

    def table(self) -> pa.Table:
        """All finished rows with all their columns, sorted by run number."""
        shards = [name for (name,) in self._rows("SELECT name FROM shards ORDER BY name")]
        if not shards:
            return _table([])
        with _disk(self.folder, "cannot be read"):
            tables = [pq.read_table(self.folder / "shards" / name) for name in shards]
        try:
            table = pa.concat_tables(tables, promote_options="permissive")
        except pa.ArrowException as error:
            raise StudyError(f"the experiment mixes kinds of values: {error}") from None
        return table.sort_by("run").combine_chunks()

    def finish(self) -> pa.Table:
        """Write `runs.parquet` and `timings.parquet` of all finished rows; returns the former.

        Columns: numbers and names of the run, what was varied, what was measured
        (the study's measures first), its seed and how it ended.
        """
        study, table = self.study, self.table()
        volatile = {*TIMING_COLUMNS, *study.volatile}
        varied = [path for path in study.varied_paths() if path in table.column_names]
        placed = {*FIRST_COLUMNS, *varied, *LAST_COLUMNS, *volatile}
        results = [name for name in study.measures.columns() if name in table.column_names]
        results += sorted(set(table.column_names) - placed - set(results))
        runs = table.select([*FIRST_COLUMNS, *varied, *results, *LAST_COLUMNS])
        runs = runs.replace_schema_metadata({"study": study.canonical})
        timings = table.select(["run", *sorted(volatile & set(table.column_names))])
        write_durably(self.folder / "runs.parquet", _parquet_bytes(runs))
        write_durably(self.folder / "timings.parquet", _parquet_bytes(timings))
        return runs

    def _has_begun(self) -> bool:
        return bool(self._rows("SELECT name FROM sqlite_schema WHERE name = 'study'"))

    def _begin(self, study: Study, runs: int) -> None:
        with self._transaction() as sql:
            for statement in _SCHEMA.split(";"):
                sql.execute(statement)
            _put(
                sql,
                format=_FORMAT,
                study=study.to_json(),
                runs=str(runs),
                provenance=json.dumps(_provenance(study)),
            )

    def _go_on(self) -> None:
        if self._get("format") != _FORMAT:
            raise StudyError(f"{self.folder}: the ledger has a format unknown to this version")
        self._forget_damaged_shards()

    def _forget_damaged_shards(self) -> None:
        kept = set()
        for name, digest in self._rows("SELECT name, digest FROM shards"):
            file = self.folder / "shards" / name
            if file.is_file() and _digest(file.read_bytes()) == digest:
                kept.add(name)
                continue
            with self._transaction() as sql:
                sql.execute("DELETE FROM runs WHERE shard = ?", (name,))
                sql.execute("DELETE FROM shards WHERE name = ?", (name,))
        for file in (self.folder / "shards").glob("*"):
            if file.name not in kept:
                file.unlink()

    def _get(self, key: str) -> str:
        rows = self._rows("SELECT value FROM study WHERE key = ?", key)
        if not rows:
            raise StudyError(f"{self.folder}: the ledger is damaged: it does not say {key}")
        value: str = rows[0][0]
        return value

    def _rows(self, query: str, *parameters: object) -> list[tuple[Any, ...]]:
        with _database(self.folder):
            return self._connection.execute(query, parameters).fetchall()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """All statements of the block, or none, on the disk when it ends."""
        with _database(self.folder):
            self._connection.execute("BEGIN IMMEDIATE")
            with self._connection:
                yield self._connection


def write_durably(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, and safe from a crash once this returns."""
    temporary = path.with_name(f".{path.name}.part")
    with _disk(path.parent, "cannot be written"):
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _connect(folder: Path) -> sqlite3.Connection:
    with _database(folder):
        connection = sqlite3.connect(folder / "ledger.sqlite", timeout=0.5, isolation_level=None)
        try:
            # One writer at a time: the lock is taken by the first statement and the
            # operating system gives it back when the process ends, however it ends.
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("BEGIN EXCLUSIVE")
            connection.execute("COMMIT")
        except BaseException:
            connection.close()
            raise
    return connection


def _put(sql: sqlite3.Connection, **values: str) -> None:
    sql.executemany("INSERT OR REPLACE INTO study VALUES (?, ?)", list(values.items()))


def _provenance(study: Study) -> dict[str, str]:
    return provenance() | {"scenario": scenario_digest(study.scenario)}


def _table(rows: Sequence[Row]) -> pa.Table:
    names = list(dict.fromkeys(name for row in rows for name in row))
    names = names or [*FIRST_COLUMNS, *LAST_COLUMNS, *TIMING_COLUMNS]
    columns = {}
    for name in names:
        try:
            columns[name] = pa.array([row.get(name) for row in rows])
        except (pa.ArrowException, OverflowError):
            kinds = sorted({type(row[name]).__name__ for row in rows if name in row})
            raise StudyError(
                f"the experiment's column {name} mixes kinds of values: {', '.join(kinds)}"
            ) from None
    return pa.table(columns)


def _parquet_bytes(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    data: bytes = sink.getvalue().to_pybytes()
    return data


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


@contextlib.contextmanager
def _disk(folder: Path, trouble: str) -> Iterator[None]:
    """Errors of the file system as one sentence."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise StudyError(_full(folder)) from error
        raise StudyError(f"{folder} {trouble}: {error.strerror or error}") from error


@contextlib.contextmanager
def _database(folder: Path) -> Iterator[None]:
    """Errors of SQLite as one sentence."""
    try:
        yield
    except sqlite3.IntegrityError as error:
        raise StudyError(f"{folder}: a run was about to be entered twice ({error})") from error
    except sqlite3.Error as error:
        if "locked" in str(error):
            raise StudyError(f"{folder} is in use by another campaign") from error
        if "full" in str(error) or "disk I/O" in str(error):
            raise StudyError(_full(folder)) from error
        raise StudyError(f"{folder}/ledger.sqlite cannot be used: {error}") from error


def _full(folder: Path) -> str:
    return (
        f"{folder}: no space left on the disk; every run entered so far is kept: make room "
        "and resume"
    )

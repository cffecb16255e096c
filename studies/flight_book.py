"""Flights on demand, each flown once: what a search asks for, generation by generation.

A search (for the mildest disturbance, say) is a pure function of its question
and of the flights it asks for. So it is resumed by asking again: the book gives what it has from
`flights.jsonl` and has the rest flown, by the same executors as a campaign.
"""

import fcntl
import itertools
import json
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from studies.executors import Executor, execute
from studies.ledger import Row
from studies.provenance import provenance, scenario_digest
from studies.seeded_landing import SEED
from studies.study import Study, StudyError, Variant

EXPERIMENT = "studies.seeded_landing:SeededLanding"
_BATCH = 50  # flights of one study: it is asked for each by number

Overrides = Mapping[str, Any]


class InterruptedSearchError(Exception):
    """Ctrl-C or SIGTERM: what was flown is in the book."""


class FlightBook:
    """The flights of one scenario in one folder; a context manager.

    Parameters
    ----------
    folder : Path
        Where `flights.jsonl` is, or will be: a line of provenance, then a line a flight.
    scenario : str
        A name or a path.
    base : mapping
        Overrides of every flight.
    executor : Executor
        Who flies what is not in the book.
    budget : int
        Flights that may be asked for; `left` counts down, `fly` does not refuse.
    stopping : threading.Event, optional
        Once set, `fly` raises `InterruptedSearchError`.
    progress : bool
        Show a progress bar on the terminal.
    experiment : str
        The import path of what flies.

    Raises
    ------
    StudyError
        The folder cannot be written, is in use, or its flights are of another scenario or code.
    """

    def __init__(
        self,
        folder: Path,
        scenario: str,
        base: Overrides,
        executor: Executor,
        budget: int,
        stopping: threading.Event | None = None,
        progress: bool = True,
        experiment: str = EXPERIMENT,
    ):
        self.scenario, self.base, self.budget = scenario, dict(base), budget
        self._executor, self._stopping, self._experiment = executor, stopping, experiment
        self._asked: dict[str, Row] = {}
        self._known: dict[str, Row] = {}
        self._open(folder)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(file=sys.stderr),
            disable=not progress,
        )
        self._task = self._bar.add_task("flights", total=budget, note="")
        self._bar.start()

    def __enter__(self) -> "FlightBook":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        self._file.close()

    @property
    def asked(self) -> int:
        """How many different flights have been asked for, flown now or before."""
        return len(self._asked)

    @property
    def left(self) -> int:
        """How many more may be asked for."""
        return self.budget - self.asked

    def note(self, text: str) -> None:
        """Say something beside the progress bar."""
        self._bar.update(self._task, note=text)

    def fly(self, flights: Sequence[tuple[Overrides, int]]) -> list[Row]:
        """The rows of some flights, in order: overrides on top of the base, and the seed."""
        asked = [{**self.base, **overrides, SEED: seed} for overrides, seed in flights]
        keys = [json.dumps(flight, sort_keys=True) for flight in asked]
        wanted = {
            key: flight for key, flight in zip(keys, asked, strict=True) if key not in self._known
        }
        self._see(key for key in keys if key in self._known)
        for start in range(0, len(wanted), _BATCH):
            self._fly(dict(itertools.islice(wanted.items(), start, start + _BATCH)))
        return [self._known[key] for key in keys]

    def _fly(self, wanted: dict[str, dict[str, Any]]) -> None:
        names = {f"flight {index}": key for index, key in enumerate(wanted)}
        study = Study(
            name="search",
            scenario=self.scenario,
            experiment=self._experiment,
            variants={name: Variant(overrides=wanted[key]) for name, key in names.items()},
        )

        def commit(rows: list[Row]) -> None:
            for row in rows:
                self._keep(names[str(row["variant"])], row)
            self._see(names[str(row["variant"])] for row in rows)

        execute(self._executor, study, range(len(names)), commit, self._stopping)
        if self._stopping is not None and self._stopping.is_set():
            raise InterruptedSearchError

    def _see(self, keys: Any) -> None:
        self._asked.update((key, self._known[key]) for key in keys)
        self._bar.update(self._task, completed=min(self.asked, self.budget))

    def _keep(self, key: str, row: Row) -> None:
        self._known[key] = row
        self._write({"flight": json.loads(key), "row": row})

    def _write(self, entry: Any) -> None:
        self._file.write(json.dumps(entry).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def _open(self, folder: Path) -> None:
        path = folder / "flights.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a+b")
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StudyError(f"{folder} is in use by another search") from None
        except OSError as error:
            raise StudyError(f"{folder}: cannot be written: {error.strerror}") from None
        begun = {
            "scenario": self.scenario,
            "experiment": self._experiment,
            **provenance(),
            "file": scenario_digest(self.scenario),
        }
        self._file.seek(0)
        lines = self._file.read().splitlines(keepends=True)
        if lines and lines[-1][-1:] != b"\n":  # torn by a crash
            self._file.truncate(sum(map(len, lines[:-1])))
            lines = lines[:-1]
        if not lines:
            self._write(begun)
            return
        try:
            entries = [json.loads(line) for line in lines]
            before = entries[0]
            self._known = {
                json.dumps(entry["flight"], sort_keys=True): entry["row"] for entry in entries[1:]
            }
        except (ValueError, KeyError, TypeError):
            raise StudyError(f"{path}: is damaged: choose another folder") from None
        if differing := [key for key in begun if before.get(key) != begun[key]]:
            raise StudyError(
                f"{folder} was begun with another {' and '.join(differing)}, and its flights "
                "would not be comparable: choose another folder"
            )

"""Fly a study: the functions behind `plumbline study`.

result = run_study("infrared-and-marker", Path("out/study"), runs=1300)
result.table.groupby("variant").landing_error_m.median()
"""

import dataclasses
import difflib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import pandas as pd
import pyarrow.parquet as pq
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from studies.executors import execute, make_executor
from studies.ledger import Ledger, Row
from studies.study import RunSpec, Study, StudyError, load_study, study_names


@dataclass(frozen=True)
class StudyResult:
    """What a campaign has come to."""

    folder: Path  # runs.parquet, timings.parquet, summary.json, summary.md, report.html
    study: Study
    runs: int  # asked for
    done: int  # flown and stored
    summary: dict[str, Any]  # the content of summary.json

    @property
    def complete(self) -> bool:
        """Whether every run asked for is there; if not, `resume` flies the rest."""
        return self.done == self.runs

    @property
    def table(self) -> pd.DataFrame:
        """One row a run, as in runs.parquet."""
        return pq.read_table(self.folder / "runs.parquet").to_pandas()


def run_study(
    study: Study | str | Path,
    folder: Path | str,
    runs: int | None = None,
    workers: int | None = None,
    seed: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
) -> StudyResult:
    """Fly a study into a folder, or go on with the same study there.

    Parameters
    ----------
    study : Study, str or Path
        A study, the name of one of the laboratory's, or the path of a YAML file.
    folder : Path or str
        Where everything is written; a campaign that is already there must be of the same
        definition and seed, and grows if more runs are asked for.
    runs : int, optional
        How many, of all conditions together (default: the study's own number).
    workers : int, optional
        Processes; 0 flies in this one (default: one a core).
    seed : int, optional
        Of the whole campaign (default: the study's own).
    scheduler : str, optional
        The address of a Dask scheduler, whose workers then fly.
    progress : bool
        Show a progress bar on the terminal.

    Returns
    -------
    StudyResult
        Not `complete` after Ctrl-C or SIGTERM: what is finished is stored and summarised.

    Raises
    ------
    StudyError
        In one sentence for the user.
    """
    if not isinstance(study, Study):
        study = load_study(study)
    if seed is not None:
        study = dataclasses.replace(study, seed=seed)
    if runs is not None and runs < 1:
        raise StudyError(f"expected 1 or more runs, found {runs}")
    _require_published(study)
    with Ledger.create(Path(folder), study, runs or study.runs) as ledger:
        ledger.require_same_provenance()
        return _fly(ledger, workers, scheduler, progress)


def resume(
    folder: Path | str,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
    changed_code: bool = False,
) -> StudyResult:
    """Fly what is left of the campaign in `folder`; parameters as in `run_study`.

    Parameters
    ----------
    changed_code : bool
        Accept that the runs before were flown with other versions or source.
    """
    with Ledger.open(Path(folder)) as ledger:
        if changed_code:
            ledger.accept_provenance()
        ledger.require_same_provenance()
        return _fly(ledger, workers, scheduler, progress)


def summarise_again(folder: Path | str) -> StudyResult:
    """Write the tables, the summary and the report of a campaign anew, flying nothing.

    Where the laboratory's study of that name still flies the same, its present texts, measures
    and layout are taken.
    """
    with Ledger.open(Path(folder)) as ledger:
        study = ledger.study
        if study.name in study_names() and load_study(study.name).digest == study.digest:
            study = load_study(study.name)
        return _write(ledger, study)


def read_run(reference: Path | str) -> tuple[Study, RunSpec]:
    """The study and the exact run of ``FOLDER/NUMBER``, to fly it once more.

    Raises
    ------
    StudyError
        There is no campaign in the folder, or it has no such run.
    """
    path = Path(reference)
    if not path.name.isdecimal():
        raise StudyError(f"{reference}: expected FOLDER/NUMBER, a campaign's folder and a run")
    with Ledger.open(path.parent) as ledger:
        if int(path.name) >= ledger.runs:
            raise StudyError(f"{path.parent} has runs 0 to {ledger.runs - 1}, but no {path.name}")
        study = ledger.study
        return study, study.run_spec(int(path.name))


def default_workers() -> int:
    """One worker for each core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _require_published(study: Study) -> None:
    """Raise `StudyError` now rather than when the last run has landed."""
    for name, variant in study.variants.items():
        if variant.published is not None:
            from studies.published import PUBLISHED

            if variant.published not in PUBLISHED:
                close = difflib.get_close_matches(variant.published, PUBLISHED, n=1, cutoff=0.0)
                raise StudyError(
                    f"study {study.name}: variants.{name}.published: there are no published "
                    f"trials {variant.published}; the nearest is {close[0]}"
                )


def _fly(ledger: Ledger, workers: int | None, scheduler: str | None, progress: bool) -> StudyResult:
    study, done = ledger.study, ledger.done()
    left = [run for run in range(ledger.runs) if run not in done]
    if left:
        count = default_workers() if workers is None else workers
        with (
            closing(make_executor(count, scheduler)) as executor,
            stop_on_signal() as stopping,
            _progress(study, ledger.runs, len(done), progress) as advance,
        ):

            def commit(rows: list[Row]) -> None:
                ledger.commit(rows)
                advance(rows)

            execute(executor, study, left, commit, stopping)
    return _write(ledger)


def _write(ledger: Ledger, study: Study | None = None) -> StudyResult:
    # Imported when there is something to draw: scipy and matplotlib take a second to load.
    from studies.report import write_report
    from studies.summary import summarise

    study, runs = study or ledger.study, ledger.runs
    table = ledger.finish()
    summary = summarise(study, table.to_pandas(), runs, ledger.folder)
    write_report(study, table.to_pandas(), summary, ledger.folder)
    return StudyResult(ledger.folder, study, runs, table.num_rows, summary)


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets; a second Ctrl-C interrupts at once."""
    stopping = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopping
        return

    def handle(number: int, _: FrameType | None) -> None:
        if stopping.is_set():
            raise KeyboardInterrupt
        stopping.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopping
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Rate(TextColumn):
    """Runs a second."""

    def __init__(self) -> None:
        super().__init__("")

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.3g} runs/s" if speed else "", style="progress.data.speed")


@contextmanager
def _progress(study: Study, runs: int, done: int, wanted: bool) -> Iterator[Any]:
    """A function that takes the rows of a chunk and moves the bar on."""
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[failed]}"),
        console=Console(file=sys.stderr),
        disable=not wanted,
    )
    failed = 0
    with bar:
        task = bar.add_task(study.name, total=runs, completed=done, failed="")

        def advance(rows: list[Row]) -> None:
            nonlocal failed
            failed += sum(row["status"] == "failed" for row in rows)
            text = f"[red]{failed} failed" if failed else ""
            bar.update(task, advance=len(rows), failed=text)

        yield advance

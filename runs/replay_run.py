"""A replay with its folder: read, run, then write tables, `log.ulg` and `report.html`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from rich.progress import Progress

from runs.flight_log import ReplayError
from runs.log_sources import read_log
from runs.replay import parameter_array, parameter_values, play
from runs.replay_diagnosis import diagnosis
from runs.replay_report import sweep_sentences, write_replay_report
from runs.replay_sweep import Sweep, parse_sweep, sweep, sweep_table
from runs.replay_tables import write_replay_ulog, write_tables
from systems.estimators.ekf2.parameters import Defaults, Value

Start = Literal["warm", "cold"]


def replay_and_report(
    path: Path,
    folder: Path,
    overrides: Sequence[str] = (),
    parameter_file: Path | None = None,
    defaults: Defaults = "module",
    sweep_text: str | None = None,
    report: bool = True,
    start: Start = "warm",
) -> list[str]:
    """Replay a log and write its folder.

    Parameters
    ----------
    path : Path
        The log.
    folder : Path
        An existing folder; files of an earlier replay in it are replaced.
    overrides : sequence of str
        NAME=VALUE, on top of the log's parameters and the file's.
    parameter_file : Path, optional
        A QGroundControl file.
    defaults : str
        PX4's set of defaults.
    sweep_text : str, optional
        NAME=FIRST:LAST:STEP; the replay then uses the best value.
    report : bool
        Write `report.html`.
    start : str
        "warm": from the state that the filter on board had when the log began, if it is logged;
        "cold": anew.

    Returns
    -------
    list of str
        What was found, in sentences.

    Raises
    ------
    ReplayError
        If the log or the parameters cannot be used.
    """
    changed = dict(_override(text) for text in overrides)
    swept = parse_sweep(sweep_text) if sweep_text is not None else None
    log = read_log(path) if start == "warm" else replace(read_log(path), start=None)
    values = parameter_values(log, parameter_file, changed)
    found: Sweep | None = None
    if swept is not None:
        name, tried = swept
        with Progress(transient=True) as bar:
            task = bar.add_task(name, total=len(tried))
            found = sweep(log, values, defaults, name, tried, progress=lambda: bar.advance(task))
        (folder / "sweep.csv").write_text(sweep_table(found), encoding="utf-8")
        values[name] = found.best.value
    p = parameter_array(log, values, defaults)
    replay = play(log.samples, p, log.start)
    write_tables(folder, replay)
    write_replay_ulog(folder / "log.ulg", replay, values)
    if report:
        write_replay_report(folder / "report.html", log, replay, p, values, found)
    return [*sweep_sentences(found), *log.notes, *diagnosis(log, replay, p)]


def _override(text: str) -> tuple[str, Value]:
    name, separator, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        separator = ""
    if not separator:
        raise ReplayError(f"--param {text}: expected NAME=VALUE with a number")
    return name.strip(), number

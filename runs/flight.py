"""A run with its folder: fly, then write `run.json`, `log.parquet`, `log.ulg`, `report.html`.

A scenario's data recorder writes `companion.csv` there on the way.
"""

import json
import math
from pathlib import Path
from typing import Any

from pydrake.systems.framework import Context
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from diagrams.loading import ScenarioError
from runs.logs import write_log
from runs.presentation import PRESENTATIONS
from runs.replay_3d import meshcat
from runs.report import CameraStrip, write_report
from runs.run import laboratory


def fly_and_report(scenario: Any, folder: Path, live: bool = False, report: bool = True) -> Any:
    """Fly a scenario and write its run folder; returns its result.

    Parameters
    ----------
    scenario : MultirotorLanding or LandingWithoutGpsScenario
        What to fly.
    folder : Path
        An existing folder; files of an earlier run in it are replaced.
    live : bool
        Show the flight in Meshcat while it happens, at real-time rate.
    report : bool
        Write `report.html`, with what the cameras saw.

    Raises
    ------
    ScenarioError
        If the scenario's parts do not fit together, or it has no live view.
    """
    shown = PRESENTATIONS[scenario.kind]
    if live and shown.live is None:
        raise ScenarioError(f"--live: there is no live view of a {scenario.kind}")
    lab = laboratory(scenario)
    if shown.record is not None:
        shown.record(lab.landing, folder)
    simulator = lab.start()
    strip = CameraStrip(lab.landing, shown.frame_period)
    if live and shown.live is not None:
        simulator.set_target_realtime_rate(1.0)
        simulator.set_monitor(shown.live(lab.landing, scenario))
        Console().print(f"Live at {meshcat().web_url()}")
    with Progress(
        TextColumn("{task.description:16}"),
        BarColumn(bar_width=40),
        TextColumn("{task.fields[time]:6.1f} s simulated"),
        TimeElapsedColumn(),
        transient=True,
    ) as bar:
        task = bar.add_task("starting", total=scenario.time_limit, time=0.0)

        def progress(context: Context) -> None:
            time = context.get_time()
            bar.update(task, completed=time, time=time, description=lab.landing.state(context))
            if report:
                strip(context)

        result = lab.fly(simulator, progress)
        bar.update(task, completed=scenario.time_limit, description="writing")
        log = lab.log(simulator.get_context())
        write_log(log, folder / "log.parquet")
        if shown.write_logs is not None:
            shown.write_logs(folder, log)
        write_json(folder / "run.json", result.summary())
        if report:
            write_report(folder / "report.html", lab.landing, result, log, strip.frames)
    return result


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write JSON that any parser reads: not-a-number becomes null."""

    def finite(value: Any) -> Any:
        if isinstance(value, float) and not math.isfinite(value):
            return None
        if isinstance(value, dict):
            return {key: finite(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [finite(entry) for entry in value]
        return value

    path.write_text(json.dumps(finite(data), indent=2) + "\n", encoding="utf-8")

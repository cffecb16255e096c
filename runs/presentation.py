"""How each kind of run is shown: its plots, its replay, its logs for other tools."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
from bokeh.models.layouts import LayoutDOM

from diagrams.landing import LandingDiagram
from runs.plots import RunPlots
from runs.px4_topics import px4_topics
from runs.replay_3d import live_view, replay_html
from runs.runway_plots import RunwayPlots
from runs.runway_replay_3d import runway_live_view, runway_replay_html
from runs.svgs_plots import SvgsPlots
from runs.ulog import write_ulog


@dataclass(frozen=True)
class Presentation:
    """One kind of run.

    Attributes
    ----------
    layouts : callable
        (log, names of the states, scenario) to the report's plots, by section.
    plots_note : str
        A sentence over the plots.
    frames_note : callable
        The scenario to a sentence over the camera's pictures.
    frame_period : float
        s of simulated time between two of them.
    replay : callable, optional
        (scenario, log) to a page with the flight in 3-D.
    live : callable, optional
        (diagram, scenario) to a monitor for the simulator that shows the flight.
    write_logs : callable, optional
        (folder, log): logs for other tools.
    record : callable, optional
        (diagram, folder), before the flight: files that the flight itself writes.
    """

    layouts: Callable[[pa.Table, Sequence[str], Any], dict[str, LayoutDOM]]
    plots_note: str
    frames_note: Callable[[Any], str]
    frame_period: float
    replay: Callable[[Any, pa.Table], str] | None = None
    live: Callable[[Any, Any], Callable] | None = None
    write_logs: Callable[[Path, pa.Table], None] | None = None
    record: Callable[[Any, Path], None] | None = None


def _multirotor_layouts(
    log: pa.Table, states: Sequence[str], scenario: Any
) -> dict[str, LayoutDOM]:
    layouts = {"plots": RunPlots(log, states).layout()}
    if scenario.sensors.svgs_camera is not None:
        layouts["svgs"] = SvgsPlots(log, states, scenario).layout()
    return layouts


def _multirotor_frames(scenario: Any) -> str:
    if scenario.fidelity == "pixels":
        return "The very images that the detectors worked on, with their detections drawn in."
    return (
        "This run flew on geometric cameras; the images are what the same exposures look like, "
        "with the measurements drawn in."
    )


def _runway_frames(scenario: Any) -> str:
    if scenario.camera.kind == "pixels":
        return "As the tracker saw the runway; the cross is the point that it followed."
    return (
        "This run flew on a geometric camera; the pictures are what it would have seen, the "
        "cross is the point that the tracker told the filter."
    )


def _write_px4_log(folder: Path, log: pa.Table) -> None:
    write_ulog(folder / "log.ulg", px4_topics(log), information={"sys_name": "Plumbline"})


def _record_on_board(landing: LandingDiagram, folder: Path) -> None:
    """Have a data recorder that was given no path write into the run's folder."""
    recorder = landing.recorder
    if recorder is not None and not recorder.config.path:
        recorder.configure(replace(recorder.config, path=str(folder / "companion.csv")))


PRESENTATIONS: dict[str, Presentation] = {
    "multirotor_landing": Presentation(
        layouts=_multirotor_layouts,
        plots_note="The dashed line marks where the landing routine took over.",
        frames_note=_multirotor_frames,
        frame_period=2.0,
        replay=replay_html,
        live=live_view,
        write_logs=_write_px4_log,
        record=_record_on_board,
    ),
    "landing_without_gps": Presentation(
        layouts=lambda log, states, scenario: {
            "plots": RunwayPlots(log, states, scenario).layout()
        },
        plots_note="The landing against the distance to go, as in the thesis's Figs. 43 to 51.",
        frames_note=_runway_frames,
        frame_period=15.0,
        replay=runway_replay_html,
        live=runway_live_view,
    ),
}

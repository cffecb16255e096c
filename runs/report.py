"""`report.html`: one self-contained page about one run."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import pyarrow as pa
from bokeh.embed import components
from bokeh.resources import INLINE
from pydrake.systems.framework import Context

from diagrams.graph import svg_of, wiring_dot
from diagrams.loading import to_yaml
from runs.presentation import PRESENTATIONS

FRAME_QUALITY = 82  # JPEG


@dataclass(frozen=True)
class Frame:
    """One picture of the strip."""

    source: str  # a data URL
    caption: str


class CameraStrip:
    """Collects what the cameras see during the landing, one picture a period.

    Parameters
    ----------
    landing : LandingDiagram or LandingWithoutGpsDiagram
        Its cameras' `image` ports render the exposure that lies in the Context, at
        either fidelity.
    period : float
        s of simulated time between two pictures of one camera.
    """

    def __init__(self, landing: Any, period: float = 2.0):
        self.landing = landing
        self.period = period
        self.frames: list[Frame] = []
        self._next = 0.0

    def __call__(self, context: Context) -> None:
        """Take the pictures that are due; a `Progress` of `Laboratory.fly`."""
        time = context.get_time()
        if time < self._next or not self.landing.is_landing(context):
            return
        self._next = time + self.period
        for name, picture in self.landing.camera_pictures(context):
            self.frames.append(Frame(_jpeg_url(picture), f"{name}, {time:.1f} s"))


def write_report(
    path: Path,
    landing: Any,
    result: Any,
    log: pa.Table,
    frames: Sequence[Frame] = (),
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    path : Path
        Of the page.
    landing : LandingDiagram or LandingWithoutGpsDiagram
        The diagram that flew.
    result : RunResult or RunwayResult
        Its verdict.
    log : pa.Table
        Its log.
    frames : sequence of Frame
        From a `CameraStrip`; none leaves the section out.
    """
    scenario = result.scenario
    shown = PRESENTATIONS[scenario.kind]
    layouts = shown.layouts(log, landing.state_names(), scenario)
    script, divisions = components(layouts)
    sections = [
        ("replay", "Replay"),
        ("plots", "Flight"),
        ("svgs", "Beacons"),
        ("cameras", "Cameras"),
        ("states", "States"),
        ("wiring", "Wiring"),
        ("scenario", "Scenario"),
    ]
    absent = {"cameras"} if not frames else set()
    if "svgs" not in layouts:
        absent.add("svgs")
    if shown.replay is None:
        absent.add("replay")
    sections = [section for section in sections if section[0] not in absent]
    template = jinja2.Environment(
        loader=jinja2.PackageLoader("runs", "."), autoescape=True
    ).get_template("report.html.jinja")
    page = template.render(
        title=f"{scenario.name}, seed {scenario.seed}",
        description=scenario.description,
        landed=result.landed,
        verdict=result.reason.capitalize(),
        sections=sections,
        figures=result.figures(),
        replay=shown.replay(scenario, log) if shown.replay else "",
        plots_note=shown.plots_note,
        plot_resources=jinja2.utils.markupsafe.Markup(INLINE.render()),
        plots=jinja2.utils.markupsafe.Markup(divisions["plots"]),
        svgs=jinja2.utils.markupsafe.Markup(divisions.get("svgs", "")),
        plot_script=jinja2.utils.markupsafe.Markup(script),
        frames=frames,
        frames_note=shown.frames_note(scenario),
        states=_drawing(landing.states_dot()),
        wiring=_drawing(wiring_dot(landing.diagram, max_depth=1)),
        scenario=to_yaml(scenario),
        versions=", ".join(f"{name} {version}" for name, version in result.versions.items()),
    )
    path.write_text(page, encoding="utf-8")


def _drawing(dot: str) -> jinja2.utils.markupsafe.Markup:
    """An inline SVG, or the DOT text where Graphviz is not installed."""
    svg = svg_of(dot)
    if svg is None:
        return jinja2.utils.markupsafe.Markup(f"<pre>{html.escape(dot)}</pre>")
    return jinja2.utils.markupsafe.Markup(svg[svg.index("<svg") :])


def _jpeg_url(picture: np.ndarray) -> str:
    """A BGR picture, shape (height, width, 3), as a data URL."""
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, FRAME_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()

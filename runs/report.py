"""`report.html`: one self-contained page about one run."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jinja2
import numpy as np
import pyarrow as pa
from bokeh.embed import components
from bokeh.resources import INLINE
from pydrake.systems.framework import Context

from diagrams.graph import svg_of, wiring_dot
from diagrams.landing import LandingDiagram
from diagrams.loading import to_yaml
from runs.plots import RunPlots
from runs.replay_3d import replay_html
from runs.run import RunResult

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
    landing : LandingDiagram
        Its cameras' `image` ports render the exposure that lies in the Context, at
        either fidelity.
    period : float
        s of simulated time between two pictures of one camera.
    """

    def __init__(self, landing: LandingDiagram, period: float = 2.0):
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
    landing: LandingDiagram,
    result: RunResult,
    log: pa.Table,
    frames: Sequence[Frame] = (),
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    path : Path
        Of the page.
    landing : LandingDiagram
        The diagram that flew.
    result : RunResult
        Its verdict.
    log : pa.Table
        Its log.
    frames : sequence of Frame
        From a `CameraStrip`; none leaves the section out.
    """
    plots = RunPlots(log, landing.state_names())
    script, division = components(plots.layout())
    scenario = result.scenario
    sections = [
        ("replay", "Replay"),
        ("plots", "Flight"),
        ("cameras", "Cameras"),
        ("states", "States"),
        ("wiring", "Wiring"),
        ("scenario", "Scenario"),
    ]
    if not frames:
        sections = [section for section in sections if section[0] != "cameras"]
    template = jinja2.Environment(
        loader=jinja2.PackageLoader("runs", "."), autoescape=True
    ).get_template("report.html.jinja")
    page = template.render(
        title=f"{scenario.name}, seed {scenario.seed}",
        description=scenario.description,
        landed=result.landed,
        verdict=result.reason.capitalize(),
        sections=sections,
        figures=_figures(result),
        replay=replay_html(scenario, log),
        plot_resources=jinja2.utils.markupsafe.Markup(INLINE.render()),
        plots=jinja2.utils.markupsafe.Markup(division),
        plot_script=jinja2.utils.markupsafe.Markup(script),
        frames=frames,
        frames_note=_frames_note(scenario.fidelity),
        states=_drawing(landing.states_dot()),
        wiring=_drawing(wiring_dot(landing.diagram, max_depth=1)),
        scenario=to_yaml(scenario),
        versions=", ".join(f"{name} {version}" for name, version in result.versions.items()),
    )
    path.write_text(page, encoding="utf-8")


def _figures(result: RunResult) -> list[tuple[str, str]]:
    x, y = (100.0 * value for value in result.landing_offset_m)
    speed = result.simulated_s / result.cpu_s if result.cpu_s > 0.0 else float("nan")
    return [
        (f"{100.0 * result.landing_error_m:.1f} cm", "landing error"),
        (f"{x:+.0f}, {y:+.0f} cm", "east, north"),
        (f"{result.touchdown_speed_m_s:.2f} m/s", "touchdown speed"),
        (f"{result.landing_time_s:.1f} s", "landing time"),
        (f"{result.attempts}", "attempt" if result.attempts == 1 else "attempts"),
        (f"{result.simulated_s:.0f} s", "flight"),
        (f"{speed:.0f} ×", "simulated seconds per CPU second"),
    ]


def _frames_note(fidelity: str) -> str:
    if fidelity == "pixels":
        return "The very images that the detectors worked on, with their detections drawn in."
    return (
        "This run flew on geometric cameras; the images are what the same exposures look like, "
        "with the measurements drawn in."
    )


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

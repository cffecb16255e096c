"""`report.html` of a replay: one self-contained page."""

from collections.abc import Sequence
from pathlib import Path

import jinja2
import numpy as np
from bokeh.embed import components
from bokeh.layouts import column
from bokeh.models import Range1d, Span
from bokeh.models.layouts import LayoutDOM
from bokeh.plotting import figure
from bokeh.resources import INLINE

from runs.flight_log import FlightLog
from runs.plots import (
    BLUE,
    GREEN,
    HEIGHT,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    blank_figure,
    finish_figure,
    uncertainty_band,
)
from runs.replay import OUTPUT_COLUMNS, Replay
from runs.replay_diagnosis import GATES, diagnosis, horizon, source_rows, summaries
from runs.replay_sweep import Sweep
from runs.replay_tables import against_on_board
from systems.estimators.ekf2.parameters import Value

_POINTS = 3000  # of a line, about as many as a screen has pixels
_AXIS_COLOURS = (BLUE, ORANGE, GREEN)


def _finished(plot: figure) -> figure:
    """With its legend above, where it hides nothing and all time axes stay aligned."""
    plot = finish_figure(plot)
    if plot.legend:
        legend = plot.legend[0]
        plot.center.remove(legend)
        legend.orientation, legend.margin, legend.padding, legend.spacing = "horizontal", 0, 0, 12
        plot.add_layout(legend, "above")
    return plot


class ReplayPlots:
    """The plots of a replay, time axes linked.

    Parameters
    ----------
    log : FlightLog
        What was replayed.
    replay : Replay
        What came of it.
    p : np.ndarray
        The filter's parameters.
    """

    def __init__(self, log: FlightLog, replay: Replay, p: np.ndarray):
        self.log, self.replay, self.p = log, replay, p
        self.start = float(replay.output[0, 0])
        end = float(self._seconds(replay.output[-1:, 0])[0])
        self.time_range = Range1d(0.0, end, bounds=(0.0, end))

    def layout(self, sweep: Sweep | None = None) -> LayoutDOM:
        """All plots, one under the other."""
        plots = [] if sweep is None else [self.sweep(sweep)]
        plots += [self.attitude(), *self.motion()]
        plots += [self.flags(), *self.innovations(), self.test_ratios()]
        return column(*plots, sizing_mode="stretch_width")

    def _seconds(self, microseconds: np.ndarray) -> np.ndarray:
        return (microseconds - self.start) * 1e-6

    def _time_figure(self, title: str, unit: str, height: int = HEIGHT, **kwargs) -> figure:
        return blank_figure(
            title, "time (s)", unit, height=height, x_range=self.time_range, **kwargs
        )

    def _line(self, plot: figure, time: np.ndarray, values: np.ndarray, **style) -> None:
        stride = max(1, len(time) // _POINTS)
        plot.line(
            time[::stride].astype("f4"),
            np.where(np.isfinite(values), values, np.nan)[::stride].astype("f4"),
            **style,
        )

    def attitude(self) -> figure:
        """Roll, pitch and yaw, replayed and on board."""
        plot = self._time_figure("Attitude", "deg")
        output = self.replay.output
        curves = [(output[:, 0], output[:, 1:5], "solid", "")]
        if self.log.on_board is not None:
            theirs = self._inside(self.log.on_board.attitude)
            curves.append((theirs[:, 0], theirs[:, 1:5], "dotted", " on board"))
        for stamps, q, dash, suffix in curves:
            for angle, name, colour in zip(
                _euler(q), ("roll", "pitch", "yaw"), _AXIS_COLOURS, strict=True
            ):
                label = name + suffix
                self._line(
                    plot, self._seconds(stamps), angle, color=colour, line_dash=dash,
                    line_width=1.4, legend_label=label,
                )  # fmt: skip
        return _finished(plot)

    def motion(self) -> list[figure]:
        """Velocity and position, replayed and on board."""
        plots = []
        for title, unit, first, own in (
            ("Velocity", "m/s", 1, ("vn", "ve", "vd")),
            ("Position, each from its own origin", "m", 4, ("pn", "pe", "pd")),
        ):
            plot = self._time_figure(title, unit)
            for axis, (name, colour) in enumerate(
                zip(("north", "east", "down"), _AXIS_COLOURS, strict=True)
            ):
                self._line(
                    plot, self._seconds(self.replay.output[:, 0]),
                    self.replay.output[:, OUTPUT_COLUMNS.index(own[axis])],
                    color=colour, line_width=1.4, legend_label=name,
                )  # fmt: skip
                if self.log.on_board is not None:
                    theirs = self._inside(self.log.on_board.motion)
                    self._line(
                        plot, self._seconds(theirs[:, 0]), theirs[:, first + axis], color=colour,
                        line_dash="dotted", line_width=1.4, legend_label=f"{name} on board",
                    )  # fmt: skip
            plots.append(_finished(plot))
        return plots

    def _inside(self, rows: np.ndarray) -> np.ndarray:
        output = self.replay.output
        return rows[(rows[:, 0] >= output[0, 0]) & (rows[:, 0] <= output[-1, 0])]

    def flags(self) -> figure:
        """Which sources were in use when."""
        names = ("tilt_align", "yaw_align", "in_air", "gnss_pos", "gnss_vel", "gps_hgt", "baro_hgt",
                 "rng_hgt", "mag_hdg", "mag_3D", "ev_pos", "ev_hgt", "ev_vel", "ev_yaw", "fake_pos",
                 "fake_hgt", "inertial_dead_reckoning")  # fmt: skip
        time = self._seconds(self.replay.delayed[:, 0])
        used = [name for name in names if self.replay.flag(name).any()]
        plot = self._time_figure(
            "In use", "", height=90 + 20 * len(used), y_range=list(reversed(used))
        )
        for name in used:
            on = self.replay.flag(name).astype(int)
            edges = np.flatnonzero(np.diff(np.concatenate([[0], on, [0]])))
            left, right = edges[::2], np.minimum(edges[1::2], len(time) - 1)
            colour = RED if "fake" in name or "dead" in name else SKY
            plot.hbar(y=[name] * len(left), left=time[left], right=time[right], height=0.7,
                      color=colour, alpha=0.85)  # fmt: skip
        return plot

    def innovations(self) -> list[figure]:
        """Each source's innovations in bands of one, three and gate standard deviations."""
        plots = []
        for name, gate_index in GATES.items():
            rows = source_rows(self.replay, name)
            if not len(rows):
                continue
            gate = max(float(self.p[gate_index]), 1.0)
            for axis in range(rows.shape[1]):
                plots.append(self._innovation(name, rows[:, axis], axis, gate))
        return plots

    def _innovation(self, name: str, rows: np.ndarray, axis: int, gate: float) -> figure:
        stride = max(1, len(rows) // _POINTS)
        time = self._seconds(rows[:, 0])
        sigma = np.sqrt(np.maximum(np.nan_to_num(rows[:, 8]), 0.0))
        plot = self._time_figure(
            f"Innovation of {name}, axis {axis}: 1 σ, 3 σ and the gate of {gate:g} σ",
            "",
            height=200,
        )
        for factor in (gate, 3.0, 1.0):
            band = (factor * sigma)[::stride].astype("f4")
            uncertainty_band(plot, time[::stride].astype("f4"), np.zeros_like(band), band, BLUE)
        fused, rejected = rows[:, 12] > 0.5, rows[:, 11] > 0.5
        finite = np.isfinite(rows[:, 7])
        for chosen, colour, label in (
            (fused & finite, GREEN, "fused"),
            (rejected & finite, RED, "rejected"),
            (~fused & ~rejected & finite, PURPLE, "not used"),
        ):
            if chosen.any():
                step = max(1, int(chosen.sum()) // _POINTS)
                plot.scatter(
                    time[chosen][::step].astype("f4"), rows[chosen, 7][::step].astype("f4"),
                    size=3, color=colour, legend_label=label,
                )  # fmt: skip
        settled = sigma[len(sigma) // 4 :]
        limit = float(np.median(settled)) * 1.5 * max(gate, 3.0)
        if np.isfinite(limit) and limit > 0.0:
            plot.y_range = Range1d(-limit, limit)
        return _finished(plot)

    def test_ratios(self) -> figure:
        """Test ratios of all sources; above one an observation is rejected."""
        plot = self._time_figure("Test ratios", "1", y_axis_type="log", y_range=(1e-4, 1e2))
        colours = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
        for index, name in enumerate(GATES):
            rows = source_rows(self.replay, name)
            if len(rows):
                worst = np.max(np.nan_to_num(rows[:, :, 9], posinf=0.0), axis=1)
                self._line(
                    plot, self._seconds(rows[:, 0, 0]), np.maximum(worst, 1e-6),
                    color=colours[index % len(colours)], line_width=1, legend_label=name,
                )  # fmt: skip
        plot.add_layout(Span(location=1.0, dimension="width", line_color=RED, line_dash="dashed"))
        return _finished(plot)

    def sweep(self, sweep: Sweep) -> figure:
        """The score over the swept parameter."""
        plot = blank_figure(f"Innovation test over {sweep.parameter}", sweep.parameter,
                       "log-likelihood of an innovation", height=HEIGHT)  # fmt: skip
        points = [point for point in sweep.points if np.isfinite(point.score)]
        plot.line([p.value for p in points], [p.score for p in points], color=BLUE, line_width=1.5)
        inside = [point for point in points if point.inside]
        plot.scatter([p.value for p in inside], [p.score for p in inside], size=8, color=GREEN,
                     legend_label="not distinguishable from the best")  # fmt: skip
        return _finished(plot)


def _euler(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(roll), np.degrees(pitch), np.degrees(yaw)


def write_replay_report(
    path: Path,
    log: FlightLog,
    replay: Replay,
    p: np.ndarray,
    parameters: dict[str, Value],
    sweep: Sweep | None = None,
) -> None:
    """Write the report of a replay.

    Parameters
    ----------
    path : Path
        Of the page.
    log, replay, p
        As `ReplayPlots`.
    parameters : dict
        What differs from the defaults.
    sweep : Sweep, optional
        Shown if there was one.
    """
    script, division = components(ReplayPlots(log, replay, p).layout(sweep))
    markup = jinja2.utils.markupsafe.Markup
    template = jinja2.Environment(
        loader=jinja2.PackageLoader("runs", "."), autoescape=True
    ).get_template("replay.html.jinja")
    page = template.render(
        title=f"{log.name} through EKF2",
        figures=_figures(log, replay),
        sentences=[*sweep_sentences(sweep), *diagnosis(log, replay, p)],
        notes=log.notes,
        summaries=summaries(replay),
        parameters=sorted(parameters.items()),
        plot_resources=markup(INLINE.render()),
        plots=markup(division),
        plot_script=markup(script),
    )
    path.write_text(page, encoding="utf-8")


def sweep_sentences(sweep: Sweep | None) -> Sequence[str]:
    """What a sweep found, as no or one sentence."""
    if sweep is None:
        return []
    low, high = sweep.interval
    return [
        f"{sweep.parameter} fits best at {sweep.best.value:g} ({low:g} to {high:g} cannot be "
        f"told apart from it), mean normalised innovation squared {sweep.best.nis:.2f}."
    ]


def _figures(log: FlightLog, replay: Replay) -> list[tuple[str, str]]:
    seconds = (replay.output[-1, 0] - replay.output[0, 0]) * 1e-6
    figures = [(f"{seconds:.0f} s", "log"), (f"{horizon(replay):.0f} ms", "horizon")]
    units = {"attitude": "deg", "velocity": "m/s", "position": "m"}
    for name, (_, error) in against_on_board(replay, log).items():
        distance = np.sqrt(np.sum(error**2, axis=1))
        if np.isfinite(distance).any():
            median = f"{np.nanmedian(distance):.2f} {units[name]}"
            figures.append((median, f"{name} off the on-board estimate, median"))
    return figures

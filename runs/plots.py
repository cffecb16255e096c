"""The interactive plots of a run: one Bokeh figure an idea, time axes linked."""

import math
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from bokeh.layouts import column, gridplot
from bokeh.models import (
    ColumnDataSource,
    HoverTool,
    Label,
    Range1d,
    Span,
    Title,
)
from bokeh.models.layouts import LayoutDOM
from bokeh.plotting import figure

from runs.logs import port_samples
from systems.schedule import SUPERVISOR_PERIOD

# Okabe and Ito's palette: distinguishable with any colour vision.
BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"
PURPLE, SKY, YELLOW, INK = "#cc79a7", "#56b4e9", "#f0e442", "#2b2d33"
GRID, PAPER = "#e6e8ec", "#ffffff"
STATE_COLOURS = (SKY, GREEN, ORANGE, PURPLE, BLUE, RED, YELLOW)

HEIGHT = 260  # px of one time plot


class RunPlots:
    """The plots of one run.

    Parameters
    ----------
    log : pa.Table
        The run's log.
    states : sequence of str
        Names of the supervisor's states, by index.
    """

    def __init__(self, log: pa.Table, states: Sequence[str]):
        self.log = log
        self.states = [state.replace("_", " ") for state in states]
        self.body = port_samples(log, "body")
        self.supervisor = port_samples(log, "supervisor")
        pad = port_samples(log, "pad")
        self.pad = np.column_stack([pad["p_WP_x"], pad["p_WP_y"], pad["p_WP_z"]])
        self._pad_time = pad["time"]
        self.end = float(self.body["time"][-1])
        self.time_range = Range1d(0.0, self.end, bounds=(0.0, self.end))

    def layout(self) -> LayoutDOM:
        """All plots, one under the other, time axes linked."""
        first_row = gridplot(
            [[self.ground_plan(), self.final_approach()]],
            sizing_mode="stretch_width",
            toolbar_location=None,
        )
        return column(
            first_row,
            self.supervisor_state(),
            self.altitude(),
            self.horizontal_offset(),
            self.sensors(),
            self.estimate_error("p_WB", "position error", "m"),
            self.estimate_error("v_WB", "velocity error", "m/s"),
            self.wind(),
            self.rotors(),
            sizing_mode="stretch_width",
        )

    def port(self, name: str) -> dict[str, np.ndarray] | None:
        """The samples of a port, or None where the run has none of it."""
        try:
            samples = port_samples(self.log, name)
        except KeyError:
            return None
        return samples if len(samples["time"]) else None

    def from_pad(self, time: np.ndarray, axis: str) -> np.ndarray:
        """One coordinate of the vehicle from the pad's centre at each time (s), m."""
        body = np.interp(time, self.body["time"], self.body[f"p_WB_{axis}"])
        return body - np.interp(time, self._pad_time, self.pad[:, "xyz".index(axis)])

    # ------------------------------------------------------------ in the plane

    def ground_plan(self) -> figure:
        """The flight from above: truth, estimate, setpoint, pad and touchdown."""
        plot = blank_figure("Ground track", "east (m)", "north (m)", match_aspect=True, height=420)
        setpoint = self.port("setpoint")
        if setpoint is not None:
            plot.line(
                setpoint["p_WB_x"],
                setpoint["p_WB_y"],
                color=ORANGE,
                line_dash="dotted",
                line_width=1.5,
                legend_label="setpoint",
            )
        estimate = self.port("estimate")
        if estimate is not None:
            known = estimate["horizontal_valid"] > 0.5
            plot.line(
                estimate["p_WB_x"][known],
                estimate["p_WB_y"][known],
                color=SKY,
                line_width=1.5,
                legend_label="estimate",
            )
        source = ColumnDataSource(
            {
                "x": self.body["p_WB_x"],
                "y": self.body["p_WB_y"],
                "z": self.body["p_WB_z"],
                "t": self.body["time"],
            }
        )
        line = plot.line("x", "y", source=source, color=BLUE, line_width=2, legend_label="truth")
        plot.add_tools(
            HoverTool(renderers=[line], tooltips=[("t", "@t{0.0} s"), ("z", "@z{0.00} m")])
        )
        if np.ptp(self.pad[:, :2], axis=0).max() > 0.0:
            plot.line(*self.pad[:, :2].T, color=INK, line_width=1.5, legend_label="pad")
        self._rings(plot, *self.pad[-1, :2])
        return finish_figure(plot)

    def final_approach(self) -> figure:
        """The last metres above the pad, from above and from the pad."""
        plot = blank_figure(
            "Last two metres of descent", "east (m)", "north (m)", match_aspect=True, height=420
        )
        time = self.body["time"]
        low = (self.from_pad(time, "z") < 2.0) & (
            time >= self._landing_started() if self._landing_started() >= 0 else False
        )
        self._rings(plot, 0.0, 0.0)
        plot.line(
            self.from_pad(time, "x")[low],
            self.from_pad(time, "y")[low],
            color=BLUE,
            line_width=2,
            legend_label="truth",
        )
        touchdown = self.port("touchdown")
        if touchdown is not None and touchdown["time"][-1] >= 0.0:
            x, y = touchdown["offset_x"][-1], touchdown["offset_y"][-1]
            plot.scatter(
                [x],
                [y],
                marker="x",
                size=14,
                line_width=3,
                color=RED,
                legend_label=f"landed {100 * math.hypot(x, y):.1f} cm off",
            )
        return finish_figure(plot)

    def _rings(self, plot: figure, x: float, y: float) -> None:
        """The pad, with distances from it."""
        for radius in (0.1, 0.5, 1.0):
            plot.circle(x, y, radius=radius, fill_alpha=0.0, line_color="#b9bdc7", line_width=1)
            plot.add_layout(
                Label(
                    x=x,
                    y=y + radius,
                    text=f"{radius:g} m",
                    text_font_size="8pt",
                    text_color="#8a8f9c",
                    text_align="center",
                )
            )
        plot.scatter([x], [y], marker="square", size=7, color=INK, legend_label="pad")

    def _landing_started(self) -> float:
        return float(self.supervisor["landing_started"][-1])

    # ----------------------------------------------------------------- in time

    def supervisor_state(self) -> figure:
        """Which state the supervisor was in, without those that it only passed through."""
        index = self.supervisor["state"].astype(int)
        time = self.supervisor["time"]
        change = np.flatnonzero(np.diff(index, prepend=-1))
        left = time[change]
        right = np.append(time[change[1:]], self.end)
        # It changes its state once a tick, so one that is passed through lasts a tick, or a sample
        tick = max(SUPERVISOR_PERIOD, float(np.median(np.diff(time))) if len(time) > 1 else 0.0)
        entered = index[change]
        stayed = np.isin(entered, entered[right - left > 1.5 * tick])
        left, right = left[stayed], right[stayed]
        names = [self.states[i] for i in entered[stayed]]
        used = list(dict.fromkeys(names))
        plot = self._time_figure(
            "Supervisor", "", height=90 + 22 * len(used), y_range=list(reversed(used))
        )
        colours = [STATE_COLOURS[used.index(name) % len(STATE_COLOURS)] for name in names]
        plot.hbar(y=names, left=left, right=right, height=0.7, color=colours, alpha=0.85)
        return plot

    def altitude(self) -> figure:
        """Height above the pad."""
        plot = self._time_figure("Height", "m")
        estimate = self.port("estimate")
        if estimate is not None:
            known = estimate["vertical_valid"] > 0.5
            uncertainty_band(
                plot,
                estimate["time"][known],
                estimate["p_WB_z"][known],
                3.0 * np.sqrt(estimate["position_variance_z"][known]),
                SKY,
            )
            plot.line(
                estimate["time"][known],
                estimate["p_WB_z"][known],
                color=SKY,
                line_width=1.5,
                legend_label="estimate, 3 σ",
            )
        ranges = self.port("range_finder")
        if ranges is not None:
            good = ranges["valid"] > 0.5
            plot.scatter(
                ranges["time"][good][::4],
                ranges["range"][good][::4],
                size=2,
                color=ORANGE,
                alpha=0.6,
                legend_label="range finder",
            )
        plot.line(
            self.body["time"], self.body["p_WB_z"], color=BLUE, line_width=2, legend_label="truth"
        )
        return self._finish_time(plot)

    def horizontal_offset(self) -> figure:
        """The pad as guidance believes it, against where it is."""
        title = "Landing target: estimated minus true position"
        target = self.port("target")
        if target is None:
            return self._finish_time(self._time_figure(f"{title} (no estimator)", "m"))
        plot = self._time_figure(title, "m")
        used = target["acquired"] > 0.5
        time = target["time"][used]
        for axis, name, colour in (("x", "east", BLUE), ("y", "north", ORANGE)):
            error = target[f"p_BP_W_{axis}"][used] + self.from_pad(time, axis)
            sigma = np.sqrt(target[f"position_variance_{axis}"][used])
            uncertainty_band(plot, time, np.zeros_like(time), 3.0 * sigma, colour)
            plot.line(time, error, color=colour, line_width=1.5, legend_label=f"{name}, 3 σ")
        if len(time):
            limit = float(np.quantile(np.abs(error), 0.99)) * 3.0 + 0.05
            plot.y_range = Range1d(-limit, limit)
        return self._finish_time(plot)

    def sensors(self) -> figure:
        """Which sensor delivered when."""
        rows: list[tuple[str, np.ndarray, str]] = []
        marker = self.port("marker")
        if marker is not None:
            valid = marker["valid"] > 0.5
            for level, name in ((0, "outer"), (1, "middle"), (2, "inner")):
                seen = valid & ~np.isnan(marker[f"corner_{level}_0_u"])
                rows.append((f"marker, {name}", marker["time"][seen], GREEN))
        infrared = self.port("infrared")
        if infrared is not None:
            rows.append(("IR beacon", infrared["time"][infrared["valid"] > 0.5], RED))
        for name, label, colour in (
            ("svgs", "SVGS", GREEN),
            ("range_finder", "range finder", BLUE),
            ("gnss", "GNSS", BLUE),
            ("pad_gnss", "pad's GNSS", BLUE),
        ):
            samples = self.port(name)
            if samples is not None:
                rows.append((label, samples["time"][samples["valid"] > 0.5], colour))
        target = self.port("target")
        if target is not None:
            rows.append(("target acquired", target["time"][target["acquired"] > 0.5], PURPLE))
        names = [name for name, _, _ in rows]
        plot = self._time_figure(
            "Which sensor when", "", height=90 + 22 * len(rows), y_range=list(reversed(names))
        )
        for name, times, colour in rows:
            plot.scatter(
                times,
                [name] * len(times),
                marker="dash",
                angle=math.pi / 2,
                size=12,
                line_width=1.2,
                color=colour,
                alpha=0.8,
            )
        return plot

    def estimate_error(self, quantity: str, title: str, unit: str) -> figure:
        """Navigation estimate minus truth, per axis, with the filter's own 3 σ."""
        plot = self._time_figure(f"Navigation: {title}", unit)
        estimate = self.port("estimate")
        if estimate is None:
            return self._finish_time(plot)
        known = (estimate["horizontal_valid"] > 0.5) & (estimate["vertical_valid"] > 0.5)
        time = estimate["time"][known]
        variance = "position_variance" if quantity == "p_WB" else "velocity_variance"
        for axis, name, colour in (("x", "east", BLUE), ("y", "north", ORANGE), ("z", "up", GREEN)):
            truth = np.interp(time, self.body["time"], self.body[f"{quantity}_{axis}"])
            error = estimate[f"{quantity}_{axis}"][known] - truth
            if axis != "y":  # east and north have nearly the same variance
                sigma = np.sqrt(estimate[f"{variance}_{axis}"][known])
                uncertainty_band(plot, time, np.zeros_like(time), 3.0 * sigma, colour)
            plot.line(time, error, color=colour, line_width=1.5, legend_label=name)
        return self._finish_time(plot)

    def wind(self) -> figure:
        """The wind at the vehicle."""
        plot = self._time_figure("Wind at the vehicle", "m/s")
        wind = self.port("wind")
        if wind is not None:
            for axis, name, colour in (
                ("x", "east", BLUE),
                ("y", "north", ORANGE),
                ("z", "up", GREEN),
            ):
                plot.line(
                    wind["time"],
                    wind[f"v_W_{axis}"],
                    color=colour,
                    line_width=1.2,
                    legend_label=name,
                )
        return self._finish_time(plot)

    def rotors(self) -> figure:
        """The normalised rotor commands."""
        plot = self._time_figure("Rotor commands", "1")
        commands = self.port("rotor_commands")
        if commands is not None:
            names = [name for name in commands if name != "time"]
            for name, colour in zip(names, STATE_COLOURS * 2, strict=False):
                plot.line(
                    commands["time"],
                    commands[name],
                    color=colour,
                    line_width=1,
                    alpha=0.8,
                    legend_label=name.replace("_", " "),
                )
        return self._finish_time(plot)

    def _time_figure(self, title: str, unit: str, height: int = HEIGHT, **kwargs) -> figure:
        return blank_figure(
            title, "time (s)", unit, height=height, x_range=self.time_range, **kwargs
        )

    def _finish_time(self, plot: figure) -> figure:
        started = self._landing_started()
        if started >= 0.0:
            plot.add_layout(
                Span(
                    location=started,
                    dimension="height",
                    line_color="#8a8f9c",
                    line_dash="dashed",
                    line_width=1,
                )
            )
        return finish_figure(plot)


def blank_figure(title: str, x_label: str, y_label: str, **kwargs) -> figure:
    """An empty figure in the laboratory's style; `kwargs` are Bokeh's own."""
    plot = figure(
        title=Title(text=title, text_font="system-ui", text_font_size="11pt", text_color=INK),
        x_axis_label=x_label,
        y_axis_label=y_label,
        tools="pan,xwheel_zoom,box_zoom,reset,save",
        active_drag="box_zoom",
        sizing_mode="stretch_width",
        background_fill_color=PAPER,
        border_fill_color=PAPER,
        outline_line_color=None,
        **kwargs,
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.grid.grid_line_color = GRID
    plot.axis.axis_label_text_font = "system-ui"
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_line_color = "#b9bdc7"
    plot.axis.major_tick_line_color = plot.axis.minor_tick_line_color = None
    return plot


def finish_figure(plot: figure) -> figure:
    """`plot` with its legend, if it has one by now, in the laboratory's style."""
    if plot.legend:
        plot.legend.location = "top_right"
        plot.legend.click_policy = "hide"
        plot.legend.background_fill_alpha = 0.7
        plot.legend.border_line_color = None
        plot.legend.label_text_font_size = "8.5pt"
        plot.legend.spacing = 0
    return plot


def uncertainty_band(
    plot: figure, time: np.ndarray, centre: np.ndarray, half_width: np.ndarray, colour: str
) -> None:
    """Draw a translucent band, for the estimator's own uncertainty.

    Parameters
    ----------
    plot : figure
    time, centre, half_width : array of shape (n,)
        The horizontal axis, and the band in the unit of the vertical one.
    colour : str
    """
    plot.varea(
        x=time, y1=centre - half_width, y2=centre + half_width, fill_color=colour, fill_alpha=0.12
    )

"""The plots of a landing without GPS, in the manner of the thesis's Figures 9 and 43 to 51.

Positions are in the runway's frame: X_r to the right of the landing direction, Y_r
along it, from the touch-down point. The landing itself is drawn against the distance to go,
falling from left to right, as the thesis does.
"""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from bokeh.layouts import column, gridplot
from bokeh.models import HoverTool, Range1d, Span
from bokeh.models.layouts import LayoutDOM
from bokeh.plotting import figure

from diagrams.landing_without_gps import LandingWithoutGpsScenario
from runs.logs import port_samples
from runs.plots import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    STATE_COLOURS,
    blank_figure,
    finish_figure,
    uncertainty_band,
)
from systems.supervisors.runway_phases import Phase

_LANDING = 5000.0  # m before the touch-down point, where the plots of the landing begin


class RunwayPlots:
    """The plots of one landing without GPS.

    Parameters
    ----------
    log : pa.Table
        The run's log.
    states : sequence of str
        Names of the phases, by index.
    scenario : LandingWithoutGpsScenario
        What flew.
    """

    def __init__(self, log: pa.Table, states: Sequence[str], scenario: LandingWithoutGpsScenario):
        self.log = log
        self.states = [state.replace("_", " ") for state in states]
        self.scenario = scenario
        self.truth = port_samples(log, "state")
        self.estimate = port_samples(log, "estimate")
        self.phase = port_samples(log, "phase")["phase"].astype(int)
        self.time = self.truth["time"]
        heading = scenario.runway.heading_radians
        # (X_r, Y_r) of a vector (north, east): R_n/r is symmetric, its own inverse (6)
        self._to_runway = np.array(
            [[-np.sin(heading), np.cos(heading)], [np.cos(heading), np.sin(heading)]]
        )
        self.position = self._in_runway(self.truth, "p_n")
        self.believed = self._in_runway(self.estimate, "p_n")
        self.believed_speed = self._in_runway(self.estimate, "v_n")
        self.speed = self._in_runway(self.truth, "v_n")
        self.known = self.estimate["initialised"] > 0.5
        # of the landing: from the last time that the aircraft came nearer than `_LANDING`
        to_go = -self.position[1]
        outside = np.flatnonzero((to_go > _LANDING) | (self.phase < Phase.FINAL))
        start = outside[-1] + 1 if len(outside) else 0
        stop = int(np.argmax(self.phase >= Phase.BRAKING)) or len(self.time)
        self.landing = slice(min(start, len(self.time) - 1), max(stop, start + 1))
        self.to_go = to_go[self.landing]
        far = float(self.to_go.max()) if len(self.to_go) else _LANDING
        self.range = Range1d(far, min(float(self.to_go.min()), 0.0))

    def layout(self) -> LayoutDOM:
        """All plots, one under the other; those of the landing share their axis."""
        rows = [
            [self.error(0), self.error(1)],
            [self.altitude_error(), self.profile()],
            [self.speed_error(0), self.speed_error(1)],
            [self.innovation("bearing"), self.innovation("elevation")],
            [self.innovation("laser"), self.pitch_and_roll()],
        ]
        plots = gridplot(rows, sizing_mode="stretch_width", toolbar_location=None)
        return column(self.ground_track(), self.phases(), plots, sizing_mode="stretch_width")

    def _in_runway(self, samples: dict[str, np.ndarray], vector: str) -> np.ndarray:
        """(X_r, Y_r) of a NED vector, shape (2, n)."""
        return self._to_runway @ np.array([samples[f"{vector}_x"], samples[f"{vector}_y"]])

    def _deviation(self, axis: int, states: tuple[str, str]) -> np.ndarray:
        """What the filter believes its own standard deviation to be on X_r or Y_r, shape (n,)."""
        a, b = states
        north, both, east = (
            self.estimate[f"covariance_{pair}"] for pair in (f"{a}_{a}", f"{a}_{b}", f"{b}_{b}")
        )
        x, y = self._to_runway[axis]
        return np.sqrt(np.maximum(x * x * north + 2.0 * x * y * both + y * y * east, 0.0))

    # ------------------------------------------------------------ in the plane

    def ground_track(self) -> figure:
        """The flight from above (Figs. 9, 42)."""
        plot = blank_figure(
            "Ground track", "right of the runway (m)", "along it (m)", match_aspect=True, height=520
        )
        runway = self.scenario.runway
        plot.rect(
            x=0.0,
            y=0.5 * (runway.length - 300.0),
            width=runway.width,
            height=runway.length + 300.0,
            fill_color="#b9bdc7",
            line_color=INK,
        )
        station = runway.ground_station
        plot.scatter(
            [station[0]], [station[1]], marker="triangle", size=11, color=PURPLE,
            legend_label="ground station",
        )  # fmt: skip
        route = self.scenario.flight_controller.route.waypoints
        if route:
            east, north = zip(*((point[0], point[1]) for point in route), strict=True)
            plot.line(east, north, color=ORANGE, line_dash="dotted", legend_label="route")
        plot.line(
            self.believed[0][self.known], self.believed[1][self.known],
            color=SKY, line_width=2, legend_label="estimate",
        )  # fmt: skip
        line = plot.line(
            self.position[0], self.position[1], color=BLUE, line_width=1.5, legend_label="truth"
        )
        lost = int(np.argmax(self.phase >= Phase.RETURN))
        if self.phase[0] == Phase.STANDBY and lost:
            plot.scatter(
                [self.position[0][lost]], [self.position[1][lost]], marker="x", size=12,
                line_width=3, color=RED, legend_label="GPS lost",
            )  # fmt: skip
        plot.add_tools(
            HoverTool(renderers=[line], tooltips=[("right", "@x{0} m"), ("along", "@y{0} m")])
        )
        return finish_figure(plot)

    def profile(self) -> figure:
        """The landing from the side."""
        plot = self._landing_figure("Profile", "altitude (m)")
        cut = self.landing
        plot.line(
            self.to_go, -self.estimate["p_n_z"][cut], color=SKY, line_width=2,
            legend_label="estimate",
        )  # fmt: skip
        plot.line(
            self.to_go, -self.truth["p_n_z"][cut], color=BLUE, line_width=1.5, legend_label="truth"
        )
        ground = -self.truth["p_n_z"][cut] - self.truth["height"][cut]
        plot.line(self.to_go, ground, color=GREEN, line_width=1.5, legend_label="ground below")
        return finish_figure(plot)

    # ------------------------------------------------------------------- in time

    def phases(self) -> figure:
        """Which phase when."""
        names = [self.states[i] for i in dict.fromkeys(self.phase)]
        end = float(self.time[-1])
        plot = blank_figure(
            "Phases", "time (s)", "", height=90 + 22 * len(names), x_range=Range1d(0.0, end),
            y_range=list(reversed(names)),
        )  # fmt: skip
        change = np.flatnonzero(np.diff(self.phase, prepend=-1))
        shown = [self.states[i] for i in self.phase[change]]
        colours = [STATE_COLOURS[names.index(name) % len(STATE_COLOURS)] for name in shown]
        right = np.append(self.time[change[1:]], end)
        plot.hbar(
            y=shown, left=self.time[change], right=right, height=0.7, color=colours, alpha=0.85
        )
        return plot

    # ------------------------------------------------- against the distance to go

    def error(self, axis: int) -> figure:
        """Estimated less true position on X_r (Fig. 44) or Y_r (Fig. 46)."""
        title = ("Error across (X_r)", "Error along (Y_r)")[axis]
        error = (self.believed - self.position)[axis]
        return self._error_figure(title, "m", error, self._deviation(axis, ("x", "y")))

    def altitude_error(self) -> figure:
        """Estimated less true altitude (Fig. 30)."""
        error = self.truth["p_n_z"] - self.estimate["p_n_z"]
        deviation = np.sqrt(np.maximum(self.estimate["covariance_z_z"], 0.0))
        return self._error_figure("Error of the altitude", "m", error, deviation)

    def speed_error(self, axis: int) -> figure:
        """Estimated less true ground speed on X_r (Fig. 47) or Y_r (Fig. 48)."""
        title = ("Error of the speed across", "Error of the speed along")[axis]
        error = (self.believed_speed - self.speed)[axis]
        return self._error_figure(title, "m/s", error, self._deviation(axis, ("vn", "ve")))

    def innovation(self, sensor: str) -> figure:
        """The innovation of a measurement with its own deviation (Figs. 49 to 51)."""
        scale, unit = (1.0, "m") if sensor == "laser" else (1e3, "mrad")
        values = scale * self.estimate[f"{sensor}_innovation"]
        variance = self.estimate[f"{sensor}_innovation_variance"]
        deviation = scale * np.sqrt(np.maximum(variance, 0.0))
        used = variance > 0.0
        values, deviation = (np.where(used, a, np.nan) for a in (values, deviation))
        return self._error_figure(f"Innovation: {sensor}", unit, values, deviation)

    def pitch_and_roll(self) -> figure:
        """The attitude, which a late picture is compared with (Figs. 40, 41)."""
        plot = self._landing_figure("Attitude", "deg")
        for angle, colour in (("pitch", BLUE), ("roll", ORANGE)):
            values = np.degrees(self.truth[angle][self.landing])
            plot.line(self.to_go, values, color=colour, line_width=1.2, legend_label=angle)
        return finish_figure(plot)

    def _error_figure(
        self, title: str, unit: str, error: np.ndarray, deviation: np.ndarray
    ) -> figure:
        plot = self._landing_figure(title, unit)
        cut = self.landing
        good = np.isfinite(error[cut]) & np.isfinite(deviation[cut])
        x, shown, envelope = self.to_go[good], error[cut][good], 3.0 * deviation[cut][good]
        uncertainty_band(plot, x, np.zeros_like(x), envelope, RED)
        for side in (-1.0, 1.0):
            plot.line(x, side * envelope, color=RED, line_width=1, legend_label="3 σ")
        plot.line(x, shown, color=BLUE, line_width=1.5, legend_label="error")
        if len(x):
            # the envelope of the first seconds would dwarf the rest
            limit = 1.2 * max(np.quantile(np.abs(shown), 0.99), np.quantile(envelope, 0.8), 1e-6)
            plot.y_range = Range1d(-float(limit), float(limit))
        return finish_figure(plot)

    def _landing_figure(self, title: str, unit: str) -> figure:
        plot = blank_figure(title, "distance to go (m)", unit, height=260, x_range=self.range)
        phase = self.phase[self.landing]
        for change in np.flatnonzero(np.diff(phase)) + 1:
            plot.add_layout(
                Span(
                    location=float(self.to_go[change]), dimension="height",
                    line_color="#8a8f9c", line_dash="dashed", line_width=1,
                )
            )  # fmt: skip
        return plot

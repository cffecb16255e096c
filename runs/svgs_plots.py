"""Plots of a landing beside SVGS beacons, in the manner of the SVGS paper's Figures 14 to 20."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pyarrow as pa
from bokeh.layouts import column, gridplot
from bokeh.models import DataRange1d, Label, Span
from bokeh.models.layouts import LayoutDOM
from bokeh.plotting import figure

from diagrams.scenario import MultirotorLanding
from plants.svgs_beacons import BEACON_NAMES
from runs.plots import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    RunPlots,
    blank_figure,
    finish_figure,
)
from systems.supervisors.svgs_routine import SvgsRoutineConfig
from systems.vision.svgs_selection import (
    AMBIGUOUS,
    BAD_GEOMETRY,
    ERRORS,
    NOT_SOLVED,
    TOO_FEW_BLOBS,
    TOO_MANY_BLOBS,
    UNCONFIRMED,
)

# The colour code of the paper's Figures 17 to 19: short, medium, long.
BEACON_COLOURS = ("#2f9e44", "#d5302b", "#15aabf")
ZONE = 1.0  # m, radius of the expected landing zone in Figures 14 and 15
# What a frame without a pose is called where `ERRORS` is too long.
_BRIEF = {
    TOO_FEW_BLOBS: "too few blobs",
    TOO_MANY_BLOBS: "too many blobs",
    BAD_GEOMETRY: "no beacon",
    NOT_SOLVED: "not solved",
    AMBIGUOUS: "ambiguous",
    UNCONFIRMED: "unconfirmed",
}
_POINTS = 3000  # about so many of a line
_MEASUREMENTS = ("svgs", "target_measurement", "touchdown")  # every one counts
_INSTANCE_COLOURS = (RED, BLUE, GREEN, PURPLE)
_AROUND = 3.0  # s, before and after a change of instance
_NEAR = 4.5  # m, of the landing point: LEDs further away are left out of the landing zone
_TILT, _TURN = math.radians(22.0), math.radians(35.0)  # of the view in `trajectory`


class SvgsPlots(RunPlots):
    """The plots of one run that has an SVGS camera.

    Positions are in the paper's frame: forward, left and up as the vehicle stood before take-off,
    from the landing point.

    Parameters
    ----------
    log : pa.Table
        The run's log.
    states : sequence of str
        Names of the supervisor's states, by index.
    scenario : MultirotorLanding
        What flew.
    """

    def __init__(self, log: pa.Table, states: Sequence[str], scenario: MultirotorLanding):
        super().__init__(log, states)
        self.body = _thinned(self.body)
        channel = scenario.sensors.svgs_camera
        if channel is None:
            raise ValueError("the scenario has no SVGS camera")
        self.beacons = channel.sensor.beacons
        self.scenario = scenario
        self._yaw = scenario.vehicle.yaw
        self._pad_yaw = scenario.pad.yaw
        self.sightings = self._sightings()

    def layout(self) -> LayoutDOM:
        """All plots, one under the other, time axes linked."""
        plane = gridplot(
            [[self.landing_zone(), self.trajectory()]],
            sizing_mode="stretch_width",
            toolbar_location=None,
        )
        time = [self.along(axis) for axis in range(3)]
        more = [self.handover(), self.alignment()]
        if self.port("selection") is not None:
            more += [self.instances(), self.change()]
        return column(plane, *time, *more, sizing_mode="stretch_width")

    def _flu(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north as forward and left."""
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        return c * x + s * y, c * y - s * x

    def _track(self, samples: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Forward, left and up of a port's `p_WB`."""
        forward, left = self._flu(samples["p_WB_x"], samples["p_WB_y"])
        return forward, left, samples["p_WB_z"]

    def port(self, name: str) -> dict[str, np.ndarray] | None:
        """The samples of a port, of a long flight every few only."""
        samples = super().port(name)
        return samples if samples is None or name in _MEASUREMENTS else _thinned(samples)

    def _sightings(self) -> dict[str, np.ndarray]:
        """Where SVGS puts the vehicle: time, beacon, forward, left, up of every pose taken."""
        packets, poses = self.port("svgs"), self.port("target_measurement")
        if packets is None or poses is None:
            return {name: np.empty(0) for name in ("time", "beacon", "f", "l", "u")}
        valid = packets["valid"] > 0.5
        validity, beacon = packets["time_of_validity"][valid], packets["beacon"][valid]
        order = np.argsort(validity)
        at = np.searchsorted(validity[order], poses["time_of_validity"] - 1e-6)
        at = np.minimum(at, len(order) - 1)
        forward, left = self._flu(-poses["p_BP_W_x"], -poses["p_BP_W_y"])
        return {
            "time": poses["time_of_validity"],
            "beacon": beacon[order][at],
            "f": forward,
            "l": left,
            "u": -poses["p_BP_W_z"],
        }

    # ------------------------------------------------------------ in space

    def landing_zone(self) -> figure:
        """Figure 14: the landing zone, the beacons and where the vehicle stands."""
        plot = blank_figure(
            "Landing zone", "forward (m)", "left (m)", match_aspect=True, height=460
        )
        plot.circle(0.0, 0.0, radius=ZONE, fill_alpha=0.0, line_color=INK, legend_label="zone, 1 m")
        c, s = math.cos(self._pad_yaw), math.sin(self._pad_yaw)
        for beacon, name, colour in zip(
            self.beacons.beacons(), BEACON_NAMES, BEACON_COLOURS, strict=True
        ):
            x, y, _ = beacon.led_positions_in_pad().T
            near = np.hypot(x, y) < _NEAR
            if not near.any():
                continue
            forward, left = self._flu((c * x - s * y)[near], (s * x + c * y)[near])
            plot.scatter(forward, left, size=9, color=colour, legend_label=f"{name}-range LEDs")
        final = self._final()
        forward, left, _ = self._track(self.body)
        plot.line(forward[final], left[final], color=BLUE, line_width=2, legend_label="truth")
        plot.scatter([0.0], [0.0], marker="cross", size=14, color=INK, line_width=2,
                     legend_label="commanded")  # fmt: skip
        touchdown = self.port("touchdown")
        if touchdown is not None and touchdown["time"][-1] >= 0.0:
            x, y = touchdown["offset_x"][-1], touchdown["offset_y"][-1]
            f, left_of = (float(v) for v in self._flu(np.array(x), np.array(y)))
            plot.scatter([f], [left_of], marker="x", size=15, line_width=3, color=RED,
                         legend_label=f"landed {math.hypot(x, y):.2f} m off")  # fmt: skip
            rotors = self.scenario.vehicle.resolved_vehicle()
            reach = max(math.hypot(*p[:2]) for p in rotors.rotor_positions) + rotors.rotor_radius
            plot.circle(
                f, left_of, radius=reach, fill_color=SKY, fill_alpha=0.15, line_color=SKY,
                legend_label="vehicle",
            )  # fmt: skip
        return _legend_aside(finish_figure(plot), "right")

    def trajectory(self) -> figure:
        """Figure 20: the landing in space, seen from above and aside; heights are drawn shorter."""
        plot = blank_figure(
            "Trajectory", "", "", height=460, x_range=DataRange1d(range_padding=0.2)
        )
        plot.axis.visible = False
        plot.grid.visible = False
        started = max(self._landing_started(), 0.0)
        tracks = []
        for name, colour, dash in (("setpoint", ORANGE, "dotted"), ("body", BLUE, "solid")):
            samples = self.port(name)
            if samples is not None:
                landing = samples["time"] >= started
                track = [np.asarray(values)[landing] for values in self._track(samples)]
                tracks.append((name, track, colour, dash))
        f, left, up = next(track for name, track, _, _ in tracks if name == "body")
        side = max(float(np.abs(np.concatenate([f, left])).max()), 2.0)
        shorten = 2.0 * side / max(float(up.max()), 1.0)

        def project(f: np.ndarray, left: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, ...]:
            c, s = math.cos(_TURN), math.sin(_TURN)
            across, away = c * f - s * left, s * f + c * left
            return across, math.cos(_TILT) * shorten * up + math.sin(_TILT) * away

        corners_f = side * np.array([-1.0, 1.0, 1.0, -1.0, -1.0])
        corners_l = side * np.array([-1.0, -1.0, 1.0, 1.0, -1.0])
        for height in np.linspace(0.0, up.max(), 5):
            level = project(corners_f, corners_l, np.full(5, height))
            plot.line(*level, color="#d5d8de", line_width=1)
            x, y = project(np.array([-side]), np.array([side]), np.array([height]))
            plot.add_layout(
                Label(x=float(x[0]), y=float(y[0]), text=f"{height:.0f} m ", text_align="right",
                      text_font_size="8pt", text_color="#8a8f9c")
            )  # fmt: skip
        for name, track, colour, dash in tracks:
            label = "truth" if name == "body" else name
            ahead, aside, high = track
            plot.line(*project(ahead, aside, high), color=colour, line_dash=dash, line_width=1.8,
                      legend_label=label)  # fmt: skip
        for beacon, name in enumerate(BEACON_NAMES):
            used = self.sightings["beacon"] == beacon
            used &= self.sightings["time"] >= started
            ahead, aside, high = (self.sightings[axis][used] for axis in "flu")
            plot.scatter(
                *project(ahead, aside, high),
                size=2.5,
                alpha=0.5,
                color=BEACON_COLOURS[beacon],
                legend_label=f"SVGS, {name}-range",
            )
        return _legend_aside(finish_figure(plot), "right")

    def _final(self) -> np.ndarray:
        """The samples of the landing below 5 m."""
        started = self._landing_started()
        return (self.body["p_WB_z"] < 5.0) & (self.body["time"] >= started) & (started >= 0.0)

    # ----------------------------------------------------------------- in time

    def along(self, axis: int) -> figure:
        """Figures 17 to 19: one axis of the position, as commanded, estimated, seen and true."""
        name = ("Forward", "Left", "Up")[axis]
        plot = self._time_figure(name, "m")
        for beacon, beacon_name in enumerate(BEACON_NAMES):
            used = self.sightings["beacon"] == beacon
            plot.scatter(
                self.sightings["time"][used],
                self.sightings["flu"[axis]][used],
                size=3,
                alpha=0.6,
                color=BEACON_COLOURS[beacon],
                legend_label=f"SVGS, {beacon_name}-range",
            )
        setpoint, estimate = self.port("setpoint"), self.port("estimate")
        if setpoint is not None:
            plot.line(setpoint["time"], self._track(setpoint)[axis], color=ORANGE,
                      line_dash="dotted", line_width=1.5, legend_label="setpoint")  # fmt: skip
        if estimate is not None:
            known = estimate["horizontal_valid"] > 0.5
            plot.line(estimate["time"][known], self._track(estimate)[axis][known], color=SKY,
                      line_width=1.5, legend_label="fused estimate")  # fmt: skip
        plot.line(self.body["time"], self._track(self.body)[axis], color=BLUE, line_width=1.5,
                  legend_label="truth")  # fmt: skip
        return _legend_aside(self._finish_time(plot), "above")

    def handover(self) -> figure:
        """Which beacon each packet of the phone is about, and the errors."""
        packets = self.port("svgs")
        rows: list[tuple[str, np.ndarray, str]] = []
        if packets is not None:
            valid = packets["valid"] > 0.5
            for beacon, name in enumerate(BEACON_NAMES):
                seen = valid & (packets["beacon"] == beacon)
                rows.append((f"{name}-range", packets["time"][seen], BEACON_COLOURS[beacon]))
            for code, text in ERRORS.items():
                wrong = ~valid & (packets["error_code"] == code)
                if wrong.any():
                    rows.append((_BRIEF.get(code, text), packets["time"][wrong], PURPLE))
        names = [name for name, _, _ in rows]
        plot = self._time_figure(
            "Beacon hand-over", "", height=90 + 22 * len(rows), y_range=list(reversed(names))
        )
        for name, times, colour in rows:
            plot.scatter(times, [name] * len(times), marker="dash", angle=math.pi / 2, size=12,
                         line_width=1.2, color=colour, alpha=0.8)  # fmt: skip
        return plot

    def alignment(self) -> figure:
        """How far the vehicle is from the point that it should be over."""
        plot = self._time_figure("Distance from the point aligned with", "m")
        routine = self.scenario.guidance.routine
        started = self._landing_started()
        if not isinstance(routine, SvgsRoutineConfig) or started < 0.0:
            return self._finish_time(plot)
        time = self.body["time"]
        points = [routine.approach_point, routine.short_point, [0.0, 0.0]]
        stage = np.zeros(len(time), int)
        for number, state in ((1, "offset to short"), (2, "final offset")):
            begun = self._first(state)
            if begun is not None:
                stage[time >= begun] = number
        c, s = math.cos(routine.beacon_heading), math.sin(routine.beacon_heading)
        aims = np.array([[c * x - s * y, s * x + c * y] for x, y in points])[stage]
        distance = np.hypot(self.body["p_WB_x"] - aims[:, 0], self.body["p_WB_y"] - aims[:, 1])
        height = np.maximum(self.body["p_WB_z"], 0.0)
        radius = routine.align_radius + routine.align_slope * height
        for number, (name, colour) in enumerate(
            zip(("approach point", "beside the short-range beacon", "landing point"),
                (BEACON_COLOURS[1], BEACON_COLOURS[0], BLUE), strict=True)
        ):  # fmt: skip
            on = (stage == number) & (time >= started)
            plot.line(time[on], distance[on], color=colour, line_width=1.8, legend_label=name)
        on = time >= started
        plot.line(time[on], radius[on], color=INK, line_dash="dotted", legend_label="aligned")
        return _legend_aside(self._finish_time(plot), "above")

    def _first(self, state: str) -> float | None:
        """When the supervisor first was in a state, s."""
        if state not in self.states:
            return None
        there = self.supervisor["state"].astype(int) == self.states.index(state)
        return float(self.supervisor["time"][there][0]) if there.any() else None

    def instances(self) -> figure:
        """The combined test ratio of each EKF2 instance, the selected one's drawn thick."""
        plot = self._time_figure("EKF2 instances: combined test ratio, the selected one thick", "")
        selection = self.port("selection")
        if selection is not None:
            for i, colour in enumerate(_INSTANCE_COLOURS[: self._instances(selection)]):
                ratio = selection[f"combined_test_ratio_{i}"]
                label = f"instance {i}"
                plot.line(selection["time"], ratio, color=colour, alpha=0.7, legend_label=label)
                chosen = np.where(selection["selected"] == i, ratio, np.nan)
                plot.line(selection["time"], chosen, color=colour, line_width=3.5,
                          legend_label=label)  # fmt: skip
                ill = (selection[f"healthy_{i}"] < 0.5) & (selection["time"] > 15.0)
                if ill.any():
                    plot.scatter(selection["time"][ill], np.zeros(ill.sum()), marker="dash",
                                 angle=math.pi / 2, size=8, color=colour,
                                 legend_label=f"{label} unhealthy")  # fmt: skip
        return _legend_aside(self._finish_time(plot), "above")

    @staticmethod
    def _instances(selection: dict[str, np.ndarray]) -> int:
        return sum(name.startswith("combined_test_ratio_") for name in selection)

    def change(self) -> figure:
        """Estimate, setpoint and vehicle around the change of instance that jumps farthest."""
        selection = super().port("selection")
        assert selection is not None
        flying = np.interp(selection["time"], self.body["time"], self.body["p_WB_z"]) > 1.0
        changed = np.flatnonzero((np.diff(selection["changes"], prepend=0.0) > 0.0) & flying)
        if len(changed) == 0:
            return finish_figure(
                blank_figure("No change of instance in flight", "time (s)", "m", height=220)
            )
        jumps = np.array(
            [self._flu(selection["position_jump_x"][k], selection["position_jump_y"][k])
             for k in changed]
        )  # fmt: skip
        worst = int(np.argmax(np.abs(jumps).max(axis=1)))
        axis = int(np.argmax(np.abs(jumps[worst])))
        time = float(selection["changed"][changed[worst]])
        before = int(selection["selected"][changed[worst] - 1])
        after = int(selection["selected"][changed[worst]])
        plot = blank_figure(
            f"Instance {before} hands over to {after} at {time:.1f} s",
            "time (s)",
            f"{('forward', 'left')[axis]} (m)",
            height=300,
        )
        for name, colour, dash, label in (
            ("setpoint", ORANGE, "dotted", "setpoint"),
            ("estimate", SKY, "solid", "estimate"),
            ("body", BLUE, "solid", "truth"),
        ):
            samples = super().port(name)
            if samples is None:
                continue
            near = np.abs(samples["time"] - time) <= _AROUND
            plot.line(samples["time"][near], self._track(samples)[axis][near], color=colour,
                      line_dash=dash, line_width=2, legend_label=label)  # fmt: skip
        plot.add_layout(Span(location=time, dimension="height", line_color=INK, line_dash="dashed"))
        return _legend_aside(finish_figure(plot), "right")


def _legend_aside(plot: figure, place: Literal["right", "above"]) -> figure:
    """Move the legend out of the plot."""
    if plot.legend:
        legend = plot.legend[0]
        plot.center.remove(legend)
        if place == "above":
            legend.orientation, legend.spacing = "horizontal", 14
        plot.add_layout(legend, place)
    return plot


def _thinned(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Every n-th sample, so that about `_POINTS` remain."""
    step = max(1, len(samples["time"]) // _POINTS)
    return {name: values[::step] for name, values in samples.items()}

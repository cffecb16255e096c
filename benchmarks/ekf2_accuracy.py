"""`python -m benchmarks.ekf2_accuracy [FOLDER]`: EKF2 beside PX4's answers and real logs.

Prints the tables of docs/ekf2.md; FOLDER is where its figures go. Needs the reference data,
see `tests.shared_data`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from runs.flight_log import FlightLog
from runs.log_sources import read_log
from runs.replay import (
    AID_COLUMNS,
    DELAYED_COLUMNS,
    OUTPUT_COLUMNS,
    Replay,
    parameter_array,
    parameter_values,
    play,
)
from runs.replay_sweep import Sweep, parse_sweep, sweep
from runs.replay_tables import against_on_board
from runs.simulated_log import PLAUSIBLE, Rates, simulated_log, without
from studies.figures import MEDIAN, PALETTE, figure, style
from systems.estimators.ekf2 import layout as at
from systems.signals import sensor_log as logs
from tests.runs.test_replay import CASES
from tests.shared_data import shared

LOGS = (
    ("outdoor_gps_quad", 10.0, 60.0),
    ("indoor_vision_no_gps", 5.0, 60.0),
    ("sitl_takeoff_return_land", 10.0, 30.0),
)
SLOW_MAGNETOMETER, SLOW_BAROMETER = 12, 5  # of 25 Hz: as seldom as the outdoor log has them
# gauss: how uncertain the fields are to the filter on board of the outdoor log before take-off
LEARNING = replace(PLAUSIBLE, earth_field=0.036, body_field=0.036)
VISION_ONLY = {"EKF2_GPS_CTRL": 0, "EKF2_EV_CTRL": 3, "EKF2_DELAY_MAX": 400, "EKF2_HGT_REF": 3}


def reference_table() -> list[str]:
    """The largest difference to PX4's own answers, over all rows."""
    lines = [
        "| stream | quaternion | velocity (m/s) | north, east (m) | down (m) | gyro bias (rad/s) "
        "| accel bias (m/s2) | variances | other flags |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    groups = ("q0 q1 q2 q3", "vn ve vd", "pn pe", "pd", "gbx gby gbz", "abx aby abz")
    for name, source, defaults, values, _, first in CASES:
        log = read_log(shared(f"data/px4-ekf2/{source}_input.csv.gz"))
        replay = play(log.samples, parameter_array(log, values, defaults))
        golden = pd.read_csv(shared(f"data/px4-ekf2/{name}_delayed.csv.gz"))
        golden = golden[golden.t_arrival_us >= first].set_index("t_arrival_us")
        ours = pd.DataFrame(replay.delayed, columns=DELAYED_COLUMNS).set_index("t_arrival_us")
        ours = ours.loc[golden.index]
        cells = [
            f"{np.abs(golden[g.split()] - ours[g.split()]).to_numpy().max():.1e}" for g in groups
        ]
        variances = [f"P{i}" for i in range(at.ERRORS)]
        worst = np.abs(ours[variances] / golden[variances] - 1.0).to_numpy().max()
        flags = int((ours.control_status != golden.control_status).sum())
        aid = pd.read_csv(shared(f"data/px4-ekf2/{name}_aid.csv.gz"))
        own = pd.DataFrame(replay.aid, columns=AID_COLUMNS)
        own["source"] = [at.AID_NAMES[int(i)] for i in own.source]
        both = aid.merge(own, on=["t_arrival_us", "source", "axis"])
        for column in ("fused", "innov_rejected"):
            flags += int((both[f"{column}_x"] != both[f"{column}_y"]).sum())
        flags += abs(len(aid) - len(both))
        lines.append(f"| `{name}` | {' | '.join(cells)} | {100 * worst:.2f} % | {flags} |")
    return lines


def _replayed(log: FlightLog, warm: bool) -> Replay:
    p = parameter_array(log, parameter_values(log))
    return play(log.samples, p, log.start if warm else None)


def log_table() -> list[str]:
    """Root mean square distance to the estimates on board."""
    lines = [
        "| log | from … to (s) | start | attitude (deg) | velocity (m/s) | north, east (m) |",
        "|---|---|---|---|---|---|",
    ]
    for name, first, last in LOGS:
        log = read_log(shared(f"data/ulg/{name}.ulg"))
        for warm in (True, False) if log.start is not None else (False,):
            replay = _replayed(log, warm)
            cells = []
            for quantity, axes in (("attitude", 1), ("velocity", 3), ("position", 2)):
                time, error = against_on_board(replay, log)[quantity]
                time = time - 1e-6 * replay.output[0, 0]
                inside = (time > first) & (time < last)
                squares = np.sum(error[inside, :axes] ** 2, axis=1)
                cells.append(f"{np.sqrt(np.nanmean(squares)):.2f}")
            lines.append(
                f"| `{name}` | {first:.0f} … {last:.0f} | {'warm' if warm else 'cold'} | "
                f"{' | '.join(cells)} |"
            )
    return lines


def _turn(log: FlightLog, replay: Replay) -> tuple[np.ndarray, np.ndarray]:
    """From the attitude on board to the replayed one (deg, about north, east, down), and when."""
    assert log.on_board is not None
    theirs, ours = log.on_board.attitude, replay.output
    theirs = theirs[(theirs[:, 0] >= ours[0, 0]) & (theirs[:, 0] <= ours[-1, 0])]
    newest = np.searchsorted(ours[:, 0], theirs[:, 0], side="right") - 1
    own = Rotation.from_quat(np.roll(ours[newest, 1:5], -1, axis=1))
    other = Rotation.from_quat(np.roll(theirs[:, 1:], -1, axis=1))
    return 1e-6 * (theirs[:, 0] - ours[0, 0]), np.degrees((own * other.inv()).as_rotvec())


def thinned_heading(seeds: int = 20) -> tuple[float, float]:
    """What seldom samples alone do: rms of tilt and heading (deg) between two replays.

    Both see the same simulated flights; one has as few magnetometer and barometer samples as
    the outdoor log.
    """
    squares = []
    column = OUTPUT_COLUMNS.index("q0")
    for seed in range(seeds):
        samples, _ = simulated_log(seed, 60.0, LEARNING)
        log = FlightLog("", samples)
        p = parameter_array(log, {"EKF2_GPS_CHECK": 1055, "EKF2_REQ_GPS_H": 2.0})
        thin = without(samples, logs.MAGNETOMETER, SLOW_MAGNETOMETER)
        thin = without(thin, logs.BAROMETER, SLOW_BAROMETER)
        attitudes = []
        for own in (samples, thin):
            output = play(own, p).output
            late = output[:, 0] > output[0, 0] + 20e6
            attitudes.append(
                Rotation.from_quat(np.roll(output[late, column : column + 4], -1, axis=1))
            )
        squares.append(np.mean((attitudes[0] * attitudes[1].inv()).as_rotvec() ** 2, axis=0))
    north, east, down = np.mean(squares, axis=0)
    return float(np.degrees(np.sqrt(north + east))), float(np.degrees(np.sqrt(down)))


def draw_on_board(path: Path) -> None:
    """Tilt and heading against the on-board ones over time, for both starts."""
    log = read_log(shared("data/ulg/outdoor_gps_quad.ulg"))
    with style():
        drawn = figure(9.0, 3.0)
        axes = drawn.subplots(1, 2, sharex=True)
        for warm, colour in ((False, PALETTE[1]), (True, PALETTE[2])):
            time, turn = _turn(log, _replayed(log, warm))
            flying = time < 65.0
            for ax, angle in zip(axes, (np.hypot(turn[:, 0], turn[:, 1]), turn[:, 2]), strict=True):
                label = "from the state on board" if warm else "started anew"
                ax.plot(time[flying], angle[flying], color=colour, label=label, lw=1.3)
        for ax, title, limit in (
            (axes[0], "tilt: replayed against on board (deg)", (0.0, 8.0)),
            (axes[1], "heading: replayed − on board (deg)", (-10.0, 10.0)),
        ):
            ax.set_ylim(*limit)
            ax.set_title(title)
            ax.set_xlabel("time in the log (s)")
        axes[1].legend(loc="upper right")
        drawn.set_layout_engine("tight")
        drawn.savefig(path, dpi=110, facecolor="white")


def vision_sweep() -> Sweep:
    """The delay of a camera, 200 ms, found again in a simulated flight without GNSS."""
    samples, _ = simulated_log(1, 60.0, PLAUSIBLE, Rates(gnss=0.0, vision=10.0, vision_delay=0.2))
    name, tried = parse_sweep("EKF2_EV_DELAY=100:300:10")
    return sweep(FlightLog("simulated", samples), VISION_ONLY, "module", name, tried, workers=2)


def draw_sweep(found: Sweep, path: Path) -> None:
    """Score and mean normalised innovation squared over the delay."""
    values = [point.value for point in found.points]
    with style():
        drawn = figure(9.0, 2.8)
        axes = drawn.subplots(1, 2)
        for ax, what, title in (
            (axes[0], "score", "mean log-likelihood of an innovation (more is better)"),
            (axes[1], "nis", "mean normalised innovation squared"),
        ):
            ax.axvspan(*found.interval, color=PALETTE[0], alpha=0.3, lw=0)
            heights = [getattr(point, what) for point in found.points]
            ax.plot(values, heights, "o-", color=PALETTE[2], ms=3.5, lw=1.3)
            ax.axvline(found.best.value, color=MEDIAN, lw=1.2)
            ax.set_title(title)
            ax.set_xlabel(f"{found.parameter} (ms)")
        drawn.set_layout_engine("tight")
        drawn.savefig(path, dpi=110, facecolor="white")


def main(folder: str = "") -> None:
    """Print the tables and draw the figures."""
    print("\n".join([*reference_table(), "", *log_table(), ""]))
    tilt, heading = thinned_heading()
    print(f"Seldom samples alone: tilt {tilt:.2f} deg, heading {heading:.2f} deg rms\n")
    found = vision_sweep()
    low, high = found.interval
    print(f"Sweep: best {found.best.value:.0f} ms, {low:.0f} to {high:.0f} ms not worse")
    if folder:
        draw_on_board(Path(folder) / "ekf2-on-board.png")
        draw_sweep(found, Path(folder) / "ekf2-sweep.png")


if __name__ == "__main__":
    main(*sys.argv[1:2])

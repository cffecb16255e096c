"""`python -m benchmarks.ekf2_consistency [SEEDS [FOLDER]]`: does EKF2 know its own errors?

Many simulated flights, 200 by default, each with sensor errors of its own. Of every
flight and second the normalised estimation error squared of a group of states,
NEES = eᵀ P⁻¹ e, has on average as many units as the group has states, if the filter is
consistent; the mean over N flights lies within the 2.5 and 97.5 % quantiles of χ²(N d)/N
(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", section 5.4.2). Likewise the normalised innovation squared, ν²/S, has mean 1 an
axis. FOLDER is where the figure goes.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from runs.replay import play_in_pieces
from runs.simulated_log import (
    EARTH_FIELD,
    MATCHED,
    ORIGIN,
    PLAUSIBLE,
    WRONG_HEADING,
    Errors,
    Truth,
    simulated_log,
)
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.fusion import covariance
from systems.estimators.ekf2.geometry import metres_per_radian

SECONDS = 60.0
SETTLED = 20.0  # s, from here on the vehicle flies and everything is aligned
# The receiver's wander would fail PX4's drift checks on the ground, which are not meant here.
PARAMETERS = {"EKF2_DELAY_MAX": 200, "EKF2_GPS_CHECK": 1055, "EKF2_REQ_GPS_H": 2.0}
GROUPS = {
    "attitude": slice(0, 3),
    "velocity": slice(3, 6),
    "position": slice(6, 9),
    "gyro bias": slice(9, 12),
    "accel bias": slice(12, 15),
    "all 15": slice(0, 15),
}
SOURCES = ("gnss_pos", "gnss_vel", "gnss_hgt", "baro_hgt", "mag")
CASES = {
    "errors as the parameters say": MATCHED,
    "and a first heading 15 deg wrong": WRONG_HEADING,
    "a plausible vehicle": PLAUSIBLE,
}


@dataclass(frozen=True)
class Flight:
    """One flight: NEES of each group and second, mean NIS of each source, and how many.

    Attributes
    ----------
    nees : np.ndarray
        Shape (seconds, groups).
    nis : np.ndarray
        Sum of ν²/S over axes and observations, and how many those are, shape (sources, 2).
    """

    nees: np.ndarray
    nis: np.ndarray


def parameters() -> np.ndarray:
    """Of the filter: PX4's defaults."""
    return prm.parameter_array(PARAMETERS, earth_field=EARTH_FIELD)


def fly(errors: Errors, seed: int, seconds: float = SECONDS) -> Flight:
    """One simulated flight through the filter."""
    samples, truth = simulated_log(seed, seconds, errors)
    times = np.arange(SETTLED, seconds) * 1e6 + truth.time[0]
    nees, aid = [], []
    for piece in play_in_pieces(samples, parameters(), list(times)):
        error = errors_of(piece.state, truth)
        P = covariance(piece.state)
        nees.append([
            error[group] @ np.linalg.solve(P[group, group], error[group])
            for group in GROUPS.values()
        ])  # fmt: skip
        aid.append(piece.aid)
    rows = np.concatenate(aid[1:])  # the first piece is the start
    nis = []
    for source in SOURCES:
        own = rows[rows[:, 2] == at.AID_NAMES.index(source)]
        nis.append([np.sum(own[:, 7] ** 2 / own[:, 8]), len(own)])
    return Flight(np.array(nees[:-1]), np.array(nis))


def errors_of(x: np.ndarray, truth: Truth) -> np.ndarray:
    """Attitude (global, rad), velocity, position and bias errors at the horizon, shape (15,)."""
    k = int(np.searchsorted(truth.time, x[at.TIME_DELAYED]))
    estimated = Rotation.from_quat(np.roll(x[at.QUATERNION : at.QUATERNION + 4], -1))
    true = Rotation.from_quat(np.roll(truth.attitude[k], -1))
    north, east = metres_per_radian(x[at.LATITUDE], x[at.ALTITUDE])
    position = np.array([
        (x[at.LATITUDE] - np.radians(ORIGIN[0])) * north,
        (x[at.LONGITUDE] - np.radians(ORIGIN[1])) * east,
        ORIGIN[2] - x[at.ALTITUDE],
    ])  # fmt: skip
    return np.concatenate([
        (true * estimated.inv()).as_rotvec(),
        truth.velocity[k] - x[at.VELOCITY : at.VELOCITY + 3],
        truth.position[k] - position,
        truth.gyro_bias[k] - x[at.GYRO_BIAS : at.GYRO_BIAS + 3],
        truth.accel_bias[k] - x[at.ACCEL_BIAS : at.ACCEL_BIAS + 3],
    ])  # fmt: skip


def band(degrees: int, flights: int) -> tuple[float, float]:
    """95 % band of the mean of `flights` values of χ²(degrees)."""
    low, high = chi2.ppf([0.025, 0.975], degrees * flights) / flights
    return float(low), float(high)


def study(errors: Errors, seeds: int, workers: int = 2) -> list[Flight]:
    """Many flights."""
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(partial(fly, errors), range(seeds), chunksize=8))


def table(flights: list[Flight]) -> list[str]:
    """NEES and NIS as lines of Markdown."""
    nees = np.mean([flight.nees for flight in flights], axis=0)  # (seconds, groups)
    lines = ["| NEES of | states | mean | 95 % band | seconds inside |", "|---|---|---|---|---|"]
    for i, (name, group) in enumerate(GROUPS.items()):
        d = group.stop - group.start
        low, high = band(d, len(flights))
        inside = np.mean((nees[:, i] >= low) & (nees[:, i] <= high))
        lines.append(
            f"| {name} | {d} | {nees[:, i].mean():.2f} | {low:.2f} … {high:.2f} | "
            f"{100 * inside:.0f} % |"
        )
    nis = np.sum([flight.nis for flight in flights], axis=0)
    lines += ["", "| NIS of | an axis | 95 % band if white |", "|---|---|---|"]
    for source, (total, count) in zip(SOURCES, nis, strict=True):
        low, high = chi2.ppf([0.025, 0.975], count) / count
        lines.append(f"| {source} | {total / count:.3f} | {low:.3f} … {high:.3f} |")
    return lines


def draw(cases: dict[str, list[Flight]], path: Path) -> None:
    """NEES over the states of each group, and its band, over time."""
    from studies.figures import PALETTE, figure, style

    with style():
        drawn = figure(11.0, 3.2)
        axes = drawn.subplots(1, len(cases), sharey=True)
        for ax, (name, flights) in zip(axes, cases.items(), strict=True):
            nees = np.mean([flight.nees for flight in flights], axis=0)
            time = SETTLED + np.arange(len(nees))
            for i, (group, states) in enumerate(list(GROUPS.items())[:-1]):
                d = states.stop - states.start
                ax.plot(time, nees[:, i] / d, color=PALETTE[i + 1], label=group, lw=1.5)
            low, high = np.array(band(3, len(flights))) / 3.0
            ax.axhspan(low, high, color=PALETTE[0], alpha=0.35, lw=0, label="95 % band")
            ax.set_yscale("log")
            ax.set_title(name)
            ax.set_xlabel("time (s)")
        axes[0].set_ylabel("NEES / number of states")
        axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8.5)
        drawn.set_layout_engine("tight")
        drawn.savefig(path, dpi=110, facecolor="white")


def main(seeds: int = 200, folder: str = "") -> None:
    """Print the tables, and draw the figure if there is a folder for it."""
    cases = {name: study(errors, seeds) for name, errors in CASES.items()}
    for name, flights in cases.items():
        print(f"\n{name}, {len(flights)} flights of {SECONDS:.0f} s\n")
        print("\n".join(table(flights)))
    if folder:
        draw(cases, Path(folder) / "ekf2-consistency.png")


if __name__ == "__main__":
    main(*(int(sys.argv[1]) if len(sys.argv) > 1 else 200,), *sys.argv[2:])

"""A parameter tried at many values over one log, scored by the innovation test.

The score of a replay is the mean log-likelihood of an innovation,

    ln L = −½ (min(ν²/S, c²) + ln 2πS)

over all axes of the observations of the sensor that the parameter belongs to (of all
sensors if it belongs to none), whether they were fused or rejected; c = 5. It is taken
second by second, from 10 s after the first observation on, over the seconds that all
replays have, and the tenth at either end is left out, so that neither the start nor a few
outliers or resets decide. Besides stands the mean normalised innovation squared ν²/S of
the same seconds, which is 1 for a filter that knows its own errors.

A value is inside the interval if it is not distinguishably worse than the best one: the
paired differences of the score between their seconds have a trimmed mean of less than
1.96 standard errors.
"""

import math
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial

import numpy as np

from runs.flight_log import FlightLog, ReplayError
from runs.replay import parameter_array, play
from runs.replay_diagnosis import source_rows
from systems.estimators.ekf2.parameters import Defaults, Value, checked

_CAP = 5.0  # standard deviations
_BLOCK = 1e6  # us
_SETTLED = 10e6  # us
_TRIM = 0.1  # of the seconds, at either end
_QUANTILE = 1.96  # of the normal distribution, 95 %
_MOST = 10_000  # values
_SOURCES = {
    "EKF2_GPS_": ("gnss_vel", "gnss_pos", "gnss_hgt"),
    "EKF2_BARO_": ("baro_hgt",),
    "EKF2_MAG_": ("mag",),
    "EKF2_RNG_": ("rng_hgt",),
    "EKF2_EV": ("ev_pos", "ev_hgt", "ev_vel", "ev_yaw"),
}
_ALL = tuple(name for names in _SOURCES.values() for name in names)


@dataclass(frozen=True)
class SweepPoint:
    """One value: its score, mean normalised innovation squared, and how much was observed."""

    value: float
    score: float
    nis: float
    observations: int
    rejected: int
    inside: bool  # not distinguishably worse than the best


@dataclass(frozen=True)
class Sweep:
    """A swept parameter; `best` is the value of highest score."""

    parameter: str
    points: list[SweepPoint]
    best: SweepPoint

    @property
    def interval(self) -> tuple[float, float]:
        """Smallest and largest value that are not distinguishably worse than the best."""
        values = [point.value for point in self.points if point.inside]
        return min(values), max(values)


def parse_sweep(text: str) -> tuple[str, list[float]]:
    """The parameter and values of `NAME=FIRST:LAST:STEP`.

    Raises
    ------
    ReplayError
        If it is written otherwise, or there is no such parameter.
    """
    name, _, span = text.partition("=")
    try:
        first, last, step = (float(part) for part in span.split(":"))
        count = math.floor((last - first) / step + 1e-9) + 1
    except (ValueError, ZeroDivisionError, OverflowError):
        raise ReplayError(
            f"--sweep {text}: expected NAME=FIRST:LAST:STEP, e.g. EKF2_EV_DELAY=0:300:10"
        ) from None
    if not 1 <= count <= _MOST:
        raise ReplayError(f"--sweep {text}: expected 1 to {_MOST} values, not {count}")
    values = [first + i * step for i in range(count)]
    try:
        if name not in checked({name: values[0]}):
            raise ReplayError(f"--sweep {text}: {name} has no effect on this filter")
        for value in values:
            checked({name: value})
    except ReplayError:
        raise
    except ValueError as error:
        raise ReplayError(f"--sweep {text}: {error}") from None
    return name, values


def sweep(
    log: FlightLog,
    values: Mapping[str, Value],
    defaults: Defaults,
    parameter: str,
    tried: list[float],
    workers: int | None = None,
    progress: Callable[[], None] = lambda: None,
) -> Sweep:
    """Replay a log once for each value, on all cores.

    Parameters
    ----------
    log : FlightLog
        The log.
    values : mapping
        The other parameters.
    defaults : str
        Their defaults.
    parameter : str
        Which one is swept.
    tried : list of float
        Its values.
    workers : int, optional
        Processes; one a core if not given.
    progress : callable
        Called after each replay.

    Raises
    ------
    ReplayError
        If a value cannot be used, or nothing was observed with any of them.
    """
    run = partial(_score, log, dict(values), defaults, parameter)
    for value in tried:  # told at once, not by a worker
        parameter_array(log, {**values, parameter: value}, defaults)
    workers = min(workers or os.cpu_count() or 1, len(tried))
    scored: list[_Score] = []
    try:
        with ProcessPoolExecutor(workers) as pool:
            for result in pool.map(run, tried):
                scored.append(result)
                progress()
    except BrokenProcessPool:
        raise ReplayError("a process of the sweep was killed; try fewer values") from None
    observed = max((len(score.seconds) for score in scored), default=0)
    compared = [score for score in scored if len(score.seconds) >= 0.8 * observed]
    common = sorted(set.intersection(*(set(score.seconds) for score in compared)))
    if not common:
        raise ReplayError(
            f"--sweep {parameter}: the log has no {_SETTLED * 1e-6:.0f} s of observations "
            "to compare"
        )
    tables = [
        np.array([score.seconds[second] for second in common])
        if score in compared
        else np.full((len(common), 2), [-math.inf, math.nan])
        for score in scored
    ]
    means = [float(_trimmed_mean(table[:, 0])) for table in tables]
    best = int(np.argmax(means))
    points = [
        SweepPoint(
            value, mean, float(np.mean(table[:, 1])), score.observations, score.rejected,
            _not_worse(tables[best][:, 0] - table[:, 0]),
        )
        for value, mean, table, score in zip(tried, means, tables, scored, strict=True)
    ]  # fmt: skip
    return Sweep(parameter, points, points[best])


@dataclass(frozen=True, eq=False)
class _Score:
    """Of each second its mean log-likelihood and NIS; observations, and rejected ones."""

    seconds: dict[int, tuple[float, float]]
    observations: int
    rejected: int


def _score(
    log: FlightLog, values: dict[str, Value], defaults: Defaults, parameter: str, value: float
) -> _Score:
    p = parameter_array(log, {**values, parameter: value}, defaults)
    replay = play(log.samples, p, log.start)
    own = next((names for prefix, names in _SOURCES.items() if parameter.startswith(prefix)), _ALL)
    aid = np.concatenate(
        [source_rows(replay, name).reshape(-1, replay.aid.shape[1]) for name in own]
    )
    tested = (aid[:, 12] > 0.5) | (aid[:, 11] > 0.5)
    aid = aid[tested & (aid[:, 8] > 0.0) & np.isfinite(aid[:, 7])]
    rejected = int((aid[:, 11] > 0.5).sum())
    fused = aid[aid[:, 12] > 0.5, 0]
    if not len(fused):
        return _Score({}, len(aid), rejected)
    settled = aid[aid[:, 0] >= fused.min() + _SETTLED]
    squares = np.minimum(settled[:, 7] ** 2 / settled[:, 8], _CAP**2)
    likelihood = -0.5 * (squares + np.log(2.0 * np.pi * settled[:, 8]))
    seconds, which = np.unique((settled[:, 0] // _BLOCK).astype(np.int64), return_inverse=True)
    counts = np.bincount(which)
    means = np.column_stack(
        [np.bincount(which, values) / counts for values in (likelihood, squares)]
    )
    pairs = ((float(a), float(b)) for a, b in means)
    return _Score(dict(zip(seconds.tolist(), pairs, strict=True)), len(aid), rejected)


def _trimmed(values: np.ndarray) -> np.ndarray:
    cut = int(_TRIM * len(values))
    return np.sort(values)[cut : len(values) - cut]


def _trimmed_mean(values: np.ndarray) -> float:
    return float(np.mean(_trimmed(values)))


def _not_worse(difference: np.ndarray) -> bool:
    if not np.isfinite(difference).all():
        return False
    # the error of a trimmed mean, by the spread of what it leaves (a little optimistic)
    left = _trimmed(difference)
    error = float(np.std(left)) / math.sqrt(len(left)) / (1.0 - 2.0 * _TRIM)
    return float(np.mean(left)) <= _QUANTILE * error


def sweep_table(result: Sweep) -> str:
    """The sweep as CSV text."""
    lines = ["value,log_likelihood,nis,observations,rejected,inside"]
    lines += [
        f"{p.value:g},{p.score!r},{p.nis!r},{p.observations},{p.rejected},{int(p.inside)}"
        for p in result.points
    ]
    return "\n".join(lines) + "\n"

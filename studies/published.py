"""Published landings, trial by trial, and how a campaign is held against them.

The trials are those of G. Badakis, "Precision landing for drones combining
infrared and visible light sensors" (master thesis, University of Thessaly, 2020),
chapter 8 and appendices A to E: a hexacopter, 10 landings a row. Where the thesis
contradicts itself, `INCONSISTENCIES` says so; the trials are taken as printed.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

SIGNIFICANCE = 0.01  # of all tests of a study together
CONFIDENCE = 0.95  # of the intervals of differences


@dataclass(frozen=True)
class PublishedTrials:
    """One row of published results; arrays of shape (trials,)."""

    key: str  # what `Variant.published` names
    table: str  # of the thesis
    title: str
    error: NDArray[np.float64]  # m, of the camera from the pad's centre (Normal: from take-off)
    x: NDArray[np.float64]  # m, touchdown from there
    y: NDArray[np.float64]  # m
    time: NDArray[np.float64]  # s, of the landing


@dataclass(frozen=True)
class Comparison:
    """A campaign's distribution against a published one."""

    condition: str
    published: str  # key
    table: str
    title: str
    quantity: str  # "error" or "time"
    ours: int  # values compared
    theirs: int
    our_mean: float
    their_mean: float
    difference: float  # of the means, ours minus theirs
    low: float  # 95 % interval of the difference (Welch)
    high: float
    p: float  # that one distribution gave both, two-sided
    p_adjusted: float = float("nan")  # after Holm, over all comparisons of the study

    @property
    def agrees(self) -> bool:
        """Whether the trials leave open that both are one distribution, at `SIGNIFICANCE`."""
        return self.p_adjusted >= SIGNIFICANCE

    @property
    def verdict(self) -> str:
        """One sentence: agrees, or differs and by how much."""
        scale, unit = (100.0, "cm") if self.quantity == "error" else (1.0, "s")
        means = f"mean {self.our_mean * scale:.1f} {unit} against {self.their_mean * scale:.1f}"
        interval = f"95 % interval {self.low * scale:+.1f} to {self.high * scale:+.1f} {unit}"
        if self.agrees:
            return f"agrees: {means} (difference {interval})"
        if self.low <= 0.0 <= self.high:
            return f"differs in shape: {means} (difference {interval})"
        way = "more" if self.difference > 0.0 else "less"
        size = f"{abs(self.difference) * scale:.1f} {unit}"
        return f"differs: {size} {way}, {means} ({interval})"


# Where the thesis contradicts itself.
INCONSISTENCIES = (
    "Section 8.2.4 says 6.79 cm for IRLock without failure; the trials of Table 7 average "
    "5.79 cm, as Table 3 has it.",
    "Section 8.2.4 says 11.50 cm for Marker, random 0.50; Table 3 and the trials of Table 11 "
    "give 11.05 cm.",
    "Section 8.2.5 says a worst case of 20 to 21 cm for the fused sensor with at most one "
    "failing; Table 13 (no failure) has 24.6 and 24.1 cm.",
    'The row "Default" of Table 5 equals Table 12 in error and time, which was flown in calm '
    "air, while section 8.2.6 says its weather was that of the windy second set.",
    "Table 4 gives 6 m as the initial height of one fused row; section 8.2.2 says all fused "
    "landings began at 10 m.",
    "Table 6, trial 1: the error is given as 95 cm, its x and y as 94.2 cm.",
)

_TITLES = {  # by table of the thesis
    6: "Normal",
    7: "IRLock, no failure",
    8: "IRLock, random 0.75",
    9: "IRLock, below 3 m",
    10: "Marker, no failure",
    11: "Marker, random 0.50",
    12: "Marker, below 3 m",
    13: "Fused, no failure",
    14: "Fused, IRLock below 3 m, Marker above 3 m",
    15: "Fused, IRLock above 3 m, Marker below 3 m",
    16: "Fused, IRLock random 0.75, Marker random 0.50",
    17: "Cautious, Marker below 3 m at first",
}


def _read_trials() -> dict[str, PublishedTrials]:
    text = (resources.files("studies") / "infrared_and_marker_trials.csv").read_text("utf-8")
    lines = list(csv.DictReader(text.splitlines()))
    published = {}
    for table, title in _TITLES.items():
        trials = [line for line in lines if int(line["table"]) == table]

        def column(name: str, trials: list[dict[str, str]] = trials) -> NDArray[np.float64]:
            return np.array([float(trial[name]) for trial in trials])

        key = f"infrared-and-marker/{table}"
        published[key] = PublishedTrials(
            key=key,
            table=f"Table {table}",
            title=title,
            error=column("error_cm") / 100.0,
            x=column("x_cm") / 100.0,
            y=column("y_cm") / 100.0,
            time=column("time_s"),
        )
    return published


PUBLISHED: dict[str, PublishedTrials] = _read_trials()


def compare(
    condition: str, quantity: str, ours: ArrayLike, trials: PublishedTrials
) -> Comparison | None:
    """Hold a campaign's values against published ones.

    The test is the two-sample Cramér–von Mises test: two-sided, of the whole
    distribution. None where either side has fewer than two values.
    "Agrees" means that so few trials cannot tell the two apart; the interval says how far
    apart they may be all the same.

    Parameters
    ----------
    condition : str
        What the campaign flew.
    quantity : str
        ``"error"`` or ``"time"``.
    ours : array of shape (runs,)
        m or s; values that are not finite are left out.
    trials : PublishedTrials
        What it is held against.
    """
    mine = np.sort(np.asarray(ours, float))
    mine = mine[np.isfinite(mine)]
    theirs: NDArray[np.float64] = getattr(trials, quantity)
    if min(len(mine), len(theirs)) < 2:
        return None
    # With 10 values on one side Welch's interval covers better than a bootstrap (93 % of
    # Rayleigh draws against 90 %).
    interval = stats.ttest_ind(mine, theirs, equal_var=False).confidence_interval(CONFIDENCE)
    return Comparison(
        condition=condition,
        published=trials.key,
        table=trials.table,
        title=trials.title,
        quantity=quantity,
        ours=len(mine),
        theirs=len(theirs),
        our_mean=float(mine.mean()),
        their_mean=float(theirs.mean()),
        difference=float(mine.mean() - theirs.mean()),
        low=float(interval.low),
        high=float(interval.high),
        p=float(stats.cramervonmises_2samp(mine, theirs).pvalue),
    )


def holm(p: Sequence[float]) -> list[float]:
    """P-values adjusted for their number, family-wise (S. Holm, Scand. J. Statist. 6, 1979)."""
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    steps = values[order] * np.arange(len(values), 0, -1)
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in adjusted]

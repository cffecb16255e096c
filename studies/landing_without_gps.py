"""The campaigns without GPS held against the thesis's tables (Leonard 2016, chapter 6).

    plumbline study landing-without-gps-terrain …
    python -m studies.landing_without_gps out/studies

prints every published number beside the campaigns' own.

LongAccuracy and LatAccuracy are secret. Each is set once, in metres, by the
reference row of the loop alone (Table 4 in open loop, Table 22 in closed loop): the
quantile of the absolute error at 100 m that the published share names. Table 4 has no
lateral column, so LatAccuracy is that of Table 22 in both loops. Every other
row is then predicted.
"""

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from studies.published_landing_without_gps import PUBLISHED, PublishedRow, published

PREFIX = "landing-without-gps-"
STUDY_OF_TABLE: dict[int, str] = {
    **dict.fromkeys((4, 5, 7, 8, 9, 11, 12), "terrain"),
    **dict.fromkeys((6, 10), "altitude"),
    **dict.fromkeys(range(13, 21), "harmonisation"),
    **dict.fromkeys((22, 24, 25), "latency-closed"),
    **dict.fromkeys((23, 26, 27, 28, 29), "latency-open"),
}
# rows of the thesis that are one variant of a study
_SAME = {
    "flat_100m": "flat",
    "slope_100m": "slope",
    "flat_no_laser": "no_laser",
    "slope_no_laser": "no_laser",
    "yaw_0.0": "pitch_0.0",
    "roll_0.0": "pitch_0.0",
    "closed": "closed_camera_0ms",
    "open": "open_camera_0ms",
    "open_vision_0ms": "open_camera_40ms",
}
POINTS = 0.10  # a percentage agrees if it lies within ten points
_OPEN_REFERENCE, _CLOSED_REFERENCE = (4, "no_laser"), (22, "closed")


@dataclass(frozen=True)
class Accuracy:
    """What the thesis keeps secret, in metres."""

    long_open: float  # LongAccuracy by Table 4
    long_closed: float  # LongAccuracy by Table 22
    lat: float  # LatAccuracy by Table 22

    def of(self, row: PublishedRow) -> float:
        """The one that a published row is in units of."""
        if row.axis == "lateral":
            return self.lat
        closed = STUDY_OF_TABLE[row.table] == "latency-closed"
        return self.long_closed if closed else self.long_open


@dataclass(frozen=True)
class Prediction:
    """One published number beside the campaign's."""

    row: PublishedRow
    value: float
    runs: int

    @property
    def agrees(self) -> bool | None:
        """Within ten points; None for what is no percentage."""
        if self.row.statistic != "valid":
            return None
        return abs(self.value - self.row.value) <= POINTS


def variant_of(row: PublishedRow) -> str:
    """The variant of `STUDY_OF_TABLE` that flies a published row."""
    return _SAME.get(row.case, row.case)


def calibrated_accuracy(errors: np.ndarray, valid_share: float) -> float:
    """The secret accuracy in metres: the quantile of |error| that the published share names.

    Parameters
    ----------
    errors : array, shape (runs,)
        Of the reference case at 100 m, m.
    valid_share : float
        The published share of valid simulations there, 0..1.
    """
    return float(np.quantile(np.abs(errors), valid_share))


def read_campaigns(folder: Path) -> dict[str, pd.DataFrame]:
    """The finished campaigns in a folder, by the study's name without the prefix."""
    return {
        path.parent.name.removeprefix(PREFIX): pd.read_parquet(path)
        for path in sorted(folder.glob(f"{PREFIX}*/runs.parquet"))
    }


def calibrate(campaigns: dict[str, pd.DataFrame]) -> Accuracy:
    """LongAccuracy and LatAccuracy from the reference rows; raises `KeyError` without them."""

    def share(reference: tuple[int, str], axis: str) -> tuple[np.ndarray, float]:
        (row,) = (
            r for r in published(*reference, "valid") if r.axis == axis and r.distance == 100.0
        )
        return _errors(campaigns, row), row.value

    return Accuracy(
        long_open=calibrated_accuracy(*share(_OPEN_REFERENCE, "longitudinal")),
        long_closed=calibrated_accuracy(*share(_CLOSED_REFERENCE, "longitudinal")),
        lat=calibrated_accuracy(*share(_CLOSED_REFERENCE, "lateral")),
    )


def predict(campaigns: dict[str, pd.DataFrame], accuracy: Accuracy) -> list[Prediction]:
    """Every published row whose campaign is there. A landing that did not get there is invalid."""
    predictions = []
    for row in PUBLISHED:
        if STUDY_OF_TABLE[row.table] not in campaigns:
            continue
        error = _errors(campaigns, row) / accuracy.of(row)
        if row.statistic == "valid":
            value = float(np.mean(np.abs(error) <= 1.0))
        elif row.statistic == "mean":
            value = float(np.nanmean(error))
        elif row.statistic == "largest":
            value = _largest(campaigns, row) / accuracy.of(row)
        else:
            value = float(np.nanstd(error))
        predictions.append(Prediction(row, value, len(error)))
    return predictions


def agreement(predictions: Iterable[Prediction]) -> tuple[int, int]:
    """How many percentages lie within ten points, and how many there are."""
    verdicts = [p.agrees for p in predictions if p.agrees is not None]
    return sum(verdicts), len(verdicts)


def markdown(predictions: list[Prediction], accuracy: Accuracy) -> str:
    """Every table: ours / published, percentages apart by more than ten points in bold."""
    lines = [
        f"LongAccuracy {accuracy.long_open:.1f} m (Table 4), {accuracy.long_closed:.1f} m "
        f"(Table 22); LatAccuracy {accuracy.lat:.2f} m (Table 22).",
        "",
    ]
    for table in sorted({p.row.table for p in predictions}):
        rows = [p for p in predictions if p.row.table == table]
        distances = sorted({p.row.distance for p in rows}, reverse=True)
        good, of = agreement(rows)
        verdict = f"; {good} of {of} within ten points" if of else ""
        lines += [f"**Table {table}** ({rows[0].row.axis}, {rows[0].runs} runs a row{verdict})", ""]
        lines.append("| | " + " | ".join(f"{d:.0f} m" for d in distances) + " |")
        lines.append("|---" * (1 + len(distances)) + "|")
        for key in dict.fromkeys((p.row.axis, p.row.case, p.row.statistic) for p in rows):
            cells = {
                p.row.distance: _cell(p)
                for p in rows
                if (p.row.axis, p.row.case, p.row.statistic) == key
            }
            axis, case, statistic = key
            name = case.replace("_", " ")
            name += f", {axis}" if table in (22, 23) else ""
            label = "largest on the way" if statistic == "largest" else statistic.replace("_", " ")
            name += "" if statistic == "valid" else f", {label}"
            lines.append(f"| {name} | " + " | ".join(cells.get(d, "") for d in distances) + " |")
        lines.append("")
    good, of = agreement(predictions)
    lines.append(f"{good} of {of} percentages ({good / max(of, 1):.0%}) lie within ten points.")
    return "\n".join(lines)


def _cell(prediction: Prediction) -> str:
    value, row = prediction.value, prediction.row
    if row.statistic != "valid":
        return f"{value:.2f} / {row.value:.2f}"
    text = f"{100 * value:.0f} / {100 * row.value:.0f} %"
    return text if prediction.agrees else f"**{text}**"


def _largest(campaigns: dict[str, pd.DataFrame], row: PublishedRow) -> float:
    """The largest |mean| + 1 σ (m) at the recorded distances from 1 km on ("Error max 1σ")."""
    table = campaigns[STUDY_OF_TABLE[row.table]]
    runs = table[table["variant"].eq(variant_of(row))]
    names = [f"{row.axis}_{distance}" for distance in (1000, 500, 300, 150, 100)]
    errors = runs[[name for name in names if name in runs]].to_numpy(dtype=float)
    return float(np.nanmax(np.abs(np.nanmean(errors, axis=0)) + np.nanstd(errors, axis=0)))


def _errors(campaigns: dict[str, pd.DataFrame], row: PublishedRow) -> np.ndarray:
    table = campaigns[STUDY_OF_TABLE[row.table]]
    runs = table[table["variant"].eq(variant_of(row))]
    return runs[f"{row.axis}_{row.distance:g}"].to_numpy(dtype=float)


def equivalent_angular_error(position_error: float, distance: float, slope: float = 6.0) -> float:
    """The angle (deg) that a camera's position error equals (6.3, Figs. 37 to 39).

    In the worst case the error along the path and the one across it add as
    seen on a glide slope of `slope` degrees: tan α = e (cos γ + sin γ)/d. That
    reproduces the published limit: 16 cm for 0.1 deg at 100 m.

    Parameters
    ----------
    position_error : float
        Along each axis, m.
    distance : float
        To the touch-down point, m.
    """
    gamma = math.radians(slope)
    return math.degrees(math.atan(position_error * (math.cos(gamma) + math.sin(gamma)) / distance))


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/studies")
    found = read_campaigns(folder)
    for reference in ("terrain", "latency-closed"):
        if reference not in found:
            sys.exit(f"{folder}: expected the finished campaign {PREFIX}{reference}, a reference")
    secret = calibrate(found)
    print(markdown(predict(found, secret), secret))

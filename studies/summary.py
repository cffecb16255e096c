"""What a campaign says: rates and distributions with their intervals, in numbers and tables.

Every number has the interval that suits it: a rate Wilson's; a mean the
bootstrap's; a median or other quantile the one of order statistics, which
assumes nothing and says so (no bound) where the runs are too few. A maximum has none:
it comes with the share of landings that lie below it.
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from studies.ledger import write_durably
from studies.published import INCONSISTENCIES, PUBLISHED, SIGNIFICANCE, Comparison, compare, holm
from studies.study import Condition, Promise, Study

CONFIDENCE = 0.95  # of all intervals
BOOTSTRAP_RESAMPLES = 1999
BCA_LIMIT = 2000  # values; the correction takes n**2 and is below the noise beyond
LISTED = 5  # runs in the lists of the slowest and the worst
LISTED_FAILURES = 20
_SEED = 1979  # of the bootstrap, so that a summary is the same twice

Estimate = dict[str, float | None]  # value, low, high


def summarise(study: Study, table: pd.DataFrame, runs: int, folder: Path) -> dict[str, Any]:
    """Summarise a campaign; writes `summary.json` and `summary.md` and returns the former.

    Parameters
    ----------
    study : Study
        What was flown.
    table : DataFrame
        One row a run, as in `runs.parquet`.
    runs : int
        How many were asked for.
    folder : Path
        The campaign's.
    """
    measures = study.measures
    table = with_measures(study, table)
    landed = table[table[measures.success].eq(True)]
    summary: dict[str, Any] = {
        "study": study.name,
        "description": study.description,
        "scenario": study.scenario,
        "seed": study.seed,
        "digest": study.digest,
        "runs": runs,
        "done": len(table),
        "successes": len(landed),
        "errors": int(table["status"].eq("failed").sum()),
        "confidence": CONFIDENCE,
        "conditions": [
            _condition(study, condition, table[table["condition"].eq(condition.label)])
            for condition in study.conditions
        ],
        "paired": [] if study.axes else _paired(study, landed),  # maps compare by cell
        "promises": [
            {"text": promise_text(promise), "cells": _kept(study, table, promise)}
            for promise in study.promises
        ],
        "published": [
            dataclasses.asdict(comparison)
            | {"agrees": comparison.agrees, "verdict": comparison.verdict}
            for comparison in comparisons(study, landed)
        ],
        "slowest": _listed(study, landed.nlargest(LISTED, measures.time), folder),
        "worst": _listed(study, table.nlargest(LISTED, measures.error), folder),
        "failed": _listed(
            study, table[~table[measures.success].eq(True)].head(LISTED_FAILURES), folder
        ),
    }
    summary = _without_nan(summary)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_durably(folder / "summary.json", f"{text}\n".encode())
    write_durably(folder / "summary.md", markdown(study, summary).encode())
    return summary


def with_measures(study: Study, table: pd.DataFrame) -> pd.DataFrame:
    """`table` with every measured column, numbers as floats, empty where no run gave it."""
    table = table.copy()
    for name in study.measures.columns():
        if name not in table.columns:
            table[name] = np.nan
        if name != study.measures.success:
            table[name] = pd.to_numeric(table[name]).astype(float)
    return table


def rate(successes: int, trials: int) -> Estimate:
    """A proportion with Wilson's interval."""
    if trials == 0:
        return {"value": math.nan, "low": math.nan, "high": math.nan}
    interval = stats.binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return {"value": successes / trials, "low": float(interval.low), "high": float(interval.high)}


def mean(values: ArrayLike) -> Estimate:
    """A mean with its bootstrap interval: BCa up to `BCA_LIMIT` values, else percentile."""
    sample = np.sort(np.asarray(values, float))
    if len(sample) == 0:
        return {"value": math.nan, "low": math.nan, "high": math.nan}
    value = float(sample.mean())
    if len(sample) < 2:
        return {"value": value, "low": math.nan, "high": math.nan}
    if sample[0] == sample[-1]:
        return {"value": value, "low": value, "high": value}
    interval = stats.bootstrap(
        (sample,),
        np.mean,
        n_resamples=BOOTSTRAP_RESAMPLES,
        batch=max(1, 2_000_000 // len(sample)),
        confidence_level=CONFIDENCE,
        method="BCa" if len(sample) <= BCA_LIMIT else "percentile",
        rng=np.random.default_rng(_SEED),
    ).confidence_interval
    return {"value": value, "low": float(interval.low), "high": float(interval.high)}


def quantile(values: ArrayLike, fraction: float) -> Estimate:
    """A quantile with its interval of order statistics; a bound is nan where runs are too few."""
    sample = np.asarray(values, float)
    if len(sample) == 0:
        return {"value": math.nan, "low": math.nan, "high": math.nan}
    interval = stats.quantile_test(sample, q=0.0, p=fraction).confidence_interval(CONFIDENCE)
    return {
        "value": float(np.quantile(sample, fraction)),
        "low": float(interval.low),
        "high": float(interval.high),
    }


def largest(values: ArrayLike) -> dict[str, float | None]:
    """A maximum, and the share of all landings that with `CONFIDENCE` lie below it.

    P(all n values lie below the quantile q) = qⁿ, so the share is (1 - confidence)^(1/n).
    """
    sample = np.asarray(values, float)
    if len(sample) == 0:
        return {"value": math.nan, "share_below": math.nan}
    share = (1.0 - CONFIDENCE) ** (1.0 / len(sample))
    return {"value": float(sample.max()), "share_below": share}


def statistics(values: ArrayLike) -> dict[str, Any]:
    """Mean, median, p95, p99 and max of the finite values, with their intervals."""
    sample = np.asarray(values, float)
    sample = sample[np.isfinite(sample)]
    return {
        "n": len(sample),
        "mean": mean(sample),
        "median": quantile(sample, 0.50),
        "p95": quantile(sample, 0.95),
        "p99": quantile(sample, 0.99),
        "max": largest(sample),
    }


def comparisons(study: Study, landed: pd.DataFrame) -> list[Comparison]:
    """Each variant with published trials held against them, on error and on landing time."""
    measures = study.measures
    found = []
    for condition in study.conditions:
        trials = published_trials(study, condition)
        if trials is None:
            continue
        rows = landed[landed["condition"].eq(condition.label)]
        for name, column in (("error", measures.error), ("time", measures.time)):
            comparison = compare(condition.label, name, rows[column], trials)
            found += [comparison] if comparison else []
    adjusted = holm([comparison.p for comparison in found])
    return [
        dataclasses.replace(comparison, p_adjusted=p)
        for comparison, p in zip(found, adjusted, strict=True)
    ]


def agreement(summary: Mapping[str, Any]) -> str:
    """How many rows agree with the published trials, in one sentence."""
    counts = {}
    for quantity in ("error", "time"):
        rows = [row for row in summary["published"] if row["quantity"] == quantity]
        counts[quantity] = f"{sum(row['agrees'] for row in rows)} of {len(rows)} rows"
    return (
        f"{counts['error']} agree with the published trials in landing error, "
        f"{counts['time']} in landing time."
    )


def published_trials(study: Study, condition: Condition) -> Any:
    """The `PublishedTrials` a condition is held against, or None."""
    variant = study.variants.get(condition.variant)
    return PUBLISHED[variant.published] if variant and variant.published else None


def promise_text(promise: Promise) -> str:
    """A promise in words."""
    where = "" if promise.of == "target" else " of the undisturbed touchdown"
    return f"within {promise.within * 100.0:g} cm{where}"


def _kept(study: Study, table: pd.DataFrame, promise: Promise) -> list[dict[str, Any]]:
    """The share of each cell's runs that keep a promise; one that does not succeed breaks it."""
    measures = study.measures

    def touchdowns(condition: Condition) -> pd.DataFrame:
        runs = table[table["condition"].eq(condition.label)].set_index("pair")
        return runs[[measures.x, measures.y]].where(runs[measures.success].eq(True), math.nan)

    cells = {(cell.variant, *cell.levels.values()): cell for cell in study.cells}
    first = next(iter(list(study.axes.values())[-1].steps))
    found = []
    for (*row, level), cell in cells.items():
        distance = touchdowns(cell.condition)
        if promise.of == "first_level":
            if level == first or (*row, first) not in cells:
                continue
            twins = touchdowns(cells[*row, first].condition)
            distance = (distance - twins).loc[distance.index.intersection(twins.index)]
        kept = int((np.hypot(*distance.to_numpy().T) <= promise.within).sum())
        share = rate(kept, len(distance))
        row_of = {"condition": cell.condition.label, "variant": cell.variant}
        found.append({**row_of, "levels": cell.levels, "share": share})
    return found


def quantity(column: str, values: ArrayLike) -> tuple[str, str, float]:
    """The title, unit and scale under which people read a column."""
    for suffix, unit, scale in (
        ("_m_s", "m/s", 1.0),
        ("_rad", "deg", 180.0 / math.pi),
        ("_s", "s", 1.0),
        ("_m", "m", 1.0),
    ):
        if column.endswith(suffix):
            title = column.removesuffix(suffix).replace("_", " ")
            sample = np.abs(np.asarray(values, float))
            sample = sample[np.isfinite(sample)]
            if unit == "m" and len(sample) and np.median(sample) < 2.0:
                return title, "cm", 100.0
            return title, unit, scale
    return column.replace("_", " "), "", 1.0


def markdown(study: Study, summary: Mapping[str, Any]) -> str:
    """The summary as a page of Markdown."""
    lines = [f"# {study.name}", "", study.description.strip(), ""]
    left = summary["runs"] - summary["done"]
    lines += [
        f"{summary['done']} runs of scenario {study.scenario}, campaign seed {study.seed}"
        + (f"; {left} more are not flown yet" if left else "")
        + (f"; {summary['errors']} ended in an error" if summary["errors"] else "")
        + f". Intervals: {100 * CONFIDENCE:g} %; distributions are of the runs that succeeded.",
    ]
    for column in study.measures.numbers():
        title, unit, scale = scale_of(column, summary)
        lines += ["", f"## {_heading(title)}{f' ({unit})' if unit else ''}", ""]
        first = column == study.measures.error
        head = ["condition", "runs", "success", "mean", "median"]
        head += ["CEP50"] if first else []
        head += ["p95", "p99", "max"]
        lines += [_row(head), _row(["---"] + ["---:"] * (len(head) - 1))]
        for condition in summary["conditions"]:
            numbers = condition["statistics"][column]
            cells = [
                condition["condition"],
                str(condition["runs"]),
                show_rate(condition["success"]),
                show(numbers["mean"], scale),
                show(numbers["median"], scale),
            ]
            cells += [show(condition["cep50"], scale)] if first else []
            cells += [show(numbers[key], scale) for key in ("p95", "p99", "max")]
            lines.append(_row(cells))
    if summary["paired"]:
        title, unit, scale = scale_of(study.measures.error, summary)
        lines += [
            "",
            f"## Against {summary['paired'][0]['baseline']}, pair by pair",
            "",
            f"Both landed in the same world with the same noise; differences of {title} in {unit}.",
            "",
            _row(["condition", "pairs", "mean difference", "closer in"]),
            _row(["---", "---:", "---:", "---:"]),
        ]
        lines += [
            _row(
                [
                    row["condition"],
                    str(row["pairs"]),
                    show(row["difference"], scale, signed=True),
                    show_rate(row["closer"]),
                ]
            )
            for row in summary["paired"]
        ]
    for promise in summary["promises"]:
        lines += ["", f"## {_heading(promise['text'])}", "", _row(["condition", "kept"])]
        lines += [_row(["---", "---:"])]
        lines += [_row([row["condition"], show_rate(row["share"])]) for row in promise["cells"]]
    if summary["published"]:
        lines += ["", "## Against the published trials", "", agreement(summary), ""]
        lines += [
            "Two-sample Cramér–von Mises test, two-sided, on the whole distribution; "
            f"{100 * SIGNIFICANCE:g} % for all rows together (Holm).",
            "",
            _row(["condition", "published", "of", "p (Holm)", "verdict"]),
            _row(["---", "---", "---", "---:", "---"]),
        ]
        lines += [
            _row(
                [
                    row["condition"],
                    row["table"],
                    row["quantity"],
                    f"{row['p_adjusted']:.2g}",
                    row["verdict"],
                ]
            )
            for row in summary["published"]
        ]
        lines += ["", "Where the publication contradicts itself:", ""]
        lines += [f"* {text}" for text in INCONSISTENCIES]
    for key, title in LISTS.items():
        if summary[key]:
            lines += ["", f"## {title}", ""]
            lines += [
                f"* run {row['run']} ({row['condition']}): {row['text']}: `{row['command']}`"
                for row in summary[key]
            ]
    return "\n".join(lines) + "\n"


LISTS = {"worst": "Worst", "slowest": "Slowest", "failed": "Failed"}


def scale_of(column: str, summary: Mapping[str, Any]) -> tuple[str, str, float]:
    """`quantity` of a column over all conditions of a summary."""
    medians = [
        condition["statistics"][column]["median"]["value"] for condition in summary["conditions"]
    ]
    return quantity(column, [math.nan if value is None else value for value in medians])


def show(estimate: Mapping[str, float | None], scale: float, signed: bool = False) -> str:
    """An estimate with its interval, as in ``5.79 [4.1, 8.0]``."""
    value = estimate["value"]
    if value is None:
        return "–"
    sign = "+" if signed else ""
    text = f"{value * scale:{sign}.3g}"
    if "low" not in estimate:
        return text
    bounds = [
        "–" if bound is None else f"{bound * scale:{sign}.3g}"
        for bound in (estimate["low"], estimate["high"])
    ]
    return f"{text} [{', '.join(bounds)}]"


def show_rate(estimate: Mapping[str, float | None]) -> str:
    """A rate with its interval, in per cent."""
    if estimate["value"] is None or estimate["low"] is None or estimate["high"] is None:
        return "–"
    low, high = 100.0 * estimate["low"], 100.0 * estimate["high"]
    return f"{100.0 * estimate['value']:.4g} % [{low:.3g}, {high:.3g}]"


def _condition(study: Study, condition: Condition, rows: pd.DataFrame) -> dict[str, Any]:
    measures = study.measures
    landed = rows[rows[measures.success].eq(True)]
    radius: NDArray[np.float64] = np.hypot(landed[measures.x], landed[measures.y]).to_numpy()
    return {
        "condition": condition.label,
        "variant": condition.variant,
        "point": condition.point,
        "runs": len(rows),
        "errors": int(rows["status"].eq("failed").sum()),
        "success": rate(len(landed), len(rows)),
        "cep50": quantile(radius[np.isfinite(radius)], 0.5),
        "statistics": {column: statistics(landed[column]) for column in measures.numbers()},
    }


def _paired(study: Study, landed: pd.DataFrame) -> list[dict[str, Any]]:
    """Each condition against the first, over the pairs in which both landed."""
    column = study.measures.error
    baseline, *others = study.conditions
    reference = landed[landed["condition"].eq(baseline.label)].set_index("pair")[column]
    rows = []
    for condition in others:
        errors = landed[landed["condition"].eq(condition.label)].set_index("pair")[column]
        difference = (errors - reference).dropna()
        if len(difference) > 1:
            rows.append(
                {
                    "condition": condition.label,
                    "baseline": baseline.label,
                    "pairs": len(difference),
                    "difference": mean(difference),
                    "closer": rate(int((difference < 0.0).sum()), len(difference)),
                }
            )
    return rows


def _listed(study: Study, rows: pd.DataFrame, folder: Path) -> list[dict[str, Any]]:
    measures = study.measures
    title, unit, scale = quantity(measures.error, rows[measures.error])
    listed = []
    for row in rows.to_dict("records"):
        error, time = row[measures.error], row[measures.time]
        parts = []
        if row["status"] == "failed":
            parts = [row["failure"]]
        else:
            parts += [] if row[measures.success] else [f"not {measures.success}"]
            parts += [f"{title} {error * scale:.3g} {unit}"] if math.isfinite(error) else []
            parts += [f"{time:.3g} s"] if math.isfinite(time) else []
        listed.append(
            {
                "run": row["run"],
                "condition": row["condition"],
                "error": error,
                "time": time,
                "seed": row["seed"],
                "text": ", ".join(parts),
                "command": f"plumbline land --from {folder / str(row['run'])}",
            }
        )
    return listed


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _heading(title: str) -> str:
    return title[:1].upper() + title[1:]


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

"""Studies with axes, told by cell: tables, heat maps and curves, and budgets in words.

Every cell shows the runs of its condition; cells that fly the same by construction show
the same runs. Errors are of the runs that succeeded, so a cell says how many those are.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies import figures
from studies.study import Budget, Cell, Study
from studies.summary import CONFIDENCE, mean, show_rate, with_measures

CM = 100.0  # in a metre; errors are told in cm, whatever they are
RESAMPLES = 400  # of the pairs, for the interval of a budget
FEWEST = 8  # pairs that the interval of a budget, or a tie, needs
SURE = 0.95  # a cell in which fewer succeed says so, and wins nothing
MISS = 1.0  # m; where even the least mean error is more, nobody wins
COLUMNS = 3  # heat maps beside each other
TABLES = ("table", "distributions")  # layouts with a table
_SEED = 1979  # of the resampling


def cell_table(study: Study, summary: Mapping[str, Any]) -> pd.DataFrame:
    """One row a cell: variant, levels, and every statistic with its interval.

    Lengths in m, times in s, rates in 1, as in `summary.json`. `runs_of` is the condition
    whose runs the cell shows.
    """
    conditions = {row["condition"]: row for row in summary["conditions"]}
    rows = []
    for cell in study.cells:
        found = conditions[cell.condition.label]
        row: dict[str, Any] = {"variant": cell.variant, **cell.levels}
        row |= {"runs": found["runs"], "runs_of": cell.condition.label}
        row |= _flat("success", found["success"])
        for column, numbers in found["statistics"].items():
            for name in ("mean", "median", "p95", "p99"):
                row |= _flat(f"{column}_{name}", numbers[name])
            row[f"{column}_max"] = numbers["max"]["value"]
        rows.append(row)
    return pd.DataFrame(rows)


def _flat(name: str, estimate: Mapping[str, float | None]) -> dict[str, float | None]:
    return {
        name: estimate["value"],
        f"{name}_low": estimate["low"],
        f"{name}_high": estimate["high"],
    }


# -- budgets


@dataclass(frozen=True)
class Spent:
    """Where along an axis a budget is used up, in one of its rows of cells."""

    variant: str
    levels: dict[str, str]  # of the other axes
    undisturbed: float  # m, mean error of the first level; nan: none landed
    at: float | None  # in the axis's unit; None: not up to its end
    low: float | None  # interval of `at`; None: beyond the end of the axis, or too few pairs
    high: float | None
    pairs: int  # flown in all cells of the row
    by: str  # "error" or "success": what gave out first


def spent(study: Study, table: pd.DataFrame, budget: Budget) -> list[Spent]:
    """Where a budget is used up, for each variant and each level of the other axes.

    The mean error has grown by `loss` over the first level's, interpolated linearly between
    the two levels where it happens; or fewer than `success` of a level's runs succeed. The
    interval is from resampling the pairs, so what all levels have in common cancels.

    Raises
    ------
    ValueError
        The axis has no numbers.
    """
    numbers = study.axes[budget.axis].numbers()
    if numbers is None:
        raise ValueError(f"budgets: the levels of {budget.axis} are not numbers")
    table = with_measures(study, table)
    at = np.array(numbers, float)
    found = []
    for variant, levels, cells in rows_along(study, budget.axis):
        if len(cells) < len(at):
            continue  # a variant without this axis
        errors = _by_pair(study, table, cells)
        place, by = _threshold(at, errors, budget)
        if not len(errors):
            found.append(Spent(variant, levels, math.nan, None, None, None, 0, by))
            continue
        rng = np.random.default_rng(_SEED)
        drawn = []
        for _ in range(RESAMPLES):
            sample = errors[rng.integers(0, len(errors), len(errors))]
            drawn.append(_threshold(at, sample, budget)[0])
        enough = len(errors) >= FEWEST
        low, high = _interval(at, drawn) if enough else (None, None)
        undisturbed = errors[:, 0][np.isfinite(errors[:, 0])]
        first = float(undisturbed.mean()) if len(undisturbed) else math.nan
        found.append(Spent(variant, levels, first, place, low, high, len(errors), by))
    return found


def rows_along(study: Study, axis: str) -> Iterator[tuple[str, dict[str, str], list[Cell]]]:
    """Variant, levels of the other axes, and the cells along `axis` in its order."""
    rows: dict[tuple[str, ...], list[Cell]] = {}
    for cell in study.cells:
        others = [step for name, step in cell.levels.items() if name != axis]
        rows.setdefault((cell.variant, *others), []).append(cell)
    order = list(study.axes[axis].steps)
    for (variant, *_), cells in rows.items():
        levels = {name: step for name, step in cells[0].levels.items() if name != axis}
        yield variant, levels, sorted(cells, key=lambda cell: order.index(cell.levels[axis]))


def _by_pair(study: Study, table: pd.DataFrame, cells: Sequence[Cell]) -> NDArray[np.float64]:
    """Errors (pairs, cells) of the pairs flown in all of them; nan: not a success."""
    measures = study.measures
    columns = []
    for cell in cells:
        runs = table[table["condition"].eq(cell.condition.label)].set_index("pair")
        columns.append(runs[measures.error].where(runs[measures.success].eq(True), math.inf))
    errors = pd.concat(columns, axis=1, join="inner").to_numpy(float)
    return np.where(np.isfinite(errors), errors, math.nan)


def _threshold(
    at: NDArray[np.float64], errors: NDArray[np.float64], budget: Budget
) -> tuple[float | None, str]:
    succeeded = np.isfinite(errors)
    share = succeeded.mean(axis=0) if len(errors) else np.zeros(len(at))
    count = np.maximum(succeeded.sum(axis=0), 1)
    grown = np.where(succeeded, errors, 0.0).sum(axis=0) / count
    grown = grown - grown[0] - budget.loss
    for i in range(len(at)):
        if grown[i] >= 0.0:
            part = -grown[i - 1] / (grown[i] - grown[i - 1])
            return float(at[i - 1] + part * (at[i] - at[i - 1])), "error"
        if share[i] < budget.success:
            return float(at[i]), "success"
    return None, "error"


def _interval(
    at: NDArray[np.float64], drawn: Sequence[float | None]
) -> tuple[float | None, float | None]:
    """Quantiles in the axis's own direction, which may fall; None: beyond its end."""
    sign = 1.0 if at[-1] >= at[0] else -1.0
    ordered = np.sort([math.inf if value is None else sign * value for value in drawn])
    tail = 0.5 * (1.0 - CONFIDENCE)
    ends = [float(ordered[round(share * (len(ordered) - 1))]) for share in (tail, 1.0 - tail)]
    low, high = (sign * end if math.isfinite(end) else None for end in ends)
    return low, high


def sentences(study: Study, table: pd.DataFrame) -> list[str]:
    """The budgets in words, one sentence a variant; what is the same everywhere is said once."""
    lines = []
    for budget in study.budgets:
        title, unit = _title_and_unit(study, budget.axis)
        last = list(study.axes[budget.axis].steps)[-1]
        loss = f"{budget.loss * CM:g} cm"
        rows: dict[str, dict[str, list[str]]] = {}  # variant: what happens: where
        for row in spent(study, table, budget):
            where = _where(study, row.levels, row.variant)
            before = f"{row.undisturbed * CM:.3g} cm undisturbed"
            if row.pairs == 0:
                text = "not flown yet"
            elif not math.isfinite(row.undisturbed):
                text = "does not land even undisturbed"
            elif row.at is None:
                text = f"not lost up to {last}{unit} ({before})"
            else:
                text = f"lost at {row.at:.3g}{unit}"
                if row.pairs >= FEWEST:
                    ends = ["–" if end is None else f"{end:.3g}" for end in (row.low, row.high)]
                    text += f" [{', '.join(ends)}]"
                if row.by == "success":
                    text += f", where it no longer lands {_percent(budget.success)} of the time"
                text += f" ({before})"
            rows.setdefault(row.variant, {}).setdefault(text, []).append(where)
        for variant, places in rows.items():
            label = _labels(study)[variant]
            told = [
                f"{' / '.join(wheres)}: {text}"
                if any(wheres) and (len(places) > 1 or len(wheres) == 1)
                else text
                for text, wheres in places.items()
            ]
            lines.append(f"**{label}**, {loss} over *{title}*; {'; '.join(told)}.")
    return lines


def rule(budget: Budget) -> str:
    """The rule behind `sentences`, in one."""
    return (
        f"A budget is spent where the mean error has grown by {budget.loss * CM:g} cm over that "
        "of the undisturbed cell, interpolated linearly between cells, or where fewer than "
        f"{_percent(budget.success)} land, whichever comes first; {100 * CONFIDENCE:g} % intervals "
        "from resampling the pairs of landings, open where they reach beyond the axis."
    )


def _percent(share: float) -> str:
    return f"{100 * share:g} %"


def _title_and_unit(study: Study, axis: str) -> tuple[str, str]:
    """The two parts of a label like "camera latency (ms)", the unit with a blank before it."""
    label = study.axes[axis].label or axis
    title, _, rest = label.partition(" (")
    return title, f" {rest.removesuffix(')')}" if rest else ""


def _labels(study: Study) -> dict[str, str]:
    """What each variant is called, by its name in the cells."""
    named = {name: variant.label or name for name, variant in study.variants.items()}
    return named or {study.cells[0].variant: study.scenario}


def _where(study: Study, levels: Mapping[str, str], variant: str | None = None) -> str:
    parts = []
    for axis, step in levels.items():
        if variant in study.axes[axis].without:
            continue
        title, unit = _title_and_unit(study, axis)
        parts.append(study.axes[axis].steps[step].label or f"{title} {step}{unit}")
    return ", ".join(parts)


# -- tables


def table_lines(study: Study, table: pd.DataFrame, summary: Mapping[str, Any]) -> list[str]:
    """The cells as tables of Markdown: mean and p99 of the error, the winners in bold.

    One table for each level of the axes before the last: its steps are the rows, variants the
    columns. Bold are the variant with the least mean error, of those that land `SURE` of the
    time, and those that the pairs cannot tell from it.
    """
    conditions = {row["condition"]: row for row in summary["conditions"]}
    last = list(study.axes)[-1]
    names, labels = list(_labels(study)), list(_labels(study).values())
    table = with_measures(study, table)
    lines = []
    for outer, rows in itertools.groupby(table_rows(study), key=lambda row: row[0]):
        where = _where(study, dict(outer))
        title = study.axes[last].label or last
        head = f"{title} ({where})" if where else title
        lines += [f"| {head} | {' | '.join(labels)} |", "|---|" + "---:|" * len(names)]
        for _, step, row in rows:
            best = winners(study, table, row, conditions)
            texts = [
                _entry(conditions[row[name].condition.label], study, name in best)
                if name in row
                else "–"
                for name in names
            ]
            label = study.axes[last].steps[step].label or step
            lines.append(f"| {label} | {' | '.join(texts)} |")
        lines.append("")
    lines.append(
        "Mean; 99th percentile of the error in cm, of the runs that landed, and how many "
        "those are where it is not all. Bold: the least mean, and whatever the pairs of landings "
        f"cannot tell from it (95 %), where {_percent(SURE)} land; nobody where "
        f"the least mean is more than {MISS:g} m."
    )
    return lines


def table_rows(
    study: Study,
) -> Iterator[tuple[tuple[tuple[str, str], ...], str, dict[str, Cell]]]:
    """The rows of a study's tables: levels before the last axis, its step, cells by variant."""
    *outer, last = study.axes
    cells = {(cell.variant, *cell.levels.values()): cell for cell in study.cells}
    for at in itertools.product(*(study.axes[axis].steps for axis in outer)):
        for step in study.axes[last].steps:
            row = {
                name: cells[key] for name in _labels(study) if (key := (name, *at, step)) in cells
            }
            yield tuple(zip(outer, at, strict=True)), step, row


def standing_lines(study: Study, table: pd.DataFrame, summary: Mapping[str, Any]) -> list[str]:
    """Which variant leads the tables, and every row in which it does not, as Markdown.

    It leads a row that has the least mean and the least 99th percentile of those that land `SURE`
    of the time. None if there is nothing to compare.
    """
    conditions = {row["condition"]: row for row in summary["conditions"]}
    table = with_measures(study, table)
    rows = [row for row in table_rows(study) if len(row[2]) > 1]
    least = [_least(study, conditions, row) for _, _, row in rows]
    leads = Counter(best["mean"] for best in least if best)
    if len(rows) < 2 or not leads:
        return []
    labels = _labels(study)
    leader, count = leads.most_common(1)[0]
    flown = sum(leader in row for _, _, row in rows)
    firsts = sum(best.get("p99") == leader for best in least)
    lines = []
    for (outer, step, row), best in zip(rows, least, strict=True):
        if leader in row and any(best.get(name) != leader for name in ("mean", "p99")):
            where = _where(study, {**dict(outer), list(study.axes)[-1]: step})
            equal = leader in winners(study, table, row, conditions)
            lines.append(f"* {where}: {_behind(study, conditions, row, best, leader, equal)}")
    head = (
        f"**{labels[leader]}** has the least mean in {count} of {flown} rows and the least "
        f"99th percentile in {firsts}, of what lands in {_percent(SURE)}."
    )
    return [head + " Not in:" if lines else head, "", *lines]


def _number(condition: Mapping[str, Any], study: Study, name: str) -> float:
    value = condition["statistics"][study.measures.error][name]["value"]
    return math.nan if value is None else value


def _least(
    study: Study, conditions: Mapping[str, Mapping[str, Any]], row: Mapping[str, Cell]
) -> dict[str, str]:
    """The variants of the least mean and 99th percentile of a row; none if none lands surely."""
    sure = {
        name: found
        for name, cell in row.items()
        if ((found := conditions[cell.condition.label])["success"]["value"] or 0.0) >= SURE
    }
    if not sure:
        return {}
    return {
        quantity: min(sure, key=lambda name: _number(sure[name], study, quantity))
        for quantity in ("mean", "p99")
    }


def _behind(
    study: Study,
    conditions: Mapping[str, Mapping[str, Any]],
    row: Mapping[str, Cell],
    best: Mapping[str, str],
    leader: str,
    equal: bool,
) -> str:
    """By what another variant is ahead of `leader` in a row."""
    found = {name: conditions[cell.condition.label] for name, cell in row.items()}
    labels = _labels(study)
    share = found[leader]["success"]["value"] or 0.0
    if share < SURE:
        most = max(found, key=lambda name: found[name]["success"]["value"] or 0.0)
        text = f"{labels[leader]} lands in {_percent(round(share, 3))}"
        if most == leader:
            return f"{text}, the others in fewer"
        return f"{text}, {labels[most]} in {_percent(round(found[most]['success']['value'], 3))}"
    ahead = []
    for quantity, title in (("mean", "mean"), ("p99", "99th percentile")):
        if (name := best[quantity]) != leader:
            first, second = (
                _plain(CM * _number(found[who], study, quantity)) for who in (name, leader)
            )
            tie = ", which the pairs cannot tell apart" if quantity == "mean" and equal else ""
            ahead.append(f"{title} {labels[name]} {first}, {labels[leader]} {second} cm{tie}")
    return "; ".join(ahead)


def promise_lines(study: Study, summary: Mapping[str, Any]) -> list[str]:
    """How often promises are kept, as tables of Markdown with their intervals."""
    *outer, last = study.axes
    labels = _labels(study)
    lines = []
    for promise in summary["promises"]:
        shares = {
            (row["variant"], *row["levels"].values()): show_rate(row["share"])
            for row in promise["cells"]
        }
        for at in itertools.product(*(study.axes[axis].steps for axis in outer)):
            where = _where(study, dict(zip(outer, at, strict=True)))
            head = f"{promise['text']} ({where})" if where else promise["text"]
            lines += [
                f"| {head} | {' | '.join(labels.values())} |",
                "|---|" + "---:|" * len(labels),
            ]
            for step, level in study.axes[last].steps.items():
                entries = [shares.get((name, *at, step), "–") for name in labels]
                if any(entry != "–" for entry in entries):
                    lines.append(f"| {level.label or step} | {' | '.join(entries)} |")
            lines.append("")
    return lines


def winners(
    study: Study,
    table: pd.DataFrame,
    row: Mapping[str, Cell],
    conditions: Mapping[str, Mapping[str, Any]],
) -> list[str]:
    """The best of the variants of a row of cells, and those that cannot be told from it.

    Nobody where even the best mean is more than `MISS`.
    """
    error = study.measures.error
    means = {
        name: conditions[cell.condition.label]["statistics"][error]["mean"]["value"]
        for name, cell in row.items()
        if (conditions[cell.condition.label]["success"]["value"] or 0.0) >= SURE
    }
    means = {name: value for name, value in means.items() if value is not None}
    if min(means.values(), default=math.inf) > MISS:
        return []
    best = min(means, key=lambda name: means[name])
    equal = [best]
    for name in means:
        if name != best:
            errors = _by_pair(study, table, [row[best], row[name]])
            difference = np.diff(errors, axis=1).ravel()
            low = mean(difference[np.isfinite(difference)])["low"]
            if low is not None and low <= 0.0 and len(errors) >= FEWEST:
                equal.append(name)
    return equal


def _plain(value: float) -> str:
    """Three significant digits, never with an exponent."""
    return f"{float(f'{value:.3g}'):.12g}"


def _entry(condition: Mapping[str, Any], study: Study, best: bool) -> str:
    numbers = condition["statistics"][study.measures.error]
    success = condition["success"]["value"]
    if numbers["mean"]["value"] is None:
        return "0 %" if condition["runs"] else "–"
    text = "; ".join(_plain(numbers[name]["value"] * CM) for name in ("mean", "p99"))
    text = f"**{text}**" if best else text
    return text if success is None or success == 1.0 else f"{text} ({100 * success:.3g} %)"


# -- figures


def draw(study: Study, summary: Mapping[str, Any]) -> Figure:
    """The figure that suits the study's layout; inside `figures.style()`."""
    return _curves(study, summary) if study.layout == "curves" else _heat_maps(study, summary)


def _curves(study: Study, summary: Mapping[str, Any]) -> Figure:
    conditions = {row["condition"]: row for row in summary["conditions"]}
    *_, last = study.axes
    numbers = study.axes[last].numbers()
    at = numbers if numbers is not None else list(range(len(study.axes[last].steps)))
    panels: dict[str, list[tuple[str, list[Cell]]]] = {}
    for variant, levels, cells in rows_along(study, last):
        panels.setdefault(_where(study, levels), []).append((variant, cells))
    labels = _labels(study)
    groups = {name: variant.group or name for name, variant in study.variants.items()}
    hues = figures.colours([groups.get(name, name) for name in labels])
    made = figures.figure(9.4, 0.9 + 3.4 * math.ceil(len(panels) / 2))
    grid = made.subplots(
        math.ceil(len(panels) / 2), min(len(panels), 2), squeeze=False, sharey=True
    ).ravel()
    for axes, (where, rows) in zip(grid, panels.items(), strict=False):
        drawn: dict[str, int] = {}
        for variant, cells in rows:
            group = groups.get(variant, variant)
            entries = [
                conditions[cell.condition.label]["statistics"][study.measures.error]["mean"]
                for cell in cells
            ]
            value, low, high = (
                [math.nan if e[key] is None else e[key] * CM for e in entries]
                for key in ("value", "low", "high")
            )
            figures.curve(
                axes, at[: len(cells)], value, low, high,
                label=labels[variant],
                colour=hues[group],
                dashes=figures.DASHES[drawn.get(group, 0) % len(figures.DASHES)],
            )  # fmt: skip
            drawn[group] = drawn.get(group, 0) + 1
        axes.set_yscale("log")
        figures.plain_numbers(axes.yaxis)
        axes.set_xlabel(study.axes[last].label or last)
        axes.set_title(where)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    grid[0].set_ylabel("mean landing error (cm)")
    handles, labels = grid[0].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return made


def _heat_maps(study: Study, summary: Mapping[str, Any]) -> Figure:
    panels = list(_panels(study))
    wide = study.layout == "table"
    columns = 1 if wide else min(COLUMNS, len(panels))
    lines = math.ceil(len(panels) / columns)
    width = max(len(panel.columns) for panel in panels)
    height = max(len(panel.rows) for panel in panels)
    made = figures.figure(
        max(9.4, 2.6 + 0.75 * width) if wide else 9.4,
        lines * (0.9 + 0.33 * height if wide else 0.95 + 0.36 * height) + 0.4,
    )
    grid = made.subplots(lines, columns, squeeze=False).ravel()
    conditions = {row["condition"]: row for row in summary["conditions"]}
    drawn = None
    for axes, panel in zip(grid, panels, strict=False):
        shape = (len(panel.rows), len(panel.columns))
        values = np.full(shape, math.nan)
        texts = np.full(shape, "", object)
        for (i, j), cell in panel.cells.items():
            condition = conditions[cell.condition.label]
            value = condition["statistics"][study.measures.error]["mean"]["value"]
            success = condition["success"]["value"]
            if value is not None:
                values[i, j] = value * CM
                texts[i, j] = f"{value * CM:.{int(value * CM < 9.95)}f}"
            if success is not None and success < SURE:
                texts[i, j] += f"\n{100 * success:.0f} %"
        drawn = figures.heat_map(axes, values, texts, panel.rows, panel.columns)
        if wide:
            axes.xaxis.tick_top()
        axes.set_title(panel.title)
        axes.set_xlabel(panel.x)
        axes.set_ylabel(panel.y)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    if drawn is not None:
        bar = made.colorbar(drawn, ax=list(grid), shrink=0.6, aspect=30, pad=0.02)
        figures.plain_numbers(bar.ax.yaxis)
        bar.set_label("mean landing error (cm)")
        bar.outline.set_visible(False)
    return made


@dataclass
class _Panel:
    title: str
    x: str
    y: str
    columns: list[str]
    rows: list[str]
    cells: dict[tuple[int, int], Cell]  # by row and column


def _panels(study: Study) -> Iterator[_Panel]:
    """Maps: a panel a variant and level of the outer axes. Table: one a level of them."""
    steps = {name: list(axis.steps) for name, axis in study.axes.items()}
    cells = {(cell.variant, *cell.levels.values()): cell for cell in study.cells}
    *names, last = study.axes
    x = study.axes[last].label or last
    labels = _labels(study)
    if study.layout in TABLES or not names:
        rows = [level.label or step for step, level in study.axes[last].steps.items()]
        for at in itertools.product(*(steps[name] for name in names)):
            found = {
                (i, j): cells[key]
                for (i, step), (j, variant) in itertools.product(
                    enumerate(steps[last]), enumerate(labels)
                )
                if (key := (variant, *at, step)) in cells
            }
            where = _where(study, dict(zip(names, at, strict=True)))
            yield _Panel(where, "", "", list(labels.values()), rows, found)
        return
    *outer, second = names
    y = study.axes[second].label or second
    for at in itertools.product(*(steps[name] for name in outer)):
        for variant, title in labels.items():
            found = {
                (i, j): cells[key]
                for (i, row), (j, column) in itertools.product(
                    enumerate(steps[second]), enumerate(steps[last])
                )
                if (key := (variant, *at, row, column)) in cells
            }
            where = _where(study, dict(zip(outer, at, strict=True)))
            title = f"{title}, {where}" if where else title
            across = steps[last] if len({j for _, j in found}) > 1 else ["own"]
            yield _Panel(title, x, y, across, steps[second], found)


# -- documentation


def markdown_lines(
    study: Study, table: pd.DataFrame, summary: Mapping[str, Any], figure: str, cells: str
) -> list[str]:
    """Figure, budgets and table of a study with axes, for a page of `docs/`.

    Parameters
    ----------
    figure, cells : str
        Paths of the figure and of the table of cells, as seen from the page.
    """
    lines = [f"![Landing error by cell]({figure})", ""]
    lines += [f"Every cell with its intervals: [{cells}]({cells})."]
    if study.budgets:
        lines += ["", *(f"* {text}" for text in sentences(study, table)), ""]
        lines += [rule(budget) for budget in study.budgets]
    if study.layout in TABLES:
        lines += ["", *table_lines(study, table, summary)]
        lines += ["", *standing_lines(study, table, summary)]
    if study.promises:
        lines += ["", *promise_lines(study, summary)]
    return [*lines, ""]

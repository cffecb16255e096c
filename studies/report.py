"""The report of a campaign: one page of HTML that needs nothing beside it."""

import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup

from studies import figures, maps
from studies.figures import Sample
from studies.ledger import write_durably
from studies.published import INCONSISTENCIES, SIGNIFICANCE, PublishedTrials
from studies.study import Condition, Study
from studies.summary import (
    CONFIDENCE,
    LISTS,
    agreement,
    published_trials,
    scale_of,
    show,
    show_rate,
    with_measures,
)

COLUMNS = 4  # panels of touchdown points beside each other
MOST_CURVES = 8  # in one plot of tails


def write_report(
    study: Study, table: pd.DataFrame, summary: Mapping[str, Any], folder: Path
) -> None:
    """Write `report.html` of a summarised campaign, and `cells.csv` if its study has axes."""
    template = (resources.files("studies") / "report.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.globals.update(agreement=agreement, show=show, show_rate=show_rate)
    with figures.style():
        drawn = _figures(study, with_measures(study, table), summary)
    html = environment.from_string(template).render(
        study=study,
        summary=summary,
        figures=[(title, text, Markup(svg)) for title, text, svg in drawn],
        measures=[(column, *scale_of(column, summary)) for column in study.measures.numbers()],
        lists=[(title, summary[key]) for key, title in LISTS.items() if summary[key]],
        inconsistencies=INCONSISTENCIES if summary["published"] else (),
        confidence=f"{100 * CONFIDENCE:g} %",
        significance=f"{100 * SIGNIFICANCE:g} %",
    )
    write_durably(folder / "report.html", html.encode())
    if study.axes:
        cells = maps.cell_table(study, summary).to_csv(index=False)
        write_durably(folder / "cells.csv", cells.encode())


def samples(study: Study, table: pd.DataFrame, column: str, scale: float) -> list[Sample]:
    """The successful runs of each condition as figures draw them."""
    measures = study.measures
    hues = figures.colours([_group(study, condition) for condition in study.conditions])
    landed = table[table[measures.success].eq(True)]
    made = []
    for condition in study.conditions:
        rows = landed[landed["condition"].eq(condition.label)]
        trials: PublishedTrials | None = published_trials(study, condition)
        shown = {measures.error: "error", measures.time: "time"}.get(column)
        made.append(
            Sample(
                label=condition.label,
                colour=hues[_group(study, condition)],
                values=rows[column].to_numpy() * scale,
                x=rows[measures.x].to_numpy() * scale,
                y=rows[measures.y].to_numpy() * scale,
                published=getattr(trials, shown) * scale if trials and shown else None,
                published_x=trials.x * scale if trials else None,
                published_y=trials.y * scale if trials else None,
            )
        )
    return made


def _group(study: Study, condition: Condition) -> str:
    variant = study.variants.get(condition.variant)
    if variant is None:
        return condition.variant
    return variant.group or (condition.variant if len(study.variants) > 1 else condition.label)


def _figures(
    study: Study, table: pd.DataFrame, summary: Mapping[str, Any]
) -> list[tuple[str, str, str]]:
    """Title, explanation and SVG of each figure that has something to show."""
    if not summary["successes"]:
        return []
    if study.drawn_by_cell:
        return [_by_cell(study, table, summary)]
    drawn = []
    diamonds = " Diamonds: the published trials." if summary["published"] else ""
    measures = study.measures
    for column in measures.numbers():
        title, unit, scale = scale_of(column, summary)
        shown = samples(study, table, column, scale)
        if not any(len(sample.values) for sample in shown):
            continue
        label = f"{title} ({unit})" if unit else title
        made = figures.figure(9.4, 0.9 + 0.42 * len(shown))
        positive = all((sample.values > 0.0).all() for sample in shown)
        wide = column == measures.error and positive and len(shown) > 1
        figures.boxes(made.subplots(), shown, label, logarithmic=wide)
        drawn.append(
            (
                title[:1].upper() + title[1:],
                "Red: the median; box: the middle half; whiskers: 5 to 95 %; dots: the rest."
                + diamonds,
                figures.to_svg(made, f"Box plots of {title} by condition"),
            )
        )
    title, unit, scale = scale_of(measures.error, summary)
    shown = samples(study, table, measures.error, scale)
    drawn.append(_touchdowns(study, shown, unit, diamonds))
    if all((sample.values > 0.0).all() for sample in shown):
        drawn.append(_tails(shown, f"{title} ({unit})"))
    if len(study.grids) == 1 and _numeric(next(iter(study.grids.values()))):
        drawn.append(_over_grid(study, summary))
    return drawn


def _by_cell(study: Study, table: pd.DataFrame, summary: Mapping[str, Any]) -> tuple[str, str, str]:
    told = " ".join(
        [
            *(text.replace("*", "") for text in maps.sentences(study, table)),
            *(maps.rule(budget) for budget in study.budgets),
        ]
    )
    return (
        "Mean error by cell",
        "Means of the runs that succeeded, and how many those are where it is fewer than "
        f"{100 * maps.SURE:g} %. {told} Every cell with its intervals: cells.csv.",
        figures.to_svg(maps.draw(study, summary), "Mean landing error by cell"),
    )


def _touchdowns(
    study: Study, shown: list[Sample], unit: str, diamonds: str
) -> tuple[str, str, str]:
    """Small multiples, one row or more a group, one scale a group."""
    groups: dict[str, list[Sample]] = {}
    for condition, sample in zip(study.conditions, shown, strict=True):
        groups.setdefault(_group(study, condition), []).append(sample)
    if max(len(members) for members in groups.values()) == 1:
        groups = {"": shown}
    rows = [
        (members[start : start + COLUMNS], _reach(members))
        for members in groups.values()
        for start in range(0, len(members), COLUMNS)
    ]
    columns = max(len(members) for members, _ in rows)
    made = figures.figure(2.5 * columns + 0.2, 2.85 * len(rows))
    grid = made.subplots(len(rows), columns, squeeze=False)
    for line, (members, reach) in zip(grid, rows, strict=True):
        for axes, sample in zip(line, members, strict=False):
            figures.touchdowns(axes, sample, reach, unit)
        for axes in line[len(members) :]:
            axes.set_visible(False)
        line[0].set_ylabel(f"north ({unit})", fontsize=8)
    return (
        "Touchdown points",
        "About the centre of the pad; red circles hold half (CEP50) and 95 % of the landings."
        + diamonds,
        figures.to_svg(made, "Touchdown points around the pad by condition"),
    )


def _reach(members: list[Sample]) -> float:
    """Half the width of a group's panels: nearly all landings, but not the one 10 m away."""
    far = [
        max(float(np.quantile(distance, 0.98)), float(published.max(initial=0.0)))
        for sample in members
        for distance in [np.hypot(sample.x, sample.y)]
        for published in [_published_distance(sample)]
        if len(distance)
    ]
    return 1.15 * max(far, default=1.0) or 1.0


def _published_distance(sample: Sample) -> np.ndarray[Any, np.dtype[np.float64]]:
    if sample.published_x is None or sample.published_y is None:
        return np.empty(0)
    return np.hypot(sample.published_x, sample.published_y)


def _tails(shown: list[Sample], label: str) -> tuple[str, str, str]:
    by_colour: dict[str, list[Sample]] = {}
    for sample in shown:
        by_colour.setdefault(sample.colour, []).append(sample)
    # One panel a group, its members in shades of line style.
    panels = list(by_colour.values()) if len(shown) > MOST_CURVES else [shown]
    columns = min(2, len(panels))
    rows = math.ceil(len(panels) / columns)
    made = figures.figure(9.4, 0.4 + 3.1 * rows)
    grid = made.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, members in zip(grid, panels, strict=False):
        figures.exceedance(axes, members, label)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    return (
        "Tails",
        "The share of landings that end farther out than a distance: one in a hundred is at 1 %.",
        figures.to_svg(made, "Share of landings beyond each distance"),
    )


def _over_grid(study: Study, summary: Mapping[str, Any]) -> tuple[str, str, str]:
    path = next(iter(study.grids))
    column = study.measures.error
    title, unit, scale = scale_of(column, summary)
    made = figures.figure(9.4, 3.4)
    left, right = made.subplots(1, 2)
    hues = figures.colours(list(study.variants) or ["default"])
    for name, colour in hues.items():
        rows = [row for row in summary["conditions"] if row["variant"] == name]
        at = [row["point"][path] for row in rows]
        label = study.variants[name].label or name if study.variants else study.scenario
        for axes, numbers, factor in (
            (left, [row["statistics"][column]["median"] for row in rows], scale),
            (right, [row["success"] for row in rows], 100.0),
        ):
            value, low, high = (
                [math.nan if number[key] is None else number[key] * factor for number in numbers]
                for key in ("value", "low", "high")
            )
            figures.curve(axes, at, value, low, high, label=label, colour=colour)
    for axes, text in ((left, f"median {title} ({unit})"), (right, "success (%)")):
        axes.set_xlabel(path)
        axes.set_ylabel(text)
    left.set_ylim(bottom=0.0)
    right.set_ylim(-2.0, 102.0)
    if len(hues) > 1:
        left.legend(fontsize=8)
    return (
        f"Over {path}",
        f"Bands: {100 * CONFIDENCE:g} % intervals.",
        figures.to_svg(made, f"Median {title} and success over {path}"),
    )


def _numeric(values: list[Any]) -> bool:
    return all(isinstance(value, (int, float)) for value in values)

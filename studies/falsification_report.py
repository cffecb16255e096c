"""What a search for the mildest spoiled landing has come to, on one page."""

import json
import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from studies import figures
from studies.falsification import Case, Finding, fresh_seeds, outcome
from studies.ledger import Row, write_durably
from studies.page import Section, write_page


def write_report(finding: Finding) -> None:
    """Write `finding.json`, `report.md` and `report.html` of a search."""
    text = json.dumps(summary(finding), indent=2, ensure_ascii=False, allow_nan=False)
    write_durably(finding.folder / "finding.json", f"{text}\n".encode())
    with figures.style():
        write_page(
            finding.folder,
            f"What spoils {finding.scenario}?",
            finding.sentence() + ".",
            _sections(finding),
        )


def summary(finding: Finding) -> dict[str, Any]:
    """The finding as plain data."""
    best = finding.best
    return {
        "scenario": finding.scenario,
        "overrides": finding.base,
        "sentence": finding.sentence(),
        "vary": [entry.name for entry in finding.space.disturbances],
        "seed": finding.seed,
        "seeds": finding.seeds,
        "miss_m": finding.miss,
        "budget": finding.budget,
        "flights": finding.asked,
        "cases": len(finding.cases),
        "complete": finding.complete,
        "confirmed": finding.confirmed,
        "severity": best.severity if best else None,
        "values": finding.space.values(best.point) if best else None,
        "case_overrides": finding.space.overrides(best.point) if best else None,
        "outcomes": [outcome(row) for row in best.rows] if best else None,
        "case": finding.space.describe(best.point) if best else None,
        "worst": outcome(best.worst()) if best else None,
        "luckiest": finding.luckiest.severity if finding.luckiest else None,
        "alone": {
            name: {"case": finding.space.describe(case.point), "spoils": case.spoils}
            for name, case in finding.alone.items()
        },
        "other_seeds": len(finding.fresh),
        "other_seeds_missed": finding.fresh_missed,
    }


def _sections(finding: Finding) -> list[Section]:
    sections = []
    if finding.interrupted:
        sections.append(
            Section("Not finished", "Interrupted; the same command goes on where it stopped.")
        )
    if finding.best is not None:
        sections += _found(finding, finding.best)
    if finding.alone:
        sections.append(_alone(finding))
    sections.append(_history(finding))
    sections.append(_searched(finding))
    failed = [row for case in finding.cases for row in case.rows if row["status"] != "done"]
    if failed:
        sections.append(
            Section(
                "Flights that failed",
                "These say something about the laboratory, not about the landing.",
                rows=[[str(row["seed"]), str(row["failure"])] for row in failed],
                head=["seed", "failure"],
            )
        )
    return sections


def _found(finding: Finding, best: Case) -> list[Section]:
    case = finding.folder / "case.yaml"
    flights = [
        [str(seed), outcome(row), _speed(row)]
        for seed, row in zip(finding.seeds, best.rows, strict=False)
    ]
    flights += [
        [f"{seed} (fresh)", outcome(row), _speed(row)]
        for seed, row in zip(fresh_seeds(finding), finding.fresh, strict=False)
    ]
    return [
        Section(
            "The case",
            f"Severity {best.severity:.3f}, where 1 is one disturbance at its limit.",
            code=f"plumbline land {case}\n\n{case.read_text(encoding='utf-8')}",
        ),
        Section(
            "Its flights",
            "A case is spoiled if most of the searched seeds are; a second that agrees with the "
            "first spares the rest. Fresh seeds, which the search did not see, confirm it: "
            + (
                "half or more agree."
                if finding.confirmed
                else "fewer than half agree, so bad luck is part of the case."
            )
            + (
                f" The mildest case that spoiled the searched seeds, at severity "
                f"{finding.luckiest.severity:.2f}, was not confirmed."
                if finding.luckiest
                else ""
            ),
            head=["seed", "outcome", "touchdown (m/s)"],
            rows=flights,
        ),
    ]


def _speed(row: Row) -> str:
    return f"{float(row['touchdown_speed_m_s']):.2f}" if row["status"] == "done" else ""


def _alone(finding: Finding) -> Section:
    space, rows = finding.space, []
    for entry in space.disturbances:
        case = finding.alone.get(entry.name)
        if case is None:
            continue
        rows.append(
            [
                entry.name,
                space.describe(case.point),
                "spoils" if case.spoils else "lands at its limit",
                "; ".join(outcome(row) for row in case.rows),
            ]
        )
    if len(rows) > 1 and finding.together is not None:
        case = finding.together
        rows.append(
            [
                "all at their limits",
                "",
                "spoils" if case.spoils else "lands",
                "; ".join(outcome(row) for row in case.rows),
            ]
        )
    return Section(
        "One at a time",
        "Bars: the case's strengths on the scale from the mildest (0) to the limit (1). Ticks: "
        "from where on each disturbance alone spoils the landing, if it does.",
        head=["disturbance", "alone", "", "flights"],
        rows=rows,
        figure=_bars(finding),
        name="one-at-a-time",
    )


def _bars(finding: Finding) -> Figure:
    space = finding.space
    entries = space.disturbances
    drawn = figures.figure(7.4, 0.9 + 0.36 * len(entries))
    axes = drawn.subplots()
    for line, (index, entry) in enumerate(zip(space.strengths, entries, strict=True)):
        if finding.best is not None:
            strength = float(np.clip(finding.best.point[index], 0.0, 1.0))
            axes.barh(-line, strength, 0.55, color=figures.PALETTE[2], alpha=0.75)
        alone = finding.alone.get(entry.name)
        if alone is not None and alone.spoils:
            axes.plot(
                [alone.severity] * 2, [-line - 0.38, -line + 0.38], color=figures.MEDIAN, lw=2
            )
    axes.set_yticks(range(0, -len(entries), -1), [entry.name for entry in entries])
    axes.tick_params(axis="y", colors=figures.INK)
    axes.grid(axis="y", visible=False)
    axes.set_xlim(0.0, 1.02)
    axes.set_xlabel("strength (1: the limit)")
    return drawn


def _history(finding: Finding) -> Section:
    drawn = figures.figure(7.4, 3.4)
    axes = drawn.subplots()
    tried = [case for case in finding.cases if case.step != "undisturbed"]
    for spoils, colour, label in (
        (False, figures.PALETTE[3], "lands"),
        (True, figures.PALETTE[5], "spoiled"),
    ):
        shown = [case for case in tried if case.spoils is spoils]
        axes.scatter(
            [case.asked for case in shown],
            [case.severity for case in shown],
            s=14,
            color=colour,
            alpha=0.75,
            lw=0,
            label=label,
        )
    at: list[float] = []
    mildest: list[float] = []
    for case in tried:
        if case.spoils and (not mildest or case.severity < mildest[-1]):
            at.append(case.asked)
            mildest.append(case.severity)
    if mildest:
        axes.step(
            [*at, finding.asked],
            [*mildest, mildest[-1]],
            where="post",
            color=figures.MEDIAN,
            lw=1.4,
            label="mildest spoiled",
        )
    if finding.best is not None:
        axes.scatter(
            [finding.best.asked],
            [finding.best.severity],
            s=46,
            marker="D",
            facecolor="none",
            edgecolor=figures.INK,
            lw=1.2,
            label="the case",
        )
    axes.set_xlabel("flights")
    axes.set_ylabel("severity")
    axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, 1.05 * max(1.0, math.sqrt(len(finding.space.disturbances))))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="upper right", ncols=4)
    return Section(
        "The search",
        f"{len(finding.cases)} cases in {finding.asked} flights, each a dot at its severity.",
        figure=drawn,
        name="history",
    )


def _searched(finding: Finding) -> Section:
    sources = {entry.name: entry for entry in finding.space.disturbances}
    rows = []
    for variable in finding.space.variables:
        entry = sources.get(variable.name)
        rows.append(
            [
                variable.name,
                f"{variable.low:.4g} to {variable.high:.4g} {variable.unit}".strip(),
                entry.text if entry else "free",
                entry.source if entry else "",
            ]
        )
    return Section(
        "What was searched",
        f"Spoiled: not landed, or more than {finding.miss:g} m from where it should, in most of "
        f"the seeds {', '.join(map(str, finding.seeds))}.",
        head=["", "range", "", "source of the limit"],
        rows=rows,
    )

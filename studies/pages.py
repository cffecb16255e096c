"""The page of a study: tables, figures and rows of its campaign, for `docs/`.

    python -m studies.pages out/studies/infrared-and-marker [MORE FOLDERS] [--docs docs]

Every folder of a campaign of study NAME leaves `docs/data/NAME.csv` and `docs/data/NAME-*.svg`, and
fills the block of each page that asks for it, ``<!-- campaign NAME -->`` to ``<!-- end -->``. The
CSV holds the campaign's rows, rounded, or if it has axes or many landings a row a cell, with
intervals. The words around the blocks are written by hand.
"""

import argparse
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import cramervonmises_2samp

from studies import figures, maps
from studies.campaign import summarise_again
from studies.ledger import Ledger
from studies.provenance import commit_of
from studies.published import PUBLISHED, SIGNIFICANCE
from studies.report import samples
from studies.study import Study
from studies.summary import agreement, rate, scale_of, show, show_rate, with_measures

FAR = 0.5  # m, a landing farther out than this has missed
KEPT = 2000  # landings, 150 kB: a larger campaign's rows stay in its folder
DECIMALS = 4  # of the kept rows: 0.1 mm, 0.1 ms


def write(folder: Path, docs: Path) -> None:
    """Write what a campaign has to say into the pages under `docs`."""
    result = summarise_again(folder)
    study = result.study
    table = with_measures(study, result.table)
    data = docs / "data"
    data.mkdir(parents=True, exist_ok=True)
    if study.axes or len(table) > KEPT:
        rows = maps.cell_table(study, result.summary)
    else:
        rows = table[["run", "condition", *study.measures.columns()]]
    rows.round(DECIMALS).to_csv(data / f"{study.name}.csv", index=False)
    _draw(study, table, result.summary, data)
    with Ledger.open(folder) as ledger:
        flown = _flown(ledger.provenance["source"])
    text = tables(study, table, result.summary, flown)
    block = re.compile(
        rf"(<!-- campaign {re.escape(study.name)} -->\n).*?(<!-- end -->)", re.DOTALL
    )
    for page in docs.glob("*.md"):
        old = page.read_text(encoding="utf-8")
        new = block.sub(lambda match: f"{match[1]}\n{text}\n{match[2]}", old)
        if new != old:
            page.write_text(new, encoding="utf-8")


def _flown(source: str) -> str:
    commit = commit_of(source)
    return f"at commit {commit}" if commit else f"by a source of no commit ({source[:8]})"


def tables(study: Study, table: pd.DataFrame, summary: Mapping[str, Any], flown: str) -> str:
    """The figures and tables of a campaign as Markdown; `flown` says by what source."""
    counts = [condition["runs"] for condition in summary["conditions"]]
    many = str(counts[0]) if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}"
    place = "cell" if study.axes else "row"
    lines = [
        f"{summary['done']} landings, {many} a {place} (the study asks for {study.runs}), "
        f"flown {flown}; campaign seed {study.seed}. Intervals: 95 %.",
        "",
    ]
    if study.axes:
        figure = f"data/{study.name}-{_figure_name(study)}.svg"
        lines += maps.markdown_lines(study, table, summary, figure, f"data/{study.name}.csv")
        return "\n".join(lines)
    lines += [f"![Landing error by row](data/{study.name}-error.svg)", ""]
    lines += (
        _published(study, summary)
        if summary["published"]
        else _distributions(study, table, summary)
    )
    return "\n".join(lines)


def _published(study: Study, summary: Mapping[str, Any]) -> list[str]:
    lines = [f"**{agreement(summary)}**", ""]
    columns = {"error": study.measures.error, "time": study.measures.time}
    medians = {
        condition["condition"]: {
            quantity: condition["statistics"][column]["median"]["value"]
            for quantity, column in columns.items()
        }
        for condition in summary["conditions"]
    }
    for quantity, title in (("error", "Landing error"), ("time", "Time to the stopped motors")):
        unit, scale = ("cm", 100.0) if quantity == "error" else ("s", 1.0)
        lines += [
            f"| {title} ({unit}), mean; median | of | thesis | here | p (Holm) | verdict |",
            "|---|---|---:|---:|---:|---|",
        ]
        for row in summary["published"]:
            if row["quantity"] == quantity:
                theirs = np.median(getattr(PUBLISHED[row["published"]], quantity)) * scale
                ours = medians[row["condition"]][quantity] * scale
                lines.append(
                    f"| {row['condition']} | {row['table']} "
                    f"| {row['their_mean'] * scale:.1f}; {theirs:.1f} "
                    f"| {row['our_mean'] * scale:.1f}; {ours:.1f} | {row['p_adjusted']:.2g} "
                    f"| {'agrees' if row['agrees'] else '**differs**'} |"
                )
        lines.append("")
    return lines


def _distributions(study: Study, table: pd.DataFrame, summary: Mapping[str, Any]) -> list[str]:
    measures = study.measures
    _, unit, scale = scale_of(measures.error, summary)
    lines = [
        f"| condition | landed | CEP50 ({unit}) | p95 | p99 | farther than {FAR:g} m "
        "| touchdown (m/s) | time (s) |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for condition in summary["conditions"]:
        rows = table[table["condition"].eq(condition["condition"])]
        landed = rows[rows[measures.success].eq(True)]
        numbers = condition["statistics"]
        far = rate(int((landed[measures.error] > FAR).sum()), len(landed))
        cells = [
            condition["condition"],
            f"{condition['success']['value'] or 0:.0%} of {condition['runs']}",
            show(condition["cep50"], scale),
            show(numbers[measures.error]["p95"], scale),
            show(numbers[measures.error]["p99"], scale),
            show_rate(far),
            show(numbers["touchdown_speed_m_s"]["mean"], 1.0),
            show(numbers[measures.time]["mean"], 1.0),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    if len(summary["conditions"]) == 2:
        lines += ["", _told_apart(study, table, summary)]
    return [*lines, ""]


def _told_apart(study: Study, table: pd.DataFrame, summary: Mapping[str, Any]) -> str:
    """Whether the landings of two conditions can be told apart, by the test of `published`."""
    landed = table[table[study.measures.success].eq(True)]
    names = [condition["condition"] for condition in summary["conditions"]]
    found = []
    for column, title in ((study.measures.error, "landing error"), (study.measures.time, "time")):
        sides = [landed.loc[landed["condition"].eq(name), column].dropna() for name in names]
        if min(map(len, sides)) < 2:
            return "Too few have landed for a test."
        p = cramervonmises_2samp(*sides).pvalue
        found.append(
            f"{title} p = {p:.2g}, {'cannot' if p >= SIGNIFICANCE else '**can**'} be told apart"
        )
    return f"Two-sample Cramér–von Mises tests, {SIGNIFICANCE:.0%}: {'; '.join(found)}."


def _draw(study: Study, table: pd.DataFrame, summary: Mapping[str, Any], data: Path) -> None:
    """The errors on white: by cell, or box plots with published trials beside them."""
    column = study.measures.error
    title, unit, scale = scale_of(column, summary)
    with figures.style():
        if study.drawn_by_cell:
            made = maps.draw(study, summary)
        else:
            shown = samples(study, table, column, scale)
            made = figures.figure(9.4, 0.9 + 0.42 * len(shown))
            wide = all((sample.values > 0.0).all() and np.size(sample.values) for sample in shown)
            figures.boxes(made.subplots(), shown, f"{title} ({unit})", logarithmic=wide)
        made.savefig(
            data / f"{study.name}-{_figure_name(study)}.svg",
            facecolor="white",
            metadata={"Date": None, "Creator": None},
        )


def _figure_name(study: Study) -> str:
    return "cells" if study.drawn_by_cell else "error"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Write the pages of campaigns.")
    parser.add_argument("folders", nargs="+", type=Path, help="of campaigns")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    arguments = parser.parse_args()
    for folder in arguments.folders:
        write(folder, arguments.docs)


if __name__ == "__main__":
    main()

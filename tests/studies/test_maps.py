import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies import figures, maps, pages
from studies.campaign import run_study, summarise_again
from studies.ledger import Ledger
from studies.report import write_report
from studies.study import Axis, Budget, Level, Promise, Study, Variant, load_study
from studies.summary import summarise

PAIRS = 60
SLOPES = {"ignored": 0.8e-3, "stamped": 0.0}  # m a ms


def landings(study: Study) -> pd.DataFrame:
    """Errors that grow linearly with latency, by SLOPES; beyond 300 ms half do not land."""
    rng = np.random.default_rng(5)
    rows = []
    for pair in range(PAIRS):
        common = rng.uniform(0.05, 0.15)
        for run, condition in enumerate(study.conditions):
            latency = float(condition.levels["latency"])
            error = common + SLOPES[condition.variant] * latency + rng.normal(0.0, 0.002)
            landed = latency <= 300.0 or condition.variant == "stamped" or pair % 2 == 0
            rows.append(
                {
                    "run": len(study.conditions) * pair + run,
                    "pair": pair,
                    "condition": condition.label,
                    "variant": condition.variant,
                    "landed": landed,
                    "landing_error_m": error,
                    "landing_x_m": error,
                    "landing_y_m": 0.0,
                    "landing_time_s": 20.0,
                    "touchdown_speed_m_s": 0.3,
                    "seed": pair,
                    "status": "done",
                    "failure": "",
                }
            )
    return pd.DataFrame(rows)


@pytest.fixture
def study() -> Study:
    return Study(
        name="late",
        scenario="toy",
        variants={
            "ignored": Variant(label="Ignored", lacks=["dimmer"]),
            "stamped": Variant(label="Time stamps"),
        },
        axes={
            "light": Axis(values=[1, 2], paths={"dimmer": 1.0}),
            "latency": Axis(
                label="camera latency (ms)", values=[0, 100, 200, 300, 400], paths={"delay": 1e-3}
            ),
        },
        budgets=[Budget(axis="latency")],
        layout="curves",
    )


@pytest.fixture
def flown(study: Study, tmp_path: Path):
    table = landings(study)
    return table, summarise(study, table, len(table), tmp_path), tmp_path


def test_every_cell_has_its_statistics_also_where_it_shows_anothers_runs(study, flown):
    table, summary, _ = flown
    cells = maps.cell_table(study, summary)
    assert len(cells) == 2 * 2 * 5
    assert len(study.conditions) == 5 + 10
    late = cells[cells["latency"].eq("300")].set_index(["variant", "light"])
    first, second = late.loc[("ignored", "1")], late.loc[("ignored", "2")]
    assert first.equals(second)
    runs = table[table["condition"].eq(first["runs_of"])]
    assert first["landing_error_m_mean"] == pytest.approx(runs["landing_error_m"].mean())
    assert first["landing_error_m_mean_low"] < first["landing_error_m_mean"]
    assert (first["runs"], first["success"]) == (PAIRS, 1.0)


def test_a_budget_is_spent_where_the_mean_has_grown_by_it(study, flown):
    table, _, _ = flown
    rows = {
        (row.variant, row.levels["light"]): row
        for row in maps.spent(study, table, study.budgets[0])
    }
    row = rows["ignored", "1"]
    assert row.at == pytest.approx(0.1 / SLOPES["ignored"], rel=0.02)
    assert row.low < row.at < row.high  # narrow, since pairs have most of the error in common
    assert row.high - row.low < 5.0
    assert row.undisturbed == pytest.approx(0.1, abs=0.01)
    assert rows["stamped", "2"].at is None


def test_a_budget_is_spent_where_too_few_land(study, flown):
    table, _, _ = flown
    row, *_ = maps.spent(study, table, Budget(axis="latency", loss=1.0))
    assert (row.at, row.by) == (400.0, "success")


def test_a_budget_may_run_down_an_axis():
    study = Study(
        name="slow",
        scenario="toy",
        variants={"ignored": Variant()},
        axes={"latency": Axis(label="frames a second", values=[30, 10, 5], paths={"rate": 1.0})},
        budgets=[Budget(axis="latency", loss=0.002)],
    )
    table = landings(study)
    table["landing_error_m"] = 0.1 + 0.001 * (30.0 - table["condition"].map(_number))
    (row,) = maps.spent(study, table, study.budgets[0])
    assert row.at == pytest.approx(28.0)
    (text,) = maps.sentences(study, table)
    assert text.startswith("**ignored**, 0.2 cm over *frames a second*; lost at 28 [28, 28]")


def _number(label: str) -> float:
    return float(label.rsplit(" ", 1)[1])


def test_budgets_in_words(study, flown):
    table, _, _ = flown
    table = table.copy()
    table.loc[table["condition"].str.contains("stamps, light 2"), "landing_error_m"] += 0.02
    ignored, stamped = maps.sentences(study, table)
    # Both lights show the same runs, so it is said once.
    assert ignored.startswith("**Ignored**, 10 cm over *camera latency*; lost at 12")
    assert " ms [" in ignored
    assert "(10" in ignored or "(9." in ignored
    one, two = stamped.split("; ")[1:]
    assert one.startswith("light 1: not lost up to 400 ms (")
    assert two.startswith("light 2: not lost up to 400 ms (")


def test_names_have_no_budget(study):
    study = Study(
        name="named",
        scenario="toy",
        axes={"fault": Axis(levels={"none": Level(), "some": Level(overrides={"x": 1})})},
        budgets=[Budget(axis="fault")],
    )
    with pytest.raises(ValueError, match="the levels of fault are not numbers"):
        maps.spent(study, pd.DataFrame({"landed": []}), study.budgets[0])


def league(errors: dict[str, np.ndarray], landed: dict[str, float] | None = None):
    """A table of systems without a fault: their errors (pairs,), and the share that lands."""
    study = Study(
        name="league",
        scenario="toy",
        variants={name: Variant(label=name.title()) for name in errors},
        axes={
            "fault": Axis(
                label="condition",
                levels={"none": Level(label="no fault"), "all": Level(without=["a"])},
            )
        },
        layout="table",
    )
    rows = []
    for condition in study.conditions:
        values = errors[condition.variant]
        share = (landed or {}).get(condition.variant, 1.0)
        for pair, error in enumerate(values):
            rows.append(
                {
                    "pair": pair,
                    "run": pair,
                    "seed": pair,
                    "condition": condition.label,
                    "landed": pair < share * len(values),
                    "landing_error_m": error,
                    "status": "done",
                    "failure": "",
                }
            )
    return study, pd.DataFrame(rows)


def test_the_winner_and_what_the_pairs_cannot_tell_from_it_are_bold(tmp_path: Path):
    rng = np.random.default_rng(3)
    base = rng.uniform(0.05, 0.25, 200)
    study, table = league(
        {
            "a": base,
            "b": base + rng.normal(0.001, 0.02, 200),  # cannot be told from a
            # can, pair by pair, though the two samples overlap
            "c": base + rng.normal(0.01, 0.005, 200),
            "d": 0.1 * base,  # better, but two in ten crash
        },
        {"d": 0.8},
    )
    summary = summarise(study, table, len(table), tmp_path)
    lines = maps.table_lines(study, table, summary)
    head, _, none, some, *_ = lines
    assert head == "| condition | A | B | C | D |"
    a, b, c, d = (cell.strip() for cell in none.split("|")[2:-1])
    assert a.startswith("**")
    assert b.startswith("**")
    assert not c.startswith("**")
    assert d.endswith("(80 %)")
    assert "*" not in d
    assert some.split("|")[2].strip() == "–"
    mean, p99 = (float(part) for part in c.split(";"))
    errors = table.loc[table["condition"].eq("C, no fault"), "landing_error_m"]
    assert mean == pytest.approx(100.0 * errors.mean(), rel=5e-3)
    assert p99 == pytest.approx(100.0 * errors.quantile(0.99), rel=5e-3)


def test_the_leader_is_named_and_where_it_does_not_lead(tmp_path: Path):
    base = np.linspace(0.05, 0.25, 200)
    # a does not fly the second row
    study, table = league({"a": 0.5 * base, "b": base, "c": np.full(200, 0.2)})
    lines = maps.standing_lines(study, table, summarise(study, table, len(table), tmp_path))
    assert lines == [
        "**A** has the least mean in 1 of 1 rows and the least 99th percentile in 1, "
        "of what lands in 95 %.",
        "",
    ]
    wide = np.where(np.arange(200) < 4, 0.9, 0.1 * base)  # four far misses
    study, table = league({"a": np.full(200, 0.05), "b": wide, "c": base}, {"c": 0.5})
    lines = maps.standing_lines(study, table, summarise(study, table, len(table), tmp_path))
    assert lines == [
        "**B** has the least mean in 2 of 2 rows and the least 99th percentile in 1, "
        "of what lands in 95 %. Not in:",
        "",
        "* no fault: 99th percentile A 5, B 90 cm",
    ]
    study, table = league({"a": base, "b": 0.9 * base}, {"a": 0.9, "b": 0.8})
    assert maps.standing_lines(study, table, summarise(study, table, len(table), tmp_path)) == []


def test_nobody_wins_where_all_miss(tmp_path: Path):
    study, table = league({"a": np.full(9, 1.234567), "b": np.full(9, 12.4)})
    summary = summarise(study, table, len(table), tmp_path)
    line = maps.table_lines(study, table, summary)[2]
    assert line == "| no fault | 123; 123 | 1240; 1240 |"


def test_a_figure_for_each_layout_says_how_many_land(study, flown):
    _, summary, _ = flown
    texts = {}
    for layout in ("curves", "maps", "table"):
        study.layout = layout
        with figures.style():
            texts[layout] = figures.to_svg(maps.draw(study, summary), layout)
    assert "camera latency (ms)" in texts["curves"]
    assert "Time stamps" in texts["curves"]
    for layout in ("maps", "table"):
        assert "50 %" in texts[layout]
        assert "mean landing error (cm)" in texts[layout]


@pytest.mark.parametrize("layout", ["curves", "maps", "table"])
def test_a_study_without_variants_is_shown_by_its_scenario(layout, monkeypatch, tmp_path: Path):
    monkeypatch.setitem(SLOPES, "default", 1e-3)
    study = Study(
        name="alone",
        scenario="toy",
        axes={
            "gate": Axis(values=[1, 2], paths={"gate": 1.0}),
            "latency": Axis(values=[0, 200], paths={"delay": 1.0}),
        },
        budgets=[Budget(axis="latency")],
        layout=layout,
    )
    table = landings(study)
    summary = summarise(study, table, len(table), tmp_path)
    with figures.style():
        text = figures.to_svg(maps.draw(study, summary), layout)
    assert "toy" in text
    assert maps.sentences(study, table)[0].startswith("**toy**, 10 cm over *latency*")
    assert maps.table_lines(study, table, summary)[0] == "| latency (gate 1) | toy |"


def test_promises_are_counted_of_the_target_and_of_the_undisturbed_twin(study, tmp_path: Path):
    study = dataclasses.replace(
        study,
        layout="table",
        promises=[Promise(within=0.15), Promise(within=0.1, of="first_level")],
    )
    table = landings(study)
    summary = summarise(study, table, len(table), tmp_path)
    of_target, of_twin = (
        {(row["variant"], *row["levels"].values()): row["share"] for row in promise["cells"]}
        for promise in summary["promises"]
    )
    runs = table[table["variant"].eq("ignored") & table["condition"].str.endswith("100")]
    kept = (runs["landing_error_m"] <= 0.15).mean()
    assert of_target["ignored", "2", "100"]["value"] == pytest.approx(kept)
    # 0.8 mm a ms: moved by 8 cm at 100 ms and by 16 at 200; beyond 300 ms half do not land
    assert ("ignored", "1", "0") not in of_twin
    assert of_twin["ignored", "1", "100"]["value"] == 1.0
    assert of_twin["ignored", "1", "200"]["value"] == 0.0
    assert of_twin["stamped", "1", "400"]["value"] == 1.0
    wide = dataclasses.replace(study, promises=[Promise(within=1.0, of="first_level")])
    (promise,) = summarise(wide, table, len(table), tmp_path)["promises"]
    shares = {(row["variant"], row["levels"]["latency"]): row["share"] for row in promise["cells"]}
    assert shares["ignored", "400"]["value"] == 0.5
    lines = maps.promise_lines(study, summary)
    assert lines[0] == "| within 15 cm (light 1) | Ignored | Time stamps |"
    assert any(line.startswith("| within 10 cm of the undisturbed touchdown") for line in lines)


def test_the_report_tells_cells_and_budgets(study, flown):
    table, summary, folder = flown
    write_report(study, table, summary, folder)
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "Mean error by cell" in html
    assert "Ignored, 10 cm over camera latency" in html
    assert "Touchdown points" not in html
    cells = pd.read_csv(folder / "cells.csv")
    assert len(cells) == len(study.cells)
    assert json.loads((folder / "summary.json").read_text())["paired"] == []


def test_a_page_gets_the_figure_budgets_and_cells(tmp_path: Path):
    study = Study(
        name="toymap",
        scenario="toy",
        experiment="tests.studies.toy:Gentle",
        variants={"one": Variant(), "two": Variant(overrides={"toy.failures": 0.0})},
        axes={"spread": Axis(values=[0.1, 0.2, 0.4], paths={"toy.spread": 1.0})},
        budgets=[Budget(axis="spread", success=0.5)],
        layout="table",
    )
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "page.md").write_text("<!-- campaign toymap -->\n<!-- end -->\n")
    run_study(study, tmp_path / "campaign", 240, workers=0, progress=False)
    pages.write(tmp_path / "campaign", docs)
    text = (docs / "page.md").read_text()
    assert "240 landings, 40 a cell" in text
    assert "**one**, 10 cm over *spread*" in text
    assert "| spread | one | two |" in text
    assert "(data/toymap-cells.svg)" in text
    assert len(pd.read_csv(docs / "data" / "toymap.csv")) == 6
    assert (docs / "data" / "toymap-cells.svg").exists()
    assert math.isfinite(pd.read_csv(docs / "data" / "toymap.csv")["landing_error_m_p99"].max())


def test_a_page_of_distributions_draws_boxes_above_the_table(tmp_path: Path):
    study = Study(
        name="toyboxes",
        scenario="toy",
        experiment="tests.studies.toy:Gentle",
        axes={"spread": Axis(values=[0.1, 0.2], paths={"toy.spread": 1.0})},
        promises=[Promise(within=0.3)],
        layout="distributions",
    )
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "page.md").write_text("<!-- campaign toyboxes -->\n<!-- end -->\n")
    run_study(study, tmp_path / "campaign", 40, workers=0, progress=False)
    pages.write(tmp_path / "campaign", docs)
    text = (docs / "page.md").read_text()
    assert "(data/toyboxes-error.svg)" in text
    assert (docs / "data" / "toyboxes-error.svg").exists()
    assert "| spread | toy |" in text
    assert "| within 30 cm | toy |" in text
    html = (tmp_path / "campaign" / "report.html").read_text(encoding="utf-8")
    assert "Within 30 cm" in html
    assert "Touchdown points" in html


def test_a_campaign_of_the_laboratory_is_told_in_its_present_words(tmp_path: Path):
    now = load_study("moving-pad")
    then = dataclasses.replace(now, description="Otherwise.", layout="table", promises=[])
    Ledger.create(tmp_path / "campaign", then, 2).close()
    told = summarise_again(tmp_path / "campaign").study
    assert (told.description, told.layout) == (now.description, now.layout)

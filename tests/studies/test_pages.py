from pathlib import Path

import pandas as pd
from scipy.stats import cramervonmises_2samp

from studies import pages
from studies.campaign import run_study
from tests.studies.driver import slow_study

RUNS = 24
PAGE = "# Words\n\n<!-- campaign {} -->\nold\n<!-- end -->\n\nMore words.\n"


def flown(folder: Path):
    study = slow_study()
    study.measures.others = ["touchdown_speed_m_s"]
    study.experiment = "tests.studies.toy:Gentle"
    return run_study(study, folder, RUNS, workers=0, progress=False)


def test_a_page_gets_the_tables_figures_and_rows_of_its_campaign(tmp_path: Path):
    folder, docs = tmp_path / "campaign", tmp_path / "docs"
    docs.mkdir()
    (docs / "mine.md").write_text(PAGE.format("toy"))
    (docs / "other.md").write_text(PAGE.format("another"))
    result = flown(folder)
    pages.write(folder, docs)

    text = (docs / "mine.md").read_text()
    assert text.startswith("# Words")
    assert text.endswith("More words.\n")
    assert "\nold\n" not in text
    assert f"{RUNS} landings, {RUNS // 2} a row" in text
    for condition in ("narrow", "wide"):
        assert f"| {condition} | " in text
    landed = result.table[result.table["landed"]]
    narrow, wide = (
        landed.loc[landed["condition"].eq(name), "landing_error_m"] for name in ("narrow", "wide")
    )
    p = cramervonmises_2samp(narrow, wide).pvalue  # two conditions are held against each other
    verdict = "cannot" if p >= 0.01 else "**can**"
    assert f"landing error p = {p:.2g}, {verdict} be told apart" in text
    assert (docs / "other.md").read_text() == PAGE.format("another")

    kept = pd.read_csv(docs / "data" / "toy.csv")
    assert kept["run"].tolist() == list(range(RUNS))
    pd.testing.assert_series_equal(
        kept["landing_error_m"], result.table["landing_error_m"], atol=1e-4, check_exact=False
    )
    assert (docs / "data" / "toy-error.svg").read_text().count("<svg") == 1

    pages.write(folder, docs)  # the same again
    assert (docs / "mine.md").read_text() == text


def test_of_a_large_campaign_a_row_a_condition_is_kept(tmp_path: Path, monkeypatch):
    folder, docs = tmp_path / "campaign", tmp_path / "docs"
    result = flown(folder)
    docs.mkdir()
    monkeypatch.setattr(pages, "KEPT", RUNS - 1)
    pages.write(folder, docs)
    kept = pd.read_csv(docs / "data" / "toy.csv").set_index("runs_of")
    assert sorted(kept.index) == ["narrow", "wide"]
    landed = result.table[result.table["landed"]]
    means = landed.groupby("condition")["landing_error_m"].mean()
    for condition, row in kept.iterrows():
        assert abs(row["landing_error_m_mean"] - means[condition]) < 1e-4
        assert row["landing_error_m_mean_low"] < means[condition] < row["landing_error_m_mean_high"]

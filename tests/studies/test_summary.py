import json
import math
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from studies import figures, summary
from studies.figures import Sample
from studies.report import write_report
from studies.study import Measures, Study, Variant
from studies.summary import largest, mean, quantile, quantity, rate, show, statistics, summarise


def test_a_rate_has_wilsons_interval():
    # R. G. Newcombe, Statistics in Medicine 17 (1998), table I, method 3: 81 of 263 and 0 of 20.
    assert rate(81, 263)["low"] == pytest.approx(0.2553, abs=5e-5)
    assert rate(81, 263)["high"] == pytest.approx(0.3662, abs=5e-5)
    assert rate(0, 20)["low"] == pytest.approx(0.0, abs=1e-12)
    assert rate(0, 20)["high"] == pytest.approx(0.1611, abs=5e-5)


def test_the_interval_of_a_median_is_that_of_order_statistics():
    """For 10 values the 95 % interval is from the 2nd to the 9th (1 - 2 * 11/1024 = 97.9 %)."""
    values = np.random.default_rng(0).permutation(np.arange(1.0, 11.0))
    assert quantile(values, 0.5) == {"value": 5.5, "low": 2.0, "high": 9.0}


def test_too_few_runs_bound_no_p99():
    found = quantile(np.arange(100.0), 0.99)
    assert found["low"] is not None
    assert found["low"] < 99.0
    assert found["high"] is not None
    assert math.isnan(found["high"])
    assert "–" in show({**found, "high": None}, 1.0)


@pytest.mark.parametrize(
    ("estimate", "truth"),
    [
        (mean, 1.0),
        (lambda values: quantile(values, 0.5), math.log(2.0)),
        (lambda values: quantile(values, 0.9), math.log(10.0)),
    ],
    ids=["mean", "median", "p90"],
)
def test_intervals_hold_the_truth_as_often_as_they_say(estimate, truth):
    rng = np.random.default_rng(4)
    held = 0
    for _ in range(120):
        found = estimate(rng.exponential(size=120))
        held += found["low"] <= truth <= found["high"]
    assert stats.binomtest(held, 120, 0.95, alternative="less").pvalue > 0.01


def test_the_mean_agrees_with_students_interval_where_that_holds():
    values = np.random.default_rng(2).normal(3.0, 0.4, 400)
    ours, low_high = mean(values), stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert ours["value"] == pytest.approx(values.mean())
    width = low_high.high - low_high.low
    assert ours["low"] == pytest.approx(low_high.low, abs=0.06 * width)
    assert ours["high"] == pytest.approx(low_high.high, abs=0.06 * width)


def test_the_share_below_a_maximum_is_that_of_the_rule_of_three():
    found = largest(np.arange(300.0))
    assert found["value"] == 299.0
    assert found["share_below"] == pytest.approx(1.0 - 3.0 / 300.0, abs=2e-4)


def test_statistics_of_nothing_of_one_and_of_equals():
    assert statistics([math.nan])["n"] == 0
    assert math.isnan(statistics([])["mean"]["value"])
    assert statistics([2.0])["mean"]["value"] == 2.0
    assert statistics([2.0] * 5)["mean"] == {"value": 2.0, "low": 2.0, "high": 2.0}


def test_people_read_centimetres_and_seconds():
    assert quantity("landing_error_m", [0.1, 0.2]) == ("landing error", "cm", 100.0)
    assert quantity("landing_error_m", [10.0, math.nan]) == ("landing error", "m", 1.0)
    assert quantity("touchdown_speed_m_s", [0.3]) == ("touchdown speed", "m/s", 1.0)
    assert quantity("landing_time_s", []) == ("landing time", "s", 1.0)
    assert quantity("tilt_rad", [1.0])[1] == "deg"
    assert quantity("attempts", [1]) == ("attempts", "", 1.0)


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(
        name="toy",
        description="Landings that nobody flew & <b>nobody</b> saw.",
        scenario="toy",
        seed=3,
        variants={
            "near": Variant(label="Marker", group="Marker", published="infrared-and-marker/10"),
            "far": Variant(label="Normal", group="Normal", published="infrared-and-marker/6"),
        },
        grids={"wind.speed": [0.0, 5.0]},
        measures=Measures(others=["touchdown_speed_m_s"]),
    )


@pytest.fixture(scope="module")
def table(study: Study) -> pd.DataFrame:
    """200 pairs: `far` lies 0.5 m to the east of `near`, one in twenty does not land."""
    rng = np.random.default_rng(7)
    rows = []
    for pair in range(200):
        x, y = rng.normal(0.0, 0.05, 2)
        crashed = pair % 20 == 19
        for place, condition in enumerate(study.conditions):
            east = x + (0.5 if condition.variant == "far" else 0.0)
            row = {
                "run": 4 * pair + place,
                "pair": pair,
                "condition": condition.label,
                "variant": condition.variant,
                "landed": not crashed,
                "landing_error_m": math.hypot(east, y),
                "landing_x_m": east,
                "landing_y_m": y,
                "landing_time_s": 25.0 + 10.0 * x,
                "touchdown_speed_m_s": 0.3,
                "seed": pair,
                "status": "done",
                "failure": "",
            }
            if pair == 5 and place == 2:
                row |= dict.fromkeys(["landed", *study.measures.columns()[1:]], None) | {
                    "status": "failed",
                    "failure": "ArithmeticError: NIS | is nan",
                }
            rows.append(row)
    return pd.DataFrame(rows)


@pytest.fixture(scope="module")
def written(study: Study, table: pd.DataFrame, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("summary")
    write_report(study, table, summarise(study, table, 1000, folder), folder)
    return folder


def test_the_summary_counts_and_measures(study: Study, table: pd.DataFrame, written: Path):
    found = json.loads((written / "summary.json").read_text())
    assert (found["runs"], found["done"], found["errors"]) == (1000, 800, 1)
    assert found["successes"] == 4 * 190 - 1
    near, _, far, _ = found["conditions"]
    assert near["success"]["value"] == 0.95
    landed = table[table.landed.eq(True) & table.condition.eq(near["condition"])]
    error = near["statistics"]["landing_error_m"]
    assert error["n"] == 190
    assert error["mean"]["value"] == pytest.approx(landed.landing_error_m.mean())
    assert error["p95"]["value"] == pytest.approx(np.quantile(landed.landing_error_m, 0.95))
    assert near["cep50"]["value"] == pytest.approx(landed.landing_error_m.median())
    assert (far["runs"], far["errors"], far["statistics"]["landing_error_m"]["n"]) == (200, 1, 189)
    assert near["statistics"]["touchdown_speed_m_s"]["mean"]["low"] == 0.3


def test_pairs_tell_more_than_two_samples(written: Path, table: pd.DataFrame):
    found = json.loads((written / "summary.json").read_text())["paired"]
    same, far, _ = found
    assert same["difference"] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert far["pairs"] == 189
    assert far["difference"]["low"] < far["difference"]["value"] < far["difference"]["high"]
    assert far["difference"]["value"] == pytest.approx(0.44, abs=0.02)
    assert far["closer"]["value"] == 0.0


def test_worst_slowest_and_failed_runs_come_with_their_command(written: Path):
    found = json.loads((written / "summary.json").read_text())
    assert found["failed"][0]["run"] == 22
    assert found["failed"][0]["text"] == "ArithmeticError: NIS | is nan"
    assert found["failed"][0]["command"] == f"plumbline land --from {written}/22"
    assert len(found["worst"]) == len(found["slowest"]) == summary.LISTED
    errors = [row["error"] for row in found["worst"]]
    assert errors == sorted(errors, reverse=True)


def test_published_rows_get_a_verdict(written: Path):
    found = json.loads((written / "summary.json").read_text())["published"]
    assert len(found) == 2 * 4
    error = next(row for row in found if "Marker" in row["condition"])
    assert error["table"] == "Table 10"
    assert error["verdict"].startswith("agrees" if error["agrees"] else "differs")


def test_the_markdown_is_a_page_of_whole_tables(written: Path):
    text = (written / "summary.md").read_text()
    assert "200 more are not flown yet" in text
    widths = [
        line.replace(r"\|", "").count("|") for line in text.splitlines() if line.startswith("|")
    ]
    assert min(widths) > 3
    assert "nan" not in text.replace("is nan", "")


class _Page(HTMLParser):
    void = ("meta", "link", "br", "img", "hr", "input")

    def __init__(self):
        super().__init__()
        self.open, self.outside, self.identifiers, self.text = [], [], [], []

    def handle_starttag(self, tag, attributes):
        if tag not in self.void:
            self.open.append(tag)
        for name, value in attributes:
            if (
                name in ("src", "href", "xlink:href")
                and value
                and not value.startswith(("#", "data:"))
            ):
                self.outside.append(value)
            if name == "id":
                self.identifiers.append(value)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.void:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_the_report_is_one_page_that_needs_nothing_else(written: Path):
    html = (written / "report.html").read_text(encoding="utf-8")
    page = _Page()
    page.feed(html)
    assert page.open == []
    assert page.outside == []
    assert len(page.identifiers) == len(set(page.identifiers))
    text = " ".join(page.text)
    assert "nobody</b>" in text  # escaped, so still there as text
    for heading in ("Landing error", "Touchdown points", "Tails", "Over wind.speed", "Worst"):
        assert heading in text
    assert html.count('role="img"') == 6
    for colour in (figures.INK, figures.SOFT, figures.LINE):
        assert colour not in html.split("</style>", 1)[1], "a colour that ignores the dark"


def test_a_campaign_in_which_nothing_landed_has_a_report(study, table, tmp_path: Path):
    lost = table.assign(landed=False)
    write_report(study, lost, summarise(study, lost, 800, tmp_path), tmp_path)
    assert "0 % [0, 1.88]" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_campaign_of_errors_only_has_a_report(study, table, tmp_path: Path):
    bare = table[["run", "pair", "condition", "variant", "seed"]].assign(
        status="failed", failure="OSError: no"
    )
    write_report(study, bare, summarise(study, bare, 800, tmp_path), tmp_path)
    assert "OSError: no" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_many_points_are_drawn_as_one_image():
    rng = np.random.default_rng(1)
    sizes = []
    for count in (figures.RASTER_LIMIT, 10 * figures.RASTER_LIMIT):
        x, y = rng.normal(size=(2, count))
        with figures.style():
            drawn = figures.figure(3, 3)
            figures.touchdowns(drawn.subplots(), Sample("many", "#123456", x=x, y=y), 5.0, "cm")
            sizes.append(len(figures.to_svg(drawn, "many")))
    assert sizes[1] < 3 * sizes[0]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("landed", [0, 3])
def test_tails_have_a_legend_if_anything_landed(landed: int):
    axes = figures.figure(4.0, 3.0).subplots()
    figures.exceedance(axes, [Sample("a", "#000000", values=np.arange(1.0, landed + 1))], "m")
    assert (axes.get_legend() is not None) == (landed > 0)

"""The search for the mildest spoiled landing, on a landing whose answer is known."""

import itertools
import json

import numpy as np
import pytest

from diagrams.loading import load_scenario, with_overrides
from studies.falsification import Finding, falsify, missed
from studies.sampling import hashed_uniform
from studies.study import StudyError

TOY = "tests.studies.toy_landing:ToyLanding"
SCENARIO = "infrared-and-marker"


def search(folder, vary=("wind", "latency"), budget=200, **options) -> Finding:
    options = {"workers": 0, "progress": False, "experiment": TOY, **options}
    return falsify(SCENARIO, folder, vary, budget, **options)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return search(tmp_path_factory.mktemp("search"))


def mildest_by_brute_force(seeds):
    """Of all cases on a fine grid, by the toy's own rule."""
    lucks = sorted(1.0 + 0.1 * hashed_uniform(seed, "luck") for seed in seeds)
    severities = []
    for wind, latency in itertools.product(np.linspace(0.0, 1.0, 201), repeat=2):
        w = (0.5 + wind * (7.17 - 0.5)) / 7.0
        if lucks[1] * (0.1 + w**2 + w * latency) > 0.5:  # the median: two of three miss
            severities.append(np.hypot(wind, latency))
    return min(severities)


def test_it_finds_the_mildest_case(found):
    best = mildest_by_brute_force(found.seeds)
    assert found.complete
    assert found.best.spoils
    assert found.best.severity >= 0.99 * best
    found_first = found.luckiest or found.best
    assert found_first.severity <= 1.1 * best


def test_it_is_milder_than_any_disturbance_alone(found):
    assert found.alone["wind"].spoils
    assert not found.alone["latency"].spoils
    assert (found.luckiest or found.best).severity < found.alone["wind"].severity


def test_fresh_seeds_confirm_the_case(found):
    assert found.confirmed
    assert len(found.fresh) == 10
    assert found.fresh_missed == sum(missed(row, 0.5) for row in found.fresh) >= 5


def test_the_budget_is_kept(found):
    assert found.asked <= found.budget


def test_the_case_is_a_scenario_that_can_be_flown(found):
    case = load_scenario(found.folder / "case.yaml")
    worst = found.best.worst()
    overrides = found.space.overrides(found.best.point)
    names = {"name": case.name, "description": case.description, "seed": case.seed}
    assert case == with_overrides(load_scenario(SCENARIO), {**overrides, **names})
    assert case.seed == found.seeds[found.best.rows.index(worst)]
    text = (found.folder / "case.yaml").read_text()
    assert f"extends: {SCENARIO}" in text
    assert f"{found.fresh_missed} of 10" in text


def test_the_report_says_what_was_found(found):
    for name in ("report.md", "report.html"):
        text = (found.folder / name).read_text()
        assert found.sentence() in text
        assert "plumbline land" in text
    finding = json.loads((found.folder / "finding.json").read_text())
    assert finding["severity"] == found.best.severity
    assert finding["values"] == found.space.values(found.best.point)
    assert (found.folder / "history.svg").is_file()


def test_what_does_nothing_is_left_out(tmp_path):
    finding = search(tmp_path, ("wind", "turbulence", "start"), 150)
    assert list(finding.space.values(finding.best.point)) == ["wind", "wind direction"]


def test_one_disturbance_without_circumstances_is_bisected(tmp_path):
    finding = search(tmp_path, ("drops",), 60)
    assert finding.space.values(finding.best.point)["drops"] == pytest.approx(0.8, abs=0.03)
    assert finding.best.worst()["landed"] is False


def test_two_processes_find_the_same(found, tmp_path):
    again = search(tmp_path, workers=2)
    assert (tmp_path / "case.yaml").read_bytes() == (found.folder / "case.yaml").read_bytes()
    assert [case.severity for case in again.cases] == [case.severity for case in found.cases]


def test_a_search_that_was_killed_goes_on(found, tmp_path):
    lines = (found.folder / "flights.jsonl").read_bytes().splitlines(keepends=True)
    half = len(lines) // 2
    (tmp_path / "flights.jsonl").write_bytes(b"".join(lines[:half]) + lines[half][:20])
    search(tmp_path)
    again = (tmp_path / "flights.jsonl").read_bytes().splitlines(keepends=True)
    assert again[:half] == lines[:half]
    assert [json.loads(line).get("flight") for line in again] == [
        json.loads(line).get("flight") for line in lines
    ]
    assert (tmp_path / "case.yaml").read_bytes() == (found.folder / "case.yaml").read_bytes()


def test_ctrl_c_leaves_the_best_case_so_far(tmp_path):
    impatient = "tests.studies.toy_landing:Impatient"
    first = search(tmp_path, experiment=impatient)
    assert first.interrupted
    assert not first.complete
    assert 40 <= first.asked < 100  # the chunk in the air is brought home
    assert first.best.spoils
    assert (tmp_path / "case.yaml").is_file()
    assert "goes on where it stopped" in (tmp_path / "report.md").read_text()
    assert search(tmp_path, experiment=impatient).complete


def test_where_nothing_spoils_it_says_what_was_searched(tmp_path):
    finding = search(tmp_path, ("latency", "turbulence"), 60)
    assert finding.best is None
    assert "no case that misses by more than 0.5 m" in finding.sentence()
    assert "latency, turbulence" in finding.sentence()
    assert not (tmp_path / "case.yaml").exists()
    assert "0 to 0.25 s" in (tmp_path / "report.md").read_text()


def test_a_landing_that_misses_undisturbed_is_said_so(tmp_path):
    finding = search(tmp_path, overrides={"wind.speed": 6.0})
    assert finding.best is None
    assert "misses undisturbed" in finding.sentence()


def test_a_flight_that_fails_is_no_find_but_reported(tmp_path):
    finding = search(
        tmp_path, ("wind",), 60, miss=5.0, experiment="tests.studies.toy_landing:Broken"
    )
    assert finding.best is None
    assert "the filter diverged" in (tmp_path / "report.md").read_text()


def test_other_flights_in_the_folder_are_refused(found):
    with pytest.raises(StudyError, match="begun with another scenario"):
        falsify("marker-landing", found.folder, ("wind",), 60, workers=0, experiment=TOY)


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"budget": 5}, "budget"),
        ({"miss": 0.0}, "miss"),
        ({"experiment": "tests.studies.toy_landing:Grounded"}, "undisturbed: failed: .*no hands"),
    ],
)
def test_impossible_searches_are_refused(options, part, tmp_path):
    with pytest.raises(StudyError, match=part):
        search(tmp_path, **options)


def test_a_scenario_of_ones_own_is_extended_from_where_it_is(tmp_path):
    own = tmp_path / "mine" / "own.yaml"
    own.parent.mkdir()
    own.write_text("extends: marker-landing\nname: own\npad: { side: 3.0 }\n")
    options = {"workers": 0, "progress": False, "experiment": TOY}
    finding = falsify(str(own), tmp_path / "out", ("wind",), 60, **options)
    assert finding.best is not None
    case = load_scenario(tmp_path / "out" / "case.yaml")
    assert "extends: ../mine/own.yaml" in (tmp_path / "out" / "case.yaml").read_text()
    assert case.pad.side == 3.0
    assert case.name == "own-spoiled"

"""`plumbline falsify` and `plumbline sensitivity` as a user meets them."""

import pytest
from click.testing import CliRunner

from diagrams.loading import load_scenario
from plumbline.command_line import cli
from studies import falsification, sensitivity
from studies.disturbances import DISTURBANCES

TOY = "tests.studies.toy_landing:ToyLanding"


def invoke(*arguments):
    return CliRunner().invoke(cli, list(arguments))


@pytest.fixture
def toy(monkeypatch):
    """Searches fly the toy, so that they cost nothing."""
    for module, name in ((falsification, "falsify"), (sensitivity, "analyse")):
        search = getattr(module, name)

        def with_toy(*arguments, search=search, **options):
            return search(*arguments, **options, experiment=TOY)

        monkeypatch.setattr(module, name, with_toy)


def test_falsify_writes_a_case(toy, tmp_path):
    result = invoke(
        "falsify", "infrared-and-marker", "--vary", "wind,latency", "--budget", "120",
        "--workers", "0", "--out", str(tmp_path), "--set", "pad.side=2.0",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "infrared-and-marker is spoiled by wind" in result.output
    assert f"plumbline land {tmp_path / 'case.yaml'}" in result.output
    case = load_scenario(tmp_path / "case.yaml")
    assert case.pad.side == 2.0
    assert case.fidelity == "geometric"  # as flown; the scenario itself is in pixels


def test_sensitivity_ranks(toy, tmp_path):
    result = invoke(
        "sensitivity", "marker-landing", "--vary", "wind,latency", "--runs", "60",
        "--workers", "0", "--out", str(tmp_path),
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "Landing error: most by wind" in result.output
    assert (tmp_path / "sensitivity.csv").is_file()


@pytest.mark.parametrize("command", ["falsify", "sensitivity"])
def test_the_disturbances_are_listed(command):
    result = invoke(command, "--list")
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.output.splitlines()] == list(DISTURBANCES)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["falsify", "marker-landng"], ["nearest is marker-landing"]),
        (["falsify", "--vary", "wind,latncy"], ["latncy", "nearest is latency"]),
        (["falsify", "--limit", "wind=strong"], ["--limit wind=strong", "wind=10"]),
        (["falsify", "--limit", "heave=1"], ["heave", "not among what is varied"]),
        (["falsify", "--budget", "3"], ["--budget 3"]),
        (["falsify", "--set", "wind.sped=1"], ["wind.sped", "nearest is speed"]),
        (["falsify", "landing-without-gps"], ["multirotor_landing"]),
        (["sensitivity", "--runs", "3"], ["--runs 3", "or more"]),
        (["sensitivity", "--vary", ""], ["--vary", "expected one or more"]),
    ],
)
def test_wrong_input_is_one_sentence_and_ends_with_2(arguments, parts, tmp_path):
    result = invoke(*arguments, "--out", str(tmp_path), "--workers", "0")
    assert result.exit_code == 2, result.output
    sentence = result.output.strip()
    assert sentence.startswith("plumbline: ")
    assert "\n" not in sentence
    for part in parts:
        assert part in sentence

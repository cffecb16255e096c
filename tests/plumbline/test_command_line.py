"""The `plumbline` command as a user meets it."""

import json
import os
import shutil

import pytest
from click.testing import CliRunner
from pyulog import ULog

from diagrams.loading import scenario_names
from plumbline.command_line import cli
from runs.logs import read_log

FAST = ["--fidelity", "geometric", "--seed", "5"]


def invoke(*arguments):
    # Standard error is part of `output`; a traceback would be in `exception`.
    return CliRunner().invoke(cli, list(arguments))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return invoke("land", "infrared-and-marker", *FAST, "--out", str(folder), "--no-report"), folder


def test_land_says_three_lines_and_ends_with_0(flown):
    result, _ = flown
    assert result.exit_code == 0, result.output
    lines = result.output.strip().splitlines()[-3:]
    assert lines[0] == "Landed: landed"
    assert lines[1].startswith("Landing error")
    assert "run.json" in lines[2]


def test_run_json_has_what_it_promises(flown):
    _, folder = flown
    run = json.loads((folder / "run.json").read_text())
    assert run["scenario"] == "infrared-and-marker"
    assert run["seed"] == 5
    assert run["landed"] is True
    assert run["attempts"] == 1
    assert len(run["landing_offset_m"]) == 2
    x, y = run["landing_offset_m"]
    assert run["landing_error_m"] == pytest.approx((x * x + y * y) ** 0.5)
    assert 0.0 < run["landing_time_s"] < run["simulated_s"]
    assert run["cpu_s"] > 0.0
    assert 0.0 < run["touchdown_speed_m_s"] < 0.7
    assert run["reason"] == "landed"
    assert "drake" in run["versions"]


def test_the_log_is_there_in_both_formats(flown):
    _, folder = flown
    table = read_log(folder / "log.parquet")
    assert {"time", "body.p_WB_z", "estimate.v_WB_x", "marker.range"} <= set(table.column_names)
    log = ULog(str(folder / "log.ulg"))
    names = {data.name for data in log.data_list}
    assert {"vehicle_local_position", "vehicle_attitude", "sensor_gps", "distance_sensor"} <= names
    position = log.get_dataset("vehicle_local_position_groundtruth").data
    assert position["z"].min() == pytest.approx(-table["body.p_WB_z"].to_pandas().max(), rel=1e-6)


def test_not_landed_ends_with_1(tmp_path):
    result = invoke(
        "land", *FAST, "--set", "time_limit=3", "--out", str(tmp_path), "--no-report"
    )  # fmt: skip
    assert result.exit_code == 1
    assert "Not landed: time limit" in result.output


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["land", "infrared-and-markr"], ["nearest is infrared-and-marker"]),
        (["land", "--set", "wind.sped=1"], ["wind.sped", "nearest is speed"]),
        (["land", "--set", "wind"], ["expected FIELD.PATH=VALUE"]),
        (["land", "--set", "control.vehicle=iris"], ["control.vehicle", "leave", "out"]),
        (["graph", "--out", "wiring.pdf"], ["dot, svg, png"]),
        (["study", "infrared-and-markr"], ["infrared-and-marker"]),
        (["study"], ["expected the NAME of a study"]),
        (["study", "infrared-and-marker", "--quick"], ["infrared-and-marker", "no quick look"]),
        (["study", "resume", "nowhere"], ["nowhere"]),
        (["land", "--from", "nowhere/3"], ["nowhere"]),
    ],
)
def test_wrong_input_is_one_sentence_and_ends_with_2(arguments, parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    sentence = result.output.strip()
    assert sentence.startswith("plumbline: ")
    assert "\n" not in sentence
    for part in parts:
        assert part in sentence


def test_unknown_option_ends_with_2():
    assert invoke("land", "--sed", "4").exit_code == 2


def test_out_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("kept")
    result = invoke("land", "--out", str(tmp_path / "file"))
    assert result.exit_code == 2
    assert "cannot be written" in result.output
    assert (tmp_path / "file").read_text() == "kept"


def test_scenarios_lists_all():
    result = invoke("scenarios")
    assert result.exit_code == 0
    for name in scenario_names():
        assert name in result.output


def test_scenarios_prints_one_with_every_field():
    result = invoke("scenarios", "infrared-and-marker")
    assert result.exit_code == 0
    assert "MPC_XY_P: 1.0" in result.output


@pytest.mark.parametrize("suffix", ["dot", "svg", "png"])
@pytest.mark.parametrize("what", [["--depth", "1"], ["--states"]])
def test_graph(suffix, what, tmp_path):
    if suffix != "dot" and shutil.which("dot") is None:
        pytest.skip("Graphviz's dot is not installed")
    out = tmp_path / f"graph.{suffix}"
    result = invoke("graph", *what, "--out", str(out))
    assert result.exit_code == 0, result.output
    assert out.stat().st_size > 1000
    if suffix == "dot":
        text = out.read_text()
        assert "digraph" in text
        assert ("descend" if what == ["--states"] else "guidance") in text


def test_the_command_is_installed():
    assert shutil.which("plumbline", path=os.path.dirname(os.sys.executable))

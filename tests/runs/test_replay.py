"""Replays against PX4's own answers and on-board estimates, and the command."""

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from pyulog import ULog

from plumbline.command_line import cli
from runs.log_sources import read_log
from runs.replay import (
    AID_COLUMNS,
    DELAYED_COLUMNS,
    OUTPUT_COLUMNS,
    parameter_values,
    play,
    play_in_pieces,
)
from runs.replay import parameter_array as array_of
from runs.replay_diagnosis import diagnosis, horizon
from runs.replay_sweep import parse_sweep, sweep
from runs.replay_tables import against_on_board
from systems.estimators.ekf2 import layout as at
from tests.runs.damage import csv_stream
from tests.shared_data import shared

FLIGHT = {
    "EKF2_MAG_DECL": 3.40560555,
    "EKF2_DELAY_MAX": 300,
    "EKF2_EV_CTRL": 3,
    "EKF2_EV_DELAY": 200,
    "EKF2_EVP_GATE": 5,
}
VISION_ONLY = FLIGHT | {"EKF2_GPS_CTRL": 0}
# Stream, input, defaults, parameters, tolerances (quaternion, velocity, north/east, down), from.
CASES = [
    ("gps_and_vision", "flight", "module", FLIGHT, (5e-5, 1e-3, 5e-4, 5e-3), 0.0),
    ("vision_only", "flight", "module", VISION_ONLY, (5e-5, 1e-3, 5e-4, 5e-3), 0.0),
    (
        "iris_gps",
        "iris_gps",
        "unit-test",
        {"EKF2_DELAY_MAX": 110, "EKF2_GPS_CTRL": 5},
        (3e-4, 3e-3, 3e-3, 3e-3),
        7.2e6,
    ),
]


def stream(name):
    return pd.read_csv(shared(f"data/px4-ekf2/{name}.csv.gz"))


def flight():
    return read_log(shared("data/px4-ekf2/flight_input.csv.gz"))


def assert_aid_values(both):
    """Observations, innovations and their variances, NaN included, and PX4's times."""
    for column, tolerance in (("observation", 1e-3), ("innov", 1e-3), ("innov_var", 1e-6)):
        theirs, own = both[f"{column}_x"].to_numpy(), both[f"{column}_y"].to_numpy()
        close = np.abs(theirs - own) <= tolerance + 2e-3 * np.abs(theirs)
        np.testing.assert_array_equal(np.isnan(theirs), np.isnan(own))
        assert (close | np.isnan(own)).all(), column
    for column in ("timestamp_sample_us", "t_delayed_us", "time_last_fuse_us"):
        np.testing.assert_array_equal(both[f"{column}_x"], both[f"{column}_y"])


@pytest.mark.parametrize("case", CASES, ids=[case[0] for case in CASES])
def test_answers_are_those_of_px4(case):
    name, source, defaults, values, tolerances, first = case
    log = read_log(shared(f"data/px4-ekf2/{source}_input.csv.gz"))
    replay = play(log.samples, array_of(log, values, defaults))

    golden = stream(f"{name}_delayed")
    assert tuple(golden.columns) == DELAYED_COLUMNS
    golden = golden[golden.t_arrival_us >= first]
    ours = pd.DataFrame(replay.delayed, columns=DELAYED_COLUMNS).set_index("t_arrival_us")
    ours = ours.loc[golden.t_arrival_us].reset_index()
    golden = golden.reset_index(drop=True)
    groups = (["q0", "q1", "q2", "q3"], ["vn", "ve", "vd"], ["pn", "pe"], ["pd"])
    for columns, tolerance in zip(groups, tolerances, strict=True):
        assert np.abs(golden[columns] - ours[columns]).to_numpy().max() < tolerance
    assert np.abs(golden[["gbx", "gby", "gbz"]] - ours[["gbx", "gby", "gbz"]]).max().max() < 1e-5
    assert np.abs(golden[["abx", "aby", "abz"]] - ours[["abx", "aby", "abz"]]).max().max() < 2e-4
    variances = [f"P{i}" for i in range(at.ERRORS)]
    assert np.abs(ours[variances] / golden[variances] - 1.0).max().max() < 0.02
    biases = ["baro_bias", "gps_hgt_bias", "ev_hgt_bias", "ev_pos_bias_n", "ev_pos_bias_e"]
    assert np.abs(golden[biases] - ours[biases]).max().max() < 5e-3
    for column in ("control_status", "fault_status", "height_ref", "hpos_valid", "rst_posNE"):
        np.testing.assert_array_equal(golden[column], ours[column])

    events = stream(f"{name}_events")
    assert [tuple(event) for event in events.to_numpy()] == replay.events()

    aid = stream(f"{name}_aid")
    assert len(aid) == len(replay.aid)
    ours = pd.DataFrame(replay.aid, columns=AID_COLUMNS)
    ours["source"] = [at.AID_NAMES[int(i)] for i in ours.source]
    both = aid.merge(ours, on=["t_arrival_us", "source", "axis"], validate="one_to_one")
    assert len(both) == len(aid)
    assert_aid_values(both[both.t_arrival_us >= first])
    np.testing.assert_array_equal(both.fused_x, both.fused_y)
    np.testing.assert_array_equal(both.innov_rejected_x, both.innov_rejected_y)

    output = stream(f"{name}_output")
    output = output[output.t_us >= first]
    ours = pd.DataFrame(replay.output, columns=OUTPUT_COLUMNS).set_index("t_us").loc[output.t_us]
    assert list(output.columns[1:]) == list(ours.columns[:16])
    for columns, tolerance in zip(groups, tolerances, strict=True):
        error = np.abs(output[columns].to_numpy() - ours[columns].to_numpy())
        assert error.max() < tolerance


@pytest.mark.parametrize(
    ("name", "first", "last", "limits"),
    [
        ("outdoor_gps_quad", 10.0, 60.0, (2.0, 0.3, 0.5)),
        ("indoor_vision_no_gps", 10.0, 60.0, (2.0, 0.3, 0.5)),
        ("indoor_vision_no_gps", 5.0, 60.0, (0.2, 0.02, 0.05)),
        ("sitl_takeoff_return_land", 10.0, 30.0, (1.0, 0.05, 0.05)),
    ],
)
def test_is_close_to_the_on_board_estimate(name, first, last, limits):
    log = read_log(shared(f"data/ulg/{name}.ulg"))
    replay = play(log.samples, array_of(log, parameter_values(log)), log.start)
    errors = against_on_board(replay, log)
    for quantity, limit in zip(("attitude", "velocity", "position"), limits, strict=True):
        time, error = errors[quantity]
        time = time - replay.output[0, 0] * 1e-6
        error = error[(time > first) & (time < last)]
        if quantity == "position":
            error = error[:, :2]  # horizontal
        assert len(error) > 100
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < limit, quantity


def test_starts_where_the_filter_on_board_was():
    log = read_log(shared("data/ulg/outdoor_gps_quad.ulg"))
    replay = play(log.samples, array_of(log, parameter_values(log)), log.start)
    delayed = pd.DataFrame(replay.delayed[:1], columns=DELAYED_COLUMNS).iloc[0]
    assert delayed.t_delayed_us - log.start.time < 10e3
    # at rest, so that a part of a filter step changes nothing
    np.testing.assert_allclose(delayed["q0":"q3"].astype(float), log.start.nominal[:4], atol=1e-4)
    np.testing.assert_allclose(delayed["gbx":"mbz"].astype(float), log.start.nominal[10:22])
    np.testing.assert_allclose(delayed["P9":"P20"].astype(float), log.start.variances[9:21])
    assert delayed.lat_deg == pytest.approx(log.start.place[0], abs=1e-8)
    for flag in ("yaw_align", "gnss_pos", "gps_hgt", "mag_hdg"):
        assert replay.flag(flag)[0]
    # no reset, and nothing that was in use is dropped, before the vehicle crashes at 67 s
    early = [event for event in replay.events() if event[0] - replay.output[0, 0] < 60e6]
    assert [event[2:] for event in early] == [
        ("in_air", 1), ("mag_aligned_in_flight", 1), ("mag_hdg", 0), ("mag_3D", 1),
    ]  # fmt: skip


def test_log_that_begins_with_its_filter_starts_cold():
    assert read_log(shared("data/ulg/sitl_takeoff_return_land.ulg")).start is None


def test_pieces_are_the_whole():
    log = flight()
    p = array_of(log, FLIGHT)
    whole = play(log.samples, p)
    pieces = list(play_in_pieces(log.samples, p, [5e6, 5.1e6, 41e6]))
    assert len(pieces) == 4
    for name in ("delayed", "output", "aid"):
        joined = np.concatenate([getattr(piece, name) for piece in pieces])
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_tells_that_vision_is_too_late():
    log = flight()
    p = array_of(log, FLIGHT | {"EKF2_DELAY_MAX": 200})
    replay = play(log.samples, p)
    assert horizon(replay) == pytest.approx(152.0)
    (late,) = [s for s in diagnosis(log, replay, p) if s.startswith("Vision")]
    assert "204 ms old" in late
    assert "your horizon is 152 ms: every sample is fused late" in late
    advised = int(late.split("EKF2_DELAY_MAX to ")[1].rstrip("."))
    p = array_of(log, FLIGHT | {"EKF2_DELAY_MAX": advised})
    replay = play(log.samples, p)
    assert not [s for s in diagnosis(log, replay, p) if s.startswith("Vision")]
    assert horizon(replay) > 204.0


def test_sweep_finds_the_delay():
    values = VISION_ONLY | {"EKF2_DELAY_MAX": 400}
    name, tried = parse_sweep("EKF2_EV_DELAY=100:300:20")
    found = sweep(flight(), values, "module", name, tried, workers=2)
    assert found.best.value == 200.0
    assert found.interval[0] >= 160.0
    assert found.interval[1] <= 240.0


def invoke(*arguments):
    return CliRunner().invoke(cli, ["replay", *map(str, arguments)])


@pytest.fixture
def at_rest(tmp_path):
    path = tmp_path / "rest.csv"
    path.write_bytes(csv_stream())
    return path


def test_command_writes_its_folder(at_rest, tmp_path):
    result = invoke(at_rest, "--out", tmp_path / "out", "--param", "EKF2_EV_CTRL=3")
    assert result.exit_code == 0, result.output
    folder = tmp_path / "out"
    delayed = pd.read_csv(folder / "delayed.csv")
    assert tuple(delayed.columns) == DELAYED_COLUMNS
    assert tuple(pd.read_csv(folder / "aid.csv").columns) == AID_COLUMNS
    assert len(pd.read_csv(folder / "output.csv")) == 499
    assert set(pd.read_csv(folder / "events.csv").event) >= {"tilt_align", "in_air"}
    topics = {dataset.name for dataset in ULog(str(folder / "log.ulg")).data_list}
    assert {"vehicle_attitude", "estimator_states", "estimator_aid_src_baro_hgt"} <= topics
    page = (folder / "report.html").read_text()
    assert "Innovation of baro_hgt" in page
    assert "http-equiv" not in page
    assert '<script src="http' not in page


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--param", "EKF2_EV_DELY=5"], "did you mean EKF2_EV_DELAY?"),
        (["--param", "EKF2_EV_DELAY"], "expected NAME=VALUE"),
        (["--params", "/nowhere.params"], "/nowhere.params: cannot be read"),
        (["--sweep", "EKF2_EV_DELAY=1:2"], "expected NAME=FIRST:LAST:STEP"),
        (["--sweep", "EKF2_EV_DELAY=0:1e9:1"], "expected 1 to 10000 values"),
        (["--param", "EKF2_DELAY_MAX=5000"], "EKF2_DELAY_MAX"),
    ],
)
def test_command_refuses_in_one_sentence(at_rest, tmp_path, arguments, part):
    result = invoke(at_rest, "--out", tmp_path / "out", *arguments)
    assert result.exit_code == 2
    assert part in result.output
    assert result.output.strip().count("\n") == 0

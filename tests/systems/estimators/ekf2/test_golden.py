"""The filter's answers against those of PX4's C++ EKF2, on every row of the reference streams."""

import functools

import numpy as np
import pandas as pd
import pytest

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from tests.systems.estimators.ekf2.streams import (
    Replay,
    flight_parameters,
    replay,
    samples,
    table,
)

# Column groups of the delayed state, where they stand, and the bound on `flight`, on `iris`.
STATES = (
    (["q0", "q1", "q2", "q3"], at.QUATERNION, 5e-5, 3e-4),
    (["vn", "ve", "vd"], at.VELOCITY, 1e-3, 3e-3),
    (["pn", "pe"], at.POSITION, 5e-4, 3e-3),
    (["pd"], at.POSITION + 2, 5e-3, 3e-3),
    (["gbx", "gby", "gbz"], at.GYRO_BIAS, 1e-5, 1e-5),
    (["abx", "aby", "abz"], at.ACCEL_BIAS, 2e-4, 2e-4),
    (["magn", "mage", "magd"], at.MAG_EARTH, 1e-4, 1e-4),
    (["mbx", "mby", "mbz"], at.MAG_BODY, 1e-4, 1e-4),
)
OUTPUTS = (
    (["q0", "q1", "q2", "q3"], at.OUT_QUATERNION, 5e-5, 3e-4),
    (["vn", "ve", "vd"], at.OUT_VELOCITY, 1e-3, 3e-3),
    (["trk_ang"], at.OUT_TRACKING_ERROR, 5e-5, 5e-5),
    (["trk_vel"], at.OUT_TRACKING_ERROR + 1, 1e-3, 1e-3),
    (["trk_pos"], at.OUT_TRACKING_ERROR + 2, 5e-3, 5e-3),
    (["vert_pos_deriv"], at.OUT_VERTICAL + 1, 1e-3, 3e-3),
    (["unaided_yaw"], at.OUT_UNAIDED_YAW, 5e-5, 5e-5),
)
# deg, deg, gauss: PX4's table of the world magnetic model at the (swapped) origin of iris_gps
IRIS_FIELD = (0.5808, 4.0330, 0.36880)
IRIS_ALIGNED = 7_200_000  # us; before it one step of slip at the alignments is normal
AID_COLUMNS = (
    "t_arrival_us",
    "source",
    "axis",
    "stamp",
    "innov_us",
    "var_us",
    "ratio",
    "rejected",
    "fused_us",
    "last",
)
RUNS = ("gps_and_vision", "vision_only", "iris_gps")


@functools.cache
def answers(run: str) -> Replay:
    if run == "iris_gps":
        values = {"EKF2_DELAY_MAX": 110, "EKF2_GPS_CTRL": 5}
        p = prm.parameter_array(values, "unit-test", earth_field=IRIS_FIELD)
        return replay(samples("iris_gps"), p)
    p = flight_parameters(**({} if run == "gps_and_vision" else {"EKF2_GPS_CTRL": 0}))
    return replay(samples("flight"), p)


def golden(run: str, kind: str, time: str) -> pd.DataFrame:
    frame = table(f"{run}_{kind}")
    return frame[frame[time] >= IRIS_ALIGNED] if run == "iris_gps" else frame


def difference(frame: pd.DataFrame, columns: list[str], rows: np.ndarray, start: int) -> np.ndarray:
    """Largest difference a row between columns of a golden table and entries of the array."""
    ours, theirs = rows[:, start : start + len(columns)], frame[columns].to_numpy()
    if columns == ["q0", "q1", "q2", "q3"]:
        theirs = theirs * np.sign((ours * theirs).sum(axis=1, keepdims=True))
    return np.abs(ours - theirs).max(axis=1)


@pytest.mark.parametrize("run", RUNS)
def test_states_and_variances_at_the_delayed_horizon(run):
    frame = golden(run, "delayed", "t_arrival_us")
    steps = answers(run).steps
    rows = np.array([steps[t] for t in frame.t_arrival_us])
    assert len(rows) > 1300
    assert np.array_equal(rows[:, at.TIME_DELAYED], frame.t_delayed_us)
    for columns, start, flight, iris in STATES:
        bound = iris if run == "iris_gps" else flight
        assert difference(frame, columns, rows, start).max() < bound, columns
    diagonal = at.COVARIANCE + np.arange(at.ERRORS) * (at.ERRORS + 1)
    variances = frame[[f"P{i}" for i in range(at.ERRORS)]].to_numpy()
    assert (np.abs(rows[:, diagonal] / variances - 1.0)).max() < 0.02


@pytest.mark.parametrize("run", RUNS)
def test_every_flag_reset_and_reference(run):
    frame = golden(run, "delayed", "t_arrival_us")
    rows = np.array([answers(run).steps[t] for t in frame.t_arrival_us])
    weights = 1 << np.arange(at.FLAG_COUNT, dtype=np.int64)
    status = rows[:, at.FLAGS : at.FLAGS + at.FLAG_COUNT].astype(np.int64) @ weights
    assert np.array_equal(status, frame.control_status)
    assert np.array_equal(rows[:, at.HEIGHT_REFERENCE], frame.height_ref)
    assert np.array_equal(1 - rows[:, at.HORIZONTAL_EXCEEDED], frame.hpos_valid)
    counters = ["rst_velNE", "rst_velD", "rst_posNE", "rst_posD", "rst_quat"]
    for number, column in enumerate(counters):
        assert np.array_equal(rows[:, at.RESET_COUNTS + number], frame[column]), column


@pytest.mark.parametrize("run", RUNS)
def test_every_event_in_its_step(run):
    flags = dict(zip(at.FLAG_NAMES, range(at.FLAGS, at.FLAGS + at.FLAG_COUNT), strict=True))
    flags |= {"height_ref": at.HEIGHT_REFERENCE}
    names = ("rst_velNE", "rst_velD", "rst_posNE", "rst_posD", "rst_quat")
    flags |= dict(zip(names, range(at.RESET_COUNTS, at.RESET_COUNTS + 5), strict=True))
    steps = answers(run).steps
    times = sorted(steps)
    frame = golden(run, "events", "t_arrival_us")
    frame = frame[frame.event.isin(flags)]
    assert len(frame) >= 9
    for event in frame.itertuples():
        index = times.index(event.t_arrival_us)
        now, before = steps[times[index]], steps[times[index - 1]]
        assert now[flags[event.event]] == event.value, event
        assert before[flags[event.event]] != event.value, event


@pytest.mark.parametrize("run", RUNS)
def test_every_fused_and_rejected_observation(run):
    ours = pd.DataFrame(answers(run).aids, columns=list(AID_COLUMNS))
    theirs = golden(run, "aid", "t_arrival_us")
    if run == "iris_gps":
        ours = ours[ours.t_arrival_us >= IRIS_ALIGNED]
    both = theirs.merge(ours, on=["t_arrival_us", "source", "axis"], how="outer", indicator=True)
    assert (both._merge == "both").all()
    assert np.array_equal(both.timestamp_sample_us, both.stamp)
    assert np.array_equal(both.fused, both.fused_us)
    assert np.array_equal(both.innov_rejected, both.rejected)
    assert np.array_equal(both.time_last_fuse_us, both["last"])
    fused = both[both.fused == 1]
    assert np.allclose(fused.innov_var, fused.var_us, rtol=0.02)
    assert (np.abs(fused.innov - fused.innov_us) < 5e-3).all()


@pytest.mark.parametrize("run", RUNS)
def test_output_predictor(run):
    frame = golden(run, "output", "t_us")
    rows = np.array([answers(run).outputs[t] for t in frame.t_us])
    assert len(rows) > 500
    for columns, start, flight, iris in OUTPUTS:
        bound = iris if run == "iris_gps" else flight
        assert difference(frame, columns, rows, start).max() < bound, columns

"""Reading logs: what is in them, and what damaged ones end in."""

import gzip

import numpy as np
import pytest

from runs.flight_log import ReplayError
from runs.log_sources import read_log
from runs.replay import parameter_array, parameter_values, play
from systems.signals import sensor_log as logs
from tests.runs.damage import csv_stream, damaged, outcome, ulog_stream
from tests.shared_data import shared

CSV, ULOG = csv_stream(), ulog_stream()


@pytest.mark.parametrize("data", [CSV, gzip.compress(CSV), ULOG], ids=["csv", "gzip", "ulog"])
def test_reads_every_format(tmp_path, data):
    path = tmp_path / "log"
    path.write_bytes(data)
    samples = read_log(path).samples
    assert np.count_nonzero(samples.kinds == logs.IMU) in (499, 500)
    _, gnss = samples.of(logs.GNSS)
    assert len(gnss) in (9, 10)
    origin = samples.origin()
    assert origin is not None
    np.testing.assert_allclose(origin, np.array([47.4, 8.5, 500.0]))
    assert (np.diff(samples.arrivals) >= 0.0).all()
    _, imu = samples.of(logs.IMU)
    np.testing.assert_allclose(imu[:, 6], -0.0392, rtol=1e-3)


def test_columns_are_found_by_name(tmp_path):
    rows = [line.split(",") for line in CSV.decode().splitlines()]
    path = tmp_path / "log.csv"
    path.write_bytes(CSV)
    expected = read_log(path).samples
    path.write_text("\n".join(",".join(reversed(row)) for row in rows))
    np.testing.assert_array_equal(read_log(path).samples.rows, expected.rows)


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("imu,1016000,0.0", "imu,1016000,nan", ("line", "v0", "finite number", "nan")),
        ("imu,1016000,0.0", "imu,1016000,zero", ("line", "v0", "a number", "'zero'")),
        ("imu,1016000,0.0", "imu,1016000,5.0", ("line", "turn rate")),
        ("\n1016000,imu,1016000", "\n1001000,imu,1016000", ("line", "before its predecessor")),
        ("\n1016000,imu,1016000", "\n1016000,gyro,1016000", ("line", "imu, mag, baro", "'gyro'")),
        ("\n1016000,imu,1016000,", "\n1016000,imu,1016000,0.0,", ("line", "15 columns", "16")),
        ("baro,1040000,500.0", "baro,1040000,5e9", ("line", "barometer", "altitude", "5e+09")),
        ("imu,1016000", "imu,9016000", ("line", "time stamp")),
        ("0.004,0.004", "0.04,0.04", ("line 2", "integrate over 40 ms")),
        ("0.004,0.004", "4.0,4.0", ("time steps", "not [4. 4.] s")),
        ("-0.0392266", "-0.00392266", ("accelerometer", "0.981", "gravity")),
        ("t_stamp_us", "stamp", ("line 1", "t_stamp_us is missing")),
    ],
)
def test_says_what_is_wrong(tmp_path, old, new, parts):
    path = tmp_path / "log.csv"
    path.write_text(CSV.decode().replace(old, new))
    with pytest.raises(ReplayError) as error:
        read_log(path)
    sentence = str(error.value)
    assert sentence.startswith(str(path))
    for part in parts:
        if part != "line 2":
            assert part in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"", "t_arrival_us is missing"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "neither a ULog nor a CSV"),
        (gzip.compress(CSV)[:500], "damaged or cut"),
        (ULOG[:10], "damaged"),
        (CSV.split(b"\n")[0], "no samples"),
        (CSV[:190], "line 3"),
    ],
)
def test_refuses_what_is_no_log(tmp_path, data, part):
    assert part in outcome(data, tmp_path / "log")


def test_refuses_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ReplayError, match="cannot be read: No such file"):
        read_log(tmp_path / "none.ulg")


@pytest.mark.parametrize("data", [CSV, ULOG], ids=["csv", "ulog"])
def test_damage_ends_in_a_log_or_one_sentence(tmp_path, data):
    sentences = [outcome(damaged(data, seed), tmp_path / "log") for seed in range(200)]
    assert all("\n" not in sentence for sentence in sentences)
    assert sum(sentence != "" for sentence in sentences) > 20


@pytest.mark.parametrize(
    ("name", "rate", "has_vision"),
    [("outdoor_gps_quad", 199, False), ("indoor_vision_no_gps", 198, True),
     ("sitl_takeoff_return_land", 250, False)],
)  # fmt: skip
def test_reads_real_flights(name, rate, has_vision):
    log = read_log(shared(f"data/ulg/{name}.ulg"))
    arrivals, _ = log.samples.of(logs.IMU)
    assert (len(arrivals) - 1) / np.ptp(arrivals) * 1e6 == pytest.approx(rate, rel=0.01)
    assert log.parameters["EKF2_ACC_NOISE"] == pytest.approx(0.35)
    assert log.on_board is not None
    assert (logs.EXTERNAL_VISION in log.samples.kinds) == has_vision


def test_start_on_board_is_read(tmp_path):
    path = tmp_path / "log.ulg"
    path.write_bytes(ULOG)
    start = read_log(path).start
    assert start.time == 1_050_000.0
    np.testing.assert_allclose(start.place, [47.4, 8.5, 500.0])
    np.testing.assert_allclose(start.origin, [47.4, 8.5, 500.0])
    assert set(start.flags) == {"tilt_align", "yaw_align", "baro_hgt", "mag"}
    np.testing.assert_allclose(start.biases[0], [0.0, 0.1])
    assert np.isnan(start.biases[1:]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, 0.0, 1e4, 1e30])
@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("estimator_states", "states"),
        ("estimator_states", "covariances"),
        ("estimator_baro_bias", "bias_var"),
        ("vehicle_local_position", "ref_lat"),
        ("vehicle_local_position", "z"),
    ],
)
def test_damaged_start_leaves_no_nan(tmp_path, topic, name, value):
    def change(topics):
        topics[topic][name] = value

    path = tmp_path / "log.ulg"
    path.write_bytes(ulog_stream(change=change))
    log = read_log(path)
    replay = play(log.samples, parameter_array(log, parameter_values(log)), log.start)
    assert np.isfinite(replay.output[:, :16]).all()

"""Replays on Drake's simulator: the same bits as the plain loop."""

import numpy as np
import pytest

from diagrams.replay import ReplayDiagram, ReplayEkf2
from runs.log_sources import FlightLog, read_log
from runs.replay import OUTPUT_COLUMNS, gnss_delay, parameter_array, play, record_output
from systems.estimators.ekf2.ekf2 import Ekf2Config
from systems.signals import sensor_log as logs
from systems.signals.sensor_log import SensorLog
from tests.shared_data import shared
from tests.system_contract import assert_matches_docstring


def test_topology():
    config = Ekf2Config()
    assert_matches_docstring(ReplayEkf2(config, config.parameter_array()))


@pytest.mark.parametrize(
    ("name", "defaults", "values", "until"),
    [
        (
            "flight",
            "module",
            {"EKF2_DELAY_MAX": 300, "EKF2_EV_CTRL": 3, "EKF2_EV_DELAY": 200},
            20e6,
        ),
        ("iris_gps", "unit-test", {"EKF2_DELAY_MAX": 110}, 35e6),
    ],
)
def test_drake_ends_in_the_same_bits(name, defaults, values, until):
    log = read_log(shared(f"data/px4-ekf2/{name}_input.csv.gz"))
    early = log.samples.arrivals < until
    samples = SensorLog(
        log.samples.kinds[early], log.samples.arrivals[early], log.samples.rows[early]
    )
    p = parameter_array(FlightLog(name, samples), values, defaults)
    expected = play(samples, p)

    imu = set(samples.of(logs.IMU)[0])
    rows = []

    def after(arrival, x):
        if arrival in imu:
            rows.append(np.empty(len(OUTPUT_COLUMNS)))
            record_output(x, p, arrival, 0.0, rows[-1])

    ReplayDiagram(samples, p, gnss_delay(samples, p)).play(after)
    updated = OUTPUT_COLUMNS.index("ekf_updated")
    ours = np.delete(np.array(rows), updated, axis=1)
    np.testing.assert_array_equal(ours, np.delete(expected.output, updated, axis=1))

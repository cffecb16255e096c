"""Replays on Drake's simulator: the same bits as the plain loop."""

from dataclasses import replace

import numpy as np
import pytest

from diagrams.replay import ReplayDiagram, ReplayEkf2
from runs.flight_log import FlightLog
from runs.log_sources import read_log
from runs.replay import OUTPUT_COLUMNS, gnss_delay, parameter_array, play, record_output
from systems.estimators.ekf2 import layout as at
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


def test_drake_starts_from_the_state_on_board():
    log = read_log(shared("data/ulg/outdoor_gps_quad.ulg"))
    early = log.samples.arrivals < log.samples.arrivals[0] + 3e6
    samples = replace(
        log.samples,
        kinds=log.samples.kinds[early],
        arrivals=log.samples.arrivals[early],
        rows=log.samples.rows[early],
    )
    p = parameter_array(log, log.parameters)
    expected = play(samples, p, log.start).state
    replay = ReplayDiagram(samples, p, gnss_delay(samples, p), log.start)
    own = replay.ekf2.GetMyContextFromRoot(replay.play())
    # as far as the kernels go; the ports' bookkeeping behind it is Drake's own
    np.testing.assert_array_equal(
        own.get_discrete_state(0).value()[: at.ARRIVED], expected[: at.ARRIVED]
    )

"""Open loop: the CSV layout, the replay of a flight and of its sensors."""

import numpy as np
import pandas as pd
import pytest

from plants.recorded_flight import (
    FLIGHT_COLUMNS,
    RecordedFlight,
    RecordedFlightConfig,
    read_flight,
    write_flight,
)
from systems.signals.runway_measurement import FIXED_WING_COMMAND
from tests.runway_bench import assert_contract, log_of

COMMAND = {"command": FIXED_WING_COMMAND.zeros()}


def straight(**extra) -> pd.DataFrame:
    time = np.arange(0.0, 2.01, 0.1)
    flight = pd.DataFrame({column: np.zeros(len(time)) for column in FLIGHT_COLUMNS})
    flight["time"] = time
    flight["north"] = -1000.0 + 30.0 * time
    flight["down"] = -100.0
    flight["v_north"] = 30.0
    flight["yaw"] = 0.1 * time
    return flight.assign(**extra)


def test_topology():
    assert_contract(RecordedFlight(RecordedFlightConfig(), flight=straight()))


def test_interpolates_position_attitude_and_rates():
    system = RecordedFlight(RecordedFlightConfig(), flight=straight())
    times, values = log_of(system, COMMAND, 1.5)
    np.testing.assert_allclose(values[:, 0], -1000.0 + 30.0 * times, atol=1e-9)
    np.testing.assert_allclose(values[:, 6], 0.1 * times, atol=1e-9)
    np.testing.assert_allclose(values[:, 9], 0.1)
    np.testing.assert_allclose(values[:, 13], 100.0)


def test_altitude_error_is_in_the_record_only():
    config = RecordedFlightConfig(altitude_error=4.0)
    system = RecordedFlight(config, flight=straight())
    _, values = log_of(system, COMMAND, 0.1)
    assert values[-1, 2] == -104.0


def test_recorded_sensors_are_replayed_and_gaps_skipped():
    heights = np.full(21, np.nan)
    heights[[3, 7]] = (80.0, 70.0)
    system = RecordedFlight(RecordedFlightConfig(), flight=straight(laser_height=heights))
    assert system.recorded_sensors == ("laser",)
    from pydrake.systems.analysis import Simulator

    simulator = Simulator(system)
    port = system.GetOutputPort("laser")
    for time, sequence, height in ((0.25, -1.0, 0.0), (0.5, 0.0, 80.0), (1.0, 1.0, 70.0)):
        simulator.AdvanceTo(time)
        laser = port.Eval(simulator.get_context())
        assert (laser[2], laser[4]) == (sequence, height)


def test_file_round_trip(tmp_path):
    path = tmp_path / "flight.csv"
    write_flight(straight(baro_altitude=100.0), path)
    pd.testing.assert_frame_equal(
        read_flight(path), straight(baro_altitude=100.0), atol=1e-6, check_exact=False
    )
    assert RecordedFlight(RecordedFlightConfig(path=str(path))).duration == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda flight: flight.drop(columns="pitch"), "expected the column pitch"),
        (lambda flight: flight.assign(down="low"), "expected numbers in the column down"),
        (lambda flight: flight.assign(time=0.0), "rising time"),
        (lambda flight: flight.head(1), "at least two rows"),
    ],
)
def test_bad_recordings_are_refused_in_one_sentence(tmp_path, edit, message):
    path = tmp_path / "flight.csv"
    edit(straight()).to_csv(path, index=False)
    with pytest.raises(ValueError, match=message) as error:
        read_flight(path)
    assert str(error.value).startswith(str(path))


def test_no_file_at_all(tmp_path):
    with pytest.raises(ValueError, match="expected a recorded flight as CSV"):
        read_flight(tmp_path / "none.csv")
    with pytest.raises(ValueError, match="expected a file, or a flight as a table"):
        RecordedFlight(RecordedFlightConfig())

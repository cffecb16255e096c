"""The fixed wing from 5 km to a standstill: closed loop, open loop, and the same bytes again."""

import dataclasses
import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from scipy.stats import chi2

from diagrams.landing_without_gps import (
    OUTPUTS,
    LandingWithoutGpsDiagram,
    LandingWithoutGpsScenario,
)
from plants.fixed_wing import FixedWingConfig
from plants.recorded_flight import FLIGHT_COLUMNS, RecordedFlightConfig, write_flight
from runs.landing_without_gps import diagram_for, simulate_landing
from systems.configuration import StructureChangedError
from systems.controllers.fixed_wing_reference_flight import reference_flight
from systems.estimators.runway_improved_filter import RunwayImprovedFilterConfig
from systems.signals.runway_measurement import PHASE_STATUS
from systems.supervisors.runway_phases import Phase

CLOSED = LandingWithoutGpsScenario(duration=300.0)
IMPROVED = LandingWithoutGpsScenario(duration=300.0, filter=RunwayImprovedFilterConfig())
# from 1.5 km: a whole landing in a minute
SHORT = FixedWingConfig(start=[0.0, -1500.0, -158.9])


def short(scenario, **changes):
    gps = dataclasses.replace(scenario.gps, horizontal_noise=10.0, vertical_noise=2.0)
    return dataclasses.replace(scenario, **{"aircraft": SHORT, "gps": gps, **changes})


@pytest.fixture(scope="module")
def landing():
    """One landing of each filter from 5 km."""
    return {"thesis": simulate_landing(CLOSED, 3), "improved": simulate_landing(IMPROVED, 3)}


@pytest.mark.parametrize("kind", ["thesis", "improved"])
def test_lands_from_5_km_and_stops_on_the_runway(landing, kind):
    result = landing[kind]
    assert result["landed"]
    assert 145.0 < result["touchdown_time"] < 160.0  # "around 2min30s" (6.6)
    assert result["stop_time"] > result["touchdown_time"] + 5.0
    assert result["touchdown_sink"] < 2.5
    assert -60.0 < result["touchdown_y"] < 150.0


def test_the_error_shrinks_towards_the_touchdown_point(landing):
    result = landing["thesis"]
    assert abs(result["lateral_100"]) < 3.0
    assert abs(result["longitudinal_100"]) < 60.0
    assert result["phase_2000"] == Phase.FINAL
    assert result["phase_300"] == Phase.FINAL_WITH_LASER
    assert result["altitude_300"] == pytest.approx(32.7, abs=6.0)


def test_same_seed_same_numbers_whatever_ran_before(landing):
    assert simulate_landing(IMPROVED, 3) == landing["improved"]
    scenario = dataclasses.replace(IMPROVED, seed=3)
    fresh = LandingWithoutGpsDiagram(scenario)
    simulator = Simulator(fresh.diagram)
    simulator.AdvanceTo(300.0)
    end = fresh.diagram.GetOutputPort("end").Eval(simulator.get_context())
    assert end[0] == landing["improved"]["touchdown_time"]
    assert end[6] == landing["improved"]["stop_x"]
    # nothing but the ticks of the two phases of 10 ms: no step an ulp long
    assert simulator.get_num_steps_taken() <= 2 * round(end[5] / 0.01 + 200.0)


def test_a_cloned_context_flies_on_to_the_same_end():
    scenario = short(IMPROVED, seed=5)
    landing = diagram_for(scenario)
    simulator = Simulator(landing.diagram)
    simulator.AdvanceTo(20.0)
    clone = simulator.get_context().Clone()
    simulator.AdvanceTo(30.0)
    again = Simulator(landing.diagram, clone)
    again.AdvanceTo(30.0)
    for name in OUTPUTS:
        port = landing.diagram.GetOutputPort(name)
        np.testing.assert_array_equal(
            port.Eval(simulator.get_context()), port.Eval(again.get_context())
        )


def test_the_lagged_aircraft_lands_in_wind():
    aircraft = dataclasses.replace(SHORT, dynamics="lagged", wind=[2.0, -3.0], turbulence_wind=5.0)
    result = simulate_landing(short(IMPROVED, aircraft=aircraft), 1)
    assert result["landed"]
    assert abs(result["touchdown_x"]) < 10.0


def test_open_loop_replays_the_same_flight_for_every_seed():
    scenario = short(CLOSED, aircraft=RecordedFlightConfig())
    first, second = simulate_landing(scenario, 1), simulate_landing(scenario, 2)
    assert first["touchdown_time"] == second["touchdown_time"]
    assert first["touchdown_x"] == second["touchdown_x"]
    assert first["longitudinal_300"] != second["longitudinal_300"]


def test_open_loop_with_recorded_sensors_uses_them(tmp_path):
    """A recording whose laser is 5 m too high draws the altitude estimate up by 5 m."""
    flight = reference_flight(CLOSED.flight_controller, CLOSED.runway, CLOSED.terrain, 1, SHORT)[
        list(FLIGHT_COLUMNS)
    ]
    height = -flight["down"] + 5.0
    flight["laser_height"] = np.where(np.arange(len(flight)) % 5 == 0, height, math.nan)
    path = tmp_path / "flight.csv"
    write_flight(flight, path)
    scenario = short(CLOSED, aircraft=RecordedFlightConfig(path=str(path)))
    result = simulate_landing(scenario, 1)
    assert result["vertical_150"] == pytest.approx(5.0, abs=1.0)
    assert "laser" not in diagram_for(scenario).systems
    other = short(CLOSED, aircraft=RecordedFlightConfig())
    with pytest.raises(StructureChangedError, match="other sensors"):
        diagram_for(scenario).configure(other)


def test_without_laser_the_final_stays_without_it():
    config = dataclasses.replace(CLOSED.phases, use_laser=False)
    result = simulate_landing(short(CLOSED, phases=config), 4)
    assert result["phase_300"] == Phase.FINAL


def test_a_short_start_of_the_default_scenario():
    landing = diagram_for(CLOSED)
    simulator = Simulator(landing.diagram)
    simulator.AdvanceTo(1.0 / 16.0)
    status = PHASE_STATUS(landing.diagram.GetOutputPort("phase").Eval(simulator.get_context()))
    assert status.phase == Phase.STANDBY


@pytest.mark.slow
def test_the_improved_filter_is_better_and_honest():
    """Over common seeds: smaller errors at 100 m, and a NEES that is not above its band."""
    seeds = range(16)
    thesis = [simulate_landing(CLOSED, seed) for seed in seeds]
    improved = [simulate_landing(IMPROVED, seed) for seed in seeds]
    for axis in ("lateral_100", "longitudinal_100"):
        spread = [np.std([result[axis] for result in results]) for results in (improved, thesis)]
        assert spread[0] < 0.7 * spread[1]
    nees = np.mean([result["nees_100"] for result in improved])
    # the filter is conservative by design: a third below the mean of 5 is allowed
    assert 2.0 < nees < chi2.ppf(0.999, 5 * 16) / 16

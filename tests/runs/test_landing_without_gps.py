"""The fixed wing from 5 km to a standstill: closed loop, open loop, and the same bytes again."""

import dataclasses
import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from pydrake.systems.analysis import Simulator
from scipy.stats import chi2

from diagrams.landing_without_gps import (
    OUTPUTS,
    LandingWithoutGpsDiagram,
    LandingWithoutGpsScenario,
)
from diagrams.loading import load_scenario
from diagrams.runway_geometry import require_landing
from plants.fixed_wing import FixedWingConfig
from plants.recorded_flight import FLIGHT_COLUMNS, RecordedFlightConfig, write_flight
from plants.terrain import CliffTerrain
from plumbline.command_line import cli
from runs.compiled_landing import fly_compiled
from runs.landing_without_gps import simulate_landing
from runs.report import CameraStrip, write_report
from runs.run import laboratory
from systems.configuration import StructureChangedError
from systems.controllers.fixed_wing_reference_flight import reference_flight
from systems.estimators.runway_error_filter import RunwayErrorFilterConfig
from systems.estimators.runway_improved_filter import RunwayImprovedFilterConfig
from systems.signals.runway_measurement import PHASE_STATUS
from systems.supervisors.runway_phases import Phase

CLOSED = LandingWithoutGpsScenario(time_limit=300.0)
IMPROVED = LandingWithoutGpsScenario(time_limit=300.0, filter=RunwayImprovedFilterConfig())
# from 1.5 km: a whole landing in a minute
SHORT = FixedWingConfig(start=[0.0, -1500.0, -154.1])


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
    assert abs(result["lateral_100"]) < 20.0  # three of its standard deviations
    assert abs(result["longitudinal_100"]) < 120.0
    assert result["phase_2000"] == Phase.FINAL
    assert result["phase_300"] == Phase.FINAL_WITH_LASER
    assert result["altitude_300"] == pytest.approx(27.9, abs=12.0)


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
    landing = laboratory(scenario).landing
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
    # trusting the laser as its data sheet does
    sharp = RunwayErrorFilterConfig(tuning="theoretical")
    scenario = short(CLOSED, aircraft=RecordedFlightConfig(path=str(path)), filter=sharp)
    result = simulate_landing(scenario, 1)
    assert result["vertical_150"] == pytest.approx(5.0, abs=1.0)
    assert "laser" not in laboratory(scenario).landing.systems
    other = short(CLOSED, aircraft=RecordedFlightConfig())
    with pytest.raises(StructureChangedError, match="other sensors"):
        laboratory(scenario).landing.configure(other)


def test_without_laser_the_final_stays_without_it():
    config = dataclasses.replace(CLOSED.phases, use_laser=False)
    result = simulate_landing(short(CLOSED, phases=config), 4)
    assert result["phase_300"] == Phase.FINAL


def test_a_short_start_of_the_default_scenario():
    landing = laboratory(CLOSED).landing
    simulator = Simulator(landing.diagram)
    simulator.AdvanceTo(1.0 / 16.0)
    status = PHASE_STATUS(landing.diagram.GetOutputPort("phase").Eval(simulator.get_context()))
    assert status.phase == Phase.STANDBY


def test_the_improved_filter_is_better_and_honest():
    """Over common seeds: smaller errors at 100 m, and a NEES inside its band.

    Compiled landings, which `test_compiled_landing` holds to the diagram.
    """
    honest = dataclasses.replace(
        IMPROVED,
        gps=dataclasses.replace(
            IMPROVED.gps, reported_horizontal_accuracy=0.0, reported_speed_accuracy=0.0
        ),
    )
    runs = 120
    improved = [fly_compiled(honest, seed) for seed in range(runs)]
    thesis = [fly_compiled(CLOSED, seed) for seed in range(30)]
    for axis in ("lateral_100", "longitudinal_100"):
        spread = [np.std([result[axis] for result in results]) for results in (improved, thesis)]
        assert spread[0] < 0.3 * spread[1]
    nees = np.mean([result["nees_100"] for result in improved])
    low, high = chi2.ppf([0.0005, 0.9995], 5 * runs) / runs
    assert low < nees < high
    assert np.mean([result["nees_100"] for result in thesis]) > 3.0 * high


def test_the_scenario_of_the_laboratory_starts():
    """A smoke run of the full procedure, recorded."""
    lab = laboratory(dataclasses.replace(load_scenario("landing-without-gps"), time_limit=2.0))
    simulator = lab.start()
    result = lab.fly(simulator)
    assert not result.landed
    assert result.reason == "time limit in the air"
    assert "time limit" in result.sentences()[0]
    log = lab.log(simulator.get_context())
    assert {"state.p_n_x", "estimate.covariance_x_x", "fix.p_n_x"} <= set(log.column_names)
    assert lab.landing.state(simulator.get_context()) == "standby"


def test_the_report_draws_what_the_thesis_draws(tmp_path):
    lab = laboratory(short(IMPROVED))
    simulator = lab.start()
    strip = CameraStrip(lab.landing, 10.0)
    result = lab.fly(simulator, strip)
    assert result.landed
    assert len(strip.frames) >= 4
    path = tmp_path / "report.html"
    write_report(path, lab.landing, result, lab.log(simulator.get_context()), strip.frames)
    page = path.read_text()
    for title in ("Ground track", "Profile", "Error across", "Innovation: laser", "Cameras"):
        assert title in page
    assert json.dumps(result.summary(), allow_nan=True)


def grid(edge, elevation):
    """An ESRI ASCII grid of 3 x 3 points about the touch-down point."""
    header = f"ncols 3\nnrows 3\nxllcenter {-edge}\nyllcenter {-edge}\ncellsize {edge}\n"
    return header + 3 * f"{elevation} {elevation} {elevation}\n"


def flight(down):
    """Two seconds of a recorded flight past 1300 m before the touch-down point."""
    header = "time,north,east,down,v_north,v_east,v_down,yaw,pitch,roll\n"
    return header + "".join(f"{k},{k - 1300},0,{down},33,0,0,42,0,0\n" for k in range(3))


GRID = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n"


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("camera.mounting=[0, 60, 0]", ("camera.mounting", "sees the touch-down point")),
        ("camera.mounting=[180, 0, 0]", ("camera.mounting", "behind it", "[0.0, -2.5, 0]")),
        ("camera.horizontal_field_of_view=0.01", ("horizontal_field_of_view", "at least 1.4 deg")),
        ("camera.vertical_field_of_view=0.01", ("vertical_field_of_view", "at least 1.2 deg")),
        ("camera.position=[100, 0, 0]", ("camera.position", "within 20 m")),
        ("camera.latency=100", ("camera.latency", "at most 1.28 s")),
        ("laser.delay=10", ("laser.delay", "at most 1.6 s")),
        ("laser.activation_height=600", ("laser.activation_height", "522 m over the ground")),
        ("record.distances=[]", ("record.distances", "at least one")),
        ("runway.length=0", ("runway.length", "greater than 0")),
        ("runway.length=200", ("runway.length", "at least 237 m")),
        ("runway.width=.nan", ("runway.width", "finite number")),
        ("runway.latitude=123", ("runway.latitude", "-89 to 89 deg")),
        ("runway.ground_station=[1e6, 0, -10]", ("runway.ground_station", "within 107 km")),
        ("runway.ground_station=[0, 0, 5]", ("runway.ground_station", "at most 0 m")),
        ("aircraft.start=[0, -5000, 100]", ("aircraft.start", "in the air")),
        ("aircraft.start=[0, 1000, -100]", ("aircraft.start", "less than -105 m")),
        ("aircraft.start=[4000, -1000, -100]", ("aircraft.start", "at most 1000 m beside")),
        ("aircraft.start=[0, -1000, -300]", ("aircraft.start", "at most 167 m above")),
        ("aircraft.start_course=180", ("aircraft.start_course", "less than 90 deg")),
        ("aircraft.start_vertical_speed=9", ("start_vertical_speed", "-2.5 to 5.5 m/s")),
        ("aircraft.speed=10", ("aircraft.speed", "at least 20.6 m/s")),
        ("aircraft.wind=[40, 0]", ("aircraft.wind", "33 m/s")),
        ("flight_controller.speed=66", ("flight_controller.speed", "about 33")),
        ("flight_controller.route.profile.slope=0.5", ("profile.slope", "more than 0.87 deg")),
        ("flight_controller.route.profile.slope=30", ("profile.slope", "at most 9.5 deg")),
        ("flight_controller.route.profile.touchdown_sink=9", ("touchdown_sink", "5.5 m/s")),
        (
            "flight_controller.route.waypoints=[[0, -9000, -500], [0, -9000, -500]]",
            ("waypoints.1", "another place"),
        ),
        ("terrain={kind: plateau, rise: 200}", ("terrain", "below the landing trajectory")),
        (
            "terrain={kind: obstacle, at: 62, height: 12}",
            ("terrain", "hides it", "m above the line of sight"),
        ),
        ("terrain={kind: slope, until: 20000}", ("terrain.until", "less than 12000 m")),
        ("terrain={kind: slope, gradient: 1}", ("terrain", "-12000 to 9000 m")),
        ("terrain={kind: file, path: buried.asc, coordinates: metres}", ("altitude", "500 m")),
        ("terrain={kind: file, path: small.asc, coordinates: metres}", ("end of the runway",)),
        ("aircraft={kind: recorded_flight, path: brief.csv}", ("brief.csv", "record.distances")),
        ("aircraft={kind: recorded_flight, path: low.csv}", ("low.csv", "500 m below")),
        ("tracker.clicks=[800, 2000, 4500]", ("tracker.clicks", "[4500.0, 2000.0, 800.0]")),
        ("tracker.clicks=[50, 40, 30]", ("tracker.clicks", "loss_distance")),
        ("terrain={kind: file, path: nowhere.asc}", ("nowhere.asc", "no such file")),
        (
            "terrain={kind: file, path: short.asc}",
            ("short.asc", "expected 2 x 2 elevations", "found 3"),
        ),
        ("aircraft={kind: recorded_flight, path: nowhere.csv}", ("nowhere.csv", "CSV")),
        ("aircraft={kind: recorded_flight, path: empty.csv}", ("empty.csv", "CSV")),
        ("aircraft={kind: recorded_flight, path: torn.csv}", ("torn.csv", "column v_north")),
        ("aircraft={kind: recorded_flight, start_distance: 1}", ("start_distance", "within 1 m")),
        ("filter={kind: kalman}", ("filter", "error_filter")),
    ],
)
def test_wrong_input_is_one_sentence_and_ends_with_2(override, parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.asc").write_text(GRID)
    (tmp_path / "buried.asc").write_text(grid(3000.0, 500.0))
    (tmp_path / "small.asc").write_text(grid(300.0, 89.0))
    (tmp_path / "brief.csv").write_text(flight(-150.0))
    (tmp_path / "low.csv").write_text(flight(500.0))
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "torn.csv").write_text("time,north,east,down\n0,1,2,3\n")
    arguments = ["land", "landing-without-gps-final", "--set", override, "--out", "out"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 2, result.output
    sentence = result.output.strip()
    assert sentence.startswith("plumbline: ")
    assert "\n" not in sentence
    for part in parts:
        assert part in sentence


@pytest.mark.parametrize("name", ["landing-without-gps", "landing-without-gps-final"])
def test_the_scenarios_of_the_laboratory_are_possible(name):
    scenario = load_scenario(name)
    require_landing(scenario, scenario.terrain.grid(scenario.runway))


def test_seeds_are_not_checked_again(monkeypatch):
    """A campaign's runs differ in the seed, and the checks cost as much as half a landing."""
    landing = LandingWithoutGpsDiagram(CLOSED)
    asked = []
    monkeypatch.setattr(
        "diagrams.landing_without_gps.require_landing", lambda *_: asked.append(True)
    )
    landing.configure(dataclasses.replace(CLOSED, seed=7))
    assert not asked
    landing.configure(dataclasses.replace(CLOSED, seed=7, terrain=CliffTerrain()))
    assert asked

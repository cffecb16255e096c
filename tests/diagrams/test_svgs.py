"""The SVGS paper's system as wired: the companion computer, the scenarios, a whole landing."""

import json

import numpy as np
import pandas as pd
import pytest

from diagrams.landing import LandingDiagram
from diagrams.loading import load_scenario
from diagrams.scenario import settled
from diagrams.svgs import RECORDED, companion_computer
from plants.vehicles import dr_spider
from runs.flight import fly_and_report
from runs.run import Laboratory, laboratory
from systems.data_recorder import DataRecorderConfig
from systems.estimators.svgs_companion import SvgsCompanionConfig
from systems.signals.measurement import EXTERNAL_VISION, SETPOINT, SVGS, VEHICLE_ESTIMATE
from systems.supervisors.landing_supervisor import LandingSupervisorConfig
from systems.supervisors.svgs_routine import SvgsRoutineConfig

FLIGHTS = ["svgs-high-altitude", "svgs-flight-2", "svgs-flight-3", "svgs-without-gnss"]
BASELINE = ["infrared-high-altitude", "infrared-flight-2", "infrared-flight-3"]
NODES = {
    "svgs_deserializer",
    "transformations",
    "filter",
    "routine_commander",
    "motion_control",
    "px4_control",
    "data_recording",
}
# From 12 m with bigger steps: a whole landing in a minute.
LOW = {
    "fidelity": "geometric",
    "guidance.mission.altitude": 12.0,
    "guidance.routine.descent_step": 1.2,
    "time_limit": 200.0,
}


def test_companion_computer_has_the_papers_nodes():
    diagram = companion_computer(
        SvgsCompanionConfig(),
        LandingSupervisorConfig(routine=SvgsRoutineConfig()),
        DataRecorderConfig(),
    )
    parts = diagram.GetSystems()
    names = {part.get_name() for part in parts}
    for part in parts:
        names |= {system.get_name() for system in getattr(part, "GetSystems", list)()}
    assert names >= NODES
    assert diagram.GetInputPort("svgs").size() == SVGS.size
    assert diagram.GetInputPort("estimate").size() == VEHICLE_ESTIMATE.size
    assert diagram.GetOutputPort("setpoint").size() == SETPOINT.size
    assert diagram.GetOutputPort("external_vision").size() == EXTERNAL_VISION.size


@pytest.mark.parametrize("name", FLIGHTS + BASELINE)
def test_scenarios_start(name):
    lab = Laboratory(load_scenario(name, {"fidelity": "geometric"}))
    simulator = lab.start()
    simulator.AdvanceTo(1.0 / 16.0)
    assert lab.landing.state(simulator.get_context()) == "wait"


@pytest.mark.parametrize("name", FLIGHTS)
def test_table_1(name):
    """The gates of Table 1, in standard deviations, and what section 2.4 says of the sources."""
    parameters = load_scenario(name).navigation.parameters
    gates = {"MAG": 5, "BARO": 5, "RNG": 10, "EVP": 10, "GPS_P": 2, "GPS_V": 2}
    assert {gate: parameters[f"EKF2_{gate}_GATE"] for gate in gates} == gates
    assert parameters["EKF2_HGT_REF"] == 0  # barometer


@pytest.mark.parametrize(
    ("name", "start", "command"),
    [
        ("svgs-high-altitude", (-11.02, 20.16, 106.65), (-9.39, 20.35)),
        ("svgs-flight-2", (-10.97, 20.20, 101.65), (-6.55, 22.59)),
        ("svgs-flight-3", (9.48, 12.82, 101.93), (7.92, 12.03)),
        ("infrared-high-altitude", (-2.07, -0.86, 54.83), (-2.04, -0.93)),
        ("infrared-flight-2", (-6.61, 42.24, 54.95), (-6.79, 48.42)),
        ("infrared-flight-3", (-0.09, 0.44, 53.11), (-0.08, 0.36)),
    ],
)
def test_table_4(name, start, command):
    """The flight begins above the start, seen from the landing command."""
    scenario = load_scenario(name)
    offset = np.array(start[:2]) - np.array(command)
    np.testing.assert_allclose(scenario.vehicle.position[:2], offset, atol=1e-9)
    assert scenario.guidance.mission.altitude == start[2]


def test_wind_is_within_table_2():
    knot = 1852.0 / 3600.0
    for name in FLIGHTS:
        assert load_scenario(name).wind.speed <= 10.0 * knot


def test_companion_takes_over_what_the_camera_is():
    scenario = load_scenario("svgs-high-altitude")
    scenario.sensors.svgs_camera.sensor.position = [0.1, 0.0, -0.2]
    scenario.sensors.svgs_camera.sensor.beacons.short.position = [-2.0, 0.5, 0.0]
    node = settled(scenario).landing_target.transformations
    assert node.camera_position == [0.1, 0.0, -0.2]
    assert node.beacons.short.position == [-2.0, 0.5, 0.0]


def test_pictures_of_the_phone():
    landing = LandingDiagram(load_scenario("svgs-high-altitude"))
    context = landing.diagram.CreateDefaultContext()
    ((name, picture),) = landing.camera_pictures(context)
    assert name == "svgs camera"
    assert picture.ndim == 3


@pytest.mark.parametrize("name", FLIGHTS + BASELINE)
def test_no_marker_where_no_camera_looks_for_one(name):
    scenario = load_scenario(name)
    assert scenario.sensors.marker_camera is None
    assert scenario.pad.marker is None


def test_a_run_folder_has_the_companions_record_and_a_campaign_has_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = load_scenario("svgs-high-altitude", {"fidelity": "geometric", "time_limit": 2.0})
    folder = tmp_path / "run"
    folder.mkdir()
    result = fly_and_report(scenario, folder, report=False)
    table = pd.read_csv(folder / "companion.csv")
    assert len(table) == pytest.approx(25 * result.simulated_s, abs=1)
    assert {column.partition(".")[0] for column in table} == {"time", *RECORDED}
    # Where the record went is no part of the scenario that run.json holds
    assert scenario.data_recorder.path == ""
    flown = json.loads((folder / "run.json").read_text())["configuration"]
    assert flown["data_recorder"]["path"] == ""
    # The same diagram, flown once more for its result alone
    record = (folder / "companion.csv").read_bytes()
    laboratory(scenario).fly()
    assert (folder / "companion.csv").read_bytes() == record
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.slow
def test_landing_and_its_record(tmp_path):
    """From 12 m to the ground beside the beacons, with the companion computer's own record."""
    path = tmp_path / "flight.csv"
    scenario = load_scenario("svgs-high-altitude", {**LOW, "data_recorder": {"path": str(path)}})
    result = Laboratory(scenario).fly()
    assert result.landed, result.reason
    assert result.landing_error_m < 0.4
    beacons = scenario.sensors.svgs_camera.sensor.beacons
    rotors = dr_spider().rotor_positions
    reach = max(np.hypot(x, y) for x, y, _ in rotors) + dr_spider().rotor_radius
    assert beacons.clearance(np.array(result.landing_offset_m), reach) > 0.0
    table = pd.read_csv(path)
    assert len(table) == pytest.approx(25 * result.simulated_s, rel=0.02)
    assert {column.partition(".")[0] for column in table} == {"time", *RECORDED}
    assert table["supervisor.disarmed"].iloc[-1] == 1.0
    # External vision came in at 30 Hz while a beacon was in sight.
    assert table["external_vision.sequence_number"].max() > 20 * 40


@pytest.mark.slow
def test_sight_lost_for_good_ends_without_a_crash():
    faults = {"faults": [{"kind": "below", "height": 8.0, "while_landing": True}]}
    scenario = load_scenario(
        "svgs-high-altitude",
        {
            **LOW,
            "time_limit": 400.0,
            "guidance.routine.first_square": 1,
            "guidance.routine.square_growth": 1,
            "sensors.svgs_camera.faults": faults,
        },
    )
    result = Laboratory(scenario).fly()
    assert result.landed, result.reason
    assert result.landing_error_m < 1.0

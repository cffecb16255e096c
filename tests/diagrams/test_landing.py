"""The wiring of a vertical landing: named sub-diagrams, every port connected, graphs."""

import pytest
from pydrake.systems.framework import Diagram

from diagrams.graph import wiring_dot
from diagrams.landing import LandingDiagram
from diagrams.loading import load_scenario, with_overrides
from diagrams.scenario import settled
from runs.run import Laboratory
from systems.configuration import StructureChangedError
from systems.estimators.ekf2.messages import STATUS


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("one-of-everything")


@pytest.fixture(scope="module")
def landing(scenario):
    return LandingDiagram(scenario)


def test_named_systems_and_subdiagrams(landing):
    names = {system.get_name() for system in landing.diagram.GetSystems()}
    assert {
        "world", "sensors", "navigation", "landing target", "guidance", "control", "observer"
    } <= names  # fmt: skip
    for name in ("world", "sensors", "landing target"):
        assert isinstance(landing.diagram.GetSubsystemByName(name), Diagram)


def test_subdiagrams_export_their_ports(landing):
    def outputs(system):
        return [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]

    assert outputs(landing.world) == ["body", "rotor_speeds", "wind", "pad"]
    assert set(outputs(landing.sensors)) == {
        "imu", "gnss", "barometer", "magnetometer", "range_finder", "marker", "infrared"
    }  # fmt: skip


def test_every_input_is_connected_but_the_ones_meant_to_be_open(landing):
    connected = {
        (entry.get_name(), int(port)) for entry, port in landing.diagram.connection_map()
    }  # fmt: skip
    open_ports = [
        (system.get_name(), system.get_input_port(index).get_name())
        for system in landing.diagram.GetSystems()
        for index in range(system.num_input_ports())
        if (system.get_name(), index) not in connected
    ]
    # Faults come by a command from outside; vision is not on board here.
    assert set(open_ports) <= {
        ("sensors", "fault_command"),
        ("navigation", "external_vision"),
    }


def test_the_navigation_filter_hears_when_it_takes_off(scenario):
    laboratory = Laboratory(with_overrides(scenario, {"fidelity": "geometric"}))
    simulator = laboratory.start()
    ekf2 = laboratory.landing.navigation
    heard = []
    for time in (1.0, 20.0):
        simulator.AdvanceTo(time)
        status = ekf2.GetOutputPort("status").Eval(
            ekf2.GetMyContextFromRoot(simulator.get_context())
        )
        values = dict(zip(STATUS.fields, status, strict=True))
        heard.append((values["vehicle_at_rest"], values["in_air"]))
    assert heard == [(1.0, 0.0), (0.0, 1.0)]


def test_the_fault_command_is_an_input_of_the_whole(landing):
    assert landing.diagram.GetInputPort("fault_command")


def test_configure_takes_numbers_and_refuses_another_structure(scenario, landing):
    landing.configure(with_overrides(scenario, {"wind.speed": 9.0, "seed": 77}))
    assert landing.blocks.scenario.wind.speed == 9.0
    with pytest.raises(StructureChangedError):
        landing.configure(with_overrides(scenario, {"sensors.gnss": None}))
    with pytest.raises(StructureChangedError):
        landing.configure(with_overrides(scenario, {"vehicle.vehicle": "dr_spider"}))
    with pytest.raises(StructureChangedError):
        landing.configure(with_overrides(scenario, {"guidance.routine": {"kind": "normal"}}))
    landing.configure(scenario)


def test_the_cameras_look_for_what_is_on_the_pad(scenario):
    pad = {
        "pad.side": 0.9,
        "pad.marker.levels": [{"id": 3, "side": 0.5}, {"id": 7, "side": 0.1}],
        "pad.beacon.position": [0.2, 0.0, 0.0],
    }
    sensors = settled(with_overrides(scenario, pad)).sensors
    assert sensors.marker_camera.sensor.marker_ids == [3, 7]
    assert sensors.marker_camera.sensor.marker_sides == [0.5, 0.1]
    assert sensors.marker_camera.sensor.plate_side == 0.9
    assert sensors.infrared_camera.sensor.beacon_position == [0.2, 0.0, 0.0]
    for part, camera in (("marker", "marker"), ("beacon", "infrared")):
        with pytest.raises(ValueError, match=f"pad.{part} is null.*{camera}_camera to null"):
            settled(with_overrides(scenario, {f"pad.{part}": None}))
        settled(with_overrides(scenario, {f"pad.{part}": None, f"sensors.{camera}_camera": None}))


def test_shared_values_reach_their_blocks(scenario):
    iris = settled(with_overrides(scenario, {"vehicle.vehicle": "iris"}))
    assert iris.control.vehicle.rotor_count == 4
    assert iris.guidance.rotor_count == 4
    assert iris.sensors.gnss.sensor.origin == [
        iris.origin.latitude, iris.origin.longitude, iris.origin.altitude
    ]  # fmt: skip


def test_blocks_draw_different_noise(scenario, landing):
    seeds = {path: landing.blocks.seed_of(path) for path in landing.blocks.systems}
    assert len(set(seeds.values())) == len(seeds)


@pytest.mark.parametrize("depth", [0, 1, None])
def test_wiring_as_dot(landing, depth):
    dot = wiring_dot(landing.diagram, depth)
    assert ("marker camera" in dot) == (depth is None)
    assert "digraph" in dot


def test_states_as_dot(landing):
    dot = landing.states_dot()
    for state in landing.state_names():
        assert state in dot or state.replace("_", " ") in dot

"""The supervisor as a system: ports, state, mission, resets, touchdown, configuration."""

import math

import numpy as np
import pydot
import pytest

from systems.configuration import StructureChangedError
from systems.signals.measurement import (
    RANGE_FINDER,
    SETPOINT,
    SUPERVISOR_STATUS,
    TARGET_ESTIMATE,
    VEHICLE_ESTIMATE,
)
from systems.supervisors.ardupilot import ArduPilotConfig
from systems.supervisors.cautious import CautiousConfig
from systems.supervisors.landing_supervisor import LandingSupervisor, LandingSupervisorConfig
from systems.supervisors.mission import MissionConfig
from systems.supervisors.normal import NormalConfig
from systems.supervisors.px4_precland import PX4PreclandConfig
from systems.supervisors.situation import Memory, Situation
from systems.supervisors.state_machine import problems, to_dot
from systems.supervisors.touchdown import TouchdownDetector, TouchdownDetectorConfig
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.supervisors.point_mass import Flight, PointMass

ROUTINES = [NormalConfig(), ArduPilotConfig(), CautiousConfig(), PX4PreclandConfig()]


def config(routine=None, **mission) -> LandingSupervisorConfig:
    return LandingSupervisorConfig(
        routine=routine or NormalConfig(), mission=MissionConfig(**mission)
    )


@pytest.mark.parametrize("routine", ROUTINES, ids=lambda routine: routine.kind)
def test_topology(routine):
    supervisor = LandingSupervisor(config(routine))
    assert_matches_docstring(supervisor)
    assert periodic_update(supervisor) == (0.04, 0.0)


def test_memory_begins_with_the_layouts_of_the_outputs():
    fields = Memory.fields()
    assert len(fields) == len(set(fields))
    renamed = [
        name.replace("setpoint_v", "v_WB_")
        .replace("setpoint_a", "a_WB_")
        .replace("setpoint_", "p_WB_")
        for name in fields
    ]
    renamed[6] = "yaw"
    assert tuple(renamed[: SETPOINT.size]) == SETPOINT.fields
    status = fields[SETPOINT.size : SETPOINT.size + SUPERVISOR_STATUS.size]
    assert [name.split("_")[0] for name in status] == [
        name.split("_")[0] for name in SUPERVISOR_STATUS.fields
    ]


def test_initial_outputs():
    supervisor = LandingSupervisor(config())
    context = supervisor.CreateDefaultContext()
    setpoint = SETPOINT(supervisor.GetOutputPort("setpoint").Eval(context))
    status = SUPERVISOR_STATUS(supervisor.GetOutputPort("status").Eval(context))
    assert setpoint.armed == 0.0
    assert np.isnan([setpoint.p_WB_x, setpoint.p_WB_y, setpoint.p_WB_z, setpoint.yaw]).all()
    assert (status.disarmed, status.landed_detected, status.landing_started) == (1.0, 0.0, -1.0)
    assert supervisor.state_name(status[:]) == "wait"


@pytest.mark.parametrize("routine", ROUTINES, ids=lambda routine: routine.kind)
def test_table_is_sound_and_can_be_drawn(routine):
    machine = LandingSupervisor(config(routine)).machine
    assert problems(machine.table) == []
    (graph,) = pydot.graph_from_dot_data(to_dot(machine.table, routine.kind, routine.routine()))
    # One node more than states and one edge more than transitions: the way in.
    assert len(graph.get_nodes()) == len(machine.table.states) + 1
    assert len(graph.get_edges()) == len(machine.table.transitions) + 1


# -- one event


def event(supervisor, context, t, **inputs):
    """One update at time t; the setpoint and the status after it."""
    context.SetTime(t)
    for name, value in inputs.items():
        supervisor.GetInputPort(name).FixValue(context, value)
    update = supervisor.EvalUniquePeriodicDiscreteUpdate(context)
    context.get_mutable_discrete_state().SetFrom(update)
    return (
        SETPOINT(supervisor.GetOutputPort("setpoint").Eval(context).copy()),
        SUPERVISOR_STATUS(supervisor.GetOutputPort("status").Eval(context).copy()),
    )


def estimate(p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), yaw=0.0, valid=1.0, **fields):
    values = VEHICLE_ESTIMATE.zeros()
    values[1:4] = valid
    values[VEHICLE_ESTIMATE.index("q_WB_w")] = math.cos(yaw / 2)
    values[VEHICLE_ESTIMATE.index("q_WB_z")] = math.sin(yaw / 2)
    values[VEHICLE_ESTIMATE.slice("p_WB")] = p
    values[VEHICLE_ESTIMATE.slice("v_WB")] = v
    for name, value in fields.items():
        values[VEHICLE_ESTIMATE.index(name)] = value
    return values


def target(p_BP_W, fused, v_WP=(0.0, 0.0, 0.0)):
    values = TARGET_ESTIMATE.zeros()
    values[TARGET_ESTIMATE.index("acquired")] = 1.0
    values[TARGET_ESTIMATE.index("time_of_last_fusion")] = fused
    values[TARGET_ESTIMATE.slice("p_BP_W")] = p_BP_W
    values[TARGET_ESTIMATE.slice("v_WP")] = v_WP
    return values


def ranging(t, distance):
    values = RANGE_FINDER.zeros()
    values[:5] = t, t, 0.0, 1.0, distance
    return values


def in_state(supervisor, name, **memory):
    """A context with the machine in a state, armed."""
    context = supervisor.CreateDefaultContext()
    fields = supervisor._routine.memory.fields()
    values = dict(zip(fields, supervisor._routine.memory.initial(), strict=True))
    values |= {"state": supervisor.machine.table.index(name), "armed": 1.0, "disarmed": 0.0}
    values |= {"horizontal_resets": 0.0, "vertical_resets": 0.0, "maximum_speed": 1.0} | memory
    start = 0
    for group in range(context.num_discrete_state_groups()):
        size = context.get_discrete_state(group).size()
        names = fields[start : start + size]
        context.SetDiscreteState(group, np.array([values[n] for n in names]))
        start += size
    return context


def test_waits_until_the_estimate_has_been_valid_for_a_while():
    supervisor = LandingSupervisor(config(settle_time=0.1))
    context = supervisor.CreateDefaultContext()
    armed = []
    for k in range(20):
        # Valid from the third event, with a gap at the fifth.
        valid = float(k >= 2 and k != 4)
        setpoint, _ = event(supervisor, context, k * 0.04, estimate=estimate(valid=valid))
        armed.append(setpoint.armed)
    assert int(np.argmax(armed)) == 5 + math.ceil(0.1 / 0.04)


@pytest.mark.parametrize(
    ("state", "memory", "v", "expected"),
    [
        ("wait", {"armed": 0.0}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ("climb", {}, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0)),  # still on the ground
        ("climb", {}, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
        ("climb", {"in_air": 1.0}, (0.0, 0.0, 0.1), (0.0, 1.0, 0.0)),
        ("descend", {"setpoint_vz": -0.5}, (0.0, 0.0, -0.5), (0.0, 1.0, 1.0)),
        ("descend", {"setpoint_vz": -0.2}, (0.0, 0.0, -0.3), (0.0, 1.0, 0.0)),  # too slowly
        ("descend", {"setpoint_vz": -0.5}, (2.0, 0.0, -0.5), (0.0, 1.0, 0.0)),  # and sideways
    ],
)
def test_tells_the_navigation_filter_what_the_land_detector_says(state, memory, v, expected):
    supervisor = LandingSupervisor(config(NormalConfig()))
    context = in_state(supervisor, state, **memory)
    event(supervisor, context, 50.0, estimate=estimate(v=v))
    port = supervisor.GetOutputPort("vehicle_status")
    np.testing.assert_array_equal(port.Eval(context), expected)


def test_over_the_target_the_setpoint_puts_the_reference_point_on_it():
    supervisor = LandingSupervisor(
        LandingSupervisorConfig(routine=ArduPilotConfig(), reference_point=[0.2, 0.1, -0.05])
    )
    context = in_state(supervisor, "descend_on_target")
    setpoint, status = event(
        supervisor,
        context,
        50.0,
        estimate=estimate(p=(3.0, 4.0, 5.0), yaw=math.pi / 2),
        target=target((0.6, -0.7, -5.0), fused=49.9, v_WP=(0.3, 0.2, 0.0)),
    )
    # Turned by 90 degrees, ahead is north and left is west.
    assert setpoint.p_WB_x == pytest.approx(3.0 + 0.6 + 0.1)
    assert setpoint.p_WB_y == pytest.approx(4.0 - 0.7 - 0.2)
    assert (setpoint.v_WB_x, setpoint.v_WB_y) == (0.3, 0.2)
    assert math.isnan(setpoint.p_WB_z)
    assert status.target_in_use == 1.0


@pytest.mark.parametrize(
    ("error", "height", "speed"),
    [
        (3.0, 6.0, 0.0),  # farther than XY_DIST_MAX
        (0.0, 6.0, 0.5),  # LAND_SPEED
        (0.0, 1.0, 0.25),  # slowed near the ground
        (0.06, 1.0, 0.15),
        (0.3, 1.0, 0.10),  # never slower
        (0.3, 0.3, 0.5),  # the last third of a metre
        (0.0, 10.5, 0.5),  # 1 (h - 10), not less than LAND_SPEED
        (0.0, 11.4, math.sqrt(2 * 0.9)),
        (0.0, 20.0, 1.5),
    ],
)
def test_ardupilots_rate_of_descent(error, height, speed):
    supervisor = LandingSupervisor(config(ArduPilotConfig()))
    context = in_state(supervisor, "descend_on_target")
    setpoint, _ = event(
        supervisor,
        context,
        50.0,
        estimate=estimate(p=(0.0, 0.0, height)),
        target=target((error, 0.0, -height), fused=49.9),
    )
    assert setpoint.v_WB_z == pytest.approx(-speed)


@pytest.mark.parametrize(("height", "speed"), [(12.0, 1.5), (7.5, 1.1), (4.0, 0.7), (0.9, 0.3)])
def test_px4s_rate_of_descent(height, speed):
    supervisor = LandingSupervisor(config(PX4PreclandConfig()))
    context = in_state(supervisor, "fallback", setpoint_x=0.0, setpoint_y=0.0)
    setpoint, _ = event(
        supervisor,
        context,
        50.0,
        estimate=estimate(p=(0.0, 0.0, height)),
        range_finder=ranging(50.0, height),
    )
    assert setpoint.v_WB_z == pytest.approx(-speed)


def test_height_is_the_tilted_range_then_the_estimates_then_over_home():
    supervisor = LandingSupervisor(config(NormalConfig()))
    roll = 0.2
    tilted = estimate(p=(0.0, 0.0, 30.0))
    tilted[VEHICLE_ESTIMATE.index("q_WB_w")] = math.cos(roll / 2)
    tilted[VEHICLE_ESTIMATE.index("q_WB_x")] = math.sin(roll / 2)
    far = {"height_above_ground": 11.3, "height_above_ground_valid": 1.0}

    def speed(**inputs):
        context = in_state(supervisor, "descend", home_z=15.0)
        setpoint, _ = event(supervisor, context, 50.0, **inputs)
        return -setpoint.v_WB_z

    # The rate of descent above 10 m tells which height was used: root of 2 (h - 10.5).
    by_range = speed(estimate=tilted, range_finder=ranging(50.0, 11.4 / math.cos(roll)))
    assert by_range == pytest.approx(math.sqrt(2 * 0.9))
    old = ranging(49.0, 11.4)
    by_estimate = speed(estimate=estimate(p=(0.0, 0.0, 30.0), **far), range_finder=old)
    assert by_estimate == pytest.approx(math.sqrt(2 * 0.8))
    by_home = speed(estimate=estimate(p=(0.0, 0.0, 26.2)), range_finder=old)
    assert by_home == pytest.approx(math.sqrt(2 * 0.7))


def test_jump_of_the_estimate_moves_every_stored_position():
    supervisor = LandingSupervisor(config(CautiousConfig()))
    stored = {
        f"{name}_{axis}": 10.0 * i + j
        for i, name in enumerate(("setpoint", "home", "goal", "sighting"))
        for j, axis in enumerate("xyz")
    }
    context = in_state(supervisor, "pause", entered=50.0, **stored, mark_x=7.0, mark_y=8.0)
    jumped = estimate(
        p=(1.0, 2.0, 5.0),
        horizontal_reset_counter=1.0,
        horizontal_reset_x=0.5,
        horizontal_reset_y=-0.25,
        vertical_reset_counter=1.0,
        vertical_reset=2.0,
    )
    for t in (50.0, 50.04):  # the second event sees the same counters
        event(supervisor, context, t, estimate=jumped)
    fields = supervisor._routine.memory.fields()
    groups = [
        context.get_discrete_state(i).value() for i in range(context.num_discrete_state_groups())
    ]
    memory = dict(zip(fields, np.concatenate(groups), strict=True))
    shift = {"x": 0.5, "y": -0.25, "z": 2.0}
    for name, value in {**stored, "mark_x": 7.0, "mark_y": 8.0}.items():
        assert memory[name] == value + shift[name[-1]], name
    assert memory["setpoint_vz"] == 0.0


# -- touchdown


def felt(detector, **changes):
    """Whether contact is felt in a situation of a vehicle on the ground that wants to descend."""
    memory = Memory()
    memory.armed, memory.setpoint_vz, memory.hover_command = 1.0, -0.5, 0.4
    situation = Situation(memory, 0.04)
    situation.time, situation.height, situation.height_measured = 10.0, 0.2, True
    for name, value in changes.items():
        setattr(memory if hasattr(memory, name) else situation, name, value)
    detector.observe(situation)
    return memory.contact_since >= 0.0


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"armed": 0.0}, False),
        ({"setpoint_z": 3.0}, False),  # no rate of descent is commanded
        ({"setpoint_vz": 0.0}, False),
        ({"vz": -0.3}, False),
        ({"vz": 0.3}, False),
        ({"vx": 1.6}, False),
        ({"height": 1.2}, False),
        ({"height": 1.2, "height_measured": False}, True),
        ({"setpoint_vz": -0.2}, False),  # too slow to tell from hovering
        ({"setpoint_vz": -0.2, "command": 0.1}, True),  # but not without thrust
        ({"setpoint_vz": -0.2, "command": 0.35}, False),
        ({"setpoint_vz": -0.2, "command": 0.1, "vz": -0.15}, False),
    ],
)
def test_signs_of_the_ground(changes, expected):
    assert felt(TouchdownDetector(TouchdownDetectorConfig()), **changes) is expected


@pytest.mark.parametrize(
    ("changes", "duration"),
    [
        ({}, 1.0),
        ({"command": 0.1}, 1.0),
        ({"command": 0.4}, 3.0),
        ({"height_measured": False}, 3.0),
        ({"height_measured": False, "command": 0.4}, 9.0),
    ],
)
def test_touchdown_takes_longer_with_fewer_signs(changes, duration):
    detector = TouchdownDetector(TouchdownDetectorConfig())
    memory = Memory()
    memory.hover_command, memory.contact_since = 0.4, 10.0
    situation = Situation(memory, 0.04)
    situation.height_measured = True
    for name, value in changes.items():
        setattr(situation, name, value)
    situation.time = 10.0 + duration - 0.01
    assert not detector.touched_down(situation)
    situation.time = 10.0 + duration + 0.01
    assert detector.touched_down(situation)


# -- flights


def test_mission_is_the_square_of_the_thesis():
    """Climb to 10 m, then a square of 2 m away from the pad and back to where the climb ended."""
    flight = Flight(config(altitude=10.0), PointMass(start=(2.0, 0.0)))
    corners = [(4.0, 0.0), (4.0, 2.0), (2.0, 2.0), (2.0, 0.0)]
    for n, corner in enumerate(corners, start=1):
        during = flight.status.state == 1.0 + n
        goal = np.array([flight.setpoints.p_WB_x[during], flight.setpoints.p_WB_y[during]])
        np.testing.assert_allclose(goal, np.array([corner]).T * np.ones(goal.shape), atol=1e-6)
        x = flight.estimates.p_WB_x[during][-1], flight.estimates.p_WB_y[during][-1]
        np.testing.assert_allclose(x, corner, atol=0.35)
    level = (flight.status.state > 1.0) & (flight.status.state <= 5.0)
    assert np.abs(flight.estimates.p_WB_z[level] - 10.0).max() < 0.4
    climbing = flight.status.state == 1.0
    assert flight.estimates.v_WB_z[climbing].max() < 1.8
    assert flight.landed
    np.testing.assert_allclose(flight.position, [2.0, 0.0, 0.0], atol=0.02)


def test_heading_turns_the_square():
    flight = Flight(config(altitude=2.0, heading=math.pi / 2), PointMass(start=(0.0, -3.0)))
    during = flight.status.state == 2.0
    assert flight.setpoints.p_WB_x[during][-1] == pytest.approx(0.0, abs=1e-6)
    assert flight.setpoints.p_WB_y[during][-1] == pytest.approx(-1.0, abs=1e-6)


def test_does_not_arm_before_navigation_is_valid():
    flight = Flight(config(altitude=2.0), PointMass(valid_from=4.0))
    assert flight.time_of("climb") == pytest.approx(5.0, abs=0.1)


def test_jump_in_flight_does_not_move_the_vehicle():
    """A jump of the estimate at the last waypoint leaves the landing place where it is."""
    plant = PointMass(jump=(12.0, 3.0, -2.0, 1.0))
    flight = Flight(config(altitude=6.0), plant, range_finder=False)
    assert flight.landed
    np.testing.assert_allclose(flight.position, [2.0, 0.0, 0.0], atol=0.02)


@pytest.mark.parametrize(("rotors", "ranging", "time"), [(0, 1, 1.0), (1, 1, 1.0), (0, 0, 3.0)])
def test_rotors_stop_once_on_the_ground(rotors, ranging, time):
    flight = Flight(
        config(altitude=3.0), PointMass(rotors=bool(rotors)), range_finder=bool(ranging)
    )
    down = flight.times[np.flatnonzero(flight.estimates.p_WB_z < 0.01)]
    touched = down[down > flight.status.landing_started[-1]][0]
    assert time < flight.time_of("landed") - touched < time + 0.8
    assert flight.setpoints.armed[-1] == 0.0
    assert (flight.status.landed_detected[-1], flight.status.disarmed[-1]) == (1.0, 1.0)


def test_configure_changes_the_altitude_but_not_the_routine():
    supervisor = LandingSupervisor(config(ArduPilotConfig(), altitude=10.0))
    supervisor.configure(config(ArduPilotConfig(strictness=0), altitude=6.0))
    assert supervisor.config.mission.altitude == 6.0
    with pytest.raises(StructureChangedError, match="kind"):
        supervisor.configure(config(NormalConfig()))
    with pytest.raises(StructureChangedError, match="rotor_count"):
        supervisor.configure(LandingSupervisorConfig(routine=ArduPilotConfig(), rotor_count=4))


def test_same_flight_same_bytes():
    first, second = (Flight(config(ArduPilotConfig(), altitude=3.0), PointMass()) for _ in range(2))
    assert first.setpoints[:].tobytes() == second.setpoints[:].tobytes()

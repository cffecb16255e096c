"""The SVGS routine in flight: every transition, the algorithms' setpoints, and its nodes."""

from functools import cache

import numpy as np
import pydot
import pytest
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import StructureChangedError
from systems.schedule import CLOCK_PERIOD, SUPERVISOR_PERIOD
from systems.signals.measurement import SETPOINT, VEHICLE_ESTIMATE
from systems.supervisors import svgs_routine as routine
from systems.supervisors.landing_supervisor import LandingSupervisorConfig
from systems.supervisors.mission import LANDED_TABLE, MISSION_TABLE, MissionConfig
from systems.supervisors.normal import NormalConfig
from systems.supervisors.state_machine import problems, to_dot
from systems.supervisors.svgs_commander import SvgsCommander
from systems.supervisors.svgs_guidance import SvgsGuidance
from systems.supervisors.svgs_motion_control import MEMORY, SvgsMotionControl
from systems.supervisors.svgs_px4_control import Px4Control, Px4ControlConfig
from systems.supervisors.svgs_routine import (
    COMMAND,
    FEEDBACK,
    SvgsMemory,
    SvgsRoutine,
    SvgsRoutineConfig,
)
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.supervisors.point_mass import Flight, PointMass

PAD = (0.3, -0.2)


def config(altitude=6.0, **fields) -> LandingSupervisorConfig:
    mission = MissionConfig(altitude=altitude, side=0.0, settle_time=0.0, climb_speed=3.0)
    quick = {"hover_time": 1.0, "maximum_speed": 3.0, **fields}
    return LandingSupervisorConfig(routine=SvgsRoutineConfig(**quick), mission=mission)


def fly(altitude=6.0, duration=200.0, plant=None, **fields) -> Flight:
    """A flight that starts 2 m east of a pad at `PAD`; the landing begins after about 3 s."""
    point_mass = PointMass(pad=PAD, rotors=True, **(plant or {}))
    return Flight(config(altitude, **fields), point_mass, duration, range_finder=False)


def between(start, end):
    return lambda t, z: start <= t < end


def outside(start, end):
    return lambda t, z: not start <= t < end


# Short of a minute each: small squares, small steps of time where they do not matter.
SHORT = {"first_square": 1, "square_growth": 1, "scan_wait": 1.0, "wait_time": 2.0}
FLIGHTS = {
    "lands": lambda: fly(24.0, high_descent_step=1.5),
    "never seen": lambda: fly(5.0, plant={"visible": lambda t, z: False}, **SHORT),
    "seen while scanning": lambda: fly(5.0, plant={"visible": lambda t, z: t > 6.0}, **SHORT),
    "lost aligning": lambda: fly(6.0, plant={"visible": outside(4.2, 9.0)}, **SHORT),
    "lost descending": lambda: fly(
        8.0, plant={"visible": outside(12.0, 13.5), "lost_time": 0.5}, short_height=5.0, **SHORT
    ),
    "lost, seen after relocating": lambda: fly(
        8.0, plant={"visible": outside(12.0, 15.5), "lost_time": 0.5}, short_height=5.0, **SHORT
    ),
    "lost, seen while waiting": lambda: fly(
        8.0, plant={"visible": outside(12.0, 17.5), "lost_time": 0.5}, short_height=5.0, **SHORT
    ),
    "lost for good": lambda: fly(
        8.0, plant={"visible": between(0.0, 12.0), "lost_time": 0.5}, short_height=5.0, **SHORT
    ),
    "lost, seen on the way back from the scan": lambda: fly(
        8.0, plant={"visible": outside(12.0, 31.0), "lost_time": 0.5}, short_height=5.0, **SHORT
    ),
    "lost twice": lambda: fly(
        8.0,
        plant={"visible": lambda t, z: t < 12.0 or 15.5 <= t < 23.0, "lost_time": 0.5},
        short_height=2.0,
        maximum_relocations=1,
        **SHORT,
    ),
    "lost aligning, not to relocate": lambda: fly(
        6.0, plant={"visible": outside(4.2, 9.0)}, maximum_relocations=0, **SHORT
    ),
    "lost low while aligning": lambda: fly(
        2.5, plant={"visible": between(0.0, 4.0), "lost_time": 0.5}, **SHORT
    ),
    # The pad moves away below a descent that does not follow it, as one that the wind pushes does.
    "drifting": lambda: fly(
        8.0,
        plant={"pad_velocity": (0.1, 0.0)},
        duration=60.0,
        descend_over="current",
        short_height=3.5,
    ),
}


@cache
def flight(name: str) -> Flight:
    return FLIGHTS[name]()


@pytest.mark.parametrize("name", [name for name in FLIGHTS if name != "drifting"])
def test_flight_ends_on_the_ground(name):
    flown = flight(name)
    assert flown.landed
    assert flown.position[2] == 0.0


def test_every_transition_is_taken():
    taken = set().union(*(flight(name).transitions for name in FLIGHTS))
    # Transitions of a state to itself do not show in the sequence of states.
    table = SvgsRoutine.table
    declared = {(w.source, w.target) for w in table.transitions if w.source != w.target}
    assert declared <= taken


def test_table_is_sound_and_can_be_drawn():
    guidance = SvgsGuidance(config())
    assert problems(guidance.machine.table) == []
    (graph,) = pydot.graph_from_dot_data(
        to_dot(guidance.machine.table, "svgs", SvgsRoutineConfig().routine())
    )
    assert len(graph.get_nodes()) == len(guidance.machine.table.states) + 1
    assert "Sight is lost, high enough to relocate" in guidance.states_dot()
    own = {state.name for state in SvgsRoutine.table.states}
    assert not own & {state.name for state in MISSION_TABLE.states + LANDED_TABLE.states}


def test_lands_on_the_pad_by_way_of_the_short_range_beacon():
    flown = flight("lands")
    order = ["hover", "align", "descend", "offset_to_short", "align", "descend", "final_offset",
             "land", "landed"]  # fmt: skip
    assert [s for s in flown.states if s in order] == order
    assert np.hypot(*(flown.position[:2] - PAD)) < 0.05
    x, z = flown.estimates.p_WB_x, flown.estimates.p_WB_z
    # Above 20 m over the approach point, from there to 3 m over the short-range beacon
    for state, point, height in (
        ("offset_to_short", -3.2, (19.0, 20.1)),
        ("final_offset", -1.7, (2.5, 3.1)),
    ):
        k = np.searchsorted(flown.times, flown.time_of(state))
        assert x[k] - PAD[0] == pytest.approx(point, abs=0.3)
        assert height[0] < z[k] < height[1]


def test_last_setpoint_is_below_the_ground():
    """Algorithm 6: the vehicle finds the ground on the way there, and disarms."""
    flown = flight("lands")
    landing = flown.times > flown.time_of("land") + 5.0
    assert flown.setpoints.p_WB_z[landing].min() < -4.0
    assert flown.status.disarmed[-1] == 1.0
    assert flown.setpoints.armed[-1] == 0.0


def test_never_seen_scans_growing_squares_and_lands_where_it_is():
    flown = flight("never seen")
    assert flown.states[-3:] == ["scan", "land_without_sight", "landed"]


def test_lost_for_good_lands_at_the_last_known_place():
    flown = flight("lost for good")
    search = ["relocate_xy", "relocate_xyz", "wait_for_sight", "scan"]
    assert [state for state in flown.states if state in search][:4] == search
    assert flown.states[-3:] == ["return_to_pad", "land_without_sight", "landed"]
    down = np.searchsorted(flown.times, flown.time_of("land_without_sight"))
    back = np.array([flown.estimates.p_WB_x[down], flown.estimates.p_WB_y[down]])
    point = PAD + np.array(SvgsRoutineConfig().approach_point)
    assert np.hypot(*(back - point)) < 0.5  # back there before it sinks
    assert np.hypot(*(flown.position[:2] - PAD)) < 0.05


def test_relocates_only_so_often():
    flown = flight("lost twice")
    assert flown.states.count("relocate_xy") == 1
    assert flown.states[-3:] == ["descend", "land_without_sight", "landed"]
    assert np.hypot(*(flown.position[:2] - PAD)) < 0.05


def test_relocation_returns_to_the_trusted_position():
    flown = flight("lost, seen while waiting")
    waiting = flown.time_of("wait_for_sight")
    trusted = np.searchsorted(flown.times, 12.0)
    there = np.searchsorted(flown.times, waiting)
    path = np.column_stack([flown.estimates.p_WB_x, flown.estimates.p_WB_y, flown.estimates.p_WB_z])
    assert np.linalg.norm(path[there] - path[trusted]) < 1.0
    assert flown.status.attempts[-1] >= 2.0


# -- motion control, one event at a time


class Bench:
    """Motion control with a command and an estimate given by hand."""

    def __init__(self, **fields):
        self.system = SvgsMotionControl(SvgsRoutineConfig(**fields))
        self.context = self.system.CreateDefaultContext()
        self.command = COMMAND(COMMAND.zeros())
        self.estimate = VEHICLE_ESTIMATE(VEHICLE_ESTIMATE.zeros())
        self.estimate.q_WB_w = 1.0

    def at(self, time: float, x=0.0, y=0.0, z=50.0) -> tuple[np.ndarray, float]:
        """The position asked for at `time` with the vehicle at (x, y, z), and the done flag."""
        self.estimate.p_WB_x, self.estimate.p_WB_y, self.estimate.p_WB_z = x, y, z
        self.context.SetTime(time)
        self.system.get_input_port(0).FixValue(self.context, np.asarray(self.command[:]))
        self.system.get_input_port(1).FixValue(self.context, np.asarray(self.estimate[:]))
        values = self.system.AllocateDiscreteVariables()
        values.SetFrom(self.context.get_discrete_state())
        self.system._update(self.context, values)
        self.context.SetDiscreteState(values)
        setpoint = self.system.GetOutputPort("setpoint").Eval(self.context)
        feedback = self.system.GetOutputPort("feedback").Eval(self.context)
        return setpoint[SETPOINT.slice("p_WB")].copy(), float(feedback[1])

    def begin(self, manoeuvre: int, time: float, **fields) -> None:
        self.command.manoeuvre, self.command.begun = manoeuvre, time
        for name, value in fields.items():
            setattr(self.command, name, value)


def test_algorithm_2_goes_to_and_fro_in_growing_steps():
    bench = Bench()
    bench.begin(routine.SCAN, 1.0, square_side=2.0)
    position, path, done = np.array([10.0, 5.0, 50.0]), [], 0.0
    time = 1.0
    while not done:
        position, done = bench.at(time, *position)
        path.append(position.copy())
        time += 3.0
    steps = np.diff(np.array([[10.0, 5.0, 50.0], *path]), axis=0)[:-1]
    # Facing east, left is north: rows of steps 0, 0.5, 1.0 m, then 0.5 i m ahead.
    left = [0.0, 0.5, 1.0, 0.0, 0.0, -0.5, -1.0, 0.0]
    ahead = [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(steps[:, 1], left, atol=1e-12)
    np.testing.assert_allclose(steps[:, 0], ahead, atol=1e-12)


def test_scan_sleeps_three_seconds():
    bench = Bench()
    bench.begin(routine.SCAN, 1.0, square_side=3.0)
    bench.at(1.0)
    bench.at(4.0)  # left by 0.5 m
    asleep, _ = bench.at(6.9, y=0.5)
    np.testing.assert_allclose(asleep, [0.0, 0.5, 50.0])
    awake, _ = bench.at(7.0, y=0.5)
    np.testing.assert_allclose(awake, [0.0, 1.5, 50.0])


def test_algorithm_3_asks_for_the_target_for_five_seconds():
    bench = Bench()
    bench.begin(routine.ALIGN, 2.0, aim_x=1.0, aim_y=-2.0)
    setpoint, done = bench.at(2.0, z=40.0)
    np.testing.assert_allclose(setpoint, [1.0, -2.0, 40.0])
    assert done == 0.0
    bench.command.aim_x = 1.5
    setpoint, done = bench.at(6.0, z=39.0)
    np.testing.assert_allclose(setpoint, [1.5, -2.0, 40.0])
    assert done == 0.0
    assert bench.at(7.0)[1] == 1.0


def test_algorithm_4_first_in_the_plane_then_completely():
    bench = Bench()
    trusted = {"trusted_x": 3.0, "trusted_y": 4.0, "trusted_z": 60.0}
    bench.begin(routine.RELOCATE_XY, 1.0, **trusted)
    setpoint, done = bench.at(1.0, z=50.0)
    np.testing.assert_allclose(setpoint, [3.0, 4.0, 50.0])
    assert done == 0.0
    assert bench.at(3.5, 0.0, 0.0, 50.0)[1] == 0.0  # not there yet
    assert bench.at(4.0, 2.9, 4.0, 50.0)[1] == 1.0
    bench.begin(routine.RELOCATE_XYZ, 5.0)
    setpoint, _ = bench.at(5.0, 2.9, 4.0, 50.0)
    np.testing.assert_allclose(setpoint, [3.0, 4.0, 60.0])
    assert bench.at(25.0, 0.0, 0.0, 50.0)[1] == 1.0  # it gives up in the end


def test_algorithm_5_sends_two_requests():
    bench = Bench()
    bench.begin(routine.OFFSET, 1.0, aim_x=1.5, aim_y=1.5, aim_known=1.0)
    assert bench.at(1.0)[0][0] == 1.5
    bench.command.aim_x = 1.6
    assert bench.at(3.0)[0][0] == 1.5
    setpoint, done = bench.at(3.5)
    assert (setpoint[0], done) == (1.6, 0.0)
    assert bench.at(6.0)[1] == 1.0


def test_algorithm_6_steps_down_and_ends_below_the_ground():
    bench = Bench(descend_over="current")
    bench.begin(routine.DESCEND, 1.0, aim_known=1.0)
    np.testing.assert_allclose(bench.at(1.0, 1.0, 2.0, 10.0)[0], [1.0, 2.0, 9.3])
    np.testing.assert_allclose(bench.at(1.9, 1.0, 2.5, 9.5)[0], [1.0, 2.0, 9.3])
    np.testing.assert_allclose(bench.at(2.0, 1.0, 2.5, 9.4)[0], [1.0, 2.5, 8.7])
    bench.begin(routine.LAND, 3.0, aim_x=0.5, aim_y=0.0)
    np.testing.assert_allclose(bench.at(3.0, 0.0, 0.0, 3.0)[0], [0.5, 0.0, 3.0])
    np.testing.assert_allclose(bench.at(5.1, 0.5, 0.0, 2.9)[0], [0.5, 0.0, -2.1])


def test_landing_without_a_known_place_stays_where_it_began():
    bench = Bench()
    bench.begin(routine.LAND, 0.0, aim_known=0.0)
    for time, x in ((0.0, 1.0), (2.0, 1.2), (3.5, 1.9), (5.0, 2.5)):
        setpoint, _ = bench.at(time, x, 0.0, 5.0)
    assert setpoint[0] == 1.2


def test_descent_follows_the_target():
    bench = Bench(high_descent_step=2.0)
    bench.begin(routine.DESCEND, 1.0, aim_x=3.0, aim_y=4.0, aim_z=0.0)
    np.testing.assert_allclose(bench.at(1.0, 0.0, 0.0, 60.0)[0], [3.0, 4.0, 58.0])
    np.testing.assert_allclose(bench.at(2.0, 0.0, 0.0, 19.0)[0], [3.0, 4.0, 18.3])


def test_resets_move_the_setpoint():
    bench = Bench()
    bench.begin(routine.HOLD, 1.0)
    bench.at(1.0, 1.0, 2.0, 30.0)
    bench.estimate.horizontal_reset_counter = 1.0
    bench.estimate.horizontal_reset_x, bench.estimate.horizontal_reset_y = 5.0, -5.0
    bench.estimate.vertical_reset_counter, bench.estimate.vertical_reset = 1.0, 2.0
    np.testing.assert_allclose(bench.at(1.5, 6.0, -3.0, 32.0)[0], [6.0, -3.0, 32.0])


# -- the nodes as systems


def test_topology():
    commander, motion = SvgsCommander(config()), SvgsMotionControl(SvgsRoutineConfig())
    px4 = Px4Control(Px4ControlConfig())
    for system in (commander, motion, px4, SvgsGuidance(config())):
        assert_matches_docstring(system)
    assert periodic_update(commander) == (SUPERVISOR_PERIOD, 0.0)
    assert periodic_update(motion) == (SUPERVISOR_PERIOD, 0.0)
    assert periodic_update(px4) == (CLOCK_PERIOD, 0.0)
    for system, port, layout in (
        (commander, "command", COMMAND),
        (motion, "command", COMMAND),
        (px4, "command", COMMAND),
    ):
        has = system.GetOutputPort if system is commander else system.GetInputPort
        assert has(port).size() == layout.size
    assert commander.GetInputPort("feedback").size() == FEEDBACK.size
    assert len(MEMORY.fields) == MEMORY.size


def test_command_holds_fields_of_the_memory():
    assert set(COMMAND.fields) <= set(SvgsMemory.fields())


def test_initial_output():
    guidance = SvgsGuidance(config())
    context = guidance.CreateDefaultContext()
    setpoint = SETPOINT(guidance.GetOutputPort("setpoint").Eval(context))
    assert setpoint.armed == 0.0
    assert np.isnan(setpoint.p_WB_x)


def test_px4_control_sends_at_thirty_hertz():
    system = Px4Control(Px4ControlConfig())
    context = system.CreateDefaultContext()
    sent, mission, command = [], SETPOINT.zeros(), COMMAND.zeros()
    system.get_input_port(1).FixValue(context, np.full(SETPOINT.size, 7.0))
    system.get_input_port(2).FixValue(context, command)
    for k in range(500):
        mission[0] = k
        context.SetTime(k * CLOCK_PERIOD)
        system.get_input_port(0).FixValue(context, mission)
        values = system.AllocateDiscreteVariables()
        values.SetFrom(context.get_discrete_state())
        system._update(context, values)
        context.SetDiscreteState(values)
        sent.append(system.get_output_port(0).Eval(context)[0])
    assert len(set(sent)) == pytest.approx(300, abs=1)
    # With a manoeuvre the setpoint is motion control's, armed the mission's.
    command[0] = routine.ALIGN
    system.get_input_port(2).FixValue(context, command)
    context.SetTime(20.0)
    values = system.AllocateDiscreteVariables()
    values.SetFrom(context.get_discrete_state())
    system._update(context, values)
    context.SetDiscreteState(values)
    setpoint = SETPOINT(system.get_output_port(0).Eval(context))
    assert (setpoint.p_WB_x, setpoint.armed) == (7.0, 0.0)


def test_configuration():
    builder = DiagramBuilder()
    guidance = config().add_to(builder, "guidance")
    assert isinstance(guidance, SvgsGuidance)
    guidance.configure(config(final_height=4.0))
    assert guidance.motion_control.config.final_height == 4.0
    with pytest.raises(StructureChangedError):
        guidance.configure(LandingSupervisorConfig(routine=NormalConfig()))

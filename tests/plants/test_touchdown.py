"""The judge: every verdict, the numbers of a touchdown, and the end of the simulation."""

import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from plants import multirotor_dynamics as dynamics
from plants import touchdown_judge as rules
from plants.multirotor import MultirotorConfig
from plants.pads import PadConfig
from plants.touchdown import REASONS, TouchdownConfig, TouchdownObserver
from systems.configuration import StructureChangedError
from systems.signals.measurement import BODY_STATE, PAD_STATE, SUPERVISOR_STATUS, TOUCHDOWN
from tests.system_contract import assert_matches_docstring, periodic_update

TERMINATED = SimulatorStatus.ReturnReason.kReachedTerminationCondition


class Judge:
    """The rules, fed by hand."""

    def __init__(self, **config):
        self.parameters = TouchdownConfig(**config).parameters()
        self.verdict = TOUCHDOWN.zeros()
        self.verdict[2] = -1.0
        self.memory = np.zeros(rules.MEMORY_SIZE)
        self.time = 0.0
        self.body = BODY_STATE.zeros()
        self.body[0] = 1.0
        self.pad = PAD_STATE.zeros()
        self.disarmed = False
        self.rotors = np.zeros(6)

    def look(self, height=0.2, contact=0.0, v_WB=(0, 0, 0), rotors=0.0, seconds=0.04):
        self.body[6], self.body[16], self.body[7:10], self.rotors[:] = height, contact, v_WB, rotors
        for _ in range(max(1, round(seconds / 0.04))):
            rules.judge(
                self.verdict,
                self.memory,
                self.body,
                self.pad,
                self.rotors.max(),
                self.disarmed,
                self.time,
                self.parameters,
            )
            self.time += 0.04
        return TOUCHDOWN(self.verdict)

    def fly_and_touch(self, speed=0.5, v_x=0.1):
        self.look(contact=24.5)
        self.look(height=3.0, rotors=600.0)
        self.look(height=0.21, v_WB=(v_x, 0, -speed), rotors=600.0, seconds=0.08)
        return self.look(height=0.199, contact=30.0, v_WB=(0, 0, -0.2), rotors=500.0)


class TestRules:
    def test_standing_is_no_touchdown(self):
        judge = Judge()
        assert judge.look(contact=24.5, seconds=2.0).time == -1.0
        judge.look(height=0.3, rotors=600.0)  # a hop below the airborne height
        verdict = judge.look(contact=24.5, seconds=2.0)
        assert (verdict.time, verdict.reason) == (-1.0, rules.RUNNING)

    def test_touchdown_and_rest(self):
        judge = Judge()
        verdict = judge.fly_and_touch()
        assert verdict.time == pytest.approx(0.16)
        assert verdict.vertical_speed == 0.5
        assert verdict.horizontal_speed == pytest.approx(0.1)
        assert judge.look(contact=24.5, rotors=100.0, seconds=3.0).landed == 0.0
        judge.body[4:6] = 0.3, -0.2
        assert judge.look(contact=24.5, seconds=0.48).landed == 0.0
        verdict = judge.look(contact=24.5, seconds=0.03)
        assert (verdict.landed, verdict.reason) == (1.0, rules.LANDED)
        assert (verdict.offset_x, verdict.offset_y) == (0.3, -0.2)
        frozen = judge.verdict.copy()
        judge.look(height=5.0, rotors=700.0, seconds=1.0)
        np.testing.assert_array_equal(judge.verdict, frozen)

    def test_the_reference_point_turns_with_the_body(self):
        judge = Judge(reference_point=[0.1, 0.0, -0.2])
        judge.fly_and_touch()
        judge.body[0], judge.body[3] = math.sqrt(0.5), math.sqrt(0.5)  # nose to the north
        verdict = judge.look(contact=24.5)
        assert (verdict.offset_x, verdict.offset_y) == pytest.approx((0.0, 0.1))

    def test_rest_starts_anew_after_a_disturbance(self):
        judge = Judge()
        judge.fly_and_touch()
        judge.look(contact=24.5, seconds=0.4)
        judge.look(contact=24.5, v_WB=(0.1, 0, 0))
        assert judge.look(contact=24.5, seconds=0.4).landed == 0.0
        assert judge.look(contact=24.5, seconds=0.2).landed == 1.0

    def test_going_up_again_cancels_a_touchdown(self):
        judge = Judge()
        judge.fly_and_touch(speed=0.9)
        assert judge.look(height=1.0, rotors=600.0).time == -1.0
        judge.look(height=0.21, v_WB=(0, 0, -0.3), rotors=600.0, seconds=0.08)
        verdict = judge.look(height=0.199, contact=25.0, rotors=500.0)
        assert verdict.vertical_speed == pytest.approx(0.3)

    def test_a_bounce_keeps_the_first_contact(self):
        judge = Judge()
        first = judge.fly_and_touch(speed=0.9).time
        judge.look(height=0.25, v_WB=(0, 0, 0.2), rotors=300.0)
        verdict = judge.look(contact=25.0, rotors=200.0)
        assert (verdict.time, verdict.vertical_speed) == (first, 0.9)

    def test_speeds_and_offset_are_relative_to_a_moving_raised_pad(self):
        judge = Judge()
        judge.pad[:] = PadConfig(
            position=[5.0, 0.0, 1.0], velocity=[0.4, 0.0, 0.0], side=1.2
        ).state(0.0)
        judge.body[4:6] = 5.2, 0.1
        judge.look(height=4.0, rotors=600.0)
        judge.look(height=1.21, v_WB=(0.4, 0.3, -0.5), rotors=600.0)
        verdict = judge.look(height=1.199, contact=25.0, v_WB=(0.4, 0, 0), rotors=600.0)
        assert verdict.horizontal_speed == pytest.approx(0.3)
        assert (verdict.offset_x, verdict.offset_y) == pytest.approx((0.2, 0.1))
        assert judge.look(height=1.2, contact=25.0, v_WB=(0.4, 0, 0), seconds=0.6).landed == 1.0

    def test_crashes(self):
        assert Judge().fly_and_touch(speed=3.1).reason == rules.HIT_HARD
        judge = Judge()
        judge.fly_and_touch()
        half = math.radians(70.0) / 2
        judge.body[:4] = math.cos(half), math.sin(half), 0.0, 0.0
        assert judge.look(contact=10.0, rotors=500.0).reason == rules.TILTED
        judge = Judge()
        judge.look(height=3.0, rotors=600.0)
        judge.disarmed = True
        assert judge.look(height=2.5, rotors=300.0).reason == rules.RUNNING
        assert judge.look(height=2.0).reason == rules.STOPPED_IN_THE_AIR
        assert judge.verdict[0] == 0.0

    def test_limits(self):
        judge = Judge(time_limit=1.0)
        assert judge.look(contact=24.5, seconds=2.0).reason == rules.NEVER_TOOK_OFF
        judge = Judge(time_limit=1.0)
        assert judge.look(height=3.0, rotors=600.0, seconds=2.0).reason == rules.TIME_LIMIT_FLYING
        judge = Judge(time_limit=1.0)
        judge.fly_and_touch()
        verdict = judge.look(contact=24.5, rotors=100.0, seconds=2.0)
        assert verdict.reason == rules.TIME_LIMIT_NOT_AT_REST
        for place in ((250.0, 0.0, 20.0), (0.0, 0.0, 300.0)):
            judge = Judge()
            judge.body[4:6] = place[:2]
            assert judge.look(height=place[2], rotors=600.0).reason == rules.LEFT_THE_ARENA

    def test_every_code_has_its_words(self):
        codes = {v for k, v in vars(rules).items() if k.isupper() and k in CODES}
        assert codes == set(REASONS) == set(range(9))
        assert len(set(REASONS.values())) == 9


CODES = (
    "RUNNING",
    "LANDED",
    "TILTED",
    "HIT_HARD",
    "STOPPED_IN_THE_AIR",
    "TIME_LIMIT_FLYING",
    "TIME_LIMIT_NOT_AT_REST",
    "NEVER_TOOK_OFF",
    "LEFT_THE_ARENA",
)


def falling(start: MultirotorConfig, config: TouchdownConfig, supervisor=None, pad=None):
    """A multirotor without commands under the judge's eyes."""
    builder = DiagramBuilder()
    multirotor = start.add_to(builder, "multirotor")
    observer = config.add_to(builder, "touchdown", seed=1)
    silence = builder.AddSystem(ConstantVectorSource(np.zeros(start.rotor_count)))
    builder.Connect(silence.get_output_port(), multirotor.GetInputPort("rotor_commands"))
    for port in ("body", "rotor_speeds"):
        builder.Connect(multirotor.GetOutputPort(port), observer.GetInputPort(port))
    for name, value in (("supervisor", supervisor), ("pad", pad)):
        if value is not None:
            source = builder.AddSystem(ConstantVectorSource(value))
            builder.Connect(source.get_output_port(), observer.GetInputPort(name))
    return builder.Build(), multirotor, observer


def verdict_of(observer, simulator):
    context = observer.GetMyContextFromRoot(simulator.get_context())
    return TOUCHDOWN(observer.GetOutputPort("touchdown").Eval(context).copy())


class TestSystem:
    def test_topology(self):
        observer = TouchdownObserver(TouchdownConfig(), seed=1)
        assert assert_matches_docstring(observer).optional == {"pad", "supervisor"}
        assert periodic_update(observer) == (0.04, 0.0)
        eight = TouchdownObserver(TouchdownConfig(rotor_count=8))
        assert eight.GetInputPort("rotor_speeds").size() == 8

    def test_initial_state(self):
        observer = TouchdownObserver(TouchdownConfig())
        context = observer.CreateDefaultContext()
        verdict = TOUCHDOWN(observer.GetOutputPort("touchdown").Eval(context))
        assert (verdict.reason, verdict.landed, verdict.time) == (rules.RUNNING, 0.0, -1.0)

    def test_a_fall_from_a_third_of_a_metre_is_a_landing_and_ends_the_simulation(self):
        start = MultirotorConfig(position=[0.5, -0.2, 0.34], flying=True)
        diagram, _, observer = falling(start, TouchdownConfig())
        simulator = Simulator(diagram)
        status = simulator.AdvanceTo(30.0)
        assert status.reason() == TERMINATED
        assert "landed" in status.FormatMessage()
        verdict = verdict_of(observer, simulator)
        assert verdict.landed == 1.0
        assert verdict.time + 0.5 < simulator.get_context().get_time() < 3.0
        assert (verdict.offset_x, verdict.offset_y) == pytest.approx((0.5, -0.2), abs=0.01)

    @pytest.mark.parametrize("height", [0.31, 0.33, 0.35, 0.4, 0.5])
    def test_the_speed_of_a_fall_is_that_at_first_contact(self, height: float):
        """Whatever the phase of the looks: against the same fall in steps of 0.1 ms."""
        start = MultirotorConfig(position=[0.0, 0.0, height], flying=True)
        diagram, _, observer = falling(start, TouchdownConfig())
        simulator = Simulator(diagram)
        simulator.AdvanceTo(1.0)
        verdict = verdict_of(observer, simulator)
        body, speeds = start.initial_body(), start.initial_rotor_speeds()
        parameters = start.resolved_vehicle().parameters()
        while body[16] == 0.0:
            fall = body[9]
            dynamics.integrate(
                body, speeds, np.zeros(6), np.zeros(3), PAD_STATE.zeros(), parameters,
                1e-4, 1, True,
            )  # fmt: skip
        assert verdict.time >= 0.0
        assert verdict.vertical_speed == pytest.approx(-fall, abs=0.05)

    def test_a_fall_from_two_metres_is_a_crash(self):
        start = MultirotorConfig(position=[0.0, 0.0, 2.0], flying=True)
        diagram, _, observer = falling(start, TouchdownConfig())
        simulator = Simulator(diagram)
        assert simulator.AdvanceTo(30.0).reason() == TERMINATED
        assert verdict_of(observer, simulator).reason == rules.HIT_HARD

    def test_a_disarmed_vehicle_in_the_air_has_crashed(self):
        status = SUPERVISOR_STATUS.zeros()
        status[SUPERVISOR_STATUS.index("disarmed")] = 1.0
        start = MultirotorConfig(position=[0.0, 0.0, 2.0], flying=True)
        diagram, _, observer = falling(start, TouchdownConfig(), status, PAD_STATE.zeros())
        simulator = Simulator(diagram)
        simulator.AdvanceTo(30.0)
        assert verdict_of(observer, simulator).reason == rules.STOPPED_IN_THE_AIR

    def test_the_time_limit_ends_a_run_that_never_took_off(self):
        diagram, _, observer = falling(MultirotorConfig(), TouchdownConfig(time_limit=0.3))
        simulator = Simulator(diagram)
        status = simulator.AdvanceTo(30.0)
        assert status.reason() == TERMINATED
        assert 0.3 <= simulator.get_context().get_time() < 0.5
        assert verdict_of(observer, simulator).reason == rules.NEVER_TOOK_OFF

    def test_configure(self):
        diagram, _, observer = falling(MultirotorConfig(), TouchdownConfig())
        observer.configure(TouchdownConfig(time_limit=0.2))
        simulator = Simulator(diagram)
        assert simulator.AdvanceTo(1.0).reason() == TERMINATED
        with pytest.raises(StructureChangedError, match="rotor_count"):
            observer.configure(TouchdownConfig(rotor_count=4))

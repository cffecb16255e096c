"""The phases: the table is sound, and each transition happens for its reason."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from systems.signals.runway_measurement import (
    FIX,
    GUIDANCE,
    LASER_HEIGHT,
    NAVIGATION_ESTIMATE,
    PICTURE,
    WHEEL_SPEED,
)
from systems.supervisors.runway_phases import TABLE, Phase, RunwayPhases, RunwayPhasesConfig
from systems.supervisors.state_machine import problems, to_dot
from tests.runway_bench import assert_contract
from tests.system_contract import periodic_update


def test_topology():
    phases = RunwayPhases(RunwayPhasesConfig())
    assert_contract(phases)
    assert periodic_update(phases) == (0.04, 0.0)


def test_table_is_sound_and_named_like_the_enumeration():
    assert problems(TABLE) == []
    assert [state.name.upper() for state in TABLE.states] == [phase.name for phase in Phase]
    assert "Weight on wheels" in to_dot(TABLE, "phases", RunwayPhases)


class Situation:
    """The supervisor between inputs that a test changes."""

    def __init__(self, config=None):
        builder = DiagramBuilder()
        self.system = builder.AddSystem(RunwayPhases(config or RunwayPhasesConfig()))
        self.sources = {}
        for name, layout in (
            ("estimate", NAVIGATION_ESTIMATE),
            ("guidance", GUIDANCE),
            ("fix", FIX),
            ("laser", LASER_HEIGHT),
            ("picture", PICTURE),
            ("wheel_speed", WHEEL_SPEED),
        ):
            source = builder.AddSystem(ConstantVectorSource(np.zeros(layout.size)))
            builder.Connect(source.get_output_port(), self.system.GetInputPort(name))
            self.sources[name] = source
        self.simulator = Simulator(builder.Build())
        self.set("estimate", 2, 5000.0)

    def set(self, name, index, value):
        root = self.simulator.get_mutable_context()
        context = self.sources[name].GetMyMutableContextFromRoot(root)
        self.sources[name].get_mutable_source_value(context)[index] = value

    def after(self, seconds) -> Phase:
        time = self.simulator.get_context().get_time()
        self.simulator.AdvanceTo(time + seconds)
        context = self.system.GetMyContextFromRoot(self.simulator.get_context())
        return Phase(int(self.system.get_output_port().Eval(context)[0]))


def test_a_whole_landing():
    now = Situation()
    now.set("fix", 3, 1.0)
    now.set("fix", 0, 1.0)
    assert now.after(1.0) == Phase.STANDBY
    now.set("fix", 3, 0.0)
    assert now.after(1.5) == Phase.STANDBY  # the loss has to be confirmed
    assert now.after(1.0) == Phase.RETURN
    now.set("laser", 3, 1.0)
    assert now.after(0.5) == Phase.RETURN  # the laser alone makes no final
    now.set("laser", 3, 0.0)
    now.set("guidance", 1, 1.0)
    assert now.after(0.1) == Phase.FINAL
    now.set("picture", 3, 1.0)
    now.set("laser", 3, 1.0)
    assert now.after(0.1) == Phase.FINAL_WITH_LASER
    now.set("estimate", 2, 99.0)
    assert now.after(0.1) == Phase.SHORT_FINAL
    now.set("wheel_speed", 3, 1.0)
    now.set("wheel_speed", 4, 30.0)
    assert now.after(0.1) == Phase.BRAKING
    now.set("wheel_speed", 4, 0.0)
    assert now.after(5.0) == Phase.STANDSTILL
    assert now.simulator.get_context().get_time() < 7.0  # it ended by itself


@pytest.mark.parametrize(
    ("distance", "expected"), [(200.0, Phase.SHORT_FINAL), (900.0, Phase.FINAL)]
)
def test_a_lost_tracker_ends_the_final_only_when_near(distance, expected):
    now = Situation()
    now.set("guidance", 1, 1.0)
    now.set("picture", 3, 1.0)
    assert now.after(3.0) == Phase.FINAL
    now.set("estimate", 2, distance)
    assert now.after(0.5) == Phase.FINAL
    now.set("picture", 3, 0.0)
    assert now.after(2.0) == expected


def test_without_laser_there_is_no_final_with_laser():
    now = Situation(RunwayPhasesConfig(use_laser=False))
    now.set("guidance", 1, 1.0)
    now.set("laser", 3, 1.0)
    assert now.after(4.0) == Phase.FINAL


def test_weight_on_wheels_counts_in_every_phase_of_the_air():
    now = Situation()
    assert now.after(3.0) == Phase.RETURN
    now.set("wheel_speed", 3, 1.0)
    now.set("wheel_speed", 4, 30.0)
    assert now.after(0.1) == Phase.BRAKING

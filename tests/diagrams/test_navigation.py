"""Three inertial sensors, three EKF2 instances, one estimate."""

import numpy as np
import pytest

from diagrams.loading import ScenarioError, load_scenario
from diagrams.navigation import RedundantNavigation
from runs.logs import port_samples
from runs.run import Laboratory
from systems.configuration import StructureChangedError
from systems.estimators.ekf2.ekf2 import Ekf2Config
from systems.estimators.ekf2_selector import Ekf2SelectorConfig
from tests.system_contract import assert_matches_docstring

LOW = {"fidelity": "geometric", "guidance.mission.altitude": 12.0, "time_limit": 200.0}


def test_topology():
    assert_matches_docstring(RedundantNavigation(Ekf2Config(), Ekf2SelectorConfig()))


def test_scenario_starts_with_three_filters():
    laboratory = Laboratory(load_scenario("svgs-three-imus", LOW))
    simulator = laboratory.start()
    simulator.AdvanceTo(1.0 / 16.0)
    assert len(laboratory.landing.navigation.instances) == 3
    assert laboratory.landing.state(simulator.get_context()) == "wait"


def test_each_instance_has_its_own_sensor():
    laboratory = Laboratory(load_scenario("svgs-three-imus", LOW))
    simulator = laboratory.start()
    simulator.AdvanceTo(4.0)
    context = simulator.get_context()
    states = [
        instance.GetOutputPort("delayed_state").Eval(instance.GetMyContextFromRoot(context))
        for instance in laboratory.landing.navigation.instances
    ]
    assert not np.array_equal(states[0], states[1])
    assert not np.array_equal(states[1], states[2])


def test_as_many_instances_as_sensors():
    with pytest.raises(ScenarioError, match=r"selector.instances is 2, .* imu, imu_2, imu_3"):
        Laboratory(load_scenario("svgs-three-imus", {**LOW, "selector.instances": 2}))


def test_one_filter_cannot_become_three():
    laboratory = Laboratory(load_scenario("svgs-high-altitude", LOW))
    with pytest.raises(StructureChangedError):
        laboratory.configure(load_scenario("svgs-three-imus", LOW))


@pytest.mark.slow
def test_a_change_of_instance_moves_setpoint_and_estimate_but_not_the_vehicle():
    # The low flight is short, so the sensor gets worse faster.
    worse = {**LOW, "sensors.imu.accelerometer_bias_walk": 0.03}
    laboratory = Laboratory(load_scenario("svgs-three-imus", worse))
    simulator = laboratory.start()
    result = laboratory.fly(simulator)
    assert result.landed, result.reason
    assert result.landing_error_m < 0.5
    log = laboratory.log(simulator.get_context())
    instance = port_samples(log, "instance")
    samples = {name: port_samples(log, name) for name in ("estimate", "setpoint", "body")}

    def step(name: str, time: float) -> np.ndarray:
        """How far a position moves from before a change until after it."""
        at = samples[name]["time"]
        before, after = np.searchsorted(at, [time - 1e-6, time + 0.1]) - [1, 0]
        return np.array(
            [samples[name][f"p_WB_{a}"][after] - samples[name][f"p_WB_{a}"][before] for a in "xyz"]
        )

    changes = instance["time"][1:][np.diff(instance["selected"]) != 0]
    jumps, followed = [], []
    for time in changes:
        jump, setpoint = step("estimate", time), step("setpoint", time)
        if np.isfinite(setpoint).all():  # before that the vehicle stands on the ground
            jumps.append(np.hypot(*jump[:2]))
            followed.append(np.hypot(*(setpoint - jump)[:2]))
            assert np.linalg.norm(step("body", time)) < 0.15
    assert max(jumps) > 0.15
    # The target's newest estimate moves the setpoint, too, so it is not the same to the millimetre.
    assert np.median(followed) < 0.5 * np.median(jumps)

"""The landing-target estimators behind their one interface, in a simulation."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from systems.estimators.ardupilot_target import ArduPilotTargetConfig
from systems.estimators.fused_sensor import FusedSensorConfig
from systems.estimators.px4_target import PX4TargetConfig, PX4VisionTargetConfig
from tests.system_contract import assert_matches_docstring
from tests.systems.estimators.target_cases import Scene, Sway, field, horizontal_error, simulate

CONFIGS = [ArduPilotTargetConfig, PX4TargetConfig, PX4VisionTargetConfig]
AT_ORIGIN = {"infrared_position": [0.0, 0.0, 0.0], "marker_position": [0.0, 0.0, 0.0]}


@pytest.mark.parametrize("config", CONFIGS)
def test_topology(config):
    assert_matches_docstring(config().add_to(DiagramBuilder(), "target_estimator"))


@pytest.mark.parametrize("config", CONFIGS)
def test_one_failing_sensor_is_survived_by_the_fused_one(config):
    """Marker until 4 s, infrared alone afterwards: the thesis's complementary failures."""
    sway = Sway(amplitude=(0.3, -0.2))
    front_end = FusedSensorConfig(mode="fused", **AT_ORIGIN)
    scene = Scene(sway, marker_until=4.0, infrared_until=8.0)
    times, targets = simulate(config(front_end=front_end), scene, 7.9)
    settled = times > 2.5
    assert field(targets, "acquired")[settled].all()
    assert np.abs(horizontal_error(times, targets, sway)[settled]).max() < 0.08
    assert field(targets, "source")[(times > 2.5) & (times < 4.0)].min() == 3.0
    assert field(targets, "source")[times > 4.1].max() == 1.0


@pytest.mark.parametrize("config", CONFIGS)
def test_the_failing_sensor_alone_loses_the_target(config):
    front_end = FusedSensorConfig(mode="marker", **AT_ORIGIN)
    scene = Scene(Sway(), marker_until=4.0, infrared_until=8.0)
    times, targets = simulate(config(front_end=front_end), scene, 7.9)
    acquired = field(targets, "acquired")
    assert acquired[(times > 2.5) & (times < 5.9)].all()
    assert not acquired[times > 6.2].any()


@pytest.mark.parametrize("config", CONFIGS)
def test_configure_reaches_front_end_and_filter(config):
    """A re-used estimator answers as a new one."""
    sway = Sway(amplitude=(0.3, -0.2))
    wanted = config(front_end=FusedSensorConfig(mode="infrared", **AT_ORIGIN), lost_time=1.0)

    class Reused(config):
        def add_to(self, builder, name, seed=0):
            estimator = super().add_to(builder, name, seed)
            estimator.configure(wanted, seed)
            return estimator

    answers = [
        simulate(made, Scene(sway, marker_until=1.0, infrared_until=3.0), 5.0)[1]
        for made in (wanted, Reused())
    ]
    np.testing.assert_array_equal(*answers)
    assert field(answers[0], "acquired").any()
    assert not field(answers[0], "acquired")[-1]

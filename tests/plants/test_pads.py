"""The pad: its motion, its port, and the geometry of what can be seen on it."""

import math

import cv2
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from plants.pads import MARKER_DICTIONARY, MarkerLevelConfig, NestedMarkerConfig, Pad, PadConfig
from systems.configuration import StructureChangedError
from systems.signals.measurement import PAD_STATE, SUPERVISOR_STATUS
from tests.system_contract import assert_matches_docstring

MOTIONS = {
    "straight": {"velocity": [0.4, -0.2, 0.1], "yaw_rate": 0.3},
    "circle": {"circle_radius": 3.0, "circle_speed": 1.5},
    "heave": {"heave_amplitude": 0.4, "heave_period": 5.0},
    "ferry": {
        "velocity": [1.0, 0.0, 0.0],
        "circle_radius": 2.0,
        "circle_speed": 0.5,
        "heave_amplitude": 0.2,
        "motion_start": 2.0,
    },
}


def pad_at(config, time):
    pad = Pad(config)
    context = pad.CreateDefaultContext()
    context.SetTime(time)
    return pad.GetOutputPort("pad").Eval(context)


def test_topology():
    pad = Pad(PadConfig(), seed=1)
    assert_matches_docstring(pad)
    assert pad.num_discrete_state_groups() == 0


def test_at_rest_by_default():
    config = PadConfig(position=[1.0, 2.0, 0.5], yaw=0.7, side=1.5)
    for time in (0.0, 33.0):
        state = PAD_STATE(pad_at(config, time))
        assert (state.p_WP_x, state.p_WP_y, state.p_WP_z) == (1.0, 2.0, 0.5)
        assert (state.yaw, state.side, state.v_WP_x, state.yaw_rate) == (0.7, 1.5, 0.0, 0.0)
    assert not config.moves


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_velocity_is_the_rate_of_the_position(motion):
    config = PadConfig(position=[1.0, -1.0, 0.3], yaw=0.2, **motion)
    assert config.moves
    step = 1e-5
    for time in (2.5, 7.0, 19.0):
        rate = (pad_at(config, time + step) - pad_at(config, time - step)) / (2.0 * step)
        state = pad_at(config, time)
        np.testing.assert_allclose(rate[0:3], state[4:7], atol=1e-7)
        assert rate[3] == pytest.approx(state[7], abs=1e-7)
    start = pad_at(config, 0.0)
    np.testing.assert_allclose(start[:4], [1.0, -1.0, 0.3, 0.2], atol=1e-12)


def test_motion_begins_when_it_should():
    config = PadConfig(**MOTIONS["ferry"])
    np.testing.assert_array_equal(pad_at(config, 1.9)[4:8], 0.0)
    assert np.linalg.norm(pad_at(config, 2.1)[4:7]) > 1.0


def test_the_landing_sets_it_off():
    pad = Pad(PadConfig(velocity=[2.0, 0.0, 0.0], motion_from="landing", motion_start=1.0))
    context = pad.CreateDefaultContext()
    context.SetTime(40.0)
    status = SUPERVISOR_STATUS.zeros()
    for landing_started, moved in ((-1.0, 0.0), (39.5, 0.0), (30.0, 18.0)):
        status[SUPERVISOR_STATUS.index("landing_started")] = landing_started
        pad.GetInputPort("supervisor").FixValue(context, status)
        state = pad.GetOutputPort("pad").Eval(context)
        assert (state[0], state[4]) == (moved, 2.0 if moved else 0.0)


def test_a_circle_comes_back():
    config = PadConfig(circle_radius=3.0, circle_speed=1.5)
    round_trip = 2.0 * math.pi * 3.0 / 1.5
    np.testing.assert_allclose(pad_at(config, round_trip), pad_at(config, 0.0), atol=1e-9)
    np.testing.assert_allclose(pad_at(config, round_trip / 2)[:3], [0.0, 6.0, 0.0], atol=1e-9)


def test_a_simulation_sees_it_move():
    pad = Pad(PadConfig(velocity=[0.5, 0.0, 0.0]))
    simulator = Simulator(pad)
    for time in (1.0, 2.0):
        simulator.AdvanceTo(time)
        assert pad.GetOutputPort("pad").Eval(simulator.get_context())[0] == 0.5 * time


def test_configure():
    pad = Pad(PadConfig())
    pad.configure(PadConfig(position=[5.0, 0.0, 0.0]))
    assert pad.GetOutputPort("pad").Eval(pad.CreateDefaultContext())[0] == 5.0
    assert pad.config.position[0] == 5.0
    with pytest.raises(StructureChangedError, match="moves"):
        pad.configure(PadConfig(velocity=[1.0, 0.0, 0.0]))


class TestNestedMarker:
    def test_corners_are_those_of_the_upright_marker(self):
        corners = NestedMarkerConfig().corners()
        assert corners.shape == (3, 4, 3)
        np.testing.assert_allclose(
            corners[0, :, :2], [[-0.4, 0.4], [0.4, 0.4], [0.4, -0.4], [-0.4, -0.4]]
        )

    def test_each_level_fits_into_the_white_middle_of_its_parent(self):
        marker = NestedMarkerConfig()
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARY))
        for level in marker.levels:
            cells = cv2.aruco.generateImageMarker(dictionary, level.id, 6) > 127
            assert cells[2:4, 2:4].all(), level.id
        cell = marker.sides()[:-1] / 6.0
        assert (marker.sides()[1:] < 2.0 * cell).all()
        np.testing.assert_array_equal(marker.ids(), [16, 45, 59])

    def test_ids_are_checked(self):
        with pytest.raises(ValueError, match="id"):
            MarkerLevelConfig(id=100, side=0.1)
        with pytest.raises(ValueError, match="levels"):
            NestedMarkerConfig(levels=[])

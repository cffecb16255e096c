"""The exposure: poses taken back to its middle, the smear, and when frames are due."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import BODY_STATE, PAD_STATE
from systems.vision.exposure import (
    EXPOSURE,
    SMEAR,
    expose,
    is_due,
    pad_in_camera,
    quaternion_of_mount,
)
from systems.vision.pinhole import camera_mount
from tests.systems.vision.pad_views import CAMERA, pad_pose, projected, rng

EXPOSURE_TIME = 0.01  # s
X_BC = camera_mount([0.12, -0.05, -0.08], yaw=0.4)


def moving_body(random: np.random.Generator) -> np.ndarray:
    body = BODY_STATE.zeros()
    attitude = Rotation.from_rotvec(random.normal(0, [0.1, 0.1, 1.0]))
    body[BODY_STATE.slice("q_WB")] = np.roll(attitude.as_quat(), 1)
    body[BODY_STATE.slice("p_WB")] = [*random.uniform(-0.3, 0.3, 2), random.uniform(2, 5)]
    body[BODY_STATE.slice("v_WB")] = random.normal(0, 1.0, 3)
    body[BODY_STATE.slice("w_WB_B")] = random.normal(0, 0.5, 3)
    return body


def moving_pad(random: np.random.Generator) -> np.ndarray:
    pad = PAD_STATE.zeros()
    pad[:3] = random.normal(0, 0.1, 3)
    pad[PAD_STATE.index("yaw")] = random.uniform(-3, 3)
    pad[PAD_STATE.slice("v_WP")] = random.normal(0, 0.5, 3)
    pad[PAD_STATE.index("yaw_rate")] = 0.3
    return pad


def exposed(body, pad, exposure_time=EXPOSURE_TIME) -> np.ndarray:
    exposure = EXPOSURE.zeros()
    expose(body, pad, X_BC, CAMERA, exposure_time, exposure)
    return exposure


def later(body: np.ndarray, pad: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Both carried on by dt at constant velocity, by scipy."""
    body, pad = body.copy(), pad.copy()
    attitude = Rotation.from_quat(np.roll(body[:4], -1))
    turn = Rotation.from_rotvec(dt * body[BODY_STATE.slice("w_WB_B")])
    body[:4] = np.roll((attitude * turn).as_quat(), 1)
    body[BODY_STATE.slice("p_WB")] += dt * body[BODY_STATE.slice("v_WB")]
    pad[:3] += dt * pad[PAD_STATE.slice("v_WP")]
    pad[PAD_STATE.index("yaw")] += dt * pad[PAD_STATE.index("yaw_rate")]
    return body, pad


@pytest.mark.parametrize("seed", range(5))
def test_the_pose_is_that_of_the_middle(seed):
    random = rng(seed)
    body, pad = moving_body(random), moving_pad(random)
    exposure = exposed(*later(body, pad, 0.5 * EXPOSURE_TIME))
    R_WB = Rotation.from_quat(np.roll(body[:4], -1)).as_matrix()
    R_WC = Rotation.from_quat(np.roll(exposure[:4], -1)).as_matrix()
    np.testing.assert_allclose(R_WC, R_WB @ X_BC[:, :3], atol=1e-12)
    p_WC = body[BODY_STATE.slice("p_WB")] + R_WB @ X_BC[:, 3]
    np.testing.assert_allclose(exposure[EXPOSURE.slice("p_WC")], p_WC, atol=1e-12)
    np.testing.assert_allclose(exposure[EXPOSURE.slice("p_WP")], pad[:3], atol=1e-12)
    assert exposure[EXPOSURE.index("yaw")] == pytest.approx(pad[PAD_STATE.index("yaw")])


@pytest.mark.parametrize("seed", range(5))
def test_the_smear_is_the_way_of_the_pad_s_image(seed):
    """Against the projected centre a little before and after, without distortion."""
    random = rng(seed)
    body, pad = moving_body(random), moving_pad(random)
    dt = 1e-5
    before, after = (
        projected(np.zeros((1, 3)), exposed(*later(body, pad, t), 0.0), (0, 0, 0, 0))[0]
        for t in (-dt, dt)
    )
    smear = exposed(body, pad, 1e-9)[SMEAR] / 1e-9
    np.testing.assert_allclose(smear, (after - before) / (2 * dt), rtol=1e-4, atol=0.05)


def test_smear_of_the_ground_below_when_the_pad_is_out_of_sight():
    """At height h and speed v the ground on the axis moves at f v / h."""
    body = BODY_STATE.zeros()
    body[0] = 1.0
    body[BODY_STATE.slice("p_WB")] = [50.0, 0.0, 2.0]
    body[BODY_STATE.slice("v_WB")] = [1.0, 0.0, 0.0]
    exposure = EXPOSURE.zeros()
    expose(body, PAD_STATE.zeros(), camera_mount([0, 0, 0]), CAMERA, 0.01, exposure)
    # The body moves forward, up in the image: the ground goes down in it.
    np.testing.assert_allclose(exposure[SMEAR], [0.0, 0.01 * 530.0 / 2.0], atol=1e-9)


def test_pad_in_camera():
    random = rng(7)
    exposure = exposed(moving_body(random), moving_pad(random))
    R_CP, p_CP = pad_in_camera(exposure)
    R_expected, p_expected = pad_pose(exposure)
    np.testing.assert_allclose(R_CP, R_expected, atol=1e-12)
    np.testing.assert_allclose(p_CP, p_expected, atol=1e-12)


@pytest.mark.parametrize("yaw", np.linspace(-np.pi, np.pi, 9))
def test_quaternion_of_mount(yaw):
    X = camera_mount([0, 0, 0], yaw)
    q = quaternion_of_mount(X)
    np.testing.assert_allclose(Rotation.from_quat(np.roll(q, -1)).as_matrix(), X[:, :3], atol=1e-12)


@pytest.mark.parametrize("rate", [30.0, 45.0, 50.0, 7.0])
def test_the_rate_is_kept_on_average(rate):
    ticks = CLOCK_PERIOD * np.arange(5_000)
    due = ticks[[is_due(t, rate) for t in ticks]]
    assert due[0] == 0.0
    assert len(due) == pytest.approx(rate * 100.0, abs=1)
    # Each frame is the first tick at or after its nominal time.
    np.testing.assert_array_less(
        np.abs(due - np.arange(len(due)) / rate - CLOCK_PERIOD / 2), CLOCK_PERIOD / 2 + 1e-5
    )

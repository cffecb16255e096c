"""The collinearity equations: derivatives, solution, bound, level pose."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from plants.svgs_beacons import BEACON_NAMES, SvgsBeaconsConfig
from systems.vision.pinhole import pinhole_camera
from systems.vision.planar_pose import quaternion_from_matrix
from systems.vision.svgs_pose import (
    ANGLES,
    angles_of_pixels,
    cramer_rao,
    level_frame,
    level_pose,
    moved,
    predict,
    solve_pose,
)

FOCAL_LENGTH = 604.0  # px
LEDS = SvgsBeaconsConfig().led_positions()
# Beacon, range (m) and the bound of the range at 0.1 px (%), each within its operating range
CASES = [(0, 20.0, 0.42), (1, 85.0, 0.91), (2, 200.0, 0.29)]


def pose_at(distance: float, x: float = 1.0, y: float = -2.0) -> np.ndarray:
    """A beacon below a camera that looks down, a little tilted and turned."""
    R_CT = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    pose = np.array([x, y, distance, *quaternion_from_matrix(R_CT)])
    return moved(pose, np.array([0.0, 0.0, 0.0, 0.05, -0.03, 0.4]))


def projected(leds: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Azimuth and elevation by scipy's rotations and the definition, shape (8,)."""
    R_CT = Rotation.from_quat(pose[[4, 5, 6, 3]])
    p_C = pose[:3] + R_CT.apply(leds)
    azimuth = np.arctan(p_C[:, 0] / p_C[:, 2])
    elevation = np.arcsin(p_C[:, 1] / np.linalg.norm(p_C, axis=1))
    return np.column_stack([azimuth, elevation]).ravel()


@pytest.mark.parametrize("beacon", range(3), ids=BEACON_NAMES)
def test_prediction_and_its_derivatives(beacon):
    pose = pose_at(30.0)
    angles, jacobian = np.empty(ANGLES), np.empty((ANGLES, 6))
    assert predict(LEDS[beacon], pose, angles, jacobian)
    np.testing.assert_allclose(angles, projected(LEDS[beacon], pose), atol=1e-12)
    step = 1e-5
    for k in range(6):
        change = np.zeros(6)
        change[k] = step
        ahead = projected(LEDS[beacon], moved(pose, change))
        back = projected(LEDS[beacon], moved(pose, -change))
        np.testing.assert_allclose(jacobian[:, k], (ahead - back) / (2 * step), atol=1e-8)


def test_nothing_is_seen_behind_the_camera():
    angles, jacobian = np.empty(ANGLES), np.empty((ANGLES, 6))
    assert not predict(LEDS[0], pose_at(-5.0), angles, jacobian)
    with pytest.raises(ValueError, match="behind"):
        cramer_rao(LEDS[0], pose_at(-5.0), 1e-4)


@pytest.mark.parametrize(("beacon", "distance", "bound"), CASES)
def test_solution_reaches_the_cramer_rao_bound(beacon, distance, bound):
    noise = 0.1 / FOCAL_LENGTH
    leds, pose = LEDS[beacon], pose_at(distance)
    covariance_bound = cramer_rao(leds, pose, noise)
    sigma = np.sqrt(np.diag(covariance_bound))
    # The bounds that were measured when the paper's beacons were first studied, at 67 deg of view
    assert 100.0 * sigma[2] / distance == pytest.approx(bound, rel=0.15)
    rng = np.random.default_rng(1)
    true = projected(leds, pose)
    errors, residuals = [], []
    covariance = np.empty((6, 6))
    for _ in range(400):
        guess = moved(pose, np.concatenate([rng.normal(0.0, 0.05 * distance, 3), np.zeros(3)]))
        residuals.append(solve_pose(leds, true + noise * rng.normal(size=8), guess, covariance))
        errors.append(guess[:3] - pose[:3])
    normalised = np.array(errors) / sigma[:3]
    assert np.abs(normalised.mean(axis=0)).max() < 0.25
    np.testing.assert_allclose(normalised.std(axis=0), 1.0, atol=0.12)
    np.testing.assert_allclose(noise**2 * covariance[:3, :3], covariance_bound[:3, :3], rtol=0.2)
    # Eight angles less six unknowns
    assert np.mean(np.square(residuals)) == pytest.approx(noise**2 * 2.0 / 8.0, rel=0.2)


def test_solution_is_that_of_scipy():
    rng = np.random.default_rng(2)
    pose = pose_at(60.0)
    measured = projected(LEDS[1], pose) + 1e-3 * rng.normal(size=8)

    def residual(step):
        return projected(LEDS[1], moved(pose, step)) - measured

    reference = least_squares(residual, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    solution = pose.copy()
    rms = solve_pose(LEDS[1], measured, solution, np.empty((6, 6)))
    np.testing.assert_allclose(solution, moved(pose, reference.x), atol=1e-4)
    assert rms == pytest.approx(np.sqrt(np.mean(reference.fun**2)), rel=1e-6)


def test_angles_of_pixels():
    camera = pinhole_camera(800, 800, FOCAL_LENGTH)
    angles = np.empty(2)
    angles_of_pixels(camera, np.array([[399.5 + 604.0, 399.5 - 302.0]]), angles)
    assert angles[0] == pytest.approx(np.pi / 4)
    assert angles[1] == pytest.approx(np.arcsin(-0.5 / np.sqrt(1 + 1 + 0.25)))


def test_level_pose_of_a_level_beacon():
    """Without noise two LEDs and the direction of gravity give the pose exactly."""
    up = np.array([0.05, -0.08, -1.0])
    up /= np.linalg.norm(up)
    level = level_frame(up)
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(level @ up, [0.0, 0.0, 1.0], atol=1e-14)
    R_CT = level.T @ Rotation.from_euler("z", 0.7).as_matrix()
    true = np.array([2.0, -1.0, 40.0, *quaternion_from_matrix(R_CT)])
    p_L = (true[:3] + LEDS[1] @ R_CT.T) @ level.T
    seen = -p_L[:, :2] / p_L[:, 2:]
    found = np.empty(7)
    level_pose(LEDS[1], level, 0, 1, seen[0], seen[1], found)
    np.testing.assert_allclose(found, true, atol=1e-10)

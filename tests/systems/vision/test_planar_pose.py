"""Poses of squares against OpenCV's IPPE, and covariances against Monte Carlo."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from systems.signals.measurement import MARKER, VALID
from systems.vision.pinhole import camera_mount, tangents_of_pixel
from systems.vision.planar_pose import (
    LINE_CORRELATION,
    corner_shifts,
    infinitesimal_plane_poses,
    pad_position_from_marker,
    quaternion_from_matrix,
    refine_pose,
    solve_positive_definite,
    write_detection,
    write_pose,
)
from tests.systems.vision.pad_views import CAMERA, exposure_at, pad_pose, projected, rng, square

SIDE = 0.8


def random_view(random: np.random.Generator, lowest: float = 1.5, highest: float = 10.0):
    z = random.uniform(lowest, highest)
    return exposure_at(
        [*random.uniform(-0.2, 0.2, 2) * z, z],
        tilt=random.normal(0, 0.15, 2),
        yaw=random.uniform(-np.pi, np.pi),
    )


def measured(corners: np.ndarray, end_noise=0.02, scale_error=0.0) -> np.ndarray:
    measurement = MARKER.zeros()
    assert write_pose(corners, SIDE, CAMERA, end_noise, scale_error, measurement)
    return measurement


def noisy(corners: np.ndarray, random, end_noise: float) -> np.ndarray:
    """Corners after the sides have moved, their ends correlated like a line's."""
    ends = random.multivariate_normal([0, 0], [[1, LINE_CORRELATION], [LINE_CORRELATION, 1]], 4)
    return corners + corner_shifts(corners, end_noise * ends)


@pytest.mark.parametrize("seed", range(20))
def test_exact_corners_give_the_exact_pose(seed):
    exposure = random_view(rng(seed))
    measurement = measured(projected(square(SIDE), exposure))
    R_CP, p_CP = pad_pose(exposure)
    found = measurement[MARKER.index("range")] * measurement[MARKER.slice("bearing_C")]
    np.testing.assert_allclose(found, p_CP, rtol=0, atol=2e-5)
    q = measurement[MARKER.slice("q_CP")]
    error = Rotation.from_quat(np.roll(q, -1)).inv() * Rotation.from_matrix(R_CP)
    assert error.magnitude() < 1e-3
    assert measurement[MARKER.index("reprojection_error")] < 1e-4


@pytest.mark.parametrize("seed", range(10))
def test_the_two_starts_are_opencv_s(seed):
    random = rng(seed)
    corners = projected(square(SIDE), random_view(random)) + random.normal(0, 0.3, (4, 2))
    tangents = np.array([tangents_of_pixel(CAMERA, *corner) for corner in corners])
    _, turns, places, _ = cv2.solvePnPGeneric(
        square(SIDE), tangents.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    R, p = infinitesimal_plane_poses(tangents, SIDE)
    expected = [
        (cv2.Rodrigues(turn)[0], place.ravel()) for turn, place in zip(turns, places, strict=True)
    ]
    if np.linalg.norm(expected[0][0] - R[0]) > np.linalg.norm(expected[1][0] - R[0]):
        expected.reverse()
    for i in range(2):
        np.testing.assert_allclose(R[i], expected[i][0], atol=1e-4)
        np.testing.assert_allclose(p[i], expected[i][1], atol=1e-3)


def test_both_solutions_explain_a_distant_square():
    """Seen 0.2 rad from the side, the pose tilted the other way fits nearly as well; both stay."""
    exposure = exposure_at([2.0, 0.0, 10.0])
    measurement = measured(projected(square(SIDE), exposure))
    first, second = (
        Rotation.from_quat(np.roll(measurement[MARKER.slice(name)], -1))
        for name in ("q_CP", "q_CP_second")
    )
    assert (first.inv() * second).magnitude() == pytest.approx(0.4, abs=0.06)
    view = MARKER(measurement)
    assert view.reprojection_error < view.reprojection_error_second < 0.5


def test_refinement_only_improves():
    random = rng(3)
    corners = projected(square(SIDE), random_view(random)) + random.normal(0, 0.5, (4, 2))
    tangents = np.array([tangents_of_pixel(CAMERA, *corner) for corner in corners])
    for R, p in zip(*infinitesimal_plane_poses(tangents, SIDE), strict=True):
        q = square(SIDE) @ R.T + p
        before = np.sqrt(np.mean(np.sum((q[:, :2] / q[:, 2:] - tangents) ** 2, axis=1)))
        assert refine_pose(R, p, tangents, SIDE) <= before
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("height", [2.0, 6.0])
def test_covariance_against_monte_carlo(height):
    random = rng(4)
    exposure = exposure_at([0.3, -0.2, height], tilt=(0.1, -0.05), yaw=0.5)
    corners = projected(square(SIDE), exposure)
    fields = [MARKER.index("bearing_C_x"), MARKER.index("bearing_C_y"), MARKER.index("range")]
    samples = np.array([measured(noisy(corners, random, 0.02))[fields] for _ in range(3000)])
    c = measured(corners)[MARKER.slice("covariance")]
    C = np.array([[c[0], c[1], c[3]], [c[1], c[2], c[4]], [c[3], c[4], c[5]]])
    ratio = np.linalg.solve(np.linalg.cholesky(C), (samples - samples.mean(axis=0)).T)
    # Whitened with the predicted covariance the samples are white.
    np.testing.assert_allclose(np.cov(ratio), np.eye(3), atol=0.12)


def test_scale_error_adds_to_the_range():
    corners = projected(square(SIDE), exposure_at([0, 0, 5.0]))
    rr = MARKER.index("covariance_rr")
    added = measured(corners, scale_error=0.01)[rr] - measured(corners)[rr]
    assert added == pytest.approx(0.05**2, rel=1e-6)


def test_the_back_of_a_square_is_no_pose():
    corners = projected(square(SIDE), exposure_at([0, 0, 5.0]))[::-1]
    measurement = MARKER.zeros()
    assert not write_pose(corners, SIDE, CAMERA, 0.02, 0.0, measurement)
    np.testing.assert_array_equal(measurement, 0.0)


def test_the_largest_level_counts():
    exposure = exposure_at([0.1, 0.0, 2.0])
    sides = np.array([0.8, 0.16, 0.032])
    corners = np.array([projected(square(side), exposure) for side in sides])
    noise, none = np.full(3, 0.02), np.zeros(3)
    measurement = MARKER.zeros()
    for missing, level in ((0, 0), (1, 1), (2, 2)):
        seen = corners.copy()
        seen[:missing] = np.nan
        write_detection(seen, sides, CAMERA, noise, none, measurement)
        view = MARKER(measurement)
        assert (view.valid, view.level) == (1.0, level)
        assert view.range == pytest.approx(np.hypot(0.1, 2.0), abs=1e-5)
        kept = measurement[MARKER.index("corner_0_0_u") :].reshape(3, 4, 2)
        np.testing.assert_array_equal(kept, seen)
    write_detection(np.full((3, 4, 2), np.nan), sides, CAMERA, noise, none, measurement)
    assert measurement[VALID] == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_pad_position_is_turned_by_the_vehicle_s_attitude(seed):
    """Against the vehicle's true position over the pad; covariance by numeric derivative."""
    random = rng(seed)
    exposure = random_view(random)
    X_BC = camera_mount([0.2, 0.1, -0.1], yaw=0.3)
    R_WC = Rotation.from_quat(np.roll(exposure[:4], -1)).as_matrix()
    R_WB = R_WC @ X_BC[:, :3].T
    p_WB = exposure[4:7] - R_WB @ X_BC[:, 3]
    q_WB = np.roll(Rotation.from_matrix(R_WB).as_quat(), 1)
    measurement = measured(projected(square(SIDE), exposure), scale_error=0.01)
    result = pad_position_from_marker(measurement, q_WB, X_BC)
    np.testing.assert_allclose(result[:3], -p_WB, atol=3e-5)

    def position(parameters):
        bx, by, r = parameters
        b = np.array([bx, by, np.sqrt(1 - bx**2 - by**2)])
        return R_WB @ (X_BC[:, 3] + X_BC[:, :3] @ (r * b))

    fields = [MARKER.index("bearing_C_x"), MARKER.index("bearing_C_y"), MARKER.index("range")]
    x = measurement[fields]
    J = np.column_stack([(position(x + h) - position(x - h)) / 2e-6 for h in 1e-6 * np.eye(3)])
    c = measurement[MARKER.slice("covariance")]
    V = J @ np.array([[c[0], c[1], c[3]], [c[1], c[2], c[4]], [c[3], c[4], c[5]]]) @ J.T
    expected = V[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    np.testing.assert_allclose(result[3:], expected, rtol=1e-4, atol=1e-12)


def test_small_linear_algebra():
    random = rng(5)
    A = random.normal(size=(6, 6))
    M, rhs = A @ A.T + np.eye(6), random.normal(size=(6, 3))
    x = rhs.copy()
    solve_positive_definite(M.copy(), x)
    np.testing.assert_allclose(x, np.linalg.solve(M, rhs), atol=1e-12)
    for turn in Rotation.random(20, random_state=6):
        q = quaternion_from_matrix(turn.as_matrix())
        np.testing.assert_allclose(q, np.roll(turn.as_quat(canonical=True), 1), atol=1e-12)


def test_moved_sides_move_the_corners_between_them():
    """A square whose sides all move out by d grows by 2d; slanted ends turn it."""
    corners = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    grown = corners + corner_shifts(corners, np.full((4, 2), 0.5))
    np.testing.assert_allclose(grown, corners + 0.5 * np.sign(corners - 5.0), atol=1e-12)

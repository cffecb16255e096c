"""The pinhole camera against OpenCV's, and the mount against the words that describe it."""

import cv2
import numpy as np
import pytest

from systems.vision.pinhole import (
    camera_mount,
    is_in_image,
    pinhole_camera,
    pixel_of_tangents,
    tangents_of_pixel,
)
from tests.systems.vision.pad_views import camera_matrix, rng

STRONG = pinhole_camera(640, 480, 400.0, (-0.2, 0.05, 0.002, -0.003))


def test_projection_is_opencv_s():
    tangents = rng(0).uniform(-0.6, 0.6, (50, 2))
    expected, _ = cv2.projectPoints(
        np.column_stack([tangents, np.ones(50)]), np.zeros(3), np.zeros(3), camera_matrix(STRONG),
        STRONG[6:],
    )  # fmt: skip
    pixels = [pixel_of_tangents(STRONG, x, y) for x, y in tangents]
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), rtol=0, atol=1e-10)


def test_undistortion_inverts_the_projection():
    for u, v in rng(1).uniform(0, [640, 480], (50, 2)):
        x, y = tangents_of_pixel(STRONG, u, v)
        np.testing.assert_allclose(pixel_of_tangents(STRONG, x, y), (u, v), rtol=0, atol=1e-5)


def test_the_principal_point_is_the_middle_of_the_pixels():
    """The centres of the first and the last pixel see rays that mirror each other."""
    camera = pinhole_camera(640, 480, 530.0)
    x, y = tangents_of_pixel(camera, 0.0, 0.0)
    np.testing.assert_allclose(tangents_of_pixel(camera, 639.0, 479.0), (-x, -y), atol=1e-15)


def test_image_top_is_the_body_s_front():
    R_BC = camera_mount([0.1, 0.2, -0.3])[:, :3]
    np.testing.assert_allclose(R_BC @ [0, 0, 1], [0, 0, -1], atol=1e-15)  # looks down
    np.testing.assert_allclose(R_BC @ [0, -1, 0], [1, 0, 0], atol=1e-15)  # up in the image: front
    np.testing.assert_allclose(R_BC @ [1, 0, 0], [0, -1, 0], atol=1e-15)  # right: right
    assert np.linalg.det(R_BC) == pytest.approx(1.0)


def test_mount_turned_to_the_left():
    """A quarter turn counter-clockwise puts the image's top on the body's left."""
    X_BC = camera_mount([0.1, 0.2, -0.3], yaw=np.pi / 2)
    np.testing.assert_allclose(X_BC[:, :3] @ [0, -1, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(X_BC[:, 3], [0.1, 0.2, -0.3])


def test_border_of_the_image():
    camera = pinhole_camera(640, 480, 530.0)
    assert is_in_image(camera, 3.0, 476.0, 3.0)
    assert not is_in_image(camera, 2.9, 100.0, 3.0)
    assert not is_in_image(camera, 100.0, 476.1, 3.0)

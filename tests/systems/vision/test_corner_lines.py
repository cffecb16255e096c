"""Corners by lines: unbiased under blur, where a corner search shrinks the square."""

import cv2
import numpy as np
import pytest
from scipy.stats import norm

from systems.vision.corner_lines import _edge, _fit_line, _sample, refine_corners
from systems.vision.pinhole import pinhole_camera, pixel_of_tangents, tangents_of_pixel
from tests.systems.vision.pad_views import rng

SIZE = 160  # px


def turned_square(random: np.random.Generator, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre and one half axis of a square."""
    angle = random.uniform(-np.pi, np.pi)
    half_axis = 0.5 * side * np.array([np.cos(angle), np.sin(angle)])
    return 0.5 * SIZE + random.uniform(-1, 1, 2), half_axis


def corners_of(centre: np.ndarray, half_axis: np.ndarray) -> np.ndarray:
    x, y = half_axis, np.array([-half_axis[1], half_axis[0]])
    return centre + np.array([-x - y, x - y, x + y, y - x])


def blurred_square(points: np.ndarray, centre, half_axis, sigma: float) -> np.ndarray:
    """Grey levels at `points` (..., 2) of a black square on white under a Gaussian blur: exact."""
    half = np.linalg.norm(half_axis)
    x, y = half_axis / half, np.array([-half_axis[1], half_axis[0]]) / half
    inside = 1.0
    for axis in (x, y):
        t = (points - centre) @ axis
        inside = inside * (norm.cdf((t + half) / sigma) - norm.cdf((t - half) / sigma))
    return 230.0 - 210.0 * inside


PIXELS = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).astype(float)


def quantised(image: np.ndarray, random: np.random.Generator, noise: float) -> np.ndarray:
    return np.clip(np.rint(image + random.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)


def radial(found: np.ndarray, true: np.ndarray) -> float:
    """Mean outward error of the corners."""
    out = true - true.mean(axis=0)
    return float(np.mean(np.sum((found - true) * out, axis=1) / np.linalg.norm(out, axis=1)))


@pytest.mark.parametrize("sigma", [0.6, 1.2, 2.0])
def test_blur_does_not_shrink_the_square(sigma):
    random = rng(1)
    by_lines, searched, errors = [], [], []
    for _ in range(12):
        square = turned_square(random, random.uniform(50, 90))
        true = corners_of(*square)
        image = quantised(blurred_square(PIXELS, *square, sigma), random, 1.0)
        start = true + random.uniform(-1, 1, true.shape)
        found = refine_corners(image, start)
        corners = start.astype(np.float32).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
        cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria)
        by_lines.append(radial(found, true))
        searched.append(radial(corners.reshape(4, 2), true))
        errors.append(found - true)
    assert abs(np.mean(by_lines)) < 0.01
    assert np.std(errors) < 0.02
    assert np.mean(searched) < np.mean(by_lines) - 0.05 * sigma


def test_straight_sides_that_distortion_bends():
    """With the camera given, the fit is of straight lines again."""
    camera = pinhole_camera(SIZE, SIZE, 150.0, (-0.3, 0.1, 0.0, 0.0))
    square = np.array([0.02, -0.01]), np.array([0.3, 0.1])
    true = np.array([pixel_of_tangents(camera, *corner) for corner in corners_of(*square)])
    tangents = np.array([[tangents_of_pixel(camera, *pixel) for pixel in row] for row in PIXELS])
    image = quantised(blurred_square(tangents, *square, 0.7 / 150.0), rng(2), 0.5)
    np.testing.assert_allclose(refine_corners(image, true + 0.5, camera), true, atol=0.05)
    assert np.abs(refine_corners(image, true + 0.5) - true).max() > 0.3


def test_a_square_near_the_border_of_the_image():
    random = rng(3)
    square = np.array([34.3, 35.2]), np.array([30.0, 0.6])
    true = corners_of(*square)
    image = quantised(blurred_square(PIXELS, *square, 0.7), random, 1.0)
    np.testing.assert_allclose(refine_corners(image, true + 0.7), true, atol=0.08)


def test_without_an_edge_the_corners_stay():
    corners = corners_of(*turned_square(rng(4), 60.0))
    flat = np.full((SIZE, SIZE), 100, np.uint8)
    np.testing.assert_array_equal(refine_corners(flat, corners), corners)
    np.testing.assert_array_equal(refine_corners(flat, corners[:1].repeat(4, 0)), corners[[0] * 4])


def test_bilinear_sample():
    image = rng(5).integers(0, 255, (20, 30)).astype(np.uint8)
    for u, v in rng(6).uniform(0, [28.9, 18.9], (20, 2)):
        i, j, a, b = int(v), int(u), v - int(v), u - int(u)
        patch = image[i : i + 2, j : j + 2].astype(float)
        assert _sample(image, u, v) == pytest.approx([1 - a, a] @ patch @ [1 - b, b])
    assert np.isnan(_sample(image, -0.1, 5.0))
    assert np.isnan(_sample(image, 5.0, 19.5))


def test_centroid_and_spread_of_an_edge():
    """Of a Gaussian edge of σ 1.5 px at u = 20.3; less than 15 % of the steepest is ignored."""
    u = np.arange(40)
    image = np.tile(np.rint(20.0 + 200.0 * norm.cdf((u - 20.3) / 1.5)).astype(np.uint8), (10, 1))
    centroid, spread, weight = _edge(image, 19.0, 5.0, 1.0, 0.0, 8.0)
    assert centroid == pytest.approx(1.3, abs=0.02)
    assert spread == pytest.approx(1.5, rel=0.2)
    assert weight > 0.0


def test_line_without_its_outlier():
    a = np.linspace(0, 30, 20)
    s = 0.4 - 0.01 * a + rng(7).normal(0, 0.01, 20)
    s[6] += 2.0
    offset, slope = _fit_line(a, s, np.ones(20), 20)
    expected = np.polyfit(np.delete(a, 6), np.delete(s, 6), 1)
    assert slope == pytest.approx(expected[0], abs=1e-9)
    assert offset == pytest.approx(expected[1], abs=1e-9)

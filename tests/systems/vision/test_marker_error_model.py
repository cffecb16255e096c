"""The error model and the images it stands for: the same detections, biases and covariances."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chi2, norm

from systems.signals.measurement import MARKER, VALID
from systems.signals.noise import stream_key
from systems.vision import marker_error_model as model
from systems.vision.corner_lines import NOISE_FLOOR
from systems.vision.nested_marker import NestedMarkerDetector
from systems.vision.rendering import BLACK, PadRenderer
from tests.systems.vision.pad_views import (
    CAMERA,
    PAD,
    exposure_at,
    pad_pose,
    projected,
    rng,
    square,
)

KEY = stream_key(1, "test")
READ_NOISE = 1.2
FIELDS = [MARKER.index("bearing_C_x"), MARKER.index("bearing_C_y"), MARKER.index("range")]


@dataclass
class Sample:
    """What a number of frames came to."""

    errors: np.ndarray  # (n, 3), bearing x and y (rad) and range (m), of the frames with a pose
    nees: np.ndarray  # (n,) of those errors under the reported covariance
    found: np.ndarray  # (frames, levels) whether a level was found
    visible: np.ndarray  # (frames, levels) whether it was wholly in the image


def views(height, tilt, smear, count, seed):
    random = rng(seed)
    for _ in range(count):
        axis, way = random.uniform(0, 2 * np.pi, 2)
        yield exposure_at(
            [*random.uniform(-0.1, 0.1, 2) * height, height],
            tilt * np.sqrt(random.uniform()) * np.array([np.cos(axis), np.sin(axis)]),
            random.uniform(-np.pi, np.pi),
            smear * np.array([np.cos(way), np.sin(way)]),
        )


def sample(exposures, light, fidelity) -> Sample:
    sides = PAD.padded_sides()
    errors, nees, found, visible = [], [], [], []
    renderer = PadRenderer(PAD, CAMERA, light, READ_NOISE, KEY)
    detector = NestedMarkerDetector(PAD, CAMERA)
    measurement, corners = MARKER.zeros(), np.empty((3, 4, 2))
    for frame, exposure in enumerate(exposures):
        if fidelity == "pixels":
            detector.detect(renderer.render(exposure, frame), corners)
        else:
            model.sample_corners(exposure, sides, CAMERA, light, READ_NOISE, KEY, frame, corners)
        model.write_marker_detection(
            corners, exposure, sides, CAMERA, light, READ_NOISE, measurement
        )
        found.append(np.isfinite(corners[:, 0, 0]))
        pixels = np.array([projected(square(side), exposure) for side in sides])
        visible.append(np.all((pixels > 4) & (pixels < [635, 475]), axis=(1, 2)))
        if measurement[VALID]:
            _, p_CP = pad_pose(exposure)
            r = np.linalg.norm(p_CP)
            error = measurement[FIELDS] - [*(p_CP[:2] / r), r]
            c = measurement[MARKER.slice("covariance")]
            C = np.array([[c[0], c[1], c[3]], [c[1], c[2], c[4]], [c[3], c[4], c[5]]])
            errors.append(error)
            nees.append(error @ np.linalg.solve(C, error))
    return Sample(np.array(errors), np.array(nees), np.array(found), np.array(visible))


def spread(errors: np.ndarray) -> np.ndarray:
    """One sigma by the quartiles, which a stray frame does not move, shape (3,)."""
    low, high = np.percentile(errors, [25, 75], axis=0)
    return (high - low) / 1.349


# height (m), largest tilt (rad), light, smear (px)
GRID = [
    (0.2, 0.1, 0.75, 0.0),
    (0.6, 0.2, 0.75, 0.0),
    (2.0, 0.1, 0.75, 0.0),
    (4.0, 0.3, 0.75, 0.0),
    (8.0, 0.1, 0.75, 0.0),
    (12.0, 0.2, 0.75, 0.0),
    (4.0, 0.1, 0.2, 0.0),
    (10.0, 0.1, 0.2, 0.0),
    (3.0, 0.1, 1.4, 0.0),
    (8.0, 0.2, 1.4, 0.0),
    (0.6, 0.1, 0.75, 4.0),
    (4.0, 0.2, 0.75, 4.0),
    (4.0, 0.1, 0.5, 8.0),
]


@pytest.mark.parametrize(("height", "tilt", "light", "smear"), GRID)
def test_both_fidelities_agree(height, tilt, light, smear):
    """Bands: bias to 0.6 σ plus chance and 15 % of itself, σ to a factor of 2, rates to 0.12.

    In saturated light the model counts what it does not know of the bias as noise: there
    the images may scatter less, down to a fifth.
    """
    pixels = sample(views(height, tilt, smear, 40, seed=1), light, "pixels")
    shortcut = sample(views(height, tilt, smear, 300, seed=2), light, "geometric")
    assert len(pixels.errors) > 30
    sigma_p, sigma_g = spread(pixels.errors), spread(shortcut.errors)
    bias_p, bias_g = np.median(pixels.errors, axis=0), np.median(shortcut.errors, axis=0)
    chance = 4.0 * 1.25 * sigma_g / np.sqrt(len(pixels.errors))
    assert np.all(np.abs(bias_p - bias_g) < 0.6 * sigma_g + chance + 0.15 * np.abs(bias_g))
    ratio = sigma_p / sigma_g
    least = 0.5 if light <= 1.0 else 0.2
    assert np.all((ratio > least) & (ratio < 2.0)), ratio
    for level in range(3):
        in_view = pixels.visible[:, level]
        if in_view.sum() >= 20:
            rate_p = pixels.found[in_view, level].mean()
            rate_g = shortcut.found[shortcut.visible[:, level], level].mean()
            chance = 3.0 * np.sqrt(max(rate_g * (1.0 - rate_g), 0.01) / in_view.sum())
            assert rate_p == pytest.approx(rate_g, abs=0.12 + chance), f"level {level}"


@pytest.mark.parametrize(
    ("height", "light", "smear"), [(2.0, 0.75, 0.0), (8.0, 0.3, 0.0), (4.0, 0.75, 3.0)]
)
def test_reported_covariance_is_honest(height, light, smear):
    """Of the shortcut, in the 99.9 % band of chi-square; of the pixels, to a factor of 1.6."""
    shortcut = sample(views(height, 0.1, smear, 300, seed=3), light, "geometric")
    n = len(shortcut.nees)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * n) / n
    # The covariance is that of the mean direction of the smear.
    slack = 1.0 if smear == 0.0 else 1.15
    assert low / slack < shortcut.nees.mean() < high * slack
    pixels = sample(views(height, 0.1, smear, 40, seed=4), light, "pixels")
    assert 1.0 / 3.0 < np.median(pixels.nees) / chi2.median(3) < 1.6


def test_centroid_of_a_saturated_edge():
    """κ against sums over a fine grid."""
    x = np.linspace(-6, 6, 200_001)
    assert model.saturation_shift(1.0) == 0.0
    for light in (1.05, 1.3, 2.0, 4.0):
        z = norm.ppf((1.0 / light - BLACK) / (1.0 - BLACK))
        slope = np.where(x < z, norm.pdf(x), 0.0)
        weight = np.maximum(slope - NOISE_FLOOR * slope.max(), 0.0)
        expected = (x * weight).sum() / weight.sum()
        assert model.saturation_shift(light) == pytest.approx(expected, abs=1e-3)


def test_a_side_s_statistics_go_the_right_way():
    """Less light, more smear or a smaller marker: more noise; saturation draws sides inwards."""
    bias, sigma, tau = model.side_statistics(80.0, 0.0, 0.75, READ_NOISE)
    assert abs(bias) < 0.01
    assert 0.003 < sigma < 0.03
    assert tau == 0.0
    assert model.side_statistics(80.0, 0.0, 0.2, READ_NOISE)[1] > sigma
    assert model.side_statistics(80.0, 8.0, 0.75, READ_NOISE)[1] > sigma
    assert model.side_statistics(15.0, 0.0, 0.75, READ_NOISE)[1] > 2.0 * sigma
    assert model.side_statistics(80.0, 0.0, 1.5, READ_NOISE)[0] < -0.2
    assert model.side_statistics(80.0, 0.0, 1.5, READ_NOISE)[2] > 0.02
    assert model.side_statistics(80.0, 8.0, 1.5, READ_NOISE)[0] < -0.5


def test_detection_goes_the_right_way():
    p = model.detection_probability
    assert p(60.0, 0.0, 0.75) > 0.99
    assert p(8.0, 0.0, 0.75) < 0.1
    assert p(60.0, 30.0, 0.75) < 0.1
    assert p(60.0, 0.0, 0.05) < 0.1
    for smear in (1.0, 5.0, 20.0):
        assert p(60.0, smear, 0.75) <= p(60.0, smear - 1.0, 0.75)


def test_nothing_is_seen_out_of_view():
    corners = np.empty((3, 4, 2))
    for exposure in (
        exposure_at([30.0, 0.0, 5.0]),
        exposure_at([0.0, 0.0, -5.0]),  # from below
        exposure_at([0.0, 0.0, 5.0], (np.pi, 0.0)),  # looking up
    ):
        model.sample_corners(
            exposure, PAD.padded_sides(), CAMERA, 0.75, READ_NOISE, KEY, 0, corners
        )
        assert np.isnan(corners).all()


def test_missing_levels_are_not_found():
    corners = np.empty((3, 4, 2))
    sides = np.array([0.8, 0.0, 0.0])
    model.sample_corners(exposure_at([0, 0, 2.0]), sides, CAMERA, 0.75, READ_NOISE, KEY, 0, corners)
    np.testing.assert_array_equal(np.isfinite(corners[:, 0, 0]), [True, False, False])

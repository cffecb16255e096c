"""The nested marker: its geometry, and that some level is found at every height."""

import cv2
import numpy as np
import pytest

from systems.signals.noise import stream_key
from systems.vision.nested_marker import MarkerDetector, NestedMarker, NestedMarkerDetector
from systems.vision.rendering import PadRenderer
from tests.systems.vision.pad_views import CAMERA, PAD, exposure_at, projected, rng, square


def test_the_next_level_lies_in_white():
    for level in range(3):
        cells = PAD.cells(level)
        assert cells.shape == (6, 6)
        np.testing.assert_array_equal(cells[[0, -1]], 0.0)  # black border
        np.testing.assert_array_equal(cells[2:4, 2:4], 1.0)  # white centre
    np.testing.assert_array_equal(PAD.padded_sides(), PAD.sides)
    single = NestedMarker((16,), (0.5,), 0.7)
    np.testing.assert_array_equal(single.padded_sides(), [0.5, 0.0, 0.0])


@pytest.mark.parametrize(
    ("ids", "sides", "plate", "message"),
    [
        ((1, 2), (0.5,), 1.0, "as many sides"),
        ((1, 2, 3, 4), (0.8, 0.2, 0.05, 0.01), 1.0, "1 to 3 ids"),
        ((1000,), (0.5,), 1.0, "0 to 999"),
        ((1, 2), (0.5, 0.3), 1.0, "does not fit into the white centre"),
        ((1,), (0.5,), 0.4, "does not fit on a plate"),
    ],
)
def test_impossible_markers_are_refused(ids, sides, plate, message):
    with pytest.raises(ValueError, match=message):
        NestedMarker(ids, sides, plate)


def test_some_level_is_read_at_every_height():
    """From 0.12 m to 12 m, five views a height."""
    random = rng(1)
    renderer = PadRenderer(PAD, CAMERA, 0.75, 1.2, stream_key(1, "test"))
    detector = NestedMarkerDetector(PAD, CAMERA)
    corners = np.empty((3, 4, 2))
    for height in np.geomspace(0.12, 12.0, 20):
        for frame in range(5):
            exposure = exposure_at(
                [*random.uniform(-0.1, 0.1, 2) * height, height],
                random.normal(0, 0.05, 2),
                random.uniform(-np.pi, np.pi),
            )
            detector.detect(renderer.render(exposure, frame), corners)
            found = np.isfinite(corners[:, 0, 0])
            assert found.any(), f"nothing found at {height:.2f} m"
            for level in np.flatnonzero(found):
                truth = projected(square(PAD.sides[level]), exposure)
                # Markers of a dozen pixels are only placed to a fraction of one.
                side = np.linalg.norm(truth[0] - truth[1])
                atol = 0.08 if side > 25.0 else 0.8
                np.testing.assert_allclose(corners[level], truth, rtol=0, atol=atol)


def test_levels_do_not_hide_each_other():
    """At 0.5 m two levels are in view whole, and both are reported."""
    renderer = PadRenderer(PAD, CAMERA, 0.75, 1.2, stream_key(1, "test"))
    corners = np.empty((3, 4, 2))
    NestedMarkerDetector(PAD, CAMERA).detect(renderer.render(exposure_at([0, 0, 0.5]), 0), corners)
    np.testing.assert_array_equal(np.isfinite(corners[:, 0, 0]), [False, True, True])


def test_magnification_keeps_the_coordinates():
    """Found in an image enlarged twice, corners are still pixels of the image given."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = np.full((100, 120), 255, np.uint8)
    image[30:66, 40:76] = dictionary.generateImageMarker(7, 36)
    expected = np.array([[40, 30], [75, 30], [75, 65], [40, 65]])
    for magnification in (1, 2, 3):
        (marker,) = MarkerDetector([dictionary], magnification=magnification).detect(image)
        assert marker.marker_id == 7
        np.testing.assert_allclose(marker.corners, expected, atol=0.75)


def test_an_empty_image_shows_no_marker():
    corners = np.zeros((3, 4, 2))
    NestedMarkerDetector(PAD, CAMERA).detect(np.zeros((480, 640), np.uint8), corners)
    assert np.isnan(corners).all()


def test_a_marker_cut_off_by_the_border_is_not_reported():
    """The outer level hangs out of the image by a few pixels, wherever the border cuts it."""
    renderer = PadRenderer(PAD, CAMERA, 0.75, 1.2, stream_key(1, "test"))
    detector = NestedMarkerDetector(PAD, CAMERA)
    corners = np.empty((3, 4, 2))
    # At 2 m a metre is 265 px: the marker's side reaches the border at an offset of 0.80 m.
    for offset in np.arange(0.80, 0.84, 0.005):
        exposure = exposure_at([offset, 0.0, 2.0])
        detector.detect(renderer.render(exposure, 0), corners)
        truth = projected(square(0.8), exposure)
        if np.isfinite(corners[0, 0, 0]):
            np.testing.assert_allclose(corners[0], truth, rtol=0, atol=0.1)
        else:
            assert truth.min() < 4.0

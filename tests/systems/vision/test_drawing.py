"""The drawings: right size, the image underneath, the detections on top."""

import numpy as np

from systems.signals.measurement import INFRARED, MARKER, VALID, no_measurement
from systems.signals.noise import stream_key
from systems.vision.drawing import draw_infrared_detection, draw_marker_detection
from systems.vision.infrared_blobs import write_blobs
from systems.vision.marker_error_model import write_geometric_detection
from systems.vision.pinhole import pinhole_camera
from systems.vision.rendering import PadRenderer
from tests.systems.vision.pad_views import CAMERA, PAD, exposure_at

KEY = stream_key(1, "test")
INFRARED_CAMERA = pinhole_camera(320, 200, 1.0 / 0.003)


def coloured(drawing: np.ndarray) -> np.ndarray:
    """Which pixels are not grey."""
    return np.ptp(drawing.astype(int), axis=2) > 40


def test_marker_detection():
    exposure = exposure_at([0.0, 0.0, 2.0])
    image = PadRenderer(PAD, CAMERA, 0.75, 1.2, KEY).render(exposure, 0)
    measurement = MARKER.zeros()
    write_geometric_detection(exposure, PAD.padded_sides(), CAMERA, 0.75, 1.2, KEY, 0, measurement)
    assert measurement[VALID]
    drawing = draw_marker_detection(image, measurement, CAMERA)
    assert drawing.shape == (960, 1280, 3)
    assert drawing.dtype == np.uint8
    rows, columns = np.nonzero(coloured(drawing))
    # The outer square: 212 px wide in the image, in its middle, twice as large in the drawing.
    assert abs(np.ptp(columns) - 424) < 16
    assert abs(columns.mean() - 640) < 20
    # Far from the marker the image shows, enlarged.
    np.testing.assert_array_equal(drawing[100:300:2, 50:150:2, 0], image[50:150, 25:75])
    assert coloured(draw_marker_detection(image, measurement)).sum() < len(rows)


def test_frames_without_a_detection():
    blank = np.zeros((480, 640), np.uint8)
    drawing = draw_marker_detection(blank, no_measurement(MARKER), CAMERA)
    assert coloured(drawing[-60:]).any()  # the caption is in red
    assert not coloured(drawing[:-60]).any()
    blank = np.zeros((200, 320), np.uint8)
    drawing = draw_infrared_detection(blank, no_measurement(INFRARED), INFRARED_CAMERA)
    assert drawing.shape == (800, 1280, 3)
    assert not coloured(drawing[:-60]).any()


def test_infrared_detection():
    measurement = INFRARED.zeros()
    write_blobs(
        np.array([[200.0, 50.0, 30.0], [60.0, 120.0, 9.0]]), 2, INFRARED_CAMERA, measurement
    )
    drawing = draw_infrared_detection(np.zeros((200, 320), np.uint8), measurement, INFRARED_CAMERA)
    rows, columns = np.nonzero(coloured(drawing[:-60]))
    right = columns > 480
    # Four times enlarged; the labels pull the means to the upper right.
    assert abs(columns[right].mean() - 802) < 15
    assert abs(rows[right].mean() - 202) < 15
    assert abs(columns[~right].mean() - 242) < 15
    assert right.sum() > (~right).sum()

"""The renderer against Drake's VTK engine: the same markers in the same places.

VTK draws no smooth edges, so its image is made three times as large and averaged
down. Its principal point counts from the pixels' edges, ours from their centres.
"""

import ctypes.util

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    GeometryId,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngine,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from systems.signals.noise import stream_key
from systems.vision.nested_marker import CELLS, NestedMarkerDetector
from systems.vision.pinhole import pinhole_camera
from systems.vision.rendering import PadRenderer
from tests.systems.vision.pad_views import PAD, camera_pose, exposure_at, projected, square

CAMERA = pinhole_camera(640, 480, 530.0)
ENLARGED = 3
LIFT = 2e-4  # m, of the black cells over the plate


def register(engine: RenderEngine, size, centre, grey: float) -> None:
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", Rgba(grey, grey, grey, 1.0))
    properties.AddProperty("label", "id", RenderLabel(1))
    engine.RegisterVisual(
        GeometryId.get_new_id(), Box(*size), properties, RigidTransform(centre), False
    )


@pytest.fixture(scope="module")
def engine() -> RenderEngine:
    if ctypes.util.find_library("EGL") is None:
        pytest.skip("VTK renders off screen with EGL, and libEGL is not installed")
    engine = MakeRenderEngineVtk(RenderEngineVtkParams(default_clear_color=[0.4, 0.4, 0.4]))
    register(engine, (1.2, 1.2, 0.02), (0.0, 0.0, -0.01 - LIFT), 1.0)
    for level, side in enumerate(PAD.sides):
        cell = side / CELLS
        for row, column in np.argwhere(PAD.cells(level) < 0.5):
            centre = ((column + 0.5) * cell - side / 2, side / 2 - (row + 0.5) * cell, -LIFT / 2)
            register(engine, (cell, cell, LIFT), centre, 0.05)
    return engine


def drake_image(engine: RenderEngine, exposure: np.ndarray) -> np.ndarray:
    """The view as a grey image of the camera's size."""
    width, height = 640 * ENLARGED, 480 * ENLARGED
    focal_length = 530.0 * ENLARGED
    core = RenderCameraCore(
        "vtk",
        CameraInfo(width, height, focal_length, focal_length, width / 2, height / 2),
        ClippingRange(0.05, 30.0),
        RigidTransform(),
    )
    R_WC, p_WC = camera_pose(exposure)
    engine.UpdateViewpoint(RigidTransform(RotationMatrix(R_WC), p_WC))
    image = ImageRgba8U(width, height)
    engine.RenderColorImage(ColorRenderCamera(core), image)
    grey = image.data[..., :3].mean(axis=2)
    small = grey.reshape(480, ENLARGED, 640, ENLARGED).mean(axis=(1, 3))
    return np.rint(small).astype(np.uint8)


@pytest.mark.parametrize(
    ("height", "tilt", "yaw"),
    [(0.5, (0.1, 0.05), 0.4), (2.0, (0.15, -0.1), 1.3), (6.0, (-0.1, 0.2), 2.9)],
)
def test_markers_are_where_drake_draws_them(engine, height, tilt, yaw):
    exposure = exposure_at([0.1 * height, 0.05 * height, height], tilt, yaw)
    detector = NestedMarkerDetector(PAD, CAMERA)
    ours, drake_s = np.empty((3, 4, 2)), np.empty((3, 4, 2))
    renderer = PadRenderer(PAD, CAMERA, 0.7, 1.0, stream_key(1, "test"))
    detector.detect(renderer.render(exposure, 0), ours)
    detector.detect(drake_image(engine, exposure), drake_s)
    truth = np.array([projected(square(side), exposure, (0, 0, 0, 0)) for side in PAD.sides])
    size = np.linalg.norm(truth[:, 0] - truth[:, 1], axis=1)
    inside = np.all((truth > 5.0) & (truth < [634.0, 474.0]), axis=(1, 2))
    compared = inside & (size > 20.0)
    assert compared.any()
    np.testing.assert_allclose(ours[compared], truth[compared], rtol=0, atol=0.06)
    # Drake's own corners bound how well two renderers can agree.
    np.testing.assert_allclose(drake_s[compared], truth[compared], rtol=0, atol=0.1)
    np.testing.assert_allclose(ours[compared], drake_s[compared], rtol=0, atol=0.1)

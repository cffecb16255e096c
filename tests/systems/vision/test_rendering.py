"""The renderer against supersampling, its noise against statistics, its bytes against itself."""

import cv2
import numpy as np
import pytest

from systems.signals.noise import stream_key
from systems.vision.image_noise import frame_noise
from systems.vision.nested_marker import CELLS
from systems.vision.pinhole import CX, CY, pinhole_camera
from systems.vision.rendering import (
    BLACK,
    LENS_SIGMA,
    SHOT_NOISE,
    VIGNETTE,
    PadRenderer,
    ground_tiles,
    pad_texture,
    texel,
)
from tests.systems.vision.pad_views import CAMERA, PAD, exposure_at, pad_pose

KEY = stream_key(1, "test")
OVERSAMPLING = 32
PLAIN = pinhole_camera(640, 480, 530.0)


def renderer(light=1.0, read_noise=0.0, camera=CAMERA) -> PadRenderer:
    return PadRenderer(PAD, camera, light, read_noise, KEY)


def reflectance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The pattern itself at points of P (m), NaN off the plate."""
    value = np.where(np.maximum(abs(x), abs(y)) < 0.5 * PAD.plate_side, 1.0, np.nan)
    for level, side in enumerate(PAD.sides):
        inside = np.maximum(abs(x), abs(y)) < 0.5 * side
        column = np.clip(np.floor((x / side + 0.5) * CELLS), 0, CELLS - 1).astype(int)
        row = np.clip(np.floor((0.5 - y / side) * CELLS), 0, CELLS - 1).astype(int)
        cells = np.where(PAD.cells(level) > 0.5, 1.0, BLACK)
        value = np.where(inside, cells[row, column], value)
    return value


def supersampled(exposure: np.ndarray, left: int, top: int, size: int) -> np.ndarray:
    """A square of the ideal image in grey levels: lens blur, no vignette, no noise."""
    margin, n = 4, OVERSAMPLING
    centres = (np.arange((size + 2 * margin) * n) + 0.5) / n - 0.5 - margin
    R_CP, p_CP = pad_pose(exposure)
    x, y = (left + centres - PLAIN[CX]) / 530.0, (top + centres - PLAIN[CY]) / 530.0
    rays = np.stack([*np.meshgrid(x, y), np.ones((x.size, y.size))], axis=-1)
    # The plane z_P = 0: n·(s ray) = n·p
    depth = (R_CP[:, 2] @ p_CP) / (rays @ R_CP[:, 2])
    points = (rays * depth[..., None] - p_CP) @ R_CP
    fine = cv2.GaussianBlur(reflectance(points[..., 0], points[..., 1]), (0, 0), LENS_SIGMA * n)
    # A pixel's centre lies between two fine samples.
    pixels = fine.reshape(size + 2 * margin, n, size + 2 * margin, n)[:, n // 2 - 1 : n // 2 + 1]
    pixels = pixels[:, :, :, n // 2 - 1 : n // 2 + 1].mean(axis=(1, 3))
    return 255.0 * pixels[margin:-margin, margin:-margin]


def vignette(camera: np.ndarray = CAMERA) -> np.ndarray:
    u, v = np.meshgrid(np.arange(640) - camera[CX], np.arange(480) - camera[CY])
    return 1.0 - VIGNETTE * (u**2 + v**2) / (camera[CX] ** 2 + camera[CY] ** 2)


@pytest.mark.parametrize(
    ("height", "tilt", "yaw"),
    [(0.15, (0.05, 0.1), 0.3), (0.7, (0.1, 0.0), 0.0), (3.0, (0.15, -0.1), 1.0), (9.0, (0, 0), 0)],
)
def test_the_image_is_the_blurred_pattern(height, tilt, yaw):
    # SHOT_NOISE cannot be switched off: the mean of frames takes it down to half a grey level.
    exposure = exposure_at([0.02 * height, 0.01 * height, height], tilt, yaw)
    _, p_CP = pad_pose(exposure)
    u = round(530.0 * p_CP[0] / p_CP[2] + CAMERA[CX])
    v = round(530.0 * p_CP[1] / p_CP[2] + CAMERA[CY])
    size = 40
    left, top = u - size // 2, v - size // 2
    render = renderer(light=0.8, camera=PLAIN).render
    images = np.mean([render(exposure, frame) for frame in range(12)], axis=0)
    image = (images / (0.8 * vignette()))[top : top + size, left : left + size]
    expected = supersampled(exposure, left, top, size)
    difference = image - expected
    assert np.all(np.isfinite(difference))
    assert expected.std() > 30.0  # the view shows edges
    # The blur's three parts together are not quite a Gaussian.
    assert np.abs(difference).max() < 20.0
    assert np.sqrt(np.mean(difference**2)) < 3.0
    # No edge is displaced: the residual has no part along the image's gradient.
    gy, gx = np.gradient(expected)
    shift = np.linalg.lstsq(np.column_stack([gx.ravel(), gy.ravel()]), difference.ravel())[0]
    assert np.abs(shift).max() < 0.025  # px


def test_texture_keeps_edges_between_texels():
    """The mean reflectance of a texture is that of the pattern at every scale."""
    x = (np.arange(1500) + 0.5) / 1500 * 1.2 - 0.6
    expected = reflectance(*np.meshgrid(x, x)).mean()
    for scale in (9, 11, 12, 14):
        texture = pad_texture(PAD, scale) / 255.0
        half = 0.5 * (len(texture) - 1) * texel(scale)
        centres = np.linspace(-half, half, len(texture))
        inside = np.abs(centres) < 0.55
        # The plate's rim is cut off on both sides: it is white.
        area = (inside.sum() * texel(scale)) ** 2
        mean = texture[np.ix_(inside, inside)].mean()
        white_rim = (1.2**2 - area) / 1.2**2
        assert mean * (1 - white_rim) + white_rim == pytest.approx(expected, abs=1e-3)


def test_noise_is_read_and_shot_noise():
    exposure = exposure_at([0.0, 0.0, 0.5])
    for read_noise in (0.5, 3.0):
        render = renderer(0.6, read_noise).render
        frames = np.stack([render(exposure, frame) for frame in range(60)]).astype(float)
        mean, variance = frames.mean(axis=0), frames.var(axis=0, ddof=1)
        for low, high in ((0, 30), (100, 170)):
            pixels = (mean > low) & (mean < high)
            expected = read_noise**2 + SHOT_NOISE * mean[pixels].mean() + 1.0 / 12.0
            assert pixels.sum() > 1000
            assert variance[pixels].mean() == pytest.approx(expected, rel=0.05)


def test_noise_of_different_frames_is_independent():
    a, b = (frame_noise(KEY, frame, 480, 640).astype(float).ravel() for frame in (0, 1))
    assert abs(np.corrcoef(a, b)[0, 1]) < 4.0 / np.sqrt(a.size)
    with pytest.raises(ValueError, match="too large"):
        frame_noise(KEY, 0, 2000, 2000)


def test_an_image_is_a_function_of_exposure_seed_and_frame():
    exposure = exposure_at([0.1, 0.2, 3.0], (0.1, 0.05), 0.4, smear=(3.0, 2.0))
    first = renderer(0.7, 1.2).render(exposure, 5)
    other = renderer(0.7, 1.2)
    assert not np.array_equal(other.render(exposure, 6), first)
    other.render(exposure_at([0, 0, 0.3]), 1)
    threads = cv2.getNumThreads()
    try:
        for count in (1, 2):
            cv2.setNumThreads(count)
            np.testing.assert_array_equal(other.render(exposure, 5), first)
    finally:
        cv2.setNumThreads(threads)
    another_seed = PadRenderer(PAD, CAMERA, 0.7, 1.2, stream_key(2, "test"))
    assert not np.array_equal(another_seed.render(exposure, 5), first)


@pytest.mark.parametrize("smear", [(0.8, -0.5), (6.0, 0.0), (4.0, -7.0)])
def test_smear_blurs_along_the_way_and_moves_nothing(smear):
    """Second moment of an edge: that of the lens plus the way's square over twelve."""
    exposure = exposure_at([0.0, 0.0, 2.0], smear=smear)
    render = renderer(0.8).render
    image = np.mean([render(exposure, frame) for frame in range(12)], axis=0) / (0.8 * vignette())
    # The left edge of the outer border, far from its corners; white outside.
    u = CAMERA[CX] - 530.0 * 0.4 / 2.0
    columns = np.arange(round(u) - 14, round(u) + 15)
    profile = image[:, columns][220:260].mean(axis=0)
    slope = -np.diff(profile)
    slope[np.abs(slope) < 0.5] = 0.0
    place = columns[:-1] + 0.5
    centroid = (slope * place).sum() / slope.sum()
    variance = (slope * (place - centroid) ** 2).sum() / slope.sum()
    # Distortion moves the edge by less than a pixel; its own place is the reference.
    still = renderer(0.8).render(exposure_at([0.0, 0.0, 2.0]), 0) / (0.8 * vignette())
    still_slope = -np.diff(still[:, columns][220:260].mean(axis=0))
    still_slope[np.abs(still_slope) < 1.0] = 0.0
    assert centroid == pytest.approx((still_slope * place).sum() / still_slope.sum(), abs=0.05)
    # The difference of neighbours adds 1/12.
    expected = LENS_SIGMA**2 + 1.0 / 12.0 + smear[0] ** 2 / 12.0
    assert variance == pytest.approx(expected, rel=0.12)


def test_light_saturates_white():
    exposure = exposure_at([0.0, 0.0, 0.5])
    bright = renderer(2.0).render(exposure, 0)
    assert bright.max() == 255
    assert np.median(bright[bright < 100]) == pytest.approx(2.0 * 255 * BLACK, abs=4.0)


def test_ground_is_plain_and_fixed_in_the_world():
    """Low contrast, and the same ground whatever the pad does on it."""
    assert all(tile.std() / tile.mean() < 0.2 for tile in ground_tiles())
    exposure = exposure_at([5.0, 5.0, 3.0])
    moved = exposure.copy()
    moved[7:11] = [0.5, -0.3, 0.0, 0.7]  # p_WP and yaw: the pad moves, out of sight
    a, b = renderer().render(exposure, 0), renderer().render(moved, 0)
    assert np.abs(a.astype(int) - b).max() <= 2
    elsewhere = renderer().render(exposure_at([5.5, 5.0, 3.0]), 0)
    assert np.abs(a.astype(int) - elsewhere).max() > 10


def test_views_past_the_horizon_and_from_afar_are_drawn():
    for tilt in (1.0, 1.5, 2.5):
        image = renderer(0.7, 1.2).render(exposure_at([0, 0, 2.0], (tilt, 0.0)), 0)
        assert image.shape == (480, 640)
    assert renderer(0.7, 1.2).render(exposure_at([0, 0, 200.0]), 0).std() < 40.0
    small = pinhole_camera(101, 67, 90.0)
    assert renderer(camera=small).render(exposure_at([0, 0, 1.0]), 0).shape == (67, 101)

"""Infrared spots and blobs: the image against its formula, the shortcut against the image."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from systems.signals.measurement import INFRARED, INFRARED_BLOBS
from systems.signals.noise import stream_key
from systems.vision.exposure import EXPOSURE
from systems.vision.infrared_blobs import (
    CENTROID_NOISE,
    MAXIMUM_SPOTS,
    SPOT_SIGMA,
    THRESHOLD,
    black_level,
    detect_blobs,
    pad_position_from_infrared,
    project_spots,
    render_spots,
    sample_blobs,
    write_blobs,
)
from systems.vision.pinhole import camera_mount, pinhole_camera
from tests.systems.vision.pad_views import exposure_at, pad_pose, rng

CAMERA = pinhole_camera(320, 200, 1.0 / 0.003)
KEY = stream_key(1, "test")
AT_CENTRE = np.zeros(3)
NOBODY = np.zeros((0, 4))


def spots_of(exposure, false_beacons=NOBODY, beacon=AT_CENTRE, reach=15.0, radius=0.02):
    spots = np.empty((MAXIMUM_SPOTS, 4))
    count = project_spots(exposure, beacon, false_beacons, radius, reach, CAMERA, spots)
    return spots, count


def seen(exposure, frame=0, quantised=True, noise=2.0, **lamps) -> np.ndarray:
    """Blobs found in the image."""
    image = render_spots(*spots_of(exposure, **lamps), CAMERA, noise, KEY, frame)
    blobs = np.empty((INFRARED_BLOBS, 3))
    return blobs[: detect_blobs(image, THRESHOLD + black_level(noise), quantised, blobs)]


def guessed(exposure, frame=0, quantised=True, **lamps) -> np.ndarray:
    """Blobs by the shortcut."""
    blobs = np.empty((INFRARED_BLOBS, 3))
    return blobs[: sample_blobs(*spots_of(exposure, **lamps), CAMERA, quantised, KEY, frame, blobs)]


def over(height: float, random=None, yaw: float = 0.0) -> np.ndarray:
    offset = np.zeros(2) if random is None else random.uniform(-0.1, 0.1, 2) * height
    return exposure_at([*offset, height], yaw=yaw)


def test_a_spot_is_where_the_pinhole_projects_it():
    exposure = exposure_at([0.4, -0.3, 5.0], (0.1, 0.05), 0.7)
    exposure[EXPOSURE.index("yaw")] = 0.5
    beacon = np.array([0.3, 0.1, 0.05])
    spots, count = spots_of(exposure, beacon=beacon)
    R_CP, p_CP = pad_pose(exposure)
    p = R_CP @ beacon + p_CP
    assert count == 1
    np.testing.assert_allclose(spots[0, :2], p[:2] / p[2] / 0.003 + [159.5, 99.5], atol=1e-9)
    r, cosine = np.linalg.norm(p), (R_CP.T @ -p)[2] / np.linalg.norm(p)
    assert spots[0, 2] == pytest.approx(THRESHOLD * (15.0 / r) ** 2 * cosine)
    assert spots[0, 3] == pytest.approx(0.02 / 0.003 / r)


def test_the_image_is_the_formula():
    exposure = over(6.0, rng(1))
    spots, count = spots_of(exposure)
    image = np.mean(
        [render_spots(spots, count, CAMERA, 1.0, KEY, frame) for frame in range(40)], axis=0
    )
    u, v, peak, disc = spots[0]
    d = np.hypot(*np.meshgrid(np.arange(320) - u, np.arange(200) - v))
    expected = 4.0 + peak * np.exp(-0.5 * (np.maximum(d - disc, 0.0) / SPOT_SIGMA) ** 2)
    unsaturated = expected < 240.0
    np.testing.assert_allclose(image[unsaturated], expected[unsaturated], atol=1.2)
    assert image[expected > 300.0].min() == 255.0


def test_blobs_are_connected_components():
    """Against scipy's labels, on noise."""
    image = (ndimage.gaussian_filter(rng(2).normal(size=(200, 320)), 4.0) * 1000 + 80).clip(0, 255)
    image = image.astype(np.uint8)
    blobs = np.empty((INFRARED_BLOBS, 3))
    count = detect_blobs(image, 150.0, False, blobs)
    labels, found = ndimage.label(image >= 150, structure=np.ones((3, 3)))
    areas = ndimage.sum_labels(np.ones_like(image), labels, range(1, found + 1))
    order = np.argsort(-areas, kind="stable")[:INFRARED_BLOBS]
    assert count == INFRARED_BLOBS < found
    np.testing.assert_array_equal(blobs[:, 2], areas[order])
    centres = ndimage.center_of_mass(image, labels, order + 1)
    np.testing.assert_allclose(blobs[:, 1::-1], centres, atol=1e-9)
    detect_blobs(image, 150.0, True, blobs)
    for blob, label in zip(blobs, order + 1, strict=True):
        rows, columns = ndimage.find_objects((labels == label).astype(int))[0]
        middle = (columns.start + columns.stop - 1) // 2, (rows.start + rows.stop - 1) // 2
        assert tuple(blob[:2]) == middle


@pytest.mark.parametrize("height", [0.4, 1.5, 4.0, 8.0, 11.0])
def test_shortcut_and_image_agree_in_whole_pixels(height):
    random = rng(3)
    centres, areas = [], []
    for frame in range(60):
        exposure = over(height, random)
        (by_image,), (by_count,) = seen(exposure, frame), guessed(exposure, frame)
        centres.append(by_image[:2] - by_count[:2])
        areas.append(by_image[2] - by_count[2])
        mean_area = by_count[2]
    # Noise moves a pixel over the threshold now and then, and with it the bounding box.
    assert np.mean(np.abs(centres) < 0.5) > 0.75
    assert np.abs(centres).max() <= 1.0
    assert abs(np.mean(centres)) < 0.1
    assert abs(np.mean(areas)) < max(0.5, 0.02 * mean_area)


@pytest.mark.parametrize("height", [0.5, 3.0, 8.0])
def test_centroids_have_the_noise_of_the_model(height):
    """Not quantised, a clean blob is centred to a twentieth of a pixel."""
    random = rng(4)
    errors, model = [], []
    for frame in range(80):
        exposure = over(height, random)
        truth = spots_of(exposure)[0][0, :2]
        errors.append(seen(exposure, frame, quantised=False)[0, :2] - truth)
        model.append(guessed(exposure, frame, quantised=False)[0, :2] - truth)
    assert abs(np.mean(errors)) < 0.02
    assert np.std(model) == pytest.approx(CENTROID_NOISE, rel=0.2)
    assert 0.2 * CENTROID_NOISE < np.std(errors) < 1.6 * CENTROID_NOISE


def test_range_limit():
    """Beyond the range nothing, near it a spot may fall between pixels."""
    random = rng(5)
    rates = {}
    for height in (13.0, 14.75, 15.5):
        exposures = [over(height, random) for _ in range(60)]
        rates[height] = [
            np.mean([len(blobs(exposure, frame)) for frame, exposure in enumerate(exposures)])
            for blobs in (seen, guessed)
        ]
    assert rates[13.0] == [1.0, 1.0]
    assert 0.02 < rates[14.75][0] < 0.98
    assert rates[14.75][0] == pytest.approx(rates[14.75][1], abs=0.25)
    assert rates[15.5] == [0.0, 0.0]
    assert len(seen(over(45.0), reach=55.0)) == 1  # MarkOne V3


def test_false_beacons_are_reported_too_largest_first():
    exposure = over(5.0)
    lamps = np.array([[1.0, 0.0, 0.0, 3.0], [-1.0, 0.3, 0.0, 0.3], [0.0, 0.8, 0.0, 0.0]])
    for blobs in (seen, guessed):
        found = blobs(exposure, false_beacons=lamps)
        assert len(found) == 3  # a lamp of no strength does not show
        assert np.all(np.diff(found[:, 2]) <= 0)
        # Pixel (159.5, 99.5) is below the camera.
        assert found[0, 0] > 200.0
        assert abs(found[1, 0] - 159.5) < 1.0


def test_only_five_are_reported():
    lamps = np.column_stack([np.linspace(-1.2, 1.2, 8), np.full(8, 0.4), np.zeros(8), np.ones(8)])
    for blobs in (seen, guessed):
        assert len(blobs(over(5.0), false_beacons=lamps)) == INFRARED_BLOBS


def test_lamps_that_touch_are_one_blob():
    exposure = over(5.0)
    lamps = np.array([[0.03, 0.0, 0.0, 1.0]])
    for blobs in (seen, guessed):
        assert len(blobs(exposure, false_beacons=lamps)) == 1


def test_no_lamp_shows_from_behind():
    from_below = exposure_at([0.0, 0.0, -2.0])
    assert spots_of(from_below)[1] == 0
    looking_up = exposure_at([0.0, 0.0, 2.0], (np.pi, 0.0))
    assert spots_of(looking_up)[1] == 0


def test_lamp_half_out_of_the_image():
    exposure = exposure_at([0.0, 0.0, 0.3])
    exposure[EXPOSURE.slice("p_WC")] = [-0.144, 0.0, 0.3]
    (by_image,), (by_count,) = seen(exposure), guessed(exposure)
    np.testing.assert_allclose(by_count, by_image, rtol=0.05, atol=1.0)


@pytest.mark.parametrize("seed", range(5))
def test_pad_position(seed):
    """Against the true position over the pad; covariance by numeric derivative."""
    random = rng(seed)
    X_BC = camera_mount([0.1, -0.2, -0.1], yaw=0.2)
    attitude = Rotation.from_rotvec(random.normal(0, [0.1, 0.1, 1.0]))
    p_WB = np.array([*random.uniform(-0.5, 0.5, 2), 6.0])
    R_WB = attitude.as_matrix()
    q_WB = np.roll(attitude.as_quat(), 1)
    p_C = (R_WB @ X_BC[:, :3]).T @ (-p_WB - R_WB @ X_BC[:, 3])
    blobs = np.array([[p_C[0] / p_C[2], p_C[1] / p_C[2], 9.0]])
    blobs[:, :2] = blobs[:, :2] / 0.003 + [159.5, 99.5]
    measurement = INFRARED.zeros()
    write_blobs(np.repeat(blobs, 5, axis=0), 1, CAMERA, measurement)
    result = pad_position_from_infrared(measurement, q_WB, 6.0, X_BC, 0, 2e-3, 0.3)
    np.testing.assert_allclose(result[:3], -p_WB, atol=1e-9)

    def position(dx, dy, dh):
        moved = measurement.copy()
        moved[INFRARED.index("blob_0_x")] += dx
        moved[INFRARED.index("blob_0_y")] += dy
        return pad_position_from_infrared(moved, q_WB, 6.0 + dh, X_BC)[:3]

    J = np.column_stack([(position(*d) - position(*-d)) / 2e-6 for d in 1e-6 * np.eye(3)])
    V = J @ np.diag([2e-3, 2e-3, 0.3]) ** 2 @ J.T
    np.testing.assert_allclose(
        result[3:], V[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]], rtol=1e-4, atol=1e-9
    )


def test_a_ray_above_the_horizon_has_no_pad_position():
    measurement = INFRARED.zeros()
    upside_down = np.array([0.0, 1.0, 0.0, 0.0])
    result = pad_position_from_infrared(measurement, upside_down, 5.0, camera_mount([0, 0, 0]))
    assert np.isnan(result).all()

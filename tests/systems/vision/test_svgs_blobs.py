"""Spots, images and blobs of the SVGS camera, and the two fidelities against each other."""

import numpy as np
import pytest

from plants.svgs_beacons import COLOURS, LAMP_SIZE, SvgsBeaconsConfig, SvgsGlint
from systems.signals.noise import stream_key
from systems.vision import svgs_blobs as blobs_module
from systems.vision.exposure import EXPOSURE
from systems.vision.pinhole import pinhole_camera
from systems.vision.svgs_blobs import (
    BLOB_AREA,
    BLOB_COLOUR,
    BLOB_MASS,
    BLOB_PEAK,
    BLOB_SIZE,
    LEVEL,
    MAXIMUM_BLOBS,
    MAXIMUM_SPOTS,
    SEED_LEVEL,
    SPOT_PEAK,
    SPOT_SIGMA,
    SPOT_SIZE,
    add_glints,
    background,
    centroid_noise,
    detect_blobs,
    next_gain,
    project_lamps,
    render_spots,
    sample_blobs,
)

CAMERA = pinhole_camera(800, 800, 604.0)
KEY = stream_key(1, "test")
BEACON_COLOURS = SvgsBeaconsConfig().colours()
GREEN = np.array(COLOURS["green"])
STILL = np.zeros(2)


def exposure_from(height: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """A level camera over the pad, its image's top to the north, shape (EXPOSURE.size,)."""
    exposure = EXPOSURE(EXPOSURE.zeros())
    exposure.q_WC_x = 1.0  # x east, y south, z down
    exposure.p_WC_x, exposure.p_WC_y, exposure.p_WC_z = x, y, height
    return np.asarray(exposure[:])


def grid_of_spots(peak: float, rng, count: int = 45, colour=GREEN) -> np.ndarray:
    """Spots far from each other at random places within a pixel."""
    spots = np.zeros((MAXIMUM_SPOTS, SPOT_SIZE))
    k = np.arange(count)
    spots[:count, 0] = 60.0 + 90.0 * (k % 8) + rng.uniform(0.0, 20.0, count)
    spots[:count, 1] = 60.0 + 110.0 * (k // 8) + rng.uniform(0.0, 20.0, count)
    spots[:count, SPOT_PEAK] = peak
    spots[:count, 4:7] = colour
    return spots


def both(spots: np.ndarray, count: int, smear, gain: float = 1.0, frame: int = 0):
    """The blobs of the image and the sampled ones, with their numbers of saturated pixels."""
    image = render_spots(spots, count, smear, gain, CAMERA, KEY, frame)
    seen = np.zeros((MAXIMUM_BLOBS, BLOB_SIZE))
    sampled = np.zeros_like(seen)
    n, saturated = detect_blobs(image, BEACON_COLOURS, seen)
    m, expected = sample_blobs(
        spots, count, *smear, gain, CAMERA, BEACON_COLOURS, KEY, frame, sampled
    )
    return seen[:n], saturated, sampled[:m], expected


def test_indices_are_those_of_the_layouts():
    assert EXPOSURE.index("p_WC_x") == blobs_module._P_WC
    assert EXPOSURE.index("p_WP_x") == blobs_module._P_WP
    assert EXPOSURE.index("yaw") == blobs_module._YAW


# -- spots


def test_lamps_are_projected():
    lamps = np.zeros((1, LAMP_SIZE))
    lamps[0] = [10.0, 5.0, 0.0, *GREEN, 100.0, 0.0]
    spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
    assert project_lamps(exposure_from(50.0), lamps, 1.0, CAMERA, spots) == 1
    # East is right, north is up.
    np.testing.assert_allclose(spots[0, :2], [399.5 + 604 * 0.2, 399.5 - 604 * 0.1])


@pytest.mark.parametrize("height", [40.0, 80.0])
def test_light_falls_with_range_squared(height):
    lamps = np.zeros((1, LAMP_SIZE))
    lamps[0] = [0.0, 0.0, 0.0, *GREEN, 100.0, 0.0]
    spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
    project_lamps(exposure_from(height), lamps, 0.5, CAMERA, spots)
    assert spots[0, SPOT_PEAK] == pytest.approx(0.5 * LEVEL * (100.0 / height) ** 2)


def test_a_resolved_lamp_keeps_its_radiance():
    """Near by, the light falls on more pixels instead of rising."""
    lamps = np.zeros((1, LAMP_SIZE))
    lamps[0] = [0.0, 0.0, 0.0, *GREEN, 100.0, 0.05]
    spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
    peaks = []
    for height in (1.0, 2.0):
        project_lamps(exposure_from(height), lamps, 1.0, CAMERA, spots)
        peaks.append(spots[0, SPOT_PEAK])
    assert peaks[0] == pytest.approx(peaks[1], rel=0.01)


def test_lamps_out_of_view_and_too_weak_are_left_out():
    lamps = np.zeros((3, LAMP_SIZE))
    lamps[:] = [0.0, 0.0, 0.0, *GREEN, 100.0, 0.0]
    lamps[1, 0] = 500.0
    lamps[2, 6] = 1.0
    spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
    assert project_lamps(exposure_from(50.0), lamps, 1.0, CAMERA, spots) == 1


def test_glints_are_drawn_anew_for_each_frame():
    spots = grid_of_spots(200.0, np.random.default_rng(0), 1)
    assert add_glints(spots, 1, 5, GREEN, CAMERA, KEY, 1) == 6
    again = grid_of_spots(200.0, np.random.default_rng(0), 1)
    add_glints(again, 1, 5, GREEN, CAMERA, KEY, 1)
    np.testing.assert_array_equal(spots[:6], again[:6])
    add_glints(again, 1, 5, GREEN, CAMERA, KEY, 2)
    assert np.all(spots[1:6, 0] != again[1:6, 0])
    assert np.all((spots[1:6, SPOT_PEAK] >= 100.0) & (spots[1:6, SPOT_PEAK] <= 400.0))


# -- images


def test_an_image_without_lamps_is_background_and_noise():
    image = render_spots(np.empty((0, SPOT_SIZE)), 0, STILL, 1.0, CAMERA, KEY, 3)
    assert image.shape == (3, 800, 800)
    assert image.mean() == pytest.approx(background(1.0), abs=0.05)
    assert image.std() == pytest.approx(np.hypot(1.5, np.sqrt(1.0 / 12.0)), rel=0.05)
    blobs = np.zeros((MAXIMUM_BLOBS, BLOB_SIZE))
    assert detect_blobs(image, BEACON_COLOURS, blobs) == (0, 0)


def test_images_are_a_function_of_seed_and_frame():
    spots = grid_of_spots(300.0, np.random.default_rng(0))
    first, again, other = (
        render_spots(spots, 45, STILL, 1.0, CAMERA, KEY, frame) for frame in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


def test_light_of_a_spot_in_the_image():
    """The sum of the image over the background is the volume of the spot's Gaussian."""
    spots = grid_of_spots(150.0, np.random.default_rng(0), 1)
    with_spot = render_spots(spots, 1, STILL, 1.0, CAMERA, KEY, 0)
    without = render_spots(spots, 0, STILL, 1.0, CAMERA, KEY, 0)
    light = (with_spot[1].astype(float) - without[1]).sum()
    # Bloom adds its part; what is below half a grey level is not drawn.
    assert light == pytest.approx(2.0 * np.pi * SPOT_SIGMA**2 * 150.0, rel=0.05)


# -- blobs


@pytest.mark.parametrize("name", ["yellow", "red", "green"])
def test_colours_are_told_apart_whatever_the_exposure(name):
    beacon = ["yellow", "red", "green"].index(name)
    for peak in (80.0, 400.0, 5000.0):
        spots = grid_of_spots(peak, np.random.default_rng(3), colour=COLOURS[name])
        seen, _, sampled, _ = both(spots, 45, STILL)
        assert len(seen) == 45
        assert set(seen[:, BLOB_COLOUR]) == {beacon}
        assert set(sampled[:, BLOB_COLOUR]) == {beacon}


def test_white_glints_have_no_beacons_colour():
    spots = grid_of_spots(300.0, np.random.default_rng(3), colour=COLOURS["white"])
    seen, _, sampled, _ = both(spots, 45, STILL)
    assert set(seen[:, BLOB_COLOUR]) == set(sampled[:, BLOB_COLOUR]) == {-1.0}


def test_blobs_cut_by_the_border_are_left_out():
    spots = np.zeros((MAXIMUM_SPOTS, SPOT_SIZE))
    spots[:2, SPOT_PEAK] = 200.0
    spots[:2, 4:7] = GREEN
    spots[0, :2], spots[1, :2] = (1.0, 300.0), (300.0, 300.0)
    seen, _, sampled, _ = both(spots, 2, STILL)
    assert len(seen) == len(sampled) == 1


@pytest.mark.parametrize("apart", [1.5, 3.0, 5.0, 9.0])
def test_near_spots_merge_in_both_fidelities(apart):
    spots = np.zeros((MAXIMUM_SPOTS, SPOT_SIZE))
    spots[:2, SPOT_PEAK] = 150.0
    spots[:2, 4:7] = GREEN
    spots[0, :2], spots[1, :2] = (300.2, 300.3), (300.2 + apart, 300.3)
    seen, _, sampled, _ = both(spots, 2, STILL)
    assert len(seen) == len(sampled)


# -- the two fidelities


@pytest.mark.parametrize("smear", [0.0, 2.5, 5.0])
@pytest.mark.parametrize("peak", [60.0, 100.0, 500.0, 5000.0])
def test_sampled_blobs_are_like_those_of_images(peak, smear):
    """Detection, bias, centroid noise, area and mass over brightness and motion blur."""
    rng = np.random.default_rng(int(peak + 10 * smear))
    errors, areas, masses, counts = [], [], [], []
    for frame in range(3):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        way = smear * np.array([np.cos(angle), np.sin(angle)])
        spots = grid_of_spots(peak, rng)
        seen, _, sampled, _ = both(spots, 45, way, 1.0, frame)
        counts.append((len(seen), len(sampled)))
        if len(seen) == 0 or len(sampled) == 0:
            continue
        way_off = seen[:, None, :2] - spots[None, :45, :2]
        nearest = np.argmin(np.sum(way_off**2, axis=2), axis=1)
        errors.append(way_off[np.arange(len(seen)), nearest])
        areas.append(seen[:, BLOB_AREA].mean() / sampled[:, BLOB_AREA].mean())
        masses.append(seen[:, BLOB_MASS].mean() / sampled[:, BLOB_MASS].mean())
    in_images, in_samples = np.mean(counts, axis=0) / 45.0
    assert in_images == pytest.approx(in_samples, abs=0.3)
    if in_images < 0.5:
        return
    error = np.concatenate(errors)
    wide = np.sqrt(1.0 + smear**2 / (12.0 * SPOT_SIGMA**2))  # a little less than the model's
    assert np.abs(error.mean(axis=0)).max() < 0.02  # px
    assert 0.5 < error.std() / centroid_noise(peak / wide) < 2.0
    assert np.mean(areas) == pytest.approx(1.0, abs=0.25)
    assert np.mean(masses) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("height", [3.0, 10.0, 20.0, 50.0, 100.0, 200.0])
def test_beacons_look_alike_in_both_fidelities(height):
    """The same blobs, colours and saturation from every height, with the exposure settled."""
    lamps = SvgsBeaconsConfig().lamps()
    x, y = (-1.7, 0.0) if height <= 20.0 else (-3.2, -1.5)
    gain = 1.0
    spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
    for frame in range(16):
        count = project_lamps(exposure_from(height, x, y), lamps, gain, CAMERA, spots)
        seen, saturated, sampled, expected = both(spots, count, STILL, gain, frame)
        used = gain
        gain = next_gain(gain, saturated)
    assert len(seen) == len(sampled)
    assert sorted(seen[:, BLOB_COLOUR]) == sorted(sampled[:, BLOB_COLOUR])
    assert saturated == pytest.approx(expected, rel=0.3, abs=12)
    assert used == 1.0 or saturated < 1200
    assert np.all(seen[:, BLOB_PEAK] >= SEED_LEVEL)


def test_glints_of_the_configuration_are_lamps():
    config = SvgsBeaconsConfig(glints=[SvgsGlint(position=[5.0, 0.0, 0.0], colour="red")])
    lamps = config.lamps()
    assert lamps.shape == (13, LAMP_SIZE)
    np.testing.assert_allclose(lamps[12, :3], [5.0, 0.0, 0.0])


def test_exposure_steps():
    assert next_gain(0.5, 5000) == pytest.approx(0.5 / np.sqrt(2.0))
    assert next_gain(0.5, 0) == pytest.approx(0.5 * np.sqrt(2.0))
    assert next_gain(0.5, 800) == 0.5
    assert next_gain(1.0, 0) == 1.0

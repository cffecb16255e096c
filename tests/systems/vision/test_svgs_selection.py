"""Which blobs are the beacon: Algorithm 1, the geometric check, and the variant without guesses."""

import itertools

import numpy as np
import pytest

from plants.svgs_beacons import SvgsBeaconsConfig
from systems.signals.measurement import SVGS, no_measurement
from systems.signals.noise import stream_key
from systems.vision import svgs_selection as selection
from systems.vision.pinhole import pinhole_camera
from systems.vision.planar_pose import quaternion_from_matrix
from systems.vision.svgs_blobs import BLOB_SIZE, MAXIMUM_BLOBS
from systems.vision.svgs_pose import ANGLES, moved, predict, up_of_pose

CAMERA = pinhole_camera(800, 800, 604.0)
CONFIG = SvgsBeaconsConfig()
LEDS, PLACEMENTS = CONFIG.led_positions(), CONFIG.placements()
LONG = 2
KEY = stream_key(3, "test")


def options(variant: str) -> np.ndarray:
    values = np.zeros(selection.OPTIONS)
    values[selection.VARIANT] = selection.VARIANTS.index(variant)
    values[selection.PIXEL_NOISE] = 0.1
    values[selection.GATE] = 0.35
    values[selection.GRAVITY_NOISE] = 0.007
    values[selection.PUBLISHED_BOUND] = 16
    values[selection.PUBLISHED_TOLERANCE] = 0.2
    return values


def pose_from(height: float, turn: float = 0.3, tilt: float = 0.03) -> np.ndarray:
    """The long-range beacon from a camera that looks down from some height."""
    R_CT = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    pose = np.array([2.0, -3.0, height, *quaternion_from_matrix(R_CT)])
    return moved(pose, np.array([0.0, 0.0, 0.0, tilt, -0.5 * tilt, turn]))


def led_pixels(pose: np.ndarray, beacon: int = LONG) -> np.ndarray:
    angles, jacobian = np.empty(ANGLES), np.empty((ANGLES, 6))
    assert predict(LEDS[beacon], pose, angles, jacobian)
    azimuth, elevation = angles[::2], angles[1::2]
    x = np.tan(azimuth)
    y = np.tan(elevation) * np.sqrt(1.0 + x * x)
    return 399.5 + 604.0 * np.column_stack([x, y])


def frame_of(pixels: np.ndarray, ratios=None, beacon: int = LONG) -> tuple[np.ndarray, int]:
    """Blobs at `pixels`, in this order."""
    blobs = np.zeros((MAXIMUM_BLOBS, BLOB_SIZE))
    count = len(pixels)
    blobs[:count, :2] = pixels
    blobs[:count, 3] = 10.0
    blobs[:count, 2] = 10.0 * (np.full(count, 50.0) if ratios is None else ratios)
    blobs[:count, 4] = beacon
    return blobs, count


class Phone:
    """The memories of one phone, and `select` on them."""

    def __init__(self, variant: str):
        self.options = options(variant)
        self.last, self.track = np.zeros((3, 8)), np.zeros(selection.TRACK.size)
        self.measurement = no_measurement(SVGS)
        self.frame = -1

    def see(self, blobs, count, up, time, frame=LONG):
        selection.select(
            blobs, count, LEDS, PLACEMENTS, CAMERA, up, time, frame, self.options, self.last,
            self.track, self.measurement,
        )  # fmt: skip
        return SVGS(self.measurement)


def used_pixels(measurement) -> np.ndarray:
    first = SVGS.index("led_0_u")
    return np.asarray(measurement[:])[first : first + 8].reshape(4, 2)


def test_indices_are_those_of_the_layouts():
    names = ("beacon", "error_code", "blob_count", "p_CT_x", "q_CT_w", "covariance_00",
             "reprojection_error", "led_0_u")  # fmt: skip
    s = selection
    own = [s._BEACON, s._ERROR, s._BLOBS, s._P, s._Q, s._COVARIANCE, s._REPROJECTION, s._LED]
    assert [SVGS.index(name) for name in names] == own
    assert SVGS.index("covariance_55") == selection._COVARIANCE + 20
    names = ("confirmations", "time", "height", "height_sigma", "yaw")
    assert selection.TRACK.fields == names


# -- Algorithm 1


def brute_force(ratios: np.ndarray) -> float:
    return min(np.var(four) for four in itertools.combinations(ratios, 4))


@pytest.mark.parametrize("count", [4, 5, 8, 12])
def test_least_deviation_is_the_minimum_over_all_combinations(count):
    rng = np.random.default_rng(count)
    for _ in range(20):
        ratios = rng.uniform(10.0, 100.0, count)
        chosen = np.zeros(4, np.int64)
        variance = selection.least_deviation(ratios, chosen)
        assert variance == pytest.approx(brute_force(ratios))
        assert variance == pytest.approx(np.var(ratios[chosen]))


def test_assignment_by_distances():
    rng = np.random.default_rng(0)
    expected = led_pixels(pose_from(120.0))
    for order in itertools.permutations(range(4)):
        turn = rng.uniform(0.0, 2.0 * np.pi)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        points = (1.7 * expected @ R.T + 30.0)[list(order)]
        assigned = np.zeros(4, np.int64)
        assert selection.assign_by_geometry(points, expected, assigned) < 1e-9
        np.testing.assert_allclose(points[assigned], 1.7 * expected @ R.T + 30.0)


def test_a_mirrored_beacon_does_not_fit():
    expected = led_pixels(pose_from(120.0))
    mirrored = expected * [-1.0, 1.0]
    assigned = np.zeros(4, np.int64)
    assert selection.assign_by_geometry(mirrored, expected, assigned) > 0.005


# -- a frame


@pytest.mark.parametrize("variant", selection.VARIANTS)
def test_four_clean_blobs_give_the_pose(variant):
    pose = pose_from(120.0)
    phone = Phone(variant)
    for time in (0.0, 0.1):  # the robust variant answers from the second frame on
        view = phone.see(*frame_of(led_pixels(pose)), up_of_pose(pose), time)
    assert (view.valid, view.error_code, view.beacon) == (1.0, selection.POSE, LONG)
    np.testing.assert_allclose([view.p_CT_x, view.p_CT_y, view.p_CT_z], pose[:3], atol=1e-4)
    q = np.array([view.q_CT_w, view.q_CT_x, view.q_CT_y, view.q_CT_z])
    assert abs(q @ pose[3:]) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(used_pixels(view), led_pixels(pose), atol=1e-9)
    assert view.covariance_22 > 0.0
    assert view.reprojection_error < 1e-3


@pytest.mark.parametrize("variant", selection.VARIANTS)
def test_error_codes(variant):
    pose = pose_from(120.0)
    up, pixels = up_of_pose(pose), led_pixels(pose)
    assert Phone(variant).see(*frame_of(pixels[:0]), up, 0.0).error_code == selection.NO_BLOBS
    assert Phone(variant).see(*frame_of(pixels[:3]), up, 0.0).error_code == selection.TOO_FEW_BLOBS
    line = np.column_stack([np.linspace(100.0, 700.0, 4), np.full(4, 400.0)])
    view = Phone(variant).see(*frame_of(line), up, 0.0)
    assert (view.valid, view.error_code) == (0.0, selection.BAD_GEOMETRY)
    assert view.beacon == -1.0


def test_published_bound_on_the_number_of_blobs():
    pose = pose_from(120.0)
    rng = np.random.default_rng(0)
    pixels = np.vstack([led_pixels(pose), rng.uniform(0.0, 799.0, (13, 2))])
    view = Phone("published").see(*frame_of(pixels), up_of_pose(pose), 0.0)
    assert view.error_code == selection.TOO_MANY_BLOBS


def test_robust_begins_with_an_unconfirmed_pose():
    pose = pose_from(120.0)
    phone = Phone("robust")
    view = phone.see(*frame_of(led_pixels(pose)), up_of_pose(pose), 0.0)
    assert (view.valid, view.error_code) == (0.0, selection.UNCONFIRMED)
    # A second one far from the first is none either: another height cannot be reached so soon.
    far = pose_from(60.0)
    view = phone.see(*frame_of(led_pixels(far)), up_of_pose(far), 0.1)
    assert view.valid == 0.0


def test_robust_does_not_guess_between_two_beacons():
    one, two = pose_from(120.0), pose_from(121.0)
    two[:2] += 20.0
    pixels = np.vstack([led_pixels(one), led_pixels(two)])
    view = Phone("robust").see(*frame_of(pixels), up_of_pose(one), 0.0)
    assert (view.valid, view.error_code) == (0.0, selection.AMBIGUOUS)


def test_robust_refuses_a_beacon_that_does_not_stand_upright():
    pose = pose_from(120.0)
    leaning = moved(pose, np.array([0.0, 0.0, 0.0, 0.15, 0.0, 0.0]))
    view = Phone("robust").see(*frame_of(led_pixels(pose)), up_of_pose(leaning), 0.0)
    assert (view.valid, view.error_code) == (0.0, selection.BAD_GEOMETRY)


# -- glints


def glint_run(variant: str, glints: int, frames: int, seed: int = 0) -> tuple[int, int]:
    """Frames with the right pose and with a wrong one, of a slow descent under glints."""
    rng = np.random.default_rng(seed)
    phone = Phone(variant)
    right = wrong = 0
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    for k in range(frames):
        time = 0.1 * k
        tilt = 0.05 * np.sin(0.9 * time + phase[0])
        pose = pose_from(180.0 - 0.5 * (time % 200.0), 0.3 * np.sin(0.1 * time + phase[1]), tilt)
        pixels = led_pixels(pose)
        seen = np.vstack([pixels + rng.normal(0.0, 0.04, (4, 2)),
                          rng.uniform(2.0, 797.0, (glints, 2))])  # fmt: skip
        ratios = np.concatenate([rng.normal(50.0, 1.5, 4), rng.uniform(25.0, 100.0, glints)])
        order = rng.permutation(len(seen))
        gravity = up_of_pose(moved(pose, np.concatenate([np.zeros(3), rng.normal(0, 0.007, 3)])))
        blobs, count = frame_of(seen[order], ratios[order])
        view = phone.see(blobs, count, gravity, time, LONG + k * 3)
        if view.valid:
            good = np.abs(used_pixels(view) - pixels).max() < 1.0
            right, wrong = right + good, wrong + (not good)
    return right, wrong


@pytest.mark.parametrize("glints", [0, 4, 12])
def test_robust_is_right_and_never_wrong(glints):
    frames = 1000
    right, wrong = glint_run("robust", glints, frames)
    assert wrong == 0
    assert right >= 0.99 * frames


def test_published_takes_wrong_blobs_among_glints():
    """What the robust variant is for: the published one reports wrong poses as good ones."""
    right, wrong = glint_run("published", 4, 600)
    assert wrong > 0
    assert right < 0.9 * 600

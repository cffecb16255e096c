"""The SVGS benchmark's tables, at a few frames a row."""

import numpy as np

from benchmarks.svgs_camera import (
    GLINTS,
    HEIGHTS,
    accuracy_table,
    centroid_bound,
    glint_table,
)
from systems.vision.svgs_blobs import (
    READ_NOISE,
    SPOT_PEAK,
    SPOT_RED,
    SPOT_SIZE,
    SPOT_U,
    SPOT_V,
)


def test_no_pose_beats_the_bound_and_a_faint_beacons_comes_near():
    rows = [row.split() for row in accuracy_table("geometric", frames=60)[2:]]
    assert [float(row[0]) for row in rows] == list(HEIGHTS)
    for row in rows:
        lateral, lateral_bound, distance, distance_bound = (float(x) for x in row[3:7])
        assert lateral > lateral_bound
        assert distance > distance_bound
    assert lateral < 4.0 * lateral_bound  # from 200 m: no saturated pixel
    assert distance < 4.0 * distance_bound


def test_the_bound_of_a_faint_spot_is_that_of_a_gaussian_in_white_noise():
    spot = np.zeros(SPOT_SIZE)
    spot[[SPOT_U, SPOT_V, SPOT_PEAK, SPOT_RED + 1]] = 100.3, 200.8, 5.0, 1.0
    # The integral over the plane of (dI/du)² is π/2 times the peak squared, whatever its width
    noise = np.sqrt(READ_NOISE**2 + 1.0 / 12.0)
    expected = noise / spot[SPOT_PEAK] * np.sqrt(2.0 / np.pi)
    still = np.zeros(2)
    np.testing.assert_allclose(centroid_bound(spot, still, 1.0), expected, rtol=0.03)
    along, across = centroid_bound(spot, np.array([4.0, 0.0]), 1.0)
    assert along > across


def test_glint_table_has_both_variants():
    rows = [row.split() for row in glint_table(frames=40)[1:]]
    assert len(rows) == 2 * len(GLINTS)
    assert {row[1] for row in rows} == {"published", "robust"}
    assert all(float(row[3]) == 0.0 for row in rows if row[1] == "robust")

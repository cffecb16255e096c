"""The fused sensor front end: the four cases of the thesis, levelling, freshness."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from systems.estimators.fused_sensor import FusedSensor, FusedSensorConfig
from systems.signals.measurement import (
    INFRARED,
    MARKER,
    RANGE_FINDER,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.estimators.target_cases import PERIOD, Bench

# A vehicle 4 m above a pad that is ahead and to the left; the body's axes, and the camera
# that looks down with its image's top to the front: x_C = −y_B, y_C = −x_B, z_C = −z_B.
HEIGHT = 4.0
P_BP_W = np.array([0.6, 0.9, -HEIGHT])
ATTITUDE = Rotation.from_euler("ZYX", [0.7, 0.08, -0.05])
R_BC = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
CAMERAS = {"infrared": [0.05, 0.03, -0.05], "marker": [-0.04, 0.02, -0.06]}


def estimate(attitude=ATTITUDE, height=None):
    values = VEHICLE_ESTIMATE.zeros()
    values[VEHICLE_ESTIMATE.slice("q_WB")] = np.roll(attitude.as_quat(), 1)
    if height is not None:
        values[VEHICLE_ESTIMATE.index("height_above_ground")] = height
        values[VEHICLE_ESTIMATE.index("height_above_ground_valid")] = 1.0
    return values


def in_camera(p_BP_W, camera, attitude=ATTITUDE):
    p_BP_B = attitude.inv().apply(p_BP_W)
    return R_BC.T @ (p_BP_B - CAMERAS[camera])


def infrared(arrival, p_BP_W=P_BP_W, latency=0.02, attitude=ATTITUDE):
    values = INFRARED.zeros()
    values[:4] = arrival - latency, arrival, 0.0, 1.0
    x, y, z = in_camera(p_BP_W, "infrared", attitude)
    values[INFRARED.index("count")] = 1.0
    values[INFRARED.index("blob_0_x")] = x / z
    values[INFRARED.index("blob_0_y")] = y / z
    return values


def marker(arrival, p_BP_W=P_BP_W, latency=0.05):
    values = MARKER.zeros()
    values[:4] = arrival - latency, arrival, 0.0, 1.0
    p = in_camera(p_BP_W, "marker")
    values[MARKER.slice("bearing_C")] = p / np.linalg.norm(p)
    values[MARKER.index("range")] = np.linalg.norm(p)
    for name, variance in (("xx", 1e-6), ("yy", 1e-6), ("rr", 1e-4)):
        values[MARKER.index(f"covariance_{name}")] = variance
    return values


def ranging(arrival, height=HEIGHT, attitude=ATTITUDE):
    """What a beam along −z_B from the body's origin measures over flat ground."""
    values = RANGE_FINDER.zeros()
    values[:4] = arrival, arrival, 0.0, 1.0
    values[RANGE_FINDER.index("range")] = height / attitude.as_matrix()[2, 2]
    return values


NO = {
    "infrared": no_measurement(INFRARED),
    "marker": no_measurement(MARKER),
    "range_finder": no_measurement(RANGE_FINDER),
    "estimate": estimate(),
}


def front_end(**fields) -> Bench:
    cameras = {
        "infrared_position": CAMERAS["infrared"],
        "marker_position": CAMERAS["marker"],
        "attitude_lag": 0.0,
    }
    return Bench(FusedSensor(FusedSensorConfig(**{**cameras, **fields})))


def poll(bench, k, **inputs):
    return TARGET_MEASUREMENT(bench.step(k, **{**NO, **inputs}))


def position(measurement):
    return measurement[TARGET_MEASUREMENT.slice("p_BP_W")]


def test_topology():
    assert_matches_docstring(FusedSensor(FusedSensorConfig()))


def test_schedule_and_initial_state():
    system = FusedSensor(FusedSensorConfig())
    assert periodic_update(system) == (0.02, 0.0)
    output = system.get_output_port(0).Eval(system.CreateDefaultContext())
    np.testing.assert_array_equal(output, no_measurement(TARGET_MEASUREMENT))


def test_infrared_alone_takes_its_height_from_the_range_finder():
    found = poll(front_end(), 0, infrared=infrared(0.0), range_finder=ranging(0.0))
    np.testing.assert_allclose(position(found), P_BP_W, atol=1e-12)
    assert (found.valid, found.source) == (1.0, 1.0)
    assert found.time_of_validity == pytest.approx(-0.02)
    assert found.time_of_arrival == 0.0


def test_infrared_without_range_takes_the_estimated_height():
    found = poll(front_end(), 0, infrared=infrared(0.0), estimate=estimate(height=HEIGHT))
    np.testing.assert_allclose(position(found), P_BP_W, atol=1e-12)


def test_infrared_without_any_height_gives_no_value():
    found = poll(front_end(), 0, infrared=infrared(0.0))
    assert found.valid == 0.0
    assert found.sequence_number == -1.0


def test_range_that_is_too_old_is_not_used():
    found = poll(front_end(), 0, infrared=infrared(0.0), range_finder=ranging(-0.6))
    assert found.valid == 0.0


def test_marker_alone_needs_no_height():
    found = poll(front_end(), 0, marker=marker(0.0))
    np.testing.assert_allclose(position(found), P_BP_W, atol=1e-12)
    assert (found.valid, found.source) == (1.0, 2.0)
    assert found.covariance_zz == pytest.approx(1e-4, rel=0.2)


def test_both_are_averaged_horizontally_with_the_weights():
    beside = P_BP_W + np.array([0.3, -0.2, 0.0])
    found = poll(
        front_end(infrared_weight=0.25),
        0,
        infrared=infrared(0.0, beside),
        marker=marker(0.0),
        range_finder=ranging(0.0, 7.0),  # not asked
    )
    expected = 0.25 * beside + 0.75 * P_BP_W
    np.testing.assert_allclose(position(found), expected, atol=1e-12)
    assert found.source == 3.0
    assert found.time_of_validity == pytest.approx(-0.25 * 0.02 - 0.75 * 0.05)


def test_averaged_covariance_is_that_of_the_draws():
    """The reported covariance against the scatter of noisy bearings and ranges."""
    rng = np.random.default_rng(2)
    sigma = 0.003
    bench = front_end(infrared_weight=0.4, infrared_angle_noise=sigma)
    draws = []
    for k in range(1500):
        seen_infrared = infrared(k + 1.0)
        seen_marker = marker(k + 1.0)
        for axis in "xy":
            noise = sigma * rng.standard_normal()
            seen_infrared[INFRARED.index(f"blob_0_{axis}")] += noise
            noise = 1e-3 * rng.standard_normal()
            seen_marker[MARKER.index(f"bearing_C_{axis}")] += noise
        x, y, _ = seen_marker[MARKER.slice("bearing_C")]
        seen_marker[MARKER.index("bearing_C_z")] = np.sqrt(1 - x * x - y * y)
        seen_marker[MARKER.index("range")] += 1e-2 * rng.standard_normal()
        found = poll(bench, k, infrared=seen_infrared, marker=seen_marker)
        draws.append(position(found).copy())
    scatter = np.cov(np.array(draws).T)
    reported = [found.covariance_xx, found.covariance_yy, found.covariance_zz]
    np.testing.assert_allclose(reported, np.diag(scatter), rtol=0.2)


@pytest.mark.parametrize(("mode", "source"), [("infrared", 1.0), ("marker", 2.0)])
def test_mode_listens_to_one_sensor(mode, source):
    inputs = {"infrared": infrared(0.0), "marker": marker(0.0), "range_finder": ranging(0.0)}
    assert poll(front_end(mode=mode), 0, **inputs).source == source


def test_value_is_taken_once_and_is_valid_while_fresh():
    bench = front_end()
    first = poll(bench, 0, marker=marker(0.0))
    polls = round(1.0 / PERIOD)
    kept = poll(bench, polls - 1, marker=marker(0.0))
    np.testing.assert_array_equal(kept[:], first[:])
    stale = poll(bench, polls + 1, marker=marker(0.0))
    assert stale.valid == 0.0
    assert stale.time_of_arrival == first.time_of_arrival
    fresh = poll(bench, polls + 2, marker=marker(1.0))
    assert (fresh.valid, fresh.sequence_number) == (1.0, 1.0)


def test_new_but_invalid_sample_is_no_value():
    unseen = marker(0.02)
    unseen[3] = 0.0
    bench = front_end()
    poll(bench, 0, marker=marker(0.0))
    assert poll(bench, 1, marker=unseen).sequence_number == 0.0


def test_attitude_is_as_old_as_its_lag():
    """Levelled with the attitude of 6 polls ago, a value seen then is right."""
    bench = front_end(attitude_lag=6 * PERIOD)
    turned = Rotation.from_euler("ZYX", [0.7, 0.3, 0.2])
    for k in range(20):
        poll(bench, k)
    for k in range(20, 25):
        poll(bench, k, estimate=estimate(turned))
    inputs = {"infrared": infrared(0.4), "estimate": estimate(turned, HEIGHT)}
    found = poll(bench, 25, **inputs)
    np.testing.assert_allclose(position(found), P_BP_W, atol=1e-12)
    inputs["infrared"] = infrared(0.5, attitude=turned)
    found = poll(bench, 26, **inputs)
    np.testing.assert_allclose(position(found), P_BP_W, atol=1e-12)


def test_range_finder_beside_the_origin():
    place = np.array([0.2, -0.1, -0.08])
    lift = ATTITUDE.apply(place)[2]
    values = ranging(0.0)
    values[RANGE_FINDER.index("range")] = (HEIGHT + lift) / ATTITUDE.as_matrix()[2, 2]
    found = poll(
        front_end(range_finder_position=list(place)), 0, infrared=infrared(0.0), range_finder=values
    )
    np.testing.assert_allclose(position(found), P_BP_W, atol=1e-12)

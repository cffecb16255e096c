"""The simulated log: its truth is a motion, and an ideal strap-down follows it."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from runs.simulated_log import MATCHED, REST, Errors, Rates, simulated_log, without
from systems.estimators.ekf2.geometry import EARTH_SPIN, normal_gravity
from systems.signals import sensor_log as logs

PERFECT = Errors(**{field.name: 0.0 for field in fields(Errors)})


def test_increments_integrate_to_the_truth():
    samples, truth = simulated_log(0, 30.0, PERFECT)
    _, imu = samples.of(logs.IMU)
    latitude = np.radians(47.3977)
    earth = EARTH_SPIN * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])
    gravity = np.array([0.0, 0.0, normal_gravity(latitude)])
    attitude = Rotation.from_quat(np.roll(truth.attitude[0], -1))
    velocity = truth.velocity[0].copy()
    for row in imu[1:]:
        half = attitude * Rotation.from_rotvec(0.5 * row[1:4])
        attitude = attitude * Rotation.from_rotvec(row[1:4] - attitude.inv().apply(earth) * 0.004)
        velocity += half.apply(row[4:7]) + (gravity - 2.0 * np.cross(earth, velocity)) * 0.004
    final = Rotation.from_quat(np.roll(truth.attitude[-1], -1))
    assert (final * attitude.inv()).magnitude() < 1e-5
    np.testing.assert_allclose(velocity, truth.velocity[-1], atol=2e-3)
    steps = 0.004 * 0.5 * (truth.velocity[1:] + truth.velocity[:-1])
    np.testing.assert_allclose(steps.sum(axis=0), truth.position[-1] - truth.position[0], atol=1e-3)
    resting = truth.time < 1e6 + REST * 1e6
    assert np.abs(truth.position[resting]).max() == 0.0


def test_is_a_function_of_the_seed():
    (first, _), (again, _), (other, _) = (simulated_log(seed, 5.0) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.rows, again.rows)
    assert not np.array_equal(first.rows, other.rows)


def test_rates_and_delays():
    rates = Rates(gnss=5.0, vision=10.0, vision_delay=0.2, vision_outliers=(3.0,))
    samples, truth = simulated_log(0, 5.0, MATCHED, rates)
    arrivals, gnss = samples.of(logs.GNSS)
    assert np.diff(arrivals) == pytest.approx(200e3)
    assert arrivals - gnss[:, 0] == pytest.approx(110e3)
    arrivals, vision = samples.of(logs.EXTERNAL_VISION)
    np.testing.assert_array_equal(arrivals, vision[:, 0])
    north = vision[:, 1] - np.interp(arrivals - 200e3, truth.time, truth.position[:, 0])
    assert (np.abs(north) > 10.0).sum() == 1
    assert (np.diff(samples.arrivals) >= 0.0).all()


def test_thinning():
    samples, _ = simulated_log(0, 5.0)
    count = np.count_nonzero
    thin = without(samples, logs.MAGNETOMETER, keep_every=10)
    assert count(thin.kinds == logs.MAGNETOMETER) == -(-count(samples.kinds == 3) // 10)
    assert logs.BAROMETER not in without(samples, logs.BAROMETER).kinds

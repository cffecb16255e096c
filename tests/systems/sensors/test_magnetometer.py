"""The magnetometer: the field in B, noise, hard and soft iron."""

import math

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from systems.sensors.magnetometer import MAGNETOMETER_PERIOD, Magnetometer, MagnetometerConfig
from systems.signals.measurement import BODY_STATE, MAGNETOMETER, no_measurement
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench

FIELD = MAGNETOMETER.slice("field_B")
QUIET = {"noise": 0.0, "hard_iron": 0.0, "soft_iron": 0.0}
EARTH = [0.02, 0.26, -0.39]  # gauss


def body(roll=0.0, pitch=0.0, yaw=0.0) -> np.ndarray:
    state = BODY_STATE.zeros()
    state[:4] = RollPitchYaw(roll, pitch, yaw).ToQuaternion().wxyz()
    return state


def record(config: MagnetometerConfig, state, duration=0.1, seed: int = 1) -> np.ndarray:
    run = Bench(Magnetometer(config, seed), {"body": state}, log_period=MAGNETOMETER_PERIOD)
    return run.advance_to(duration).arrivals()


def test_topology():
    magnetometer = Magnetometer(MagnetometerConfig())
    assert_matches_docstring(magnetometer)
    assert periodic_update(magnetometer) == (0.08, 0.0)


def test_starts_with_no_measurement():
    run = Bench(Magnetometer(MagnetometerConfig()), {"body": body()})
    np.testing.assert_array_equal(run.advance_to(0.0).values()[0], no_measurement(MAGNETOMETER))


def test_header():
    out = record(MagnetometerConfig(), body(), 1.0)
    np.testing.assert_allclose(out[:, 0], 0.08 * np.arange(len(out)), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out[:, 0], out[:, 1])
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))
    assert out[:, 3].all()


@pytest.mark.parametrize("attitude", [(0, 0, 0), (0, 0, 1.0), (0.3, -0.4, 2.0), (3.0, 0.1, -1.0)])
def test_field_is_the_earth_s_seen_from_the_body(attitude):
    config = MagnetometerConfig(earth_field=EARTH, **QUIET)
    R_WB = RollPitchYaw(*attitude).ToRotationMatrix()
    measured = record(config, body(*attitude))[-1, FIELD]
    np.testing.assert_allclose(measured, R_WB.inverse() @ np.array(EARTH), atol=1e-15)


def test_facing_magnetic_north_the_field_is_ahead_and_down():
    config = MagnetometerConfig(earth_field=EARTH, **QUIET)
    measured = record(config, body(yaw=math.atan2(EARTH[1], EARTH[0])))[-1, FIELD]
    np.testing.assert_allclose(
        measured, [math.hypot(EARTH[0], EARTH[1]), 0.0, EARTH[2]], atol=1e-15
    )


def test_default_field_is_that_of_the_default_origin():
    """WMM2025 for Volos in mid 2025: 0.4691 G, declination 5.16 deg, inclination 56.46 deg."""
    east, north, up = MagnetometerConfig().earth_field
    assert math.hypot(east, north, up) == pytest.approx(0.4691, abs=1e-4)
    assert math.degrees(math.atan2(east, north)) == pytest.approx(5.16, abs=0.02)
    assert math.degrees(math.atan2(-up, math.hypot(east, north))) == pytest.approx(56.46, abs=0.02)


def test_noise():
    config = MagnetometerConfig(earth_field=EARTH, hard_iron=0.0, soft_iron=0.0)
    noise = record(config, body(), 64.0)[:, FIELD] - EARTH
    np.testing.assert_allclose(noise.std(axis=0), 0.0035, rtol=4.0 / math.sqrt(2 * len(noise)))
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 4.0 / math.sqrt(len(noise))


def test_iron_has_its_spread():
    hard = MagnetometerConfig(earth_field=[0.0, 0.0, 0.0], noise=0.0)
    drawn = np.array([record(hard, body(), seed=seed)[-1, FIELD] for seed in range(80)])
    assert drawn.std() == pytest.approx(0.01, rel=4.0 / math.sqrt(2 * drawn.size))
    soft = MagnetometerConfig(earth_field=[1.0, 0.0, 0.0], noise=0.0, hard_iron=0.0)
    drawn = np.array([record(soft, body(), seed=seed)[-1, FIELD] for seed in range(80)])
    drawn -= [1.0, 0.0, 0.0]
    assert drawn.std() == pytest.approx(0.01, rel=4.0 / math.sqrt(2 * drawn.size))


def test_iron_turns_with_the_vehicle():
    config = MagnetometerConfig(earth_field=EARTH, noise=0.0, soft_iron=0.0)
    offsets = [
        record(config, body(yaw=yaw))[-1, FIELD]
        - RollPitchYaw(0, 0, yaw).ToRotationMatrix().inverse() @ np.array(EARTH)
        for yaw in (0.0, 1.0, 2.0)
    ]
    np.testing.assert_allclose(offsets, np.tile(offsets[0], (3, 1)), atol=1e-15)
    assert np.abs(offsets[0]).min() > 0.0


def test_deterministic_by_seed():
    first = record(MagnetometerConfig(), body(), 1.0, 1)
    np.testing.assert_array_equal(first, record(MagnetometerConfig(), body(), 1.0, 1))
    assert (record(MagnetometerConfig(), body(), 1.0, 2)[:, FIELD] != first[:, FIELD]).all()


def test_configure_is_a_new_magnetometer():
    inputs = {"body": body()}
    run = Bench(Magnetometer(MagnetometerConfig(), 1), inputs, log_period=MAGNETOMETER_PERIOD)
    run.system.configure(MagnetometerConfig(noise=0.1), 5)
    expected = record(MagnetometerConfig(noise=0.1), body(), 1.0, 5)
    np.testing.assert_array_equal(run.advance_to(1.0).arrivals(), expected)

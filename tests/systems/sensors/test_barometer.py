"""The barometer: noise, drift with its time constant, the bubble under the rotors."""

import math

import numpy as np
import pytest

from systems.sensors.barometer import (
    BAROMETER_PERIOD,
    Barometer,
    BarometerConfig,
    ground_effect,
    metres_per_pascal,
)
from systems.signals.measurement import BAROMETER, BODY_STATE, no_measurement
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench

ALTITUDE = BAROMETER.index("altitude")
QUIET = {"noise": 0.0, "drift": 0.0}


def body(height=10.0, f_z=9.80665, contact_force=0.0) -> np.ndarray:
    state = BODY_STATE.zeros()
    state[0] = 1.0
    state[BODY_STATE.index("p_WB_z")] = height
    state[BODY_STATE.index("f_B_z")] = f_z
    state[BODY_STATE.index("contact_force")] = contact_force
    return state


def record(config: BarometerConfig, state, duration: float, seed: int = 1) -> np.ndarray:
    run = Bench(Barometer(config, seed), {"body": state}, log_period=BAROMETER_PERIOD)
    return run.advance_to(duration).arrivals()


def test_topology():
    barometer = Barometer(BarometerConfig())
    assert_matches_docstring(barometer)
    assert periodic_update(barometer) == (0.08, 0.0)


def test_starts_with_no_measurement():
    run = Bench(Barometer(BarometerConfig()), {"body": body()})
    np.testing.assert_array_equal(run.advance_to(0.0).values()[0], no_measurement(BAROMETER))


def test_header():
    out = record(BarometerConfig(), body(), 1.0)
    np.testing.assert_allclose(out[:, 0], 0.08 * np.arange(len(out)), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out[:, 0], out[:, 1])
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))
    assert out[:, 3].all()


def test_altitude_is_above_mean_sea_level():
    config = BarometerConfig(origin_altitude=488.0, ground_effect=0.0, **QUIET)
    assert record(config, body(12.5), 0.1)[-1, ALTITUDE] == 500.5


@pytest.mark.parametrize(
    ("altitude", "gradient"), [(0.0, 12.013), (488.0, 11.461), (1000.0, 10.90), (3000.0, 8.912)]
)
def test_pressure_gradient_is_the_standard_atmosphere_s(altitude, gradient):
    """ρ g of ISO 2533, Pa/m."""
    assert 1.0 / metres_per_pascal(altitude) == pytest.approx(gradient, rel=2e-3)


def test_white_noise_is_one_pascal():
    config = BarometerConfig(drift=0.0, ground_effect=0.0, origin_altitude=0.0)
    noise = record(config, body(), 64.0)[:, ALTITUDE] - 10.0
    assert noise.std() == pytest.approx(0.0832, rel=4.0 / math.sqrt(2 * len(noise)))
    assert abs(noise.mean()) < 4.0 * 0.0832 / math.sqrt(len(noise))
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 4.0 / math.sqrt(len(noise))


def test_drift_is_a_gauss_markov_process():
    """exp(−Δt/τ) between two samples, σ throughout; 1000 time constants."""
    config = BarometerConfig(noise=0.0, drift=2.0, drift_time=0.32, ground_effect=0.0)
    drift = record(config, body(), 320.0)[:, ALTITUDE] - 20.0
    assert drift.std() == pytest.approx(2.0, rel=0.12)
    for lag in (1, 5, 10, 20):
        correlation = np.corrcoef(drift[lag:], drift[:-lag])[0, 1]
        assert correlation == pytest.approx(math.exp(-0.08 * lag / 0.32), abs=0.1)


def test_drift_starts_at_its_spread():
    config = BarometerConfig(noise=0.0, drift=2.0, ground_effect=0.0)
    first = [record(config, body(), 0.08, seed)[0, ALTITUDE] - 20.0 for seed in range(100)]
    assert np.std(first) == pytest.approx(2.0, rel=4.0 / math.sqrt(200))


def test_default_drift_changes_by_what_users_report_in_ten_minutes():
    config = BarometerConfig()
    change = config.drift * math.sqrt(2.0 * (1.0 - math.exp(-600.0 / config.drift_time)))
    assert change == pytest.approx(1.5, rel=0.01)


def test_ground_effect():
    config = BarometerConfig(ground_effect=1.5, ground_effect_height=0.4, **QUIET)
    sinking = {
        height: height + 10.0 - record(config, body(height), 0.1)[-1, ALTITUDE]
        for height in (0.0, 0.4, 4.0)
    }
    assert sinking[0.0] == pytest.approx(1.5)
    assert sinking[0.4] == pytest.approx(0.75)
    assert sinking[4.0] < 0.02
    assert ground_effect(0.0, 2.0, 1.5, 0.4) == 3.0  # in proportion to the thrust


def test_no_ground_effect_while_the_ground_carries_the_vehicle():
    config = BarometerConfig(vehicle_mass=3.0, **QUIET)
    standing = body(0.0, contact_force=3.0 * 9.80665)
    assert record(config, standing, 0.1)[-1, ALTITUDE] == pytest.approx(10.0, abs=1e-12)


def test_deterministic_by_seed():
    first = record(BarometerConfig(), body(), 1.0, 1)
    np.testing.assert_array_equal(first, record(BarometerConfig(), body(), 1.0, 1))
    assert (record(BarometerConfig(), body(), 1.0, 2)[:, ALTITUDE] != first[:, ALTITUDE]).all()


def test_configure_is_a_new_barometer():
    run = Bench(Barometer(BarometerConfig(), 1), {"body": body()}, log_period=BAROMETER_PERIOD)
    run.system.configure(BarometerConfig(noise=3.0), 5)
    expected = record(BarometerConfig(noise=3.0), body(), 1.0, 5)
    np.testing.assert_array_equal(run.advance_to(1.0).arrivals(), expected)

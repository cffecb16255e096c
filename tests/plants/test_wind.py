"""The wind: MIL-F-8785C's numbers, the spectra against theory, gusts, and the system."""

import math

import numpy as np
import pytest
from numba import njit
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.linalg import expm
from scipy.signal import welch

from plants import wind_dynamics as dynamics
from plants.wind import GustConfig, Wind, WindConfig
from systems.signals.measurement import BODY_STATE
from systems.signals.noise import stream_key
from tests.system_contract import assert_matches_docstring, periodic_update

FOOT = 0.3048
STATIONARY = np.array([[0.5, 0.25], [0.25, 0.25]])  # covariance of (x₁, x₂)


class TestMilitarySpecification:
    def test_scales_meet_at_a_thousand_feet(self):
        """Where the low-altitude model ends turbulence is isotropic: L = 1000 ft, σ_u = σ_w."""
        assert dynamics.scales(1000 * FOOT) == pytest.approx((304.8, 304.8, 1.0))
        assert dynamics.scales(5000 * FOOT) == dynamics.scales(1000 * FOOT)

    def test_scales_at_a_hundred_feet(self):
        """By hand: 0.177 + 0.0823 = 0.2593; 100/0.2593^1.2 = 505.3; 0.2593^-0.4 = 1.716."""
        length_u, length_w, ratio = dynamics.scales(100 * FOOT)
        assert length_u / FOOT == pytest.approx(505.3, rel=1e-3)
        assert length_w / FOOT == pytest.approx(100.0)
        assert ratio == pytest.approx(1.716, rel=1e-3)

    def test_the_model_stops_at_ten_feet(self):
        assert dynamics.scales(0.0) == dynamics.scales(10 * FOOT)


@pytest.mark.parametrize("a", [1e-9, 1e-5, 1e-3, 0.00999, 0.01001, 0.1, 1.0, 5.0])
def test_the_discretisation_is_exact(a: float):
    """Against the matrix exponential of Van Loan, "Computing integrals" (1978)."""
    drift = np.array([[-1.0, 0.0], [1.0, -1.0]])
    van_loan = np.zeros((4, 4))
    van_loan[:2, :2] = -drift
    van_loan[:2, 2:] = np.diag([1.0, 0.0])
    van_loan[2:, 2:] = drift.T
    both = expm(van_loan * a)
    transition = both[2:, 2:].T
    l11, l21, l22 = dynamics.second_order_noise(a)
    L = np.array([[l11, 0.0], [l21, l22]])
    Q = L @ L.T
    scale = np.sqrt(np.outer([a, a**3], [a, a**3])) if a < 1.0 else np.ones((2, 2))
    np.testing.assert_allclose(Q / scale, transition @ both[:2, 2:] / scale, rtol=1e-6, atol=1e-6)

    states = np.eye(5)  # each unit state propagated without noise
    for state in states:
        dynamics.advance_turbulence(state, a, 2.0 * a, np.zeros(5))
    np.testing.assert_allclose(states[1:3, 1:3].T, transition, atol=1e-12)
    np.testing.assert_allclose(states[3:5, 3:5].T, transition @ transition, atol=1e-12)
    np.testing.assert_allclose(transition @ STATIONARY @ transition.T + Q, STATIONARY, atol=1e-12)


def test_the_first_sample_is_stationary():
    l11, l21, l22 = dynamics.second_order_noise(np.inf)
    L = np.array([[l11, 0.0], [l21, l22]])
    np.testing.assert_allclose(L @ L.T, STATIONARY)
    output = np.array([math.sqrt(3.0), 1.0 - math.sqrt(3.0)])
    assert output @ STATIONARY @ output == pytest.approx(1.0)
    parameters = WindConfig(speed=10.0).parameters()
    samples = np.empty((20_000, 3))
    for seed in range(len(samples)):
        state = np.zeros(6)
        dynamics.update(
            samples[seed], state, 30.48, np.zeros(3), 0.0, 0.04, np.uint64(seed), parameters
        )
        assert np.isfinite(state).all()
    expected = np.array([1.716, 1.716, 1.0])
    np.testing.assert_allclose(samples.std(axis=0), expected, rtol=0.02)  # four sigma
    np.testing.assert_allclose(samples.mean(axis=0), [10.0, 0.0, 0.0], atol=0.05)


@njit
def record(series, height, v_WB, period, key, parameters):
    state = np.zeros(6)
    for k in range(len(series)):
        dynamics.update(series[k], state, height, v_WB, 0.0, period, key, parameters)


def test_the_spectra_are_drydens():
    """Welch's estimate over 20 000 s in a 10 m/s wind at 100 ft, against Φ(ω/V)/V."""
    height, speed, period = 100 * FOOT, 10.0, 0.1
    series = np.empty((200_000, 3))
    parameters = WindConfig(speed=speed).parameters()
    record(series, height, np.zeros(3), period, stream_key(5, "spectra"), parameters)
    length_u, length_w, ratio = dynamics.scales(height)
    for axis, (length, sigma) in enumerate([(length_u, ratio), (length_u, ratio), (length_w, 1.0)]):
        frequency, density = welch(series[:, axis], 1.0 / period, nperseg=4096)
        x = (2.0 * math.pi * frequency * length / speed) ** 2
        shape = 2.0 / (1.0 + x) if axis == 0 else (1.0 + 3.0 * x) / (1.0 + x) ** 2
        # One-sided in hertz: 2π Φ(ω/V) / V.
        theory = 2.0 * sigma**2 * length / speed * shape
        for low, high in ((0.005, 0.02), (0.02, 0.1), (0.1, 0.5)):  # free of aliasing
            band = (frequency > low) & (frequency < high)
            found = density[band].sum() / theory[band].sum()
            assert found == pytest.approx(1.0, abs=0.15), (axis, low)
        assert series[:, axis].std() == pytest.approx(sigma, rel=0.05)


def test_correlation_times_follow_the_airspeed():
    """Correlation e^−τ along, (1 − τ/2) e^−τ across, after τ = V t/L."""
    parameters = WindConfig(speed=5.0).parameters()
    height, period = 100 * FOOT, 1.0
    length = dynamics.scales(height)[0]
    for v_x in (0.0, -10.0):  # hovering; flying upwind
        series = np.empty((200_000, 3))
        record(series, height, np.array([v_x, 0, 0]), period, stream_key(6, "c"), parameters)
        lag = 10
        tau = (5.0 - v_x) * lag * period / length
        for axis, theory in ((0, math.exp(-tau)), (1, (1.0 - 0.5 * tau) * math.exp(-tau))):
            x = series[:, axis] - series[:, axis].mean()
            assert (x[lag:] * x[:-lag]).mean() / x.var() == pytest.approx(theory, abs=0.06)


class TestSteadyWind:
    @pytest.mark.parametrize(
        ("config", "height", "speed"),
        [
            (WindConfig(speed=4.0), 100.0, 4.0),
            (WindConfig(speed=4.0, shear="power"), 6.096, 4.0),
            (WindConfig(speed=4.0, shear="power", shear_exponent=0.2), 60.96, 4.0 * 10**0.2),
            (WindConfig(speed=4.0, shear="logarithmic"), 6.096, 4.0),
            (WindConfig(speed=4.0, shear="logarithmic", roughness_length=0.06096), 60.96, 6.0),
            (WindConfig(speed=4.0, shear="logarithmic"), -1.0, 0.0),
        ],
    )
    def test_profile(self, config, height, speed):
        assert dynamics.steady_speed(height, config.parameters()) == pytest.approx(speed)

    def test_blows_to_its_direction(self):
        config = WindConfig(speed=3.0, direction=2.0, turbulence=0.0)
        np.testing.assert_allclose(
            wind_after(config, 0.1), [3.0 * math.cos(2.0), 3.0 * math.sin(2.0), 0.0]
        )


def wind_after(config, seconds, seed=0, body=None):
    builder = DiagramBuilder()
    wind = config.add_to(builder, "wind", seed)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = wind.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    if body is not None:
        wind.GetInputPort("body").FixValue(context, body)
    simulator.AdvanceTo(seconds)
    return wind.GetOutputPort("wind").Eval(context).copy()


def test_a_scheduled_gust_is_one_minus_cosine():
    gust = GustConfig(start=1.0, duration=2.0, velocity=[4.0, -2.0, 1.0])
    config = WindConfig(speed=2.0, turbulence=0.0, gusts=[gust])
    # The wind after the last event at 0.04 k is that for 0.04 (k + 1).
    for seconds in (0.5, 1.5, 2.0, 2.7, 3.5):
        time = 0.04 * math.floor(seconds / 0.04 + 1.0 + 1e-9)
        share = 0.5 * (1 - math.cos(math.pi * (time - 1.0))) if 1.0 < time < 3.0 else 0.0
        expected = np.array([2.0, 0.0, 0.0]) + share * np.array([4.0, -2.0, 1.0])
        np.testing.assert_allclose(wind_after(config, seconds + 1e-4), expected, atol=1e-9)


def test_two_gusts_add_up():
    gusts = [
        GustConfig(start=0.0, duration=2.0, velocity=[1.0, 0.0, 0.0]),
        GustConfig(start=0.5, duration=1.0, velocity=[0.0, 3.0, 0.0]),
    ]
    wind = wind_after(WindConfig(gusts=gusts), 1.0 - 0.01)
    np.testing.assert_allclose(wind, [1.0, 3.0, 0.0], atol=1e-2)


class TestSystem:
    def test_topology(self):
        wind = Wind(WindConfig(), seed=1)
        assert assert_matches_docstring(wind).optional == {"body"}
        assert periodic_update(wind) == (0.04, 0.0)

    def test_initial_state_is_calm_and_so_is_the_default(self):
        wind = Wind(WindConfig(speed=9.0), seed=1)
        context = wind.CreateDefaultContext()
        np.testing.assert_array_equal(wind.GetOutputPort("wind").Eval(context), 0.0)
        np.testing.assert_array_equal(wind_after(WindConfig(), 1.0), 0.0)

    def test_update_is_the_kernels(self):
        config = WindConfig(speed=7.0, shear="power")
        body = BODY_STATE.zeros()
        body[BODY_STATE.index("p_WB_z")] = 20.0
        expected, state = np.zeros(3), np.zeros(6)
        key = stream_key(4, "wind.turbulence")
        for k in range(3):
            dynamics.update(
                expected, state, 20.0, np.zeros(3), 0.04 * (k + 1), 0.04, key, config.parameters()
            )
        np.testing.assert_array_equal(wind_after(config, 0.1, seed=4, body=body), expected)
        assert expected[2] != 0.0

    def test_seeds_and_configure(self):
        config = WindConfig(speed=7.0)
        one = wind_after(config, 1.0, seed=1)
        np.testing.assert_array_equal(one, wind_after(config, 1.0, seed=1))
        assert (one != wind_after(config, 1.0, seed=2)).all()
        wind = Wind(WindConfig(), seed=9)
        wind.configure(config, seed=1)
        simulator = Simulator(wind)
        simulator.AdvanceTo(1.0)
        np.testing.assert_array_equal(wind.GetOutputPort("wind").Eval(simulator.get_context()), one)

    def test_turbulence_of_another_wind_than_the_steady_one(self):
        gusty = wind_after(WindConfig(speed=0.0, turbulence_speed=10.0), 0.5, seed=3)
        doubled = WindConfig(speed=0.0, turbulence=2.0, turbulence_speed=10.0)
        np.testing.assert_allclose(2.0 * gusty, wind_after(doubled, 0.5, seed=3))
        assert np.abs(gusty).max() > 0.1

"""The fixed wing: appendix A, the lagged model, wind, touchdown and braking."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from plants.fixed_wing import FixedWing, FixedWingConfig
from plants.fixed_wing_dynamics import (
    GUST_U,
    GUST_W,
    advance,
    equilibrium_pitch,
    trimmed_state,
    turbulence,
)
from plants.terrain import FlatTerrain
from systems.runway_frames import RunwayConfig
from systems.signals.noise import stream_key
from systems.signals.runway_measurement import FIXED_WING_STATE
from tests.runway_bench import assert_contract, log_of
from tests.system_contract import periodic_update

GRID = FlatTerrain().grid(RunwayConfig())
KEY = stream_key(0, "gust")
STILL = FixedWingConfig(start=[0.0, -5000.0, -500.0], start_vertical_speed=0.0)


def fly(config, command, seconds, start=(0.0, 0.0, -500.0), sink=0.0):
    """States at every 10 ms, shape (n + 1, 15), and the memory at the end."""
    parameters = config.parameters(0)
    state, memory = trimmed_state(
        np.array(start), 0.3, sink, parameters, GRID.values, GRID.geometry
    )
    states = [state.copy()]
    for _ in range(round(seconds / 0.01)):
        advance(state, memory, np.array(command), parameters, GRID.values, GRID.geometry, KEY, 0.01)
        states.append(state.copy())
    return np.array(states), memory


def test_topology():
    aircraft = FixedWing(FixedWingConfig())
    assert_contract(aircraft)
    assert periodic_update(aircraft) == (0.01, 0.0)


def test_starts_trimmed_and_again_after_configure():
    aircraft = FixedWing(STILL)
    command = {"command": np.zeros(4)}
    _, values = log_of(aircraft, command, 0.0)
    state = FIXED_WING_STATE(values[0])
    assert math.hypot(state.p_n_x, state.p_n_y) == pytest.approx(5000.0)
    assert state.p_n_z == -500.0
    assert state.pitch == pytest.approx(150.0 / 33.0**2 - 0.09)
    assert state.yaw == pytest.approx(RunwayConfig().heading_radians)
    other = FixedWing(STILL)
    other.configure(FixedWingConfig(start=[0.0, -900.0, -90.0], start_vertical_speed=0.0), 0)
    _, values = log_of(other, command, 0.0)
    assert values[0, 2] == -90.0


def test_coarse_model_is_appendix_a():
    """A steady turn under roll and sink: closed forms of the appendix's equations."""
    config = FixedWingConfig()
    roll, sink, V = 0.2, 3.0, config.speed
    states, _ = fly(config, [roll, sink, 0.0, 0.0], 20.0)
    rate = 9.80665 / V * math.tan(roll)
    end = states[-1]
    assert end[6] == pytest.approx(0.3 + rate * 20.0)
    assert end[8] == roll
    assert math.hypot(end[3], end[4]) == pytest.approx(V)
    assert end[2] == pytest.approx(-500.0 + sink * 20.0)
    assert end[7] == pytest.approx(150.0 / V**2 - 0.09 + math.atan(-sink / V))
    # a circle of radius V/ψ′ through the start
    radius = V / rate
    centre = np.array([-math.sin(0.3), math.cos(0.3)]) * radius
    assert np.hypot(*(end[:2] - centre)) == pytest.approx(radius, abs=0.5)


def test_equilibrium_pitch_rises_with_lower_speed_and_with_climb():
    assert equilibrium_pitch(30.0, 0.0, 150.0, 0.09) > equilibrium_pitch(40.0, 0.0, 150.0, 0.09)
    assert equilibrium_pitch(33.0, -2.0, 150.0, 0.09) > equilibrium_pitch(33.0, 2.0, 150.0, 0.09)


def test_lagged_model_agrees_with_an_integrator():
    """In still air the kernel's steps follow scipy's solution of the printed equations."""
    c = FixedWingConfig(dynamics="lagged")
    g = 9.80665
    command = (0.3, 2.0)

    def rates(_, y):
        roll, p, pitch, q, path, yaw = y[:6]
        alpha = c.pitch_a / c.speed**2 - c.pitch_b
        aim = math.asin(-command[1] / c.speed)
        w, v = c.roll_frequency, c.pitch_frequency
        return [
            p,
            w * w * (command[0] - roll) - 2 * c.roll_damping * w * p,
            q,
            v * v * (2 * aim - path + alpha - pitch) - 2 * c.pitch_damping * v * q,
            (pitch - alpha - path) / c.path_lag,
            g / c.speed * math.tan(roll),
            c.speed * math.cos(path) * math.cos(yaw),
            c.speed * math.cos(path) * math.sin(yaw),
            -c.speed * math.sin(path),
        ]

    trim = c.pitch_a / c.speed**2 - c.pitch_b
    y0 = [0.0, 0.0, trim, 0.0, 0.0, 0.3, 0.0, 0.0, -500.0]
    expected = solve_ivp(rates, (0.0, 15.0), y0, rtol=1e-8, atol=1e-8).y[:, -1]
    states, _ = fly(c, [*command, 0.0, 0.0], 15.0)
    end = states[-1]
    np.testing.assert_allclose(end[[8, 7, 6]], expected[[0, 2, 5]], atol=0.003)
    np.testing.assert_allclose(end[:3], expected[6:], atol=1.0)


def test_lagged_commands_are_reached_with_realistic_lag():
    states, _ = fly(FixedWingConfig(dynamics="lagged"), [0.2, 3.0, 0.0, 0.0], 12.0)
    roll, sink = states[:, 8], states[:, 5]
    assert roll[50] < 0.12  # half a second later
    assert roll[-1] == pytest.approx(0.2, abs=0.002)
    assert sink[50] < 1.5
    assert sink[-1] == pytest.approx(3.0, abs=0.05)


def test_steady_wind_carries_the_aircraft_and_the_start_is_crabbed():
    config = FixedWingConfig(dynamics="lagged", wind=[3.0, -5.0])
    states, _ = fly(config, np.zeros(4), 10.0)
    air = states[-1, 3:5] - [3.0, -5.0]
    assert np.hypot(*air) == pytest.approx(33.0, abs=0.01)
    moved = states[-1, :2]
    assert math.atan2(moved[1], moved[0]) == pytest.approx(0.3, abs=0.005)


def test_turbulence_has_the_intensity_of_the_specification():
    config = FixedWingConfig(dynamics="lagged", turbulence_wind=7.7)
    parameters = config.parameters(0)
    gusts = []
    for seed in range(60):
        state, memory = trimmed_state(
            np.array([0.0, 0.0, -30.0]), 0.0, 0.0, parameters, GRID.values, GRID.geometry
        )
        key = stream_key(seed, "gust")
        for _ in range(1500):
            state[13] = 30.0
            state[2] = -30.0
            advance(state, memory, np.zeros(4), parameters, GRID.values, GRID.geometry, key, 0.01)
        gusts.append(memory[[GUST_U, GUST_W]])
    sigma_u, sigma_w, length_u, length_w = turbulence(30.0, 7.7)
    assert sigma_w == pytest.approx(0.77)
    assert sigma_u == pytest.approx(0.77 / (0.177 + 0.000823 * 98.43) ** 0.4, rel=1e-3)
    assert length_w == pytest.approx(30.0)
    assert length_u > length_w
    np.testing.assert_allclose(np.std(gusts, axis=0), (sigma_u, sigma_w), rtol=0.3)


def test_touchdown_and_braking_to_a_standstill():
    config = FixedWingConfig()
    states, _ = fly(config, [0.0, 1.0, 2.0, 0.0], 40.0, start=(0.0, 0.0, -11.2), sink=1.0)
    ground = states[:, 14] > 0.0
    touchdown = int(np.argmax(ground))
    assert touchdown * 0.01 == pytest.approx(10.0, abs=0.02)  # 10 m at 1 m/s
    assert states[touchdown, 13] == pytest.approx(config.gear)
    assert ground[touchdown:].all()
    assert np.hypot(*states[-1, 3:5]) == 0.0
    distance = np.hypot(*(states[-1, :2] - states[touchdown, :2]))
    assert distance == pytest.approx(33.0**2 / (2 * 2.3), rel=0.01)


def test_the_nose_wheel_steers():
    states, _ = fly(FixedWingConfig(), [0.0, 1.0, 0.0, 0.05], 6.0, start=(0.0, 0.0, -1.3), sink=1.0)
    assert states[-1, 6] > 0.5
    assert states[-1, 9] == pytest.approx(0.05, abs=1e-3)


def test_no_steps_an_ulp_long():
    """The periods of this vehicle are exact multiples of each other in floating point."""
    for k in range(200_000):
        assert 2 * k * 0.01 == k * 0.02
        assert 4 * k * 0.01 == k * 0.04
        assert 0.005 + 2 * k * 0.01 == 0.005 + k * 0.02

"""ArduPilot's landing-target estimator: its rules, its arithmetic, its known weaknesses."""

import numpy as np
import pytest

from systems.estimators.ardupilot_target import ArduPilotTargetConfig, ArduPilotTargetFilter
from systems.signals.measurement import TARGET_ESTIMATE, VEHICLE_ESTIMATE
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.estimators.target_cases import (
    PERIOD,
    Bench,
    Sway,
    field,
    fly,
    horizontal_error,
    target_measurement,
)


def ardupilot(**fields) -> ArduPilotTargetFilter:
    return ArduPilotTargetFilter(ArduPilotTargetConfig(**fields))


def test_topology():
    assert_matches_docstring(ardupilot())


def test_schedule_and_initial_state():
    system = ardupilot()
    assert periodic_update(system) == (0.02, 0.0)
    target = TARGET_ESTIMATE(system.get_output_port(0).Eval(system.CreateDefaultContext()))
    assert target.acquired == 0.0
    assert target.time_of_last_fusion == -1.0


def reference(times, sway, measurements, lag_frames):
    """The Kalman filter of one axis (east) with plain matrices, and its output prediction."""
    x, P = None, None
    frames = []
    answers = []
    for t in times:
        frames.append(sway.acceleration(t)[0] * PERIOD)
        frames = frames[-lag_frames:]
        if x is not None:
            F = np.array([[1.0, PERIOD], [0.0, 1.0]])
            x = F @ x - np.array([0.0, frames[0]])
            P = F @ P @ F.T + np.diag([0.0, (2.5 * PERIOD) ** 2])
        if t in measurements:
            z, height = measurements[t]
            R = (height * 0.01 + 0.02) ** 2
            if x is None:
                delayed = max(times[0], t - (lag_frames - 1) * PERIOD)
                x, P = np.array([z, -sway.velocity(delayed)[0]]), np.diag([R, 4.0])
            else:
                H = np.array([1.0, 0.0])
                K = P @ H / (H @ P @ H + R)
                x = x + K * (z - x[0])
                P = (np.eye(2) - np.outer(K, H)) @ P
        r, v = (0.0, 0.0) if x is None else x
        for dv in frames[1:]:
            v -= dv
            r += v * PERIOD
        answers.append([r, v, 0.0 if P is None else P[0, 0], 0.0 if P is None else P[1, 1]])
    return np.array(answers)


@pytest.mark.parametrize(("lag", "frames"), [(0.02, 1), (0.06, 3), (0.24, 12)])
def test_arithmetic_equals_a_plain_kalman_filter(lag, frames):
    sway = Sway()
    bench = Bench(ardupilot(lag=lag))
    times = [k * PERIOD for k in range(200)]
    measurements = {}
    found = []
    measurement = target_measurement(np.array([0.0, 0.0, -1.0]), -1.0, -1.0)
    for k, t in enumerate(times):
        if k % 3 == 0:
            p = -sway.position(t)
            measurement = target_measurement(p, t, t)
            measurements[t] = (p[0], -p[2])
        target = bench.step(k, measurement=measurement, estimate=sway.estimate(t))
        names = ("p_BP_W_x", "v_BP_W_x", "position_variance_x", "velocity_variance_x")
        found.append([target[TARGET_ESTIMATE.index(name)] for name in names])
    expected = reference(times, sway, measurements, frames)
    np.testing.assert_allclose(np.array(found), expected, atol=1e-10)


def test_is_acquired_after_two_seconds_of_updates():
    times, targets = fly(ardupilot(), Sway(), 4.0)
    acquired = field(targets, "acquired")
    assert times[np.flatnonzero(acquired)[0]] == pytest.approx(2.0, abs=0.05)
    assert acquired[times > 2.1].all()


def test_is_not_acquired_with_gaps_longer_than_half_a_second():
    _, targets = fly(ardupilot(), Sway(), 8.0, visible=lambda t: t % 1.0 < 0.3)
    assert not field(targets, "acquired").any()


def test_is_lost_two_seconds_after_the_last_fusion():
    times, targets = fly(ardupilot(), Sway(), 9.0, visible=lambda t: t < 4.0)
    acquired = field(targets, "acquired")
    lost = times[np.flatnonzero(acquired)[-1] + 1]
    assert lost == pytest.approx(6.0, abs=0.06)
    assert field(targets, "time_of_last_fusion")[-1] == pytest.approx(4.0, abs=0.05)


@pytest.mark.parametrize("estimator", ["kalman", "raw_sensor"])
def test_follows_a_swaying_vehicle(estimator):
    sway = Sway()
    times, targets = fly(ardupilot(estimator=estimator), sway, 6.0, noise=0.02)
    settled = times > 2.5
    assert np.abs(horizontal_error(times, targets, sway)[settled]).max() < 0.1
    assert not field(targets, "v_WP_x").any()


def test_raw_sensor_is_acquired_at_once_and_carried_with_the_velocity():
    sway = Sway()
    system = ardupilot(estimator="raw_sensor")
    times, targets = fly(system, sway, 2.0, visible=lambda t: t < 0.5)
    assert field(targets, "acquired")[2:].all()
    assert np.abs(horizontal_error(times, targets, sway)[times > 1.0]).max() < 0.02


def test_raw_sensor_needs_a_valid_velocity():
    class Blind(Sway):
        def estimate(self, t):
            estimate = super().estimate(t)
            estimate[VEHICLE_ESTIMATE.index("horizontal_valid")] = 0.0
            return estimate

    _, targets = fly(ardupilot(estimator="raw_sensor"), Blind(), 1.0)
    assert not field(targets, "acquired").any()


def test_lag_parameter_makes_up_for_the_latency():
    sway = Sway(amplitude=(1.5, 0.0), frequency=0.25)
    worst = {}
    for lag in (0.02, 0.2):
        # The frame `lag` ago: 10 frames reach 9 periods back.
        times, targets = fly(ardupilot(lag=lag), sway, 8.0, latency=9)
        error = horizontal_error(times, targets, sway)[times > 3.0]
        worst[lag] = np.abs(error).max()
    assert worst[0.02] > 0.2
    assert worst[0.2] < 0.02


def test_false_target_wins_on_its_fourth_frame():
    class Jump(Sway):
        def position(self, t):
            return super().position(t) + (np.array([3.0, 0.0, 0.0]) if t > 3.0 else 0.0)

    times, targets = fly(ardupilot(), Jump(frequency=0.0), 5.0, every=2)
    rejected = field(targets, "rejected_count")
    assert rejected.max() == 3.0
    first = np.flatnonzero(rejected == 1.0)[0]
    won = np.flatnonzero((rejected == 0.0) & (times > times[first]))[0]
    assert won - first == 3 * 2
    assert np.abs(field(targets, "p_BP_W_x")[times > 4.5] + 3.0).max() < 0.3


def test_moving_target_option_reports_the_pads_velocity():
    class Drift(Sway):
        """The pad moves with −0.4 m/s: measurements are of −p + v_pad t."""

        def position(self, t):
            return super().position(t) + np.array([0.4 * t, 0.0, 0.0])

        def velocity(self, t):
            return super().velocity(t)

    _, targets = fly(ardupilot(moving_target=True), Drift(frequency=0.0), 6.0)
    assert field(targets, "v_WP_x")[-1] == pytest.approx(-0.4, abs=0.02)


def test_configure_changes_the_estimator():
    system = ardupilot()
    system.configure(ArduPilotTargetConfig(estimator="raw_sensor"))
    _, targets = fly(system, Sway(), 0.2)
    assert field(targets, "acquired")[-1] == 1.0

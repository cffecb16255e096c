"""PX4's landing-target estimators against PX4's own streams, and in motion."""

import numpy as np
import pandas as pd
import pytest

from systems.estimators import px4_target_kernel as kernel
from systems.estimators.px4_target import (
    PX4TargetConfig,
    PX4TargetFilter,
    PX4VisionTargetConfig,
    PX4VisionTargetFilter,
)
from systems.signals.measurement import TARGET_ESTIMATE
from tests.shared_data import shared
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.estimators.target_cases import Sway, field, fly, horizontal_error

FILTERS = [PX4TargetFilter(PX4TargetConfig()), PX4VisionTargetFilter(PX4VisionTargetConfig())]


@pytest.mark.parametrize("system", FILTERS, ids=lambda system: type(system).__name__)
def test_topology(system):
    assert_matches_docstring(system)


@pytest.mark.parametrize("system", FILTERS, ids=lambda system: type(system).__name__)
def test_schedule_and_initial_state(system):
    assert periodic_update(system) == (0.02, 0.0)
    target = TARGET_ESTIMATE(system.get_output_port(0).Eval(system.CreateDefaultContext()))
    assert target.acquired == 0.0
    assert target.time_of_last_fusion == -1.0


def test_landing_target_estimator_axis_equals_px4():
    stream = pd.read_csv(shared("data/px4-ekf2/lte_axis.csv.gz"))
    axis = np.empty(kernel.AXIS)
    # The stream begins after the first prediction; LTEST_*_UNC_IN are variances.
    first = stream.iloc[0]
    velocity = first.v - first.acc_in * first["dt"]
    position = first.x - velocity * first["dt"] - 0.5 * first["dt"] ** 2 * first.acc_in
    kernel.initialise_axis(axis, position, velocity, 0.1, 0.1)
    worst = 0.0
    for row in stream.itertuples():
        kernel.predict_axis(axis, row.dt, row.acc_in, row.acc_unc)
        if row.accepted >= 0:
            innovation, total, fused = kernel.fuse_axis(axis, row.meas, row.meas_unc, 3.84)
            assert fused == bool(row.accepted)
            worst = max(worst, abs(innovation - row.innov), abs(total - row.innov_cov))
        answer = axis[[0, 1, 2, 4]]
        worst = max(worst, np.abs(answer - [row.x, row.v, row.P00, row.P11]).max())
    assert (stream.accepted == 0).sum() == 7
    assert worst < 1e-5


# vte_pos_fusion's status codes
STATUS = {
    kernel.FUSED_NOW: 1,
    kernel.FUSED_LATE: 2,
    kernel.REJECTED_GATE: 3,
    kernel.REJECTED_OLD: 5,
    kernel.REJECTED_NEW: 6,
    kernel.RESET: 7,
    kernel.REJECTED_EMPTY: 8,
}
OBSERVED = {"vision": (1.0, 0.0, 0.0), "gnss_pos": (1.0, 0.0, 1.0), "gnss_vel": (0.0, 1.0, 0.0)}


def test_vision_target_estimator_axis_equals_px4():
    inputs = pd.read_csv(shared("data/px4-ekf2/vte_input.csv.gz"))
    measured = dict(list(inputs[inputs.kind != "acc"].groupby("t_us")))
    fusions = pd.read_csv(shared("data/px4-ekf2/vte_pos_fusion.csv.gz")).itertuples()
    outputs = pd.read_csv(shared("data/px4-ekf2/vte_pos_output.csv.gz"))
    first = outputs.iloc[0]
    dt = 0.02
    velocity = first.v_uav - first.acc * dt
    position = first.r + dt * velocity + 0.5 * dt**2 * first.acc
    axis = np.empty((26, kernel.SNAPSHOT))
    start = first.t_us * 1e-6 - dt
    kernel.start_vision_axis(axis, start, position, velocity, np.array([0.5, 0.5, 1.0]))
    worst = 0.0
    late = 0
    for output in outputs.itertuples():
        events = measured.get(output.t_us, inputs[:0])
        kernel.predict_vision_axis(axis, output.t_us * 1e-6, output.acc, 0.02, 0.001)
        for event in events.itertuples():
            status, innovation, total = kernel.fuse_vision_axis(
                axis,
                event.t_sample_us * 1e-6,
                event.value,
                event.variance,
                np.array(OBSERVED[event.kind]),
                3.84,
                dt,
                0.02,
                0.001,
            )
            fusion = next(fusions)
            assert (fusion.t_us, fusion.kind) == (event.t_us, event.kind)
            assert STATUS[status] == fusion.status
            late += status == kernel.FUSED_LATE
            worst = max(worst, abs(innovation - fusion.innov), abs(total - fusion.innov_var))
        answer = [output.r, output.v_uav, output.bias]
        worst = max(worst, np.abs(axis[-1, 1:4] - answer).max())
        upper = axis[-1, 4:13].reshape(3, 3)[np.triu_indices(3)]
        answer = [output.P00, output.P01, output.P02, output.P11, output.P12, output.P22]
        worst = max(worst, np.abs(upper - answer).max())
        kernel.keep_snapshot(axis)
    assert late > 500
    assert worst < 1e-5


def test_late_measurement_in_order_equals_the_batch_answer():
    """With one late measurement the projected correction is exactly the Kalman smoother's."""
    rng = np.random.default_rng(4)
    accelerations = rng.standard_normal(12)
    dt, q = 0.02, 0.3
    axis = np.empty((33, kernel.SNAPSHOT))
    kernel.start_vision_axis(axis, 0.0, 1.0, 0.5, np.array([0.5, 0.4, 1.0]))
    kernel.keep_snapshot(axis)
    for k, a in enumerate(accelerations, start=1):
        kernel.predict_vision_axis(axis, k * dt, a, q, 0.0)
        if k < len(accelerations):
            kernel.keep_snapshot(axis)
    measured, z, R = 5 * dt, 0.3, 0.02
    kernel.fuse_vision_axis(axis, measured, z, R, np.array([1.0, 0, 0]), 100.0, dt, q, 0.0)

    # The same as one linear estimate: x(5) then x(12) = F⁷ x(5) + known + noise.
    F = np.array([[1.0, -dt], [0.0, 1.0]])
    Q = q * np.array([[dt**3 / 3, -(dt**2) / 2], [-(dt**2) / 2, dt]])
    x, P = np.array([1.0, 0.5]), np.diag([0.5, 0.4])
    cross = None
    for k, a in enumerate(accelerations, start=1):
        x = F @ x + np.array([-0.5 * dt**2, dt]) * a
        P = F @ P @ F.T + Q
        if k == 5:
            x5, P5 = x.copy(), P.copy()
            cross = P.copy()
        elif k > 5:
            cross = F @ cross
    gain = cross[:, 0] / (P5[0, 0] + R)
    np.testing.assert_allclose(axis[-1, 1:3], x + gain * (z - x5[0]), atol=1e-12)
    expected = P - np.outer(gain, gain) * (P5[0, 0] + R)
    np.testing.assert_allclose(axis[-1, 4:13].reshape(3, 3)[:2, :2], expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["px4", "px4_vision"])
def test_follows_a_swaying_vehicle(kind):
    sway = Sway()
    system = FILTERS[kind == "px4_vision"]
    times, targets = fly(system, sway, 6.0, noise=0.02)
    settled = times > 2.0
    assert field(targets, "acquired")[settled].all()
    assert np.abs(horizontal_error(times, targets, sway)[settled]).max() < 0.1
    true_velocity = np.array([-sway.velocity(t)[0] for t in times])
    assert np.abs(field(targets, "v_BP_W_x") - true_velocity)[settled].max() < 0.2
    heights = np.array([-sway.position(t)[2] for t in times])
    assert np.abs(field(targets, "p_BP_W_z") - heights)[settled].max() < 0.1


def test_latency_hurts_only_the_filter_that_ignores_it():
    sway = Sway(amplitude=(1.5, 0.0), frequency=0.25)
    worst = []
    for system in FILTERS:
        times, targets = fly(system, sway, 8.0, latency=10)
        worst.append(np.abs(horizontal_error(times, targets, sway)[times > 3.0]).max())
    speed = 1.5 * 2 * np.pi * 0.25
    assert worst[0] > 0.5 * speed * 0.16
    assert worst[1] < 0.1 * speed * 0.16


@pytest.mark.parametrize("kind", ["px4", "px4_vision"])
def test_is_lost_two_seconds_after_the_last_fusion_and_found_again(kind):
    sway = Sway()
    system = FILTERS[kind == "px4_vision"]
    times, targets = fly(system, sway, 9.0, visible=lambda t: t < 3.0 or t > 7.0)
    acquired = field(targets, "acquired")
    lost = times[np.flatnonzero((acquired == 0.0) & (times > 3.0))[0]]
    assert 4.9 < lost < 5.1
    assert not acquired[(times > 5.1) & (times < 7.0)].any()
    assert acquired[times > 7.3].all()


def test_false_target_is_rejected_until_the_filter_is_lost():
    """15 m aside, PX4 starts anew on the false target after two seconds."""

    class Jump(Sway):
        def position(self, t):
            return super().position(t) + (np.array([15.0, 0.0, 0.0]) if t > 3.0 else 0.0)

    times, targets = fly(FILTERS[0], Jump(frequency=0.0), 7.0)
    x = field(targets, "p_BP_W_x")
    assert np.abs(x[(times > 3.0) & (times < 4.9)]).max() < 1.0
    assert field(targets, "rejected_count")[(times > 4.0) & (times < 4.9)].min() > 20
    assert np.abs(x[times > 6.0] + 15.0).max() < 0.5


def test_normalised_errors_are_consistent():
    """NEES of the position over seeds lies in its chi-square band where the model is true.

    `measurement_variance` times height² is made the true variance, the acceleration is known.
    """
    height = 4.0
    sway = Sway(frequency=0.0, descent=0.0, height=height)
    config = PX4TargetConfig(
        measurement_variance=0.05**2 / height**2,
        acceleration_variance=1e-6,
        initial_position_variance=0.05**2,
        initial_velocity_variance=1e-6,
    )
    nees = []
    for seed in range(30):
        times, targets = fly(PX4TargetFilter(config), sway, 2.0, noise=0.05, seed=seed)
        error = horizontal_error(times, targets, sway)[-1]
        variance = targets[-1, TARGET_ESTIMATE.index("position_variance_x")]
        nees.extend(error**2 / variance)
    # The mean of 60 chi-square variables of one degree: 1 ± 4 standard deviations of √(2/60).
    assert abs(np.mean(nees) - 1.0) < 4 * np.sqrt(2 / 60)


def test_configure_changes_the_lost_time():
    system = PX4TargetFilter(PX4TargetConfig())
    system.configure(PX4TargetConfig(lost_time=0.5))
    times, targets = fly(system, Sway(), 4.0, visible=lambda t: t < 2.0)
    acquired = field(targets, "acquired")
    lost = times[np.flatnonzero((acquired == 0.0) & (times > 2.0))[0]]
    assert 2.4 < lost < 2.6

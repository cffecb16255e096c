"""The IMU: what it integrates, its noise by Allan deviation, its constants, its limits."""

import math

import numpy as np
import pytest

from systems.sensors.imu import IMU_MODELS, Imu, ImuConfig
from systems.signals.measurement import BODY_STATE, INERTIAL, no_measurement
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench, Playback

DT = 0.01  # s
GYRO = INERTIAL.slice("delta_angle")
ACCELEROMETER = INERTIAL.slice("delta_velocity")
CLIPPING = INERTIAL.index("clipping")


def body(w=(0.0, 0.0, 0.0), f=(0.0, 0.0, 0.0)) -> np.ndarray:
    state = BODY_STATE.zeros()
    state[0] = 1.0
    state[BODY_STATE.slice("w_WB_B")] = w
    state[BODY_STATE.slice("f_B")] = f
    return state


def record(config: ImuConfig, state, duration: float, seed: int = 1, stream="imu") -> np.ndarray:
    """The measurements while `state` (an array or a `Playback`) is at the input."""
    run = Bench(Imu(config, seed, stream=stream), {"body": state}, log_period=DT)
    return run.advance_to(duration).arrivals()


def test_topology():
    imu = Imu(ImuConfig())
    assert_matches_docstring(imu)
    assert periodic_update(imu) == (DT, 0.0)


def test_starts_with_no_measurement():
    run = Bench(Imu(ImuConfig()), {"body": body()})
    np.testing.assert_array_equal(run.advance_to(0.0).values()[0], no_measurement(INERTIAL))


def test_header():
    out = record(ImuConfig(), body(), 1.0)
    np.testing.assert_allclose(out[:, 0], DT * np.arange(len(out)), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out[:, 0], out[:, 1])
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))
    assert out[:, 3].all()
    assert (out[:, INERTIAL.index("delta_angle_dt")] == DT).all()
    assert (out[:, INERTIAL.index("delta_velocity_dt")] == DT).all()


def test_ideal_is_the_truth():
    out = record(ImuConfig(model="ideal"), body(w=(0.1, -0.2, 0.3), f=(1.0, 2.0, 9.8)), 0.1)
    np.testing.assert_allclose(out[:, GYRO] / DT, np.tile([0.1, -0.2, 0.3], (len(out), 1)))
    np.testing.assert_allclose(out[:, ACCELEROMETER] / DT, np.tile([1.0, 2.0, 9.8], (len(out), 1)))
    assert not out[:, CLIPPING].any()


def test_sum_of_increments_is_the_angle_turned():
    """The rate as the plant publishes it, sin(2πt) rad/s, sampled by the trapezium rule."""
    times = DT * np.arange(251)
    rows = np.array([body(w=(math.sin(2 * math.pi * t), 0, 0)) for t in times])
    # The plant's event at t - 10 ms puts the state of t into its port.
    out = record(ImuConfig(model="ideal"), Playback(times - DT, rows), 0.51)
    turned = (1.0 - math.cos(2 * math.pi * 50 * DT)) / (2 * math.pi)
    # The rule is off by (ωh)²/12, here 3.3e-4.
    assert out[1:51, GYRO][:, 0].sum() == pytest.approx(turned, rel=4e-4)


def allan_deviation(rate: np.ndarray, cluster: int) -> float:
    """Of `rate` (samples of one axis), averaged over clusters of `cluster` samples."""
    means = rate[: len(rate) // cluster * cluster].reshape(-1, cluster).mean(axis=1)
    return math.sqrt(0.5 * np.mean(np.diff(means) ** 2))


@pytest.mark.parametrize("model", ["bmi055", "icm_20602", "icm_20689"])
def test_white_noise_by_allan_deviation(model):
    """σ(τ) = N/√τ, IEEE Std 952; the bias walk is far below it at one second."""
    out = record(ImuConfig(model=model), body(), 80.0)
    errors = IMU_MODELS[model]
    for fields, density in ((GYRO, errors.gyro_noise), (ACCELEROMETER, errors.accelerometer_noise)):
        rate = out[:, fields] / DT
        for cluster in (1, 16, 64):
            tau = cluster * DT
            measured = [allan_deviation(rate[:, axis], cluster) for axis in range(3)]
            pairs = 3 * (len(rate) // cluster)
            assert np.sqrt(np.mean(np.square(measured))) == pytest.approx(
                density / math.sqrt(tau), rel=4.0 / math.sqrt(pairs)
            )


def test_bias_walk_by_allan_deviation():
    """σ(τ) = K √(τ/3), IEEE Std 952."""
    walk = 0.02
    config = ImuConfig(model="ideal", gyro_bias_walk=walk, accelerometer_bias_walk=walk)
    out = record(config, body(), 120.0)
    for fields in (GYRO, ACCELEROMETER):
        rate = out[:, fields] / DT
        cluster = 100
        measured = [allan_deviation(rate[:, axis], cluster) for axis in range(3)]
        expected = walk * math.sqrt(cluster * DT / 3)
        assert np.sqrt(np.mean(np.square(measured))) == pytest.approx(expected, rel=0.12)


def test_axes_are_independent():
    out = record(ImuConfig(), body(), 40.0)
    rates = np.hstack([out[:, GYRO], out[:, ACCELEROMETER]])
    assert np.abs(np.corrcoef(rates.T) - np.eye(6)).max() < 4.0 / math.sqrt(len(out))


def constants(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The matrices and biases of one run, found by turning and pushing a noiseless IMU."""
    config = ImuConfig(
        gyro_noise=0.0, gyro_bias_walk=0.0, accelerometer_noise=0.0, accelerometer_bias_walk=0.0
    )
    states = [body(), *(body(w=axis, f=axis) for axis in np.eye(3))]
    gyro, accelerometer = [], []
    for state in states:
        out = record(config, state, 0.02, seed)
        gyro.append(out[-1, GYRO] / DT)
        accelerometer.append(out[-1, ACCELEROMETER] / DT)
    g, a = np.array(gyro), np.array(accelerometer)
    return (g[1:] - g[0]).T, g[0], (a[1:] - a[0]).T, a[0]


def test_constants_of_a_run_have_their_spread():
    errors = IMU_MODELS["icm_20602"]
    runs = [constants(seed) for seed in range(60)]
    for matrix, bias, scale_error, bias_error in (
        (0, 1, errors.gyro_scale_error, errors.gyro_bias),
        (2, 3, errors.accelerometer_scale_error, errors.accelerometer_bias),
    ):
        deviations = np.array([run[matrix] for run in runs]) - np.eye(3)
        diagonal = np.array([np.diag(d) for d in deviations])
        beside = deviations[:, ~np.eye(3, dtype=bool)]
        for drawn, sigma in (
            (diagonal, scale_error),
            (beside, errors.misalignment),
            (np.array([run[bias] for run in runs]), bias_error),
        ):
            assert np.sqrt(np.mean(drawn**2)) == pytest.approx(
                sigma, rel=4.0 / math.sqrt(2 * drawn.size)
            )
            assert abs(drawn.mean()) < 4.0 * sigma / math.sqrt(drawn.size)


def test_accelerometer_clips_at_its_range_and_says_so():
    config = ImuConfig(model="ideal", accelerometer_range=20.0, gyro_range=2.0)
    out = record(config, body(w=(3.0, -3.0, 1.0), f=(0.0, 30.0, -30.0)), 0.02)
    np.testing.assert_allclose(out[-1, ACCELEROMETER] / DT, [0.0, 20.0, -20.0])
    np.testing.assert_allclose(out[-1, GYRO] / DT, [2.0, -2.0, 1.0])
    assert out[-1, CLIPPING] == 1.0


def test_a_gyro_at_its_range_is_no_clipping():
    config = ImuConfig(model="ideal", gyro_range=2.0)
    assert record(config, body(w=(3.0, 0.0, 0.0)), 0.02)[-1, CLIPPING] == 0.0


def test_vibration_adds_in_quadrature():
    config = ImuConfig(
        model="ideal",
        accelerometer_noise=0.3 * math.sqrt(DT),
        accelerometer_vibration=0.4,
        gyro_vibration=0.05,
    )
    out = record(config, body(), 20.0)
    tolerance = 4.0 / math.sqrt(2 * 3 * len(out))
    assert np.std(out[:, ACCELEROMETER] / DT) == pytest.approx(0.5, rel=tolerance)
    assert np.std(out[:, GYRO] / DT) == pytest.approx(0.05, rel=tolerance)


def test_overrides_replace_single_figures():
    errors = ImuConfig(model="bmi055", gyro_noise=1.0).errors()
    assert errors.gyro_noise == 1.0
    assert errors.accelerometer_noise == IMU_MODELS["bmi055"].accelerometer_noise


def test_deterministic_by_seed_and_stream():
    first = record(ImuConfig(), body(), 0.2, seed=1)
    np.testing.assert_array_equal(first, record(ImuConfig(), body(), 0.2, seed=1))
    for other in (
        record(ImuConfig(), body(), 0.2, seed=2),
        record(ImuConfig(), body(), 0.2, seed=1, stream="imu_2"),
    ):
        assert (other[:, GYRO] != first[:, GYRO]).all()


def test_configure_is_a_new_imu():
    run = Bench(Imu(ImuConfig(), 1), {"body": body()}, log_period=DT)
    run.system.configure(ImuConfig(model="bmi055"), 5)
    expected = record(ImuConfig(model="bmi055"), body(), 0.2, seed=5)
    np.testing.assert_array_equal(run.advance_to(0.2).arrivals(), expected)


def test_a_cloned_context_goes_on_like_the_original():
    config = ImuConfig(gyro_bias_walk=0.1)
    whole = record(config, body(), 0.4)
    run = Bench(Imu(config, 1), {"body": body()}, log_period=DT).advance_to(0.2)
    clone = run.simulator.get_context().Clone()
    run.advance_to(0.3)
    run.simulator.reset_context(clone)
    np.testing.assert_array_equal(run.advance_to(0.4).arrivals(), whole)

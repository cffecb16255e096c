"""Where the delayed horizon lies, what is too late or too fast, what a delay means."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.buffers import pop, push_observation
from tests.systems.estimators.ekf2.streams import Samples, flight_parameters, replay, samples


def imu_row(time: float, dt: float) -> np.ndarray:
    return np.array([time, 0, 0, 0, 0, 0, -at.STANDARD_GRAVITY * dt, dt, dt, 0, 0, 0])


def run_at_rest(rate: float, seconds: float, **values: float) -> np.ndarray:
    p = prm.parameter_array(values)
    x = kernels.initialise(p)
    for k in range(1, round(seconds * rate) + 1):
        kernels.push_imu(x, p, imu_row(round(k * 1e6 / rate), 1.0 / rate))
        kernels.update(x, p)
    return x


@pytest.mark.parametrize(
    ("rate", "delay_max", "step", "horizon"),
    [
        # facts: at 250 Hz a DELAY_MAX of 200 ms gives only 152 ms, 300 ms gives 232 ms
        (250.0, 200.0, 0.008, 152_000),
        (250.0, 300.0, 0.008, 232_000),
        (200.0, 110.0, 0.010, 100_000),
        (1000.0, 200.0, 0.010, 190_000),
    ],
)
def test_horizon_follows_from_rate_and_delay_max(rate, delay_max, step, horizon):
    x = run_at_rest(rate, 4.0, EKF2_DELAY_MAX=delay_max)
    newest = x[at.TIME_LATEST] - x[at.DS_COUNT] * 1e6 / rate
    assert newest - x[at.TIME_DELAYED] == pytest.approx(horizon)
    assert x[at.DT_AVERAGE] == pytest.approx(step, rel=0.02)


def test_down_sampler_composes_rotations_and_turns_velocity():
    p = prm.parameter_array({})
    x = kernels.initialise(p)
    rng = np.random.default_rng(1)
    angles, velocities = rng.normal(0, 0.05, (2, 3)), rng.normal(0, 0.1, (2, 3))
    dt = 0.005
    for k in range(2):
        row = np.array([5000.0 * (k + 1), *angles[k], *velocities[k], dt, dt, 0, 0, 0])
        kernels.push_imu(x, p, row)
    assert x[at.IMU_UPDATED] == 1.0
    entry = int(x[at.RING_IMU + at.RING_DATA])
    turns = [Rotation.from_rotvec(angle) for angle in angles]
    total = (turns[0] * turns[1]).as_rotvec()
    assert np.allclose(x[entry + 1 : entry + 4], total, atol=1e-12)
    velocity = np.zeros(3)
    for turn, new in zip(turns, velocities, strict=True):
        velocity = turn.inv().apply(velocity) + 0.5 * (new + turn.inv().apply(new))
    assert np.allclose(x[entry + 4 : entry + 7], velocity, atol=1e-12)


class PlainRing:
    """An observation ring as a list: what `buffers` must agree with as long as nothing is lost."""

    def __init__(self):
        self.times: list[float] = []

    def pop(self, horizon: float) -> float | None:
        for i in range(len(self.times) - 1, -1, -1):
            if self.times[i] <= horizon < self.times[i] + 100_000:
                time = self.times[i]
                del self.times[: i + 1]
                return time
        return None


def test_ring_pops_the_newest_sample_behind_the_horizon():
    x = run_at_rest(250.0, 1.0, EKF2_DELAY_MAX=200)
    plain, rng, popped = PlainRing(), np.random.default_rng(2), 0
    x[at.DT_AVERAGE] = 0.0
    x[at.MINIMUM_INTERVAL] = 0.0
    time = horizon = 2e6
    for _ in range(400):
        time += rng.integers(5_000, 60_000)
        assert push_observation(x, at.RING_BARO, time, 0.0) >= 0
        plain.times.append(time)
        horizon = max(horizon, time - rng.integers(0, 140_000))
        entry = pop(x, at.RING_BARO, horizon)
        expected = plain.pop(horizon)
        assert (entry >= 0) == (expected is not None)
        if expected is not None:
            assert x[at.RING_BARO + at.RING_POPPED_TIME] == expected
            popped += 1
    assert popped > 100


def test_an_observation_that_follows_too_fast_is_dropped():
    x = run_at_rest(250.0, 1.0, EKF2_DELAY_MAX=200)
    # 20 entries cover the horizon of 152 ms
    assert x[at.MINIMUM_INTERVAL] == 152_000 // 19
    time = x[at.TIME_LATEST]
    assert push_observation(x, at.RING_MAG, time, 0.0) >= 0
    assert push_observation(x, at.RING_MAG, time + 7_999, 0.0) == -1
    assert push_observation(x, at.RING_MAG, time + 8_000, 0.0) >= 0


def test_delay_parameter_and_true_stamp_are_the_same():
    """Stamp = arrival with EV_DELAY 200, and stamp = true time with EV_DELAY 0: bit for bit."""
    stream = samples("flight", 8.0)
    stamped = Samples(stream.arrivals, stream.kinds, [row.copy() for row in stream.rows])
    for kind, row in zip(stamped.kinds, stamped.rows, strict=True):
        if kind == "ev":
            row[0] -= 200_000
    by_arrival = replay(stream, flight_parameters(EKF2_GPS_CTRL=0)).x
    by_validity = replay(stamped, flight_parameters(EKF2_GPS_CTRL=0, EKF2_EV_DELAY=0)).x
    assert by_arrival[at.EV_POS] == 1.0
    assert np.array_equal(by_arrival, by_validity, equal_nan=True)


def test_a_camera_later_than_the_horizon_is_fused_at_the_wrong_time():
    """200 ms late behind a horizon of 152 ms: what users stumble over."""
    stream = samples("flight", 25.0)
    truth = {}
    for delay_max in (200, 300):
        p = flight_parameters(EKF2_GPS_CTRL=0, EKF2_DELAY_MAX=delay_max)
        x = replay(stream, p).x
        late = x[at.TIME_DELAYED] - x[at.AID_EV_POS + at.A_TIME]
        truth[delay_max] = late
        assert x[at.EV_POS] == 1.0
    # behind the horizon by up to an interval of 100 ms; with 200 by 48 ms more
    assert truth[300] < 100_000 < truth[200] + 100_000

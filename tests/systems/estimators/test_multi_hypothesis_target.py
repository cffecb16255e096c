"""The multi-hypothesis estimator: late data, consistency, false beacons, moving pads."""

import functools

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

from plants.svgs_beacons import SvgsBeaconsConfig
from systems.estimators import multi_hypothesis_target_filter as track_filter
from systems.estimators.fused_sensor import no_target
from systems.estimators.multi_hypothesis_target import (
    MultiHypothesisTarget,
    MultiHypothesisTargetConfig,
    TargetSensorsConfig,
)
from systems.estimators.multi_hypothesis_target_kernel import TARGET_HYPOTHESES
from systems.frames import geodetic_from_world
from systems.sensors.gnss import RECEIVERS
from systems.signals.measurement import (
    GNSS,
    INFRARED,
    MARKER,
    RANGE_FINDER,
    SVGS,
    TARGET_ESTIMATE,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.estimators.target_cases import (
    PERIOD,
    Bench,
    Scene,
    Sway,
    field,
    horizontal_error,
    port_names,
    simulate,
)

# As the filter takes them: a pad at rest, for which v decays, and one that moves
REST = np.array([1e-3, 0.04, 0.09, 2.5, 0.01, 30.0])
MOVING = np.array([1e-3, 0.04, 0.09, np.inf, 0.01, 30.0])
NOISE = REST


def config(mode="fused", **fields):
    origin = [0.0, 0.0, 0.0]
    sensors = TargetSensorsConfig(
        mode=mode, infrared_position=origin, marker_position=origin, svgs_position=origin
    )
    return MultiHypothesisTargetConfig(front_end=sensors, **fields)


def test_topology():
    system = MultiHypothesisTarget(config())
    assert_matches_docstring(system)
    inputs, outputs = port_names(system)
    assert inputs[:4] == ["infrared", "marker", "svgs", "gnss"]
    assert inputs[4:] == ["pad_gnss", "range_finder", "estimate"]
    assert outputs[:2] == ["target", "measurement"]
    assert periodic_update(system) == (PERIOD, 0.0)


def test_initial_outputs():
    system = MultiHypothesisTarget(config())
    context = system.CreateDefaultContext()
    values = [system.get_output_port(i).Eval(context) for i in range(3)]
    np.testing.assert_array_equal(values[0], no_target())
    assert values[1][3] == 0.0
    assert not values[2].any()


# -- the filter against plain matrices


@functools.cache
def _discretised(dt, *noise):
    density, horizontal, vertical, tau_v, sigma, tau = noise
    A, Q = np.zeros((8, 8)), np.zeros((8, 8))
    A[:3, 3:6] = np.eye(3)
    A[3, 3] = A[4, 4] = -1.0 / tau_v
    A[6:, 6:] = -np.eye(2) / tau
    Q[:3, :3] = density * np.eye(3)
    Q[3:6, 3:6] = np.diag([horizontal, horizontal, vertical])
    Q[6:, 6:] = 2.0 * sigma**2 / tau * np.eye(2)
    both = expm(np.block([[-A, Q], [np.zeros((8, 8)), A.T]]) * dt)
    F = both[8:, 8:].T
    return F, F @ both[:8, 8:]


def discretised(dt, noise):
    """F and Q of a step of dt (s), by Van Loan's exponential, IEEE T-AC 23(3), 1978."""
    return _discretised(dt, *noise)


class Reference:
    """The Kalman filter of the docstring, written once more with matrices."""

    def __init__(self, x, P, time, noise):
        self.x, self.P, self.time, self.noise = x.copy(), P.copy(), time, noise

    def predict(self, time):
        dt, self.time = time - self.time, time
        F, Q = discretised(dt, self.noise)
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q

    def fuse(self, H, z, R):
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        innovation = z - H @ self.x
        self.x = self.x + K @ innovation
        self.P = (np.eye(8) - K @ H) @ self.P
        return innovation @ np.linalg.solve(S, innovation)


def random_measurements(rng, count, duration):
    """Times, matrices, values and covariances of `count` measurements of one to three rows."""
    times = np.sort(rng.uniform(0.0, duration, count))
    measurements = []
    for time in times:
        rows = int(rng.integers(1, 4))
        H = rng.standard_normal((rows, 8))
        A = 0.1 * rng.standard_normal((rows, rows))
        R = A @ A.T + 0.01 * np.eye(rows)
        measurements.append((time, H, rng.standard_normal(rows), R))
    return measurements


def observation(time, H, z, R):
    rows = len(z)
    coefficients, values, covariance = np.zeros((3, 8)), np.zeros(3), np.zeros((3, 3))
    coefficients[:rows], values[:rows], covariance[:rows, :rows] = H, z, R
    packed = np.zeros(track_filter.OBSERVATION)
    track_filter.whiten(packed, time, coefficients, values, covariance, rows)
    return packed


def start():
    x = np.array([1.0, -2.0, 0.5, 0.1, 0.2, -0.3, 0.0, 0.0])
    P = np.diag([4.0, 4.0, 1.0, 1.0, 1.0, 1.0, 1e-4, 1e-4])
    track = np.zeros(track_filter.TRACK)
    track_filter.begin(track, 0.0, x, P)
    return track, x, P


def answer(track, time):
    x, P = np.empty(8), np.empty((8, 8))
    track_filter.newest(track, time, x, P, NOISE)
    return x, P


@pytest.mark.parametrize("dt", [1e-3, 0.1, 0.3, 5.0])
@pytest.mark.parametrize("noise", [REST, MOVING], ids=["rest", "moving"])
def test_prediction(noise, dt):
    x, P = start()[1:]
    reference = Reference(x, P, 0.0, noise)
    reference.predict(dt)
    track_filter.predict(x, P, dt, noise)
    np.testing.assert_allclose(x, reference.x, rtol=1e-9)
    np.testing.assert_allclose(P, reference.P, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_any_order_of_arrival_gives_the_filter_that_had_them_in_order(seed):
    rng = np.random.default_rng(seed)
    track, x, P = start()
    reference = Reference(x, P, 0.0, NOISE)
    measurements = random_measurements(rng, 40, 1.0)
    for time, H, z, R in measurements:
        reference.predict(time)
        reference.fuse(H, z, R)
    reference.predict(1.1)
    for i in rng.permutation(len(measurements)):
        packed = observation(*measurements[i])
        track_filter.insert(track, packed, np.empty(8), np.empty((8, 8)), NOISE)
    x, P = answer(track, 1.1)
    np.testing.assert_allclose(x, reference.x, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(P, reference.P, rtol=0.0, atol=1e-6)


def test_a_full_buffer_forgets_nothing_of_what_came_in_order():
    rng = np.random.default_rng(7)
    track, x, P = start()
    reference = Reference(x, P, 0.0, NOISE)
    for time, H, z, R in random_measurements(rng, 3 * track_filter.SLOTS, 4.0):
        reference.predict(time)
        reference.fuse(H, z, R)
        packed = observation(time, H, z, R)
        track_filter.insert(track, packed, np.empty(8), np.empty((8, 8)), NOISE)
    assert track[track_filter.USED] == track_filter.SLOTS
    x, P = answer(track, 4.0)
    reference.predict(4.0)
    np.testing.assert_allclose(x, reference.x, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(P, reference.P, rtol=0.0, atol=1e-6)


def late_by_a_buffer(seed, noise):
    """In order, without, and with a measurement that comes when 70 younger ones are fused."""
    rng = np.random.default_rng(seed)
    x, P = start()[1:]
    truth = x + np.linalg.cholesky(P) @ rng.standard_normal(8)
    track, (in_order, without) = start()[0], (Reference(x, P, 0.0, noise) for _ in range(2))
    now, kept = 0.0, None
    for i, (time, H, _, R) in enumerate(random_measurements(rng, 130, 3.0)):
        step = Reference(truth, np.zeros((8, 8)), now, noise)
        step.predict(time)
        truth = step.x + np.linalg.cholesky(step.P + 1e-15 * np.eye(8)) @ rng.standard_normal(8)
        now = time
        z = H @ truth + np.linalg.cholesky(R) @ rng.standard_normal(len(R))
        in_order.predict(time)
        in_order.fuse(H, z, R)
        packed = observation(time, H, z, R)
        if i == 60:
            kept = packed
            continue
        without.predict(time)
        without.fuse(H, z, R)
        assert track_filter.insert(track, packed, np.empty(8), np.empty((8, 8)), noise)
    # 69 younger ones, more than a full buffer of 48
    assert track_filter.insert(track, kept, np.empty(8), np.empty((8, 8)), noise)
    late = np.empty(8), np.empty((8, 8))
    track_filter.newest(track, now, *late, noise)
    return truth, in_order, without, late


def test_a_measurement_older_than_the_buffer_is_used_and_not_overrated():
    """Never better than in order, never worse than without, and as good as it says."""
    squared, runs = [], 40
    for seed in range(runs):
        truth, in_order, without, (x, P) = late_by_a_buffer(seed, NOISE)
        assert np.linalg.eigvalsh(without.P - P).min() > -1e-8
        assert np.linalg.eigvalsh(P - in_order.P).min() > -1e-6  # one part in a thousand
        error = (x - truth)[:6]
        squared.append(error @ np.linalg.solve(P[:6, :6], error))
    low, high = chi2.ppf([0.001, 0.999], 6 * runs) / runs
    assert low < np.mean(squared) < high


def test_what_is_older_than_the_archive_is_refused():
    track = start()[0]
    measurements = random_measurements(np.random.default_rng(2), 400, 8.0)
    for one in measurements[1:]:
        track_filter.insert(track, observation(*one), np.empty(8), np.empty((8, 8)), NOISE)
    before = track.copy()
    packed = observation(*measurements[0])
    assert not track_filter.insert(track, packed, np.empty(8), np.empty((8, 8)), NOISE)
    np.testing.assert_array_equal(track, before)


def test_innovation_is_normalised_with_the_prior():
    rng = np.random.default_rng(1)
    track, x, P = start()
    (time, H, z, R), *_ = random_measurements(rng, 1, 1.0)
    reference = Reference(x, P, 0.0, NOISE)
    reference.predict(time)
    expected = reference.fuse(H, z, R)
    x, P = np.empty(8), np.empty((8, 8))
    packed = observation(time, H, z, R)
    assert track_filter.prior(track, packed, x, P, NOISE)
    found, _ = track_filter.fuse(x, P, packed)
    assert found == pytest.approx(expected, rel=1e-4)


def test_a_kick_is_a_change_of_the_velocity_some_time_before():
    """A slot with a kick 0.2 s before it: as P had been larger then, but for the drift since."""
    packed = observation(0.5, np.eye(8)[:3], np.array([1.5, -2.0, 0.4]), 1e-4 * np.eye(3))
    packed[track_filter.KICK], packed[track_filter.SINCE] = 2.0, 0.2
    track, x, P = start()
    track_filter.insert(track, packed, np.empty(8), np.empty((8, 8)), MOVING)
    reference = Reference(x, P, 0.0, MOVING)
    reference.predict(0.3)
    reference.P[3, 3] += 2.0
    reference.P[4, 4] += 2.0
    reference.predict(0.5)
    reference.fuse(np.eye(8)[:3], np.array([1.5, -2.0, 0.4]), 1e-4 * np.eye(3))
    x, P = np.empty(8), np.empty((8, 8))
    track_filter.newest(track, 0.5, x, P, MOVING)
    np.testing.assert_allclose(x, reference.x, atol=1e-6)
    np.testing.assert_allclose(P, reference.P, atol=1e-6)


# -- with sensors


class World:
    """A moving pad as the filter supposes it, seen from a vehicle that sways over it."""

    def __init__(self, seed, settings, duration, pad_velocity=(0.0, 0.0, 0.0), wander=1.0):
        self.rng = np.random.default_rng(seed)
        self.settings, self.sway = settings, Sway(amplitude=(0.4, -0.3), height=6.0, descent=0.4)
        self.times = PERIOD * np.arange(round(duration / PERIOD))
        c = settings
        v = np.array(pad_velocity, dtype=float)
        p = np.array([0.5, -0.3, 0.0])
        b = wander * c.bearing_bias * self.rng.standard_normal(2)
        self.p, self.v, self.b = [], [], []
        densities = np.array([c.horizontal_acceleration] * 2 + [c.vertical_acceleration])
        root = np.linalg.cholesky(
            np.array([[PERIOD**3 / 3, PERIOD**2 / 2], [PERIOD**2 / 2, PERIOD]])
        )
        decay = np.exp(-PERIOD / c.bearing_bias_time)
        for _ in self.times:
            self.p.append(p)
            self.v.append(v)
            self.b.append(b)
            w = wander * densities[:, None] * (self.rng.standard_normal((3, 2)) @ root.T)
            walk = wander * c.position_noise * np.sqrt(PERIOD) * self.rng.standard_normal(3)
            p, v = p + PERIOD * v + w[:, 0] + walk, v + w[:, 1]
            kick = wander * c.bearing_bias * np.sqrt(1 - decay**2)
            b = decay * b + kick * self.rng.standard_normal(2)

    def relative(self, k):
        """p_BP_W at step k, m."""
        return self.p[k] - self.sway.position(self.times[k])

    def marker(self, k, arrival, noise=1.0):
        """A MARKER measurement made at step k."""
        s = self.settings.front_end
        found = self.relative(k)
        sigma_bearing = 1e-3
        height = -found[2]
        lateral = np.hypot(s.marker_noise, height * s.attitude_noise)
        # bearing and range errors are small: add everything in W
        scatter = np.array([np.hypot(lateral, height * sigma_bearing)] * 2 + [s.marker_noise])
        found = found + noise * scatter * self.rng.standard_normal(3)
        found[:2] += height * self.b[k]
        p_C = np.array([-found[1], -found[0], -found[2]])
        measurement = MARKER.zeros()
        measurement[:4] = self.times[k], arrival, k, 1.0
        measurement[MARKER.slice("bearing_C")] = p_C / np.linalg.norm(p_C)
        measurement[MARKER.index("range")] = np.linalg.norm(p_C)
        for name in ("covariance_xx", "covariance_yy"):
            measurement[MARKER.index(name)] = sigma_bearing**2
        measurement[MARKER.index("covariance_rr")] = 1e-8
        return measurement

    def infrared(self, k, arrival, lamps=(), noise=1.0, sees_beacon=True):
        """An INFRARED measurement made at step k; other lamps stand at `lamps` in W, brighter."""
        s = self.settings.front_end
        spots = [np.asarray(lamp) - self.sway.position(self.times[k]) for lamp in lamps]
        if sees_beacon:
            spots.append(self.relative(k))
        measurement = INFRARED.zeros()
        measurement[:4] = self.times[k], arrival, k, float(bool(spots))
        measurement[INFRARED.index("count")] = len(spots)
        for i, spot in enumerate(spots):
            height = -spot[2]
            lateral = np.hypot(s.infrared_lamp_noise, height * s.attitude_noise)
            sigma = np.hypot(lateral, height * s.infrared_angle_noise)
            x, y = spot[:2] + noise * sigma * self.rng.standard_normal(2) + height * self.b[k]
            measurement[INFRARED.index(f"blob_{i}_x")] = -y / height
            measurement[INFRARED.index(f"blob_{i}_y")] = -x / height
            measurement[INFRARED.index(f"blob_{i}_area")] = 20.0
        return measurement

    def fly(self, every=(2, 1), latency=(3, 1), lamps=lambda t: (), marker_until=np.inf, noise=1.0,
            beacon=lambda t: True, ranged=False):  # fmt: skip
        """Run the estimator; the targets and the hypotheses at every step."""
        system = MultiHypothesisTarget(self.settings)
        bench = Bench(system)
        marker, infrared = no_measurement(MARKER), no_measurement(INFRARED)
        bench.step(0, marker=marker, infrared=infrared, range_finder=no_measurement(RANGE_FINDER),
                   estimate=self.sway.estimate(self.times[0]))  # fmt: skip
        targets, hypotheses = [], []
        for k, t in enumerate(self.times):
            inputs = {"estimate": self.sway.estimate(t)}
            if k >= latency[0] and k % every[0] == 0 and t < marker_until:
                inputs["marker"] = self.marker(k - latency[0], t, noise)
            if k >= latency[1] and k % every[1] == 0:
                then = k - latency[1]
                lit = lamps(self.times[then])
                inputs["infrared"] = self.infrared(then, t, lit, noise, beacon(self.times[then]))
            if ranged:
                ranging = RANGE_FINDER.zeros()
                ranging[:4] = t, t, k, 1.0
                ranging[RANGE_FINDER.index("range")] = self.sway.position(t)[2]
                inputs["range_finder"] = ranging
                index = VEHICLE_ESTIMATE.index
                inputs["estimate"][index("height_above_ground")] = self.sway.position(t)[2]
                inputs["estimate"][index("height_above_ground_valid")] = 1.0
            targets.append(bench.step(k, **inputs))
            hypotheses.append(system.GetOutputPort("hypotheses").Eval(bench.context).copy())
        return np.array(targets), np.array(hypotheses)

    def errors(self, targets):
        """Position error, shape (n, 3), m."""
        truth = np.array([self.relative(k) for k in range(len(self.times))])
        return targets[:, TARGET_ESTIMATE.slice("p_BP_W")] - truth


def test_consistency_over_a_hundred_runs():
    """The mean normalised error squared of position and velocity lies in its chi-square band."""
    settings = config()
    runs, sampled = 100, (48, 76, 99)
    squared = np.zeros((runs, len(sampled), 6))
    for run in range(runs):
        world = World(
            run, settings, 2.0, pad_velocity=1.5 * np.random.default_rng(run).standard_normal(3)
        )
        targets, _ = world.fly()
        error = world.errors(targets)
        for i, k in enumerate(sampled):
            v_error = targets[k, TARGET_ESTIMATE.slice("v_WP")] - world.v[k]
            variance = np.concatenate(
                (
                    targets[k, TARGET_ESTIMATE.slice("position_variance")],
                    targets[k, TARGET_ESTIMATE.slice("velocity_variance")],
                )
            )
            squared[run, i] = np.concatenate((error[k], v_error)) ** 2 / variance
    low, high = chi2.ppf([0.0005, 0.9995], runs) / runs  # each of 18 bands, 2 % false alarms in all
    mean = squared.mean(axis=0)
    assert (mean > low).all()
    assert (mean < high).all()


LAMP = (2.0, -0.3, 0.0)  # 1.5 m from the pad


def distance_from_pad(world, targets):
    return np.linalg.norm(world.errors(targets)[:, :2], axis=1)


@pytest.mark.parametrize("marker_until", [np.inf, 1.0])
def test_a_persistent_false_beacon_does_not_move_the_target(marker_until):
    """From 2 s on a brighter lamp; with the marker, and with the infrared camera alone."""
    world = World(1, config(), 8.0, wander=0.0)
    targets, hypotheses = world.fly(
        lamps=lambda t: (LAMP,) if t > 2.0 else (), marker_until=marker_until, ranged=True
    )
    settled = world.times > 1.0
    limit = 0.05 if marker_until > 8.0 else 0.15  # the infrared camera errs by 2 cm from 6 m
    assert distance_from_pad(world, targets)[settled].max() < limit
    assert field(targets, "acquired")[settled].all()
    assert hypotheses[-1, TARGET_HYPOTHESES.index("probability_0")] > 0.99
    rival = hypotheses[-1, TARGET_HYPOTHESES.index("p_WP_x_1")]
    assert rival == pytest.approx(LAMP[0], abs=0.4)  # as its height is only guessed


def test_a_lamp_that_was_there_first_loses_against_the_marker():
    """The lamp alone for 1 s, the pad with its marker later: doubt, then the pad."""
    world = World(2, config(), 6.0, wander=0.0)
    targets, _ = world.fly(
        lamps=lambda t: (LAMP,), beacon=lambda t: t > 1.0, latency=(70, 1), ranged=True
    )
    misled = (world.times > 0.5) & (world.times < 0.9)
    assert distance_from_pad(world, targets)[misled].min() > 1.3
    assert distance_from_pad(world, targets)[world.times > 3.0].max() < 0.1


def test_two_lamps_from_the_start_leave_doubt():
    """Without a marker nothing tells them apart, and the variance says so."""
    world = World(3, config(mode="infrared"), 4.0, wander=0.0)
    targets, hypotheses = world.fly(lamps=lambda t: (LAMP,), ranged=True)
    assert hypotheses[-1, TARGET_HYPOTHESES.index("probability_0")] == pytest.approx(0.5)
    sigma = np.sqrt(field(targets, "position_variance_x")[-1])
    assert sigma == pytest.approx(1.5 * np.sqrt(0.5), rel=0.05)


def test_the_lamp_does_not_inherit_while_the_pad_is_out_of_sight_for_a_while():
    world = World(4, config(), 8.0, wander=0.0)
    targets, _ = world.fly(
        lamps=lambda t: (LAMP,) if t > 2.0 else (),
        marker_until=3.0,
        beacon=lambda t: not 3.0 < t < 6.0,
        ranged=True,
    )
    unseen = (world.times > 3.2) & (world.times < 6.0)
    assert (field(targets, "time_of_last_fusion")[unseen] <= 3.0).all()
    assert (np.diff(field(targets, "position_variance_x")[unseen]) > 0.0).all()
    assert distance_from_pad(world, targets)[world.times > 3.5].max() < 0.5
    assert field(targets, "acquired")[-1]
    assert distance_from_pad(world, targets)[world.times > 7.0].max() < 0.05


def test_outliers_are_rejected():
    world = World(5, config(), 5.0, wander=0.0)
    flicker = np.random.default_rng(9).uniform(-3.0, 3.0, (2000, 2))
    targets, _ = world.fly(
        lamps=lambda t: ((*flicker[int(t / PERIOD)], 0.0),) if int(t / PERIOD) % 3 == 0 else ()
    )
    settled = world.times > 1.0
    assert distance_from_pad(world, targets)[settled].max() < 0.05


@pytest.mark.parametrize("velocity", [(2.0, 0.0, 0.0), (-1.0, 2.0, 0.3)])
def test_a_moving_pad_is_followed_with_its_velocity(velocity):
    world = World(6, config(), 4.0, pad_velocity=velocity, wander=0.0)
    targets, _ = world.fly()
    settled = world.times > 2.0
    assert np.abs(world.errors(targets)[settled]).max() < 0.06
    found = targets[settled][:, TARGET_ESTIMATE.slice("v_WP")]
    assert np.abs(found - velocity).max() < 0.35


def test_a_pad_that_leaves_at_once_is_found_again_within_two_seconds():
    """Its marker is seen elsewhere, and nothing where it was."""
    world = World(7, config(), 7.0, wander=0.0)
    jump = world.times > 3.0
    world.p = [p + np.array([1.5, 0.0, 0.0]) * late for p, late in zip(world.p, jump, strict=True)]
    targets, _ = world.fly()
    assert distance_from_pad(world, targets)[world.times > 5.0].max() < 0.12


@pytest.mark.parametrize("latency", [(3, 1), (20, 12)])
def test_latency_needs_no_parameter(latency):
    """0.3 s and 0.2 s late, out of order, without noise: still where the pad is."""
    world = World(8, config(), 5.0, wander=0.0)
    targets, _ = world.fly(latency=latency, noise=0.0)
    settled = world.times > 2.0
    assert distance_from_pad(world, targets)[settled].max() < 2e-3


def test_one_failing_sensor_is_survived():
    sway = Sway(amplitude=(0.3, -0.2))
    times, targets = simulate(config(), Scene(sway, marker_until=4.0, infrared_until=8.0), 7.9)
    settled = times > 1.0
    assert field(targets, "acquired")[settled].all()
    assert np.abs(horizontal_error(times, targets, sway)[settled]).max() < 0.03
    times, targets = simulate(
        config(mode="marker"), Scene(Sway(), marker_until=4.0, infrared_until=8.0), 7.0
    )
    # What is at rest stays where it was, ever less surely.
    blind = times > 4.1
    assert field(targets, "acquired")[blind].all()
    assert np.abs(horizontal_error(times, targets, Sway())[blind]).max() < 0.03
    sigma = np.sqrt(field(targets, "position_variance_x")[blind])
    assert (np.diff(sigma) > 0.0).all()
    assert sigma[0] < 0.1 < sigma[-1] < 0.25


def test_what_moves_is_lost_sooner_than_what_rests():
    for velocity, seconds in (((2.0, 0.0, 0.0), 5.0), ((0.0, 0.0, 0.0), np.inf)):
        world = World(10, config(), 9.0, pad_velocity=velocity, wander=0.0)
        targets, _ = world.fly(marker_until=2.0, beacon=lambda t: t < 2.0)
        acquired = field(targets, "acquired") > 0.0
        assert acquired[(world.times > 0.5) & (world.times < 3.0)].all()
        assert acquired[-1] == np.isinf(seconds)
        assert not acquired[world.times > 2.0 + seconds].any()


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0)])
@pytest.mark.parametrize("rate", [25, 4, 1])
def test_a_slow_camera_sees_the_pad_too(rate, velocity):
    """Frames once a second: the second one is enough, and nothing is lost in between."""
    world = World(11, config(mode="marker"), 9.0, pad_velocity=velocity, wander=0.0)
    targets, _ = world.fly(every=(round(1.0 / (rate * PERIOD)), 1))
    acquired = field(targets, "acquired") > 0.0
    assert acquired[world.times > 0.2 + 2.0 / rate].all()
    settled = world.times > 4.0
    assert distance_from_pad(world, targets)[settled].max() < 0.1 + 0.1 * (rate == 1)


def test_one_sighting_does_not_acquire():
    world = World(12, config(mode="marker"), 4.0, wander=0.0)
    targets, _ = world.fly(every=(1000, 1), latency=(0, 1))
    assert not field(targets, "acquired").any()


@pytest.mark.parametrize(
    ("mode", "speed"), [("fused", 1.5), ("fused", 3.0), ("marker", 3.0), ("infrared", 1.5)]
)
def test_a_pad_that_sets_off_at_once_is_followed(mode, speed):
    world = World(13, config(mode=mode), 5.0, wander=0.0)
    gone = np.maximum(world.times - 3.0, 0.0)
    world.p = [p + np.array([speed * t, 0.0, 0.0]) for p, t in zip(world.p, gone, strict=True)]
    targets, _ = world.fly(ranged=True)
    assert field(targets, "acquired")[world.times > 1.0].all()
    found = field(targets, "v_WP_x")
    assert np.abs(found[world.times > 3.5] - speed).max() < 0.35
    assert np.abs(found[(world.times > 2.0) & (world.times < 3.0)]).max() < 0.15
    assert distance_from_pad(world, targets)[world.times > 3.5].max() < 0.15


def test_evidence_is_the_same_for_any_rate():
    """Two seconds of a marker at 1 to 25 frames a second tell its code from others equally."""
    evidence = []
    for every in (2, 10, 50):
        world = World(14, config(mode="marker", marker_odds_limit=1e3), 4.3, wander=0.0)
        _, hypotheses = world.fly(every=(every, 1))
        evidence.append(hypotheses[-1, TARGET_HYPOTHESES.index("evidence_0")])
    assert max(evidence) < 2.6 * min(evidence)  # eight-fold counts: 1 - exp(-dt/0.5 s) a frame


class Drifting(Sway):
    """A vehicle whose estimated position follows a drifting receiver, its velocity hardly."""

    def __init__(self, seed, settings, duration):
        super().__init__(amplitude=(0.4, -0.3), height=6.0, descent=0.4)
        rng = np.random.default_rng(seed)
        steps = round(duration / PERIOD) + 1
        decay = np.exp(-PERIOD / settings.drift_time)
        error = settings.drift_speed * rng.standard_normal(2)
        self.errors = []
        for _ in range(steps):
            self.errors.append(error)
            kick = settings.drift_speed * np.sqrt(1.0 - decay**2) * rng.standard_normal(2)
            error = decay * error + kick
        self.walk = np.cumsum(0.09 * np.sqrt(PERIOD) * rng.standard_normal((steps, 2)), axis=0)

    def estimate(self, t):
        estimate = super().estimate(t)
        k = round(t / PERIOD)
        estimate[VEHICLE_ESTIMATE.slice("v_WB")][:2] += self.errors[k]
        estimate[VEHICLE_ESTIMATE.slice("p_WB")][:2] += self.walk[k]
        return estimate


def test_an_unseen_pad_is_where_the_odometry_says_and_as_surely():
    """Seen for 3 s, then not: errors after 1, 2 and 4 s, against their variance."""
    settings, runs, sampled = config(), 40, (200, 250, 349)
    squared = np.zeros((runs, len(sampled), 2))
    for run in range(runs):
        world = World(run, settings, 7.0, wander=0.0)
        world.sway = Drifting(run, settings, 7.0)
        world.b = [np.zeros(2)] * len(world.times)
        targets, _ = world.fly(marker_until=3.0, beacon=lambda t: t < 3.0)
        error = world.errors(targets)
        for i, k in enumerate(sampled):
            variance = targets[k, TARGET_ESTIMATE.slice("position_variance")][:2]
            squared[run, i] = error[k, :2] ** 2 / variance
    low, high = chi2.ppf([0.0005, 0.9995], 2 * runs) / (2 * runs)
    mean = squared.mean(axis=(0, 2))
    assert (mean < high).all()
    assert mean[-1] > low  # at first the bearing's bias, of which there is none, is most of σ


def test_configure_makes_a_used_estimator_a_new_one():
    wanted = config(mode="infrared", drift_speed=0.3)

    class Reused(MultiHypothesisTargetConfig):
        def add_to(self, builder, name, seed=0):
            estimator = super().add_to(builder, name, seed)
            estimator.configure(wanted, seed)
            return estimator

    scene = [Scene(Sway(), marker_until=1.0, infrared_until=3.0) for _ in range(3)]
    answers = [simulate(c, s, 4.0)[1] for c, s in zip((wanted, Reused()), scene[1:], strict=True)]
    np.testing.assert_array_equal(answers[0], answers[1])
    assert field(answers[0], "acquired").any()
    assert (answers[0] != simulate(config(mode="infrared"), scene[0], 4.0)[1]).any()


def test_a_reset_of_the_navigation_filter_does_not_move_the_target():
    class Jumping(Sway):
        def estimate(self, t):
            estimate = super().estimate(t)
            if t > 2.0:
                estimate[VEHICLE_ESTIMATE.index("p_WB_x")] += 3.0
                estimate[VEHICLE_ESTIMATE.index("horizontal_reset_counter")] = 1.0
                estimate[VEHICLE_ESTIMATE.index("horizontal_reset_x")] = 3.0
            return estimate

    world = World(9, config(), 4.0, wander=0.0)
    world.sway = Jumping(amplitude=(0.4, -0.3), height=6.0, descent=0.4)
    targets, _ = world.fly(noise=0.0)
    settled = world.times > 1.5
    assert field(targets, "acquired")[settled].all()
    assert distance_from_pad(world, targets)[settled].max() < 0.01


# -- light beacons, and the receivers of pad and vehicle


def svgs_pose(p_BP_W, validity, arrival, beacon=0):
    """An SVGS measurement of a beacon that stands as configured, from a level vehicle."""
    settings = SvgsBeaconsConfig()
    x, y, z, _ = settings.placements()[beacon]
    p_BT = p_BP_W + np.array([x, y, z])
    pose = no_measurement(SVGS)
    pose[:4] = validity, arrival, round(arrival / PERIOD), 1.0
    pose[SVGS.index("beacon")] = beacon
    pose[SVGS.slice("p_CT")] = -p_BT[1], -p_BT[0], -p_BT[2]
    # x_C = −y_W, y_C = −x_W, z_C = −z_W: half a turn about (1, −1, 0)
    pose[SVGS.slice("q_CT")] = 0.0, np.sqrt(0.5), -np.sqrt(0.5), 0.0
    diagonal = [f"covariance_{i}{i}" for i in range(6)]
    pose[[SVGS.index(name) for name in diagonal]] = [1e-4] * 3 + [1e-6] * 3
    return pose


def test_an_svgs_pose_is_where_its_beacon_stands_on_the_pad():
    sway = Sway(height=60.0, descent=0.7)
    bench = Bench(MultiHypothesisTarget(config("svgs")))
    silent = {"svgs": no_measurement(SVGS)}
    for k in range(200):
        t = k * PERIOD
        if k >= 8 and k % 6 == 0:
            then = t - 8 * PERIOD
            silent["svgs"] = svgs_pose(-sway.position(then), then, t, beacon=(k // 6) % 3)
        target = bench.step(k, estimate=sway.estimate(t), **silent)
    target = TARGET_ESTIMATE(target)
    assert target.acquired == 1.0
    assert target.source == 4.0
    found = target[TARGET_ESTIMATE.slice("p_BP_W")]
    np.testing.assert_allclose(found, -sway.position(199 * PERIOD), atol=0.02)


def test_from_high_up_less_need_be_known():
    """60 m up a bearing bias of 10 mrad leaves 0.6 m, which is known; 3 m up it would not be."""
    sway = Sway(height=60.0, descent=0.0)
    for slope, acquired in ((0.05, 1.0), (0.0, 0.0)):
        settings = config("svgs", known_slope=slope, known_radius=0.5)
        bench = Bench(MultiHypothesisTarget(settings))
        for k in range(150):
            t = k * PERIOD
            pose = svgs_pose(-sway.position(t), t, t)
            target = bench.step(k, estimate=sway.estimate(t), svgs=pose)
        assert TARGET_ESTIMATE(target).acquired == acquired


class Receivers:
    """Fixes of the vehicle and of a pad that drives, every 0.2 s, the pad's 0.2 s late."""

    ORIGIN = (39.3622, 22.9420, 10.0)

    def __init__(self, kind, pad_velocity=(0.0, 0.0, 0.0), offset=(0.0, 0.0, 0.0)):
        self.kind, self.v = kind, np.array(pad_velocity)
        self.offset = np.array(offset)  # m, of the pad's fixes from the truth
        self.sway = Sway(height=5.0, descent=0.0)

    def pad(self, t):
        return np.array([0.5, -0.3, 0.0]) + self.v * t

    def fix(self, p_W, v_W, validity, arrival):
        receiver = RECEIVERS[self.kind]
        fix = no_measurement(GNSS)
        fix[:4] = validity, arrival, round(validity / 0.2), 1.0
        fix[4:7] = geodetic_from_world(p_W, np.array(self.ORIGIN))
        fix[GNSS.slice("v_W")] = v_W
        for name in ("horizontal_accuracy", "vertical_accuracy", "speed_accuracy", "fix_type"):
            fix[GNSS.index(name)] = getattr(receiver, name)
        return fix

    def fly(self, duration, settings=None, **others):
        """The last target, and its error (m) there."""
        bench = Bench(MultiHypothesisTarget(settings or config()))
        gnss = pad_gnss = no_measurement(GNSS)
        for k in range(round(duration / PERIOD)):
            t = k * PERIOD
            if k % 10 == 0:
                gnss = self.fix(self.sway.position(t), self.sway.velocity(t), t, t)
                if k >= 10:
                    then = t - 0.2
                    pad_gnss = self.fix(self.pad(then) + self.offset, self.v, then, t)
            sensors = {name: make(k, t) for name, make in others.items()}
            estimate = self.sway.estimate(t)
            target = bench.step(k, estimate=estimate, gnss=gnss, pad_gnss=pad_gnss, **sensors)
        error = target[TARGET_ESTIMATE.slice("p_BP_W")] - (self.pad(t) - self.sway.position(t))
        return TARGET_ESTIMATE(target), error


def test_receivers_with_fixed_ambiguities_find_a_pad_that_drives_alone():
    target, error = Receivers("rtk", pad_velocity=(2.0, -1.0, 0.0)).fly(4.0)
    assert target.acquired == 1.0
    assert np.abs(error[:2]).max() < 0.05
    np.testing.assert_allclose(target[TARGET_ESTIMATE.slice("v_WP")], [2.0, -1.0, 0.0], atol=0.1)
    assert target.time_of_last_fusion > 3.5


def test_receivers_that_wander_begin_nothing():
    target, _ = Receivers("standalone").fly(4.0)
    assert target.acquired == 0.0


@pytest.mark.parametrize("told", [True, False])
def test_a_pad_that_sets_off_unseen_is_followed_by_its_receivers_velocity(told):
    """Seen for 2 s at rest, then 4 s unseen at 2 m/s; its fixes are 2 m off, for good."""
    flight = Receivers("standalone", offset=(2.0, 0.0, 0.0))
    start = 2.2  # s

    def pad(t):
        return np.array([0.5, -0.3, 0.0]) + np.array([2.0, 0.0, 0.0]) * max(t - start, 0.0)

    flight.pad = pad
    make = flight.fix

    def fix(p_W, v_W, validity, arrival):
        own = v_W is flight.v
        v_W = np.array([2.0 if validity > start else 0.0, 0.0, 0.0]) if own else v_W
        made = make(p_W, v_W, validity, arrival)
        made[3] = float(told or not own)
        return made

    flight.fix = fix

    def marker(k, t):
        then = t if t < 2.0 else 2.0 - PERIOD
        p_BP = pad(then) - flight.sway.position(then)
        p_C = np.array([-p_BP[1], -p_BP[0], -p_BP[2]])
        measurement = MARKER.zeros()
        measurement[:4] = then, then, k, 1.0
        measurement[MARKER.slice("bearing_C")] = p_C / np.linalg.norm(p_C)
        measurement[MARKER.index("range")] = np.linalg.norm(p_C)
        for name in ("covariance_xx", "covariance_yy", "covariance_rr"):
            measurement[MARKER.index(name)] = 1e-6
        return measurement

    target, error = flight.fly(6.2, marker=marker)
    missed = np.hypot(*error[:2])
    assert target.acquired == 1.0
    assert missed < 0.6 if told else missed > 7.0


def test_a_lamp_beside_a_pad_with_fixed_ambiguities_is_not_the_pad():
    """It has been seen alone for a second when the first fixes come."""
    flight = Receivers("rtk")

    def infrared(k, t):
        spot = np.array(LAMP) - flight.sway.position(t)
        measurement = INFRARED.zeros()
        measurement[:4] = t, t, k, 1.0
        measurement[INFRARED.index("count")] = 1.0
        measurement[INFRARED.index("blob_0_x")] = spot[1] / spot[2]
        measurement[INFRARED.index("blob_0_y")] = spot[0] / spot[2]
        return measurement

    def height(k, t):
        ranging = RANGE_FINDER.zeros()
        ranging[:4] = t, t, k, 1.0
        ranging[RANGE_FINDER.index("range")] = flight.sway.position(t)[2]
        return ranging

    target, error = flight.fly(6.0, infrared=infrared, range_finder=height)
    assert target.acquired == 1.0
    assert np.abs(error[:2]).max() < 0.05

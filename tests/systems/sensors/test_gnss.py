"""The satellite receiver: geodesy, clock, noise, drift; held against literature and real data."""

import math

import numpy as np
import pytest
from pyulog import ULog
from scipy import stats

from systems import geodesy
from systems.frames import geodetic_from_world, world_from_geodetic
from systems.sensors.gnss import RECEIVERS, Gnss, GnssConfig
from systems.signals.measurement import BODY_STATE, GNSS, PAD_STATE, no_measurement
from tests.shared_data import shared
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench

LOG_PERIOD = 0.08  # s, every fix stays longer than that
LATITUDE = GNSS.index("latitude")
VELOCITY = GNSS.slice("v_W")
ORIGIN = [47.397742, 8.545594, 488.0]
EXACT = {
    f"{axis}_{kind}": 0.0
    for axis in ("horizontal", "vertical")
    for kind in ("noise", "drift", "offset", "velocity_noise")
}


def body(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)) -> np.ndarray:
    state = BODY_STATE.zeros()
    state[0] = 1.0
    state[BODY_STATE.slice("p_WB")] = position
    state[BODY_STATE.slice("v_WB")] = velocity
    return state


def record(config: GnssConfig, state, duration: float, seed: int = 1) -> np.ndarray:
    run = Bench(Gnss(config, seed), {"body": state}, log_period=LOG_PERIOD)
    return run.advance_to(duration).arrivals()


def positions(out: np.ndarray, origin=ORIGIN) -> np.ndarray:
    """Back to W, shape (n, 3), m."""
    geodetic = out[:, LATITUDE : LATITUDE + 3]
    return np.array([world_from_geodetic(row, np.array(origin)) for row in geodetic])


def errors(duration: float, seed: int = 1, **figures) -> np.ndarray:
    """Position errors of a receiver at rest in W's origin, all of them zero but `figures`."""
    config = GnssConfig(origin=ORIGIN, **{**EXACT, **figures})
    return positions(record(config, body(), duration, seed))


def test_topology():
    gnss = Gnss(GnssConfig())
    assert_matches_docstring(gnss)
    assert periodic_update(gnss) == (0.02, 0.0)


def test_starts_with_no_measurement():
    run = Bench(Gnss(GnssConfig()), {"body": body()})
    np.testing.assert_array_equal(run.advance_to(0.0).values()[0], no_measurement(GNSS))


@pytest.mark.parametrize(("rate", "intervals"), [(5, {0.2}), (10, {0.1})])
def test_clock(rate, intervals):
    out = record(GnssConfig(rate=rate), body(), 20.0)
    assert len(out) == 20 * rate
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))
    np.testing.assert_array_equal(out[:, 0], out[:, 1])
    late = out[:, 0] - out[:, 2] / rate
    assert late.min() > -1e-9
    assert late.max() < 0.02
    assert {round(interval, 6) for interval in np.diff(out[:, 0])} == intervals


@pytest.mark.parametrize("origin", [ORIGIN, [39.3622, 22.942, 10.0], [-33.9, 151.2, 50.0]])
@pytest.mark.parametrize("p_W", [[0.0, 0.0, 0.0], [150.0, -80.0, 100.0], [-9000.0, 4000.0, 500.0]])
def test_compiled_geodesy_is_pymap3d_s(p_W, origin):
    compiled = geodesy.geodetic_from_world(np.array(p_W), np.array(origin))
    reference = geodetic_from_world(np.array(p_W), np.array(origin))
    np.testing.assert_allclose(compiled[:2], reference[:2], rtol=0, atol=1e-11)  # 1 um
    assert compiled[2] == pytest.approx(reference[2], abs=1e-6)
    back = geodesy.world_from_geodetic(reference, np.array(origin))
    np.testing.assert_allclose(back, p_W, rtol=0, atol=1e-6)


def test_on_a_pad_it_tells_the_pads_place_and_velocity():
    pad = PAD_STATE.zeros()
    pad[PAD_STATE.slice("p_WP")], pad[PAD_STATE.slice("v_WP")] = (3.0, 4.0, 0.5), (2.0, 0.0, 0.1)
    gnss = Gnss(GnssConfig(origin=ORIGIN, **EXACT), 1, stream="pad_gnss", carrier="pad")
    out = Bench(gnss, {"pad": pad}, log_period=LOG_PERIOD).advance_to(1.0).arrivals()
    np.testing.assert_allclose(positions(out), np.tile([3.0, 4.0, 0.5], (len(out), 1)), atol=1e-6)
    np.testing.assert_array_equal(out[:, VELOCITY], np.tile([2.0, 0.0, 0.1], (len(out), 1)))


def test_without_errors_it_is_the_truth():
    config = GnssConfig(origin=ORIGIN, **EXACT)
    out = record(config, body((12.0, -7.0, 30.0), (1.0, 2.0, -3.0)), 1.0)
    np.testing.assert_allclose(
        positions(out), np.tile([12.0, -7.0, 30.0], (len(out), 1)), atol=1e-6
    )
    np.testing.assert_array_equal(out[:, VELOCITY], np.tile([1.0, 2.0, -3.0], (len(out), 1)))


@pytest.mark.parametrize("kind", ["standalone", "rtk"])
def test_reports_the_receiver_s_quality(kind):
    out = GNSS(record(GnssConfig(kind=kind), body(), 0.2)[0])
    receiver = RECEIVERS[kind]
    for field in GNSS.fields[GNSS.index("horizontal_accuracy") :]:
        assert getattr(out, field) == getattr(receiver, field)
    assert out.valid == 1.0


def test_without_a_fix_it_is_not_valid():
    assert record(GnssConfig(fix_type=0), body(), 0.2)[0, 3] == 0.0


def test_white_noise():
    drawn = errors(300.0, horizontal_noise=0.3, vertical_noise=0.7)
    tolerance = 4.0 / math.sqrt(2 * len(drawn))
    np.testing.assert_allclose(drawn.std(axis=0), [0.3, 0.3, 0.7], rtol=tolerance)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 4.0 / math.sqrt(len(drawn))
    for axis in range(3):
        lag_one = np.corrcoef(drawn[1:, axis], drawn[:-1, axis])[0, 1]
        assert abs(lag_one) < 4.0 / math.sqrt(len(drawn))


def test_drift_is_a_gauss_markov_process():
    """Over 300 time constants of 1 s: σ, and exp(−Δt/τ) between two samples."""
    figures = {"horizontal_drift": 2.0, "vertical_drift": 4.0}
    drift = errors(300.0, **figures, drift_time=1.0, smoothing_time=0.0)
    np.testing.assert_allclose(drift.std(axis=0), [2.0, 2.0, 4.0], rtol=0.25)
    for lag in (1, 3, 5, 10):
        correlation = [np.corrcoef(drift[lag:, i], drift[:-lag, i])[0, 1] for i in range(3)]
        assert np.mean(correlation) == pytest.approx(math.exp(-0.2 * lag), abs=0.12)


def wander(lag):
    """What a standalone receiver's error changes by in a few seconds, one sigma an axis, m."""
    receiver = RECEIVERS["standalone"]
    t = receiver.smoothing_time
    rate = 2.0 * receiver.horizontal_drift**2 / receiver.drift_time  # m2/s
    return np.sqrt(rate * (lag - t * -np.expm1(-lag / t)) + 2.0 * receiver.horizontal_noise**2)


def test_the_receiver_smooths_its_drift():
    """In proportion to time at first, and to its root when it is long to the smoothing time."""
    run = errors_of("standalone", 400.0, 3)[50:, :2]
    for lag in (1, 2, 5, 10, 20):
        moved = run[lag:] - run[:-lag]
        assert np.sqrt(np.mean(moved**2)) == pytest.approx(wander(0.2 * lag), rel=0.2)


def test_offset_is_constant_in_a_run_and_drawn_for_each():
    figures = {"horizontal_offset": 1.0, "vertical_offset": 3.0}
    runs = np.array([errors(1.0, seed, **figures) for seed in range(100)])
    assert np.ptp(runs, axis=1).max() < 1e-6
    np.testing.assert_allclose(runs[:, 0].std(axis=0), [1.0, 1.0, 3.0], rtol=4 / math.sqrt(200))


def test_errors_relative_to_the_start():
    figures = {"horizontal_offset": 1.0, "horizontal_drift": 2.0, "drift_time": 10.0}
    absolute = errors(5.0, horizontal_drift=2.0, drift_time=10.0)
    relative = errors(5.0, relative_to_start=True, **figures)
    np.testing.assert_allclose(relative[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(relative, absolute - absolute[0], atol=1e-6)


def test_velocity_noise():
    config = GnssConfig(
        **{**EXACT, "horizontal_velocity_noise": 0.04, "vertical_velocity_noise": 0.06}
    )
    drawn = record(config, body(velocity=(1.0, 2.0, 3.0)), 300.0)[:, VELOCITY] - [1.0, 2.0, 3.0]
    tolerance = 4.0 / math.sqrt(2 * len(drawn))
    np.testing.assert_allclose(drawn.std(axis=0), [0.04, 0.04, 0.06], rtol=tolerance)


def test_standalone_is_two_and_a_half_metres_cep():
    runs = np.array([errors_of("standalone", 0.2, seed)[0] for seed in range(300)])
    inside = int((np.hypot(runs[:, 0], runs[:, 1]) < 2.5).sum())
    assert stats.binomtest(inside, 300, 0.5).pvalue > 1e-3


def test_rtk_is_a_centimetre_cep_about_its_offset():
    runs = np.array([errors_of("rtk", 0.2, seed, False)[0] for seed in range(300)])
    inside = int((np.hypot(runs[:, 0], runs[:, 1]) < 0.01).sum())
    assert stats.binomtest(inside, 300, 0.5).pvalue > 1e-3


def errors_of(kind: str, duration: float, seed: int, with_offset: bool = True) -> np.ndarray:
    """Position errors of a whole receiver at rest in W's origin, shape (n, 3), m."""
    offset = {} if with_offset else {"horizontal_offset": 0.0, "vertical_offset": 0.0}
    config = GnssConfig(kind=kind, origin=ORIGIN, **offset)
    return positions(record(config, body(), duration, seed))


# Distances from take-off to touch-down in the thesis's Normal land mode (appendix A), m.
NORMAL_LANDINGS = [0.95, 1.70, 1.80, 0.54, 0.51, 0.43, 0.18, 0.165, 0.19, 0.25]


def drift(duration: float) -> float:
    """What a standalone receiver's error changes by in `duration` (s), one sigma an axis, m."""
    receiver = RECEIVERS["standalone"]
    kept = math.exp(-duration / receiver.drift_time)
    return receiver.horizontal_drift * math.sqrt(2.0 * (1.0 - kept))


def test_drift_from_take_off_to_landing():
    duration = 45.0
    drawn = [errors_of("standalone", duration + 0.2, seed) for seed in range(40)]
    moved = np.array([(run[-1] - run[0])[:2] for run in drawn])
    assert moved.std() == pytest.approx(drift(duration), rel=4.0 / math.sqrt(2 * moved.size))


@pytest.mark.parametrize("duration", [30.0, 45.0, 60.0])
def test_drift_agrees_with_the_thesis_s_landings(duration):
    """Ten landings by GNSS alone, half a minute to a minute after take-off.

    None of the receiver's figures was fitted to them. The landings were made on
    several days, so their distances spread wider than one Rayleigh distribution;
    their mean square and the worst of them are compared.
    """
    sigma = drift(duration)
    squares = np.sum(np.square(NORMAL_LANDINGS)) / sigma**2
    cumulative = stats.chi2(2 * len(NORMAL_LANDINGS)).cdf(squares)
    assert 0.025 < cumulative < 0.975
    worst = stats.rayleigh(scale=sigma).cdf(max(NORMAL_LANDINGS)) ** len(NORMAL_LANDINGS)
    assert 0.01 < worst < 0.99


def test_a_real_receiver_at_rest():
    """After the landing in an outdoor flight: hardly any white noise, and a smooth drift."""
    log = ULog(str(shared("data/ulg/outdoor_gps_quad.ulg")), ["vehicle_gps_position"])
    gps = log.data_list[0].data
    time = (gps["timestamp"] - gps["timestamp"][0]) * 1e-6
    rest = time > 70.7
    latitude, longitude = gps["latitude_deg"][rest], gps["longitude_deg"][rest]
    place = 111.2e3 * np.stack((latitude, np.cos(np.radians(latitude[0])) * longitude), axis=1)
    receiver = RECEIVERS["standalone"]
    for lag in (1, 2, 5, 10, 20, 30):  # in 9 s a few of them are independent
        moved = place[lag:] - place[:-lag]
        assert np.sqrt(np.mean(moved**2)) == pytest.approx(wander(0.2 * lag), rel=0.25)
    # The second difference of white noise has six times its variance, that of a drift hardly any.
    assert np.diff(place, 2, axis=0).std() / math.sqrt(6) < 2.0 * receiver.horizontal_noise
    assert np.median(gps["eph"]) == pytest.approx(receiver.horizontal_accuracy, rel=0.05)
    assert np.median(gps["epv"]) == pytest.approx(receiver.vertical_accuracy, rel=0.05)
    assert np.median(gps["s_variance_m_s"]) == pytest.approx(receiver.speed_accuracy, rel=0.05)


def test_deterministic_by_seed():
    first = record(GnssConfig(), body(), 2.0, 1)
    np.testing.assert_array_equal(first, record(GnssConfig(), body(), 2.0, 1))
    other = record(GnssConfig(), body(), 2.0, 2)
    assert (other[:, LATITUDE : VELOCITY.stop] != first[:, LATITUDE : VELOCITY.stop]).all()


def test_configure_is_a_new_receiver():
    run = Bench(Gnss(GnssConfig(), 1), {"body": body()}, log_period=LOG_PERIOD)
    config = GnssConfig(kind="rtk", rate=10)
    run.system.configure(config, 5)
    np.testing.assert_array_equal(run.advance_to(2.0).arrivals(), record(config, body(), 2.0, 5))


def test_a_cloned_context_goes_on_like_the_original():
    whole = record(GnssConfig(), body(), 4.0)
    run = Bench(Gnss(GnssConfig(), 1), {"body": body()}, log_period=LOG_PERIOD).advance_to(2.0)
    clone = run.simulator.get_context().Clone()
    run.advance_to(3.0)
    run.simulator.reset_context(clone)
    np.testing.assert_array_equal(run.advance_to(4.0).arrivals(), whole)

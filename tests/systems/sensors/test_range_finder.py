"""The range finder: geometry, accuracy, limits."""

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from systems.sensors.range_finder import RANGE_FINDER_PERIOD, RangeFinder, RangeFinderConfig
from systems.signals.measurement import BODY_STATE, PAD_STATE, RANGE_FINDER, no_measurement
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench

RANGE = RANGE_FINDER.index("range")
QUALITY = RANGE_FINDER.index("signal_quality")
EXACT = {"accuracy": 0.0, "relative_accuracy": 0.0, "resolution": 0.0}


def body(position=(0.0, 0.0, 5.0), attitude=(0.0, 0.0, 0.0)) -> np.ndarray:
    state = BODY_STATE.zeros()
    state[:4] = RollPitchYaw(*attitude).ToQuaternion().wxyz()
    state[BODY_STATE.slice("p_WB")] = position
    return state


def pad(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    state = PAD_STATE.zeros()
    state[PAD_STATE.slice("p_WP")] = x, y, z
    return state


def record(config: RangeFinderConfig, state, duration=0.05, seed=1, **inputs) -> np.ndarray:
    finder = RangeFinder(config, seed)
    run = Bench(finder, {"body": state, **inputs}, log_period=RANGE_FINDER_PERIOD)
    return run.advance_to(duration).arrivals()


def measured(config: RangeFinderConfig, state, **inputs) -> float:
    """One valid range."""
    out = record(config, state, **inputs)[-1]
    assert out[3] == 1.0
    assert out[QUALITY] == 100.0
    return out[RANGE]


def test_topology():
    finder = RangeFinder(RangeFinderConfig())
    assert assert_matches_docstring(finder).optional == {"pad"}
    assert periodic_update(finder) == (0.04, 0.0)


def test_starts_with_no_measurement():
    run = Bench(RangeFinder(RangeFinderConfig()), {"body": body()})
    np.testing.assert_array_equal(run.advance_to(0.0).values()[0], no_measurement(RANGE_FINDER))


def test_header():
    out = record(RangeFinderConfig(), body(), 1.0)
    np.testing.assert_allclose(out[:, 0], 0.04 * np.arange(len(out)), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out[:, 0], out[:, 1])
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))
    assert out[:, 3].all()


@pytest.mark.parametrize("attitude", [(0, 0, 0), (0.3, 0, 1.0), (0.2, -0.4, 2.0)])
@pytest.mark.parametrize("position", [[0.0, 0.0, 0.0], [0.1, -0.2, -0.05]])
def test_range_ends_on_the_ground(attitude, position):
    """The end of the beam, put through Drake's transforms, has no height."""
    config = RangeFinderConfig(position=position, **EXACT)
    length = measured(config, body((3.0, 4.0, 5.0), attitude))
    X_WB = RigidTransform(RollPitchYaw(*attitude), np.array([3.0, 4.0, 5.0]))
    x, y, z = position
    end = X_WB @ np.array([x, y, z - length])
    assert end[2] == pytest.approx(0.0, abs=1e-12)


def test_pad_stands_above_the_ground():
    config = RangeFinderConfig(pad_radius=0.5, **EXACT)
    raised = pad(z=1.0)
    assert measured(config, body((0.0, 0.0, 5.0)), pad=raised) == pytest.approx(4.0)
    assert measured(config, body((0.49, 0.0, 5.0)), pad=raised) == pytest.approx(4.0)
    assert measured(config, body((0.51, 0.0, 5.0)), pad=raised) == pytest.approx(5.0)


def test_tilted_beam_meets_the_pad_where_it_points():
    config = RangeFinderConfig(pad_radius=0.3, **EXACT)
    tilt = 0.3  # pitched nose down: the beam goes backwards
    away = 4.0 * math.tan(tilt)
    state = body((0.0, 0.0, 5.0), (0.0, tilt, 0.0))
    assert measured(config, state, pad=pad(x=-away, z=1.0)) == pytest.approx(4.0 / math.cos(tilt))
    assert measured(config, state, pad=pad(x=away, z=1.0)) == pytest.approx(5.0 / math.cos(tilt))


@pytest.mark.parametrize(
    ("height", "attitude"),
    [
        (0.09, (0.0, 0.0, 0.0)),
        (12.1, (0.0, 0.0, 0.0)),
        (-0.5, (0.0, 0.0, 0.0)),
        (9.0, (0.0, 0.75, 0.0)),  # 12.3 m along the beam
        (2.0, (0.0, 0.8, 0.0)),  # beyond 45 deg
        (2.0, (math.pi, 0.0, 0.0)),
    ],
)
def test_no_return(height, attitude):
    out = record(RangeFinderConfig(**EXACT), body((0.0, 0.0, height), attitude))
    assert not out[:, 3].any()
    assert not out[:, RANGE].any()
    assert not out[:, QUALITY].any()
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))


@pytest.mark.parametrize("height", [0.1, 12.0])
def test_limits_are_within(height):
    assert measured(RangeFinderConfig(**EXACT), body((0.0, 0.0, height))) == height


def test_resolution():
    ranges = record(RangeFinderConfig(), body(), 3.0)[:, RANGE]
    np.testing.assert_allclose(ranges / 0.005, np.rint(ranges / 0.005), atol=1e-9)
    assert len(set(ranges)) > 3


@pytest.mark.parametrize(("height", "sigma"), [(2.0, 0.025), (5.9, 0.025), (10.0, 0.05)])
def test_accuracy_is_two_sigma_over_runs(height, sigma):
    config = RangeFinderConfig(resolution=0.0)
    runs = [record(config, body((0, 0, height)), 0.5, seed)[:, RANGE] for seed in range(80)]
    errors = np.array(runs) - height
    within = math.sqrt(np.mean(errors.var(axis=1, ddof=1)))
    between = errors.mean(axis=1).std()
    assert within == pytest.approx(sigma * math.sqrt(0.5), rel=4.0 / math.sqrt(2 * errors.size))
    assert between == pytest.approx(sigma * math.sqrt(0.5), rel=4.0 / math.sqrt(2 * 80))


def test_deterministic_by_seed():
    config = RangeFinderConfig(resolution=0.0)
    first = record(config, body(), 1.0, 1)
    np.testing.assert_array_equal(first, record(config, body(), 1.0, 1))
    assert (record(config, body(), 1.0, 2)[:, RANGE] != first[:, RANGE]).all()


def test_configure_is_a_new_range_finder():
    config = RangeFinderConfig(accuracy=0.2)
    inputs = {"body": body()}
    run = Bench(RangeFinder(RangeFinderConfig(), 1), inputs, log_period=RANGE_FINDER_PERIOD)
    run.system.configure(config, 5)
    np.testing.assert_array_equal(run.advance_to(1.0).arrivals(), record(config, body(), 1.0, 5))

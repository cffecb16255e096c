"""The delay line: latency to the tick, jitter, losses, copies, order, overflow."""

import math

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from pydrake.systems.framework import Context
from scipy import stats

from systems.configuration import StructureChangedError
from systems.signals.delay_line import (
    DelayLine,
    DelayLineConfig,
    FixedLatency,
    NormalLatency,
    RecordedLatency,
    RollingLatency,
    UniformLatency,
    draw_latency,
)
from systems.signals.measurement import BAROMETER, MARKER, Layout, no_measurement
from systems.signals.noise import stream_key, uniform
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench, Playback, samples

PERIOD = 0.02  # s, of the sensor


def bench(config: DelayLineConfig, rows: np.ndarray, layout: Layout = BAROMETER, seed=1) -> Bench:
    line = DelayLine(config, seed, layout=layout)
    return Bench(line, {"measurement": Playback(rows[:, 1], rows, no_measurement(layout))})


def released(config: DelayLineConfig, count: int = 40, seed: int = 1) -> np.ndarray:
    rows = samples(BAROMETER, PERIOD, count)
    return bench(config, rows, seed=seed).advance_to(PERIOD * count + 1.0).arrivals()


def test_topology():
    line = DelayLine(DelayLineConfig(), layout=BAROMETER)
    assert_matches_docstring(line)
    assert periodic_update(line) == (0.01, 0.0)


@pytest.mark.parametrize("layout", [Layout("Bare", ("a", "b", "c", "d")), BAROMETER, MARKER])
def test_holds_any_layout_and_starts_with_no_measurement(layout):
    rows = samples(layout, PERIOD, 10, fields=7.0)
    run = bench(DelayLineConfig(processing=0.03), rows, layout).advance_to(0.5)
    np.testing.assert_array_equal(run.values()[0], no_measurement(layout))
    out = run.arrivals()
    np.testing.assert_array_equal(np.delete(out, 1, axis=1), np.delete(rows, 1, axis=1))


def test_fixed_latency_is_exact_on_the_grid():
    out = released(DelayLineConfig(latency=FixedLatency(time=0.05)))
    assert len(out) == 40
    np.testing.assert_allclose(out[:, 1], out[:, 0] + 0.05, rtol=0, atol=1e-12)


def test_latency_off_the_grid_ends_at_the_next_tick():
    out = released(DelayLineConfig(latency=FixedLatency(time=0.0501)))
    np.testing.assert_allclose(out[:, 1], out[:, 0] + 0.060, rtol=0, atol=1e-12)


def test_exposure_processing_transport_and_draw_add():
    config = DelayLineConfig(
        exposure=0.004, processing=0.03, transport=0.01, latency=FixedLatency(time=0.006)
    )
    np.testing.assert_array_equal(
        released(config), released(DelayLineConfig(latency=FixedLatency(time=0.05)))
    )


def test_latency_counts_from_the_time_of_validity():
    rows = samples(BAROMETER, PERIOD, 20)
    rows[:, 0] -= 0.01  # waited a tick before the line saw it
    out = bench(DelayLineConfig(processing=0.04), rows).advance_to(1.0).arrivals()
    np.testing.assert_allclose(out[:, 1], rows[:, 0] + 0.04, rtol=0, atol=1e-12)


def test_a_release_is_visible_only_after_its_tick():
    run = bench(DelayLineConfig(processing=0.05), samples(BAROMETER, PERIOD, 1)).advance_to(0.1)
    seen = run.times()[run.values()[:, 1] >= 0.0]
    assert seen[0] == pytest.approx(0.0525, abs=1e-12)  # the log's first look after 0.05


@pytest.mark.parametrize(
    ("model", "distribution"),
    [
        (UniformLatency(shortest=0.175, longest=0.23), stats.uniform(0.175, 0.055)),
        (
            NormalLatency(mean=0.02, standard_deviation=0.03),
            stats.truncnorm(-0.02 / 0.03, np.inf, 0.02, 0.03),
        ),
    ],
)
@pytest.mark.parametrize("copy", [0, 1])
def test_latencies_have_their_distribution(model, distribution, copy):
    kind, a, b = model.parameters()
    parameters = np.array([kind, a, b, 0.1, 0.0, 0.0, 1.0])
    key = stream_key(3, "latency")
    drawn = np.array([draw_latency(parameters, key, n, copy) for n in range(4000)]) - 0.1
    assert stats.kstest(drawn, distribution.cdf).pvalue > 1e-3
    lag_one = np.corrcoef(drawn[1:], drawn[:-1])[0, 1]
    assert abs(lag_one) < 3.5 / math.sqrt(len(drawn))


def test_copies_have_latencies_of_their_own():
    parameters = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    key = stream_key(3, "latency")
    drawn = np.array([[draw_latency(parameters, key, n, c) for c in (0, 1)] for n in range(2000)])
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.08


def test_recorded_latencies_are_cycled():
    out = released(DelayLineConfig(latency=RecordedLatency(times=[0.02, 0.04, 0.03])))
    expected = np.resize([0.02, 0.04, 0.03], 40)
    np.testing.assert_allclose(out[:, 1] - out[:, 0], expected, rtol=0, atol=1e-12)


def test_jitter_stays_in_its_bounds():
    config = DelayLineConfig(
        latency=UniformLatency(shortest=0.01, longest=0.06), order="by_release_time"
    )
    out = released(config, 400)
    latency = out[:, 1] - out[:, 0]
    assert len(out) == 400
    assert latency.min() >= 0.01
    assert latency.max() < 0.06 + 2 * 0.01  # a tick late, and once more if two are due
    assert np.std(latency) == pytest.approx(0.05 / math.sqrt(12), rel=0.1)


def test_drops_are_a_function_of_seed_and_number():
    out = released(DelayLineConfig(drop=0.3), 1000)
    kept = out[:, 2].astype(int)
    key = stream_key(1, "delay_line.drop")
    np.testing.assert_array_equal(kept, [n for n in range(1000) if uniform(key, n, 0) >= 0.3])
    assert stats.binomtest(1000 - len(kept), 1000, 0.3).pvalue > 1e-3


def test_duplicates_come_twice_and_are_otherwise_alike():
    config = DelayLineConfig(duplicate=0.4, latency=FixedLatency(time=0.02))
    rows = samples(BAROMETER, PERIOD, 500)
    run = bench(config, rows).advance_to(11.0)
    out = run.arrivals()
    number, copies = np.unique(out[:, 2], return_counts=True)
    np.testing.assert_array_equal(number, np.arange(500))
    assert set(copies) == {1, 2}
    assert stats.binomtest(int((copies == 2).sum()), 500, 0.4).pvalue > 1e-3
    assert len(np.unique(out[:, 1])) == len(out)
    np.testing.assert_allclose(out[:, 0], PERIOD * out[:, 2], atol=1e-12)
    assert run.system.counts(run.context) == {
        "entered": len(out),
        "released": len(out),
        "dropped": 0,
        "duplicated": len(out) - 500,
        "overflowed": 0,
    }


def test_order():
    latency = RecordedLatency(times=[0.1, 0.05])
    in_order = released(DelayLineConfig(latency=latency), 10)
    np.testing.assert_array_equal(in_order[:, 2], np.arange(10))
    re_ordered = released(DelayLineConfig(latency=latency, order="by_release_time"), 10)
    assert list(re_ordered[:, 2]) != sorted(re_ordered[:, 2])
    np.testing.assert_array_equal(
        re_ordered[:, 2], np.argsort([PERIOD * n + (0.1, 0.05)[n % 2] for n in range(10)])
    )


def test_two_that_are_due_leave_at_two_ticks_the_older_one_first():
    latency = RecordedLatency(times=[0.06, 0.04])  # both are due 60 ms after the first
    for order in ("first_in_first_out", "by_release_time"):
        out = released(DelayLineConfig(latency=latency, order=order), 2)
        np.testing.assert_array_equal(out[:, 2], [0, 1])
        np.testing.assert_allclose(out[:, 1], [0.06, 0.07], atol=1e-12)


def test_overflow_loses_the_oldest_and_counts_it():
    rows = samples(BAROMETER, PERIOD, 11)
    run = bench(DelayLineConfig(processing=1.0, capacity=4), rows).advance_to(3.0)
    np.testing.assert_array_equal(run.arrivals()[:, 2], [7, 8, 9, 10])
    counts = run.system.counts(run.context)
    assert (counts["entered"], counts["released"], counts["overflowed"]) == (11, 4, 7)


def reference(rows: np.ndarray, config: DelayLineConfig, keys, parameters, end: float):
    """The delay line once more, with a list: (time, sequence number) of every release."""
    queue: list[tuple[float, int, int]] = []
    out, entered, last, i = [], 0, -math.inf, 0
    for tick in range(round(end / config.period)):
        time = tick * config.period
        if time > end:
            break
        if i < len(rows) and rows[i, 1] < time:
            n = int(rows[i, 2])
            if uniform(keys[1], n, 0) >= config.drop:
                copies = 1 + (uniform(keys[2], n, 0) < config.duplicate)
                for copy in range(copies):
                    release = rows[i, 0] + draw_latency(parameters, keys[0], n, copy)
                    if config.order == "first_in_first_out":
                        release = last = max(release, last)
                    if len(queue) == config.capacity:
                        queue.remove(min(queue, key=lambda entry: entry[1]))
                    queue.append((release, entered, n))
                    entered += 1
            i += 1
        queue.sort()
        if queue and queue[0][0] <= time + 1e-9:
            out.append((time, queue.pop(0)[2]))
    return out


@pytest.mark.parametrize("order", ["first_in_first_out", "by_release_time"])
@pytest.mark.parametrize("capacity", [3, 16])
def test_agrees_with_a_plain_queue(order, capacity):
    latency = NormalLatency(mean=0.06, standard_deviation=0.05)
    config = DelayLineConfig(
        latency=latency, drop=0.1, duplicate=0.2, order=order, capacity=capacity
    )
    rows = samples(BAROMETER, PERIOD, 300)
    out = bench(config, rows, seed=9).advance_to(6.0).arrivals()
    keys = [stream_key(9, f"delay_line.{name}") for name in ("latency", "drop", "duplicate")]
    kind, a, b = latency.parameters()
    parameters = np.array([kind, a, b, 0.0, 0.1, 0.2, order == "first_in_first_out"])
    expected = np.array(reference(rows, config, keys, parameters, 6.0))
    np.testing.assert_allclose(out[:, [1, 2]], expected, rtol=0, atol=1e-9)


def test_a_cloned_context_goes_on_like_the_original():
    config = DelayLineConfig(
        latency=UniformLatency(shortest=0.02, longest=0.2), drop=0.2, order="by_release_time"
    )
    rows = samples(BAROMETER, PERIOD, 100)
    whole = bench(config, rows).advance_to(2.0)
    halves = bench(config, rows).advance_to(0.9)
    clone: Context = halves.simulator.get_context().Clone()
    halves.advance_to(1.1)  # moves on; the clone must not notice
    halves.simulator.reset_context(clone)
    halves.advance_to(2.0)
    np.testing.assert_array_equal(halves.arrivals(), whole.arrivals())


def test_seeds_and_streams_differ():
    config = DelayLineConfig(drop=0.5)
    assert not np.array_equal(released(config, seed=1), released(config, seed=2))
    rows = samples(BAROMETER, PERIOD, 40)
    other = DelayLine(config, 1, layout=BAROMETER, stream="another")
    run = Bench(other, {"measurement": Playback(rows[:, 1], rows, no_measurement(BAROMETER))})
    assert not np.array_equal(run.advance_to(2.0).arrivals(), released(config, seed=1))


def test_configure():
    line = DelayLine(DelayLineConfig(), layout=BAROMETER)
    line.configure(DelayLineConfig(processing=0.05, latency=FixedLatency(time=0.1)), 3)
    for changed in (DelayLineConfig(capacity=5), DelayLineConfig(period=0.02)):
        with pytest.raises(StructureChangedError):
            line.configure(changed, 3)


def test_from_a_scenario():
    """As a scenario's mappings, told apart by their kind."""
    config = TypeAdapter(DelayLineConfig).validate_python(
        {"latency": {"kind": "recorded", "times": [0.1, 0.2]}, "order": "by_release_time"}
    )
    assert config.latency == RecordedLatency(times=[0.1, 0.2])
    with pytest.raises(ValidationError, match="uniform"):
        DelayLineConfig(latency={"kind": "gamma"})


def test_refuses_impossible_figures():
    with pytest.raises(ValueError, match=r"0\.012 s is not"):
        DelayLineConfig(period=0.012)
    with pytest.raises(ValueError, match="less than shortest"):
        UniformLatency(shortest=0.2, longest=0.1)
    with pytest.raises(ValueError, match="times"):
        RecordedLatency(times=[])
    with pytest.raises(ValueError, match="drop"):
        DelayLineConfig(drop=1.5)


def test_a_rolling_latency_is_a_sine_over_the_measurements():
    config = RollingLatency(mean=0.16, amplitude=0.1, turn=12.5)
    parameters = np.array([*config.parameters()[:3], 0.0, 0.0, 0.0, 1.0, config.turn])
    drawn = np.array([draw_latency(parameters, stream_key(3, "line"), n, 0) for n in range(50)])
    phase = 2.0 * np.pi * np.arange(50) / 12.5
    design = np.column_stack((np.ones(50), np.sin(phase), np.cos(phase)))
    (mean, *wave), residual, *_ = np.linalg.lstsq(design, drawn, rcond=None)
    assert residual[0] < 1e-24
    assert mean == pytest.approx(0.16)
    assert np.hypot(*wave) == pytest.approx(0.1)
    again = draw_latency(parameters, stream_key(4, "line"), 0, 0)
    assert again != pytest.approx(drawn[0], abs=1e-6)  # another run, another phase


def test_a_rolling_latency_is_never_negative():
    with pytest.raises(ValidationError, match="is more than the mean"):
        RollingLatency(mean=0.1, amplitude=0.2)


def test_a_rolling_latency_reaches_the_consumer():
    latency = RollingLatency(mean=0.1, amplitude=0.06, turn=40.0)
    out = released(DelayLineConfig(latency=latency, order="by_release_time"))
    taken = out[:, 1] - out[:, 0]
    assert taken.min() < 0.06 < 0.14 < taken.max()

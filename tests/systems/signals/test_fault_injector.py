"""Faults: every row of the thesis's tables 1 and 2, attempts, windows, and distortions."""

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from scipy import stats

from systems.configuration import StructureChangedError
from systems.sensors.barometer import BarometerConfig
from systems.signals.delay_line import DelayLineConfig
from systems.signals.fault_injector import (
    FAULT_COMMAND,
    AboveDrop,
    BelowDrop,
    Bias,
    FalseTarget,
    FaultInjector,
    FaultInjectorConfig,
    Freeze,
    Outlier,
    PeriodicDrop,
    PermanentDrop,
    RandomDrop,
    WindowsDrop,
)
from systems.signals.measurement import (
    BAROMETER,
    BODY_STATE,
    INFRARED,
    INFRARED_BLOBS,
    MARKER,
    PAD_STATE,
    SUPERVISOR_STATUS,
    no_measurement,
)
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.signals.playback import Bench, Playback, samples

PERIOD = 0.02  # s, of the sensor
INFRARED_BIT, MARKER_BIT = 1, 2


def bench(config, rows, layout=BAROMETER, seed=1, **inputs) -> Bench:
    injector = FaultInjector(config, seed, layout=layout)
    measurement = Playback(rows[:, 1], rows, no_measurement(layout))
    return Bench(injector, {"measurement": measurement, **inputs})


def passed(*faults, count=50, rows=None, layout=BAROMETER, seed=1, target=0, **inputs):
    """The measurements that pass `faults`, shape (n, size)."""
    rows = samples(layout, PERIOD, count) if rows is None else rows
    config = FaultInjectorConfig(faults=list(faults), target=target)
    run = bench(config, rows, layout, seed, **inputs)
    return run.advance_to(rows[-1, 1] + 0.1).arrivals()


def numbers(*faults, **arguments) -> list[int]:
    """The sequence numbers of the measurements that pass."""
    return [int(n) for n in passed(*faults, **arguments)[:, 2]]


def falling(start: float, speed: float, duration: float = 2.0) -> Playback:
    """The body's state while it descends from `start` (m) at `speed` (m/s)."""
    times = 0.002 * np.arange(round(duration / 0.002) + 1)
    rows = np.zeros((len(times), BODY_STATE.size))
    rows[:, BODY_STATE.index("p_WB_z")] = start - speed * times
    return Playback(times, rows)


def supervisor(times, attempts, landing_started=None) -> Playback:
    rows = np.zeros((len(times), SUPERVISOR_STATUS.size))
    rows[:, SUPERVISOR_STATUS.index("attempts")] = attempts
    rows[:, SUPERVISOR_STATUS.index("landing_started")] = (
        0.0 if landing_started is None else landing_started
    )
    return Playback(np.array(times), rows)


def commands(*rows) -> Playback:
    """Commands (time, target, r_drop, p_keep, p_drop), each issued at its time."""
    none = FAULT_COMMAND.zeros()
    none[0] = -1.0
    return Playback(np.array([row[0] for row in rows]), np.array(rows), none)


def test_topology():
    injector = FaultInjector(FaultInjectorConfig(), layout=BAROMETER)
    contract = assert_matches_docstring(injector)
    assert contract.optional == {"body", "pad", "supervisor", "command"}
    assert periodic_update(injector) == (0.01, 0.0)


def test_without_faults_everything_passes_a_tick_later():
    rows = samples(BAROMETER, PERIOD, 20, fields=3.0)
    run = bench(FaultInjectorConfig(), rows).advance_to(0.5)
    np.testing.assert_array_equal(run.values()[0], no_measurement(BAROMETER))
    out = run.arrivals()
    np.testing.assert_array_equal(np.delete(out, 1, axis=1), np.delete(rows, 1, axis=1))
    np.testing.assert_allclose(out[:, 1], rows[:, 1] + 0.01, rtol=0, atol=1e-12)


# Table 2 of the thesis: None, Random X, Permanent, Below X, Above X.


@pytest.mark.parametrize("probability", [0.75, 0.5])  # its figures for IR-LOCK and marker
def test_random(probability):
    kept = len(numbers(RandomDrop(probability=probability), count=1500))
    assert stats.binomtest(1500 - kept, 1500, probability).pvalue > 1e-3


def test_random_drops_of_two_faults_are_independent():
    kept = len(numbers(RandomDrop(probability=0.5), RandomDrop(probability=0.5), count=1500))
    assert stats.binomtest(kept, 1500, 0.25).pvalue > 1e-3


def test_permanent():
    assert numbers(PermanentDrop()) == []


def test_below_and_above_are_complements_but_for_the_threshold():
    body = {"body": falling(6.0, 4.0)}  # 3 m at 0.75 s
    below = numbers(BelowDrop(height=3.0), count=100, body=falling(6.0, 4.0))
    above = numbers(AboveDrop(height=3.0), count=100, **body)
    # The height counts that stood in the port just before the event, 10 ms after the sample.
    height = 6.0 - 4.0 * (PERIOD * np.arange(100) + 0.01 - 0.002)
    assert below == list(np.flatnonzero(height > 3.0))
    assert above == list(np.flatnonzero(height < 3.0))


def test_below_for_a_while_is_one_gap():
    fault = BelowDrop(height=3.0, duration=0.3)
    kept = numbers(fault, count=100, body=falling(6.0, 4.0))
    gap = sorted(set(range(100)) - set(kept))
    assert len(gap) == 15  # 0.3 s of 50 Hz, and what is below 3 m after them passes
    assert gap == list(range(gap[0], gap[0] + 15))
    assert gap[0] == numbers(BelowDrop(height=3.0), count=100, body=falling(6.0, 4.0))[-1] + 1
    none = BelowDrop(height=3.0, duration=0.0)
    assert len(numbers(none, count=100, body=falling(6.0, 4.0))) == 100


@pytest.mark.parametrize("fault", [BelowDrop(height=3.0), AboveDrop(height=3.0)])
def test_exactly_at_the_threshold_both_drop(fault):
    body = BODY_STATE.zeros()
    body[BODY_STATE.index("p_WB_z")] = 3.0
    assert numbers(fault, body=body) == []


def test_height_is_above_the_pad():
    body, pad = BODY_STATE.zeros(), PAD_STATE.zeros()
    body[BODY_STATE.index("p_WB_z")] = 3.5
    pad[PAD_STATE.index("p_WP_z")] = 1.0
    assert len(numbers(BelowDrop(height=3.0), body=body)) == 50
    assert numbers(BelowDrop(height=3.0), body=body, pad=pad) == []


def test_below_needs_the_body():
    with pytest.raises(RuntimeError, match="body"):
        passed(BelowDrop(height=3.0))


# Periodic drops, section 7.1.


@pytest.mark.parametrize(("keep", "drop"), [(3, 2), (1, 1), (0, 4), (4, 0), (0, 0)])
def test_periodic(keep, drop):
    expected = [n for n in range(50) if drop == 0 or n % (keep + drop) < keep]
    assert numbers(PeriodicDrop(keep=keep, drop=drop)) == expected


def test_frames_without_a_detection_do_not_advance_a_periodic_fault():
    rows = samples(BAROMETER, PERIOD, 12)
    rows[::2, 3] = 0.0
    # valid ones: 1 3 5 7 9 11, of which the first two are kept, the next two dropped …
    assert numbers(PeriodicDrop(keep=2, drop=2), rows=rows) == [0, 1, 2, 3, 8, 9, 10, 11]


# Windows, times, attempts.


def test_windows():
    kept = numbers(WindowsDrop(windows=[[0.1, 0.2], [0.4, 0.5]]), count=60)
    at = PERIOD * np.arange(60) + 0.01
    inside = ((at >= 0.1) & (at < 0.2)) | ((at >= 0.4) & (at < 0.5))
    assert kept == list(np.flatnonzero(~inside))


def test_start_and_end_time():
    kept = numbers(PermanentDrop(start_time=0.2, end_time=0.4), count=60)
    at = PERIOD * np.arange(60) + 0.01
    assert kept == list(np.flatnonzero((at < 0.2) | (at >= 0.4)))


def test_below_three_metres_only_during_the_first_attempt():
    """The thesis's table 5: the fault is gone when the landing is tried again."""
    body = BODY_STATE.zeros()
    body[BODY_STATE.index("p_WB_z")] = 2.0
    fault = BelowDrop(height=3.0, until_attempt=1)
    attempts = supervisor([0.0, 0.2, 0.4], [0, 1, 2])
    kept = numbers(fault, body=body, supervisor=attempts)
    assert kept[0] == np.ceil((0.4 - 0.01) / PERIOD)
    assert kept == list(range(kept[0], 50))


def test_from_attempt_and_while_landing():
    def kept(fault) -> int:
        status = supervisor([0.0, 0.2, 0.4], [0, 1, 2], [-1.0, -1.0, 0.4])
        passing = numbers(fault, supervisor=status)
        assert passing == list(range(len(passing)))
        return len(passing)

    # The first that is dropped came out of the port 10 ms after its sample, after the status.
    assert kept(PermanentDrop(from_attempt=1)) == np.ceil((0.2 - 0.01 + 0.002) / PERIOD)
    assert kept(PermanentDrop(while_landing=True)) == np.ceil((0.4 - 0.01 + 0.002) / PERIOD)


def test_attempts_need_the_supervisor():
    with pytest.raises(RuntimeError, match="supervisor"):
        passed(PermanentDrop(from_attempt=1))


# Commands in flight, table 1.


def commanded(*rows, target=INFRARED_BIT, count=60, **arguments) -> list[int]:
    return numbers(target=target, count=count, command=commands(*rows), **arguments)


def test_command_random():
    kept = len(commanded((0.0, 1, 0.75, 0, 0), count=1500))
    assert stats.binomtest(1500 - kept, 1500, 0.75).pvalue > 1e-3


def test_command_random_wins_over_periodic():
    assert commanded((0.0, 1, 0.5, 0, 1)) == commanded((0.0, 1, 0.5, 0, 0)) != []


@pytest.mark.parametrize("permanent", [(1.0, 0, 0), (1.0, 5, 5), (0.0, 0, 1), (0.0, 0, 9)])
def test_command_permanent(permanent):
    assert commanded((0.0, 1, *permanent)) == []


def test_command_periodic_starts_with_the_keep_phase():
    kept = commanded((0.2, 1, 0.0, 2, 3))
    first = int(np.ceil((0.2 - 0.01 + 0.002) / PERIOD))  # the first one after the command
    assert kept == [n for n in range(60) if n < first or (n - first) % 5 < 2]


def test_command_all_zero_ends_it():
    kept = commanded((0.0, 1, 1.0, 0, 0), (0.4, 1, 0.0, 0, 0))
    assert kept == list(range(kept[0], 60))
    assert kept[0] == pytest.approx(0.4 / PERIOD, abs=1.0)


@pytest.mark.parametrize(
    ("own", "addressed", "obeys"),
    [(1, 1, True), (1, 2, False), (2, 1, False), (2, 2, True), (1, 3, True), (2, 3, True)],
)
def test_command_reaches_its_target_only(own, addressed, obeys):
    assert (commanded((0.0, addressed, 1.0, 0, 0), target=own) == []) is obeys


def test_a_command_for_another_sensor_changes_nothing():
    assert commanded((0.0, 1, 1.0, 0, 0), (0.3, 2, 0.0, 0, 0)) == []


def test_a_sensor_without_a_bit_takes_no_commands():
    assert len(commanded((0.0, 3, 1.0, 0, 0), target=0)) == 60


def test_commands_leave_configured_faults_alone():
    command = (0.0, 1, 0.0, 0, 0)
    kept = numbers(PeriodicDrop(keep=1, drop=1), target=1, command=commands(command))
    assert kept == list(range(0, 50, 2))


# Distortions.


def test_bias_is_added_to_named_fields_only():
    rows = samples(MARKER, PERIOD, 5, fields=2.0)
    out = passed(Bias(offsets={"range": 0.5, "bearing_C_x": -0.1}), rows=rows, layout=MARKER)
    expected = rows.copy()
    expected[:, MARKER.index("range")] += 0.5
    expected[:, MARKER.index("bearing_C_x")] -= 0.1
    np.testing.assert_allclose(np.delete(out, 1, axis=1), np.delete(expected, 1, axis=1))


@pytest.mark.parametrize("field", ["rnge", "valid"])
def test_bias_names_the_nearest_field(field):
    fault = Bias(offsets={field: 1.0})
    with pytest.raises(ValueError, match=rf"no field '{field}' \(nearest: "):
        FaultInjector(FaultInjectorConfig(faults=[fault]), layout=MARKER)


def test_freeze_repeats_fields_under_new_headers():
    rows = samples(BAROMETER, PERIOD, 50)
    rows[:, 4] = np.arange(50.0)
    out = passed(Freeze(start_time=0.2, end_time=0.4), rows=rows)
    assert len(out) == 50
    np.testing.assert_array_equal(out[:, 2], np.arange(50))
    np.testing.assert_array_equal(out[:, 0], rows[:, 0])
    frozen = (out[:, 1] >= 0.2) & (out[:, 1] < 0.4)
    np.testing.assert_array_equal(out[~frozen, 4], rows[~frozen, 4])
    assert set(out[frozen, 4]) == {np.flatnonzero(frozen)[0] - 1.0}


def test_freeze_from_the_start_holds_the_first_measurement():
    rows = samples(BAROMETER, PERIOD, 10)
    rows[:, 4] = 5.0 + np.arange(10.0)
    assert set(passed(Freeze(), rows=rows)[:, 4]) == {5.0}


def test_freeze_repeats_the_valid_flag():
    rows = samples(BAROMETER, PERIOD, 30)
    rows[10:, 3] = 0.0
    out = passed(Freeze(start_time=PERIOD * 10), rows=rows)
    assert out[:, 3].all()


def infrared(count: int, areas: list[float]) -> np.ndarray:
    rows = samples(INFRARED, PERIOD, count)
    rows[:, 3] = float(bool(areas))
    rows[:, 4] = len(areas)
    for i, area in enumerate(areas):
        rows[:, 5 + 3 * i : 8 + 3 * i] = 0.01 * i, 0.02 * i, area
    return rows


def blobs(measurement: np.ndarray) -> list[tuple[float, float, float]]:
    count = int(measurement[4])
    assert not measurement[5 + 3 * count :].any()
    return [tuple(measurement[5 + 3 * i : 8 + 3 * i]) for i in range(count)]


@pytest.mark.parametrize(
    ("areas", "rank"),
    [([], 0), ([30.0], 1), ([10.0], 0), ([30.0, 20.0, 5.0], 2), ([9.0, 8.0, 7.0, 6.0, 5.0], 0)],
)
def test_false_blob_takes_its_place_by_area(areas, rank):
    rows = infrared(3, areas)
    fault = FalseTarget(bearing=[0.3, -0.1], area=20.0)
    out = passed(fault, rows=rows, layout=INFRARED)
    expected = blobs(rows[0])
    expected.insert(rank, (0.3, -0.1, 20.0))
    assert blobs(out[0]) == expected[:INFRARED_BLOBS]
    assert out[:, 3].all()


def test_false_blob_smaller_than_five_others_is_not_reported():
    rows = infrared(3, [50.0, 40.0, 30.0, 25.0, 21.0])
    out = passed(FalseTarget(area=20.0), rows=rows, layout=INFRARED)
    assert blobs(out[0]) == blobs(rows[0])


def test_false_blob_instead_of_the_others():
    fault = FalseTarget(bearing=[0.3, -0.1], area=20.0, replace=True)
    out = passed(fault, rows=infrared(3, [50.0, 40.0]), layout=INFRARED)
    assert blobs(out[2]) == [(0.3, -0.1, 20.0)]


def test_false_target_turns_a_marker_s_bearing():
    rows = samples(MARKER, PERIOD, 2)
    bearing = MARKER.slice("bearing_C")
    rows[:, bearing] = np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])
    rows[1, 3] = 0.0
    out = passed(FalseTarget(bearing=[0.2, -0.1]), rows=rows, layout=MARKER)
    turned = np.array([0.3, 0.1, 1.0])
    np.testing.assert_allclose(out[0, bearing], turned / np.linalg.norm(turned), atol=1e-15)
    np.testing.assert_array_equal(out[1, bearing], rows[1, bearing])  # not detected
    np.testing.assert_array_equal(out[0, bearing.stop :], rows[0, bearing.stop :])


def test_false_target_needs_a_bearing():
    with pytest.raises(ValueError, match="BarometerMeasurement has no bearing"):
        FaultInjector(FaultInjectorConfig(faults=[FalseTarget()]), layout=BAROMETER)


def test_faults_act_in_their_order():
    rows = samples(BAROMETER, PERIOD, 10)
    rows[:, 4] = np.arange(10.0)
    bias, freeze = Bias(offsets={"altitude": 100.0}), Freeze()
    assert set(passed(freeze, bias, rows=rows)[:, 4]) == {100.0}
    assert set(passed(bias, freeze, rows=rows)[1:, 4]) == {0.0}


# As a system.


def test_from_a_scenario():
    """As a scenario's mappings, told apart by their kind."""
    config = TypeAdapter(FaultInjectorConfig).validate_python(
        {
            "target": 2,
            "faults": [
                {"kind": "below", "height": 3.0, "until_attempt": 1},
                {"kind": "windows", "windows": [[1.0, 2.0]]},
                {"kind": "false_target", "bearing": [0.1, 0.0]},
            ],
        }
    )
    assert config.faults == [
        BelowDrop(height=3.0, until_attempt=1),
        WindowsDrop(windows=[[1.0, 2.0]]),
        FalseTarget(bearing=[0.1, 0.0]),
    ]
    with pytest.raises(ValidationError, match="permanent"):
        FaultInjectorConfig(faults=[{"kind": "forever"}])


def test_between_a_sensor_and_its_delay_line_it_costs_no_time():
    builder = DiagramBuilder()
    barometer = BarometerConfig().add_to(builder, "barometer", 1)
    faults = FaultInjectorConfig(faults=[PeriodicDrop(keep=1, drop=1)])
    injector = faults.add_to(builder, "faults", 1, BAROMETER)
    line = DelayLineConfig(processing=0.05).add_to(builder, "line", 1, BAROMETER)
    body = builder.AddSystem(ConstantVectorSource(BODY_STATE.zeros()))
    builder.Connect(body.get_output_port(), barometer.get_input_port())
    builder.Connect(barometer.get_output_port(), injector.GetInputPort("measurement"))
    builder.Connect(injector.get_output_port(), line.get_input_port())
    log = LogVectorOutput(line.get_output_port(), builder, 0.005)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(2.0)
    out = log.FindLog(simulator.get_context()).data().T
    out = out[np.flatnonzero(np.diff(out[:, 1], prepend=-1.0))]
    np.testing.assert_array_equal(out[:, 2], 2 * np.arange(len(out)))
    np.testing.assert_allclose(out[:, 1] - out[:, 0], 0.05, rtol=0, atol=1e-12)


def test_deterministic_by_seed():
    fault = RandomDrop(probability=0.5)
    assert numbers(fault, seed=1) == numbers(fault, seed=1)
    assert numbers(fault, seed=1) != numbers(fault, seed=2)


def test_a_cloned_context_goes_on_like_the_original():
    faults = [RandomDrop(probability=0.3), PeriodicDrop(keep=3, drop=2)]
    config = FaultInjectorConfig(faults=faults)
    rows = samples(BAROMETER, PERIOD, 100)
    whole = bench(config, rows).advance_to(1.7)
    halves = bench(config, rows).advance_to(0.7)
    clone = halves.simulator.get_context().Clone()
    halves.advance_to(1.0)
    halves.simulator.reset_context(clone)
    np.testing.assert_array_equal(halves.advance_to(1.7).arrivals(), whole.arrivals())


def test_configure_changes_the_faults_but_not_the_period():
    rows = samples(BAROMETER, PERIOD, 10)
    run = bench(FaultInjectorConfig(), rows)
    run.system.configure(FaultInjectorConfig(faults=[PermanentDrop()]), 1)
    assert len(run.advance_to(0.3).arrivals()) == 0
    with pytest.raises(StructureChangedError):
        run.system.configure(FaultInjectorConfig(period=0.02), 1)


def test_too_many_faults():
    with pytest.raises(ValueError, match="33 rows"):
        FaultInjector(FaultInjectorConfig(faults=[PermanentDrop()] * 33), layout=BAROMETER)


def test_outliers_are_so_many_so_far_off_in_every_direction():
    count, size = 600, 0.2
    rows = samples(MARKER, PERIOD, count)
    rows[:, MARKER.index("valid")] = 1.0
    bearing = slice(MARKER.index("bearing_C_x"), MARKER.index("bearing_C_x") + 3)
    rows[:, bearing] = 0.0, 0.0, 1.0
    out = passed(Outlier(probability=0.3, size=size), rows=rows, layout=MARKER)[:, bearing]
    shift = out[:, :2] / out[:, 2:]
    wrong = shift[np.any(shift != 0.0, axis=1)]
    assert stats.binomtest(len(wrong), count, 0.3).pvalue > 1e-3
    np.testing.assert_allclose(np.hypot(*wrong.T), size, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, rtol=1e-12)
    angle = np.arctan2(wrong[:, 1], wrong[:, 0])
    assert stats.kstest(angle, stats.uniform(-np.pi, 2.0 * np.pi).cdf).pvalue > 1e-3


def test_an_infrared_outlier_shifts_all_blobs_alike():
    rows = samples(INFRARED, PERIOD, 20)
    first = INFRARED.index("blob_0_x")
    rows[:, INFRARED.index("valid")], rows[:, INFRARED.index("count")] = 1.0, 2.0
    rows[:, first:] = 0.0
    rows[:, first + 3] = 0.1
    out = passed(Outlier(probability=1.0, size=0.05), rows=rows, layout=INFRARED)
    blobs = out[:, first : first + 6].reshape(-1, 2, 3)
    np.testing.assert_allclose(np.hypot(*blobs[:, 0, :2].T), 0.05, rtol=1e-12)
    np.testing.assert_allclose(blobs[:, 1, :2] - blobs[:, 0, :2], [[0.1, 0.0]] * 20, atol=1e-12)
    assert not out[:, first + 6 :].any()


def test_a_barometer_has_no_outliers_in_bearing():
    with pytest.raises(ValueError, match="outlier: a BarometerMeasurement has no bearing"):
        passed(Outlier(), layout=BAROMETER)

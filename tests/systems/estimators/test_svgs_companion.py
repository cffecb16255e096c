"""The companion computer behind the phone: deserialiser, transformations, filter."""

import numpy as np
import pytest
from pydrake.systems.framework import EventStatus
from scipy.spatial.transform import Rotation

from plants.svgs_beacons import SvgsBeaconsConfig
from systems.estimators import svgs_companion_filter as filtering
from systems.estimators import svgs_companion_transformations as transformations
from systems.estimators.svgs_companion import SvgsCompanion, SvgsCompanionConfig
from systems.estimators.svgs_companion_deserializer import (
    SvgsDeserializer,
    SvgsDeserializerConfig,
)
from systems.estimators.svgs_companion_filter import (
    COVARIANCE_FACTOR,
    COVARIANCE_FLOOR,
    MEMORY,
    SvgsFilter,
    SvgsFilterConfig,
)
from systems.estimators.svgs_companion_transformations import (
    SvgsTransformations,
    SvgsTransformationsConfig,
    pad_from_pose,
)
from systems.signals.measurement import (
    EXTERNAL_VISION,
    SVGS,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from systems.vision import svgs_selection as selection
from systems.vision.pinhole import camera_mount
from systems.vision.planar_pose import quaternion_from_matrix
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.estimators.target_cases import Sway, target_measurement

PERIOD = 0.02  # s
BLOCKS = [
    SvgsDeserializer(SvgsDeserializerConfig()),
    SvgsTransformations(SvgsTransformationsConfig()),
    SvgsFilter(SvgsFilterConfig()),
]


@pytest.mark.parametrize("system", BLOCKS, ids=lambda system: type(system).__name__)
def test_topology_and_schedule(system):
    assert_matches_docstring(system)
    assert periodic_update(system) == (PERIOD, 0.0)


def test_topology_of_the_companion():
    companion = SvgsCompanion(SvgsCompanionConfig())
    assert_matches_docstring(companion)
    companion.configure(SvgsCompanionConfig(filter=SvgsFilterConfig(gate=3.0)))
    assert companion.filter.config.gate == 3.0


def test_indices_are_those_of_the_layouts():
    t, f = transformations, filtering
    for layout, names, own in (
        (SVGS, ("beacon", "p_CT_x", "q_CT_w", "covariance_00"),
         [t._S_BEACON, t._S_P, t._S_Q, t._S_COVARIANCE]),
        (VEHICLE_ESTIMATE, ("time_of_validity", "q_WB_w"), [t._E_TIME, t._E_Q]),
        (TARGET_MEASUREMENT, ("p_BP_W_x", "covariance_xx", "source"),
         [t._T_P, t._T_COVARIANCE, t._T_SOURCE]),
    ):  # fmt: skip
        assert [layout.index(name) for name in names] == own
    names = ("seen", "last_fusion", "count", "rejected", "test_ratio", "p_WP_x", "p_WP_variance_x",
             "r_x", "r_rate_x", "r_covariance_x_pp", "relative_time", "reference_x", "referenced",
             "reset_counter", "next_vision", "horizontal_resets", "vertical_resets",
             "newest")  # fmt: skip
    assert [MEMORY.index(name) for name in names] == [
        f._SEEN, f._LAST, f._COUNT, f._REJECTED, f._RATIO, f._PAD, f._PAD_VARIANCE, f._R,
        f._R_RATE, f._R_COVARIANCE, f._R_TIME, f._REFERENCE, f._REFERENCED, f._RESET_COUNTER,
        f._NEXT, f._H_RESETS, f._V_RESETS, f._NEWEST,
    ]  # fmt: skip
    assert MEMORY.size == f._HISTORY
    names = ("time_of_validity", "horizontal_valid", "vertical_valid", "p_WB_x", "v_WB_x",
             "horizontal_reset_counter", "horizontal_reset_x", "vertical_reset_counter",
             "vertical_reset")  # fmt: skip
    assert [VEHICLE_ESTIMATE.index(name) for name in names] == [
        f._E_TIME, f._E_HORIZONTAL, f._E_VERTICAL, f._E_P, f._E_V, f._E_H_COUNTER, f._E_H_RESET,
        f._E_V_COUNTER, f._E_V_RESET,
    ]  # fmt: skip
    names = ("time_of_validity", "acquired", "time_of_last_fusion", "p_BP_W_x", "v_BP_W_x",
             "position_variance_x", "velocity_variance_x", "innovation_test_ratio",
             "rejected_count", "source")  # fmt: skip
    assert [TARGET_ESTIMATE.index(name) for name in names] == [
        f._T_TIME, f._T_ACQUIRED, f._T_FUSED, f._T_P, f._T_V, f._T_P_VARIANCE, f._T_V_VARIANCE,
        f._T_RATIO, f._T_REJECTED, f._T_SOURCE,
    ]  # fmt: skip
    names = ("p_WB_x", "position_variance_x", "v_WB_x", "yaw", "reset_counter", "quality")
    assert [EXTERNAL_VISION.index(name) for name in names] == [
        f._V_P, f._V_P_VARIANCE, f._V_V, f._V_YAW, f._V_RESET_COUNTER, f._V_QUALITY,
    ]  # fmt: skip
    assert (f._M_P, f._M_COVARIANCE) == (4, 7)


# -- deserialiser


def packet(arrival: float, error_code: int = selection.POSE) -> np.ndarray:
    view = SVGS(no_measurement(SVGS))
    view.time_of_validity, view.time_of_arrival = arrival - 0.2, arrival
    view.error_code = error_code
    view.valid = float(error_code == selection.POSE)
    view.q_CT_w = 1.0
    return np.asarray(view[:])


def test_error_packets_are_dropped_and_counted():
    system = SvgsDeserializer(SvgsDeserializerConfig())
    context = system.CreateDefaultContext()
    codes = [selection.POSE, selection.AMBIGUOUS, selection.BAD_GEOMETRY, selection.POSE]
    arrivals = []
    for k, code in enumerate(codes):
        system.get_input_port(0).FixValue(context, packet(1.0 + k, code))
        for _ in range(2):  # a packet counts once
            values = system.AllocateDiscreteVariables()
            values.SetFrom(context.get_discrete_state())
            status = system._update(context, values)
            context.SetDiscreteState(values)
        assert status.severity() == EventStatus.DidNothing().severity()
        arrivals.append(SVGS(system.get_output_port(0).Eval(context)).time_of_arrival)
    assert arrivals == [1.0, 1.0, 1.0, 4.0]
    counts = system.counts(context)
    assert counts[selection.ERRORS[selection.POSE]] == 2
    assert counts[selection.ERRORS[selection.AMBIGUOUS]] == 1


# -- transformations

PLACEMENTS = SvgsBeaconsConfig().placements()


def seen_pose(R_WB, p_WB, X_BC, beacon: int, heading: float = 0.0) -> np.ndarray:
    """What a perfect phone reports of a beacon on a pad in W's origin."""
    R_WB = Rotation.from_quat(np.roll(R_WB, -1)) if np.shape(R_WB) == (4,) else R_WB
    R_WC = R_WB.as_matrix() @ X_BC[:, :3]
    p_WC = p_WB + R_WB.apply(X_BC[:, 3])
    R_WP = Rotation.from_euler("z", heading)
    R_WT = R_WP * Rotation.from_euler("z", PLACEMENTS[beacon, 3])
    view = SVGS(packet(1.0))
    values = np.asarray(view[:])
    values[SVGS.index("beacon")] = beacon
    values[SVGS.slice("p_CT")] = R_WC.T @ (R_WP.apply(PLACEMENTS[beacon, :3]) - p_WC)
    values[SVGS.slice("q_CT")] = quaternion_from_matrix(R_WC.T @ R_WT.as_matrix())
    for i, variance in enumerate([1e-4, 1e-4, 1e-2, 1e-5, 1e-5, 1e-6]):
        values[SVGS.index(f"covariance_{i}{i}")] = variance
    return values


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("beacon", [0, 1, 2])
def test_lemma_1(beacon, fused):
    """Without errors the pad's place comes out exactly, wherever the camera hangs."""
    X_BC = camera_mount([0.1, -0.05, -0.2], yaw=0.4)
    attitude = Rotation.from_euler("ZYX", [0.9, 0.1, -0.15])
    q_WB = np.roll(attitude.as_quat(), 1)
    p_WB = np.array([3.0, -8.0, 42.0])
    out = np.empty(9)
    pose = seen_pose(attitude, p_WB, X_BC, beacon, heading=0.3)
    pad_from_pose(pose, q_WB, X_BC, PLACEMENTS, 0.01, fused, out)
    np.testing.assert_allclose(out[:3], -p_WB, atol=1e-9)
    covariance = out[[3, 4, 6, 4, 5, 7, 6, 7, 8]].reshape(3, 3)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_an_upright_beacon_corrects_the_autopilots_tilt():
    X_BC = camera_mount([0.0, 0.0, -0.05])
    p_WB = np.array([0.0, 0.0, 100.0])
    attitude = Rotation.from_euler("ZYX", [0.5, 0.0, 0.0])
    wrong = np.roll((Rotation.from_rotvec([0.0, 0.02, 0.0]) * attitude).as_quat(), 1)
    pose = seen_pose(attitude, p_WB, X_BC, 2)
    alone, together = np.empty(9), np.empty(9)
    pad_from_pose(pose, wrong, X_BC, PLACEMENTS, 0.02, False, alone)
    pad_from_pose(pose, wrong, X_BC, PLACEMENTS, 0.02, True, together)
    assert np.abs(alone[0]) == pytest.approx(2.0, rel=0.05)  # 0.02 rad from 100 m
    # The pose's tilt has 1e-5 rad2, the autopilot's 4e-4: one part in 41 is left.
    assert np.abs(together[0]) == pytest.approx(2.0 / 41.0, rel=0.2)
    assert together[3] < 0.1 * alone[3]


def test_attitude_of_the_poses_own_time():
    """A turning vehicle: the attitude of 0.2 s ago is used, not the present one."""
    system = SvgsTransformations(SvgsTransformationsConfig(attitude="vehicle"))
    context = system.CreateDefaultContext()
    X_BC = camera_mount([0.0, 0.0, -0.05])
    p_WB = np.array([1.0, 2.0, 30.0])
    rate = 0.5  # rad/s

    def attitude(t):
        return Rotation.from_euler("ZYX", [rate * t, 0.2 * t, 0.0])

    validity = 0.707
    for k in range(60):
        t = k * PERIOD
        estimate = VEHICLE_ESTIMATE.zeros()
        estimate[0] = t
        estimate[VEHICLE_ESTIMATE.slice("q_WB")] = np.roll(attitude(t).as_quat(), 1)
        pose = packet(0.9) if t >= 0.9 else no_measurement(SVGS)
        if t >= 0.9:
            pose = seen_pose(attitude(validity), p_WB, X_BC, 1)
            pose[:2] = validity, 0.9
        else:
            pose[SVGS.index("beacon")] = -1.0
        system.get_input_port(0).FixValue(context, pose)
        system.get_input_port(1).FixValue(context, estimate)
        values = system.AllocateDiscreteVariables()
        values.SetFrom(context.get_discrete_state())
        system._update(context, values)
        context.SetDiscreteState(values)
    view = TARGET_MEASUREMENT(system.get_output_port(0).Eval(context))
    np.testing.assert_allclose([view.p_BP_W_x, view.p_BP_W_y, view.p_BP_W_z], -p_WB, atol=1e-3)
    assert (view.time_of_validity, view.source) == (validity, transformations.SVGS_SOURCE)


# -- filter


class FilterRun:
    """The filter with sightings of a swaying vehicle, irregular and late."""

    def __init__(self, config=None, noise=0.05, duration=20.0, seen=lambda t: True, seed=0,
                 offset=lambda t: np.zeros(3), jump=None, valid=1.0,
                 outlier=lambda t: 0.0):  # fmt: skip
        config = config or SvgsFilterConfig()
        rng = np.random.default_rng(seed)
        sway = Sway(height=40.0, descent=0.5)
        system = SvgsFilter(config)
        context = system.CreateDefaultContext()
        memory = context.get_discrete_state(2).value().copy()
        target = context.get_discrete_state(0).value().copy()
        vision = context.get_discrete_state(1).value().copy()
        pending: list[tuple[float, np.ndarray]] = []
        next_frame, measurement = 0.0, no_measurement(TARGET_MEASUREMENT)
        self.targets, self.visions, self.true = [], [], []
        for k in range(round(duration / PERIOD)):
            t = k * PERIOD
            drift = offset(t)
            if t >= next_frame:
                next_frame = t + rng.uniform(1.0 / 15.0, 1.0 / 6.0)
                if seen(t):
                    value = -sway.position(t) + noise * rng.normal(size=3)
                    value[0] += outlier(t)
                    arrival = t + rng.uniform(0.175, 0.230)
                    pending.append((arrival, target_measurement(value, t, arrival, noise**2)))
            if pending and pending[0][0] <= t:
                measurement = pending.pop(0)[1]
                measurement[1] = t
            estimate = sway.estimate(t)
            estimate[1:4] = valid
            estimate[VEHICLE_ESTIMATE.slice("p_WB")] += drift
            if jump is not None and t >= jump:
                estimate[VEHICLE_ESTIMATE.index("horizontal_reset_counter")] = 1.0
                estimate[VEHICLE_ESTIMATE.slice("horizontal_reset")] = drift[:2]
            filtering.filter_step(
                t, measurement, estimate, config.parameters(), memory, target, vision
            )
            self.targets.append(target.copy())
            self.visions.append(vision.copy())
            self.true.append(sway.position(t))
        self.time = PERIOD * np.arange(len(self.targets))
        self.targets, self.visions = np.array(self.targets), np.array(self.visions)
        self.true, self.sway, self.memory = np.array(self.true), sway, memory
        p = TARGET_ESTIMATE.slice("p_BP_W")
        self.error = self.targets[:, p] + self.true
        self.acquired = self.targets[:, 1] > 0.0


def test_target_in_spite_of_latency():
    run = FilterRun()
    assert run.acquired[run.time > 1.5].all()
    late = run.error[run.time > 5.0]
    assert np.sqrt(np.mean(late**2, axis=0)).max() < 0.04  # m, from sightings of 0.05 m
    source = TARGET_ESTIMATE.index("source")
    assert run.targets[-1, source] == 2.0  # passed through


def test_vision_comes_evenly_and_is_where_the_vehicle_was():
    run = FilterRun()
    number = run.visions[:, 2]
    sent = np.flatnonzero(np.diff(number) > 0) + 1
    sent = sent[run.time[sent] > 3.0]
    rate = (len(sent) - 1) / (run.time[sent[-1]] - run.time[sent[0]])
    assert rate == pytest.approx(30.0, rel=0.02)
    rows = run.visions[sent]
    np.testing.assert_allclose(rows[:, 1] - rows[:, 0], SvgsFilterConfig().lag, atol=1e-9)
    was = np.array([run.sway.position(t) for t in rows[:, 0]])
    p = EXTERNAL_VISION.slice("p_WB")
    error = rows[:, p] - was
    assert error.std(axis=0).max() < 0.08
    assert np.abs(error.mean(axis=0)).max() < 0.08
    assert np.isnan(rows[:, EXTERNAL_VISION.slice("v_WB")]).all()
    assert np.isnan(rows[:, EXTERNAL_VISION.index("yaw")]).all()
    variances = rows[:, EXTERNAL_VISION.slice("position_variance")]
    # Equations 4 and 5: 1.6 times 0.0552 and 0.0405
    np.testing.assert_allclose(variances.min(axis=0)[:2], [0.08832, 0.0648])


def test_covariance_floor_is_that_of_the_paper():
    assert COVARIANCE_FACTOR == 1.6
    np.testing.assert_array_equal(COVARIANCE_FLOOR, COVARIANCE_FLOOR.T)
    np.testing.assert_array_equal(
        np.diag(COVARIANCE_FLOOR), [0.000027, 0.000016, 0.006, 0.0552, 0.0051, 0.0405]
    )


def test_sight_lost_and_regained():
    run = FilterRun(seen=lambda t: not 6.0 < t < 10.0)
    lost = (run.time > 7.5) & (run.time < 10.0)
    assert not run.acquired[lost].any()
    assert run.acquired[run.time > 11.5].all()
    assert np.abs(run.error[run.time > 11.5]).max() < 0.15
    gap = (run.time > 7.0) & (run.time < 10.1)
    assert len(set(run.visions[gap, 2])) == 1  # nothing is sent without sight


def test_outliers_are_rejected():
    # Every third frame, roughly, is wrong by 15 m.
    rng = np.random.default_rng(0)
    wrong = {round(t, 3) for t in PERIOD * np.flatnonzero(rng.uniform(size=1300) < 0.33)}
    run = FilterRun(outlier=lambda t: 15.0 if t > 3.0 and round(t, 3) in wrong else 0.0)
    assert run.acquired[run.time > 2.0].all()
    assert np.abs(run.error[run.time > 3.0]).max() < 0.2


def test_a_lasting_change_is_believed_in_the_end():
    run = FilterRun(outlier=lambda t: 5.0 if t > 8.0 else 0.0)
    assert np.abs(run.error[run.time > 12.0, 0] - 5.0).max() < 0.3


def test_resets_of_the_navigation_filter_are_followed():
    run = FilterRun(offset=lambda t: np.array([3.0, -2.0, 0.0]) * (t >= 8.0), jump=8.0)
    assert np.abs(run.error[run.time > 4.0]).max() < 0.2


@pytest.mark.parametrize("valid", [0.0, 1.0])
def test_reference_of_vision(valid):
    """In the local frame as it was at the lock; without one, where the pad was surveyed."""
    config = SvgsFilterConfig(pad_position=[10.0, 20.0, 0.0])
    offset = np.array([5.0, 5.0, 1.0])
    run = FilterRun(config, noise=0.001, offset=lambda t: offset, valid=valid)
    row = run.visions[-1]
    was = run.sway.position(row[0])
    expected = was + (offset if valid else config.pad_position)
    np.testing.assert_allclose(row[EXTERNAL_VISION.slice("p_WB")], expected, atol=0.1)

"""Which of several EKF2 instances is believed, and what a change does to those who follow it."""

import math

import numpy as np
import pytest

from systems.configuration import StructureChangedError
from systems.estimators import ekf2_selection as decision
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.messages import INNOVATIONS, STATUS
from systems.estimators.ekf2_selector import (
    SELECTOR_PERIOD,
    Ekf2Selector,
    Ekf2SelectorConfig,
    selection_layout,
)
from systems.signals.measurement import INERTIAL, SETPOINT, VEHICLE_ESTIMATE
from systems.supervisors.svgs_motion_control import SvgsMotionControl
from systems.supervisors.svgs_routine import COMMAND, HOLD, SvgsRoutineConfig
from tests.system_contract import assert_matches_docstring, periodic_update

SELECTION = selection_layout(3)


class Bench:
    """Instances with positions, test ratios, faults and sensors given by hand."""

    def __init__(self, instances: int = 3):
        self.system = Ekf2Selector(Ekf2SelectorConfig(instances=instances))
        self.context = self.system.CreateDefaultContext()
        self.instances = instances
        self.positions = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1], [-0.3, 0.4, -0.2]])
        self.velocities = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, 0.1]])
        self.yaws = [0.0, 0.1, -3.0]
        self.ratios = np.array([0.01, 0.01, 0.01])
        self.faults = [False, False, False]
        self.stopped = [False, False, False]
        self.specific_forces = np.tile([0.0, 0.0, 9.8], (3, 1))
        self.rates = np.zeros((3, 3))
        self.resets = [0, 0, 0]
        self.time = 0.0

    def run(self, seconds: float = SELECTOR_PERIOD) -> np.ndarray:
        for _ in range(round(seconds / SELECTOR_PERIOD)):
            for i in range(self.instances):
                if not self.stopped[i]:
                    self._publish(i)
            self.context.SetTime(self.time)
            values = self.system.AllocateDiscreteVariables()
            values.SetFrom(self.context.get_discrete_state())
            self.system._update(self.context, values)
            self.context.SetDiscreteState(values)
            self.time += SELECTOR_PERIOD
        return self.estimate

    def _publish(self, i: int) -> None:
        estimate = VEHICLE_ESTIMATE(VEHICLE_ESTIMATE.zeros())
        estimate.attitude_valid = 1.0
        estimate.q_WB_w, estimate.q_WB_z = math.cos(self.yaws[i] / 2), math.sin(self.yaws[i] / 2)
        estimate.p_WB_x, estimate.p_WB_y, estimate.p_WB_z = self.positions[i]
        estimate.v_WB_x, estimate.v_WB_y, estimate.v_WB_z = self.velocities[i]
        estimate.horizontal_reset_counter = self.resets[i]
        estimate.horizontal_reset_x = 9.0
        innovations, status = INNOVATIONS.zeros(), STATUS.zeros()
        for source in ("gnss_vel", "gnss_pos", "baro_hgt"):
            innovations[INNOVATIONS.index(f"{source}_time")] = self.time + 1.0
            innovations[INNOVATIONS.index(f"{source}_test_ratio_0")] = self.ratios[i]
            status[STATUS.index(source)] = 1.0
        status[STATUS.index("time_of_validity")] = self.time
        status[STATUS.index(at.FAULT_NAMES[0])] = float(self.faults[i])
        imu = INERTIAL(INERTIAL.zeros())
        imu.delta_angle_dt = imu.delta_velocity_dt = 0.01
        imu[INERTIAL.slice("delta_angle")] = 0.01 * self.rates[i]
        imu[INERTIAL.slice("delta_velocity")] = 0.01 * self.specific_forces[i]
        values = (np.asarray(estimate[:]), innovations, status, np.asarray(imu[:]))
        for port, value in enumerate(values):
            self.system.get_input_port(4 * i + port).FixValue(self.context, value)

    @property
    def estimate(self) -> np.ndarray:
        return self.system.GetOutputPort("estimate").Eval(self.context).copy()

    @property
    def instance(self) -> int:
        return int(self.system.GetOutputPort("instance").Eval(self.context)[0])

    def selection(self, field: str) -> float:
        layout = selection_layout(self.instances)
        return float(self.system.GetOutputPort("selection").Eval(self.context)[layout.index(field)])


def test_topology():
    selector = Ekf2Selector(Ekf2SelectorConfig())
    assert_matches_docstring(selector)
    assert periodic_update(selector) == (SELECTOR_PERIOD, 0.0)
    with pytest.raises(StructureChangedError):
        selector.configure(Ekf2SelectorConfig(instances=2))


def test_what_must_be_connected_is_an_error_unconnected():
    selector = Ekf2Selector(Ekf2SelectorConfig())
    with pytest.raises(RuntimeError, match="estimate_0"):
        selector.GetOutputPort("estimate").Eval(selector.CreateDefaultContext())


def test_initial_state():
    selector = Ekf2Selector(Ekf2SelectorConfig())
    context = selector.CreateDefaultContext()
    selection = selector.GetOutputPort("selection").Eval(context)
    assert selection[SELECTION.index("selected")] == 0.0
    assert selection[SELECTION.index("changes")] == 0.0
    assert selection[SELECTION.index("faulty_gyro")] == decision.NOBODY
    assert not any(selection[SELECTION.index(f"healthy_{i}")] for i in range(3))


def _combined(ratios: dict[str, float], in_use: tuple[str, ...]) -> float:
    row = decision.initial_memory(1)[decision.INSTANCES :]
    innovations, status = INNOVATIONS.zeros(), STATUS.zeros()
    for entry, ratio in ratios.items():
        innovations[INNOVATIONS.index(entry)] = ratio
        source = entry.split("_test")[0]
        innovations[INNOVATIONS.index(f"{source}_time")] = 1.0
    for flag in in_use:
        status[STATUS.index(flag)] = 1.0
    decision.filter_test_ratios(row, innovations)
    return float(decision.combined_test_ratio(row, status))


def test_combined_test_ratio():
    ratios = {
        "gnss_vel_test_ratio_1": 0.36,
        "gnss_pos_test_ratio_0": 0.04,
        "ev_pos_test_ratio_1": 0.16,
        "baro_hgt_test_ratio_0": 0.01,
    }
    vision = ("gnss_vel", "gnss_pos", "ev_pos", "baro_hgt")
    assert _combined(ratios, vision) == pytest.approx(0.5 * (0.6 + 0.4))
    # What is not in use does not count, and without any source the ratio is one.
    assert _combined(ratios, ("gnss_vel", "gnss_pos", "baro_hgt")) == pytest.approx(0.4)
    assert _combined(ratios, ("gnss_vel", "gnss_pos")) == pytest.approx(1.0)
    # Heights are averaged.
    ratios |= {"baro_hgt_test_ratio_0": 0.81, "gnss_hgt_test_ratio_0": 0.25}
    assert _combined(ratios, ("gnss_vel", "gnss_pos", "baro_hgt", "gps_hgt")) == pytest.approx(0.7)


def test_test_ratios_are_signed_and_low_passed():
    """Noise averages out and a bias stays: against the recursion written out."""
    row = decision.initial_memory(1)[decision.INSTANCES :]
    status = STATUS.zeros()
    status[STATUS.index("baro_hgt")] = 1.0
    rng = np.random.default_rng(1)
    nu = rng.normal(0.0, 1.0, 300)
    expected = 0.0
    for k, value in enumerate(nu):
        innovations = INNOVATIONS.zeros()
        innovations[INNOVATIONS.index("baro_hgt_time")] = 0.1 * (k + 1)
        innovations[INNOVATIONS.index("baro_hgt_innovation_0")] = value
        innovations[INNOVATIONS.index("baro_hgt_test_ratio_0")] = value**2 / 25.0
        decision.filter_test_ratios(row, innovations)
        decision.filter_test_ratios(row, innovations)  # seen twice, taken once
        new = math.copysign(value**2 / 25.0, value)
        expected = new if k == 0 else expected + 0.1 / (0.1 + 0.5) * (new - expected)
    combined = decision.combined_test_ratio(row, status)
    assert combined == 1.0  # neither position nor velocity
    filtered = row[decision.ROW - 3]  # the barometer's: range finder and vision come after it
    assert filtered == pytest.approx(expected, rel=1e-12)


def test_the_first_instance_is_believed_among_equals():
    bench = Bench()
    bench.run(32.0)
    assert bench.instance == 0
    assert bench.selection("healthy_0") == 1.0


def test_small_advantages_do_not_count():
    bench = Bench()
    bench.ratios[:] = 0.09, 0.02, 0.02  # combined 0.3 against 0.14
    bench.run(40.0)
    assert bench.instance == 0


def test_a_better_instance_takes_over_after_ten_seconds():
    bench = Bench()
    bench.ratios[:] = 0.64, 0.49, 0.01
    bench.run(9.9)
    assert bench.instance == 0
    bench.run(0.4)
    assert bench.instance == 2
    assert bench.selection("combined_test_ratio_0") == pytest.approx(0.8)


def test_changes_to_and_fro_take_their_time():
    """An instance that has just been left is not taken again for ten seconds."""
    bench = Bench()
    bench.run(11.0)
    bench.ratios[:] = 0.9, 0.9, 0.01
    bench.run(3.0)
    assert bench.instance == 2
    changed = bench.time
    bench.ratios[:] = 0.9, 0.01, 0.9
    bench.run(4.0)
    assert bench.instance == 2  # although instance 1 is better by far
    bench.run(10.0 - (bench.time - changed) + 1.0)
    assert bench.instance == 1


def test_an_instance_whose_observations_are_rejected_is_left_early():
    bench = Bench()
    bench.run(11.0)
    bench.ratios[:] = 0.5, 0.01, 0.3
    bench.run(4.0)
    assert bench.instance == 1
    bench.ratios[:] = 0.5, 3.0, 0.01
    bench.run(3.0)  # within the ten seconds, but a warning of more than one
    assert bench.instance == 2


def test_a_faulty_instance_is_left_at_once_and_recovers_slowly():
    bench = Bench()
    bench.run(2.0)
    bench.faults[0], bench.ratios[:] = True, (0.01, 0.6, 0.2)
    bench.run()
    assert bench.instance == 2
    bench.faults[:] = True, True, True
    bench.run(4.0)
    assert bench.instance == 2  # there is no better one
    bench.faults[:] = False, False, False
    bench.run(0.9)
    assert bench.selection("healthy_0") == 0.0
    bench.run(0.2)
    assert bench.selection("healthy_0") == 1.0


def test_an_instance_that_stops_is_left():
    bench = Bench()
    bench.run(2.0)
    bench.stopped[0] = True
    bench.run(0.12)
    assert bench.instance != 0


@pytest.mark.parametrize("sensor", ["accelerometer", "gyro"])
def test_a_sensor_that_disagrees_is_faulty(sensor):
    """Against the mean of three stand two thirds of an error; what is above the threshold adds."""
    bench, config = Bench(), Ekf2SelectorConfig()
    bench.run(2.0)
    if sensor == "accelerometer":
        bench.specific_forces[0, 0], error = 3.0, 3.0
        threshold, limit = config.accelerometer_threshold, config.accelerometer_limit
    else:
        bench.rates[0, 2], error = 0.4, 0.4
        threshold, limit = config.gyro_threshold, config.gyro_limit
    # the low-pass filter's lag, in which the difference is below the threshold, aside
    expected = limit / (error * 2.0 / 3.0 - threshold)
    start = bench.time
    while bench.instance == 0:
        bench.run()
        assert bench.time < start + 10.0
    assert bench.time - start == pytest.approx(expected, abs=0.25)
    assert bench.selection(f"faulty_{sensor}") == 0.0
    assert bench.selection("healthy_0") == 0.0
    bench.run(30.0)
    assert bench.selection("changes") == 1.0


def test_errors_below_the_threshold_are_forgotten():
    bench = Bench()
    bench.specific_forces[0, 0] = 1.4  # 0.93 from the mean
    bench.run(60.0)
    assert bench.instance == 0
    assert bench.selection("accelerometer_error_0") == 0.0


def test_two_sensors_disagree_and_nobody_knows_which():
    bench = Bench(2)
    bench.run(2.0)
    bench.specific_forces[0, 0] = 4.0
    bench.run(8.0)
    assert bench.selection("faulty_accelerometer") == decision.UNKNOWN
    assert bench.instance == 0


def test_a_change_is_a_reset():
    bench = Bench()
    bench.resets[:] = 3, 1, 1
    before = VEHICLE_ESTIMATE(bench.run(2.0))
    bench.faults[0] = True
    after = VEHICLE_ESTIMATE(bench.run())
    assert after.horizontal_reset_counter == before.horizontal_reset_counter + 1
    assert after.vertical_reset_counter == before.vertical_reset_counter + 1
    jump = np.array([after.horizontal_reset_x, after.horizontal_reset_y, after.vertical_reset])
    np.testing.assert_allclose(jump, bench.positions[bench.instance] - bench.positions[0])
    velocity = [bench.selection(f"velocity_jump_{axis}") for axis in "xyz"]
    np.testing.assert_allclose(velocity, bench.velocities[bench.instance])
    assert bench.selection("yaw_jump") == pytest.approx(bench.yaws[bench.instance])
    # A later reset of the instance itself counts on, with its own jump.
    bench.resets[bench.instance] += 1
    later = VEHICLE_ESTIMATE(bench.run())
    assert later.horizontal_reset_counter == after.horizontal_reset_counter + 1
    assert later.horizontal_reset_x == 9.0


def test_setpoints_move_with_the_change():
    """A vehicle that holds its place is not asked to move by a change of instance."""
    bench = Bench()
    motion = SvgsMotionControl(SvgsRoutineConfig())
    context = motion.CreateDefaultContext()
    command = COMMAND(COMMAND.zeros())
    command.manoeuvre, command.begun = HOLD, 1.0
    motion.get_input_port(0).FixValue(context, np.asarray(command[:]))
    errors = []
    bench.run(2.0)
    for event in range(6):
        bench.faults[0] = event >= 3
        estimate = bench.run()
        motion.get_input_port(1).FixValue(context, estimate)
        context.SetTime(1.0 + event)
        values = motion.AllocateDiscreteVariables()
        values.SetFrom(context.get_discrete_state())
        motion._update(context, values)
        context.SetDiscreteState(values)
        setpoint = motion.GetOutputPort("setpoint").Eval(context)
        p = setpoint[SETPOINT.slice("p_WB")]
        errors.append(p - estimate[VEHICLE_ESTIMATE.slice("p_WB")])
    assert bench.instance != 0
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)

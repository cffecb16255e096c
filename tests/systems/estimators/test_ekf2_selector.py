"""Which of several EKF2 instances is believed, and what a change does to those who follow it."""

import numpy as np
import pytest

from systems.configuration import StructureChangedError
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.messages import INNOVATIONS, STATUS
from systems.estimators.ekf2_selector import (
    SCORE_PERIOD,
    Ekf2Selector,
    Ekf2SelectorConfig,
    combined_test_ratio,
)
from systems.signals.measurement import SETPOINT, VEHICLE_ESTIMATE
from systems.supervisors.svgs_motion_control import SvgsMotionControl
from systems.supervisors.svgs_routine import COMMAND, HOLD, SvgsRoutineConfig
from tests.system_contract import assert_matches_docstring, periodic_update


class Bench:
    """Three instances with positions, test ratios and faults given by hand."""

    def __init__(self):
        self.system = Ekf2Selector(Ekf2SelectorConfig())
        self.context = self.system.CreateDefaultContext()
        self.positions = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1], [-0.3, 0.4, -0.2]])
        self.ratios = np.array([0.1, 0.1, 0.1])
        self.faults = [False, False, False]
        self.resets = [0, 0, 0]
        self.time = 0.0

    def run(self, events: int = 1) -> np.ndarray:
        for _ in range(events):
            for i in range(3):
                estimate = VEHICLE_ESTIMATE(VEHICLE_ESTIMATE.zeros())
                estimate.attitude_valid, estimate.q_WB_w = 1.0, 1.0
                estimate.p_WB_x, estimate.p_WB_y, estimate.p_WB_z = self.positions[i]
                estimate.horizontal_reset_counter = self.resets[i]
                estimate.horizontal_reset_x = 9.0
                innovations, status = INNOVATIONS.zeros(), STATUS.zeros()
                innovations[INNOVATIONS.index("baro_hgt_test_ratio_0")] = self.ratios[i]
                status[STATUS.index(at.FAULT_NAMES[0])] = float(self.faults[i])
                for port, value in enumerate((np.asarray(estimate[:]), innovations, status)):
                    self.system.get_input_port(3 * i + port).FixValue(self.context, value)
            self.context.SetTime(self.time)
            values = self.system.AllocateDiscreteVariables()
            values.SetFrom(self.context.get_discrete_state())
            self.system._update(self.context, values)
            self.context.SetDiscreteState(values)
            self.time += SCORE_PERIOD
        return self.estimate

    @property
    def estimate(self) -> np.ndarray:
        return self.system.GetOutputPort("estimate").Eval(self.context).copy()

    @property
    def instance(self) -> int:
        return int(self.system.GetOutputPort("instance").Eval(self.context)[0])


def test_topology():
    selector = Ekf2Selector(Ekf2SelectorConfig())
    assert_matches_docstring(selector)
    assert periodic_update(selector) == (SCORE_PERIOD, 0.0)
    with pytest.raises(StructureChangedError):
        selector.configure(Ekf2SelectorConfig(instances=2))


def test_combined_test_ratio():
    innovations = INNOVATIONS.zeros()
    innovations[INNOVATIONS.index("gnss_vel_test_ratio_1")] = 0.6
    innovations[INNOVATIONS.index("gnss_pos_test_ratio_0")] = 0.2
    assert combined_test_ratio(innovations) == pytest.approx(0.4)
    innovations[INNOVATIONS.index("baro_hgt_test_ratio_0")] = 0.7
    assert combined_test_ratio(innovations) == pytest.approx(0.7)


def test_the_first_instance_is_believed_among_equals():
    bench = Bench()
    bench.run(200)
    assert bench.instance == 0


def test_small_advantages_do_not_count():
    bench = Bench()
    bench.ratios[:] = 0.25, 0.1, 0.1
    bench.run(300)
    assert bench.instance == 0


def test_a_better_instance_takes_over_after_ten_seconds():
    bench = Bench()
    bench.ratios[:] = 0.8, 0.7, 0.1
    bench.run(round(9.0 / SCORE_PERIOD))
    assert bench.instance == 0
    bench.run(round(2.0 / SCORE_PERIOD))
    assert bench.instance == 2


def test_a_faulty_instance_is_left_at_once():
    bench = Bench()
    bench.run(3)
    bench.faults[0], bench.ratios[:] = True, (0.1, 0.6, 0.2)
    bench.run(1)
    assert bench.instance == 2
    bench.faults[:] = True, True, True
    bench.run(20)
    assert bench.instance == 2  # there is no better one


def test_a_change_is_a_reset():
    bench = Bench()
    bench.resets[:] = 3, 1, 1
    before = VEHICLE_ESTIMATE(bench.run(3))
    bench.faults[0] = True
    after = VEHICLE_ESTIMATE(bench.run(1))
    assert after.horizontal_reset_counter == before.horizontal_reset_counter + 1
    assert after.vertical_reset_counter == before.vertical_reset_counter + 1
    jump = np.array([after.horizontal_reset_x, after.horizontal_reset_y, after.vertical_reset])
    np.testing.assert_allclose(jump, bench.positions[bench.instance] - bench.positions[0])
    # A later reset of the instance itself counts on, with its own jump.
    bench.resets[bench.instance] += 1
    later = VEHICLE_ESTIMATE(bench.run(1))
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
    for event in range(6):
        bench.faults[0] = event >= 3
        estimate = bench.run(1)
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

"""Several EKF2 instances, each on an inertial sensor of its own, and one that is believed.

The decision is PX4's; its equations stand in `ekf2_selection`.
"""

import math
from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.configuration import NonNegative, Seconds, configuration, require_same_structure
from systems.estimators import ekf2_selection as decision
from systems.estimators.ekf2.messages import INNOVATIONS, STATUS
from systems.frames import yaw_of
from systems.schedule import SUPERVISOR_PERIOD
from systems.signals.measurement import INERTIAL, VEHICLE_ESTIMATE, Layout, vector
from systems.signals.optional_input import optional_input

SELECTOR_PERIOD = SUPERVISOR_PERIOD  # s; PX4 looks at every filter step
# of each instance, before its sensor
_PORTS = {"estimate": VEHICLE_ESTIMATE, "innovations": INNOVATIONS, "status": STATUS}
_DEGREE = math.pi / 180.0

_P = VEHICLE_ESTIMATE.slice("p_WB")
_V = VEHICLE_ESTIMATE.slice("v_WB")
_Q = VEHICLE_ESTIMATE.slice("q_WB")
_ATTITUDE_VALID = VEHICLE_ESTIMATE.index("attitude_valid")
_H_COUNTER = VEHICLE_ESTIMATE.index("horizontal_reset_counter")
_H_RESET = VEHICLE_ESTIMATE.slice("horizontal_reset")
_V_COUNTER = VEHICLE_ESTIMATE.index("vertical_reset_counter")
_V_RESET = VEHICLE_ESTIMATE.index("vertical_reset")
# State: the reset counters of the selected instance when it was chosen, what is to be added to
# them, how often it changed, what jumped at the last change, and the memory of the decision.
_H_THEN, _V_THEN, _H_ADD, _V_ADD, _CHANGES, _JUMP = 0, 1, 2, 3, 4, 5
_MEMORY = _JUMP + 7


def selection_layout(instances: int) -> Layout:
    """What `Ekf2Selector` says about its decision; PX4's `estimator_selector_status`."""
    each = (
        "combined_test_ratio",  # 1
        "relative_error",  # 1, against the selected instance
        "healthy",  # 0/1
        "gyro_error",  # rad, accumulated against the mean of all
        "accelerometer_error",  # m/s, accumulated against the mean of all
    )
    return Layout(
        "Ekf2Selection",
        (
            "selected",
            "changed",  # s, time of the last change
            "changes",
            *vector("position_jump"),  # m, W, at the last change: new minus old
            *vector("velocity_jump"),  # m/s, W
            "yaw_jump",  # rad
            "faulty_gyro",  # instance; -1 none, -2 one of two
            "faulty_accelerometer",
            *(f"{name}_{i}" for i in range(instances) for name in each),
        ),
    )


_OF_INSTANCE = [
    decision.COMBINED,
    decision.RELATIVE,
    decision.HEALTHY,
    decision.GYRO_ERROR,
    decision.ACCELEROMETER_ERROR,
]


@configuration
class Ekf2SelectorConfig:
    """When another instance is believed; PX4's parameters and their defaults."""

    instances: Annotated[int, Field(ge=2, le=4)] = (
        3  # SVGS paper, 4.1.1: the FMU-V6X has three IMUs
    )
    error_reduction: NonNegative = 0.2  # EKF2_SEL_ERR_RED
    change_interval: Seconds = 10.0  # s, between changes among healthy instances
    gyro_threshold: NonNegative = 7.0 * _DEGREE  # rad/s, EKF2_SEL_IMU_RAT
    gyro_limit: NonNegative = 15.0 * _DEGREE  # rad, EKF2_SEL_IMU_ANG
    accelerometer_threshold: NonNegative = 1.0  # m/s2, EKF2_SEL_IMU_ACC
    accelerometer_limit: NonNegative = 2.0  # m/s, EKF2_SEL_IMU_VEL

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Ekf2Selector":
        """Add a selector called `name` to `builder`."""
        return builder.AddNamedSystem(name, Ekf2Selector(self, seed))


class Ekf2Selector(LeafSystem):
    """Passes the estimate of one of several filters on, and says when the choice makes it jump.

    .. pydrake_system::
        name: Ekf2Selector
        input_ports:
        - estimate_0
        - innovations_0
        - status_0
        - imu_0 (optional)
        - estimate_1
        - innovations_1
        - status_1
        - imu_1 (optional)
        - estimate_2
        - innovations_2
        - status_2
        - imu_2 (optional)
        output_ports:
        - estimate
        - instance
        - selection

    | port | layout | meaning |
    |---|---|---|
    | `estimate_0` | `VEHICLE_ESTIMATE` | of the first instance; with more or fewer, accordingly |
    | `innovations_0` | `messages.INNOVATIONS` | its test ratios |
    | `status_0` | `messages.STATUS` | its sources and faults |
    | `imu_0` (optional) | `INERTIAL` | its sensor; unconnected: not compared with the others |
    | `estimate_1` | `VEHICLE_ESTIMATE` | of the second |
    | `innovations_1` | `messages.INNOVATIONS` | |
    | `status_1` | `messages.STATUS` | |
    | `imu_1` (optional) | `INERTIAL` | |
    | `estimate_2` | `VEHICLE_ESTIMATE` | of the third |
    | `innovations_2` | `messages.INNOVATIONS` | |
    | `status_2` | `messages.STATUS` | |
    | `imu_2` (optional) | `INERTIAL` | |
    | `estimate` | `VEHICLE_ESTIMATE` | of the selected instance |
    | `instance` | (2,) | its number, and the time (s) of the last change |
    | `selection` | `selection_layout` | ratios, errors and health of all, the last jump |

    An instance is healthy if its attitude is valid, its sensor agrees with the others, it goes on
    and it has reported no fault for a second. An unhealthy one is left at once, for the healthy
    one with the least combined test ratio. A healthy one is left for another whose relative error
    has come below -0.5, which was not selected in the last 10 s, if the last change was 10 s ago
    or the selected one's ratio has been above 1 for a second.

    A change of instance is a reset: the counters of `estimate` go up by one and its resets are the
    jump p_new − p_old, so that whoever follows resets moves its setpoints along and the vehicle
    does not ("if the reference changes, local position values reflect the change": SVGS paper,
    section 4.1.1). What velocity and yaw jump by stands in `selection`.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | errors, and the choice |
    """

    def __init__(self, config: Ekf2SelectorConfig, seed: int = 0):
        """A selector; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.config = config
        n = config.instances
        self._read: dict[str, list[Callable]] = {name: [] for name in (*_PORTS, "imu")}
        for i in range(n):
            for name, layout in _PORTS.items():
                self._read[name].append(
                    self.DeclareVectorInputPort(f"{name}_{i}", layout.size).Eval
                )
            imu = self.DeclareVectorInputPort(f"imu_{i}", INERTIAL.size)
            self._read["imu"].append(optional_input(imu, np.full(INERTIAL.size, math.nan)))
        initial = np.concatenate([np.zeros(_MEMORY), decision.initial_memory(n)])
        initial[_H_THEN] = initial[_V_THEN] = -1.0
        self.DeclareDiscreteState(BasicVector(initial))
        self.DeclareVectorOutputPort(
            "estimate",
            BasicVector(VEHICLE_ESTIMATE.size),
            self._calc_estimate,
            {self.xd_ticket(), self.all_input_ports_ticket()},
        )
        self.DeclareVectorOutputPort(
            "instance", BasicVector(2), self._calc_instance, {self.xd_ticket()}
        )
        self.DeclareVectorOutputPort(
            "selection",
            BasicVector(selection_layout(n).size),
            self._calc_selection,
            {self.xd_ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(SELECTOR_PERIOD, 0.0, self._update)

    def configure(self, config: Ekf2SelectorConfig, seed: int = 0) -> None:
        """Take over a new configuration; the number of instances must stay."""
        require_same_structure(self.config, config, "instances")
        self.config = config

    def _inputs(self, context: Context, name: str) -> np.ndarray:
        """Those of all instances, a row each."""
        return np.stack([read(context) for read in self._read[name]])

    def _calc_estimate(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state(0).value()
        output.SetFromVector(self._selected_estimate(context, state))

    def _calc_instance(self, context: Context, output: BasicVector) -> None:
        memory = context.get_discrete_state(0).value()[_MEMORY:]
        output.SetFromVector(memory[[decision.SELECTED, decision.CHANGED]])

    def _calc_selection(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state(0).value()
        memory = state[_MEMORY:]
        rows = memory[decision.INSTANCES :].reshape(self.config.instances, decision.ROW)
        chosen = memory[[decision.SELECTED, decision.CHANGED]]
        faults = memory[[decision.GYRO_FAULT, decision.ACCELEROMETER_FAULT]]
        output.SetFromVector(
            np.concatenate([chosen, state[_CHANGES:_MEMORY], faults, rows[:, _OF_INSTANCE].ravel()])
        )

    def _selected_estimate(self, context: Context, state: np.ndarray) -> np.ndarray:
        """The selected instance's estimate, its reset counters carried over changes."""
        estimate = self._read["estimate"][int(state[_MEMORY + decision.SELECTED])](context).copy()
        if estimate[_H_COUNTER] == state[_H_THEN]:  # no reset of its own since the change
            estimate[_H_RESET] = state[_JUMP : _JUMP + 2]
        if estimate[_V_COUNTER] == state[_V_THEN]:
            estimate[_V_RESET] = state[_JUMP + 2]
        estimate[_H_COUNTER] += state[_H_ADD]
        estimate[_V_COUNTER] += state[_V_ADD]
        return estimate

    def _limits(self) -> np.ndarray:
        c = self.config
        return np.array(
            [
                c.error_reduction,
                c.change_interval,
                c.gyro_threshold,
                c.gyro_limit,
                c.accelerometer_threshold,
                c.accelerometer_limit,
            ]
        )

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        state = discrete_state.get_mutable_value(0)
        estimates = self._inputs(context, "estimate")
        before = int(state[_MEMORY + decision.SELECTED])
        old = self._selected_estimate(context, state)
        after = decision.choose(
            state[_MEMORY:],
            context.get_time(),
            SELECTOR_PERIOD,
            self._inputs(context, "innovations"),
            self._inputs(context, "status"),
            estimates[:, _ATTITUDE_VALID] > 0.0,
            self._inputs(context, "imu"),
            self._limits(),
        )
        if after != before:
            self._hand_over(state, old, estimates[after])
        return EventStatus.Succeeded()

    def _hand_over(self, state: np.ndarray, old: np.ndarray, new: np.ndarray) -> None:
        """Remember what jumps, and go on counting where the old instance's counters stand."""
        state[_JUMP : _JUMP + 3] = new[_P] - old[_P]
        state[_JUMP + 3 : _JUMP + 6] = new[_V] - old[_V]
        state[_JUMP + 6] = math.remainder(yaw_of(new[_Q]) - yaw_of(old[_Q]), math.tau)
        state[_H_ADD] = old[_H_COUNTER] + 1.0 - new[_H_COUNTER]
        state[_V_ADD] = old[_V_COUNTER] + 1.0 - new[_V_COUNTER]
        state[_H_THEN], state[_V_THEN] = new[_H_COUNTER], new[_V_COUNTER]
        state[_CHANGES] += 1.0

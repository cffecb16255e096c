"""Several EKF2 instances, each on an inertial sensor of its own, and one that is believed.

Facts: PX4's `EKF2Selector`. The combined test ratio of an instance is

    max(½ (velocity + position), height)

of the newest observations' test ratios. Every instance's error is integrated against that of the
selected one, within ±1, counting an advantage only beyond EKF2_SEL_ERR_RED:

    e_i ← clip(e_i + Δ_i, −1, 1)   where Δ_i > 0 or Δ_i < −error_reduction

An instance with e_i ≤ −½ takes over if the last change is 10 s ago; an unhealthy selected one is
replaced at once by the healthy one with the least error.
"""

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
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.messages import INNOVATIONS, STATUS
from systems.signals.measurement import VEHICLE_ESTIMATE

SCORE_PERIOD = 0.16  # s, between two looks at the test ratios; PX4: with the primary's status
_SCORE_LIMIT = 1.0
_SCORE_TO_SWITCH = 0.5


def _ratios(kind: str) -> list[int]:
    """The entries of INNOVATIONS with the test ratios of one kind of observation."""
    return [
        INNOVATIONS.index(f"{source}_test_ratio_{axis}")
        for source, axes in zip(at.AID_NAMES, at.AID_AXES, strict=True)
        if source.endswith(kind) and not source.startswith("fake")
        for axis in range(axes)
    ]


_VELOCITY, _POSITION, _HEIGHT = (_ratios(kind) for kind in ("vel", "pos", "hgt"))
_FAULTS = [STATUS.index(name) for name in at.FAULT_NAMES]
_P = VEHICLE_ESTIMATE.slice("p_WB")
_ATTITUDE_VALID = VEHICLE_ESTIMATE.index("attitude_valid")
_H_COUNTER = VEHICLE_ESTIMATE.index("horizontal_reset_counter")
_H_RESET = VEHICLE_ESTIMATE.slice("horizontal_reset")
_V_COUNTER = VEHICLE_ESTIMATE.index("vertical_reset_counter")
_V_RESET = VEHICLE_ESTIMATE.index("vertical_reset")
# State: which instance, when it was chosen (s), its reset counters then, what is to be added to
# them, the jump of the position at the change (m), then the errors.
_SELECTED, _CHANGED, _H_THEN, _V_THEN, _H_ADD, _V_ADD, _JUMP = 0, 1, 2, 3, 4, 5, 6
_ERRORS = 9


@configuration
class Ekf2SelectorConfig:
    """When another instance is believed."""

    instances: Annotated[int, Field(ge=2, le=4)] = (
        3  # SVGS paper, 4.1.1: the FMU-V6X has three IMUs
    )
    error_reduction: NonNegative = 0.2  # EKF2_SEL_ERR_RED
    change_interval: Seconds = 10.0  # s, between changes among healthy instances

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Ekf2Selector":
        """Add a selector called `name` to `builder`."""
        return builder.AddNamedSystem(name, Ekf2Selector(self, seed))


def combined_test_ratio(innovations: np.ndarray) -> float:
    """The error of an instance from its `messages.INNOVATIONS`."""
    velocity, position, height = (
        float(np.nanmax(innovations[entries])) for entries in (_VELOCITY, _POSITION, _HEIGHT)
    )
    return max(0.5 * (velocity + position), height)


class Ekf2Selector(LeafSystem):
    """Passes the estimate of one of several filters on, and says when the choice makes it jump.

    .. pydrake_system::
        name: Ekf2Selector
        input_ports:
        - estimate_0
        - innovations_0
        - status_0
        - estimate_1
        - innovations_1
        - status_1
        - estimate_2
        - innovations_2
        - status_2
        output_ports:
        - estimate
        - instance

    | port | layout | meaning |
    |---|---|---|
    | `estimate_0` | `VEHICLE_ESTIMATE` | of the first instance; with more or fewer, accordingly |
    | `innovations_0` | `messages.INNOVATIONS` | its test ratios |
    | `status_0` | `messages.STATUS` | its faults |
    | `estimate_1` | `VEHICLE_ESTIMATE` | of the second |
    | `innovations_1` | `messages.INNOVATIONS` | |
    | `status_1` | `messages.STATUS` | |
    | `estimate_2` | `VEHICLE_ESTIMATE` | of the third |
    | `innovations_2` | `messages.INNOVATIONS` | |
    | `status_2` | `messages.STATUS` | |
    | `estimate` | `VEHICLE_ESTIMATE` | of the selected instance |
    | `instance` | (2,) | its number, and the time (s) of the last change |

    An instance is healthy if its attitude is valid and it reports no fault. A change of instance
    is a reset: the counters of `estimate` go up by one and its resets are the jump p_new − p_old,
    so that whoever follows resets moves its setpoints along and the vehicle does not ("if the
    reference changes, local position values reflect the change": SVGS paper, section 4.1.1).

    | event | when | does |
    |---|---|---|
    | update | every 160 ms from 0 | errors, and the choice |
    """

    def __init__(self, config: Ekf2SelectorConfig, seed: int = 0):
        """A selector; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.config = config
        for i in range(config.instances):
            self.DeclareVectorInputPort(f"estimate_{i}", VEHICLE_ESTIMATE.size)
            self.DeclareVectorInputPort(f"innovations_{i}", INNOVATIONS.size)
            self.DeclareVectorInputPort(f"status_{i}", STATUS.size)
        initial = np.zeros(_ERRORS + config.instances)
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
        self.DeclarePeriodicDiscreteUpdateEvent(SCORE_PERIOD, 0.0, self._update)

    def configure(self, config: Ekf2SelectorConfig, seed: int = 0) -> None:
        """Take over a new configuration; the number of instances must stay."""
        require_same_structure(self.config, config, "instances")
        self.config = config

    def _estimate(self, context: Context, instance: int) -> np.ndarray:
        return self.get_input_port(3 * instance).Eval(context)

    def _calc_estimate(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state(0).value()
        output.SetFromVector(self._selected_estimate(context, state))

    def _calc_instance(self, context: Context, output: BasicVector) -> None:
        state = context.get_discrete_state(0).value()
        output.SetFromVector(state[[_SELECTED, _CHANGED]])

    def _selected_estimate(self, context: Context, state: np.ndarray) -> np.ndarray:
        """The selected instance's estimate, its reset counters carried over changes."""
        estimate = self._estimate(context, int(state[_SELECTED])).copy()
        if estimate[_H_COUNTER] == state[_H_THEN]:  # no reset of its own since the change
            estimate[_H_RESET] = state[_JUMP : _JUMP + 2]
        if estimate[_V_COUNTER] == state[_V_THEN]:
            estimate[_V_RESET] = state[_JUMP + 2]
        estimate[_H_COUNTER] += state[_H_ADD]
        estimate[_V_COUNTER] += state[_V_ADD]
        return estimate

    def _is_healthy(self, context: Context, instance: int) -> bool:
        status = self.get_input_port(3 * instance + 2).Eval(context)
        valid = self._estimate(context, instance)[_ATTITUDE_VALID] > 0.0
        return bool(valid and not np.any(status[_FAULTS]))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        state = discrete_state.get_mutable_value(0)
        now = context.get_time()
        selected = int(state[_SELECTED])
        instances = range(self.config.instances)
        ratios = [
            combined_test_ratio(self.get_input_port(3 * i + 1).Eval(context)) for i in instances
        ]
        errors = state[_ERRORS:]
        for i in instances:
            advantage = ratios[i] - ratios[selected]
            if i != selected and (advantage > 0.0 or advantage < -self.config.error_reduction):
                errors[i] = np.clip(errors[i] + advantage, -_SCORE_LIMIT, _SCORE_LIMIT)
        others = [i for i in instances if i != selected and self._is_healthy(context, i)]
        if not others:
            return EventStatus.Succeeded()
        best = min(others, key=lambda i: errors[i])
        better = errors[best] <= -_SCORE_TO_SWITCH
        long_ago = now - state[_CHANGED] >= self.config.change_interval
        if not self._is_healthy(context, selected) or (better and long_ago):
            self._change(context, state, best, now)
        return EventStatus.Succeeded()

    def _change(self, context: Context, state: np.ndarray, instance: int, now: float) -> None:
        before = self._selected_estimate(context, state)
        after = self._estimate(context, instance)
        state[_JUMP : _JUMP + 3] = after[_P] - before[_P]
        state[_H_ADD] = before[_H_COUNTER] + 1.0 - after[_H_COUNTER]
        state[_V_ADD] = before[_V_COUNTER] + 1.0 - after[_V_COUNTER]
        state[_H_THEN], state[_V_THEN] = after[_H_COUNTER], after[_V_COUNTER]
        state[_SELECTED], state[_CHANGED] = instance, now
        state[_ERRORS:] = 0.0

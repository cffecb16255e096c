"""PX4's two landing-target estimators behind the fused sensor front end."""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import Metres, NonNegative, Positive, Seconds, configuration
from systems.estimators import px4_target_kernel as kernel
from systems.estimators.fused_sensor import (
    POLL_PERIOD,
    FusedSensorConfig,
    build_target_estimator,
    no_target,
)
from systems.estimators.px4_target_kernel import (
    MEMORY,
    PARAMETERS,
    VISION_MEMORY,
    VISION_PARAMETERS,
)
from systems.signals.measurement import TARGET_MEASUREMENT, VEHICLE_ESTIMATE


@configuration
class PX4TargetConfig:
    """PX4's `landing_target_estimator`; defaults are PX4's."""

    kind: Literal["px4"] = "px4"
    front_end: FusedSensorConfig = Field(default_factory=FusedSensorConfig)
    acceleration_variance: Positive = 10.0  # (m/s2)2, LTEST_ACC_UNC
    measurement_variance: Positive = 0.005  # 1, LTEST_MEAS_UNC, R = this · height²
    initial_position_variance: Positive = 0.1  # m2, LTEST_POS_UNC_IN
    initial_velocity_variance: Positive = 0.1  # (m/s)2, LTEST_VEL_UNC_IN
    gate: Positive = 3.84  # on the NIS of each axis, 5 % false alarms
    lost_time: Seconds = 2.0  # s without fusion

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "PX4Target":
        """Add an estimator called `name` to `builder`."""
        estimator = PX4Target(self, seed)
        builder.AddNamedSystem(name, estimator)
        return estimator


class PX4Target(Diagram):
    """The fused sensor front end, then PX4's `landing_target_estimator`.

    .. pydrake_system::
        name: PX4Target
        input_ports:
        - infrared (optional)
        - marker (optional)
        - range_finder (optional)
        - estimate
        output_ports:
        - target
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `infrared` (optional) | `INFRARED` | as in `FusedSensor` |
    | `marker` (optional) | `MARKER` | as in `FusedSensor` |
    | `range_finder` (optional) | `RANGE_FINDER` | as in `FusedSensor` |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle as its navigation filter knows it |
    | `target` | `TARGET_ESTIMATE` | the landing target |
    | `measurement` | `TARGET_MEASUREMENT` | what the front end gave the filter |
    """

    def __init__(self, config: PX4TargetConfig, seed: int = 0):
        """An estimator; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self._filter = PX4TargetFilter(config, seed)
        self._front_end = build_target_estimator(self, config.front_end, self._filter, seed)

    def configure(self, config: PX4TargetConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self._filter.configure(config, seed)
        self._front_end.configure(config.front_end, seed)


class PX4TargetFilter(LeafSystem):
    """Two independent filters of relative position and velocity, east and north.

    .. pydrake_system::
        name: PX4TargetFilter
        input_ports:
        - measurement
        - estimate
        output_ports:
        - target

    | port | layout | meaning |
    |---|---|---|
    | `measurement` | `TARGET_MEASUREMENT` | the front end's value; taken once per time of arrival |
    | `estimate` | `VEHICLE_ESTIMATE` | acceleration and velocity |
    | `target` | `TARGET_ESTIMATE` | the target now; not acquired: the last values |

    State r, v of each axis, with a = −a_WB and T = 20 ms:

        r ← r + v T + ½ a T²    P ← F P Fᵀ + G Gᵀ acceleration_variance
        v ← v + a T             F = (1 T; 0 1), G = (½T², T)
        R = measurement_variance h²,   h = −p_BP_W.z

    An axis fuses a measurement if its NIS is within `gate`; both must, for the measurement to
    count. The first one initialises; the target is acquired with the next, and lost `lost_time`
    after the last. Nothing accounts for the measurement's age. Vertically the newest
    measurement is carried with the vehicle's velocity.

    Facts: PX4's `landing_target_estimator`, main branch of August 2026.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | predict, take a new measurement |
    """

    def __init__(self, config: PX4TargetConfig, seed: int = 0):
        """A filter; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        memory = MEMORY.zeros()
        memory[MEMORY.index("last_arrival")] = -1.0
        self._measurement, self._estimate = _declare(self, memory, self._update)

    def configure(self, config: PX4TargetConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        parameters = PARAMETERS(PARAMETERS.zeros())
        parameters.acceleration_variance = config.acceleration_variance
        parameters.measurement_variance = config.measurement_variance
        parameters.initial_position_variance = config.initial_position_variance
        parameters.initial_velocity_variance = config.initial_velocity_variance
        parameters.gate = config.gate
        parameters.lost_time = config.lost_time
        parameters.period = POLL_PERIOD
        self._parameters = parameters[:]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        kernel.step(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            context.get_time(),
            self._measurement(context),
            self._estimate(context),
            self._parameters,
        )


@configuration
class PX4VisionTargetConfig:
    """PX4's `vision_target_estimator`; defaults are PX4's."""

    kind: Literal["px4_vision"] = "px4_vision"
    front_end: FusedSensorConfig = Field(default_factory=FusedSensorConfig)
    acceleration_density: Positive = 0.02  # m2/s3, VTE_ACC_D_UNC
    bias_density: NonNegative = 0.001  # m2/s, VTE_BIAS_UNC
    initial_position_variance: Positive = 0.5  # m2, VTE_POS_UNC_IN
    initial_velocity_variance: Positive = 0.5  # (m/s)2, VTE_VEL_UNC_IN
    initial_bias_variance: Positive = 1.0  # m2, VTE_BIA_UNC_IN
    position_noise: Metres = 0.1  # m, VTE_EVP_NOISE, least standard deviation of a measurement
    gate: Positive = 3.84  # VTE_POS_NIS_THRE
    lost_time: Seconds = 2.0  # s without fusion, VTE_TGT_TOUT
    stop_time: Seconds = 3.0  # s without fusion before starting anew, VTE_BTOUT

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "PX4VisionTarget":
        """Add an estimator called `name` to `builder`."""
        estimator = PX4VisionTarget(self, seed)
        builder.AddNamedSystem(name, estimator)
        return estimator


class PX4VisionTarget(Diagram):
    """The fused sensor front end, then PX4's `vision_target_estimator`.

    .. pydrake_system::
        name: PX4VisionTarget
        input_ports:
        - infrared (optional)
        - marker (optional)
        - range_finder (optional)
        - estimate
        output_ports:
        - target
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `infrared` (optional) | `INFRARED` | as in `FusedSensor` |
    | `marker` (optional) | `MARKER` | as in `FusedSensor` |
    | `range_finder` (optional) | `RANGE_FINDER` | as in `FusedSensor` |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle as its navigation filter knows it |
    | `target` | `TARGET_ESTIMATE` | the landing target |
    | `measurement` | `TARGET_MEASUREMENT` | what the front end gave the filter |
    """

    def __init__(self, config: PX4VisionTargetConfig, seed: int = 0):
        """An estimator; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self._filter = PX4VisionTargetFilter(config, seed)
        self._front_end = build_target_estimator(self, config.front_end, self._filter, seed)

    def configure(self, config: PX4VisionTargetConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self._filter.configure(config, seed)
        self._front_end.configure(config.front_end, seed)


class PX4VisionTargetFilter(LeafSystem):
    """Three filters of relative position, vehicle velocity and bias, with late measurements.

    .. pydrake_system::
        name: PX4VisionTargetFilter
        input_ports:
        - measurement
        - estimate
        output_ports:
        - target

    | port | layout | meaning |
    |---|---|---|
    | `measurement` | `TARGET_MEASUREMENT` | the front end's value; taken once per time of arrival |
    | `estimate` | `VEHICLE_ESTIMATE` | acceleration; velocity at the start |
    | `target` | `TARGET_ESTIMATE` | the target now; not acquired: the last values |

    State r, v, b of each axis with r' = −v, v' = a_WB + white noise, b' = white noise. The position
    z = r is fused at its time of validity: the newest of 32 snapshots (0.5 s) before it is
    predicted to that time and corrected by the gain k; every later snapshot and the present
    are corrected by Φ k, Φ being the transition to them, as if nothing had been fused between.
    NIS above `gate` rejects an axis; all three must fuse for the measurement to count.

    PX4 may also fuse a GNSS receiver's velocity (z = v) and the place of the pad by GNSS or from
    the mission (z = r + b); here vision is alone, v is known from it and from the vehicle's
    velocity at the start, and b stays 0. Fused at the present, ahead of later but older
    positions, velocities would make the projected correction unstable.

    Facts: PX4's `vision_target_estimator`, main branch of August 2026, which runs at 50 Hz
    with 25 snapshots.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | predict, take a new measurement, keep a snapshot |
    """

    def __init__(self, config: PX4VisionTargetConfig, seed: int = 0):
        """A filter; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        memory = VISION_MEMORY.zeros()
        memory[VISION_MEMORY.index("last_arrival")] = -1.0
        self._measurement, self._estimate = _declare(self, memory, self._update)

    def configure(self, config: PX4VisionTargetConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        parameters = VISION_PARAMETERS(VISION_PARAMETERS.zeros())
        parameters.acceleration_density = config.acceleration_density
        parameters.bias_density = config.bias_density
        parameters.initial_position_variance = config.initial_position_variance
        parameters.initial_velocity_variance = config.initial_velocity_variance
        parameters.initial_bias_variance = config.initial_bias_variance
        parameters.minimum_position_variance = config.position_noise**2
        parameters.gate = config.gate
        parameters.lost_time = config.lost_time
        parameters.stop_time = config.stop_time
        parameters.period = POLL_PERIOD
        self._parameters = parameters[:]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        kernel.vision_step(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            context.get_time(),
            self._measurement(context),
            self._estimate(context),
            self._parameters,
        )


def _declare(
    system: PX4TargetFilter | PX4VisionTargetFilter, memory: np.ndarray, update: Callable[..., Any]
) -> tuple[Callable[[Context], np.ndarray], Callable[[Context], np.ndarray]]:
    """Declare the ports, state and event that both filters have; returns how to read the inputs."""
    measurement = system.DeclareVectorInputPort("measurement", TARGET_MEASUREMENT.size)
    estimate = system.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size)
    target = system.DeclareDiscreteState(BasicVector(no_target()))
    system.DeclareDiscreteState(BasicVector(memory))
    system.DeclareStateOutputPort("target", target)
    system.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, update)
    return measurement.Eval, estimate.Eval

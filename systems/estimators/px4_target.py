"""PX4's two landing-target estimators behind the fused sensor front end."""

from typing import Literal

from pydantic import Field
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Metres, NonNegative, Positive, Seconds, configuration
from systems.estimators import px4_target_kernel as kernel
from systems.estimators.fused_sensor import POLL_PERIOD, FusedSensorConfig
from systems.estimators.px4_target_kernel import (
    MEMORY,
    PARAMETERS,
    VISION_MEMORY,
    VISION_PARAMETERS,
)
from systems.estimators.target_estimator import TargetEstimator, TargetFilter


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

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> TargetEstimator:
        """Add an estimator called `name` to `builder`."""
        estimator = TargetEstimator(PX4TargetFilter(self, seed), self, seed)
        return builder.AddNamedSystem(name, estimator)


class PX4TargetFilter(TargetFilter):
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

    memory = MEMORY
    step = staticmethod(kernel.step)

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

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> TargetEstimator:
        """Add an estimator called `name` to `builder`."""
        estimator = TargetEstimator(PX4VisionTargetFilter(self, seed), self, seed)
        return builder.AddNamedSystem(name, estimator)


class PX4VisionTargetFilter(TargetFilter):
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
    z = r is fused at its time of validity: the newest of 32 snapshots (0.64 s) before it is
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

    memory = VISION_MEMORY
    step = staticmethod(kernel.vision_step)

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

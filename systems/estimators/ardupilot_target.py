"""ArduPilot's landing-target estimator behind the fused sensor front end."""

from typing import Annotated, Literal

from pydantic import Field
from pydrake.systems.framework import DiagramBuilder

from systems.configuration import Positive, Seconds, configuration
from systems.estimators import ardupilot_target_kernel as kernel
from systems.estimators.ardupilot_target_kernel import MEMORY, PARAMETERS
from systems.estimators.fused_sensor import POLL_PERIOD, FusedSensorConfig
from systems.estimators.target_estimator import TargetEstimator, TargetFilter


@configuration
class ArduPilotTargetConfig:
    """ArduPilot's `AC_PrecLand` estimator; defaults are ArduPilot's."""

    kind: Literal["ardupilot"] = "ardupilot"
    front_end: FusedSensorConfig = Field(default_factory=FusedSensorConfig)
    estimator: Literal["raw_sensor", "kalman"] = "kalman"  # PLND_EST_TYPE 0, 1
    acceleration_noise: Positive = 2.5  # m/s2, PLND_ACC_P_NSE
    # s, PLND_LAG, length of the inertial buffer; at least one frame of 20 ms
    lag: Annotated[float, Field(ge=0.02, le=0.25)] = 0.02
    gate: Positive = 3.0  # on the larger NIS of both axes
    rejections: int = Field(default=3, ge=0)  # in a row; the next measurement is fused anyway
    acquisition_time: Seconds = 2.0  # s of updates before the target is acquired
    acquisition_interval: Seconds = 0.5  # s at most between them
    lost_time: Seconds = 2.0  # s without fusion
    moving_target: bool = False  # PLND_OPTIONS bit 0, report the pad's velocity

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> TargetEstimator:
        """Add an estimator called `name` to `builder`."""
        estimator = TargetEstimator(ArduPilotTargetFilter(self, seed), self, seed)
        return builder.AddNamedSystem(name, estimator)


class ArduPilotTargetFilter(TargetFilter):
    """Two filters of relative position and velocity, east and north, as in `AC_PrecLand`.

    .. pydrake_system::
        name: ArduPilotTargetFilter
        input_ports:
        - measurement
        - estimate
        output_ports:
        - target

    | port | layout | meaning |
    |---|---|---|
    | `measurement` | `TARGET_MEASUREMENT` | the front end's value; taken once per time of arrival |
    | `estimate` | `VEHICLE_ESTIMATE` | acceleration, velocity and angular velocity |
    | `target` | `TARGET_ESTIMATE` | the target now; not acquired: the last values |

    State r, v of each axis at a delayed horizon, the oldest of n = max(round(lag/T), 1) inertial
    frames, whatever the measurement's own time; T = 20 ms, Δv = a_WB T:

        r ← r + v T          P ← F P Fᵀ + diag(0, (acceleration_noise T)²)
        v ← v − Δv(oldest)   F = (1 T; 0 1)
        R = (h (0.01 + 0.01 |ω|) + 0.02 m)²,   h = −p_BP_W.z

    A measurement is fused if the larger NIS of both axes is below `gate`, or after `rejections`
    rejections in a row. The first one initialises r with R, and v with the vehicle's
    velocity and (2 m/s)². The target is acquired after `acquisition_time` of updates, and lost
    `lost_time` after the last fusion. The output is predicted to now with the frames after
    the oldest. `raw_sensor` takes measurements as they are and carries them with the velocity.

    Vertically the newest measurement is carried with the vehicle's velocity. Facts: ArduPilot's
    `AC_PrecLand`, which runs at up to 400 Hz.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | predict, take a new measurement, predict to now |
    """

    memory = MEMORY
    step = staticmethod(kernel.step)

    def configure(self, config: ArduPilotTargetConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        parameters = PARAMETERS(PARAMETERS.zeros())
        parameters.kalman = config.estimator == "kalman"
        parameters.acceleration_noise = config.acceleration_noise
        parameters.buffer_length = max(round(config.lag / POLL_PERIOD), 1)
        parameters.gate = config.gate
        parameters.rejections = config.rejections
        parameters.acquisition_time = config.acquisition_time
        parameters.acquisition_interval = config.acquisition_interval
        parameters.lost_time = config.lost_time
        parameters.moving_target = config.moving_target
        parameters.period = POLL_PERIOD
        self._parameters = parameters[:]

"""The front end of precision landing: infrared camera and marker camera as one sensor."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Probability,
    Seconds,
    Vector3,
    configuration,
)
from systems.estimators import fused_sensor_kernel as kernel
from systems.estimators.fused_sensor_kernel import MEMORY, PARAMETERS
from systems.signals.measurement import (
    INFRARED,
    MARKER,
    RANGE_FINDER,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from systems.signals.optional_input import optional_input
from systems.vision.pinhole import camera_mount

POLL_PERIOD = 0.02  # s, of the front end and of the filters behind it

_SOURCES = {
    "infrared": kernel.INFRARED_SOURCE,
    "marker": kernel.MARKER_SOURCE,
    "fused": kernel.INFRARED_SOURCE | kernel.MARKER_SOURCE,
}
_NO_INFRARED = no_measurement(INFRARED)
_NO_MARKER = no_measurement(MARKER)
_NO_RANGE = no_measurement(RANGE_FINDER)
_MAXIMUM_LAG = (kernel.ATTITUDES - 1) * POLL_PERIOD


@configuration
class FusedSensorConfig:
    """Which sensors are listened to, and how their values are combined."""

    mode: Literal["infrared", "marker", "fused"] = "fused"
    infrared_weight: Probability = 0.5  # of two simultaneous values; the marker has the rest
    freshness: Seconds = 1.0  # s, a stored value is valid so long; thesis section 5.2
    # s, age of the attitude that levels a value: ArduPilot takes the oldest of its inertial
    # buffer, PLND_LAG long, whatever the value's own time
    attitude_lag: Annotated[float, Field(ge=0.0, le=_MAXIMUM_LAG)] = 0.02
    infrared_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    infrared_yaw: Finite = 0.0  # rad, turn of the camera about z_B
    marker_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    marker_yaw: Finite = 0.0  # rad
    range_finder_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m, p_BR
    range_timeout: Seconds = 0.5  # s, after which a range measurement is too old
    infrared_angle_noise: NonNegative = 1.5e-3  # rad, half a pixel of 3 mrad, one sigma
    height_noise: Metres = 0.05  # m, one sigma; TFmini Plus up to 6 m

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "FusedSensor":
        """Add a front end called `name` to `builder`."""
        return builder.AddNamedSystem(name, FusedSensor(self, seed))


class FusedSensor(LeafSystem):
    """The fused sensor front end of the infrared and marker thesis (Badakis 2020, chapter 5).

    .. pydrake_system::
        name: FusedSensor
        input_ports:
        - infrared (optional)
        - marker (optional)
        - range_finder (optional)
        - estimate
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `infrared` (optional) | `INFRARED` | the largest blob is the beacon; unconnected: no values |
    | `marker` (optional) | `MARKER` | the detected marker; unconnected: no values |
    | `range_finder` (optional) | `RANGE_FINDER` | height for infrared alone; unconnected, invalid \
or old: the estimate's height above ground, and without one infrared alone gives no value |
    | `estimate` | `VEHICLE_ESTIMATE` | attitude and height above ground |
    | `measurement` | `TARGET_MEASUREMENT` | the stored value; `valid` while it is fresh |

    At each poll a sensor may have a new valid value (one with a new time of arrival). The four
    cases of section 5.2:

    | new values | the front end returns |
    |---|---|
    | both | horizontally a p_infrared + (1 − a) p_marker, vertically the marker's |
    | infrared alone | p_infrared, vertically from the range finder |
    | marker alone | p_marker |
    | none | the stored value, valid for `freshness` after it was stored |

    Values are levelled with one attitude of a fixed age, as in ArduPilot. The time of
    validity of a pair is the weighted mean of theirs; the covariance follows the weights.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | one poll |
    """

    def __init__(self, config: FusedSensorConfig, seed: int = 0):
        """A front end; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        self._infrared = optional_input(
            self.DeclareVectorInputPort("infrared", INFRARED.size), _NO_INFRARED
        )
        self._marker = optional_input(
            self.DeclareVectorInputPort("marker", MARKER.size), _NO_MARKER
        )
        self._range_finder = optional_input(
            self.DeclareVectorInputPort("range_finder", RANGE_FINDER.size), _NO_RANGE
        )
        self._estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size).Eval
        memory = MEMORY(MEMORY.zeros())
        memory.infrared_arrival = memory.marker_arrival = -1.0
        output = self.DeclareDiscreteState(BasicVector(no_measurement(TARGET_MEASUREMENT)))
        self.DeclareDiscreteState(BasicVector(memory[:]))
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, self._update)

    def configure(self, config: FusedSensorConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        parameters = PARAMETERS(PARAMETERS.zeros())
        parameters.sources = _SOURCES[config.mode]
        parameters.infrared_weight = config.infrared_weight
        parameters.freshness = config.freshness
        parameters.attitude_steps = round(config.attitude_lag / POLL_PERIOD)
        parameters.infrared_angle_noise = config.infrared_angle_noise
        parameters.height_noise = config.height_noise
        parameters.range_timeout = config.range_timeout
        self._parameters = parameters[:]
        self._parameters[PARAMETERS.slice("range_finder")] = config.range_finder_position
        self._X_BI = camera_mount(config.infrared_position, config.infrared_yaw)
        self._X_BM = camera_mount(config.marker_position, config.marker_yaw)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        kernel.poll(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            context.get_time(),
            self._infrared(context),
            self._marker(context),
            self._range_finder(context),
            self._estimate(context),
            self._parameters,
            self._X_BI,
            self._X_BM,
        )


def no_target() -> np.ndarray:
    """A `TARGET_ESTIMATE` before the first measurement, shape (TARGET_ESTIMATE.size,)."""
    target: Any = TARGET_ESTIMATE(TARGET_ESTIMATE.zeros())
    target.time_of_last_fusion = -1.0
    return np.asarray(target[:])

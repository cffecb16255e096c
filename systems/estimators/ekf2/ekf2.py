"""PX4's EKF2 as a block of the laboratory."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, field_validator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import (
    Positive,
    StructureChangedError,
    Vector2,
    Vector3,
    configuration,
    require_same_structure,
)
from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import messages, parameters
from systems.estimators.ekf2.world_model import earth_field
from systems.schedule import CLOCK_PERIOD, PLANT_PERIOD, SUPERVISOR_PERIOD
from systems.signals.measurement import (
    BAROMETER,
    EXTERNAL_VISION,
    GNSS,
    INERTIAL,
    MAGNETOMETER,
    RANGE_FINDER,
    VEHICLE_ESTIMATE,
    VEHICLE_STATUS,
)

_OBSERVATION_DELAYS = tuple(
    f"EKF2_{sensor}_DELAY" for sensor in ("GPS", "BARO", "MAG", "RNG", "EV")
)
_CONNECTED = slice(at.CONNECTED, at.CONNECTED + 6)
_VISION = at.CONNECTED + 4


@configuration
class Ekf2Config:
    """PX4's EKF2: its parameters, and what it is told besides."""

    defaults: Literal["module", "unit-test"] = "module"  # PX4's sets, see `parameters`
    parameter_file: str = ""  # a QGroundControl .params file on top of the defaults; empty: none
    parameters: dict[str, float] = Field(default_factory=dict)  # PX4's names, on top of the file
    # Which time an observation is stamped with: "arrival", from which the filter takes PX4's
    # EKF2_…_DELAY off (EKF2_GPS_DELAY 110 ms in "module"), or its true "validity" (delays unused).
    timestamps: Literal["arrival", "validity"] = "arrival"
    # deg, deg, m above sea level: W's origin
    origin: Vector3 = Field(default_factory=lambda: [39.3648, 22.9470, 30.0])
    # deg, deg (down), gauss: declination, inclination and strength of the earth's field as the
    # filter's world magnetic model has it; null: PX4's model at the origin
    earth_field: Vector3 | None = None
    period: Positive = PLANT_PERIOD  # s, of the IMU; a log that is replayed may have another
    range_limits: Vector2 = Field(default_factory=lambda: [0.1, 12.0])  # m, of the range finder

    @field_validator("parameters")
    @classmethod
    def _known(cls, values: dict[str, float]) -> dict[str, float]:
        parameters.checked(values)
        return values

    def parameter_array(self) -> np.ndarray:
        """The parameters as the kernels read them, shape (parameters.SIZE,).

        Raises
        ------
        parameters.ParameterError
            If the parameter file cannot be used, or the values do not fit together.
        """
        values: dict[str, parameters.Value] = {}
        if self.parameter_file:
            values |= parameters.read_parameter_file(Path(self.parameter_file))
        values |= self.parameters
        if self.timestamps == "validity":
            values |= dict.fromkeys(_OBSERVATION_DELAYS, 0.0)
        field = self.earth_field or earth_field(*self.origin[:2])
        shortest, longest = self.range_limits
        declination, inclination, strength = field
        return parameters.parameter_array(
            values, self.defaults, (shortest, longest), (declination, inclination, strength)
        )

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Ekf2":
        """Add an `Ekf2` called `name` to `builder`."""
        return builder.AddNamedSystem(name, Ekf2(self, seed))


class Ekf2(LeafSystem):
    """PX4's navigation filter (main branch of August 2026).

    .. pydrake_system::
        name: Ekf2
        input_ports:
        - imu
        - gnss (optional)
        - barometer (optional)
        - magnetometer (optional)
        - range_finder (optional)
        - external_vision (optional)
        - vehicle_status (optional)
        output_ports:
        - estimate
        - delayed_state
        - innovations
        - status

    | port | layout | meaning |
    |---|---|---|
    | `imu` | `INERTIAL` | every sample is integrated |
    | `gnss` (optional) | `GNSS` | unconnected: no GNSS |
    | `barometer` (optional) | `BAROMETER` | unconnected: no barometer |
    | `magnetometer` (optional) | `MAGNETOMETER` | unconnected: the heading waits for GNSS |
    | `range_finder` (optional) | `RANGE_FINDER` | unconnected: the ground is where it took off |
    | `external_vision` (optional) | `EXTERNAL_VISION` | pose in W; unconnected: no vision |
    | `vehicle_status` (optional) | `VEHICLE_STATUS` | unconnected: in the air |
    | `estimate` | `VEHICLE_ESTIMATE` | the state now, from the output predictor, in W and B |
    | `delayed_state` | `DELAYED_STATE` | state and variances at the delayed horizon, NED, FRD |
    | `innovations` | `INNOVATIONS` | newest innovation of every source |
    | `status` | `STATUS` | PX4's control and fault flags, biases, reset counters |

    The last three layouts stand in `messages`.

    An extended Kalman filter over 24 errors (attitude, velocity, position, biases of
    gyro and accelerometer, earth and body magnetic field, wind, terrain) runs behind
    real time, at the delayed horizon, where every observation is fused at its own
    time; an output predictor carries its state to now. The equations stand in the
    modules of this package: prediction in `prediction`, fusion in `fusion`, the sources
    in `gnss`, `height`, `magnetometer`, `range_finder`, `external_vision` and `unaided`,
    the horizon in `buffers` and `output_predictor`. Optical flow, airspeed, sideslip,
    drag, ranging beacons and dual-antenna headings are not built.

    Before it flies it must stand still: tilt alignment takes a fraction of a second
    at rest, GNSS must pass its checks for EKF2_REQ_GPS_H = 10 s. In `estimate`,
    `attitude_valid` means that tilt and heading are aligned. As long as there is no GNSS
    position, `p_WB` is relative to where the filter started or, with external vision,
    to W's origin; a jump of `p_WB` shows in the reset counters.

    | event | when | does |
    |---|---|---|
    | initialize | at the start | the empty filter of the last `configure` |
    | update | every `period` (10 ms by default) from 0 | moves the output predictor, may step |

    The output predictor moves with every IMU sample; a filter step follows when the samples
    make up EKF2_PREDICT_US. The other messages are looked at on the tick after the one that
    sensors have their events on, every 40 ms, and every 20 ms if external vision is connected.

    The discrete state has two groups: the filter's flat array (see `layout`) and `estimate`.
    """

    def __init__(self, config: Ekf2Config, seed: int = 0):
        super().__init__()
        sizes = (GNSS, BAROMETER, MAGNETOMETER, RANGE_FINDER, EXTERNAL_VISION)
        names = ("gnss", "barometer", "magnetometer", "range_finder", "external_vision")
        self._imu = self.DeclareVectorInputPort("imu", INERTIAL.size).Eval
        self._ports = [
            self.DeclareVectorInputPort(name, layout.size)
            for name, layout in zip(names, sizes, strict=True)
        ]
        self._ports.append(self.DeclareVectorInputPort("vehicle_status", VEHICLE_STATUS.size))
        self._optional = [port.Eval for port in self._ports]
        self._absent = np.empty(0)
        self._nothing = [self._absent] * len(self._ports)

        self._configure(config)
        self._filter = self.DeclareDiscreteState(self._initial)
        estimate = VEHICLE_ESTIMATE.zeros()
        estimate[VEHICLE_ESTIMATE.index("q_WB_w")] = 1.0
        estimate[VEHICLE_ESTIMATE.index("time_of_validity")] = -1.0
        self.DeclareStateOutputPort("estimate", self.DeclareDiscreteState(estimate))
        # seldom looked at, so made of the filter's state on demand
        for name, layout, write in (
            ("delayed_state", messages.DELAYED_STATE, messages.write_delayed_state),
            ("innovations", messages.INNOVATIONS, messages.write_innovations),
            ("status", messages.STATUS, messages.write_status),
        ):
            self.DeclareVectorOutputPort(
                name,
                layout.size,
                partial(self._calc, write),
                prerequisites_of_calc={self.discrete_state_ticket(self._filter)},
            )
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self._declare_update()

    def configure(self, config: Ekf2Config, seed: int = 0) -> None:
        """Take over another configuration for the next run.

        Raises
        ------
        StructureChangedError
            If EKF2_DELAY_MAX or EKF2_PREDICT_US ask for rings of another length.
        """
        require_same_structure(self._config, config, "period")
        size = self._initial.size
        previous = self._config
        self._configure(config)
        if self._initial.size != size:
            self._configure(previous)
            raise StructureChangedError(
                "EKF2_DELAY_MAX and EKF2_PREDICT_US are built into the diagram: build a new diagram"
            )

    def _configure(self, config: Ekf2Config) -> None:
        self._config = config
        self._rate = 1.0 / config.period
        # The laboratory's sensors have their events on this grid; what they measure is there a
        # tick later. Those of a log have times of their own.
        # Only external vision comes more often than every SUPERVISOR_PERIOD.
        self._poll = self._seldom = 1
        if config.period == PLANT_PERIOD:
            self._poll = round(CLOCK_PERIOD / PLANT_PERIOD)
            self._seldom = round(SUPERVISOR_PERIOD / PLANT_PERIOD)
        self._parameters = config.parameter_array()
        self._initial = kernels.initialise(self._parameters)
        latitude, longitude, altitude = config.origin
        self._origin = np.array([np.radians(latitude), np.radians(longitude), altitude])
        self._by_validity = config.timestamps == "validity"

    def _declare_update(self) -> None:
        self.DeclarePeriodicDiscreteUpdateEvent(self._config.period, 0.0, self._update)

    def _initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        # Drake fixes the default state when a system is built (it never asks Python for it), so
        # what `configure` made of it is put in here, unless the filter has already begun.
        x = discrete_state.get_mutable_value(0)
        if x[at.INITIALISED] == 0.0:
            x[:] = self._initial
            x[_CONNECTED] = [port.HasValue(context) for port in self._ports]

    def _calc(
        self, write: Callable[[np.ndarray, np.ndarray], None], context: Context, out: BasicVector
    ) -> None:
        write(context.get_discrete_state(self._filter).value(), out.get_mutable_value())

    def _input(self, context: Context, index: int) -> np.ndarray:
        """The message in a port, of size 0 if nothing is connected."""
        value: BasicVector | None = self.EvalVectorInput(context, index)
        return self._absent if value is None else value.get_value()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        x = discrete_state.get_mutable_value(0)
        estimate = discrete_state.get_mutable_value(1)
        parameters, absent = self._parameters, self._absent
        messages_in = self._nothing
        tick = round(context.get_time() * self._rate)
        every = self._poll if x.item(_VISION) else self._seldom
        if tick % every == min(1, every - 1):
            connected = x[_CONNECTED].tolist()
            messages_in = [
                evaluate(context) if is_connected else absent
                for evaluate, is_connected in zip(self._optional, connected, strict=True)
            ]
        imu = self._imu(context)
        if messages.receive(x, parameters, self._by_validity, imu, *messages_in):
            kernels.update(x, parameters)
        messages.write_step(x, parameters, self._origin, estimate)

"""The inertial measurement unit: increments of angle and velocity, 100 times a second."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from systems.configuration import NonNegative, Positive, configuration
from systems.schedule import PLANT_PERIOD
from systems.signals.measurement import BODY_STATE, INERTIAL, no_measurement
from systems.signals.noise import standard_normals, stream_key

_STANDARD_GRAVITY = 9.80665  # m/s2
_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class ImuModel:
    """The errors of one kind of IMU; standard deviations are one sigma an axis.

    An autopilot calibrates its IMU: offsets and scale factors that remain are what
    the temperature changes since then. So "bias" and "scale error" are the data
    sheet's temperature coefficients times 10 K. Cross-axis sensitivity is not
    calibrated and taken from the data sheet as it stands.
    """

    gyro_noise: float  # rad/s/sqrt(Hz), density of the white noise
    gyro_bias: float  # rad/s, constant in a run
    gyro_bias_walk: float  # rad/s/sqrt(s), random walk of the bias
    gyro_scale_error: float  # 1
    gyro_range: float  # rad/s
    accelerometer_noise: float  # m/s2/sqrt(Hz)
    accelerometer_bias: float  # m/s2
    accelerometer_bias_walk: float  # m/s2/sqrt(s)
    accelerometer_scale_error: float  # 1
    accelerometer_range: float  # m/s2
    misalignment: float  # rad, of each axis towards each other one


_CALIBRATION_OFFSET = 10.0  # K, assumed between calibration and flight
# Bias walks: Allan deviation of a MEMS IMU of the same class (BMI160), Schubert et al., "The TUM VI
# Benchmark for Evaluating Visual-Inertial Odometry", IROS 2018, section on IMU noise.
_GYRO_BIAS_WALK = 2.2e-6
_ACCELEROMETER_BIAS_WALK = 8.6e-5
# Temperature coefficients of sensitivity: BMI055 data sheet, 0.03 %/K (gyro), 0.02 %/K
# (accelerometer); the ICM sheets give changes over their whole range of the same size.
_GYRO_SCALE_ERROR = 3e-4 * _CALIBRATION_OFFSET
_ACCELEROMETER_SCALE_ERROR = 2e-4 * _CALIBRATION_OFFSET
_CROSS_AXIS = 0.01  # 1 %, all three data sheets


def _mems(
    gyro_noise: float,  # deg/s/sqrt(Hz)
    gyro_drift: float,  # deg/s/K
    accelerometer_noise: float,  # ug/sqrt(Hz)
    accelerometer_drift: float,  # mg/K
) -> ImuModel:
    return ImuModel(
        gyro_noise=gyro_noise * _DEGREE,
        gyro_bias=gyro_drift * _DEGREE * _CALIBRATION_OFFSET,
        gyro_bias_walk=_GYRO_BIAS_WALK,
        gyro_scale_error=_GYRO_SCALE_ERROR,
        gyro_range=2000.0 * _DEGREE,
        accelerometer_noise=accelerometer_noise * 1e-6 * _STANDARD_GRAVITY,
        accelerometer_bias=accelerometer_drift * 1e-3 * _STANDARD_GRAVITY * _CALIBRATION_OFFSET,
        accelerometer_bias_walk=_ACCELEROMETER_BIAS_WALK,
        accelerometer_scale_error=_ACCELEROMETER_SCALE_ERROR,
        accelerometer_range=16.0 * _STANDARD_GRAVITY,
        misalignment=_CROSS_AXIS,
    )


IMU_MODELS = {
    # Without errors and without limits.
    "ideal": ImuModel(0.0, 0.0, 0.0, 0.0, math.inf, 0.0, 0.0, 0.0, 0.0, math.inf, 0.0),
    # Bosch Sensortec, data sheet BST-BMI055-DS000-08 (2014), tables 1 and 2.
    "bmi055": _mems(0.014, 0.015, 150.0, 1.0),
    # TDK InvenSense, data sheet DS-000176 rev. 1.0 (2016), tables 1 and 2; z axis.
    "icm_20602": _mems(0.004, 0.01, 100.0, 1.0),
    # TDK InvenSense, data sheet DS-000143 rev. 1.1, tables 1 and 2; z axis.
    "icm_20689": _mems(0.006, 0.05, 150.0, 1.0),
}


@configuration
class ImuConfig:
    """Which IMU; None takes the model's figure."""

    model: Literal["ideal", "bmi055", "icm_20602", "icm_20689"] = "icm_20602"
    gyro_noise: NonNegative | None = None  # rad/s/sqrt(Hz)
    gyro_bias: NonNegative | None = None  # rad/s, one sigma
    gyro_bias_walk: NonNegative | None = None  # rad/s/sqrt(s)
    gyro_scale_error: NonNegative | None = None  # 1, one sigma
    gyro_range: Positive | None = None  # rad/s
    gyro_vibration: NonNegative = 0.0  # rad/s rms, what vibration leaves in the mean over a sample
    accelerometer_noise: NonNegative | None = None  # m/s2/sqrt(Hz)
    accelerometer_bias: NonNegative | None = None  # m/s2, one sigma
    accelerometer_bias_walk: NonNegative | None = None  # m/s2/sqrt(s)
    accelerometer_scale_error: NonNegative | None = None  # 1, one sigma
    accelerometer_range: Positive | None = None  # m/s2
    accelerometer_vibration: NonNegative = 0.0  # m/s2 rms, as for the gyro
    misalignment: NonNegative | None = None  # rad, one sigma

    def errors(self) -> ImuModel:
        """The model's errors with what this configuration puts in their place."""
        model = IMU_MODELS[self.model]
        fields = model.__dataclass_fields__
        overrides = {field: getattr(self, field) for field in fields}
        return ImuModel(
            **{
                field: getattr(model, field) if value is None else value
                for field, value in overrides.items()
            }
        )

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "Imu":
        """Add an `Imu`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, Imu(self, seed, stream=name))


_W = BODY_STATE.slice("w_WB_B").start
_F = BODY_STATE.slice("f_B").start
_DELTA_ANGLE = INERTIAL.slice("delta_angle").start
_DELTA_VELOCITY = INERTIAL.slice("delta_velocity").start
_DELTA_ANGLE_DT = INERTIAL.index("delta_angle_dt")
_DELTA_VELOCITY_DT = INERTIAL.index("delta_velocity_dt")
_CLIPPING = INERTIAL.index("clipping")
_DT = PLANT_PERIOD

# The memory: rate at the last sample (NaN before the first), then the walks of the two biases.
_LAST_RATE, _GYRO_WALK, _ACCELEROMETER_WALK = 0, 3, 6
# The parameter vector, for the gyro and again for the accelerometer.
_NOISE, _WALK, _RANGE, _BIAS, _MATRIX, _STRIDE = 0, 1, 2, 3, 6, 15


@njit(cache=True)
def sample_imu(index, time, body, key, parameters, output, memory):
    """Write one inertial measurement.

    Parameters
    ----------
    index : int
        Of the sample.
    time : float
        s, now.
    body : array of shape (17,)
        `BODY_STATE`.
    key : np.uint64
        Of the sensor's stream of noise.
    parameters : array of shape (30,)
        For the gyro, then for the accelerometer: noise of a sample, step of the bias walk,
        range, bias (3), scale and misalignment (3x3, row by row).
    output : array of shape (13,)
        `INERTIAL`, changed in place.
    memory : array of shape (9,)
        Changed in place.
    """
    noise = standard_normals(key, index, 12)
    clipping = 0.0
    for axis in range(3):
        if math.isnan(memory[_LAST_RATE + axis]):
            memory[_LAST_RATE + axis] = body[_W + axis]
    for sensor in range(2):
        p = parameters[_STRIDE * sensor : _STRIDE * (sensor + 1)]
        walk = memory[_GYRO_WALK + 3 * sensor : _GYRO_WALK + 3 * (sensor + 1)]
        first = _DELTA_VELOCITY if sensor else _DELTA_ANGLE
        for i in range(3):
            value = p[_BIAS + i] + walk[i] + p[_NOISE] * noise[6 * sensor + i]
            for j in range(3):
                true = body[_F + j] if sensor else 0.5 * (memory[_LAST_RATE + j] + body[_W + j])
                value += p[_MATRIX + 3 * i + j] * true
            if abs(value) >= p[_RANGE]:
                value = math.copysign(p[_RANGE], value)
                if sensor:
                    clipping = 1.0
            output[first + i] = value * _DT
            walk[i] += p[_WALK] * noise[6 * sensor + 3 + i]
    memory[_LAST_RATE : _LAST_RATE + 3] = body[_W : _W + 3]
    output[0] = output[1] = time
    output[2] = index
    output[3] = 1.0
    output[_DELTA_ANGLE_DT] = output[_DELTA_VELOCITY_DT] = _DT
    output[_CLIPPING] = clipping


class Imu(LeafSystem):
    """A strap-down IMU at the body's origin, aligned with B up to its misalignment.

    .. pydrake_system::

        name: Imu
        input_ports:
        - body
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the true state of the body |
    | `measurement` | `INERTIAL` | increments over the last 10 ms |

    With ω̄ the mean of the angular rate at the last sample and now, f̄ the mean
    specific force over the plant's last step (which is the sample's interval), Δ =
    10 ms and n standard normal,

        Δθ = sat((I + S_g) ω̄ + b_g + σ_g n) Δ       σ² = density²/Δ + vibration²
        Δv = sat((I + S_a) f̄ + b_a + σ_a n) Δ
        b⁺ = b + walk √Δ n                         b(0) drawn for the run

    S holds scale errors on its diagonal and misalignments beside it, drawn for the
    run. Coning is neglected: at 100 deg/s it is at most |Δθ|²/12 = 2e-5 rad a
    sample. Vibration enters as white noise: what the sensor's integration leaves
    of it is aliased.

    | event | when | does |
    |---|---|---|
    | update | every 10 ms from 0 | samples the body as it was just before |

    Parameters
    ----------
    config : ImuConfig
    seed : int
    stream : str
        The name of the random stream; sensors that share it under one seed err alike.
    """

    def __init__(self, config: ImuConfig, seed: int = 0, *, stream: str = "imu"):
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        initial = np.zeros(9)
        initial[_LAST_RATE : _LAST_RATE + 3] = math.nan
        output = self.DeclareDiscreteState(no_measurement(INERTIAL))
        self.DeclareDiscreteState(initial)
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(PLANT_PERIOD, 0.0, self._update)

    def configure(self, config: ImuConfig, seed: int) -> None:
        """Take over a new configuration and draw the errors that are constant in a run."""
        errors = config.errors()
        self._key = stream_key(seed, f"{self._stream}.noise")
        self._parameters = np.empty(2 * _STRIDE)
        constants = standard_normals(stream_key(seed, f"{self._stream}.constants"), 0, 24)
        for sensor, name in enumerate(("gyro", "accelerometer")):
            density = getattr(errors, f"{name}_noise")
            vibration = getattr(config, f"{name}_vibration")
            drawn = constants[12 * sensor : 12 * (sensor + 1)]
            spread = np.full((3, 3), errors.misalignment)
            np.fill_diagonal(spread, getattr(errors, f"{name}_scale_error"))
            p = self._parameters[_STRIDE * sensor : _STRIDE * (sensor + 1)]
            p[_NOISE] = math.hypot(density / math.sqrt(_DT), vibration)
            p[_WALK] = getattr(errors, f"{name}_bias_walk") * math.sqrt(_DT)
            p[_RANGE] = getattr(errors, f"{name}_range")
            p[_BIAS:_MATRIX] = getattr(errors, f"{name}_bias") * drawn[:3]
            p[_MATRIX:] = (np.eye(3) + spread * drawn[3:].reshape(3, 3)).ravel()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time = context.get_time()
        sample_imu(
            round(time / _DT),
            time,
            self._body(context),
            self._key,
            self._parameters,
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
        )

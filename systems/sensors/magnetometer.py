"""The magnetometer: the earth's field in B, bent by the vehicle's iron."""

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from systems.configuration import NonNegative, Vector3, configuration
from systems.frames import rotation_matrix
from systems.signals.measurement import BODY_STATE, MAGNETOMETER, no_measurement
from systems.signals.noise import standard_normals, stream_key

MAGNETOMETER_PERIOD = 0.08  # s; PX4: SENS_MAG_RATE, 15 Hz


@configuration
class MagnetometerConfig:
    """A calibrated three-axis magnetometer in the field of one place."""

    # gauss, W: east, north, up. Volos, Greece, 39.36 N 22.94 E, by WMM2025 in mid 2025.
    earth_field: Vector3 = Field(default_factory=lambda: [0.0233, 0.2581, -0.3910])
    noise: NonNegative = 0.0035  # gauss rms, white; LIS3MDL data sheet: 3.2 (x, y), 4.1 mG (z)
    # What the calibration leaves, one sigma an axis; 0.01 gauss turns the heading by 2 deg here.
    hard_iron: NonNegative = 0.01  # gauss, assumed
    soft_iron: NonNegative = 0.01  # 1, each entry of the matrix's deviation from unity; assumed

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "Magnetometer":
        """Add a `Magnetometer`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, Magnetometer(self, seed, stream=name))


_FIELD = MAGNETOMETER.slice("field_B").start


@njit(cache=True)
def sample_magnetometer(index, time, body, key, earth_field, noise, hard_iron, soft_iron, output):
    """Write one magnetometer measurement.

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
    earth_field : array of shape (3,)
        gauss, W.
    noise : float
        gauss rms.
    hard_iron : array of shape (3,)
        gauss, B.
    soft_iron : array of shape (3, 3)
        B.
    output : array of shape (7,)
        `MAGNETOMETER`, changed in place.
    """
    R_WB = rotation_matrix(body[:4])
    n = standard_normals(key, index, 3)
    for i in range(3):
        value = hard_iron[i] + noise * n[i]
        for j in range(3):
            for k in range(3):
                value += soft_iron[i, j] * R_WB[k, j] * earth_field[k]
        output[_FIELD + i] = value
    output[0] = output[1] = time
    output[2] = index
    output[3] = 1.0


class Magnetometer(LeafSystem):
    """A magnetometer aligned with B.

    .. pydrake_system::

        name: Magnetometer
        input_ports:
        - body
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the true state of the body |
    | `measurement` | `MAGNETOMETER` | the field in B |

    With n standard normal, and A, h drawn for the run,

        field_B = A R_WBᵀ earth_field + h + noise · n,    A = I + soft_iron · N,  h = hard_iron · n

    | event | when | does |
    |---|---|---|
    | update | every 80 ms from 0 | samples the body as it was just before |

    Parameters
    ----------
    config : MagnetometerConfig
    seed : int
    stream : str
        The name of the random stream; sensors that share it under one seed err alike.
    """

    def __init__(self, config: MagnetometerConfig, seed: int = 0, *, stream: str = "magnetometer"):
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        output = self.DeclareDiscreteState(no_measurement(MAGNETOMETER))
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(MAGNETOMETER_PERIOD, 0.0, self._update)

    def configure(self, config: MagnetometerConfig, seed: int) -> None:
        """Take over a new configuration and draw the iron of the run."""
        self._noise = config.noise
        self._earth_field = np.array(config.earth_field)
        self._key = stream_key(seed, f"{self._stream}.noise")
        drawn = standard_normals(stream_key(seed, f"{self._stream}.iron"), 0, 12)
        self._hard_iron = config.hard_iron * drawn[:3]
        self._soft_iron = np.eye(3) + config.soft_iron * drawn[3:].reshape(3, 3)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time = context.get_time()
        sample_magnetometer(
            round(time / MAGNETOMETER_PERIOD),
            time,
            self._body(context),
            self._key,
            self._earth_field,
            self._noise,
            self._hard_iron,
            self._soft_iron,
            discrete_state.get_mutable_value(0),
        )

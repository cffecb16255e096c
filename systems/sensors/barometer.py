"""The barometer: altitude by pressure, with noise, drift and the pressure under the rotors."""

import math

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from systems.configuration import Finite, Metres, NonNegative, Positive, configuration
from systems.signals.measurement import BAROMETER, BODY_STATE, no_measurement
from systems.signals.noise import standard_normal, stream_key

BAROMETER_PERIOD = 0.08  # s; PX4: SENS_BARO_RATE, 20 Hz
_GRAVITY = 9.80665  # m/s2
_SEA_LEVEL_DENSITY = 1.225  # kg/m3, ISO 2533


def metres_per_pascal(altitude: float) -> float:
    """How far one climbs while the pressure of the standard atmosphere (ISO 2533) drops by 1 Pa.

    Parameters
    ----------
    altitude : float
        m above mean sea level, within the troposphere.
    """
    density = _SEA_LEVEL_DENSITY * (1.0 - 2.25577e-5 * altitude) ** 4.25588
    return 1.0 / (density * _GRAVITY)


@configuration
class BarometerConfig:
    """A MEMS barometer inside the vehicle's shell."""

    origin_altitude: Finite = 10.0  # m above mean sea level, of W's origin
    noise: NonNegative = 1.0  # Pa rms, white: 8 cm, as in PX4's simulator
    # The drift is such that its rms change in ten minutes is the 1.5 m that users report.
    drift: Metres = 1.33  # m, one sigma of a Gauss-Markov process
    drift_time: Positive = Field(default=600.0)  # s, its time constant
    # Pressure rise under the rotors, as apparent sinking. Reports go from nothing to the 4 m
    # that PX4's dead zone covers (EKF2_GND_EFF_DZ); 1 m is assumed.
    ground_effect: Metres = 1.0  # m, at zero height in hover
    ground_effect_height: Positive = 0.5  # m, where half of it is left; PX4: EKF2_GND_MAX_HGT
    vehicle_mass: Positive = 2.0  # kg, to tell thrust from the ground's support

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "Barometer":
        """Add a `Barometer`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, Barometer(self, seed, stream=name))


_P_Z = BODY_STATE.index("p_WB_z")
_F_Z = BODY_STATE.index("f_B_z")
_CONTACT = BODY_STATE.index("contact_force")
_ALTITUDE = BAROMETER.index("altitude")


@njit(cache=True)
def ground_effect(height, thrust_ratio, strength, half_height):
    """The apparent sinking (m) of a barometer under rotors: strength·thrust/(1 + (h/h½)²).

    The square is that of the source's image in the ground (Cheeseman and Bennett, ARC R&M
    3021, 1955).
    """
    ratio = max(height, 0.0) / half_height
    return strength * thrust_ratio / (1.0 + ratio * ratio)


@njit(cache=True)
def sample_barometer(index, time, body, key, parameters, output, memory):
    """Write one barometer measurement; `parameters` are those that `Barometer` lays out."""
    altitude, noise, drift, keep, strength, half_height, mass = parameters
    innovation = standard_normal(key, index, 1)
    if index == 0:
        memory[0] = drift * innovation
    else:
        memory[0] = keep * memory[0] + drift * math.sqrt(1.0 - keep * keep) * innovation
    thrust_ratio = max(body[_F_Z] - body[_CONTACT] / mass, 0.0) / _GRAVITY
    output[_ALTITUDE] = (
        altitude
        + body[_P_Z]
        + memory[0]
        + noise * standard_normal(key, index, 0)
        - ground_effect(body[_P_Z], thrust_ratio, strength, half_height)
    )
    output[0] = output[1] = time
    output[2] = index
    output[3] = 1.0


class Barometer(LeafSystem):
    """A barometer at the body's origin.

    .. pydrake_system::

        name: Barometer
        input_ports:
        - body
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the true state of the body |
    | `measurement` | `BAROMETER` | altitude above mean sea level |

    With h the height of the body's origin above the ground plane z = 0 of W, T the
    thrust as the specific force along B's z axis shows it, n standard normal, and
    δ = 80 ms,

        altitude = origin + p_WB.z + d + σ n − g,        σ = noise · dh/dp
        d⁺ = d exp(−δ/τ) + drift √(1 − exp(−2δ/τ)) n,     d(0) = drift · n
        g = ground_effect · (T/mg) / (1 + (h/h½)²)

    | event | when | does |
    |---|---|---|
    | update | every 80 ms from 0 | samples the body as it was just before |

    Parameters
    ----------
    config : BarometerConfig
    seed : int
    stream : str
        The name of the random stream; sensors that share it under one seed err alike.
    """

    def __init__(self, config: BarometerConfig, seed: int = 0, *, stream: str = "barometer"):
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        output = self.DeclareDiscreteState(no_measurement(BAROMETER))
        self.DeclareDiscreteState(np.zeros(1))  # m, the drift
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(BAROMETER_PERIOD, 0.0, self._update)

    def configure(self, config: BarometerConfig, seed: int) -> None:
        """Take over a new configuration."""
        self._key = stream_key(seed, self._stream)
        self._parameters = np.array(
            [
                config.origin_altitude,
                config.noise * metres_per_pascal(config.origin_altitude),
                config.drift,
                math.exp(-BAROMETER_PERIOD / config.drift_time),
                config.ground_effect,
                config.ground_effect_height,
                config.vehicle_mass,
            ]
        )

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time = context.get_time()
        sample_barometer(
            round(time / BAROMETER_PERIOD),
            time,
            self._body(context),
            self._key,
            self._parameters,
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
        )

"""The satellite receiver: position and velocity with errors that last, 5 or 10 times a second."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from systems.configuration import Metres, NonNegative, Positive, Vector3, configuration
from systems.geodesy import geodetic_from_world
from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import BODY_STATE, GNSS, PAD_STATE, no_measurement
from systems.signals.noise import standard_normals, stream_key

_CEP = 1.1774  # radius of the circle that holds half of a unit bivariate normal
_R50 = 0.6745  # half of a unit normal lies within


@dataclass(frozen=True)
class Receiver:
    """The errors of a receiver, one sigma (an axis, where horizontal), and what it reports."""

    horizontal_noise: float  # m, white
    vertical_noise: float  # m, white
    horizontal_drift: float  # m, of a first-order Gauss-Markov process
    vertical_drift: float  # m
    drift_time: float  # s, time constant of both
    smoothing_time: float  # s, time constant of a low pass behind the drift; 0 is none
    horizontal_offset: float  # m, constant in a run
    vertical_offset: float  # m
    horizontal_velocity_noise: float  # m/s, white
    vertical_velocity_noise: float  # m/s
    horizontal_accuracy: float  # m, as reported
    vertical_accuracy: float  # m, as reported
    speed_accuracy: float  # m/s, as reported
    fix_type: float  # as in `GNSS`
    satellites: float
    position_dilution: float


RECEIVERS = {
    # A single-frequency receiver of the u-blox M8 class.
    # - Drift: horizontal 2.5 m CEP (NEO-M8 data sheet UBX-13003366, GPS + GLONASS), nearly all of
    #   which is slow. Time constant 1100 s, and vertical/horizontal = 9.2/4.7: the Gauss-Markov
    #   model of Rankin, "An error model for sensor simulation: GPS and differential GPS", PLANS
    #   1994, as in Beard and McLain, "Small Unmanned Aircraft", 2012, table 7.2. In a minute this
    #   drifts by 0.69 m rms an axis. D. L. Wilson's web page "Correlation of errors" shows a fast
    #   part of about a minute besides in one receiver and none in another; it is left out.
    # - Smoothing: in the 9 s after the landing in the outdoor flight log `outdoor_gps_quad.ulg` the
    #   receiver at rest wanders by 13, 25, 54, 94, 144, 220 mm rms an axis in 0.2, 0.4, 1, 2, 4 and
    #   6 s: in proportion to the time at first, to its root later, as a drift does behind a low
    #   pass. With 1.4 s the drift above gives 11, 21, 48, 88, 149, 194 mm; 5 mm of white noise (the
    #   message counts in 11 mm) make the first two 13 and 22.
    # - White noise vertically: what is left of that log's 35 mm between consecutive altitudes.
    # - Velocity: 0.05 m/s (50 %) by the data sheet; vertical half as much again, as PX4 takes it.
    # - Accuracies, satellites and dilution: as reported in that flight.
    "standalone": Receiver(
        horizontal_noise=0.005,
        vertical_noise=0.032,
        horizontal_drift=2.5 / _CEP,
        vertical_drift=2.5 / _CEP * 9.2 / 4.7,
        drift_time=1100.0,
        smoothing_time=1.4,
        horizontal_offset=0.0,
        vertical_offset=0.0,
        horizontal_velocity_noise=0.05 / _CEP,
        vertical_velocity_noise=1.5 * 0.05 / _CEP,
        horizontal_accuracy=0.58,
        vertical_accuracy=1.0,
        speed_accuracy=0.165,
        fix_type=3.0,
        satellites=14.0,
        position_dilution=1.51,
    ),
    # A u-blox ZED-F9P with fixed ambiguities (data sheet UBX-17051259): 0.01 m CEP horizontally,
    # 0.01 m R50 vertically (1 ppm of a short baseline is nothing), 0.05 m/s. Assumed: half of the
    # variance is white, half multipath that changes over a hundred seconds; the pad was surveyed
    # with the same receiver, so its offset is as large again.
    "rtk": Receiver(
        horizontal_noise=0.01 / _CEP * math.sqrt(0.5),
        vertical_noise=0.01 / _R50 * math.sqrt(0.5),
        horizontal_drift=0.01 / _CEP * math.sqrt(0.5),
        vertical_drift=0.01 / _R50 * math.sqrt(0.5),
        drift_time=100.0,
        smoothing_time=0.0,
        horizontal_offset=0.01 / _CEP,
        vertical_offset=0.01 / _R50,
        horizontal_velocity_noise=0.05 / _CEP,
        vertical_velocity_noise=1.5 * 0.05 / _CEP,
        horizontal_accuracy=0.014,
        vertical_accuracy=0.014,
        speed_accuracy=0.05,
        fix_type=6.0,
        satellites=28.0,
        position_dilution=1.1,
    ),
}


@configuration
class GnssConfig:
    """Which receiver, and where in the world; None takes the receiver's figure."""

    kind: Literal["standalone", "rtk"] = "standalone"
    # deg, deg, m: latitude, longitude and altitude of W's origin. Volos, Greece.
    origin: Vector3 = Field(default_factory=lambda: [39.3622, 22.9420, 10.0])
    rate: Literal[5, 10] = 5  # Hz
    # Errors count from those at t = 0, as if W's origin had been surveyed with this very receiver
    # before take-off; otherwise they are absolute.
    relative_to_start: bool = False
    horizontal_noise: Metres | None = None  # m, white, one sigma an axis
    vertical_noise: Metres | None = None  # m
    horizontal_drift: Metres | None = None  # m, correlated, one sigma an axis
    vertical_drift: Metres | None = None  # m
    drift_time: Positive | None = None  # s, correlation time of the drift
    smoothing_time: NonNegative | None = None  # s, of the receiver's filter behind it; 0 is none
    horizontal_offset: Metres | None = None  # m, constant in a run, one sigma an axis
    vertical_offset: Metres | None = None  # m
    horizontal_velocity_noise: NonNegative | None = None  # m/s, white, one sigma an axis
    vertical_velocity_noise: NonNegative | None = None  # m/s
    horizontal_accuracy: Metres | None = None  # m, as reported
    vertical_accuracy: Metres | None = None  # m
    speed_accuracy: NonNegative | None = None  # m/s
    fix_type: Literal[0, 3, 4, 5, 6] | None = None  # as in `GNSS`; below 3 the fix is not valid
    satellites: NonNegative | None = None  # 1
    position_dilution: NonNegative | None = None  # PDOP, 1

    def receiver(self) -> Receiver:
        """The receiver's figures with what this configuration puts in their place."""
        receiver = RECEIVERS[self.kind]
        values = {}
        for field in receiver.__dataclass_fields__:
            override = getattr(self, field)
            values[field] = getattr(receiver, field) if override is None else override
        return Receiver(**values)

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, carrier: "Carrier" = "body"
    ) -> "Gnss":
        """Add a `Gnss` on `carrier`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, Gnss(self, seed, stream=name, carrier=carrier))


Carrier = Literal["body", "pad"]
_CARRIED = {
    "body": (BODY_STATE, BODY_STATE.slice("p_WB"), BODY_STATE.slice("v_WB")),
    "pad": (PAD_STATE, PAD_STATE.slice("p_WP"), PAD_STATE.slice("v_WP")),
}
_LATITUDE = GNSS.index("latitude")
_V_W = GNSS.slice("v_W").start
_REPORTED = GNSS.index("horizontal_accuracy")
_EARLY = 1e-6  # samples, so that rounding does not make one late


@njit(cache=True)
def sample_gnss(
    index,
    time,
    p_true,
    v_true,
    key,
    origin,
    sigmas,
    keep,
    blend,
    relative,
    reported,
    output,
    memory,
):
    """Write one GNSS measurement.

    Parameters
    ----------
    index : int
        Of the sample.
    time : float
        s, now.
    p_true, v_true : arrays of shape (3,)
        Of the antenna in W, m and m/s.
    key : np.uint64
        Of the sensor's stream of noise.
    origin : array of shape (3,)
        deg, deg, m.
    sigmas : array of shape (4, 3)
        Standard deviations in W of white noise, drift (m), velocity (m/s); the offset itself (m).
    keep : float
        What a step leaves of the drift, exp(−δ/τ).
    blend : float
        What a step takes over of it, 1 − exp(−δ/T); 1 without smoothing.
    relative : bool
        Whether errors count from those at the first sample.
    reported : array of shape (6,)
        The last six fields of `GNSS`.
    output : array of shape (16,)
        `GNSS`, changed in place.
    memory : array of shape (9,)
        Drift, the smoothed drift, and its first sample (m, W), changed in place.
    """
    n = standard_normals(key, index, 9)
    p_W = np.empty(3)
    for i in range(3):
        drift = sigmas[1, i] * n[3 + i]
        if index == 0:
            memory[i] = memory[3 + i] = memory[6 + i] = drift
        else:
            memory[i] = keep * memory[i] + math.sqrt(1.0 - keep * keep) * drift
            memory[3 + i] += blend * (memory[i] - memory[3 + i])
        error = memory[3 + i] - memory[6 + i] if relative else memory[3 + i] + sigmas[3, i]
        p_W[i] = p_true[i] + error + sigmas[0, i] * n[i]
        output[_V_W + i] = v_true[i] + sigmas[2, i] * n[6 + i]
    output[0] = output[1] = time
    output[2] = index
    output[3] = 1.0 if reported[3] >= 3.0 else 0.0
    output[_LATITUDE : _LATITUDE + 3] = geodetic_from_world(p_W, origin)
    output[_REPORTED : _REPORTED + 6] = reported


class Gnss(LeafSystem):
    """A GNSS receiver with its antenna at the origin of the vehicle's body, or of the pad.

    .. pydrake_system::

        name: Gnss
        input_ports:
        - body
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the true state of the body; on a pad `pad`, `PAD_STATE` |
    | `measurement` | `GNSS` | geodetic position, velocity in W, reported quality |

    With δ = 1/rate, n standard normal and an axis each,

        p = p_WB + offset + s + noise · n          (W, then WGS84)
        s⁺ = s + (1 − exp(−δ/T)) (d⁺ − s),                s(0) = d(0)
        d⁺ = d exp(−δ/τ) + drift √(1 − exp(−2δ/τ)) n,     d(0) = drift · n
        v = v_WB + velocity_noise · n

    with T the smoothing time, so two errors Δt apart differ by about
    drift √(2/τ (Δt − T (1 − exp(−Δt/T)))) rms an axis while Δt is short of τ, and in the
    end by drift √2, which is what a landing at the place of take-off sees of a standalone
    receiver. The receiver's latency is the business of a `DelayLine`.

    Sample k is taken by the first event at or after k/rate.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | takes a sample, if one is due |

    Parameters
    ----------
    config : GnssConfig
    seed : int
    stream : str
        The name of the random stream; sensors that share it under one seed err alike.
    carrier : "body" or "pad"
        What the antenna is on.
    """

    def __init__(
        self,
        config: GnssConfig,
        seed: int = 0,
        *,
        stream: str = "gnss",
        carrier: Carrier = "body",
    ):
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        layout, self._p, self._v = _CARRIED[carrier]
        self._state = self.DeclareVectorInputPort(carrier, layout.size).Eval
        output = self.DeclareDiscreteState(no_measurement(GNSS))
        self.DeclareDiscreteState(np.zeros(9))
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(CLOCK_PERIOD, 0.0, self._update)

    def configure(self, config: GnssConfig, seed: int) -> None:
        """Take over a new configuration and draw the offset of the run."""
        receiver = config.receiver()
        self._rate = float(config.rate)
        self._relative = config.relative_to_start
        self._origin = np.array(config.origin)
        self._keep = math.exp(-1.0 / (config.rate * receiver.drift_time))
        smoothing = config.rate * receiver.smoothing_time  # samples
        self._blend = 1.0 if smoothing == 0.0 else -math.expm1(-1.0 / smoothing)
        self._key = stream_key(seed, f"{self._stream}.noise")
        drawn = standard_normals(stream_key(seed, f"{self._stream}.offset"), 0, 3)
        kinds = ("noise", "drift", "velocity_noise", "offset")
        self._sigmas = np.array(
            [
                [
                    getattr(receiver, f"{axis}_{kind}")
                    for axis in ("horizontal",) * 2 + ("vertical",)
                ]
                for kind in kinds
            ]
        )
        self._sigmas[3] *= drawn
        self._reported = np.array(
            [getattr(receiver, field) for field in GNSS.fields[_REPORTED:]], dtype=float
        )

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time = context.get_time()
        index = math.floor(time * self._rate + _EARLY)
        if index == math.floor((time - CLOCK_PERIOD) * self._rate + _EARLY):
            return
        state = self._state(context)
        sample_gnss(
            index,
            time,
            state[self._p],
            state[self._v],
            self._key,
            self._origin,
            self._sigmas,
            self._keep,
            self._blend,
            self._relative,
            self._reported,
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
        )

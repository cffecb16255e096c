"""The range finder: a narrow lidar that looks down along the body's axis."""

import math
from typing import Annotated

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from systems.configuration import Metres, NonNegative, Positive, Vector3, configuration
from systems.frames import rotation_matrix
from systems.signals.measurement import BODY_STATE, PAD_STATE, RANGE_FINDER, no_measurement
from systems.signals.noise import standard_normal, stream_key
from systems.signals.optional_input import optional_input

RANGE_FINDER_PERIOD = 0.04  # s; of the lidar's 100 Hz as much as navigation takes


@configuration
class RangeFinderConfig:
    """A Benewake TFmini Plus, figures from its data sheet (SJ-GU-TFmini-Plus-01 A04)."""

    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m, p_BS of the lens, in B
    minimum_range: Metres = 0.1  # m
    maximum_range: Positive = 12.0  # m, on a surface that reflects 90 %
    # The data sheet's accuracy is taken as two sigma, one half of the variance constant in a run.
    accuracy: NonNegative = 0.05  # m, ± up to 6 m
    relative_accuracy: NonNegative = 0.01  # 1, ± of the range beyond 6 m
    resolution: Metres = 0.005  # m, 0 is none
    # Beyond this the ground throws too little light back; PX4's filter stops at the same tilt.
    maximum_incidence: Annotated[float, Field(gt=0.0, lt=math.pi / 2)] = math.pi / 4  # rad
    pad_radius: Metres = 0.5  # m, of the pad's top around its centre

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "RangeFinder":
        """Add a `RangeFinder`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, RangeFinder(self, seed, stream=name))


_ACCURACY_CHANGE = 6.0  # m
_P = BODY_STATE.slice("p_WB").start
_P_WP = PAD_STATE.slice("p_WP").start
_RANGE = RANGE_FINDER.index("range")
_QUALITY = RANGE_FINDER.index("signal_quality")
_NO_PAD = PAD_STATE.zeros()


@njit(cache=True)
def beam_length(body, p_BS, p_WP, pad_radius):
    """The distance along −z of B from the lens to the ground plane z = 0 or to the pad's top.

    Parameters
    ----------
    body : array of shape (17,)
        `BODY_STATE`.
    p_BS : array of shape (3,)
        m, the lens in B.
    p_WP : array of shape (3,)
        m, the pad's centre in W; the pad is a level disc.
    pad_radius : float
        m.

    Returns
    -------
    length : float
        m; infinite if the beam meets neither.
    cosine : float
        Of the angle of incidence on the level surface.
    """
    R_WB = rotation_matrix(body[:4])
    p_WS = body[_P : _P + 3] + R_WB @ p_BS
    cosine = R_WB[2, 2]  # the beam is −R_WB.z, the surface's normal is W's z
    if cosine <= 0.0:
        return math.inf, cosine
    length = p_WS[2] / cosine if p_WS[2] >= 0.0 else math.inf
    to_pad = (p_WS[2] - p_WP[2]) / cosine
    if to_pad >= 0.0:
        x = p_WS[0] - to_pad * R_WB[0, 2] - p_WP[0]
        y = p_WS[1] - to_pad * R_WB[1, 2] - p_WP[1]
        if x * x + y * y <= pad_radius * pad_radius:
            length = min(length, to_pad)
    return length, cosine


@njit(cache=True)
def sample_range_finder(index, time, body, pad, key, constant, p_BS, parameters, output):
    """Write one range measurement; `parameters` are those that `RangeFinder` lays out."""
    shortest, longest, accuracy, relative, resolution, least_cosine, pad_radius = parameters
    length, cosine = beam_length(body, p_BS, pad[_P_WP : _P_WP + 3], pad_radius)
    output[0] = output[1] = time
    output[2] = index
    output[3] = output[_RANGE] = output[_QUALITY] = 0.0
    if not shortest <= length <= longest or cosine < least_cosine:
        return
    sigma = 0.5 * (accuracy if length <= _ACCURACY_CHANGE else relative * length)
    measured = length + sigma * math.sqrt(0.5) * (constant + standard_normal(key, index, 0))
    if resolution > 0.0:
        measured = resolution * np.rint(measured / resolution)
    if shortest <= measured <= longest:
        output[3] = 1.0
        output[_RANGE] = measured
        output[_QUALITY] = 100.0


class RangeFinder(LeafSystem):
    """A lidar that measures along −z of B to the ground or the pad.

    .. pydrake_system::

        name: RangeFinder
        input_ports:
        - body
        - pad (optional)
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the true state of the body |
    | `pad` (optional) | `PAD_STATE` | the pad, a level disc; unconnected: flush with the ground |
    | `measurement` | `RANGE_FINDER` | range along the beam |

    With l the distance from the lens along the beam, n standard normal and c(run)
    standard normal, drawn for the run,

        range = round(l + σ(l) (c + n)/√2),    2σ = accuracy up to 6 m, relative_accuracy · l beyond

    rounded to the resolution. A range outside the limits or an angle of incidence
    above `maximum_incidence` gives a measurement with valid 0, range 0, quality 0.
    The beam is a line: the 3.6 deg of the real one average over 6 % of the range.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | samples the state of just before |

    Parameters
    ----------
    config : RangeFinderConfig
    seed : int
    stream : str
        The name of the random stream; sensors that share it under one seed err alike.
    """

    def __init__(self, config: RangeFinderConfig, seed: int = 0, *, stream: str = "range_finder"):
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        self._pad = optional_input(self.DeclareVectorInputPort("pad", PAD_STATE.size), _NO_PAD)
        output = self.DeclareDiscreteState(no_measurement(RANGE_FINDER))
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(RANGE_FINDER_PERIOD, 0.0, self._update)

    def configure(self, config: RangeFinderConfig, seed: int) -> None:
        """Take over a new configuration and draw the offset of the run."""
        self._key = stream_key(seed, f"{self._stream}.noise")
        self._constant = standard_normal(stream_key(seed, f"{self._stream}.constant"), 0, 0)
        self._position = np.array(config.position)
        self._parameters = np.array(
            [
                config.minimum_range,
                config.maximum_range,
                config.accuracy,
                config.relative_accuracy,
                config.resolution,
                math.cos(config.maximum_incidence),
                config.pad_radius,
            ]
        )

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        time = context.get_time()
        sample_range_finder(
            round(time / RANGE_FINDER_PERIOD),
            time,
            self._body(context),
            self._pad(context),
            self._key,
            self._constant,
            self._position,
            self._parameters,
            discrete_state.get_mutable_value(0),
        )

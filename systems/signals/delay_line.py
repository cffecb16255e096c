"""Latency as a system: a measurement goes in at its sensor and comes out at its consumer later.

Latency counts from the time of validity, so the time that a measurement spends
on its way into the line (a tick behind a fault injector, say) is not added to it.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from numba import njit
from pydantic import AfterValidator, Field, model_validator
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import (
    Positive,
    Probability,
    Seconds,
    configuration,
    require_same_structure,
)
from systems.schedule import PLANT_PERIOD, on_grid
from systems.signals.measurement import (
    SEQUENCE_NUMBER,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    Layout,
    no_measurement,
)
from systems.signals.noise import standard_normal, stream_key, uniform

_FIXED, _UNIFORM, _NORMAL, _RECORDED, _ROLLING = range(5)


@configuration
class FixedLatency:
    """Every measurement takes equally long."""

    kind: Literal["fixed"] = "fixed"
    time: Seconds = 0.0  # s

    def parameters(self) -> list[float]:
        """The model as `draw_latency` reads it."""
        return [_FIXED, self.time, 0.0]


@configuration
class UniformLatency:
    """Uniformly distributed between two bounds."""

    kind: Literal["uniform"] = "uniform"
    shortest: Seconds = 0.0  # s
    longest: Seconds = 0.0  # s

    @model_validator(mode="after")
    def _check_order(self) -> Any:
        if self.longest < self.shortest:
            raise ValueError(f"longest {self.longest} s is less than shortest {self.shortest} s")
        return self

    def parameters(self) -> list[float]:
        """The model as `draw_latency` reads it."""
        return [_UNIFORM, self.shortest, self.longest]


@configuration
class NormalLatency:
    """Normally distributed, truncated at zero (drawn again while negative)."""

    kind: Literal["normal"] = "normal"
    mean: Seconds = 0.0  # s, of the distribution before it is truncated
    standard_deviation: Seconds = 0.0  # s, likewise

    def parameters(self) -> list[float]:
        """The model as `draw_latency` reads it."""
        return [_NORMAL, self.mean, self.standard_deviation]


@configuration
class RecordedLatency:
    """Latencies measured on a real system, repeated from the start when they are used up."""

    kind: Literal["recorded"] = "recorded"
    times: Annotated[list[Seconds], Field(min_length=1)]  # s, by sequence number

    def parameters(self) -> list[float]:
        """The model as `draw_latency` reads it."""
        return [_RECORDED, 0.0, 0.0, *self.times]


@configuration
class RollingLatency:
    """A sine over the measurements, as of two clocks that beat; its phase is drawn once a run."""

    kind: Literal["rolling"] = "rolling"
    mean: Seconds = 0.0  # s
    amplitude: Seconds = 0.0  # s, at most the mean
    turn: Positive = 60.0  # measurements from one crest to the next

    @model_validator(mode="after")
    def _check_amplitude(self) -> Any:
        if self.amplitude > self.mean:
            raise ValueError(f"amplitude {self.amplitude} s is more than the mean {self.mean} s")
        return self

    def parameters(self) -> list[float]:
        """The model as `draw_latency` reads it."""
        return [_ROLLING, self.mean, self.amplitude, self.turn]


LatencyModel = Annotated[
    FixedLatency | UniformLatency | NormalLatency | RecordedLatency | RollingLatency,
    Field(discriminator="kind"),
]


@configuration
class DelayLineConfig:
    """How long measurements travel, and which of them are lost on the way.

    The latency of a measurement is exposure + processing + transport + a draw from `latency`.
    """

    exposure: Seconds = 0.0  # s, from the time of validity to the end of the exposure
    processing: Seconds = 0.0  # s, from the end of the exposure to the result
    transport: Seconds = 0.0  # s, from the result to the consumer
    latency: LatencyModel = Field(default_factory=FixedLatency)  # the part that varies
    drop: Probability = 0.0  # that a measurement is lost
    duplicate: Probability = 0.0  # that a second copy is sent, with a latency of its own
    order: Literal["first_in_first_out", "by_release_time"] = "first_in_first_out"
    capacity: Annotated[int, Field(ge=1)] = 16  # measurements under way; the oldest gives way
    # s, between looks
    period: Annotated[float, Field(ge=PLANT_PERIOD), AfterValidator(on_grid)] = PLANT_PERIOD

    def add_to(self, builder: DiagramBuilder, name: str, seed: int, layout: Layout) -> "DelayLine":
        """Add a `DelayLine` for measurements of `layout`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, DelayLine(self, seed, layout=layout, stream=name))


# The parameter vector of the compiled functions.
_MODEL, _A, _B, _CONSTANT, _DROP, _DUPLICATE, _IN_ORDER, _TIMES = range(8)
# The memory of a line: these, then `capacity` slots of (release, entry number, measurement).
_SEEN, _NEXT_RELEASE, _LAST_RELEASE = range(3)
_ENTERED, _RELEASED, _DROPPED, _DUPLICATED, _OVERFLOWED = range(3, 8)
_SLOTS = 8
_TOLERANCE = 1e-9  # s, sums of times in decimals miss the grid by less

_OUTPUT, _MEMORY = range(2)  # groups of the discrete state


@njit(cache=True)
def draw_latency(parameters, key, sequence_number, copy):
    """The latency (s) of a measurement: the constant part plus a draw from the model.

    Parameters
    ----------
    parameters : array of shape (7 + further numbers of the model,)
        Model, its two numbers, constant part (s), drop, duplicate, in order, then the recorded
        latencies or the measurements of a turn.
    key : np.uint64
        Of the stream of latencies.
    sequence_number : int
    copy : int
        0 the measurement, 1 its duplicate.
    """
    model, a, b = parameters[_MODEL], parameters[_A], parameters[_B]
    drawn = a
    if model == _UNIFORM:
        drawn = a + (b - a) * uniform(key, sequence_number, copy)
    elif model == _NORMAL:
        lane = copy
        drawn = a + b * standard_normal(key, sequence_number, lane)
        while drawn < 0.0:
            lane += 2
            drawn = a + b * standard_normal(key, sequence_number, lane)
    elif model == _RECORDED:
        drawn = parameters[_TIMES + (sequence_number + copy) % (parameters.size - _TIMES)]
    elif model == _ROLLING:
        turns = sequence_number / parameters[_TIMES] + uniform(key, 0, 0)
        drawn = a + b * math.sin(2.0 * math.pi * turns)
    return parameters[_CONSTANT] + drawn


@njit(cache=True)
def _push(release, measurement, parameters, memory):
    size = measurement.size
    if parameters[_IN_ORDER]:
        release = max(release, memory[_LAST_RELEASE])
    memory[_LAST_RELEASE] = release
    slot = _SLOTS  # the first free one, or else the one that was entered first
    for start in range(_SLOTS, memory.size, size + 2):
        if memory[start] == math.inf:
            slot = start
            break
        if memory[start + 1] < memory[slot + 1]:
            slot = start
    if memory[slot] != math.inf:
        memory[_OVERFLOWED] += 1.0
    memory[slot] = release
    memory[slot + 1] = memory[_ENTERED]
    memory[slot + 2 : slot + 2 + size] = measurement
    memory[_ENTERED] += 1.0


@njit(cache=True)
def advance(time, measurement, keys, parameters, output, memory):
    """One tick of a delay line: take in `measurement` if it is new, release what is due.

    Parameters
    ----------
    time : float
        s, now.
    measurement : array of shape (size,)
    keys : array of np.uint64, shape (3,)
        Of the streams of latencies, drops and duplicates.
    parameters : array
        See `draw_latency`.
    output : array of shape (size,)
        The measurement last released; changed in place.
    memory : array of shape (8 + capacity (size + 2),)
        Changed in place.
    """
    size = measurement.size
    if measurement[TIME_OF_ARRIVAL] != memory[_SEEN]:
        memory[_SEEN] = measurement[TIME_OF_ARRIVAL]
        number = int(measurement[SEQUENCE_NUMBER])
        valid_at = measurement[TIME_OF_VALIDITY]
        if uniform(keys[1], number, 0) < parameters[_DROP]:
            memory[_DROPPED] += 1.0
        else:
            release = valid_at + draw_latency(parameters, keys[0], number, 0)
            _push(release, measurement, parameters, memory)
            if uniform(keys[2], number, 0) < parameters[_DUPLICATE]:
                memory[_DUPLICATED] += 1.0
                release = valid_at + draw_latency(parameters, keys[0], number, 1)
                _push(release, measurement, parameters, memory)

    first = -1
    following = math.inf
    for start in range(_SLOTS, memory.size, size + 2):
        if memory[start] == math.inf:
            continue
        if first < 0 or (memory[start], memory[start + 1]) < (memory[first], memory[first + 1]):
            if first >= 0:
                following = min(following, memory[first])
            first = start
        else:
            following = min(following, memory[start])
    if first >= 0 and memory[first] <= time + _TOLERANCE:
        output[:] = memory[first + 2 : first + 2 + size]
        output[TIME_OF_ARRIVAL] = time
        memory[first] = math.inf
        memory[_RELEASED] += 1.0
    elif first >= 0:
        following = memory[first]
    memory[_NEXT_RELEASE] = following


class DelayLine(LeafSystem):
    """Holds measurements back for their latency; can lose, duplicate and re-order them.

    .. pydrake_system::

        name: DelayLine
        input_ports:
        - measurement
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `measurement` | any measurement layout | at the sensor (input), at the consumer (output) |

    The output's `time_of_arrival` is the time of its release; time of validity,
    sequence number, valid flag and fields are the input's. Before the first release
    the output is `no_measurement(layout)`.

    With t_v the time of validity and n the sequence number of a measurement,

        latency(n) = exposure + processing + transport + draw(seed, stream, n)
        release(n) = t_v + latency(n)                               by release time
        release(n) = max(t_v + latency(n), release of the one before)    first in, first out

    and it leaves at the first tick at or after release(n). One measurement leaves
    a tick, the one with the earliest release time (the older one of two that are
    equal); another that is due leaves at the next tick. When `capacity`
    measurements are under way and one more enters, the one that entered first is
    lost and counted. Every draw is a function of (seed, stream, n), so that a
    measurement that was itself duplicated upstream meets the same fate twice.

    | event | when | does |
    |---|---|---|
    | update | every `period` (10 ms by default) from 0 | enter, release |

    A consumer sees a release one period of its own later, like everything that happens
    on one tick.

    Parameters
    ----------
    config : DelayLineConfig
    seed : int
    layout : Layout
        Of the measurement.
    stream : str
        The name of the random stream; lines that share it under one seed draw alike.
    """

    def __init__(
        self,
        config: DelayLineConfig,
        seed: int = 0,
        *,
        layout: Layout,
        stream: str = "delay_line",
    ):
        super().__init__()
        self._config = config
        self._stream = stream
        self.configure(config, seed)
        self._measurement = self.DeclareVectorInputPort("measurement", layout.size).Eval
        initial = np.zeros(_SLOTS + config.capacity * (layout.size + 2))
        initial[_SEEN] = no_measurement(layout)[TIME_OF_ARRIVAL]
        initial[_NEXT_RELEASE] = math.inf
        initial[_LAST_RELEASE] = -math.inf
        initial[_SLOTS :: layout.size + 2] = math.inf
        output = self.DeclareDiscreteState(no_measurement(layout))
        self.DeclareDiscreteState(initial)
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)

    def configure(self, config: DelayLineConfig, seed: int) -> None:
        """Take over a new configuration; `period` and `capacity` must stay as they are."""
        require_same_structure(self._config, config, "period", "capacity")
        self._config = config
        streams = ("latency", "drop", "duplicate")
        self._keys = np.array([stream_key(seed, f"{self._stream}.{name}") for name in streams])
        model, a, b, *times = config.latency.parameters()
        constant = config.exposure + config.processing + config.transport
        in_order = config.order == "first_in_first_out"
        self._parameters = np.array(
            [model, a, b, constant, config.drop, config.duplicate, in_order, *times]
        )

    def counts(self, context: Context) -> dict[str, int]:
        """How many measurements entered, were released, dropped, duplicated, overflowed."""
        memory = context.get_discrete_state(_MEMORY).get_value()
        names = ("entered", "released", "dropped", "duplicated", "overflowed")
        indices = (_ENTERED, _RELEASED, _DROPPED, _DUPLICATED, _OVERFLOWED)
        return {name: int(memory[i]) for name, i in zip(names, indices, strict=True)}

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        measurement = self._measurement(context)
        memory = discrete_state.get_mutable_value(_MEMORY)
        time = context.get_time()
        is_new = measurement.item(TIME_OF_ARRIVAL) != memory.item(_SEEN)
        if is_new or time >= memory.item(_NEXT_RELEASE) - _TOLERANCE:
            output = discrete_state.get_mutable_value(_OUTPUT)
            advance(time, measurement, self._keys, self._parameters, output, memory)

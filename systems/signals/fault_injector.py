"""Faults on purpose: measurements dropped or distorted, as configured or as commanded in flight."""

import difflib
import math
from typing import Annotated, Literal

import numpy as np
from numba import njit
from pydantic import AfterValidator, Field
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import (
    Finite,
    NonNegative,
    Probability,
    Seconds,
    Vector2,
    configuration,
    require_same_structure,
)
from systems.schedule import PLANT_PERIOD, on_grid
from systems.signals.measurement import (
    BODY_STATE,
    HEADER,
    INFRARED,
    INFRARED_BLOBS,
    MARKER,
    PAD_STATE,
    SEQUENCE_NUMBER,
    SUPERVISOR_STATUS,
    TIME_OF_ARRIVAL,
    VALID,
    Layout,
    no_measurement,
)
from systems.signals.noise import stream_key, uniform

# A command in flight, the thesis's MAVLink message (table 1). A command counts when its time is
# new; before the first one the time is negative.
FAULT_COMMAND = Layout(
    "FaultCommand",
    (
        "time",  # s, when it was issued; -1 none yet
        "target",  # bit 0 the infrared sensor, bit 1 the marker sensor: 3 both
        "r_drop",  # 1, probability of dropping a value; if > 0 the rest is ignored
        "p_keep",  # 1, values to keep in a row
        "p_drop",  # 1, values to drop in a row after these
    ),
)

_RANDOM, _PERIODIC, _ALWAYS, _BELOW, _ABOVE, _BIAS, _FREEZE, _FALSE_BLOB, _BEARING_SHIFT = range(9)
_OUTLIER = 9


@configuration
class _Fault:
    """When a fault may act: all of these must hold."""

    start_time: Seconds = 0.0  # s
    end_time: Seconds | None = None  # s; None never
    from_attempt: Annotated[int, Field(ge=0)] = 0  # landing attempt, 0 before the first
    until_attempt: Annotated[int, Field(ge=0)] | None = None  # the last one; None every later one
    while_landing: bool = False  # only once the landing routine has taken over

    def _row(self, kind: int, *arguments: float) -> list[float]:
        return [
            kind,
            self.start_time,
            math.inf if self.end_time is None else self.end_time,
            self.from_attempt,
            math.inf if self.until_attempt is None else self.until_attempt,
            self.while_landing,
            *arguments,
            *[0.0] * (4 - len(arguments)),
        ]


@configuration
class RandomDrop(_Fault):
    """Each measurement is dropped with a probability."""

    kind: Literal["random"] = "random"
    probability: Probability = 0.5  # that a measurement is dropped

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        return [self._row(_RANDOM, self.probability)]


@configuration
class PeriodicDrop(_Fault):
    """So many valid measurements are kept, then so many dropped, and again."""

    kind: Literal["periodic"] = "periodic"
    keep: Annotated[int, Field(ge=0)] = 1  # valid measurements kept in a row
    drop: Annotated[int, Field(ge=0)] = 1  # valid measurements dropped in a row after these

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        return [self._row(_PERIODIC, self.keep, self.drop)]


@configuration
class PermanentDrop(_Fault):
    """Every measurement is dropped."""

    kind: Literal["permanent"] = "permanent"

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        return [self._row(_ALWAYS)]


@configuration
class BelowDrop(_Fault):
    """Dropped while the vehicle is at most so high above the pad."""

    kind: Literal["below"] = "below"
    height: Finite = 3.0  # m, of the body's origin above the pad's centre
    duration: Seconds | None = None  # s from the first drop, once in a run; None as long as below

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        duration = math.inf if self.duration is None else self.duration
        return [self._row(_BELOW, self.height, duration)]


@configuration
class AboveDrop(_Fault):
    """Dropped while the vehicle is at least so high above the pad."""

    kind: Literal["above"] = "above"
    height: Finite = 3.0  # m, of the body's origin above the pad's centre

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        return [self._row(_ABOVE, self.height)]


@configuration
class WindowsDrop(_Fault):
    """Dropped from the start of each window of time until just before its end."""

    kind: Literal["windows"] = "windows"
    windows: list[Vector2] = Field(default_factory=list)  # s, [start, end] each

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        rows = []
        for start, end in self.windows:
            row = self._row(_ALWAYS)
            row[_START], row[_END] = max(row[_START], start), min(row[_END], end)
            rows.append(row)
        return rows


@configuration
class Bias(_Fault):
    """Offsets are added to named fields."""

    kind: Literal["bias"] = "bias"
    offsets: dict[str, Finite] = Field(default_factory=dict)  # by field, in the field's unit

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it; raises `ValueError` for a field that `layout` lacks."""
        fields = layout.fields[len(HEADER) :]
        for field in self.offsets:
            if field not in fields:
                nearest = difflib.get_close_matches(field, fields, n=1, cutoff=0.0)[0]
                raise ValueError(
                    f"bias: {layout.name} has no field {field!r} (nearest: {nearest!r})"
                )
        return [
            self._row(_BIAS, layout.index(field), offset) for field, offset in self.offsets.items()
        ]


@configuration
class Freeze(_Fault):
    """The fields and the valid flag repeat the last measurement before the fault, as if new."""

    kind: Literal["freeze"] = "freeze"

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it."""
        return [self._row(_FREEZE)]


@configuration
class FalseTarget(_Fault):
    """A persistent false bearing, fixed to the camera, as of a reflection on the vehicle itself.

    An infrared measurement gets one more blob (or only this blob); a marker
    measurement that is valid has its bearing turned, its corners stay. A false
    target that stands still in the world belongs to the camera instead.
    """

    kind: Literal["false_target"] = "false_target"
    # Tangents x/z and y/z in C: of the false blob, or by which the marker's bearing is shifted.
    bearing: Vector2 = Field(default_factory=lambda: [0.2, 0.0])
    area: NonNegative = 20.0  # px, of the false blob; blobs are in order of their area
    replace: bool = False  # the false blob is the only one

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it; raises `ValueError` if `layout` has no bearing."""
        if layout.name == INFRARED.name:
            return [self._row(_FALSE_BLOB, *self.bearing, self.area, self.replace)]
        if layout.name == MARKER.name:
            return [self._row(_BEARING_SHIFT, *self.bearing)]
        raise ValueError(f"false_target: a {layout.name} has no bearing to a target")


@configuration
class Outlier(_Fault):
    """Some measurements point elsewhere: by a fixed angle, in a direction drawn for each.

    All blobs of an infrared measurement are shifted alike; a marker measurement that is
    valid has its bearing turned, its corners stay.
    """

    kind: Literal["outlier"] = "outlier"
    probability: Probability = 0.1  # that a measurement is an outlier
    size: NonNegative = 0.1  # 1, shift of the tangents x/z and y/z in C

    def rows(self, layout: Layout) -> list[list[float]]:
        """The fault as `inject` reads it; raises `ValueError` if `layout` has no bearing."""
        if layout.name not in (INFRARED.name, MARKER.name):
            raise ValueError(f"outlier: a {layout.name} has no bearing to a target")
        blobs = layout.name == INFRARED.name
        return [self._row(_OUTLIER, self.probability, self.size, blobs)]


Fault = Annotated[
    RandomDrop
    | PeriodicDrop
    | PermanentDrop
    | BelowDrop
    | AboveDrop
    | WindowsDrop
    | Bias
    | Freeze
    | FalseTarget
    | Outlier,
    Field(discriminator="kind"),
]

MAXIMUM_ROWS = 32


@configuration
class FaultInjectorConfig:
    """What goes wrong with a sensor."""

    faults: list[Fault] = Field(default_factory=list)  # act in this order
    target: Annotated[int, Field(ge=0)] = 0  # bit by which commands address this sensor; 0 none
    # s, at most the sensor's, or measurements are lost unseen
    period: Annotated[float, Field(ge=PLANT_PERIOD), AfterValidator(on_grid)] = PLANT_PERIOD

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, layout: Layout
    ) -> "FaultInjector":
        """Add a `FaultInjector` for `layout`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, FaultInjector(self, seed, layout=layout, stream=name))


# The columns of a fault's row.
_KIND, _START, _END, _FIRST_ATTEMPT, _LAST_ATTEMPT, _LANDING, _A, _B, _C, _D = range(10)
# The memory: these, the counters of the faults, then the held fields from the valid flag on.
_SEEN, _COMMAND_TIME, _R_DROP, _P_KEEP, _P_DROP, _COMMAND_COUNT, _HAS_HELD = range(7)
_COUNTERS = 7
_HELD = _COUNTERS + MAXIMUM_ROWS

_COUNT = INFRARED.index("count")
_BLOB = INFRARED.index("blob_0_x")
_BEARING = MARKER.index("bearing_C_x")

_TIME, _TARGET = FAULT_COMMAND.index("time"), FAULT_COMMAND.index("target")
_BODY_Z, _PAD_Z = BODY_STATE.index("p_WB_z"), PAD_STATE.index("p_WP_z")
_ATTEMPTS = SUPERVISOR_STATUS.index("attempts")
_LANDING_STARTED = SUPERVISOR_STATUS.index("landing_started")

_OUTPUT, _MEMORY = range(2)  # groups of the discrete state


@njit(cache=True)
def _add_blob(measurement, x, y, area, replace):
    count = 0 if replace or measurement[VALID] == 0.0 else int(measurement[_COUNT])
    rank = 0
    while rank < count and measurement[_BLOB + 3 * rank + 2] >= area:
        rank += 1
    if rank == INFRARED_BLOBS:
        return
    for i in range(min(count, INFRARED_BLOBS - 1), rank, -1):
        to = _BLOB + 3 * i
        measurement[to : to + 3] = measurement[to - 3 : to].copy()
    start = _BLOB + 3 * rank
    measurement[start], measurement[start + 1], measurement[start + 2] = x, y, area
    count = min(count + 1, INFRARED_BLOBS)
    measurement[_COUNT] = count
    measurement[_BLOB + 3 * count : _BLOB + 3 * INFRARED_BLOBS] = 0.0
    measurement[VALID] = 1.0


@njit(cache=True)
def _turn_bearing(measurement, dx, dy):
    bearing = measurement[_BEARING : _BEARING + 3]
    if measurement[VALID] == 0.0 or bearing[2] <= 0.0:
        return
    x, y = bearing[0] / bearing[2] + dx, bearing[1] / bearing[2] + dy
    length = math.sqrt(x * x + y * y + 1.0)
    bearing[0], bearing[1], bearing[2] = x / length, y / length, 1.0 / length


@njit(cache=True)
def _shift_blobs(measurement, dx, dy):
    if measurement[VALID] == 0.0:
        return
    for i in range(int(measurement[_COUNT])):
        measurement[_BLOB + 3 * i] += dx
        measurement[_BLOB + 3 * i + 1] += dy


@njit(cache=True)
def _in_drop_phase(count, keep, drop):
    """Whether the value after `count` others is dropped: `keep` are kept, then `drop` dropped."""
    return drop > 0.0 and count % (keep + drop) >= keep


@njit(cache=True)
def inject(time, measurement, height, attempts, landing_started, rows, keys, output, memory):
    """Pass one new measurement on with its faults, or drop it.

    Parameters
    ----------
    time : float
        s, now.
    measurement : array of shape (size,)
        Changed in place.
    height : float
        m, above the pad; read where a fault depends on it.
    attempts, landing_started : float
        From the supervisor's status; read where a fault depends on them.
    rows : array of shape (number of rows, 10)
        The faults.
    keys : array of np.uint64, shape (2,)
        Of the streams of configured and commanded random drops.
    output : array of shape (size,)
        Becomes the measurement unless it is dropped.
    memory : array of shape (39 + size - 3,)
        Changed in place.

    Returns
    -------
    bool
        Whether the measurement was passed on.
    """
    number = int(measurement[SEQUENCE_NUMBER])
    valid = measurement[VALID] != 0.0
    untouched = measurement[VALID:].copy()
    dropped = False
    frozen = False
    for i in range(rows.shape[0]):
        row = rows[i]
        if time < row[_START] or time >= row[_END]:
            continue
        if attempts < row[_FIRST_ATTEMPT] or attempts > row[_LAST_ATTEMPT]:
            continue
        if row[_LANDING] != 0.0 and landing_started < 0.0:
            continue
        kind = row[_KIND]
        if kind == _RANDOM:
            dropped |= uniform(keys[0], number, i) < row[_A]
        elif kind == _PERIODIC:
            dropped |= _in_drop_phase(memory[_COUNTERS + i], row[_A], row[_B])
            memory[_COUNTERS + i] += valid
        elif kind == _ALWAYS:
            dropped = True
        elif kind == _BELOW:
            if height <= row[_A]:
                if memory[_COUNTERS + i] == 0.0:
                    memory[_COUNTERS + i] = time
                dropped |= time - memory[_COUNTERS + i] < row[_B]
        elif kind == _ABOVE:
            dropped |= height >= row[_A]
        elif kind == _BIAS:
            measurement[int(row[_A])] += row[_B]
        elif kind == _FREEZE:
            frozen = True
            if memory[_HAS_HELD] != 0.0:
                measurement[VALID:] = memory[_HELD:]
        elif kind == _FALSE_BLOB:
            _add_blob(measurement, row[_A], row[_B], row[_C], row[_D] != 0.0)
        elif kind == _BEARING_SHIFT:
            _turn_bearing(measurement, row[_A], row[_B])
        elif kind == _OUTLIER and uniform(keys[0], number, i) < row[_A]:
            angle = 2.0 * math.pi * uniform(keys[0], number, MAXIMUM_ROWS + i)
            dx, dy = row[_B] * math.cos(angle), row[_B] * math.sin(angle)
            if row[_C] != 0.0:
                _shift_blobs(measurement, dx, dy)
            else:
                _turn_bearing(measurement, dx, dy)
    if not frozen or memory[_HAS_HELD] == 0.0:
        memory[_HELD:] = untouched
        memory[_HAS_HELD] = 1.0

    if memory[_R_DROP] > 0.0:
        dropped |= uniform(keys[1], number, 0) < memory[_R_DROP]
    else:
        dropped |= _in_drop_phase(memory[_COMMAND_COUNT], memory[_P_KEEP], memory[_P_DROP])
        memory[_COMMAND_COUNT] += valid
    if not dropped:
        output[:] = measurement
        output[TIME_OF_ARRIVAL] = time
    return not dropped


class FaultInjector(LeafSystem):
    """Drops or distorts the measurements of one sensor, as configured and as commanded in flight.

    .. pydrake_system::

        name: FaultInjector
        input_ports:
        - measurement
        - body (optional)
        - pad (optional)
        - supervisor (optional)
        - command (optional)
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `measurement` | any measurement layout | before (input) and after (output) the faults |
    | `body` (optional) | `BODY_STATE` | needed by `below` and `above`, otherwise unread |
    | `pad` (optional) | `PAD_STATE` | for the height above it; unconnected: at W's origin |
    | `supervisor` (optional) | `SUPERVISOR_STATUS` | needed by faults tied to attempts or landing |
    | `command` (optional) | `FAULT_COMMAND` | unconnected: no commands |

    A dropped measurement does not change the output, so the consumer sees no new
    arrival. A measurement that passes has the time of the event as its
    `time_of_arrival`. Measurements without a detection (valid 0) are dropped like
    the others but do not advance a periodic fault, which counts sensor values.

    The configured faults act in their order, each while its time window
    [start_time, end_time), its attempts [from_attempt, until_attempt] and
    `while_landing` hold:

        random      dropped if u(seed, stream, n) < probability
        periodic    dropped if count mod (keep + drop) ≥ keep
        permanent   dropped
        below       dropped if h ≤ height,  h = p_WB.z − p_WP.z,  for `duration` at most
        above       dropped if h ≥ height
        windows     dropped if start ≤ t < end of one of them
        bias        field += offset
        freeze      fields and valid flag := those before the first frozen measurement
        false_target  a blob more, or bearing (x/z, y/z) += (dx, dy)
        outlier     with `probability` all bearings += size (cos φ, sin φ),  φ = 2π u(seed, n)

    A command has the meaning of the message in "Precision landing with infrared and
    marker sensors", section 7.2 and table 1: if its `target` has this sensor's bit,
    it replaces the commanded mode; r_drop > 0 is the random mode (1 drops all);
    otherwise p_keep values are kept, then p_drop dropped; p_keep = 0 with
    p_drop > 0 drops all; all three zero end it. Commands for other sensors are
    ignored. A command has no say over the configured faults. Commands must be at
    least one period apart.

    | event | when | does |
    |---|---|---|
    | update | every `period` (10 ms by default) from 0 | obeys, passes, drops |

    The sensor's sample at t passes at t + period, as from any block to another. A
    `DelayLine` behind the injector absorbs that, because it counts latency from
    the time of validity.

    Parameters
    ----------
    config : FaultInjectorConfig
        `faults` may change from run to run; `period` may not.
    seed : int
    layout : Layout
        Of the measurement.
    stream : str
        The name of the random stream.

    Raises
    ------
    ValueError
        If a fault does not fit the layout, or the faults take more than 32 rows
        (one each, but one per window and one per biased field).
    """

    def __init__(
        self,
        config: FaultInjectorConfig,
        seed: int = 0,
        *,
        layout: Layout,
        stream: str = "fault_injector",
    ):
        super().__init__()
        self._config = config
        self._layout = layout
        self._stream = stream
        self.configure(config, seed)
        self._measurement = self.DeclareVectorInputPort("measurement", layout.size).Eval
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size)
        self._pad = self.DeclareVectorInputPort("pad", PAD_STATE.size)
        self._supervisor = self.DeclareVectorInputPort("supervisor", SUPERVISOR_STATUS.size)
        self._command = self.DeclareVectorInputPort("command", FAULT_COMMAND.size)
        initial = np.zeros(_HELD + layout.size - VALID)
        initial[_SEEN] = initial[_COMMAND_TIME] = -1.0
        output = self.DeclareDiscreteState(no_measurement(layout))
        self.DeclareDiscreteState(initial)
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)

    def configure(self, config: FaultInjectorConfig, seed: int) -> None:
        """Take over a new configuration; `period` must stay as it is."""
        require_same_structure(self._config, config, "period")
        rows = [row for fault in config.faults for row in fault.rows(self._layout)]
        if len(rows) > MAXIMUM_ROWS:
            raise ValueError(f"the faults take {len(rows)} rows, more than {MAXIMUM_ROWS}")
        self._config = config
        self._target = config.target
        self._rows = np.array(rows, dtype=float).reshape(len(rows), _D + 1)
        self._keys = np.array(
            [stream_key(seed, f"{self._stream}.{name}") for name in ("random", "command")]
        )
        bound = (
            (self._rows[:, _FIRST_ATTEMPT] > 0.0)
            | (self._rows[:, _LAST_ATTEMPT] < math.inf)
            | (self._rows[:, _LANDING] != 0.0)
        )
        self._needs_supervisor = bool(bound.any())
        self._needs_height = bool(np.isin(self._rows[:, _KIND], (_BELOW, _ABOVE)).any())

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        memory = discrete_state.get_mutable_value(_MEMORY)
        if self._target:
            command = self.EvalVectorInput(context, 4)
            if command is not None:
                self._obey(command.get_value(), memory)
        measurement = self._measurement(context)
        if measurement[TIME_OF_ARRIVAL] == memory[_SEEN]:
            return
        memory[_SEEN] = measurement[TIME_OF_ARRIVAL]
        height = attempts = 0.0
        landing_started = -1.0
        if self._needs_height:
            height = self._body.Eval(context)[_BODY_Z]
            if self._pad.HasValue(context):
                height -= self._pad.Eval(context)[_PAD_Z]
        if self._needs_supervisor:
            supervisor = self._supervisor.Eval(context)
            attempts, landing_started = supervisor[_ATTEMPTS], supervisor[_LANDING_STARTED]
        inject(
            context.get_time(),
            measurement,  # a copy, which the faults may change
            height,
            attempts,
            landing_started,
            self._rows,
            self._keys,
            discrete_state.get_mutable_value(_OUTPUT),
            memory,
        )

    def _obey(self, command: np.ndarray, memory: np.ndarray) -> None:
        """Take over a command if it is new."""
        if command[_TIME] == memory[_COMMAND_TIME]:
            return
        memory[_COMMAND_TIME] = command[_TIME]
        if int(command[_TARGET]) & self._target:
            memory[_R_DROP : _P_DROP + 1] = command[_TARGET + 1 :]
            memory[_COMMAND_COUNT] = 0.0

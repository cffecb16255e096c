"""Systems under test between recorded inputs and a log of their output."""

from collections.abc import Mapping

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from systems.schedule import BASE_PERIOD
from systems.signals.measurement import TIME_OF_ARRIVAL, Layout

_TOLERANCE = 1e-9  # s


class Playback(LeafSystem):
    """Outputs row i of `rows` (shape (n, size)) from the tick at `times[i]` (s, rising) on.

    Before the first it outputs `initial`, or the first row if there is no `initial`.
    """

    def __init__(self, times: np.ndarray, rows: np.ndarray, initial: np.ndarray | None = None):
        super().__init__()
        self._times, self._rows = np.asarray(times), np.asarray(rows, dtype=float)
        state = self.DeclareDiscreteState(self._rows[0] if initial is None else initial)
        self.DeclareStateOutputPort("output", state)
        self.DeclarePeriodicDiscreteUpdateEvent(BASE_PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        i = np.searchsorted(self._times, context.get_time() + _TOLERANCE) - 1
        if i < 0:
            return EventStatus.DidNothing()
        discrete_state.set_value(self._rows[i])
        return EventStatus.Succeeded()


def samples(layout: Layout, period: float, count: int, fields: float = 0.0) -> np.ndarray:
    """`count` measurements, one every `period` (s), valid, with all fields at `fields`."""
    rows = np.full((count, layout.size), fields)
    rows[:, 0] = rows[:, 1] = period * np.arange(count)
    rows[:, 2] = np.arange(count)
    rows[:, 3] = 1.0
    return rows


class Bench:
    """A system with constants or a `Playback` at its inputs and a log of its one output.

    Parameters
    ----------
    system : LeafSystem
    inputs : mapping of str to array or Playback
        By port; a port that is not named stays unconnected.
    log_period : float
        s.
    """

    def __init__(
        self,
        system: LeafSystem,
        inputs: Mapping[str, np.ndarray | Playback],
        log_period: float = BASE_PERIOD,
    ):
        builder = DiagramBuilder()
        builder.AddSystem(system)
        for port, value in inputs.items():
            source = value if isinstance(value, LeafSystem) else ConstantVectorSource(value)
            builder.AddSystem(source)
            builder.Connect(source.get_output_port(), system.GetInputPort(port))
        self.system = system
        self._log = LogVectorOutput(system.get_output_port(), builder, log_period)
        self.simulator = Simulator(builder.Build())

    @property
    def context(self) -> Context:
        """The context of the system under test."""
        root = self.simulator.get_context()
        return self.system.GetMyContextFromRoot(root)

    def advance_to(self, time: float) -> "Bench":
        """Simulate up to `time` (s)."""
        self.simulator.AdvanceTo(time)
        return self

    def values(self) -> np.ndarray:
        """The logged output, shape (ticks, size)."""
        return self._log.FindLog(self.simulator.get_context()).data().T

    def times(self) -> np.ndarray:
        """When it was logged, shape (ticks,), s."""
        return self._log.FindLog(self.simulator.get_context()).sample_times()

    def arrivals(self) -> np.ndarray:
        """The measurements in the log, each once, shape (n, size)."""
        values = self.values()
        arrival = values[:, TIME_OF_ARRIVAL]
        return values[np.flatnonzero(np.diff(arrival, prepend=-1.0))]

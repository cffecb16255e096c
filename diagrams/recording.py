"""Which ports of a diagram are recorded, and under which names."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import LogVectorOutput, Multiplexer, VectorLogSink

from systems.signals.measurement import TIME_OF_ARRIVAL, Layout


@dataclass(frozen=True)
class RecordedPort:
    """One recorded port: its name in the log and the names of its entries."""

    name: str
    fields: Sequence[str]
    port: OutputPort
    period: float  # s

    @property
    def is_measurement(self) -> bool:
        """Whether one row an arrival is kept instead of one a period."""
        return "time_of_arrival" in self.fields


class Recording:
    """The recorded ports of one diagram; the samples themselves live in the Context.

    Every system costs Drake time at every step, so ports of one period share one
    multiplexer and one sink.
    """

    def __init__(self) -> None:
        self.ports: list[RecordedPort] = []
        self._sinks: dict[float, VectorLogSink] = {}

    def add(
        self, port: OutputPort, name: str, layout: Layout | Sequence[str], period: float
    ) -> None:
        """Record `port` every `period` seconds.

        Parameters
        ----------
        port : OutputPort
            A vector port of the root diagram.
        name : str
            The prefix of the log's columns: `name.field`.
        layout : Layout or sequence of str
            The names of the port's entries. A measurement (a layout with the header)
            is kept once an arrival, so `period` should not exceed its shortest interval.
        period : float
            s, a power of two times the base period.
        """
        fields = layout.fields if isinstance(layout, Layout) else tuple(layout)
        if len(fields) != port.size():
            raise ValueError(f"{name}: {len(fields)} names for a port of {port.size()}")
        self.ports.append(RecordedPort(name, fields, port, period))

    def connect(self, builder: DiagramBuilder) -> None:
        """Add the sinks of all ports to the root diagram's builder."""
        for period in sorted({port.period for port in self.ports}):
            ports = self._of_period(period)
            gather = Multiplexer([len(port.fields) for port in ports])
            builder.AddNamedSystem(f"record {period * 1e3:g} ms", gather)
            for index, port in enumerate(ports):
                builder.Connect(port.port, gather.get_input_port(index))
            sink = LogVectorOutput(gather.get_output_port(), builder, publish_period=period)
            sink.set_name(f"log {period * 1e3:g} ms")
            self._sinks[period] = sink

    def samples(self, context: Context) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """What was recorded so far.

        Returns
        -------
        dict
            For each port its times, shape (n,) in s, and its values, shape (n, size);
            measurements only where a new one had arrived.
        """
        recorded = {}
        for period, sink in self._sinks.items():
            log = sink.FindLog(context)
            times, values = log.sample_times().copy(), log.data().T.copy()
            # A simulator that goes on from a context records the present once more.
            first = np.diff(times, prepend=-1.0) > 0.0
            start = 0
            for port in self._of_period(period):
                own = values[:, start : start + len(port.fields)]
                start += len(port.fields)
                keep = first
                if port.is_measurement:
                    arrival = own[:, TIME_OF_ARRIVAL]
                    keep = first & (arrival >= 0.0) & (np.diff(arrival, prepend=-1.0) != 0.0)
                recorded[port.name] = (times[keep], own[keep])
        return {port.name: recorded[port.name] for port in self.ports}

    def _of_period(self, period: float) -> list[RecordedPort]:
        return [port for port in self.ports if port.period == period]

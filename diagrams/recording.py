"""Which ports of a diagram are recorded, and under which names."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from systems.signals.measurement import TIME_OF_ARRIVAL, Layout


@dataclass(frozen=True)
class RecordedPort:
    """One recorded port: its name in the log, the names of its entries, its sink."""

    name: str
    fields: Sequence[str]
    is_measurement: bool  # keep one row an arrival instead of one a period
    sink: VectorLogSink


class Recording:
    """The recorded ports of one diagram; the samples themselves live in the Context."""

    def __init__(self) -> None:
        self.ports: list[RecordedPort] = []

    def add(
        self,
        builder: DiagramBuilder,
        port: OutputPort,
        name: str,
        layout: Layout | Sequence[str],
        period: float,
    ) -> None:
        """Record `port` every `period` seconds.

        Parameters
        ----------
        builder : DiagramBuilder
            Of the diagram that owns `port`.
        port : OutputPort
            A vector port.
        name : str
            The prefix of the log's columns: `name.field`.
        layout : Layout or sequence of str
            The names of the port's entries. A measurement (a layout with the header)
            is kept once an arrival.
        period : float
            s, a power of two times the base period.
        """
        fields = layout.fields if isinstance(layout, Layout) else tuple(layout)
        if len(fields) != port.size():
            raise ValueError(f"{name}: {len(fields)} names for a port of {port.size()}")
        sink = LogVectorOutput(port, builder, publish_period=period)
        sink.set_name(f"log {name}")
        is_measurement = "time_of_arrival" in fields
        self.ports.append(RecordedPort(name, fields, is_measurement, sink))

    def samples(self, context: Context) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """What was recorded so far.

        Returns
        -------
        dict
            For each port its times, shape (n,) in s, and its values, shape (n, size);
            measurements only where a new one had arrived.
        """
        recorded = {}
        for port in self.ports:
            log = port.sink.FindLog(context)
            times, values = log.sample_times(), log.data().T
            keep = np.append(np.diff(times) > 0.0, True)[: len(times)]
            if port.is_measurement and len(times):
                arrival = values[:, TIME_OF_ARRIVAL]
                new = np.diff(arrival, prepend=-1.0) != 0.0
                keep &= new & (arrival >= 0.0)
            recorded[port.name] = (times[keep].copy(), values[keep].copy())
        return recorded

    def clear(self, context: Context) -> None:
        """Forget all samples in `context`."""
        for port in self.ports:
            port.sink.FindMutableLog(context).Clear()

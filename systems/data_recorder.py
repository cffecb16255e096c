"""The companion computer's data recorder: some ports, 25 times a second, as CSV."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.configuration import Positive, configuration, require_same_structure
from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import Layout

_EARLY = 1e-6  # s, by which a look at the clock may be early


@configuration
class DataRecorderConfig:
    """Where and how often."""

    # Of the file; empty: `companion.csv` in the run's folder, and nothing where a run has none
    path: str = ""
    rate: Positive = Field(default=25.0, le=1.0 / CLOCK_PERIOD)  # 1/s; SVGS paper, section 2.5.5

    def add_to(
        self,
        builder: DiagramBuilder,
        name: str,
        seed: int = 0,
        *,
        ports: Mapping[str, Layout | Sequence[str]],
    ) -> "DataRecorder":
        """Add a recorder called `name` to `builder`."""
        return builder.AddNamedSystem(name, DataRecorder(self, seed, ports=ports))


class DataRecorder(LeafSystem):
    """Writes what its inputs show into a CSV file while the simulation runs.

    .. pydrake_system::
        name: DataRecorder
        input_ports:
        - one of each name in `ports`
        output_ports: []

    | port | layout | meaning |
    |---|---|---|
    | each name in `ports` (optional) | its layout | a row's part; unconnected: empty cells |

    The node `data_recording_drspider` of "High-altitude precision landing by SVGS" (Drones 8, 37,
    2024, section 2.5.5). The first line names the columns: `time`, then `port.field`. The file is
    the run's output, not its state: it begins anew when a simulation is initialised, and one
    that is resumed adds to it. How far the recording has come is in the Context.

    | event | when | does |
    |---|---|---|
    | begin | at initialisation | an empty file with the first line |
    | update | every 20 ms from 0 | a row, if 1 / rate has passed |

    Parameters
    ----------
    config : DataRecorderConfig
    seed : int
        Not used, for uniformity.
    ports : mapping of str to Layout or names
        The names of the ports and of their entries.
    """

    def __init__(
        self,
        config: DataRecorderConfig,
        seed: int = 0,
        *,
        ports: Mapping[str, Layout | Sequence[str]],
    ):
        super().__init__()
        self.config = config
        self.columns = ["time"]
        self._sizes = []
        for name, layout in ports.items():
            fields = layout.fields if isinstance(layout, Layout) else tuple(layout)
            self.DeclareVectorInputPort(name, len(fields))
            self.columns += [f"{name}.{field}" for field in fields]
            self._sizes.append(len(fields))
        self.DeclareDiscreteState(1)  # s, when the next row is due
        self.DeclareInitializationPublishEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(CLOCK_PERIOD, 0.0, self._update)

    def configure(self, config: DataRecorderConfig, seed: int = 0) -> None:
        """Take over another configuration; the rate must stay."""
        require_same_structure(self.config, config, "rate")
        self.config = config

    def _begin(self, context: Context) -> EventStatus:
        if self.config.path:
            self._write(self.columns, "w")
        return EventStatus.Succeeded()

    def _write(self, row: Sequence[Any], mode: str) -> None:
        with Path(self.config.path).open(mode, encoding="utf-8", newline="") as file:
            csv.writer(file).writerow(row)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        due = context.get_discrete_state(0).value()[0]
        now = context.get_time()
        if not self.config.path or now < due - _EARLY:
            return EventStatus.DidNothing()
        period = 1.0 / self.config.rate
        discrete_state.get_mutable_value(0)[0] = due + (1 + int((now - due) / period)) * period
        row: list[Any] = [f"{now:.3f}"]
        for index, size in enumerate(self._sizes):
            value = self.EvalVectorInput(context, index)
            if value is None:
                row += size * [""]
            else:
                row += value.get_value().tolist()
        self._write(row, "a")
        return EventStatus.Succeeded()

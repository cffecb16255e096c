"""What ArduPilot's and PX4's landing-target estimators share: one front end, one kind of filter."""

from collections.abc import Callable
from typing import Any

from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.estimators.fused_sensor import POLL_PERIOD, no_target
from systems.signals.measurement import TARGET_MEASUREMENT, VEHICLE_ESTIMATE, Layout


class TargetFilter(LeafSystem):
    """A filter of the front end's measurements: one compiled step every 20 ms.

    A subclass sets the class attributes, defines `configure` and documents its ports, which are
    `measurement` (`TARGET_MEASUREMENT`), `estimate` (`VEHICLE_ESTIMATE`) and `target`
    (`TARGET_ESTIMATE`).

    Attributes
    ----------
    memory : Layout
        What is remembered from step to step; `last_arrival` begins at −1, the rest at 0.
    step : callable
        Compiled: (target, memory, time, measurement, estimate, parameters), the first two
        changed in place.
    """

    memory: Layout
    step: Callable[..., None]

    def __init__(self, config: Any, seed: int = 0):
        """A filter; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        self._measurement = self.DeclareVectorInputPort("measurement", TARGET_MEASUREMENT.size).Eval
        self._estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size).Eval
        memory = self.memory.zeros()
        memory[self.memory.index("last_arrival")] = -1.0
        target = self.DeclareDiscreteState(BasicVector(no_target()))
        self.DeclareDiscreteState(BasicVector(memory))
        self.DeclareStateOutputPort("target", target)
        self.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, self._update)

    def configure(self, config: Any, seed: int = 0) -> None:
        """Take over a new configuration: set `_parameters`, the step's flat parameters."""
        raise TypeError(f"{type(self).__name__} does not say how it is configured")

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        self.step(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            context.get_time(),
            self._measurement(context),
            self._estimate(context),
            self._parameters,
        )


class TargetEstimator(Diagram):
    """The fused sensor front end, then a filter.

    .. pydrake_system::
        name: TargetEstimator
        input_ports:
        - infrared (optional)
        - marker (optional)
        - range_finder (optional)
        - estimate
        output_ports:
        - target
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `infrared` (optional) | `INFRARED` | as in `FusedSensor` |
    | `marker` (optional) | `MARKER` | as in `FusedSensor` |
    | `range_finder` (optional) | `RANGE_FINDER` | as in `FusedSensor` |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle as its navigation filter knows it |
    | `target` | `TARGET_ESTIMATE` | the landing target |
    | `measurement` | `TARGET_MEASUREMENT` | what the front end gave the filter |

    Parameters
    ----------
    target_filter : TargetFilter
        Built from `config`.
    config : dataclass
        Of the filter; its `front_end` is the front end's.
    seed : int
        For uniformity: nothing here draws random numbers.
    """

    def __init__(self, target_filter: TargetFilter, config: Any, seed: int = 0):
        super().__init__()
        self._filter = target_filter
        builder = DiagramBuilder()
        self._front_end = config.front_end.add_to(builder, "front_end", seed)
        builder.AddNamedSystem("filter", target_filter)
        measurement = self._front_end.GetOutputPort("measurement")
        builder.Connect(measurement, target_filter.GetInputPort("measurement"))
        for name in ("infrared", "marker", "range_finder", "estimate"):
            builder.ExportInput(self._front_end.GetInputPort(name), name)
        builder.ConnectInput("estimate", target_filter.GetInputPort("estimate"))
        builder.ExportOutput(target_filter.GetOutputPort("target"), "target")
        builder.ExportOutput(measurement, "measurement")
        builder.BuildInto(self)

    def configure(self, config: Any, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self._filter.configure(config, seed)
        self._front_end.configure(config.front_end, seed)

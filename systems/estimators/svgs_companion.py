"""What the companion computer makes of SVGS packets: a landing target, and external vision."""

from typing import Literal

from pydantic import Field
from pydrake.systems.framework import Diagram, DiagramBuilder

from systems.configuration import configuration
from systems.estimators.svgs_companion_deserializer import SvgsDeserializerConfig
from systems.estimators.svgs_companion_filter import SvgsFilterConfig
from systems.estimators.svgs_companion_transformations import SvgsTransformationsConfig


@configuration
class SvgsCompanionConfig:
    """The three nodes behind the phone."""

    kind: Literal["svgs"] = "svgs"
    deserializer: SvgsDeserializerConfig = Field(default_factory=SvgsDeserializerConfig)
    transformations: SvgsTransformationsConfig = Field(default_factory=SvgsTransformationsConfig)
    filter: SvgsFilterConfig = Field(default_factory=SvgsFilterConfig)

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "SvgsCompanion":
        """Add a companion computer called `name` to `builder`."""
        return builder.AddNamedSystem(name, SvgsCompanion(self, seed))


class SvgsCompanion(Diagram):
    """Deserialiser, transformations and filter of the SVGS paper's companion computer.

    .. pydrake_system::
        name: SvgsCompanion
        input_ports:
        - svgs
        - estimate
        output_ports:
        - target
        - measurement
        - external_vision

    | port | layout | meaning |
    |---|---|---|
    | `svgs` | `SVGS` | packets of the phone, as they arrive |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle as the navigation filter knows it |
    | `target` | `TARGET_ESTIMATE` | the landing target, for guidance |
    | `measurement` | `TARGET_MEASUREMENT` | one sighting of it |
    | `external_vision` | `EXTERNAL_VISION` | the vehicle's position, for the navigation filter |

    A packet takes one period of 20 ms in each node.
    """

    def __init__(self, config: SvgsCompanionConfig, seed: int = 0):
        """A companion computer; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        builder = DiagramBuilder()
        self.deserializer = config.deserializer.add_to(builder, "svgs_deserializer", seed)
        self.transformations = config.transformations.add_to(builder, "transformations", seed)
        self.filter = config.filter.add_to(builder, "filter", seed)
        pose, measurement = "pose", "measurement"
        builder.Connect(
            self.deserializer.GetOutputPort(pose), self.transformations.GetInputPort(pose)
        )
        builder.Connect(
            self.transformations.GetOutputPort(measurement), self.filter.GetInputPort(measurement)
        )
        builder.ExportInput(self.deserializer.GetInputPort("svgs"), "svgs")
        estimate = builder.ExportInput(self.transformations.GetInputPort("estimate"), "estimate")
        builder.ConnectInput(estimate, self.filter.GetInputPort("estimate"))
        builder.ExportOutput(self.filter.GetOutputPort("target"), "target")
        builder.ExportOutput(self.transformations.GetOutputPort(measurement), measurement)
        builder.ExportOutput(self.filter.GetOutputPort("external_vision"), "external_vision")
        builder.BuildInto(self)

    def configure(self, config: SvgsCompanionConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.deserializer.configure(config.deserializer, seed)
        self.transformations.configure(config.transformations, seed)
        self.filter.configure(config.filter, seed)

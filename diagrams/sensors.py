"""Every sensor as one named diagram: sensor, then injected faults if any, then latency."""

from typing import Any

from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System

from diagrams.blocks import Blocks
from systems.signals.fault_injector import FAULT_COMMAND
from systems.signals.measurement import (
    BODY_STATE,
    GNSS,
    INFRARED,
    MARKER,
    PAD_STATE,
    SUPERVISOR_STATUS,
    SVGS,
    Layout,
)

# Name of the channel, path in the scenario, layout, options of the sensor: those with faults and
# latency behind them.
CHANNELS: tuple[tuple[str, str, Layout, dict[str, Any]], ...] = (
    ("gnss", "sensors.gnss", GNSS, {}),
    ("marker", "sensors.marker_camera", MARKER, {}),
    ("infrared", "sensors.infrared_camera", INFRARED, {}),
    ("svgs", "sensors.svgs_camera", SVGS, {}),
    ("pad_gnss", "sensors.pad_gnss", GNSS, {"carrier": "pad"}),
)
DIRECT = ("imu", "imu_2", "imu_3", "barometer", "magnetometer", "range_finder")


def sensors(blocks: Blocks) -> Diagram:
    """The sensors.

    Exports the inputs `body`, `pad`, `supervisor`, `fault_command` and one output a
    sensor that the scenario has: `imu`, `imu_2`, `imu_3`, `gnss`, `barometer`,
    `magnetometer`, `range_finder`, `marker`, `infrared`, `svgs`, `pad_gnss`.
    """
    builder = DiagramBuilder()
    shared = _SharedInputs(builder)
    for name in DIRECT:
        sensor = blocks.add(builder, f"sensors.{name}", name)
        if sensor is not None:
            shared.connect(sensor)
            builder.ExportOutput(sensor.GetOutputPort("measurement"), name)
    for name, path, layout, options in CHANNELS:
        called = name if layout is GNSS else f"{name} camera"
        sensor = blocks.add(builder, f"{path}.sensor", called, **options)
        if sensor is None:
            continue
        shared.connect(sensor)
        port = sensor.GetOutputPort("measurement")
        faults = blocks.add(builder, f"{path}.faults", f"{name} faults", layout=layout)
        if faults is not None:
            builder.Connect(port, faults.GetInputPort("measurement"))
            shared.connect(faults)
            port = faults.GetOutputPort("measurement")
        builder.ExportOutput(_delayed(builder, blocks, name, path, layout, port), name)
    diagram = builder.Build()
    diagram.set_name("sensors")
    return diagram


class _SharedInputs:
    """Exports each input of the diagram once and connects it to all who have one of that name."""

    SIZES = {  # noqa: RUF012 (a constant)
        "body": BODY_STATE.size,
        "pad": PAD_STATE.size,
        "supervisor": SUPERVISOR_STATUS.size,
        "command": FAULT_COMMAND.size,
    }
    NAMES = {"command": "fault_command"}  # noqa: RUF012

    def __init__(self, builder: DiagramBuilder):
        self._builder = builder
        self._exported: dict[str, int] = {}

    def connect(self, system: System) -> None:
        for name in self.SIZES:
            if not system.HasInputPort(name):
                continue
            port = system.GetInputPort(name)
            if name in self._exported:
                self._builder.ConnectInput(self._exported[name], port)
            else:
                exported = self.NAMES.get(name, name)
                self._exported[name] = self._builder.ExportInput(port, exported)


def _delayed(
    builder: DiagramBuilder,
    blocks: Blocks,
    name: str,
    path: str,
    layout: Layout,
    port: OutputPort,
) -> OutputPort:
    """The output of a delay line behind `port`."""
    line = blocks.add(builder, f"{path}.latency", f"{name} latency", layout=layout)
    builder.Connect(port, line.GetInputPort("measurement"))
    return line.GetOutputPort("measurement")

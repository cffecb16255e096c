"""The SVGS paper's companion computer as one diagram, node by node."""

from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort

from systems.data_recorder import DataRecorderConfig
from systems.estimators.svgs_companion import SvgsCompanionConfig
from systems.signals.measurement import (
    EXTERNAL_VISION,
    SETPOINT,
    SUPERVISOR_STATUS,
    SVGS,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    Layout,
)
from systems.supervisors.landing_supervisor import LandingSupervisorConfig

# What the node data_recording_drspider keeps: sensors, SVGS measurements, setpoints.
RECORDED: dict[str, Layout] = {
    "estimate": VEHICLE_ESTIMATE,
    "svgs": SVGS,
    "target_measurement": TARGET_MEASUREMENT,
    "target": TARGET_ESTIMATE,
    "external_vision": EXTERNAL_VISION,
    "setpoint": SETPOINT,
    "supervisor": SUPERVISOR_STATUS,
}


def companion_computer(
    landing_target: SvgsCompanionConfig,
    guidance: LandingSupervisorConfig,
    recorder: DataRecorderConfig | None = None,
    seed: int = 0,
) -> Diagram:
    """Everything that runs on the companion computer, between the phone and the autopilot.

    Its nodes are those of "High-altitude precision landing by SVGS" (Drones 8, 37, 2024, section
    2.5.5): svgs_deserializer, transformations and the Kalman filter in the sub-diagram
    `landing target`; routine_commander, motion_control and px4_control in `guidance`; and
    data_recording.

    Exports the inputs `svgs`, `estimate`, `rotor_commands` and the outputs `target`,
    `external_vision`, `setpoint`, `status`.

    Parameters
    ----------
    landing_target : SvgsCompanionConfig
    guidance : LandingSupervisorConfig
        With a routine of the kind `svgs`.
    recorder : DataRecorderConfig, optional
        None: nothing is recorded.
    seed : int
    """
    builder = DiagramBuilder()
    target = landing_target.add_to(builder, "landing target", seed)
    supervisor = guidance.add_to(builder, "guidance", seed)
    ports: dict[str, OutputPort] = {
        "target": target.GetOutputPort("target"),
        "target_measurement": target.GetOutputPort("measurement"),
        "external_vision": target.GetOutputPort("external_vision"),
        "setpoint": supervisor.GetOutputPort("setpoint"),
        "supervisor": supervisor.GetOutputPort("status"),
    }
    builder.Connect(ports["target"], supervisor.GetInputPort("target"))
    svgs = builder.ExportInput(target.GetInputPort("svgs"), "svgs")
    estimate = builder.ExportInput(target.GetInputPort("estimate"), "estimate")
    builder.ConnectInput(estimate, supervisor.GetInputPort("estimate"))
    builder.ExportInput(supervisor.GetInputPort("rotor_commands"), "rotor_commands")
    if recorder is not None:
        recording = recorder.add_to(builder, "data_recording", seed, ports=RECORDED)
        for name in RECORDED:
            if name in ports:
                builder.Connect(ports[name], recording.GetInputPort(name))
        builder.ConnectInput(svgs, recording.GetInputPort("svgs"))
        builder.ConnectInput(estimate, recording.GetInputPort("estimate"))
    for name in ("target", "external_vision", "setpoint"):
        builder.ExportOutput(ports[name], name)
    builder.ExportOutput(ports["supervisor"], "status")
    diagram = builder.Build()
    diagram.set_name("companion computer")
    return diagram

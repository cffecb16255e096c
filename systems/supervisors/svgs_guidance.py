"""The SVGS paper's guidance on the companion computer: commander, motion control, px4_control."""

from typing import TYPE_CHECKING

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder

from systems.supervisors.svgs_commander import SvgsCommander
from systems.supervisors.svgs_motion_control import add_motion_control
from systems.supervisors.svgs_px4_control import Px4ControlConfig
from systems.supervisors.svgs_routine import SvgsRoutineConfig

if TYPE_CHECKING:
    from systems.supervisors.landing_supervisor import LandingSupervisorConfig
    from systems.supervisors.state_machine import StateMachine


class SvgsGuidance(Diagram):
    """Guidance with the ports of a `LandingSupervisor`, made of the paper's three nodes.

    .. pydrake_system::
        name: SvgsGuidance
        input_ports:
        - estimate
        - target
        - range_finder (optional)
        - rotor_commands (optional)
        output_ports:
        - setpoint
        - status
        - vehicle_status

    | port | layout | meaning |
    |---|---|---|
    | `estimate` | `VEHICLE_ESTIMATE` | the navigation filter's answer |
    | `target` | `TARGET_ESTIMATE` | the landing target |
    | `range_finder` (optional) | `RANGE_FINDER` | height along the body's axis |
    | `rotor_commands` (optional) | one a rotor | a sign of the ground |
    | `setpoint` | `SETPOINT` | what the controller is asked for, at 30 Hz |
    | `status` | `SUPERVISOR_STATUS` | the state by its index in `machine.table` |
    | `vehicle_status` | `VEHICLE_STATUS` | as in `LandingSupervisor` |

    Attributes
    ----------
    commander : SvgsCommander
    motion_control : SvgsMotionControl
    px4_control : Px4Control
    """

    def __init__(self, config: "LandingSupervisorConfig", seed: int = 0):
        """Guidance; `config.routine` must be of the kind `svgs`."""
        super().__init__()
        builder = DiagramBuilder()
        self.commander = builder.AddNamedSystem("routine_commander", SvgsCommander(config, seed))
        self.motion_control = add_motion_control(
            builder, "motion_control", self._routine(config), seed
        )
        self.px4_control = Px4ControlConfig().add_to(builder, "px4_control", seed)
        for source, output, sink, port in (
            (self.commander, "command", self.motion_control, "command"),
            (self.motion_control, "feedback", self.commander, "feedback"),
            (self.commander, "setpoint", self.px4_control, "mission"),
            (self.motion_control, "setpoint", self.px4_control, "manoeuvre"),
            (self.commander, "command", self.px4_control, "command"),
        ):
            builder.Connect(source.GetOutputPort(output), sink.GetInputPort(port))
        estimate = builder.ExportInput(self.commander.GetInputPort("estimate"), "estimate")
        builder.ConnectInput(estimate, self.motion_control.GetInputPort("estimate"))
        for name in ("target", "range_finder", "rotor_commands"):
            builder.ExportInput(self.commander.GetInputPort(name), name)
        builder.ExportOutput(self.px4_control.GetOutputPort("setpoint"), "setpoint")
        for name in ("status", "vehicle_status"):
            builder.ExportOutput(self.commander.GetOutputPort(name), name)
        builder.BuildInto(self)

    def configure(self, config: "LandingSupervisorConfig", seed: int = 0) -> None:
        """Take over a new configuration; raises `StructureChangedError` as `LandingSupervisor`."""
        self.commander.configure(config, seed)
        self.motion_control.configure(self._routine(config), seed)

    @staticmethod
    def _routine(config: "LandingSupervisorConfig") -> SvgsRoutineConfig:
        if not isinstance(config.routine, SvgsRoutineConfig):
            raise TypeError(f"SvgsGuidance flies the routine svgs, not {config.routine.kind}")
        return config.routine

    @property
    def machine(self) -> "StateMachine":
        """The commander's state machine."""
        return self.commander.machine

    def state_name(self, status: np.ndarray) -> str:
        """The name of the state in a `SUPERVISOR_STATUS`."""
        return self.commander.state_name(status)

    def states_dot(self) -> str:
        """The commander's transition table as DOT text."""
        return self.commander.states_dot()

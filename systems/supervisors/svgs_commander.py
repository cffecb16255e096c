"""The routine commander: the SVGS routine's table, run by the supervisor of every flight."""

from typing import TYPE_CHECKING, Any

from pydrake.systems.framework import BasicVector, Context

from systems.supervisors.landing_supervisor import LandingSupervisor, remembered
from systems.supervisors.situation import Situation
from systems.supervisors.svgs_routine import COMMAND, FEEDBACK, SvgsMemory

if TYPE_CHECKING:
    from systems.supervisors.landing_supervisor import LandingSupervisorConfig


class SvgsCommander(LandingSupervisor):
    """Decides which manoeuvre runs: mission, SVGS routine, touchdown.

    .. pydrake_system::
        name: SvgsCommander
        input_ports:
        - estimate
        - target (optional)
        - range_finder (optional)
        - rotor_commands (optional)
        - feedback
        output_ports:
        - setpoint
        - status
        - vehicle_status
        - command

    | port | layout | meaning |
    |---|---|---|
    | `estimate` | `VEHICLE_ESTIMATE` | as in `LandingSupervisor` |
    | `target` (optional) | `TARGET_ESTIMATE` | the landing target; unconnected: never seen |
    | `range_finder` (optional) | `RANGE_FINDER` | as in `LandingSupervisor` |
    | `rotor_commands` (optional) | one a rotor | as in `LandingSupervisor` |
    | `feedback` | `svgs_routine.FEEDBACK` | whether motion control has finished |
    | `setpoint` | `SETPOINT` | of the mission; during a manoeuvre only `armed` counts |
    | `status` | `SUPERVISOR_STATUS` | the state by its index in `machine.table` |
    | `vehicle_status` | `VEHICLE_STATUS` | as in `LandingSupervisor` |
    | `command` | `svgs_routine.COMMAND` | the manoeuvre for motion control |

    The node `routine_commander_drspider` of "High-altitude precision landing by SVGS" (Drones 8,
    37, 2024). Its flags (scanBool, alignBool, relocateBool, offsetFlag, landingFlag), of which one
    is set at a time, are the number of the manoeuvre.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | as in `LandingSupervisor` |
    """

    def __init__(self, config: "LandingSupervisorConfig", seed: int = 0):
        """A commander; its configuration's routine must be of the kind `svgs`."""
        super().__init__(config, seed)
        self._feedback = self.DeclareVectorInputPort("feedback", FEEDBACK.size)
        names = remembered(SvgsMemory)
        self._command_fields = [names.index(field) for field in COMMAND.fields]
        self.DeclareVectorOutputPort(
            "command", BasicVector(COMMAND.size), self._calc_command, {self.xd_ticket()}
        )

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(3).value()[self._command_fields])

    def _perceive_target(self, context: Context, s: Situation[Any]) -> None:
        super()._perceive_target(context, s)
        begun, done = self._feedback.Eval(context)
        s.memory.done = float(done > 0.0 and begun == s.memory.begun)

"""The node that talks to the flight controller: setpoints at 30 Hz, whatever happens."""

import math

from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.configuration import Positive, configuration
from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import SETPOINT
from systems.supervisors.situation import Memory
from systems.supervisors.svgs_routine import COMMAND, NONE

_EARLY = 1e-6  # s, by which a look may be early
_ARMED = SETPOINT.index("armed")


@configuration
class Px4ControlConfig:
    """How often setpoints are sent."""

    rate: Positive = Field(default=30.0, le=1.0 / CLOCK_PERIOD)  # 1/s; paper, section 2.5.5

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Px4Control":
        """Add the node called `name` to `builder`."""
        return builder.AddNamedSystem(name, Px4Control(self, seed))


class Px4Control(LeafSystem):
    """Sends the setpoint of the mission or of the manoeuvre on, at its own rate.

    .. pydrake_system::
        name: Px4Control
        input_ports:
        - mission
        - manoeuvre
        - command
        output_ports:
        - setpoint

    | port | layout | meaning |
    |---|---|---|
    | `mission` | `SETPOINT` | of the commander; its `armed` always counts |
    | `manoeuvre` | `SETPOINT` | of motion control |
    | `command` | `svgs_routine.COMMAND` | whether there is a manoeuvre |
    | `setpoint` | `SETPOINT` | to the flight controller |

    The node `px4_control_drspider` of "High-altitude precision landing by SVGS" (Drones 8, 37,
    2024).

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | send, if 1 / rate has passed |
    """

    def __init__(self, config: Px4ControlConfig, seed: int = 0):
        """A node; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        self._mission = self.DeclareVectorInputPort("mission", SETPOINT.size).Eval
        self._manoeuvre = self.DeclareVectorInputPort("manoeuvre", SETPOINT.size).Eval
        self._command = self.DeclareVectorInputPort("command", COMMAND.size).Eval
        initial = Memory.initial()[: SETPOINT.size]
        self.DeclareStateOutputPort("setpoint", self.DeclareDiscreteState(BasicVector(initial)))
        self.DeclareDiscreteState(1)  # s, when the next setpoint is due
        self.DeclarePeriodicDiscreteUpdateEvent(CLOCK_PERIOD, 0.0, self._update)

    def configure(self, config: Px4ControlConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        due = context.get_discrete_state(1).value()[0]
        if context.get_time() < due - _EARLY:
            return EventStatus.DidNothing()
        period = 1.0 / self.config.rate
        behind = math.floor((context.get_time() - due) / period + _EARLY)
        discrete_state.get_mutable_value(1)[0] = due + (1 + behind) * period
        mission = self._mission(context)
        setpoint = discrete_state.get_mutable_value(0)
        if self._command(context)[0] == NONE:
            setpoint[:] = mission
        else:
            setpoint[:] = self._manoeuvre(context)
            setpoint[_ARMED] = mission[_ARMED]
        return EventStatus.Succeeded()

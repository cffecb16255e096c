"""The first node behind the phone: packets in, poses out, error packets dropped."""

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.configuration import configuration
from systems.estimators.fused_sensor import POLL_PERIOD
from systems.signals.measurement import SVGS, TIME_OF_ARRIVAL, VALID, no_measurement
from systems.vision.svgs_selection import ERRORS

_NOTHING = EventStatus.DidNothing()
_ERROR_CODE = SVGS.index("error_code")


@configuration
class SvgsDeserializerConfig:
    """Nothing to choose: a packet either holds a pose or an error code."""

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "SvgsDeserializer":
        """Add a deserialiser called `name` to `builder`."""
        return builder.AddNamedSystem(name, SvgsDeserializer(self, seed))


class SvgsDeserializer(LeafSystem):
    """Passes packets with a pose on, drops those with an error code, and counts both.

    .. pydrake_system::
        name: SvgsDeserializer
        input_ports:
        - svgs
        output_ports:
        - pose

    | port | layout | meaning |
    |---|---|---|
    | `svgs` | `SVGS` | what the phone sends |
    | `pose` | `SVGS` | the newest packet with a pose, with its own time of arrival |

    The node `svgs_deserializer_drspider` of "High-altitude precision landing by SVGS" (Drones 8,
    37, 2024, sections 2.4 and 2.5.5). Its Kalman filter stands behind the rotation to the local
    frame instead, in `SvgsFilter`: in the camera's frame a turn of the vehicle looks like motion.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | take a new packet |
    """

    def __init__(self, config: SvgsDeserializerConfig, seed: int = 0):
        """A deserialiser; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.config = config
        self._svgs = self.DeclareVectorInputPort("svgs", SVGS.size).Eval
        pose = self.DeclareDiscreteState(BasicVector(no_measurement(SVGS)))
        # Arrival of the newest packet, then how many there were by error code
        self.DeclareDiscreteState(BasicVector(np.array([-1.0] + len(ERRORS) * [0.0])))
        self.DeclareStateOutputPort("pose", pose)
        self.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, self._update)

    def configure(self, config: SvgsDeserializerConfig, seed: int = 0) -> None:
        """Take over a new configuration."""
        self.config = config

    def counts(self, context: Context) -> dict[str, int]:
        """How many packets there were, by what they say."""
        numbers = context.get_discrete_state(1).value()[1:]
        return {text: int(numbers[code]) for code, text in ERRORS.items()}

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus | None:
        packet = self._svgs(context)
        if packet[TIME_OF_ARRIVAL] == context.get_discrete_state(1).value()[0]:
            return _NOTHING
        memory = discrete_state.get_mutable_value(1)
        memory[0] = packet[TIME_OF_ARRIVAL]
        memory[1 + int(packet[_ERROR_CODE])] += 1.0
        if packet[VALID] > 0.0:
            discrete_state.get_mutable_value(0)[:] = packet
        return None

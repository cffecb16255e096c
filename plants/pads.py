"""Landing pads: where they are, how they move, and what can be seen on them.

Pad frame P has its origin in the middle of the pad's top, z up. Seen from above
with x to the right and y up the marker's image is upright.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Seconds,
    Vector3,
    configuration,
    require_same_structure,
)
from systems.signals.measurement import MARKER_LEVELS, PAD_STATE, SUPERVISOR_STATUS

MARKER_DICTIONARY = "DICT_4X4_100"  # OpenCV's name; 4 x 4 bits in a border one cell wide
MARKER_CELLS = 6  # cells a side, with the border

_LANDING_STARTED = SUPERVISOR_STATUS.index("landing_started")


def _zeros() -> list[float]:
    return [0.0, 0.0, 0.0]


@configuration
class MarkerLevelConfig:
    """One square ArUco marker of a nested marker."""

    id: Annotated[int, Field(ge=0, le=99, description="an id of DICT_4X4_100, 0 to 99")]
    side: Positive  # m, of the black square


@configuration
class NestedMarkerConfig:
    """ArUco markers one inside the other, concentric, the outermost first.

    The default is read at some level from 0.12 to 12 m by a 640 x 480 camera of
    530 px focal length: each level is 1.2 cells of its parent wide and sits in
    the white middle of a marker whose 2 x 2 middle cells are white.
    """

    levels: list[MarkerLevelConfig] = Field(
        default_factory=lambda: [
            MarkerLevelConfig(id=16, side=0.8),
            MarkerLevelConfig(id=45, side=0.16),
            MarkerLevelConfig(id=59, side=0.032),
        ],
        min_length=1,
        max_length=MARKER_LEVELS,
    )

    def ids(self) -> np.ndarray:
        """The ids of the levels, shape (levels,)."""
        return np.array([level.id for level in self.levels])

    def sides(self) -> np.ndarray:
        """The sides of the levels' black squares (m), shape (levels,)."""
        return np.array([level.side for level in self.levels])

    def corners(self) -> np.ndarray:
        """The corners of each level in P (m), shape (levels, 4, 3).

        In OpenCV's order: top left, top right, bottom right, bottom left of the
        upright marker.
        """
        unit = 0.5 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
        square = np.column_stack((unit, np.zeros(4)))
        return self.sides()[:, None, None] * square


@configuration
class InfraredBeaconConfig:
    """An infrared beacon like the MarkOne: a point that an infrared camera sees from above."""

    position: Vector3 = Field(default_factory=_zeros)  # m, in P; thesis: inside the inner marker


@configuration
class PadConfig:
    """A square pad, at rest unless a speed, a circle or a heave is given; these add up."""

    kind: Literal["pad"] = "pad"
    position: Vector3 = Field(default_factory=_zeros)  # m, middle of the top at t = 0, in W
    yaw: Finite = 0.0  # rad, counter-clockwise from east
    side: Metres = 1.2  # m, of the square that can be stood on
    velocity: Vector3 = Field(default_factory=_zeros)  # m/s, in W
    yaw_rate: Finite = 0.0  # rad/s
    circle_radius: Metres = 0.0  # m, of a circle that starts eastward and turns left
    circle_speed: NonNegative = 0.0  # m/s along it
    heave_amplitude: Metres = 0.0  # m, of a vertical sine that starts upward
    heave_period: Positive = 8.0  # s
    # s, when the motion begins: after the start of the run, or once the landing routine took over
    motion_start: Seconds = 0.0
    motion_from: Literal["start", "landing"] = "start"
    marker: NestedMarkerConfig | None = Field(default_factory=NestedMarkerConfig)
    beacon: InfraredBeaconConfig | None = Field(default_factory=InfraredBeaconConfig)

    @property
    def moves(self) -> bool:
        """Whether the pad's state depends on time, which shapes the diagram."""
        circles = self.circle_radius > 0.0 and self.circle_speed > 0.0
        drives = any(self.velocity) or self.yaw_rate != 0.0
        return drives or circles or self.heave_amplitude > 0.0

    def state(self, time: float) -> np.ndarray[Any, Any]:
        """The `PAD_STATE` at a time (s) since what `motion_from` names; at rest before."""
        t = time - self.motion_start
        x, y, z = self.position
        if t < 0.0 or not self.moves:
            return np.array([x, y, z, self.yaw, 0.0, 0.0, 0.0, 0.0, self.side])
        vx, vy, vz = self.velocity
        x, y, z = x + vx * t, y + vy * t, z + vz * t
        if self.circle_radius > 0.0:
            angle = self.circle_speed / self.circle_radius * t
            c, s = math.cos(angle), math.sin(angle)
            x += self.circle_radius * s
            y += self.circle_radius * (1.0 - c)
            vx += self.circle_speed * c
            vy += self.circle_speed * s
        rate = 2.0 * math.pi / self.heave_period
        z += self.heave_amplitude * math.sin(rate * t)
        vz += self.heave_amplitude * rate * math.cos(rate * t)
        yaw = self.yaw + self.yaw_rate * t
        return np.array([x, y, z, yaw, vx, vy, vz, self.yaw_rate, self.side])

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Pad":
        """Add the system to `builder` under `name`."""
        return builder.AddNamedSystem(name, Pad(self, seed))


class Pad(LeafSystem):
    """The landing pad's motion, a function of time.

    .. pydrake_system::

        name: Pad
        input_ports:
        - supervisor (optional)
        output_ports:
        - pad

    | port | layout | meaning |
    |---|---|---|
    | `supervisor` (optional) | `SUPERVISOR_STATUS` | needed where the landing sets the pad off |
    | `pad` | `PAD_STATE` | pose and velocity of the middle of the pad's top |

    p(t) = p₀ + v t + r (sin φ, 1 − cos φ, 0) + (0, 0, h sin 2πt/T), φ = speed · t/r,
    exact at every t, which counts from `motion_start` after the start or after the landing has
    begun; the output of a pad at rest is calculated once a run. It has no events.
    """

    def __init__(self, config: PadConfig, seed: int = 0):
        super().__init__()
        self._config = config
        self._supervisor = self.DeclareVectorInputPort("supervisor", SUPERVISOR_STATUS.size)
        moving = {self.time_ticket(), self.input_port_ticket(self._supervisor.get_index())}
        tickets = moving if config.moves else {self.nothing_ticket()}
        self.DeclareVectorOutputPort("pad", PAD_STATE.size, self._calc_pad, tickets)

    def configure(self, config: PadConfig, seed: int = 0) -> None:
        """Another pad, for contexts made from now on; one at rest cannot begin to move."""
        require_same_structure(self._config, config, "moves")
        self._config = config

    @property
    def config(self) -> PadConfig:
        """The configuration in force: what can be seen on the pad."""
        return self._config

    def _calc_pad(self, context: Any, output: Any) -> None:
        config, time = self._config, context.get_time()
        if config.moves and config.motion_from == "landing":
            began = self._supervisor.Eval(context)[_LANDING_STARTED]
            time = time - began if began >= 0.0 else -math.inf
        output.SetFromVector(config.state(time))

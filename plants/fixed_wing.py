"""The fixed wing that lands without GPS: thesis's coarse model or a lagged one in wind."""

import math
from typing import Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from plants.fixed_wing_dynamics import MEMORY, advance, trimmed_state
from plants.terrain import FlatTerrain, Terrain
from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Vector2,
    Vector3,
    configuration,
)
from systems.runway_frames import RunwayConfig, ned_from_runway
from systems.signals.noise import standard_normals, stream_key
from systems.signals.runway_measurement import (
    ATTITUDE_PERIOD,
    FIXED_WING_COMMAND,
    FIXED_WING_STATE,
)


@configuration
class FixedWingConfig:
    """An aircraft of the class of a motor glider of one tonne (Patroller, Stemme S15)."""

    kind: Literal["fixed_wing"] = "fixed_wing"
    dynamics: Literal["coarse", "lagged"] = "coarse"  # appendix A, or the better one of 6.4
    speed: Positive = 33.0  # m/s: 5 km in two and a half minutes (6.6)
    # A = 2 W/(ρ S C_Lα) with W/S = 525 N/m2 (1000 kg on 18.7 m2), C_Lα = 5.7/rad
    pitch_a: NonNegative = 150.0  # rad m2/s2
    pitch_b: Finite = 0.09  # rad, incidence and zero-lift angle: level at 41 m/s
    gear: Metres = 1.2  # m, from the wheels up to the centre of gravity
    roll_frequency: Positive = 2.0  # rad/s, of the closed roll loop, wings of 18 m
    roll_damping: Positive = 0.8  # 1
    pitch_frequency: Positive = 3.0  # rad/s, of the closed pitch loop
    pitch_damping: Positive = 0.7  # 1
    path_lag: Positive = 0.47  # s, 2 m/(ρ V S C_Lα) at 33 m/s
    speed_lag: Positive = 5.0  # s, of the automatic throttle
    roll_gust: Finite = 0.4  # 1, a gust from the left (v_g > 0) lifts the left wing: roll right
    pitch_gust: Finite = 0.5  # 1, a downward gust (w_g > 0) pulls the nose up with the tail
    steering_lag: Positive = 0.3  # s, of the nose wheel
    rolling_deceleration: NonNegative = 0.3  # m/s2, friction and drag on the ground
    wind: Vector2 = Field(default_factory=lambda: [0.0, 0.0])  # m/s, of the air to north and east
    wind_spread: NonNegative = 0.0  # m/s, one sigma of each component from run to run
    turbulence_wind: NonNegative = 0.0  # m/s, wind at 20 ft that sets the turbulence; 0 none
    start: Vector3 = Field(  # m, runway frame: right of the axis, along it, down
        default_factory=lambda: [0.0, -5000.0, -521.9]
    )
    start_course: Finite = 0.0  # deg, against the landing direction
    start_vertical_speed: Finite = 3.47  # m/s, positive down; on the landing trajectory

    def add_to(
        self,
        builder: DiagramBuilder,
        name: str,
        seed: int,
        runway: RunwayConfig | None = None,
        terrain: Terrain | None = None,
    ) -> "FixedWing":
        """Add the aircraft to a builder."""
        system = builder.AddNamedSystem(name, FixedWing(self, seed, runway, terrain))
        assert isinstance(system, FixedWing)
        return system

    def parameters(self, seed: int) -> np.ndarray:
        """The flat vector that `plants.fixed_wing_dynamics` takes, shape (PARAMETERS,)."""
        draw = standard_normals(stream_key(seed, "fixed_wing.wind"), 0, 2)
        return np.array(
            [
                float(self.dynamics == "lagged"),
                self.speed,
                self.pitch_a,
                self.pitch_b,
                self.gear,
                self.roll_frequency,
                self.roll_damping,
                self.pitch_frequency,
                self.pitch_damping,
                self.path_lag,
                self.speed_lag,
                self.roll_gust,
                self.pitch_gust,
                self.steering_lag,
                self.rolling_deceleration,
                self.wind[0] + self.wind_spread * draw[0],
                self.wind[1] + self.wind_spread * draw[1],
                self.turbulence_wind,
            ]
        )


class FixedWing(LeafSystem):
    """The fixed wing under roll and vertical-speed commands, in the air and on the ground.

    .. pydrake_system::

        name: FixedWing
        input_ports:
        - command
        output_ports:
        - state

    | port | layout | meaning |
    |---|---|---|
    | command | FIXED_WING_COMMAND | what the flight controller asks |
    | state | FIXED_WING_STATE | the aircraft now |

    Equations: `plants.fixed_wing_dynamics`. It touches the ground where the
    wheels reach the terrain.

    | event | when | does |
    |---|---|---|
    | initialize | at the start | the trimmed aircraft at the start of the last `configure` |
    | advance | every 10 ms from 0 | moves by 10 ms under the command at t |
    """

    def __init__(
        self,
        config: FixedWingConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
        terrain: Terrain | None = None,
    ):
        super().__init__()
        self._site: tuple[RunwayConfig, Terrain] | None = None
        self.configure(config, seed, runway, terrain)
        self._command = self.DeclareVectorInputPort("command", FIXED_WING_COMMAND.size).Eval
        state = self.DeclareDiscreteState(FIXED_WING_STATE.size)
        self.DeclareDiscreteState(MEMORY)
        self.DeclareStateOutputPort("state", state)
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(ATTITUDE_PERIOD, 0.0, self._advance)

    def configure(
        self,
        config: FixedWingConfig,
        seed: int,
        runway: RunwayConfig | None = None,
        terrain: Terrain | None = None,
    ) -> None:
        """Take a new aircraft, seed and site; omitted, the site is flat at the default runway."""
        site = (runway or RunwayConfig(), terrain or FlatTerrain())
        if site != self._site:
            self._grid = site[1].grid(site[0])
            self._site = site
        self._parameters = config.parameters(seed)
        self._key = stream_key(seed, "fixed_wing.gust")
        heading = site[0].heading_radians
        self._initial = trimmed_state(
            ned_from_runway(np.array(config.start), heading),
            heading + math.radians(config.start_course),
            config.start_vertical_speed,
            self._parameters,
            self._grid.values,
            self._grid.geometry,
        )

    @property
    def model(self) -> tuple:
        """Initial state and memory, parameters, noise key, and the terrain's grid."""
        return *self._initial, self._parameters, self._key, self._grid

    def _initialize(self, context, discrete_state):
        # Drake fixes the default state when a system is built; an aircraft without airspeed is
        # one that has not been placed yet.
        state = discrete_state.get_mutable_value(0)
        if state[12] == 0.0 and state[14] == 0.0:
            state[:], discrete_state.get_mutable_value(1)[:] = self._initial

    def _advance(self, context, discrete_state):
        advance(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            self._command(context),
            self._parameters,
            self._grid.values,
            self._grid.geometry,
            self._key,
            ATTITUDE_PERIOD,
        )

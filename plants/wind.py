"""The wind at the vehicle: steady, turbulent, and gusts by appointment."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from plants import wind_dynamics as dynamics
from systems.configuration import Finite, NonNegative, Positive, Seconds, Vector3, configuration
from systems.schedule import BASE_PERIOD
from systems.signals.measurement import BODY_STATE
from systems.signals.noise import stream_key
from systems.signals.optional_input import optional_input

WIND_PERIOD = 16 * BASE_PERIOD  # s; a gust of 1 m scale at 10 m/s lasts 100 ms

_SHEARS = ("none", "power", "logarithmic")
_HEIGHT = BODY_STATE.index("p_WB_z")
_VELOCITY = BODY_STATE.slice("v_WB")
_HOVERING = BODY_STATE.zeros()
_HOVERING[_HEIGHT] = dynamics.REFERENCE_HEIGHT


@configuration
class GustConfig:
    """One gust of the form (1 − cos): it rises to `velocity` and falls again."""

    start: Seconds = 0.0  # s
    duration: Positive = 2.0  # s, of the whole gust
    velocity: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m/s in W at its peak


@configuration
class WindConfig:
    """The weather. The default is a calm day."""

    kind: Literal["wind"] = "wind"
    speed: NonNegative = 0.0  # m/s, steady, at 6.1 m (20 ft) over the ground
    direction: Finite = 0.0  # rad, where it blows to, counter-clockwise from east
    shear: Annotated[
        Literal["none", "power", "logarithmic"],
        Field(description="none, power or logarithmic: how the steady wind grows with height"),
    ] = "none"
    shear_exponent: NonNegative = 1.0 / 7.0  # of the power law, open country
    roughness_length: Positive = 0.0457  # m, of the logarithmic law; MIL-F-8785C's 0.15 ft
    turbulence: NonNegative = 1.0  # factor on MIL-F-8785C's intensity at this wind speed; 0 is none
    turbulence_speed: NonNegative | None = None  # m/s, instead of `speed`, for the turbulence
    gusts: list[GustConfig] = Field(default_factory=list)  # by appointment

    def parameters(self) -> np.ndarray:
        """The parameter vector of `plants.wind_dynamics`."""
        speed = self.speed if self.turbulence_speed is None else self.turbulence_speed
        scalars = np.zeros(dynamics.FIRST_GUST)
        scalars[dynamics.STEADY_SPEED] = self.speed
        scalars[dynamics.DIRECTION] = self.direction
        scalars[dynamics.SHEAR] = _SHEARS.index(self.shear)
        scalars[dynamics.EXPONENT] = self.shear_exponent
        scalars[dynamics.ROUGHNESS] = self.roughness_length
        scalars[dynamics.TURBULENCE_SPEED] = self.turbulence * speed
        scalars[dynamics.GUSTS] = len(self.gusts)
        gusts = [[gust.start, gust.duration, *gust.velocity] for gust in self.gusts]
        return np.concatenate((scalars, np.ravel(gusts)))

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Wind":
        """Add the system to `builder` under `name`."""
        return builder.AddNamedSystem(name, Wind(self, seed))


class Wind(LeafSystem):
    """The velocity of the air at the vehicle.

    .. pydrake_system::

        name: Wind
        input_ports:
        - body
        output_ports:
        - wind

    | port | layout | meaning |
    |---|---|---|
    | `body` (optional) | `BODY_STATE` | whose height counts; unconnected: hovering at 6.1 m |
    | `wind` | (3,) | velocity of the air, m/s in W; zero until the first event |

    Steady wind with an optional power-law or logarithmic profile, Dryden
    turbulence of MIL-F-8785C's low-altitude model in three linear components
    (equations in `plants.wind_dynamics`), and gusts v/2 (1 − cos 2π(t − t₀)/T)
    by appointment (the form of CS-25.341). The ground is at z = 0.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | the wind for t + 40 ms, held from t on |
    """

    def __init__(self, config: WindConfig, seed: int = 0):
        super().__init__()
        wind = self.DeclareDiscreteState(3)
        self.DeclareDiscreteState(dynamics.STATE_SIZE)
        self._body = optional_input(self.DeclareVectorInputPort("body", BODY_STATE.size), _HOVERING)
        self.DeclareStateOutputPort("wind", wind)
        self.DeclarePeriodicDiscreteUpdateEvent(WIND_PERIOD, 0.0, self._update)
        self.configure(config, seed)

    def configure(self, config: WindConfig, seed: int = 0) -> None:
        """Change the weather and its seed; every field may change."""
        self._parameters = config.parameters()
        self._key = stream_key(seed, "wind.turbulence")

    def _update(self, context: Any, discrete_state: Any) -> None:
        body = self._body(context)
        dynamics.update(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            body[_HEIGHT],
            body[_VELOCITY],
            context.get_time() + WIND_PERIOD,
            WIND_PERIOD,
            self._key,
            self._parameters,
        )

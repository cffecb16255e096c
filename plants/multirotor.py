"""The multirotor as a Drake system: fast and discrete, or continuous for every scalar type.

`Multirotor` is what runs: one discrete event every 10 ms around the compiled
kernel of `plants.multirotor_dynamics`. `ContinuousMultirotor_` writes the same
free flight down once more for float, AutoDiffXd and Expression, to linearise,
to design controllers with, and to hold the kernel against.
"""

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field
from pydrake.math import max as max_
from pydrake.math import sqrt
from pydrake.symbolic import Expression, if_then_else
from pydrake.systems.framework import (
    BasicVector_,
    DiagramBuilder,
    LeafSystem,
    LeafSystem_,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from plants import multirotor_dynamics as dynamics
from plants.vehicles import VEHICLES, Vehicle, VehicleName
from systems.configuration import (
    Finite,
    NonNegative,
    Positive,
    Vector3,
    configuration,
    require_same_structure,
)
from systems.schedule import PLANT_PERIOD
from systems.signals.measurement import BODY_STATE, PAD_STATE
from systems.signals.optional_input import optional_input

_CALM = np.zeros(3)
_NO_PAD = PAD_STATE.zeros()
_F_B = BODY_STATE.slice("f_B")
_CONTACT_FORCE = BODY_STATE.index("contact_force")
_BODY, _ROTORS = range(2)  # groups of the discrete state


@configuration
class MultirotorConfig:
    """Which multirotor flies, and how it starts."""

    kind: Literal["multirotor"] = "multirotor"
    vehicle: VehicleName | Vehicle = "thesis_hexacopter"  # a name, or every field of a Vehicle
    mass: Positive | None = None  # kg, instead of the vehicle's
    inertia: Vector3 | None = None  # kg m2, instead of the vehicle's
    drag_areas: Vector3 | None = None  # m2, instead of the vehicle's
    rotor_drag_coefficient: NonNegative | None = None  # N s2/(rad m), instead of the vehicle's
    ground_effect: NonNegative | None = None  # factor, instead of the vehicle's; 0 is none
    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m, middle of the feet, W
    yaw: Finite = 0.0  # rad, counter-clockwise from east
    velocity: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m/s, in W
    flying: bool = False  # start at the hover rotor speed, not standing with stopped rotors

    def resolved_vehicle(self) -> Vehicle:
        """The vehicle with the overrides of this configuration."""
        vehicle = self.vehicle
        if isinstance(vehicle, str):
            vehicle = VEHICLES[vehicle]()
        names = ("mass", "inertia", "drag_areas", "rotor_drag_coefficient", "ground_effect")
        overrides = {name: getattr(self, name) for name in names}
        return replace(vehicle, **{k: v for k, v in overrides.items() if v is not None})

    @property
    def rotor_count(self) -> int:
        """The number of rotors, which shapes the diagram."""
        return self.resolved_vehicle().rotor_count

    def initial_body(self) -> np.ndarray[Any, Any]:
        """The `BODY_STATE` at the start: level, at rest in the pad's or the air's support."""
        vehicle = self.resolved_vehicle()
        body = BODY_STATE.zeros()
        body[0], body[3] = math.cos(0.5 * self.yaw), math.sin(0.5 * self.yaw)
        height = vehicle.standing_height()
        if self.flying:
            height = -min(foot[2] for foot in vehicle.feet)
        body[BODY_STATE.slice("p_WB")] = self.position + np.array([0.0, 0.0, height])
        body[BODY_STATE.slice("v_WB")] = self.velocity
        body[_F_B] = 0.0, 0.0, vehicle.gravity
        body[_CONTACT_FORCE] = 0.0 if self.flying else vehicle.mass * vehicle.gravity
        return body

    def initial_rotor_speeds(self) -> np.ndarray[Any, Any]:
        """The rotor speeds at the start (rad/s), shape (N,)."""
        vehicle = self.resolved_vehicle()
        speed = vehicle.hover_rotor_speed() if self.flying else 0.0
        return np.full(vehicle.rotor_count, speed)

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "Multirotor":
        """Add the system to `builder` under `name`."""
        return builder.AddNamedSystem(name, Multirotor(self, seed))


class Multirotor(LeafSystem):
    """A rigid body with N rotors, drag in the wind, ground effect and legs.

    .. pydrake_system::

        name: Multirotor
        input_ports:
        - rotor_commands
        - wind
        - pad
        output_ports:
        - body
        - rotor_speeds

    | port | layout | meaning |
    |---|---|---|
    | `rotor_commands` | (N,) | normalised thrust 0..1; rotor speed = maximum √command |
    | `wind` (optional) | (3,) | velocity of the air, m/s in W; unconnected: calm |
    | `pad` (optional) | `PAD_STATE` | what the legs stand on; unconnected: ground at z = 0 |
    | `body` | `BODY_STATE` | pose, velocities; specific force and contact force are means |
    | `rotor_speeds` | (N,) | rad/s, never negative |

    The command is a thrust, as PX4's mixer gives it out with THR_MDL_FAC = 1:
    thrust is linear in it. The equations are in `plants.multirotor_dynamics`.
    Body frame B has its origin at the centre of mass.

    | event | when | does |
    |---|---|---|
    | initialize | at the start | the initial state of the last `configure` |
    | step | every 10 ms from 0 | RK4 from t to t + 10 ms with the inputs at t |

    So a block that samples at t sees the body at t, and in it the mean specific
    force from t − 10 ms to t. The same equations for other scalar types are in
    `ContinuousMultirotor_`.
    """

    def __init__(self, config: MultirotorConfig, seed: int = 0):
        super().__init__()
        self._config = config
        self._default = config
        self._parameters = config.resolved_vehicle().parameters()
        self._commands = self.DeclareVectorInputPort("rotor_commands", config.rotor_count).Eval
        self._wind = optional_input(self.DeclareVectorInputPort("wind", 3), _CALM)
        self._pad = optional_input(self.DeclareVectorInputPort("pad", PAD_STATE.size), _NO_PAD)
        body = self.DeclareDiscreteState(config.initial_body())
        rotors = self.DeclareDiscreteState(config.initial_rotor_speeds())
        self.DeclareStateOutputPort("body", body)
        self.DeclareStateOutputPort("rotor_speeds", rotors)
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(PLANT_PERIOD, 0.0, self._step)

    def configure(self, config: MultirotorConfig, seed: int = 0) -> None:
        """Fly another vehicle from now on; the number of rotors must stay the same."""
        require_same_structure(self._config, config, "rotor_count")
        self._config = config
        self._parameters = config.resolved_vehicle().parameters()

    @property
    def config(self) -> MultirotorConfig:
        """The configuration in force."""
        return self._config

    def _initialize(self, context, discrete_state):
        # Drake fixes the default state when a system is built. After `configure` it is replaced
        # here, unless the context holds something else on purpose.
        body = discrete_state.get_mutable_value(_BODY)
        if context.get_time() == 0.0 and np.array_equal(body, self._default.initial_body()):
            body[:] = self._config.initial_body()
            discrete_state.get_mutable_value(_ROTORS)[:] = self._config.initial_rotor_speeds()

    def _step(self, context, discrete_state):
        dynamics.step(
            discrete_state.get_mutable_value(_BODY),
            discrete_state.get_mutable_value(_ROTORS),
            self._commands(context),
            self._wind(context),
            self._pad(context),
            self._parameters,
        )


def _rotation(q):
    """R_WB of a unit quaternion for any scalar type, shape (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion_rate(q, w):
    """½ q ⊗ (0, w) for any scalar type, shape (4,)."""
    scalar, vector = q[0], q[1:]
    return 0.5 * np.concatenate(([-(vector @ w)], scalar * w + np.cross(vector, w)))


def _lagged(error, up, down):
    """The error over the time constant of its direction, for any scalar type."""
    if isinstance(error, Expression):
        return if_then_else(error > 0.0, error / up, error / down)
    return error / up if error > 0.0 else error / down


@TemplateSystem.define("ContinuousMultirotor_")
def ContinuousMultirotor_(T):
    """The class for one scalar type; documented there."""

    class Impl(LeafSystem_[T]):
        """The free flight of `Multirotor` as a continuous system for every scalar type.

        .. pydrake_system::

            name: ContinuousMultirotor
            input_ports:
            - rotor_commands
            - wind
            output_ports:
            - state

        | port | layout | meaning |
        |---|---|---|
        | `rotor_commands` | (N,) | normalised thrust, within 0..1: it is not clipped here |
        | `wind` (optional) | (3,) | velocity of the air, m/s in W; unconnected: calm |
        | `state` | (13 + N,) | q_WB, p_WB, v_WB, w_WB_B, rotor speeds |

        The equations of `plants.multirotor_dynamics` over flat ground at z = 0,
        without contact, which has no derivative where a leg touches. The
        constructor takes a `Vehicle`. It has no events.
        """

        def _construct(self, vehicle: Vehicle, converter=None):
            super().__init__(converter)
            self._vehicle = vehicle
            count = vehicle.rotor_count
            default = np.zeros(dynamics.BODY_SIZE + count)
            default[0] = 1.0
            default[dynamics.BODY_SIZE :] = vehicle.hover_rotor_speed()
            state = self.DeclareContinuousState(BasicVector_[T]([T(value) for value in default]))
            self._commands = self.DeclareVectorInputPort("rotor_commands", count)
            self._wind = self.DeclareVectorInputPort("wind", 3)
            self.DeclareStateOutputPort("state", state)

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other._vehicle, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            # Drake's symbolic arithmetic raises the processor's "invalid" flag on its way, which
            # numpy would report.
            with np.errstate(invalid="ignore"):
                derivatives.SetFromVector(self._calc_rates(context))

        def _calc_rates(self, context):
            vehicle = self._vehicle
            x = context.get_continuous_state_vector().CopyToVector()
            commands = self._commands.Eval(context)
            wind = self._wind.Eval(context) if self._wind.HasValue(context) else np.zeros(3)
            q, v_WB, w, speeds = x[0:4], x[7:10], x[10:13], x[13:]
            R = _rotation(q)
            u = R.T @ (v_WB - wind)
            airspeed = sqrt(u @ u + dynamics.AIRSPEED_SOFTENING)
            force = -0.5 * vehicle.air_density * airspeed * np.array(vehicle.drag_areas) * u
            torque = np.array([T(0.0), T(0.0), T(0.0)])
            rates = []
            for position, spin, speed, command in zip(
                vehicle.rotor_positions, vehicle.rotor_spins, speeds, commands, strict=True
            ):
                r = np.array(position)
                u_i = u + np.cross(w, r)
                static = vehicle.thrust_coefficient * speed**2
                radius = vehicle.rotor_radius
                height = max_(x[6] + R[2] @ r, T(0.5 * radius))
                induced = static / (2.0 * vehicle.air_density * math.pi * radius**2)
                in_plane = u_i[0] ** 2 + u_i[1] ** 2 + dynamics.AIRSPEED_SOFTENING
                near = vehicle.ground_effect * (0.25 * radius / height) ** 2
                gain = 1.0 / (1.0 - near * induced / (induced + in_plane))
                hub = speed * np.array(
                    [
                        -vehicle.rotor_drag_coefficient * u_i[0],
                        -vehicle.rotor_drag_coefficient * u_i[1],
                        -vehicle.axial_drag_coefficient * u_i[2],
                    ]
                )
                hub[2] += gain * static
                force = force + hub
                torque = torque + np.cross(r, hub)
                torque[2] -= spin * vehicle.moment_constant * static
                error = vehicle.maximum_rotor_speed * sqrt(command) - speed
                rates.append(_lagged(error, vehicle.time_constant_up, vehicle.time_constant_down))
            inertia = np.array(vehicle.inertia)
            acceleration = R @ force / vehicle.mass - np.array([0.0, 0.0, vehicle.gravity])
            angular = (torque - np.cross(w, inertia * w)) / inertia
            return np.concatenate((_quaternion_rate(q, w), v_WB, acceleration, angular, rates))

    return Impl


ContinuousMultirotor = ContinuousMultirotor_[None]

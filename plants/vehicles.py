"""Vehicles by name: masses, rotors, drags and legs, each number with where it is from.

Body frame B is forward-left-up with its origin at the centre of mass. Rotors
are numbered as PX4 and ArduPilot number the motors of their frames ("hexa x",
"octo x", "quad x").
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from plants import multirotor_dynamics as dynamics
from systems.configuration import (
    Metres,
    NonNegative,
    Positive,
    Seconds,
    Vector3,
    configuration,
)

STANDARD_GRAVITY = 9.80665  # m/s2, ISO 80000-3
AIR_DENSITY = 1.225  # kg/m3, ISO 2533 at sea level

Spin = Annotated[Literal[-1, 1], Field(description="+1 counter-clockwise from above, or -1")]


@configuration
class Vehicle:
    """The mechanics of a multirotor; equations in `plants.multirotor_dynamics`."""

    mass: Positive  # kg
    inertia: Vector3  # kg m2, principal moments about the axes of B
    rotor_positions: Annotated[list[Vector3], Field(min_length=1)]  # m, hubs in B
    rotor_spins: list[Spin]  # +1 counter-clockwise seen from above, -1 clockwise
    rotor_radius: Positive  # m
    thrust_coefficient: Positive  # N s2/rad2, thrust a squared rotor speed
    moment_constant: NonNegative  # m, drag torque a thrust
    maximum_rotor_speed: Positive  # rad/s
    time_constant_up: Annotated[Seconds, Field(gt=0.0)]  # s, of a rotor speeding up
    time_constant_down: Annotated[Seconds, Field(gt=0.0)]  # s, of a rotor slowing down
    rotor_drag_coefficient: NonNegative  # N s2/(rad m), drag a rotor speed and in-plane airspeed
    axial_drag_coefficient: NonNegative  # N s2/(rad m), thrust lost a rotor speed and axial speed
    drag_areas: Vector3  # m2, drag coefficient times area, against flow along the axes of B
    ground_effect: NonNegative = 1.0  # factor on Cheeseman and Bennett's term; 0 is none
    feet: Annotated[list[Vector3], Field(min_length=1)]  # m, where the legs touch, in B
    leg_stiffness: Positive  # N/m a foot
    leg_dissipation: NonNegative = 3.0  # s/m, Hunt and Crossley's: touchdowns hardly bounce
    friction: NonNegative = 0.6  # rubber feet on plywood
    slip_speed: Positive = 0.01  # m/s, below this friction is viscous
    gravity: Positive = STANDARD_GRAVITY  # m/s2
    air_density: Positive = AIR_DENSITY  # kg/m3

    def __post_init__(self):
        if len(self.rotor_positions) != len(self.rotor_spins):
            raise ValueError(
                f"a vehicle with {len(self.rotor_positions)} rotor_positions needs as many "
                f"rotor_spins, not {len(self.rotor_spins)}"
            )
        if min(self.inertia) <= 0.0:
            raise ValueError(f"a vehicle's inertia must be positive, not {self.inertia}")
        if min(self.drag_areas) < 0.0:
            raise ValueError(f"a vehicle's drag_areas must not be negative, like {self.drag_areas}")

    @property
    def rotor_count(self) -> int:
        """The number of rotors N."""
        return len(self.rotor_positions)

    @property
    def maximum_thrust(self) -> float:
        """The static thrust of one rotor at its maximum speed, N."""
        return self.thrust_coefficient * self.maximum_rotor_speed**2

    def hover_command(self) -> float:
        """The command (normalised thrust, 0..1) that carries the weight out of ground effect."""
        return self.mass * self.gravity / (self.rotor_count * self.maximum_thrust)

    def hover_rotor_speed(self) -> float:
        """The rotor speed that carries the weight out of ground effect, rad/s."""
        return self.maximum_rotor_speed * math.sqrt(self.hover_command())

    def allocation_matrix(self) -> np.ndarray:
        """The static wrench of the rotor commands, shape (4, N).

        Row 0 is the thrust along z_B (N), rows 1 to 3 the torque about the
        axes of B (N m); a mixer inverts it.
        """
        positions = np.array(self.rotor_positions)
        spins = np.array(self.rotor_spins, dtype=float)
        unit = np.stack(
            (
                np.ones(self.rotor_count),
                positions[:, 1],
                -positions[:, 0],
                -self.moment_constant * spins,
            )
        )
        return self.maximum_thrust * unit

    def standing_height(self) -> float:
        """The height of B's origin over the ground when the vehicle stands on its legs, m."""
        sink = self.mass * self.gravity / (len(self.feet) * self.leg_stiffness)
        return -min(foot[2] for foot in self.feet) - sink

    def contact_points(self) -> np.ndarray:
        """The feet, then the rotor hubs (a toppled vehicle lies on those), in B, shape (n, 3)."""
        return np.array([*self.feet, *self.rotor_positions])

    def parameters(self) -> np.ndarray:
        """The parameter vector of `plants.multirotor_dynamics`."""
        rotors = [
            [*position, float(spin)]
            for position, spin in zip(self.rotor_positions, self.rotor_spins, strict=True)
        ]
        contacts = self.contact_points()
        scalars = np.zeros(dynamics.FIRST_ROTOR)
        scalars[dynamics.ROTORS] = self.rotor_count
        scalars[dynamics.CONTACTS] = len(contacts)
        scalars[dynamics.MASS] = self.mass
        scalars[dynamics.INERTIA_X : dynamics.INERTIA_Z + 1] = self.inertia
        scalars[dynamics.GRAVITY] = self.gravity
        scalars[dynamics.AIR_DENSITY] = self.air_density
        scalars[dynamics.THRUST_COEFFICIENT] = self.thrust_coefficient
        scalars[dynamics.TORQUE_COEFFICIENT] = self.moment_constant * self.thrust_coefficient
        scalars[dynamics.ROTOR_DRAG] = self.rotor_drag_coefficient
        scalars[dynamics.AXIAL_DRAG] = self.axial_drag_coefficient
        scalars[dynamics.TIME_CONSTANT_UP] = self.time_constant_up
        scalars[dynamics.TIME_CONSTANT_DOWN] = self.time_constant_down
        scalars[dynamics.MAXIMUM_SPEED] = self.maximum_rotor_speed
        scalars[dynamics.ROTOR_RADIUS] = self.rotor_radius
        scalars[dynamics.GROUND_EFFECT] = self.ground_effect
        scalars[dynamics.DRAG_AREA_X : dynamics.DRAG_AREA_Z + 1] = self.drag_areas
        scalars[dynamics.STIFFNESS] = self.leg_stiffness
        scalars[dynamics.DISSIPATION] = self.leg_dissipation
        scalars[dynamics.FRICTION] = self.friction
        scalars[dynamics.SLIP_SPEED] = self.slip_speed
        return np.concatenate((scalars, np.ravel(rotors), np.ravel(contacts)))


def _ring(radius: Metres, height: float, bearings: list[float]) -> list[list[float]]:
    """Points on a circle about z_B; bearings in degrees, clockwise from the nose."""
    return [
        [radius * math.cos(math.radians(b)), -radius * math.sin(math.radians(b)), height]
        for b in bearings
    ]


def thesis_hexacopter() -> Vehicle:
    """The custom hexacopter of Badakis' thesis (2020), as an F550-class frame.

    The thesis names the autopilot (CUAV V5 Nano) and the sensors but not the
    frame; a 550 mm hexacopter with 9.4-inch propellers on four cells is what
    carries them. Propulsion is from the bench tests of the CTU MRS group
    (github.com/ctu-mrs/ctu-mrs.github.io, docs/hardware/motor_tests.md):
    2312 920KV motor, DJI 9450 propeller, 401 g at 5688 rpm to 1024 g at
    9068 rpm, so k_f = 1.11e-5 to 1.13e-5.
    """
    return Vehicle(
        # DJI's manual of the F550 allows 1.2 to 2.4 kg; Raspberry Pi, cameras and legs on top.
        mass=2.5,
        # By parts: 6 x 85 g motor, ESC and propeller at 0.275 m, 0.33 kg of arms at 0.16 m, 1.46 kg
        # in a box of 0.16 x 0.12 x 0.10 m, 0.2 kg of legs at 0.15 m and 0.15 m below.
        inertia=[0.034, 0.035, 0.057],
        rotor_positions=_ring(0.275, 0.02, [90.0, -90.0, -30.0, 150.0, 30.0, -150.0]),
        rotor_spins=[-1, 1, -1, 1, 1, -1],
        rotor_radius=0.119,  # 9.4 in propeller
        thrust_coefficient=1.12e-5,  # the bench tests' mean
        # The tests' 51 W at 401 g and 596 rad/s, 0.8 of it reaching the shaft (a usual efficiency
        # of motor and ESC): 0.069 N m on 3.9 N. Figure of merit 0.57.
        moment_constant=0.0175,
        maximum_rotor_speed=950.0,  # the tests' 9068 rpm at full throttle on 16.3 V
        # J / (K_t²/R + 2 k_m Ω) with J = 6.6e-5 kg m2 (13 g propeller and the bell), K_t = 1/920KV
        # = 0.0104 N m/A, R = 0.117 Ω and the hover speed.
        time_constant_up=0.055,
        time_constant_down=0.055,
        # Iris' figure, same class of propeller: 0.25 1/s of damping; Faessler, Franchi, Scaramuzza
        # (RA-L 2018) identify 0.3 to 0.5 1/s on a smaller quadrotor.
        rotor_drag_coefficient=1.75e-4,
        # Thrust falls linearly to zero at an advance ratio of 0.65, a little over pitch by diameter
        # (5.0/9.4), as the UIUC propeller data base shows: k_z = 2π k_f / (0.65 · 0.239 m).
        axial_drag_coefficient=4.5e-4,
        drag_areas=[0.025, 0.025, 0.05],  # hull, arms and legs as bluff bodies, C_d about 1
        feet=[[0.14, 0.15, -0.2], [0.14, -0.15, -0.2], [-0.14, 0.15, -0.2], [-0.14, -0.15, -0.2]],
        leg_stiffness=1200.0,  # sinks 5 mm into its rubber feet and plastic legs
    )


def iris() -> Vehicle:
    """PX4's simulated 3DR Iris: PX4-SITL_gazebo-classic, models/iris/iris.sdf.jinja.

    The legs stand at the lower corners of the model's collision box. The model
    has no parasitic drag; its motor model takes thrust down linearly to zero
    at 25 m/s of axial speed, which is k_z = k_f Ω / 25 at the hover speed.
    """
    return Vehicle(
        mass=1.5,  # the base link; sensors and rotors add 45 g there
        inertia=[0.029125, 0.029125, 0.055225],
        rotor_positions=[
            [0.13, -0.22, 0.023],
            [-0.13, 0.20, 0.023],
            [0.13, 0.22, 0.023],
            [-0.13, -0.20, 0.023],
        ],
        rotor_spins=[1, 1, -1, -1],
        rotor_radius=0.128,
        thrust_coefficient=5.84e-6,
        moment_constant=0.06,
        maximum_rotor_speed=1100.0,
        time_constant_up=0.0125,
        time_constant_down=0.025,
        rotor_drag_coefficient=1.75e-4,
        axial_drag_coefficient=1.85e-4,
        drag_areas=[0.0, 0.0, 0.0],
        feet=[
            [0.235, 0.235, -0.055],
            [0.235, -0.235, -0.055],
            [-0.235, 0.235, -0.055],
            [-0.235, -0.235, -0.055],
        ],
        leg_stiffness=750.0,  # sinks 5 mm
    )


def dr_spider() -> Vehicle:
    """DR Spider, the octocopter of the SVGS high-altitude landing paper (Table 2).

    Tarot X8-II frame, Tarot 4114/320KV motors, 16-inch Tarot 1655 propellers,
    22 lbm, 44.3 x 44.3 x 19.3 in. The X8-II has eight arms in one plane; 44.3 in
    must be its wheelbase, for on less the propellers would meet (0.43 m between
    neighbours, 0.41 m propellers). Propulsion is scaled from the CTU MRS group's
    bench tests of that motor with the 15-inch 1555 propeller (same page as
    `thesis_hexacopter`'s; k_f = 6.0e-5 to 6.7e-5, 5832 rpm at full throttle).
    """
    return Vehicle(
        mass=9.98,  # 22 lbm
        # By parts: 8 x 223 g motor, ESC and propeller at 0.5625 m, 0.8 kg of arms at 0.3 m, 6.8 kg
        # of batteries and boards in 0.25 x 0.20 x 0.20 m, 0.6 kg of legs.
        inertia=[0.43, 0.43, 0.74],
        rotor_positions=_ring(
            0.5625, 0.05, [22.5, -157.5, 67.5, 157.5, -22.5, -112.5, -67.5, 112.5]
        ),
        rotor_spins=[-1, -1, 1, 1, 1, 1, -1, -1],
        rotor_radius=0.203,  # 16 in propeller
        thrust_coefficient=8.2e-5,  # 6.3e-5 times (16/15)⁴
        # 144 W at 1077 g and 420 rad/s, 0.82 of it at the shaft, times 16/15.
        moment_constant=0.028,
        maximum_rotor_speed=548.0,  # 611 rad/s times (15/16)^(5/3): the same power
        # As thesis_hexacopter's, with J = 5.2e-4 kg m2, K_t = 0.0298 N m/A, R = 0.126 Ω.
        time_constant_up=0.058,
        time_constant_down=0.058,
        # Blade area and radius scale the Iris' figure by (16/10.1)³: 0.22 1/s of damping.
        rotor_drag_coefficient=7.0e-4,
        axial_drag_coefficient=2.8e-3,  # 2π k_f / (0.46 · 0.406 m), as above for 5.5 in of pitch
        drag_areas=[0.09, 0.09, 0.16],  # hull, battery and legs as bluff bodies, C_d about 1
        feet=[
            [0.25, 0.23, -0.36],
            [0.25, -0.23, -0.36],
            [-0.25, 0.23, -0.36],
            [-0.25, -0.23, -0.36],
        ],
        leg_stiffness=4000.0,  # sinks 6 mm
    )


VehicleName = Literal["thesis_hexacopter", "iris", "dr_spider"]
VEHICLES: dict[str, Callable[[], Vehicle]] = {
    "thesis_hexacopter": thesis_hexacopter,
    "iris": iris,
    "dr_spider": dr_spider,
}


def vehicle_named(name: VehicleName, **overrides) -> Vehicle:
    """A vehicle by name, with some fields replaced; raises `KeyError` for an unknown name."""
    return replace(VEHICLES[name](), **overrides)

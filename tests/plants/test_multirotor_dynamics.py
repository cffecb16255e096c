"""The compiled equations of motion against Drake's bodies, scipy's integrator and pen and paper."""

import itertools
import math

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.examples import QuadrotorPlant
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import RotationalInertia, SpatialInertia
from pydrake.systems.analysis import Simulator
from scipy.integrate import solve_ivp

from plants import multirotor_dynamics as dynamics
from plants.vehicles import VEHICLES, Vehicle, vehicle_named
from systems.frames import quaternion_from_rotation_vector, rotation_matrix
from systems.signals.measurement import PAD_STATE

CALM = np.zeros(3)
GROUND = PAD_STATE.zeros()


def body_at(p_WB=(0.0, 0.0, 10.0), rotation=(0.0, 0.0, 0.0), v_WB=(0, 0, 0), w_WB_B=(0, 0, 0)):
    body = np.zeros(17)
    body[:4] = quaternion_from_rotation_vector(np.array(rotation, dtype=float))
    body[4:7], body[7:10], body[10:13] = p_WB, v_WB, w_WB_B
    return body


def fly(vehicle, body, rotor_speeds, commands, seconds, wind=CALM, pad=GROUND):
    """Steps until `seconds` in place; the history of bodies, shape (steps + 1, 17)."""
    parameters = vehicle.parameters()
    history = [body.copy()]
    for _ in range(round(seconds / dynamics.STEP)):
        dynamics.step(body, rotor_speeds, commands, wind, pad, parameters)
        history.append(body.copy())
    return np.array(history)


def derivative(vehicle, state, commands, wind=CALM, pad=GROUND, contact=False):
    dx = np.zeros(17 + vehicle.rotor_count)
    dynamics.derivatives(state, commands, wind, pad, 0.0, contact, vehicle.parameters(), dx)
    return dx


def plain_wrench(vehicle, R, v_WB, w_WB_B, speeds, wind):
    """Force and torque on the body far above the ground, in B, from the docstring's equations."""
    u = R.T @ (v_WB - wind)
    force = -0.5 * vehicle.air_density * np.linalg.norm(u) * np.array(vehicle.drag_areas) * u
    torque = np.zeros(3)
    for r, spin, speed in zip(vehicle.rotor_positions, vehicle.rotor_spins, speeds, strict=True):
        u_i = u + np.cross(w_WB_B, r)
        thrust = vehicle.thrust_coefficient * speed**2
        in_plane, axial = vehicle.rotor_drag_coefficient, vehicle.axial_drag_coefficient
        rotor = [0.0, 0.0, thrust] - speed * np.array([in_plane, in_plane, axial]) * u_i
        force += rotor
        torque += np.cross(r, rotor) - [0.0, 0.0, spin * vehicle.moment_constant * thrust]
    return force, torque


@pytest.mark.parametrize("name", VEHICLES)
def test_acceleration_equals_that_of_a_multibody_plant(name: str):
    vehicle = vehicle_named(name, ground_effect=0.0)
    plant = MultibodyPlant(time_step=0.0)
    inertia = SpatialInertia.MakeFromCentralInertia(
        vehicle.mass, np.zeros(3), RotationalInertia(*vehicle.inertia)
    )
    body = plant.AddRigidBody("body", inertia)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -vehicle.gravity])
    plant.Finalize()
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(7)
    for _ in range(20):
        R = RotationMatrix(Quaternion(quaternion_from_rotation_vector(rng.normal(size=3))))
        v, w, wind = 5.0 * rng.normal(size=3), 3.0 * rng.normal(size=3), 4.0 * rng.normal(size=3)
        speeds = rng.uniform(0.0, vehicle.maximum_rotor_speed, vehicle.rotor_count)
        force, torque = plain_wrench(vehicle, R.matrix(), v, w, speeds, wind)

        plant.SetFreeBodyPose(context, body, RigidTransform(R, [1.0, 2.0, 30.0]))
        velocity = np.concatenate((R @ w, v))
        plant.SetVelocities(context, velocity)
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = body.index()
        applied.F_Bq_W = SpatialForce(tau=R @ torque, f=R @ force)
        plant.get_applied_spatial_force_input_port().FixValue(context, [applied])
        expected = plant.EvalTimeDerivatives(context).CopyToVector()[-6:]

        state = np.concatenate((R.ToQuaternion().wxyz(), [1.0, 2.0, 30.0], v, w, speeds))
        dx = derivative(vehicle, state, np.zeros(vehicle.rotor_count), wind)
        angular_W = R @ dx[10:13]  # the derivative of w_WB_W is R ẇ, for w × w is nothing
        np.testing.assert_allclose(angular_W, expected[:3], rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(dx[7:10], expected[3:], rtol=1e-10, atol=1e-9)


def test_flight_equals_that_of_drakes_quadrotor():
    mass, arm, k_f, k_m = 0.775, 0.15, 1.0, 0.025
    inertia = [0.0015, 0.0025, 0.0035]
    quadrotor = QuadrotorPlant(mass, arm, np.diag(inertia), k_f, k_m)
    vehicle = Vehicle(
        mass=mass,
        inertia=inertia,
        rotor_positions=[[arm, 0, 0], [0, arm, 0], [-arm, 0, 0], [0, -arm, 0]],
        rotor_spins=[-1, 1, -1, 1],
        rotor_radius=0.1,
        thrust_coefficient=1.0,  # so that the speed squared is the thrust
        moment_constant=k_m / k_f,
        maximum_rotor_speed=2.0,
        time_constant_up=0.05,
        time_constant_down=0.05,
        rotor_drag_coefficient=0.0,
        axial_drag_coefficient=0.0,
        drag_areas=[0.0, 0.0, 0.0],
        ground_effect=0.0,
        feet=[[0.0, 0.0, -0.1]],
        leg_stiffness=100.0,
        gravity=9.81,  # Drake's
    )
    thrusts = np.array([1.91, 1.902, 1.908, 1.899])
    commands = thrusts / vehicle.maximum_thrust
    simulator = Simulator(quadrotor)
    integrator = simulator.get_mutable_integrator()
    integrator.set_target_accuracy(1e-10)
    integrator.set_maximum_step_size(0.002)
    context = simulator.get_mutable_context()
    rpy, rates = np.array([0.1, -0.2, 0.5]), np.array([0.3, -0.2, 0.4])
    context.SetContinuousState(np.concatenate(([0, 0, 10.0], rpy, [1.0, -0.5, 0.2], rates)))
    quadrotor.get_input_port(0).FixValue(context, thrusts)

    attitude = RollPitchYaw(rpy)
    body = np.zeros(17)
    body[:4] = attitude.ToQuaternion().wxyz()
    body[4:7], body[7:10] = [0, 0, 10.0], [1.0, -0.5, 0.2]
    body[10:13] = attitude.CalcAngularVelocityInChildFromRpyDt(rates)
    speeds = vehicle.maximum_rotor_speed * np.sqrt(commands)
    simulator.AdvanceTo(1.0)
    fly(vehicle, body, speeds, commands, 1.0)

    expected = context.get_continuous_state_vector().CopyToVector()
    np.testing.assert_allclose(body[4:7], expected[:3], atol=1e-8)
    np.testing.assert_allclose(body[7:10], expected[6:9], atol=1e-8)
    np.testing.assert_allclose(
        rotation_matrix(body[:4]),
        RollPitchYaw(expected[3:6]).ToRotationMatrix().matrix(),
        atol=1e-7,
    )


def test_two_substeps_in_flight_follow_a_fine_integrator():
    vehicle = vehicle_named("thesis_hexacopter")
    rng = np.random.default_rng(3)
    commands = vehicle.hover_command() * rng.uniform(0.97, 1.03, 6)
    wind = np.array([4.0, -2.0, 0.5])
    body = body_at(rotation=(0.1, 0.2, 0.3), v_WB=(2, 1, -1), w_WB_B=(0.5, -0.4, 0.3))
    speeds = np.full(6, 0.8 * vehicle.hover_rotor_speed())
    start = np.concatenate((body[:13], speeds))

    def rate(_, x):
        return derivative(vehicle, x, commands, wind)[: x.size]

    fine = solve_ivp(rate, (0.0, 1.0), start, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    fly(vehicle, body, speeds, commands, 1.0, wind)
    np.testing.assert_allclose(body[4:10], fine[4:10], atol=2e-6)
    np.testing.assert_allclose(body[:4], fine[:4] / np.linalg.norm(fine[:4]), atol=2e-6)
    np.testing.assert_allclose(speeds, fine[13:], rtol=1e-6)


@pytest.mark.parametrize("name", VEHICLES)
def test_hover_command_carries_the_weight(name: str):
    vehicle = vehicle_named(name, ground_effect=0.0)
    n = vehicle.rotor_count
    body = body_at()
    commands = np.full(n, vehicle.hover_command())
    fly(vehicle, body, np.full(n, vehicle.hover_rotor_speed()), commands, 1.0)
    np.testing.assert_allclose(body[4:13], [0, 0, 10.0, 0, 0, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(body[13:17], [0.0, 0.0, vehicle.gravity, 0.0], atol=1e-9)


@pytest.mark.parametrize("name", VEHICLES)
def test_allocation_matrix_predicts_the_wrench(name: str):
    vehicle = vehicle_named(name, ground_effect=0.0)
    commands = np.linspace(0.2, 0.6, vehicle.rotor_count)
    thrust, *torque = vehicle.allocation_matrix() @ commands
    speeds = vehicle.maximum_rotor_speed * np.sqrt(commands)
    dx = derivative(vehicle, np.concatenate((body_at()[:13], speeds)), commands)
    assert vehicle.mass * (dx[9] + vehicle.gravity) == pytest.approx(thrust)
    np.testing.assert_allclose(np.array(vehicle.inertia) * dx[10:13], torque, atol=1e-12)
    assert np.linalg.matrix_rank(vehicle.allocation_matrix()) == 4


def test_rotor_speeds_follow_the_root_of_the_command_with_their_time_constants():
    vehicle = vehicle_named("iris")
    speeds = np.zeros(4)
    fly(vehicle, body_at(), speeds, np.full(4, 0.25), 0.02)
    expected = 0.5 * vehicle.maximum_rotor_speed * (1.0 - math.exp(-0.02 / 0.0125))
    np.testing.assert_allclose(speeds, expected, rtol=2e-4)  # RK4, 5 ms, lag 12.5 ms
    speeds[:] = 800.0
    fly(vehicle, body_at(), speeds, np.zeros(4), 0.02)
    np.testing.assert_allclose(speeds, 800.0 * math.exp(-0.02 / 0.025), rtol=2e-5)
    speeds[:] = 0.0  # beyond the range, and not a number: the nearest, and none
    fly(vehicle, body_at(), speeds, np.array([7.0, -1.0, math.nan, 1.0]), 1.0)
    np.testing.assert_allclose(speeds, [1100.0, 0.0, 0.0, 1100.0], atol=1e-9)


def test_yaw_torque_opposes_the_spin():
    vehicle = vehicle_named("thesis_hexacopter")
    counter_clockwise = np.array(vehicle.rotor_spins) == 1
    speeds = np.where(counter_clockwise, 700.0, 500.0)
    dx = derivative(vehicle, np.concatenate((body_at()[:13], speeds)), np.zeros(6))
    assert dx[12] < 0.0  # the body turns clockwise


def test_wind_drags_and_pushes_towards_itself():
    vehicle = vehicle_named("thesis_hexacopter")
    speeds = np.full(6, vehicle.hover_rotor_speed())
    state = np.concatenate((body_at()[:13], speeds))
    dx = derivative(vehicle, state, np.zeros(6), wind=np.array([8.0, 0.0, 0.0]))
    parasitic = 0.5 * 1.225 * 0.025 * 8.0**2
    rotors = 1.75e-4 * speeds.sum() * 8.0
    assert vehicle.mass * dx[7] == pytest.approx(parasitic + rotors, rel=1e-9)
    # Only velocity relative to the air counts.
    state[7] = 8.0
    same = derivative(vehicle, state, np.zeros(6), wind=np.array([16.0, 0.0, 0.0]))
    np.testing.assert_allclose(same[7:13], dx[7:13], atol=1e-12)


def test_ground_effect_is_cheeseman_and_bennetts():
    vehicle = vehicle_named("thesis_hexacopter")
    radius, rotor_z = vehicle.rotor_radius, vehicle.rotor_positions[0][2]

    def gain(rotor_height, forward=0.0, pad=GROUND, factor=1.0):
        speeds = np.full(6, vehicle.hover_rotor_speed())
        vehicle.ground_effect = factor
        vehicle.drag_areas = [0.0, 0.0, 0.0]
        height = rotor_height - rotor_z + pad[2]
        state = np.concatenate((body_at((0, 0, height), v_WB=(forward, 0, 0))[:13], speeds))
        return derivative(vehicle, state, np.zeros(6), pad=pad)[9] / vehicle.gravity + 1.0

    for ratio, expected in ((1.0, 16 / 15), (2.0, 64 / 63), (0.6, 1 / (1 - 1 / 2.4**2))):
        assert gain(ratio * radius) == pytest.approx(expected, rel=1e-9)
    assert gain(0.1 * radius) == gain(0.5 * radius)  # the formula ends there
    assert gain(radius, factor=0.0) == pytest.approx(1.0)
    # At a forward speed of the induced velocity half of the term is left.
    thrust = vehicle.mass * vehicle.gravity / 6
    induced = math.sqrt(thrust / (2 * 1.225 * math.pi * radius**2))
    assert gain(radius, forward=induced) == pytest.approx(1 / (1 - 1 / 32), rel=1e-9)
    # A raised pad counts where the rotor is over it.
    pad = GROUND.copy()
    pad[2], pad[8] = 1.5, 3.0
    assert gain(radius, pad=pad) == pytest.approx(16 / 15, rel=1e-9)


class TestSpecificForce:
    def test_it_is_the_change_of_velocity_less_gravity_where_nothing_turns(self):
        vehicle = vehicle_named("thesis_hexacopter")
        vehicle.rotor_positions = [[x, y, 0.0] for x, y, _ in vehicle.rotor_positions]
        vehicle.ground_effect = 0.0
        body = body_at(v_WB=(3.0, 0.0, 0.0))
        wind = np.array([0.0, 3.0, 0.0])
        history = fly(vehicle, body, np.full(6, 400.0), np.full(6, 0.6), 0.4, wind)
        change = np.diff(history[:, 7:10], axis=0) / dynamics.STEP
        gravity = np.array([0.0, 0.0, vehicle.gravity])
        np.testing.assert_allclose(history[1:, 13:16], change + gravity, atol=1e-9)
        assert np.abs(history[1:, 13:15]).min() > 0.1

    def test_it_turns_with_the_body(self):
        """Summed up along the turning body it gives the velocity: what an IMU is for."""
        vehicle = vehicle_named("thesis_hexacopter")
        body = body_at(w_WB_B=(2.0, -3.0, 4.0))
        speeds = np.full(6, vehicle.hover_rotor_speed())
        history = fly(vehicle, body, speeds, np.full(6, 0.45), 1.0)
        v = np.zeros(3)
        for before, after in itertools.pairwise(history):
            middle = before[:4] + after[:4]
            R = rotation_matrix(middle / np.linalg.norm(middle))
            v += dynamics.STEP * (R @ after[13:16] - [0, 0, vehicle.gravity])
        np.testing.assert_allclose(v, body[7:10], atol=2e-4)

    def test_free_fall_and_standing(self):
        vehicle = vehicle_named("thesis_hexacopter", drag_areas=[0.0, 0.0, 0.0])
        history = fly(vehicle, body_at(), np.zeros(6), np.zeros(6), 0.5)
        np.testing.assert_allclose(history[1:, 13:17], 0.0, atol=1e-9)
        body = body_at((0, 0, vehicle.standing_height()))
        history = fly(vehicle, body, np.zeros(6), np.zeros(6), 0.5)
        weight = vehicle.mass * vehicle.gravity
        expected = np.tile([0, 0, vehicle.gravity, weight], (len(history) - 1, 1))
        np.testing.assert_allclose(history[1:, 13:17], expected)


class TestContact:
    @pytest.mark.parametrize("name", VEHICLES)
    def test_a_dropped_vehicle_comes_to_rest_at_its_standing_height(self, name: str):
        vehicle = vehicle_named(name)
        n = vehicle.rotor_count
        body = body_at((0, 0, vehicle.standing_height() + 0.3), rotation=(0.05, -0.03, 0.4))
        history = fly(vehicle, body, np.zeros(n), np.zeros(n), 3.0)
        assert body[6] == pytest.approx(vehicle.standing_height(), abs=1e-4)
        assert np.abs(body[7:13]).max() < 5e-3
        assert (history[:, 16] >= 0.0).all()
        assert body[16] == pytest.approx(vehicle.mass * vehicle.gravity, rel=1e-2)

    def test_legs_only_push_and_a_bounce_never_gives_energy(self):
        vehicle = vehicle_named(
            "thesis_hexacopter", drag_areas=[0.0, 0.0, 0.0], leg_dissipation=0.2, friction=0.0
        )
        body = body_at((0, 0, vehicle.standing_height() + 0.5))
        history = fly(vehicle, body, np.zeros(6), np.zeros(6), 3.0)
        free = history[:, 16] == 0.0
        energy = 0.5 * history[:, 9] ** 2 + vehicle.gravity * history[:, 6]
        flights = np.split(energy, np.flatnonzero(np.diff(free)) + 1)[::2]
        assert len(flights) > 3
        assert all(np.ptp(flight) < 1e-9 for flight in flights[:3])
        assert flights[0][0] > 1.05 * flights[1][0] > 1.1 * flights[2][0]
        assert (history[1:, 15] >= -1e-9).all()  # nothing ever pulls down

    def test_sliding_ends_after_coulombs_distance(self):
        vehicle = vehicle_named("dr_spider", drag_areas=[0.0, 0.0, 0.0], slip_speed=1e-3)
        body = body_at((0, 0, vehicle.standing_height()), v_WB=(1.0, 0, 0))
        # Wide and low enough not to topple: the centre of mass is moved down.
        vehicle.feet = [[x, y, -0.05] for x, y, _ in vehicle.feet]
        body[6] = vehicle.standing_height()
        parameters = vehicle.parameters()
        for _ in range(125):
            dynamics.integrate(
                body, np.zeros(8), np.zeros(8), CALM, GROUND, parameters, 0.008, 256, True
            )
        assert body[4] == pytest.approx(1.0 / (2 * 0.6 * vehicle.gravity), rel=0.02)
        assert abs(body[7]) < 1e-3

    @pytest.mark.parametrize("name", VEHICLES)
    def test_substeps_in_contact_agree_with_twelve_times_as_many(self, name: str):
        """A hard touchdown (1.5 m/s, tilted, sliding, in wind): within 0.05 mm after a second."""
        vehicle = vehicle_named(name)
        n = vehicle.rotor_count
        parameters = vehicle.parameters()
        wind = np.array([3.0, 0.0, 0.0])
        ends = []
        for substeps in (dynamics.CONTACT_SUBSTEPS, 400):
            body = body_at(
                (0, 0, vehicle.standing_height() + 0.1), (0.1, 0.05, 0.3), v_WB=(0.5, 0, -1.5)
            )
            speeds = np.full(n, 0.5 * vehicle.hover_rotor_speed())
            for _ in range(125):
                dynamics.integrate(
                    body, speeds, np.zeros(n), wind, GROUND, parameters, 0.008, substeps, True
                )
            ends.append(body)
        np.testing.assert_allclose(ends[0][4:7], ends[1][4:7], atol=5e-5)

    def test_contact_is_looked_for_in_time(self):
        """`step` decides on its sub-steps by itself and ends where an all-contact run ends."""
        vehicle = vehicle_named("thesis_hexacopter")
        parameters = vehicle.parameters()
        stepped = body_at((0, 0, 1.2), rotation=(0.1, 0, 0), v_WB=(0.2, 0, -2.0))
        fine = stepped.copy()
        for _ in range(150):
            dynamics.step(stepped, np.zeros(6), np.zeros(6), CALM, GROUND, parameters)
            dynamics.integrate(
                fine, np.zeros(6), np.zeros(6), CALM, GROUND, parameters, 0.008, 32, True
            )
        np.testing.assert_allclose(stepped[4:7], fine[4:7], atol=1e-4)

    def test_at_rest_it_sleeps_until_it_is_asked_to_move(self):
        vehicle = vehicle_named("iris")
        body, speeds = body_at((0, 0, vehicle.standing_height())), np.zeros(4)
        wind = np.array([5.0, 0.0, 0.0])
        fly(vehicle, body, speeds, np.zeros(4), 1.0, wind)
        asleep = body.copy()
        fly(vehicle, body, speeds, np.zeros(4), 1.0, wind)
        np.testing.assert_array_equal(body, asleep)
        assert body[16] == pytest.approx(vehicle.mass * vehicle.gravity, rel=0.01)
        sinking = GROUND.copy()
        sinking[6], sinking[8] = -0.1, 1.2
        assert not dynamics.at_rest(body, speeds, np.zeros(4), sinking, vehicle.parameters())
        fly(vehicle, body, speeds, np.full(4, 0.9), 0.5)
        assert body[6] > asleep[6] + 0.1

    def test_a_toppled_vehicle_lies_on_its_rotor_hubs(self):
        vehicle = vehicle_named("thesis_hexacopter")
        body = body_at((0, 0, 0.4), rotation=(math.pi - 0.1, 0, 0))
        fly(vehicle, body, np.zeros(6), np.zeros(6), 4.0)
        assert body[6] == pytest.approx(0.02, abs=0.01)
        assert rotation_matrix(body[:4])[2, 2] == pytest.approx(-1.0, abs=1e-3)

    def test_a_raised_pad_carries_and_beside_it_is_the_ground(self):
        vehicle = vehicle_named("thesis_hexacopter")
        pad = GROUND.copy()
        pad[2], pad[3], pad[8] = 0.5, 0.3, 1.2
        for x, surface in ((0.1, 0.5), (3.0, 0.0)):
            body = body_at((x, 0, vehicle.standing_height() + 0.7))
            fly(vehicle, body, np.zeros(6), np.zeros(6), 2.0, pad=pad)
            assert body[6] == pytest.approx(vehicle.standing_height() + surface, abs=1e-4)

    def test_a_moving_and_turning_pad_takes_the_vehicle_along(self):
        vehicle = vehicle_named("thesis_hexacopter", drag_areas=[0.0, 0.0, 0.0])
        parameters = vehicle.parameters()
        body = body_at((0, 0, vehicle.standing_height()))
        pad = PAD_STATE.zeros()
        pad[4:9] = 0.3, 0.1, 0.05, 0.2, 1.2
        for _ in range(250):
            dynamics.step(body, np.zeros(6), np.zeros(6), CALM, pad, parameters)
            pad[:3] += dynamics.STEP * pad[4:7]
            pad[3] += dynamics.STEP * pad[7]
        np.testing.assert_allclose(body[7:10], pad[4:7], atol=0.02)
        assert body[12] == pytest.approx(0.2, abs=1e-3)
        np.testing.assert_allclose(body[4:6], pad[:2], atol=0.02)
        assert body[6] == pytest.approx(pad[2] + vehicle.standing_height(), abs=1e-3)


def test_vehicles_are_balanced():
    for name in VEHICLES:
        vehicle = vehicle_named(name)
        matrix = vehicle.allocation_matrix()
        assert 0.3 < vehicle.hover_command() < 0.6, name
        assert abs(matrix[3].sum()) < 1e-9, name
        positions = np.array(vehicle.rotor_positions)
        gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        gaps += 10.0 * np.eye(len(positions))
        assert gaps.min() > 2 * vehicle.rotor_radius, f"{name}: propellers meet"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rotor_spins", [1, -1]),
        ("inertia", [0.1, 0.0, 0.1]),
        ("drag_areas", [0.1, 0.1, -0.1]),
        ("mass", 0.0),
        ("feet", []),
    ],
)
def test_impossible_vehicles_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        vehicle_named("iris", **{field: value})

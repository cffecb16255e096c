"""The multirotor as a system: ports, start, step, re-use; the template against the kernel."""

import math

import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.symbolic import Expression, Variable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    DiagramBuilder,
    InputPortIndex,
    OutputPortSelection,
)
from pydrake.systems.primitives import ConstantVectorSource, Linearize

from plants import multirotor_dynamics as dynamics
from plants.multirotor import ContinuousMultirotor, Multirotor, MultirotorConfig
from plants.vehicles import VEHICLES, vehicle_named
from systems.configuration import StructureChangedError
from systems.signals.measurement import BODY_STATE, PAD_STATE
from tests.system_contract import assert_matches_docstring, docstring_contract, periodic_update


def hovering(config: MultirotorConfig):
    builder = DiagramBuilder()
    multirotor = config.add_to(builder, "multirotor", seed=0)
    vehicle = config.resolved_vehicle()
    commands = np.full(vehicle.rotor_count, vehicle.hover_command())
    source = builder.AddSystem(ConstantVectorSource(commands))
    builder.Connect(source.get_output_port(), multirotor.GetInputPort("rotor_commands"))
    return builder.Build(), multirotor


def body_of(multirotor, root_context):
    context = multirotor.GetMyContextFromRoot(root_context)
    return multirotor.GetOutputPort("body").Eval(context)


def test_topology():
    contract = assert_matches_docstring(Multirotor(MultirotorConfig()))
    assert contract.optional == {"wind", "pad"}
    multirotor = Multirotor(MultirotorConfig(vehicle="dr_spider"))
    assert multirotor.GetInputPort("rotor_commands").size() == 8
    assert multirotor.GetOutputPort("rotor_speeds").size() == 8
    assert periodic_update(multirotor) == (0.01, 0.0)


def test_topology_of_the_continuous_system():
    plant = ContinuousMultirotor(vehicle_named("iris"))
    contract = docstring_contract(type(plant))
    assert contract.name == "ContinuousMultirotor"
    inputs = [plant.get_input_port(i) for i in range(plant.num_input_ports())]
    assert [(port.get_name(), port.size()) for port in inputs] == [
        ("rotor_commands", 4),
        ("wind", 3),
    ]
    assert contract.inputs == ("rotor_commands", "wind")
    assert plant.get_output_port().get_name() == contract.outputs[0] == "state"
    assert plant.get_output_port().size() == plant.num_continuous_states() == 17


class TestInitialState:
    def test_standing(self):
        config = MultirotorConfig(position=[1.0, 2.0, 0.0], yaw=0.5)
        diagram, multirotor = hovering(config)
        body = BODY_STATE(body_of(multirotor, diagram.CreateDefaultContext()))
        assert (body.p_WB_x, body.p_WB_y) == (1.0, 2.0)
        assert body.p_WB_z == config.resolved_vehicle().standing_height()
        assert 2.0 * math.atan2(body.q_WB_z, body.q_WB_w) == pytest.approx(0.5)
        assert body.f_B_z == pytest.approx(9.80665)
        assert body.contact_force == pytest.approx(2.5 * 9.80665)

    def test_flying(self):
        config = MultirotorConfig(position=[0.0, 0.0, 5.0], velocity=[1.0, 0.0, 0.0], flying=True)
        diagram, multirotor = hovering(config)
        context = multirotor.GetMyContextFromRoot(diagram.CreateDefaultContext())
        body = BODY_STATE(multirotor.GetOutputPort("body").Eval(context))
        assert (body.p_WB_z, body.v_WB_x, body.contact_force) == (5.2, 1.0, 0.0)
        speeds = multirotor.GetOutputPort("rotor_speeds").Eval(context)
        np.testing.assert_allclose(speeds, config.resolved_vehicle().hover_rotor_speed())


def test_one_update_is_one_step_of_the_kernel():
    config = MultirotorConfig(position=[0.0, 0.0, 3.0], flying=True)
    multirotor = Multirotor(config)
    context = multirotor.CreateDefaultContext()
    commands, wind = np.linspace(0.3, 0.5, 6), np.array([3.0, -1.0, 0.2])
    pad = PAD_STATE.zeros()
    multirotor.GetInputPort("rotor_commands").FixValue(context, commands)
    multirotor.GetInputPort("wind").FixValue(context, wind)
    multirotor.GetInputPort("pad").FixValue(context, pad)
    updated = multirotor.EvalUniquePeriodicDiscreteUpdate(context)
    body, speeds = config.initial_body(), config.initial_rotor_speeds()
    dynamics.step(body, speeds, commands, wind, pad, config.resolved_vehicle().parameters())
    np.testing.assert_array_equal(updated.value(0), body)
    np.testing.assert_array_equal(updated.value(1), speeds)
    assert body[7] > 0.0


def test_hovers_for_a_second():
    config = MultirotorConfig(position=[0.0, 0.0, 3.0], flying=True, ground_effect=0.0)
    diagram, multirotor = hovering(config)
    simulator = Simulator(diagram)
    assert simulator.AdvanceTo(1.0).reason().name == "kReachedBoundaryTime"
    body = body_of(multirotor, simulator.get_context())
    np.testing.assert_allclose(body[4:13], [0, 0, 3.2, 0, 0, 0, 0, 0, 0], atol=1e-9)


def test_the_same_run_twice_is_the_same_bytes_and_resumes_from_a_clone():
    config = MultirotorConfig(position=[0.0, 0.0, 0.3], velocity=[0.4, 0.1, 0.0], mass=3.0)
    diagram, multirotor = hovering(config)
    ends = []
    for _ in range(2):
        simulator = Simulator(diagram)
        simulator.AdvanceTo(0.5)
        half = simulator.get_context().Clone()
        simulator.AdvanceTo(1.0)
        ends.append(body_of(multirotor, simulator.get_context()).tobytes())
    resumed = Simulator(diagram, half)
    resumed.AdvanceTo(1.0)
    ends.append(body_of(multirotor, resumed.get_context()).tobytes())
    assert ends[0] == ends[1] == ends[2]


class TestConfigure:
    def test_another_start_and_another_vehicle_of_the_same_rotor_count(self):
        diagram, multirotor = hovering(MultirotorConfig())
        multirotor.configure(MultirotorConfig(position=[0.0, 0.0, 9.0], flying=True, mass=2.0))
        simulator = Simulator(diagram)
        simulator.Initialize()
        assert body_of(multirotor, simulator.get_context())[6] == pytest.approx(9.2)
        simulator.AdvanceTo(1.0)  # the commands are for 2.5 kg
        assert body_of(multirotor, simulator.get_context())[9] > 1.0

    def test_a_state_set_by_hand_stays(self):
        diagram, multirotor = hovering(MultirotorConfig())
        multirotor.configure(MultirotorConfig(position=[0.0, 0.0, 9.0], flying=True))
        simulator = Simulator(diagram)
        context = multirotor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        by_hand = MultirotorConfig(position=[4.0, 0.0, 2.0]).initial_body()
        context.SetDiscreteState(0, by_hand)
        simulator.Initialize()
        np.testing.assert_array_equal(body_of(multirotor, simulator.get_context()), by_hand)

    def test_the_number_of_rotors_shapes_the_diagram(self):
        multirotor = Multirotor(MultirotorConfig())
        with pytest.raises(StructureChangedError, match="rotor_count"):
            multirotor.configure(MultirotorConfig(vehicle="iris"))

    def test_overrides_and_a_vehicle_in_full(self):
        iris = vehicle_named("iris", mass=1.7)
        config = MultirotorConfig(vehicle=iris, drag_areas=[0.1, 0.1, 0.1])
        assert config.resolved_vehicle().mass == 1.7
        assert config.resolved_vehicle().drag_areas == [0.1, 0.1, 0.1]
        assert config.rotor_count == 4
        assert iris.drag_areas == [0.0, 0.0, 0.0]


class TestContinuousMultirotor:
    @pytest.mark.parametrize("name", VEHICLES)
    def test_derivatives_equal_the_kernels(self, name: str):
        vehicle = vehicle_named(name)
        n = vehicle.rotor_count
        plant = ContinuousMultirotor(vehicle)
        context = plant.CreateDefaultContext()
        rng = np.random.default_rng(1)
        for _ in range(20):
            x = rng.normal(size=13 + n)
            x[:4] /= np.linalg.norm(x[:4])
            x[6] = rng.uniform(0.0, 0.5)  # in ground effect
            x[7:10] *= 4.0
            x[13:] = rng.uniform(0.0, vehicle.maximum_rotor_speed, n)
            commands, wind = rng.uniform(0.0, 1.0, n), 4.0 * rng.normal(size=3)
            plant.GetInputPort("rotor_commands").FixValue(context, commands)
            plant.GetInputPort("wind").FixValue(context, wind)
            context.SetContinuousState(x)
            dx = np.zeros(17 + n)
            dynamics.derivatives(
                x, commands, wind, PAD_STATE.zeros(), 0.0, False, vehicle.parameters(), dx
            )
            expected = plant.EvalTimeDerivatives(context).CopyToVector()
            np.testing.assert_allclose(dx[: 13 + n], expected, rtol=1e-12, atol=1e-11)

    def test_expressions_evaluate_to_the_floats(self):
        vehicle = vehicle_named("iris")
        plant = ContinuousMultirotor(vehicle)
        symbolic = plant.ToSymbolic()
        context = symbolic.CreateDefaultContext()
        states = [Variable(f"x{i}") for i in range(17)]
        commands = [Variable(f"c{i}") for i in range(4)]
        context.SetContinuousState([Expression(x) for x in states])
        port = symbolic.GetInputPort("rotor_commands")
        port.FixValue(context, [Expression(c) for c in commands])
        expressions = symbolic.EvalTimeDerivatives(context).CopyToVector()

        rng = np.random.default_rng(2)
        values = np.concatenate(
            ([0.5, 0.5, -0.5, 0.5], rng.uniform(0.1, 1.0, 9), [500, 600, 700, 800])
        )
        inputs = rng.uniform(0.0, 1.0, 4)
        environment = dict(zip([*states, *commands], [*values, *inputs], strict=True))
        floats = plant.CreateDefaultContext()
        floats.SetContinuousState(values)
        plant.GetInputPort("rotor_commands").FixValue(floats, inputs)
        np.testing.assert_allclose(
            [expression.Evaluate(environment) for expression in expressions],
            plant.EvalTimeDerivatives(floats).CopyToVector(),
            rtol=1e-12,
            atol=1e-12,
        )

    def test_gradients_equal_finite_differences(self):
        vehicle = vehicle_named("iris")
        plant = ContinuousMultirotor(vehicle)
        rng = np.random.default_rng(4)
        x = np.concatenate(([0.5, 0.5, -0.5, 0.5], rng.uniform(0.1, 1.0, 9), [500, 600, 700, 800]))
        wind, commands = np.array([3.0, 1.0, 0.5]), rng.uniform(0.2, 1.0, 4)
        automatic = plant.ToAutoDiffXd()
        context = automatic.CreateDefaultContext()
        automatic.GetInputPort("rotor_commands").FixValue(
            context, [AutoDiffXd(c) for c in commands]
        )
        automatic.GetInputPort("wind").FixValue(context, [AutoDiffXd(w) for w in wind])
        context.SetContinuousState(InitializeAutoDiff(x).ravel())
        gradient = ExtractGradient(automatic.EvalTimeDerivatives(context).CopyToVector())

        def rate(state):
            dx = np.zeros(21)
            parameters = vehicle.parameters()
            dynamics.derivatives(
                state, commands, wind, PAD_STATE.zeros(), 0.0, False, parameters, dx
            )
            return dx[:17]

        for i in range(17):
            step = np.zeros(17)
            step[i] = 1e-6 * max(1.0, abs(x[i]))
            numeric = (rate(x + step) - rate(x - step)) / (2.0 * step[i])
            np.testing.assert_allclose(gradient[:, i], numeric, rtol=1e-5, atol=1e-5)

    def test_linearises_at_hover(self):
        vehicle = vehicle_named("thesis_hexacopter", ground_effect=0.0)
        plant = ContinuousMultirotor(vehicle)
        context = plant.CreateDefaultContext()
        commands = np.full(6, vehicle.hover_command())
        plant.GetInputPort("rotor_commands").FixValue(context, commands)
        linear = Linearize(plant, context, InputPortIndex(0), OutputPortSelection.kNoOutput)
        A, B = linear.A(), linear.B()
        assert np.isfinite(A).all()
        speed = vehicle.hover_rotor_speed()
        # Level, a tilt of 2 q_y accelerates forward by g; rotor drag damps the motion.
        assert A[7, 2] == pytest.approx(2.0 * vehicle.gravity)
        assert A[7, 7] == pytest.approx(-6 * speed * 1.75e-4 / vehicle.mass)
        np.testing.assert_allclose(np.diag(A)[13:], -1.0 / vehicle.time_constant_up)
        expected = vehicle.maximum_rotor_speed / (2 * math.sqrt(commands[0]))
        np.testing.assert_allclose(np.diag(B[13:]), expected / vehicle.time_constant_down)

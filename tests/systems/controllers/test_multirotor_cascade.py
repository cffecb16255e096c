"""The cascade as a system, and in the loop with the plant on the real schedule."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from plants.multirotor import MultirotorConfig
from plants.vehicles import vehicle_named
from plants.wind import WindConfig
from systems.configuration import StructureChangedError
from systems.controllers.multirotor_cascade import (
    CASCADE_SETPOINTS,
    MultirotorCascade,
    MultirotorCascadeConfig,
)
from systems.schedule import PLANT_PERIOD, SUPERVISOR_PERIOD
from systems.signals.measurement import (
    BODY_STATE,
    INERTIAL,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from tests.system_contract import assert_matches_docstring, periodic_update

VEHICLES = ("thesis_hexacopter", "iris", "dr_spider")
NAN = math.nan
HEIGHT = 10.0  # m, of the feet
Q, P, V, W = (BODY_STATE.slice(vector) for vector in ("q_WB", "p_WB", "v_WB", "w_WB_B"))
GYRO = slice(INERTIAL.index("delta_angle_x"), INERTIAL.index("delta_angle_z") + 1)
POSE_AND_VELOCITY = slice(VEHICLE_ESTIMATE.index("q_WB_w"), VEHICLE_ESTIMATE.index("v_WB_z") + 1)


class PerfectNavigation(LeafSystem):
    """The body's state as estimate and gyro sample, at the times of the real schedule.

    The gyro's mean over the last period leaves at 0 ms, the estimate that knows it
    at 10 ms, so that the controller sees it at 20 ms.
    """

    def __init__(self, gyro_bias: np.ndarray):
        super().__init__()
        self._bias = gyro_bias
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size)
        estimate = self.DeclareDiscreteState(BasicVector(VEHICLE_ESTIMATE.zeros()))
        imu = self.DeclareDiscreteState(BasicVector(no_measurement(INERTIAL)))
        self.DeclareDiscreteState(BasicVector(BODY_STATE.zeros()))
        self.DeclareStateOutputPort("estimate", estimate)
        self.DeclareStateOutputPort("imu", imu)
        self.DeclarePeriodicDiscreteUpdateEvent(PLANT_PERIOD, 0.0, self._sense)
        self.DeclarePeriodicDiscreteUpdateEvent(PLANT_PERIOD, 0.0, self._estimate)

    def _sense(self, context, values):
        body, last, imu = (
            self._body.Eval(context),
            values.get_mutable_value(2),
            values.get_mutable_value(1),
        )
        imu[:4] = context.get_time(), context.get_time(), imu[2] + 1.0, 1.0
        before = last[W] if imu[2] > 0.0 else body[W]
        imu[GYRO] = (0.5 * (before + body[W]) + self._bias) * PLANT_PERIOD
        imu[INERTIAL.index("delta_angle_dt")] = PLANT_PERIOD
        last[:] = body

    def _estimate(self, context, values):
        state = context.get_discrete_state()
        imu, estimate = state.value(1), values.get_mutable_value(0)
        if imu[3] == 0.0:
            return  # no sample yet
        estimate[:4] = imu[0], 1.0, 1.0, 1.0  # time, attitude, horizontal and vertical valid
        estimate[POSE_AND_VELOCITY] = state.value(2)[:10]
        estimate[VEHICLE_ESTIMATE.slice("w_WB_B")] = imu[GYRO] / PLANT_PERIOD - self._bias


class Script(LeafSystem):
    """A setpoint as a function of time, renewed every 40 ms as a supervisor's is."""

    def __init__(self, script):
        super().__init__()
        self._script = script
        state = self.DeclareDiscreteState(BasicVector(script(0.0)))
        self.DeclareStateOutputPort("setpoint", state)
        self.DeclarePeriodicDiscreteUpdateEvent(SUPERVISOR_PERIOD, 0.0, self._update)

    def _update(self, context, values):
        values.get_mutable_value()[:] = self._script(context.get_time())


def goal(p=(NAN, NAN, NAN), v=(NAN, NAN, NAN), yaw=0.0, armed=1.0, maximum_speed=5.0) -> list:
    return [*p, *v, yaw, armed, maximum_speed, NAN, NAN, NAN]


def flying_height(vehicle: str) -> float:
    """Height of B's origin when the feet are at HEIGHT, m."""
    return HEIGHT - min(foot[2] for foot in vehicle_named(vehicle).feet)


class Loop:
    """Plant, perfect navigation and controller, in one diagram."""

    def __init__(
        self, vehicle, script, flying=True, wind=None, gyro_bias=(0.0, 0.0, 0.0), gyro=True,
        mass=None, height=HEIGHT, log_period=0.04, **config,
    ):  # fmt: skip
        builder = DiagramBuilder()
        self.plant = MultirotorConfig(
            vehicle=vehicle,
            flying=flying,
            mass=mass,
            position=[0.0, 0.0, height if flying else 0.0],
        ).add_to(builder, "plant")
        navigation = builder.AddSystem(PerfectNavigation(np.array(gyro_bias)))
        self.controller = MultirotorCascadeConfig(vehicle=vehicle, flying=flying, **config).add_to(
            builder, "controller"
        )
        body = self.plant.GetOutputPort("body")
        commands = self.controller.GetOutputPort("rotor_commands")
        builder.Connect(body, navigation.GetInputPort("body"))
        builder.Connect(
            navigation.GetOutputPort("estimate"), self.controller.GetInputPort("estimate")
        )
        if gyro:
            builder.Connect(navigation.GetOutputPort("imu"), self.controller.GetInputPort("imu"))
        builder.Connect(
            builder.AddSystem(Script(script)).get_output_port(),
            self.controller.GetInputPort("setpoint"),
        )
        builder.Connect(commands, self.plant.GetInputPort("rotor_commands"))
        if wind is not None:
            config, seed = wind
            air = config.add_to(builder, "wind", seed)
            builder.Connect(body, air.GetInputPort("body"))
            builder.Connect(air.GetOutputPort("wind"), self.plant.GetInputPort("wind"))
        ports = (body, self.controller.GetOutputPort("setpoints"), commands)
        self._logs = [LogVectorOutput(port, builder, log_period) for port in ports]
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()

    def fly(self, duration: float) -> "Flight":
        simulator = Simulator(self.diagram, self.context)
        simulator.AdvanceTo(self.context.get_time() + duration)
        logs = [log.FindLog(self.context) for log in self._logs]
        return Flight(logs[0].sample_times().copy(), *(log.data().T.copy() for log in logs))


@dataclass
class Flight:
    """What was logged: times (n,), body states, setpoints and rotor commands (n, size)."""

    t: np.ndarray
    body: np.ndarray
    setpoints: np.ndarray
    rotors: np.ndarray

    @property
    def tilt(self) -> np.ndarray:
        q = self.body[:, Q]
        return np.arccos(np.clip(1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2), -1, 1))

    @property
    def yaw(self) -> np.ndarray:
        w, x, y, z = self.body[:, Q].T
        return np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def hold(vehicle: str, t: float) -> list:
    return goal(p=(0.0, 0.0, flying_height(vehicle)))


# The system


def test_topology():
    contract = assert_matches_docstring(MultirotorCascade(MultirotorCascadeConfig()))
    assert contract.optional == {"imu"}


def test_rotor_commands_have_the_vehicles_size():
    for vehicle, count in zip(VEHICLES, (6, 4, 8), strict=True):
        controller = MultirotorCascade(MultirotorCascadeConfig(vehicle=vehicle))
        assert controller.GetOutputPort("rotor_commands").size() == count
        assert controller.GetOutputPort("setpoints").size() == CASCADE_SETPOINTS.size


def test_updates_every_tick():
    controller = MultirotorCascade(MultirotorCascadeConfig())
    assert periodic_update(controller) == (PLANT_PERIOD, 0.0)


def test_initial_commands_stand_or_hover():
    for flying, command in ((False, 0.0), (True, vehicle_named("iris").hover_command())):
        controller = MultirotorCascade(MultirotorCascadeConfig(vehicle="iris", flying=flying))
        commands = controller.GetOutputPort("rotor_commands").Eval(
            controller.CreateDefaultContext()
        )
        np.testing.assert_allclose(commands, command, rtol=1e-12)


def test_configure_changes_gains_and_start_but_not_the_number_of_rotors():
    loop = Loop("iris", partial(hold, "iris"), flying=True)
    loop.controller.configure(MultirotorCascadeConfig(vehicle="iris", flying=False))
    context = loop.diagram.CreateDefaultContext()
    Simulator(loop.diagram, context).Initialize()
    own = loop.controller.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(loop.controller.GetOutputPort("rotor_commands").Eval(own), 0.0)
    with pytest.raises(StructureChangedError, match="rotor_count"):
        loop.controller.configure(MultirotorCascadeConfig(vehicle="dr_spider"))


def test_a_vehicle_that_cannot_yaw_is_refused():
    torqueless = vehicle_named("iris", moment_constant=0.0)
    with pytest.raises(ValueError, match="three axes"):
        MultirotorCascade(MultirotorCascadeConfig(vehicle=torqueless))


def test_a_resumed_run_is_the_same_run():
    def script(t):
        return goal(p=(1.0, 0.0, flying_height("iris")))

    whole = Loop("iris", script)
    first = whole.fly(1.0)
    copy = whole.context.Clone()
    through = whole.fly(1.0)
    whole.context = copy
    resumed = whole.fly(1.0)
    assert len(first.t) < len(through.t)
    np.testing.assert_array_equal(through.body, resumed.body)
    np.testing.assert_array_equal(through.setpoints, resumed.setpoints)


# In the loop


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_hovers_on_the_spot(vehicle):
    flight = Loop(vehicle, partial(hold, vehicle)).fly(5.0)
    error = flight.body[flight.t > 4.0, P] - [0.0, 0.0, flying_height(vehicle)]
    assert np.abs(error).max() < 1e-3


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_step_of_two_metres_is_smooth_and_settles(vehicle):
    start, z = 1.0, flying_height(vehicle)
    loop = Loop(vehicle, lambda t: goal(p=(0.0 if t < start else 2.0, 0.0, z)))
    flight = loop.fly(10.0)
    x = flight.body[:, P][:, 0]
    assert x.max() < 2.0 * 1.02  # measured: at most 0.6 % of overshoot
    outside = flight.t[np.abs(x - 2.0) > 0.1]
    assert outside[-1] - start < 6.5  # measured: 5.4 to 5.5 s
    assert np.degrees(flight.tilt.max()) < 15.0
    assert np.abs(flight.body[:, P][:, 1]).max() < 0.01
    assert np.abs(flight.body[:, P][:, 2] - z).max() < 0.02


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_holds_its_place_in_wind_and_gusts(vehicle):
    wind = (WindConfig(speed=5.0), 1)
    flight = Loop(vehicle, partial(hold, vehicle), wind=wind).fly(35.0)
    settled = flight.t > 15.0
    error = flight.body[settled, P] - [0.0, 0.0, flying_height(vehicle)]
    # 0.17 m over four flights of 45 s with the Iris, the worst of the three
    assert np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))) < 0.25
    assert np.abs(error[:, 2]).max() < 0.4
    assert np.degrees(flight.tilt.max()) < 25.0


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_descends_and_stands_still_when_it_has_landed(vehicle):
    def script(t):
        return goal(p=(0.0, 0.0, NAN), v=(NAN, NAN, 0.0 if t < 0.5 else -0.5), armed=t < 15.0)

    flight = Loop(vehicle, script, height=4.0).fly(16.0)
    force = flight.body[:, BODY_STATE.index("contact_force")]
    touched = flight.t[np.argmax(force > 0.0)]
    assert 8.0 < touched < 10.0
    sinking = (flight.t > 3.0) & (flight.t < touched - 1.0)
    speed = flight.body[sinking, V][:, 2]
    assert speed[0] == pytest.approx(-0.5, abs=0.05)
    assert speed[-1] == pytest.approx(-0.5, abs=0.012)  # integrated away with P/I = 2 s
    landed = (flight.t > touched + 3.0) & (flight.t < 15.0)
    contact = flight.setpoints[:, CASCADE_SETPOINTS.index("ground_contact")]
    assert contact[flight.t < touched].max() == 0.0
    assert contact[landed].min() == 1.0
    assert np.hypot(*flight.body[landed, P][:, :2].T).max() < 0.05
    assert np.degrees(flight.tilt[flight.t > touched].max()) < 3.0
    assert flight.rotors[-1].max() == 0.0
    assert np.abs(flight.body[-1, V]).max() < 1e-3


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_takes_off_by_the_ramp(vehicle):
    loop = Loop(vehicle, lambda t: goal(p=(0.0, 0.0, 3.0), armed=t > 0.5), flying=False)
    flight = loop.fly(14.0)
    assert flight.rotors[flight.t < 0.5].max() == 0.0
    assert np.abs(np.diff(flight.rotors, axis=0)).max() < 0.1
    z = flight.body[:, P][:, 2]
    assert z.max() < 3.05
    assert z[-1] == pytest.approx(3.0, abs=0.05)
    assert flight.body[:, V][:, 2].max() < 1.6  # MPC_TKO_SPEED
    assert np.hypot(*flight.body[:, P][:, :2].T).max() < 0.02


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_yaw_step_turns_on_the_spot(vehicle):
    z = flying_height(vehicle)
    loop = Loop(vehicle, lambda t: goal(p=(0.0, 0.0, z), yaw=0.0 if t < 1.0 else math.pi / 2))
    flight = loop.fly(8.0)
    error = np.degrees(flight.yaw) - 90.0
    assert error.max() < 3.0
    assert np.abs(error[flight.t > 4.5]).max() < 2.0
    assert np.degrees(np.diff(flight.yaw).max()) / 0.04 < 60.0  # MPC_YAWRAUTO_MAX 45 deg/s
    error = flight.body[:, P] - [0.0, 0.0, z]
    assert np.abs(error).max() < 0.02


def test_follows_a_moving_target_with_its_velocity_as_feed_forward():
    z = flying_height("dr_spider")
    loop = Loop("dr_spider", lambda t: goal(p=(1.0 * t, 0.0, z), v=(1.0, 0.0, 0.0)))
    flight = loop.fly(16.0)
    late = flight.t > 13.0
    # measured: 13 mm behind, less than the setpoint moves in its 40 ms
    assert np.abs(flight.body[late, P][:, 0] - flight.t[late]).max() < 0.05


def test_everything_at_once_saturates_and_recovers():
    """An overloaded vehicle flies sideways, up and around: rotors at their limits."""
    z = flying_height("thesis_hexacopter")

    def script(t):
        return goal(p=(30.0, -20.0, z + 20.0), yaw=3.0, maximum_speed=12.0)

    loop = Loop("thesis_hexacopter", script, mass=4.4)
    flight = loop.fly(28.0)
    assert flight.rotors.max() > 0.95
    assert flight.rotors.min() >= 0.0
    assert np.degrees(flight.tilt.max()) < 50.0
    np.testing.assert_allclose(flight.body[-1, P], [30.0, -20.0, z + 20.0], atol=0.1)
    assert math.remainder(flight.yaw[-1] - 3.0, 2 * math.pi) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_recovers_from_being_thrown(vehicle):
    loop = Loop(vehicle, partial(hold, vehicle))
    state = loop.plant.GetMyContextFromRoot(loop.context).get_mutable_discrete_state(0)
    tilt = math.radians(75.0)
    body = state.get_mutable_value()
    body[Q] = math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0
    body[BODY_STATE.slice("w_WB_B")] = 5.0, -2.5, 2.0
    flight = loop.fly(12.0)
    shares = flight.setpoints[1:, CASCADE_SETPOINTS.index("roll_pitch_share")]
    assert shares.min() < 1.0
    assert np.degrees(flight.tilt[flight.t > 1.5].max()) < 46.0
    assert np.degrees(flight.tilt[-1]) < 1.0
    np.testing.assert_allclose(flight.body[-1, P], [0, 0, flying_height(vehicle)], atol=0.3)


def test_a_biased_gyro_flies_as_an_unbiased_one_and_no_gyro_flies_too():
    def script(t):
        return goal(p=(0.0 if t < 1.0 else 1.0, 0.0, flying_height("iris")))

    plain = Loop("iris", script).fly(6.0)
    biased = Loop("iris", script, gyro_bias=(0.05, -0.03, 0.02)).fly(6.0)
    without = Loop("iris", script, gyro=False).fly(6.0)
    np.testing.assert_allclose(biased.body[:, P], plain.body[:, P], atol=2e-3)
    np.testing.assert_allclose(without.body[:, P], plain.body[:, P], atol=0.05)

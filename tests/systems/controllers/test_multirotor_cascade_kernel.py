"""The stages of the cascade against plain references and against a log of PX4 itself."""

import math

import numpy as np
import pytest
from pyulog import ULog
from scipy.optimize import linprog
from scipy.signal import butter
from scipy.spatial.transform import Rotation

from plants.vehicles import vehicle_named
from systems.controllers import multirotor_cascade_kernel as kernel
from systems.controllers.multirotor_cascade import MultirotorCascadeConfig
from systems.controllers.multirotor_cascade_kernel import (
    CASCADE_SETPOINTS,
    GRAVITY,
    PARAMETERS,
    STATE,
)
from systems.frames import attitude_ned_from_world, frd_from_body, ned_from_world
from systems.schedule import PLANT_PERIOD
from systems.signals.measurement import INERTIAL, SETPOINT, VEHICLE_ESTIMATE
from tests.shared_data import shared

VEHICLES = ("thesis_hexacopter", "iris", "dr_spider")
NAN3 = (math.nan,) * 3


def test_indices_are_those_of_the_layouts():
    estimate, imu, setpoint = VEHICLE_ESTIMATE.index, INERTIAL.index, SETPOINT.index
    assert estimate("attitude_valid") == kernel._ATTITUDE_VALID
    assert estimate("horizontal_valid") == kernel._HORIZONTAL_VALID
    assert estimate("vertical_valid") == kernel._VERTICAL_VALID
    assert estimate("q_WB_w") == kernel._Q
    assert estimate("p_WB_x") == kernel._P
    assert estimate("v_WB_x") == kernel._V
    assert estimate("w_WB_B_x") == kernel._W
    assert estimate("horizontal_reset_counter") == kernel._HORIZONTAL_RESET_COUNTER
    assert estimate("horizontal_reset_x") == kernel._HORIZONTAL_RESET
    assert estimate("vertical_reset_counter") == kernel._VERTICAL_RESET_COUNTER
    assert estimate("vertical_reset") == kernel._VERTICAL_RESET
    assert imu("valid") == kernel._IMU_VALID
    assert imu("delta_angle_x") == kernel._DELTA_ANGLE
    assert imu("delta_angle_dt") == kernel._DELTA_ANGLE_DT
    assert setpoint("p_WB_x") == kernel._P_SP
    assert setpoint("v_WB_x") == kernel._V_SP
    assert setpoint("yaw") == kernel._YAW_SP
    assert setpoint("armed") == kernel._ARMED
    assert setpoint("maximum_speed") == kernel._MAXIMUM_SPEED
    assert setpoint("a_WB_x") == kernel._A_SP


# Trajectory


def test_square_root_law_brakes_within_its_limit():
    gain, limit, dt = 0.5, 1.5, 0.001
    distance = 40.0
    speeds = []
    while distance > 0.01:
        speeds.append(kernel.square_root_law(distance, gain, limit))
        distance -= speeds[-1] * dt
    braking = -np.diff(speeds) / dt
    assert braking.max() < 1.001 * limit
    assert braking[0] == pytest.approx(limit, rel=1e-3)  # far away it uses all of it
    assert kernel.square_root_law(-3.0, gain, limit) == -kernel.square_root_law(3.0, gain, limit)
    assert kernel.square_root_law(0.2, gain, limit) == pytest.approx(gain * 0.2)


@pytest.mark.parametrize("target", [5.0, -5.0, 0.3])
def test_s_curve_keeps_acceleration_and_jerk_and_is_nearly_time_optimal(target):
    a_max, jerk, dt = 3.0, 4.0, 0.004
    v = a = 0.0
    vs, accelerations = [v], [a]
    for _ in range(1500):
        v, a = kernel.smooth_velocity(v, a, target, a_max, jerk, dt)
        vs.append(v)
        accelerations.append(a)
    assert np.abs(accelerations).max() <= a_max + 1e-9
    assert np.abs(np.diff(accelerations)).max() / dt <= jerk + 1e-9
    assert v == pytest.approx(target, rel=1e-3)
    assert np.max(np.array(vs) / target) < 1.02  # hardly an overshoot
    change = abs(target)
    best = change / a_max + a_max / jerk if change > a_max**2 / jerk else 2 * (change / jerk) ** 0.5
    reached = np.argmax(np.array(vs) / target > 0.95) * dt
    assert 0.8 * best < reached < 1.3 * best + 1.5 / kernel.VELOCITY_SMOOTHING


def test_plane_s_curve_moves_along_the_straight_line_like_one_axis():
    direction = np.array([0.6, -0.8])
    v = np.zeros(2)
    a = np.zeros(2)
    v1 = a1 = 0.0
    for _ in range(700):
        *v, ax, ay = kernel.smooth_velocity_plane(*v, *a, *(4.0 * direction), 3.0, 4.0, 0.004)
        a = np.array([ax, ay])
        v1, a1 = kernel.smooth_velocity(v1, a1, 4.0, 3.0, 4.0, 0.004)
        np.testing.assert_allclose(v, v1 * direction, atol=1e-12)


# Thrust and attitude


def test_thrust_without_saturation_lifts_and_tilts_as_asked():
    a = np.array([1.5, -0.7, 0.4])
    hover = 0.45
    thrust, tx, ty, vertical, _ = kernel.thrust_vector(*a, hover, 0.1, 1.0, 0.3, math.radians(45))
    vector = thrust * np.array([tx, ty, 1.0]) / math.sqrt(tx**2 + ty**2 + 1)
    up = hover * (1 + a[2] / GRAVITY)
    np.testing.assert_allclose(vector, [up * a[0] / GRAVITY, up * a[1] / GRAVITY, up], atol=1e-12)
    assert vertical == pytest.approx(up)


def test_thrust_saturates_with_height_before_position_but_for_the_margin():
    tilt = math.radians(45)
    rng = np.random.default_rng(3)
    for a in rng.uniform(-40, 40, (300, 3)):
        thrust, tx, ty, _, _ = kernel.thrust_vector(*a, 0.5, 0.12, 1.0, 0.3, tilt)
        vector = thrust * np.array([tx, ty, 1.0]) / math.sqrt(tx**2 + ty**2 + 1)
        assert math.hypot(tx, ty) <= math.tan(tilt) + 1e-12
        assert vector[2] >= 0.12 - 1e-12
        assert thrust <= 1.0 + 1e-12
        assert vector[0] * a[1] - vector[1] * a[0] == pytest.approx(0.0, abs=1e-12)  # same bearing
    # full climb and full tilt: 0.3 goes to the side, what is left upwards
    thrust, tx, ty, _, _ = kernel.thrust_vector(30.0, 0.0, 30.0, 0.5, 0.12, 1.0, 0.3, tilt)
    upward = thrust / math.sqrt(1 + tx * tx)
    assert upward == pytest.approx(math.sqrt(1 - 0.3**2))
    assert upward * tx == pytest.approx(0.3)


def test_attitude_of_thrust_has_thrusts_z_and_yaws_heading():
    rng = np.random.default_rng(4)
    for tx, ty, yaw in rng.uniform([-2, -2, -math.pi], [2, 2, math.pi], (200, 3)):
        w, x, y, z = kernel.attitude_of_thrust(tx, ty, yaw)
        R = Rotation.from_quat([x, y, z, w]).as_matrix()
        axis = np.array([tx, ty, 1.0]) / math.sqrt(tx * tx + ty * ty + 1)
        np.testing.assert_allclose(R[:, 2], axis, atol=1e-12)
        left = np.cross(axis, [math.cos(yaw), math.sin(yaw), 0.0])
        np.testing.assert_allclose(R[:, 1], left / np.linalg.norm(left), atol=1e-12)
        assert w >= 0.0


def shortest_turn(a: np.ndarray, b: np.ndarray) -> Rotation:
    axis = np.cross(a, b)
    angle = math.atan2(np.linalg.norm(axis), a @ b)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle)


@pytest.mark.parametrize("weight", [0.1, 0.4, 1.0])
def test_attitude_error_is_the_reduced_attitude_and_a_share_of_the_rest(weight):
    rng = np.random.default_rng(5)
    z = np.array([0.0, 0.0, 1.0])
    for body, goal in zip(
        Rotation.random(100, rng=rng), Rotation.random(100, rng=rng), strict=True
    ):
        reduced = shortest_turn(body.apply(z), goal.apply(z)) * body
        rest = (reduced.inv() * goal).as_rotvec()
        np.testing.assert_allclose(rest[:2], 0.0, atol=1e-6)
        mixed = reduced * Rotation.from_rotvec(weight * rest)
        x, y, zz, w = (body.inv() * mixed).as_quat()
        expected = 2 * math.copysign(1.0, w) * np.array([x, y, zz])
        quaternions = (np.roll(r.as_quat(), 1) for r in (body, goal))
        error = kernel.attitude_error(*(v for q in quaternions for v in q), weight)
        np.testing.assert_allclose(error, expected, atol=1e-7)


def test_attitude_error_upside_down_still_turns():
    error = kernel.attitude_error(0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.4)
    assert np.linalg.norm(error) == pytest.approx(2.0)


# Rates


def test_gyro_filter_is_scipys_butterworth():
    k = PARAMETERS(MultirotorCascadeConfig().parameters())
    b, a = butter(2, 40.0, fs=1 / PLANT_PERIOD)
    np.testing.assert_allclose([k.gyro_b_0, k.gyro_b_1, k.gyro_b_2], b, rtol=1e-12)
    np.testing.assert_allclose([1.0, k.gyro_a_1, k.gyro_a_2], a, rtol=1e-12)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_rate_loops_have_margins_by_the_rule(vehicle):
    """Open loop of the real schedule: rotor lag, sampling, hold and filters."""
    config = MultirotorCascadeConfig(vehicle=vehicle)
    gains, dt = config.gains(), PLANT_PERIOD
    mechanics = vehicle_named(vehicle)
    lag = 0.5 * (mechanics.time_constant_up + mechanics.time_constant_down)
    w = np.logspace(0, math.log10(math.pi / dt), 20000)
    s, z = 1j * w, np.exp(1j * w * dt)
    hold = (1 - 1 / z) / (s * dt)
    b, a = butter(2, config.IMU_GYRO_CUTOFF, fs=1 / dt)
    gyro = hold * np.polyval(b, z) / np.polyval(a, z)  # averaged over a period, then filtered
    alpha = 1 - math.exp(-2 * math.pi * config.IMU_DGYRO_CUTOFF * dt)
    derivative = (1 - 1 / z) / dt * alpha / (1 - (1 - alpha) / z)
    for axis in range(3):
        pid = gains.rate_p[axis] + gains.rate_i[axis] / s + gains.rate_d[axis] * derivative
        loop = pid * gyro * np.exp(-2 * s * dt) * hold / (s * (lag * s + 1))
        gain, phase = np.abs(loop), np.unwrap(np.angle(loop))
        crossings = np.flatnonzero((gain[:-1] > 1) & (gain[1:] <= 1))
        assert len(crossings) == 1
        assert w[crossings[0]] == pytest.approx(gains.rate_p[axis], rel=0.25)
        margin = math.degrees(phase[crossings[0]] + math.pi)
        assert margin > 50.0
        at_180 = np.argmax(phase < -math.pi)
        assert 20 * math.log10(1 / gain[at_180]) > 6.0
    # the attitude loop is slow enough for a rate loop with that much lag
    assert np.all(gains.attitude_p[:2] <= 0.5 / (lag + 1 / gains.rate_p[:2]) + 1e-9)


def test_gains_by_the_rule_on_the_iris_are_px4s_but_for_the_slower_loop():
    gains = MultirotorCascadeConfig(vehicle="iris").gains()
    np.testing.assert_allclose(gains.attitude_p, [4.97, 4.97, 2.8], rtol=1e-3)  # PX4: 6.5, 6.5
    ratio = gains.rate_d[:2] / gains.rate_p[:2]
    np.testing.assert_allclose(ratio, 0.003 / 0.15, rtol=0.1)


# Allocation


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_allocation_gives_small_demands_whole(vehicle):
    mixer = MultirotorCascadeConfig(vehicle=vehicle).mixer()
    mechanics = vehicle_named(vehicle)
    rotors = np.empty(len(mixer))
    given = kernel.allocate(0.45, 3.0, -2.0, 0.3, mixer, 0.15, rotors)
    assert given == (0.45, 1.0, 1.0)
    wrench = mechanics.allocation_matrix() @ rotors
    total = mechanics.rotor_count * mechanics.maximum_thrust
    expected = [0.45 * total, *(np.array(mechanics.inertia) * [3.0, -2.0, 0.3])]
    np.testing.assert_allclose(wrench, expected, rtol=1e-9)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_allocation_saturates_by_priority_as_a_linear_program_does(vehicle):
    mixer = MultirotorCascadeConfig(vehicle=vehicle).mixer()
    effect = np.linalg.pinv(mixer)
    rotors = np.empty(len(mixer))
    rng = np.random.default_rng(6)
    shares = []
    for _ in range(150):
        thrust = rng.uniform(0.0, 1.0)
        demand = rng.normal(0.0, [80.0, 80.0, 6.0])
        given, share, yaw_share = kernel.allocate(thrust, *demand, mixer, 0.15, rotors)
        assert rotors.min() >= 0.0
        assert rotors.max() <= 1.0
        np.testing.assert_allclose(
            effect @ rotors, [given, *(share * demand[:2]), yaw_share * demand[2]], atol=1e-6
        )
        # the largest share of roll and pitch with any collective thrust up to the one asked for
        r = mixer[:, 1:3] @ demand[:2]
        p = mixer[:, 0]
        A = np.block([[r[:, None], p[:, None]], [-r[:, None], -p[:, None]]])
        b = np.concatenate((np.ones(len(p)), np.zeros(len(p))))
        best = linprog([-1.0, 0.0], A_ub=A, b_ub=b, bounds=[(0.0, 1.0), (0.0, thrust)])
        assert share == pytest.approx(-best.fun, abs=1e-7)
        # and for it the largest collective thrust, less what yaw may take
        high = min(thrust, np.min((1.0 - share * r) / p))
        assert high - 0.15 - 1e-9 <= given <= high + 1e-9
        if yaw_share < 1.0:
            full = given * p + share * r
            span = full + mixer[:, 3] * demand[2]
            limits = [
                (1 - f) / (s - f) if s > 1 else f / (f - s)
                for f, s in zip(full, span, strict=True)
                if s > 1 + 1e-9 or s < -1e-9
            ]
            assert yaw_share == pytest.approx(min(limits, default=1.0), abs=1e-6)
        shares.append((share, yaw_share))
    assert np.ptp(shares, axis=0).min() > 0.5  # both saturations were met


@pytest.mark.parametrize("factor", [0.0, 0.3, 1.0])
def test_thrust_model_is_inverted(factor):
    for thrust in np.linspace(0.0, 1.0, 11):
        command = kernel.command_of_thrust(thrust, factor)
        assert factor * command**2 + (1 - factor) * command == pytest.approx(thrust, abs=1e-12)


# One event


def hovering(**fields: float) -> np.ndarray:
    estimate = VEHICLE_ESTIMATE.zeros()
    for field in ("attitude_valid", "horizontal_valid", "vertical_valid", "q_WB_w"):
        estimate[VEHICLE_ESTIMATE.index(field)] = 1.0
    estimate[VEHICLE_ESTIMATE.index("p_WB_z")] = 10.0
    for field, value in fields.items():
        estimate[VEHICLE_ESTIMATE.index(field)] = value
    return estimate


def setpoint(p=NAN3, v=NAN3, yaw=math.nan, armed=1.0, maximum_speed=5.0) -> np.ndarray:
    return np.array([*p, *v, yaw, armed, maximum_speed, *NAN3])


class Controller:
    """State, parameters and outputs for calling the kernel without Drake."""

    def __init__(self, **config):
        self.config = MultirotorCascadeConfig(**({"flying": True} | config))
        self.x = self.config.initial_state()
        self.rotors = self.config.initial_commands()
        self.out = CASCADE_SETPOINTS.zeros()
        self.parameters = self.config.parameters()
        self.mixer = self.config.mixer()

    def step(self, estimate, goal, imu=None):
        imu = INERTIAL.zeros() if imu is None else imu
        kernel.cascade_step(
            self.x, self.rotors, self.out, estimate, imu, goal, self.parameters, self.mixer
        )
        return CASCADE_SETPOINTS(self.out)


def test_hover_gives_the_hover_commands():
    controller = Controller()
    for _ in range(3):
        controller.step(hovering(), setpoint(p=(0.0, 0.0, 10.0), yaw=0.0))
    np.testing.assert_allclose(controller.rotors, controller.config.hover_thrust(), rtol=1e-3)


def test_nothing_happens_before_the_attitude_is_known():
    controller = Controller()
    before = controller.rotors.copy(), controller.x.copy()
    controller.step(hovering(attitude_valid=0.0), setpoint(p=(50.0, 0.0, 0.0)))
    np.testing.assert_array_equal(controller.rotors, before[0])
    np.testing.assert_array_equal(controller.x, before[1])


@pytest.mark.parametrize("cutoff", [None, 2.0])
def test_velocity_pid_is_the_textbooks(cutoff):
    controller = Controller(PSC_ACC_XY_FILT=cutoff)
    k = controller.config
    v = 0.3
    goal = setpoint(v=(1.0, 0.0, 0.0))
    integral = derivative = last = correction = 0.0
    smoothed = acceleration = 0.0
    gain = 1.0 if cutoff is None else 1 - math.exp(-2 * math.pi * cutoff * PLANT_PERIOD)
    for n in range(200):
        measured = v + 0.1 * math.sin(0.05 * n)
        out = controller.step(hovering(v_WB_x=measured), goal)
        if n == 0:
            smoothed = last = measured  # the trajectory starts with the vehicle
        smoothed, acceleration = kernel.smooth_velocity(
            smoothed, acceleration, 1.0, k.MPC_ACC_HOR, k.MPC_JERK_AUTO, PLANT_PERIOD
        )
        derivative += (1 - math.exp(-2 * math.pi * k.MPC_VELD_LP * PLANT_PERIOD)) * (
            (measured - last) / PLANT_PERIOD - derivative
        )
        last = measured
        error = smoothed - measured
        asked = k.MPC_XY_VEL_P_ACC * error + integral - k.MPC_XY_VEL_D_ACC * derivative
        correction += gain * (asked - correction)
        assert out.a_WB_x == pytest.approx(acceleration + correction, abs=1e-9)
        integral += k.MPC_XY_VEL_I_ACC * error * PLANT_PERIOD
    assert abs(integral) > 0.01


def test_acceleration_is_added_to_what_is_asked_for():
    goal = setpoint(v=(0.0, 0.0, 0.0))
    plain = Controller().step(hovering(v_WB_x=0.3), goal)[CASCADE_SETPOINTS.slice("a_WB")].copy()
    goal[SETPOINT.slice("a_WB")] = 0.5, -0.2, math.nan
    pushed = Controller().step(hovering(v_WB_x=0.3), goal)[CASCADE_SETPOINTS.slice("a_WB")]
    np.testing.assert_allclose(pushed - plain, [0.5, -0.2, 0.0], atol=1e-12)


def test_uncontrolled_and_invalid_axes_ask_for_no_acceleration():
    controller = Controller()
    for _ in range(5):
        out = controller.step(hovering(v_WB_x=1.0, v_WB_z=0.5), setpoint())
        np.testing.assert_array_equal(out[CASCADE_SETPOINTS.slice("a_WB")], 0.0)
    goal = setpoint(p=(5.0, 5.0, 10.0))
    out = controller.step(hovering(horizontal_valid=0.0, v_WB_x=1.0), goal)
    assert out.a_WB_x == out.a_WB_y == 0.0
    assert math.isnan(out.p_WB_x)
    assert out.p_WB_z == pytest.approx(10.0, abs=0.01)


def test_horizontal_speed_is_limited_by_the_setpoint():
    controller = Controller(MPC_XY_ERR_MAX=1e9)
    fastest = 0.0
    for _ in range(2500):
        out = controller.step(hovering(), setpoint(p=(300.0, 400.0, 10.0), maximum_speed=2.0))
        x = STATE(controller.x)
        fastest = max(fastest, math.hypot(x.v_ref_x, x.v_ref_y))
    assert fastest == pytest.approx(2.0, rel=0.01)
    assert out.p_WB_y / out.p_WB_x == pytest.approx(4 / 3)


def test_trajectory_waits_for_a_vehicle_that_is_held():
    controller = Controller()
    for _ in range(2500):
        out = controller.step(hovering(), setpoint(p=(50.0, 0.0, 10.0)))
    assert 1.0 < out.p_WB_x <= 2.0


def test_a_reset_of_the_estimate_moves_the_trajectory_not_the_vehicle():
    goal = setpoint(p=(0.0, 0.0, 10.0), yaw=0.0)
    jump = {"p_WB_x": 1.0, "p_WB_z": 9.0}
    told = {
        "horizontal_reset_counter": 1.0,
        "horizontal_reset_x": 1.0,
        "vertical_reset_counter": 1.0,
        "vertical_reset": -1.0,
    }
    with_notice, without = Controller(), Controller()
    for _ in range(5):
        with_notice.step(hovering(), goal)
        without.step(hovering(), goal)
    quiet = with_notice.step(hovering(**jump, **told), goal)
    loud = without.step(hovering(**jump), goal)
    np.testing.assert_allclose(quiet[CASCADE_SETPOINTS.slice("a_WB")], 0.0, atol=0.1)
    assert loud.a_WB_x < -1.0
    assert loud.a_WB_z > 1.0


def test_disarmed_rotors_stand_and_integrals_are_gone():
    controller = Controller()
    for _ in range(100):
        controller.step(hovering(v_WB_x=0.2, w_WB_B_x=0.05), setpoint(p=(0.0, 0.0, 10.0)))
    assert np.abs(controller.x[STATE.slice("rate_integral")]).max() > 0.0
    controller.step(hovering(), setpoint(p=(0.0, 0.0, 10.0), armed=0.0))
    np.testing.assert_array_equal(controller.rotors, 0.0)
    for integral in ("rate_integral", "velocity_integral"):
        np.testing.assert_array_equal(controller.x[STATE.slice(integral)], 0.0)
    assert STATE(controller.x).takeoff == 0.0


def test_take_off_ramps_thrust_without_winding_up():
    controller = Controller(flying=False)
    ground = hovering(p_WB_z=0.2, v_WB_x=0.1, w_WB_B_y=0.02)
    controller.step(ground, setpoint(p=(0.0, 0.0, 0.2)))
    np.testing.assert_array_equal(controller.rotors, 0.0)  # armed, but nothing to climb to
    goal = setpoint(p=(0.0, 0.0, 3.0))
    thrusts, tilts = [], []
    while STATE(controller.x).takeoff < 1.0:
        out = controller.step(ground, goal)
        thrusts.append(out.thrust)
        q = out[CASCADE_SETPOINTS.slice("q_WB")]
        tilts.append(2 * math.acos(min(q[0], 1.0)))
        for integral in ("rate_integral", "velocity_integral"):
            np.testing.assert_array_equal(controller.x[STATE.slice(integral)], 0.0)
    assert len(thrusts) * PLANT_PERIOD == pytest.approx(3.0, abs=0.02)  # MPC_TKO_RAMP_T
    assert thrusts[0] < 0.01
    assert np.diff(thrusts).max() < 0.01
    assert max(thrusts) > 1.2 * controller.config.hover_thrust()
    assert max(tilts) <= math.radians(12.0) + 1e-9


def test_held_on_the_ground_the_controller_notices_contact_and_freezes():
    controller = Controller()
    standing = hovering(p_WB_z=0.2, v_WB_x=0.02, w_WB_B_x=0.01)
    goal = setpoint(p=(1.0, 0.0, math.nan), v=(math.nan, math.nan, -0.5))
    steps = 0
    while CASCADE_SETPOINTS(controller.out).ground_contact == 0.0:
        controller.step(standing, goal)
        steps += 1
        assert steps < 1000
    frozen = controller.x[STATE.slice("rate_integral")].copy()
    for _ in range(100):
        out = controller.step(standing, goal)
    np.testing.assert_array_equal(controller.x[STATE.slice("rate_integral")], frozen)
    assert out.thrust < controller.config.hover_thrust()
    np.testing.assert_allclose(out[CASCADE_SETPOINTS.slice("q_WB")][1:3], 0.0, atol=1e-12)
    for _ in range(200):  # and lets go when it is to climb
        out = controller.step(standing, setpoint(v=(0.0, 0.0, 1.0)))
    assert out.ground_contact == 0.0
    assert out.thrust > controller.config.hover_thrust()


def test_gyro_is_used_without_its_bias_and_the_estimate_without_a_gyro():
    bias, rate = np.array([0.05, -0.02, 0.03]), np.array([0.2, 0.1, -0.3])
    imu = INERTIAL.zeros()
    imu[INERTIAL.index("valid")] = 1.0
    first = INERTIAL.index("delta_angle_x")
    imu[first : first + 3] = (rate + bias) * PLANT_PERIOD
    imu[INERTIAL.index("delta_angle_dt")] = PLANT_PERIOD
    estimate = hovering(**{f"w_WB_B_{axis}": r for axis, r in zip("xyz", rate, strict=True)})
    for sample in (imu, None):
        controller = Controller()
        for _ in range(50):
            controller.step(estimate, setpoint(), sample)
        np.testing.assert_allclose(controller.x[STATE.slice("w_last")], rate, atol=1e-3)
    # a change shows in the gyro first
    controller = Controller()
    for _ in range(50):
        controller.step(estimate, setpoint(), imu)
    imu[INERTIAL.index("delta_angle_x")] += 0.1 * PLANT_PERIOD
    for _ in range(10):
        controller.step(estimate, setpoint(), imu)
    assert STATE(controller.x).w_last_x > rate[0] + 0.08


# PX4 v1.15 itself, in the log of a simulated Iris


@pytest.fixture(scope="module")
def px4_log() -> dict:
    names = [
        "vehicle_local_position_setpoint",
        "vehicle_attitude_setpoint",
        "vehicle_attitude",
        "vehicle_rates_setpoint",
        "actuator_motors",
        "vehicle_torque_setpoint",
        "vehicle_thrust_setpoint",
        "takeoff_status",
    ]
    log = ULog(str(shared("data/ulg/sitl_takeoff_return_land.ulg")), names)
    topics = {topic.name: topic.data for topic in log.data_list}
    state = topics["takeoff_status"]
    times, states = state["timestamp"], state["takeoff_state"]
    flight = np.argmax(states == 5)  # takeoff_status.msg: 5 flight, 3 ready for take-off
    landed = flight + np.argmax(states[flight:] == 3)
    return topics | {"flight": (times[flight], times[landed]), "parameters": log.initial_parameters}


def columns(topic: dict, *names: str) -> np.ndarray:
    return np.stack([topic[name] for name in names], axis=1).astype(float)


def test_thrust_and_attitude_setpoints_are_px4s(px4_log):
    position, attitude = (
        px4_log[f"vehicle_{name}_setpoint"] for name in ("local_position", "attitude")
    )
    parameters = px4_log["parameters"]
    accelerations = columns(position, *(f"acceleration[{i}]" for i in range(3)))
    thrusts = columns(position, *(f"thrust[{i}]" for i in range(3)))
    quaternions = columns(attitude, *(f"q_d[{i}]" for i in range(4)))
    first, last = px4_log["flight"]
    compared = 0
    for time, a_NED, thrust_NED in zip(position["timestamp"], accelerations, thrusts, strict=True):
        if not first <= time <= last:
            continue
        a, expected = ned_from_world(a_NED), ned_from_world(thrust_NED)
        if not expected[:2].any():
            continue  # PX4 has noticed ground contact
        hover = expected[2] / (a[2] / GRAVITY + 1)  # PX4 estimates it in flight
        assert 0.45 < hover < 0.55
        thrust, tx, ty, _, _ = kernel.thrust_vector(
            *a, hover, parameters["MPC_THR_MIN"], parameters["MPC_THR_MAX"],
            parameters["MPC_THR_XY_MARG"], math.radians(parameters["MPC_TILTMAX_AIR"]),
        )  # fmt: skip
        vector = thrust * np.array([tx, ty, 1.0]) / math.sqrt(tx * tx + ty * ty + 1)
        np.testing.assert_allclose(vector, expected, atol=2e-5)
        nearest = np.argmin(np.abs(attitude["timestamp"].astype(float) - float(time)))
        if attitude["timestamp"][nearest] == time:
            yaw = math.pi / 2 - attitude["yaw_body"][nearest]
            q = attitude_ned_from_world(np.array(kernel.attitude_of_thrust(tx, ty, yaw)))
            assert abs(q @ quaternions[nearest]) > math.cos(0.5 * math.radians(0.1))
            compared += 1
    assert compared > 30


def test_rate_setpoints_are_px4s(px4_log):
    """Log rows are asynchronous (20 and 50 Hz): compared as a regression, not row by row."""
    attitude, goal, rates = (
        px4_log[f"vehicle_{name}"] for name in ("attitude", "attitude_setpoint", "rates_setpoint")
    )
    q = columns(attitude, *(f"q[{i}]" for i in range(4)))
    q_d = columns(goal, *(f"q_d[{i}]" for i in range(4)))
    first, last = px4_log["flight"]
    parameters = px4_log["parameters"]
    weight = parameters["MC_YAW_WEIGHT"]
    ours, theirs = [], []
    for time, rate in zip(rates["timestamp"], columns(rates, "roll", "pitch", "yaw"), strict=True):
        if not first <= time <= last:
            continue
        body = [np.interp(float(time), attitude["timestamp"].astype(float), c) for c in q.T]
        body_W = attitude_ned_from_world(np.array(body) / np.linalg.norm(body))
        goal_W = attitude_ned_from_world(q_d[np.searchsorted(goal["timestamp"], time, "right") - 1])
        error = np.array(kernel.attitude_error(*body_W, *goal_W, weight))
        ours.append(error * [parameters["MC_ROLL_P"], parameters["MC_PITCH_P"], 0.0])
        theirs.append(frd_from_body(rate))
    for axis in range(2):
        a, b = np.array(ours)[:, axis], np.array(theirs)[:, axis]
        assert np.corrcoef(a, b)[0, 1] > 0.97
        assert np.polyfit(a, b, 1)[0] == pytest.approx(1.0, abs=0.03)


def test_mixer_is_px4s_up_to_its_normalisation_of_torque(px4_log):
    parameters = px4_log["parameters"]
    iris = vehicle_named(
        "iris",
        rotor_positions=[
            [parameters[f"CA_ROTOR{i}_PX"], -parameters[f"CA_ROTOR{i}_PY"], 0.0] for i in range(4)
        ],
        rotor_spins=[round(math.copysign(1, parameters[f"CA_ROTOR{i}_KM"])) for i in range(4)],
        moment_constant=parameters["CA_ROTOR0_KM"],
    )
    mixer = MultirotorCascadeConfig(vehicle=iris).mixer()
    motors, torque, thrust = (
        px4_log[name]
        for name in ("actuator_motors", "vehicle_torque_setpoint", "vehicle_thrust_setpoint")
    )
    first, last = px4_log["flight"]
    rows, commands = [], []
    for time, command in zip(
        motors["timestamp"], columns(motors, *(f"control[{i}]" for i in range(4))), strict=True
    ):
        match = np.flatnonzero(torque["timestamp"] == time)
        if first <= time <= last and len(match):
            roll, pitch, yaw = (torque[f"xyz[{i}]"][match[0]] for i in range(3))
            rows.append([-thrust["xyz[2]"][match[0]], roll, -pitch, -yaw])
            commands.append(command)
    fitted = np.linalg.lstsq(np.array(rows), np.array(commands), rcond=None)[0].T
    np.testing.assert_allclose(fitted[:, 0], mixer[:, 0], atol=2e-3)
    for axis, similarity in ((1, 0.999), (2, 0.999), (3, 0.98)):  # yaw was hardly excited
        a, b = fitted[:, axis], mixer[:, axis]
        assert a @ b / (np.linalg.norm(a) * np.linalg.norm(b)) > similarity

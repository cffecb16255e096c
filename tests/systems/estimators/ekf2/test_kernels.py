"""The compiled kernels against a few lines of numpy and scipy."""

import math

import numpy as np
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import fusion, geometry, prediction
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2 import yaw_estimator as gsf
from systems.estimators.ekf2.aiding import fuse_bias, predict_bias
from systems.estimators.ekf2.unaided import control_gravity
from systems.estimators.ekf2.world_model import earth_field

DT = 0.008


def scipy_rotation(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1))


@pytest.fixture
def filter_in_flight():
    """A filter somewhere in flight, with all states and a full covariance, and its parameters."""
    rng = np.random.default_rng(3)
    p = prm.parameter_array({"EKF2_ACC_NOISE": 0.3})
    x = kernels.initialise(p)
    q = rng.normal(size=4)
    x[at.QUATERNION : at.QUATERNION + 4] = q / np.linalg.norm(q)
    x[at.VELOCITY : at.VELOCITY + 3] = 3.0, -2.0, 1.0
    x[at.GYRO_BIAS : at.GYRO_BIAS + 3] = rng.normal(0, 0.01, 3)
    x[at.ACCEL_BIAS : at.ACCEL_BIAS + 3] = rng.normal(0, 0.1, 3)
    x[at.MAG_EARTH : at.MAG_EARTH + 3] = 0.2, 0.01, 0.4
    x[at.LATITUDE], x[at.LONGITUDE], x[at.ALTITUDE] = 0.8, 0.2, 300.0
    x[at.IMU_DELTA_ANGLE : at.IMU_DELTA_ANGLE + 3] = rng.normal(0, 0.3 * DT, 3)
    x[at.IMU_DELTA_VELOCITY : at.IMU_DELTA_VELOCITY + 3] = rng.normal(0, 5 * DT, 3)
    x[at.IMU_ANGLE_DT] = x[at.IMU_VELOCITY_DT] = DT
    x[at.HEADING_OBSERVABLE] = x[at.MAG] = 1.0
    x[at.HEIGHT_REFERENCE] = at.GNSS
    fusion.set_rotation(x)
    root = rng.normal(size=(at.ERRORS, at.ERRORS)) * 0.01
    fusion.covariance(x)[:] = root @ root.T + 1e-4 * np.eye(at.ERRORS)
    return x, p


def change(before: np.ndarray, after: np.ndarray, first: int, count: int) -> np.ndarray:
    return after[first : first + count] - before[first : first + count]


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def test_covariance_prediction(filter_in_flight):
    x, p = filter_in_flight
    before = fusion.covariance(x).copy()
    R = scipy_rotation(x[at.QUATERNION : at.QUATERNION + 4]).as_matrix()
    accel = x[at.IMU_DELTA_VELOCITY : at.IMU_DELTA_VELOCITY + 3] / DT
    accel = accel - x[at.ACCEL_BIAS : at.ACCEL_BIAS + 3]
    A = np.eye(at.ERRORS)
    A[0:3, 9:12] = -R * DT
    A[3:6, 0:3] = -skew(R @ accel) * DT
    A[3:6, 12:15] = -R * DT
    A[6:9, 3:6] = np.eye(3) * DT
    expected = A @ before @ A.T
    expected[0:3, 0:3] += np.eye(3) * (p[prm.EKF2_GYR_NOISE] * DT) ** 2
    expected[3:6, 3:6] += np.eye(3) * (p[prm.EKF2_ACC_NOISE] * DT) ** 2
    drift = np.zeros(at.ERRORS)
    drift[9:12] = (p[prm.EKF2_GYR_B_NOISE] * DT) ** 2 * (np.diag(expected)[9:12] < 0.015**2)
    drift[12:15] = (p[prm.EKF2_ACC_B_NOISE] * DT) ** 2
    drift[15:18] = (p[prm.EKF2_MAG_E_NOISE] * DT) ** 2 * (np.diag(expected)[15:18] < 0.05**2)
    drift[18:21] = (p[prm.EKF2_MAG_B_NOISE] * DT) ** 2 * (np.diag(expected)[18:21] < 0.05**2)
    climb = DT / (10 + DT) * x[at.VELOCITY + 2]
    drift[21:23] = (p[prm.EKF2_WIND_NSD] * (1 + 0.5 * climb)) ** 2 * DT
    drift[23] = DT**2 * (p[prm.EKF2_TERR_NOISE] ** 2 + (p[prm.EKF2_TERR_GRAD] ** 2) * 13.0)
    expected += np.diag(drift)
    prediction.predict_covariance(x, p)
    assert np.allclose(fusion.covariance(x), expected, rtol=1e-12, atol=1e-16)


def test_transition_matrix_is_the_derivative_of_the_strap_down(filter_in_flight):
    """Turn attitude, velocity and biases a little: the strap-down's answer is A times that."""
    x, p = filter_in_flight
    start = x.copy()
    prediction.predict_state(x, p)
    nominal = x.copy()
    R = scipy_rotation(start[at.QUATERNION : at.QUATERNION + 4]).as_matrix()
    step = 1e-6
    fields = [None] * 3 + [at.VELOCITY + i for i in range(3)] + [None] * 3
    fields += [at.GYRO_BIAS + i for i in range(3)] + [at.ACCEL_BIAS + i for i in range(3)]
    accel = start[at.IMU_DELTA_VELOCITY : at.IMU_DELTA_VELOCITY + 3] / DT
    accel = accel - start[at.ACCEL_BIAS : at.ACCEL_BIAS + 3]
    for error in (0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14):
        other = start.copy()
        unit = np.eye(at.ERRORS)[error]
        if error < 3:
            turned = Rotation.from_rotvec(step * unit[:3]) * scipy_rotation(
                start[at.QUATERNION : at.QUATERNION + 4]
            )
            other[at.QUATERNION : at.QUATERNION + 4] = np.roll(turned.as_quat(), 1)
            fusion.set_rotation(other)
        else:
            other[fields[error]] += step
        prediction.predict_state(other, p)
        turn = scipy_rotation(other[at.QUATERNION : at.QUATERNION + 4]) * (
            scipy_rotation(nominal[at.QUATERNION : at.QUATERNION + 4]).inv()
        )
        velocity = change(nominal, other, at.VELOCITY, 3) / step
        expected_turn = unit[:3] - DT * R @ unit[9:12]
        expected_velocity = unit[3:6] - DT * skew(R @ accel) @ unit[:3] - DT * R @ unit[12:15]
        # the derivation drops what is of second order in the step, about (0.3 rad/s DT)
        assert np.allclose(turn.as_rotvec() / step, expected_turn, atol=5e-3 * DT)
        assert np.allclose(velocity, expected_velocity, atol=5e-3 * DT * 10)


def test_strap_down_over_a_second_of_circling():
    """Against the closed form: constant body rate about the vertical and constant acceleration."""
    p = prm.parameter_array({})
    x = kernels.initialise(p)
    rate, pull, steps = 0.5, 2.0, 1000
    dt = 1.0 / steps
    for _ in range(steps):
        x[at.IMU_DELTA_ANGLE + 2] = rate * dt
        # the kernel turns first, so the specific force is given in the frame after the step
        x[at.IMU_DELTA_VELOCITY] = pull * dt
        x[at.IMU_DELTA_VELOCITY + 2] = -at.STANDARD_GRAVITY * dt
        x[at.IMU_ANGLE_DT] = x[at.IMU_VELOCITY_DT] = dt
        prediction.predict_state(x, p)
    assert geometry.yaw_of(tuple(x[at.ROTATION : at.ROTATION + 9])) == pytest.approx(rate)
    expected = pull / rate * np.array([math.sin(rate), 1.0 - math.cos(rate)])
    assert np.allclose(x[at.VELOCITY : at.VELOCITY + 2], expected, atol=2e-3)
    assert abs(x[at.VELOCITY + 2]) < 2e-3


def test_fusion_is_josephs_form_with_inhibited_gains(filter_in_flight):
    x, p = filter_in_flight
    x[at.ACCEL_BIAS_INHIBITED] = x[at.GYRO_BIAS_INHIBITED] = 1.0
    P = fusion.covariance(x).copy()
    before = x.copy()
    H = np.zeros(at.ERRORS)
    H[[0, 3, 8, 15]] = 0.3, -1.0, 0.5, 2.0
    noise, innovation = 0.02, 0.1
    S = H @ P @ H + noise
    K = P @ H / S
    g = np.empty(at.ERRORS)
    predicted = fusion.project_covariance(fusion.covariance(x), H, g)
    assert predicted == pytest.approx(H @ P @ H)
    assert np.allclose(g, P @ H)
    fusion.fuse_gains(x, p, K.copy(), g, predicted, noise, innovation)
    K[9:13] = 0.0
    kept = np.eye(at.ERRORS) - np.outer(K, H)
    expected = kept @ P @ kept.T + noise * np.outer(K, K)
    assert np.allclose(fusion.covariance(x), expected, rtol=1e-10, atol=1e-15)
    dx = -K * innovation
    turned = Rotation.from_rotvec(dx[:3]) * scipy_rotation(before[at.QUATERNION :][:4])
    assert np.allclose(
        scipy_rotation(x[at.QUATERNION :][:4]).as_matrix(), turned.as_matrix(), atol=1e-12
    )
    assert np.allclose(change(before, x, at.VELOCITY, 3), dx[3:6])
    assert before[at.ALTITUDE] - x[at.ALTITUDE] == pytest.approx(dx[8])
    assert np.allclose(change(before, x, at.MAG_EARTH, 6), dx[15:21])
    assert np.array_equal(x[at.GYRO_BIAS :][:3], before[at.GYRO_BIAS :][:3])


def test_direct_observation_is_the_same_as_one_with_its_matrix(filter_in_flight):
    x, p = filter_in_flight
    other = x.copy()
    P = fusion.covariance(x)
    fusion.fuse_state(x, p, 4, 0.3, P[4, 4] + 0.1, 0.1)
    H, g = np.eye(at.ERRORS)[4], np.empty(at.ERRORS)
    predicted = fusion.project_covariance(fusion.covariance(other), H, g)
    fusion.fuse_gains(other, p, g / (predicted + 0.1), g, predicted, 0.1, 0.3)
    assert np.allclose(x, other, rtol=1e-13, equal_nan=True)


def test_heading_that_nothing_observes_stays(filter_in_flight):
    x, p = filter_in_flight
    x[at.HEADING_OBSERVABLE] = 0.0
    P = fusion.covariance(x)
    P[2, 2] = 5.0
    fusion.fuse_state(x, p, 4, 0.3, P[4, 4] + 0.1, 0.1)
    assert P[2, 2] == pytest.approx(p[prm.EKF2_HEAD_NOISE] ** 2)
    assert np.count_nonzero(P[2]) == 1
    assert np.count_nonzero(P[:, 2]) == 1


def test_a_variance_above_its_limit_is_fused_down_not_clipped(filter_in_flight):
    x, p = filter_in_flight
    P = fusion.covariance(x)
    P[3, 3] = 2e6
    P[5, 5] = 1e-12
    covariances = P[3, 4:].copy()
    fusion.constrain_variances(x, p)
    # an observation with ten times the variance takes an eleventh off everything in its row
    assert P[3, 3] == pytest.approx(2e6 * 10 / 11)
    assert np.allclose(P[3, 4:], covariances * 10 / 11)
    assert P[5, 5] == 1e-6
    assert np.allclose(P, P.T)


def test_gravity_points_where_the_derivative_says(filter_in_flight):
    """The innovation variance of gravity, with a Jacobian by differences."""
    x, p = filter_in_flight
    P = fusion.covariance(x).copy()
    control_gravity(x, p)
    rotation = scipy_rotation(x[at.QUATERNION : at.QUATERNION + 4])
    up = np.array([0.0, 0.0, -1.0])
    step = 1e-6
    H = np.column_stack(
        [
            ((Rotation.from_rotvec(step * axis) * rotation).inv().apply(up)
             - rotation.inv().apply(up)) / step
            for axis in np.eye(3)
        ]
    )  # fmt: skip
    expected = np.diag(H @ P[:3, :3] @ H.T) + 1.0
    variances = x[at.AID_GRAVITY + at.A_INNOVATION_VARIANCE :: at.A_AXIS][:3]
    assert np.allclose(variances, expected, rtol=1e-6)


def test_gate_is_innovation_squared_over_gate_squared_times_variance():
    x = kernels.initialise(prm.parameter_array({}))
    aid = at.AID_EV_POS
    for gate, innovations, rejected in (
        (5.0, (4.9, 0.0), 0.0),
        (5.0, (5.1, 0.0), 1.0),
        (5.0, (0.0, -5.1), 1.0),  # any axis
        (10.0, (5.1, -9.9), 0.0),
        (5.0, (0.0, math.nan), 1.0),
    ):
        for axis in range(2):
            fusion.set_aid(x, aid, axis, 1e6, 0.0, 1.0, innovations[axis], 1.0, gate)
        fusion.finish_aid(x, aid, 1e6)
        assert x[aid + at.A_REJECTED] == rejected
        assert x[aid + at.A_TEST_RATIO] == pytest.approx((innovations[0] / gate) ** 2)


def test_bias_estimator_follows_an_offset():
    x = kernels.initialise(prm.parameter_array({}))
    bias = at.BIAS_EV_NORTH
    rng = np.random.default_rng(4)
    for _ in range(2000):
        predict_bias(x, bias, 0.1)
        fuse_bias(x, bias, 0.7 + 0.1 * rng.normal(), 0.01, 0.13, 0.5)
    assert x[bias + at.B_BIAS] == pytest.approx(0.7, abs=0.2)
    # the steady state of a random walk: P² + P Q − Q R = 0 after the update
    q, r = 0.13**2 * 0.1, 0.01
    steady = -q / 2 + math.sqrt(q * q / 4 + q * r)
    assert x[bias + at.B_VARIANCE] == pytest.approx(steady, rel=1e-6)


def test_rotations_against_scipy():
    rng = np.random.default_rng(5)
    for _ in range(200):
        vector = rng.normal(0, 1.0, 3)
        q = np.array(geometry.from_rotation_vector(*vector))
        rotation = Rotation.from_rotvec(vector)
        matrix = np.array(geometry.matrix_of(*q)).reshape(3, 3)
        assert np.allclose(matrix, rotation.as_matrix(), atol=1e-14)
        back = np.array(geometry.quaternion_of(tuple(matrix.ravel())))
        assert np.allclose(back * np.sign(back @ q), q, atol=1e-14)
        assert np.allclose(
            geometry.to_rotation_vector(*(q * np.sign(q[0]))), rotation.as_rotvec(), atol=1e-12
        )
        tilt = scipy_rotation(np.array(geometry.tilt_quaternion(*vector)))
        assert np.allclose(tilt.apply(vector)[:2], 0.0, atol=1e-12)
        assert tilt.apply(vector)[2] < 0.0
        yaw = rng.uniform(-3.0, 3.0)
        turned = geometry.with_yaw(yaw, tuple(matrix.ravel()))
        assert geometry.yaw_of(turned) == pytest.approx(yaw, abs=1e-9)
        same = geometry.with_yaw(geometry.yaw_of(tuple(matrix.ravel())), tuple(matrix.ravel()))
        assert np.allclose(np.array(same).reshape(3, 3), matrix, atol=1e-9)
        assert np.allclose(np.array(turned[6:]), matrix[2], atol=1e-9)  # the tilt stays


def test_the_earth():
    latitude, longitude = 0.83, 0.15
    for north, east in ((120.0, -80.0), (-3000.0, 2500.0)):
        point = geometry.unproject(north, east, latitude, longitude)
        assert np.allclose(geometry.project(*point, latitude, longitude), (north, east), atol=1e-6)
    degrees = math.degrees(latitude)
    east_of = pymap3d.geodetic2enu(degrees, math.degrees(longitude + 1e-6), 0, degrees,
                                   math.degrees(longitude), 0)  # fmt: skip
    per_latitude, per_longitude = geometry.metres_per_radian(latitude, 0.0)
    assert per_longitude == pytest.approx(east_of[0] / 1e-6, rel=1e-6)
    # PX4's meridian radius has one factor 1 − e² sin²φ too many below
    north_of = pymap3d.geodetic2enu(math.degrees(latitude + 1e-6), math.degrees(longitude), 0,
                                    degrees, math.degrees(longitude), 0)  # fmt: skip
    w = 1.0 - 0.0818191908425**2 * math.sin(latitude) ** 2
    assert per_latitude == pytest.approx(north_of[1] / 1e-6 / w, rel=1e-5)
    assert geometry.normal_gravity(0.0) == pytest.approx(9.7803253359)
    assert geometry.normal_gravity(math.pi / 4) == pytest.approx(9.8061992, abs=1e-5)
    assert geometry.normal_gravity(math.pi / 2) == pytest.approx(9.8321849, abs=1e-5)


def test_world_model_is_px4s_table():
    # README of the reference streams, for the origin of `flight`
    declination, inclination, strength = earth_field(47.397742, 8.545594)
    assert declination == pytest.approx(3.4056, abs=5e-4)
    assert inclination == pytest.approx(63.157, abs=2e-3)
    assert strength == pytest.approx(0.48239, abs=2e-5)
    assert np.isfinite(earth_field(90.0, 180.0)).all()


def test_yaw_estimator_finds_the_heading_from_velocity_alone():
    """Accelerate to the north-east with a nose that points to 1 rad, and no magnetometer."""
    p = prm.parameter_array({})
    x = kernels.initialise(p)
    heading, dt, v = 1.0, 0.008, np.zeros(2)
    x[at.IMU_ANGLE_DT] = x[at.IMU_VELOCITY_DT] = dt
    R = Rotation.from_euler("z", heading)
    x[at.IN_AIR] = 1.0
    for k in range(2500):
        accel = np.array([2.0 * math.sin(3.0 * k * dt), 1.5 * math.cos(2.0 * k * dt), 0.0])
        force = R.inv().apply(accel - np.array([0.0, 0.0, at.STANDARD_GRAVITY]))
        x[at.IMU_DELTA_VELOCITY : at.IMU_DELTA_VELOCITY + 3] = force * dt
        v += accel[:2] * dt
        gsf.set_yaw_estimator_bias(x)
        gsf.predict_yaw_estimator(x)
        if k % 25 == 24:
            gsf.fuse_yaw_estimator(x, v[0], v[1], 0.3)
    assert gsf.yaw_estimate_available(x)
    assert x[at.GSF_YAW] == pytest.approx(heading, abs=0.05)

"""The fixed wing's sensors: rates of Tables 3 and 21, models of 3.2, delays, repeatability."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from systems.configuration import StructureChangedError
from systems.runway_frames import RunwayConfig, ned_from_runway
from systems.sensors.runway_airspeed import RunwayAirspeed, RunwayAirspeedConfig
from systems.sensors.runway_antenna import RunwayAntenna, RunwayAntennaConfig
from systems.sensors.runway_baro_inertial import RunwayBaroInertial, RunwayBaroInertialConfig
from systems.sensors.runway_camera import RunwayCamera, RunwayCameraConfig
from systems.sensors.runway_gps import RunwayGps, RunwayGpsConfig
from systems.sensors.runway_heading import RunwayHeading, RunwayHeadingConfig
from systems.sensors.runway_inertial_drift import (
    RunwayInertialDrift,
    RunwayInertialDriftConfig,
    drift_since_reset,
    drift_step,
)
from systems.sensors.runway_laser import RunwayLaser, RunwayLaserConfig
from systems.sensors.runway_tracker import RunwayTracker, RunwayTrackerConfig
from systems.sensors.runway_wheel_encoder import RunwayWheelEncoder, RunwayWheelEncoderConfig
from systems.signals.runway_measurement import FIXED_WING_STATE, PICTURE
from tests.runway_bench import arrivals, assert_contract, log_of

RUNWAY = RunwayConfig()
SENSORS = [
    (RunwayLaser, RunwayLaserConfig, 0.1),
    (RunwayBaroInertial, RunwayBaroInertialConfig, 0.02),
    (RunwayAntenna, RunwayAntennaConfig, 1.0),
    (RunwayCamera, RunwayCameraConfig, 0.04),
    (RunwayHeading, RunwayHeadingConfig, 0.08),
    (RunwayAirspeed, RunwayAirspeedConfig, 0.08),
    (RunwayWheelEncoder, RunwayWheelEncoderConfig, 0.08),
    (RunwayGps, RunwayGpsConfig, 1.0),
]


def state(along=-1000.0, right=0.0, up=100.0, **fields) -> np.ndarray:
    """An aircraft on the landing course."""
    values = FIXED_WING_STATE.zeros()
    values[:3] = ned_from_runway(np.array([right, along, -up]), RUNWAY.heading_radians)
    values[3:6] = ned_from_runway(np.array([0.0, 33.0, 0.0]), RUNWAY.heading_radians)
    view = FIXED_WING_STATE(values)
    view.yaw = RUNWAY.heading_radians
    view.height = up
    view.airspeed = 33.0
    for name, value in fields.items():
        values[FIXED_WING_STATE.index(name)] = value
    return values


@pytest.mark.parametrize(("sensor", "config", "period"), SENSORS)
def test_contract_rate_and_header(sensor, config, period):
    assert_contract(sensor(config()))
    out = arrivals(sensor(config()), {"state": state()}, 3.0)
    np.testing.assert_allclose(np.diff(out[:, 0]), period, atol=1e-9)
    np.testing.assert_array_equal(out[:, 2], np.arange(len(out)))


@pytest.mark.parametrize(("sensor", "config", "period"), SENSORS)
def test_same_seed_same_measurements_and_seeds_differ(sensor, config, period):
    def run(system):
        return arrivals(system, {"state": state()}, 1.1)

    first = run(sensor(config(), 1))
    again = sensor(config(), 7)
    again.configure(config(), 1)
    np.testing.assert_array_equal(first, run(again))
    other = run(sensor(config(), 2))
    if sensor is not RunwayWheelEncoder:  # its noise can hide in its resolution
        assert not np.array_equal(first, other)
    with pytest.raises(StructureChangedError):
        again.configure(config(period=period * 2), 1)


def test_laser_delay_bias_and_activation():
    """Eq. 12 with what the manufacturer says switched on one by one."""
    quiet = {"bias_spread": 0.0, "noise": 0.0, "activation_spread": 0.0}
    out = arrivals(RunwayLaser(RunwayLaserConfig(**quiet)), {"state": state(up=80.0)}, 1.0)
    np.testing.assert_allclose(out[:, 4], 80.0)
    np.testing.assert_allclose(out[:, 1] - out[:, 0], 0.1, atol=1e-9)
    assert (out[:, 3] == 1.0).all()
    above = arrivals(RunwayLaser(RunwayLaserConfig(**quiet)), {"state": state(up=101.0)}, 1.0)
    assert (above[:, 3] == 0.0).all()
    means = [
        arrivals(RunwayLaser(RunwayLaserConfig(), s), {"state": state(up=50.0)}, 3.0)[:, 4]
        for s in range(30)
    ]
    assert np.std([m.mean() for m in means]) == pytest.approx(0.05, rel=0.4)
    assert np.mean([m.std() for m in means]) == pytest.approx(0.1, rel=0.2)


def test_baro_bias_and_scale_factor():
    """Eq. 13: the error over two heights gives both constants, with their spread over seeds."""
    biases, scales = [], []
    for seed in range(80):
        low, high = (
            arrivals(
                RunwayBaroInertial(RunwayBaroInertialConfig(), seed), {"state": state(up=up)}, 0.15
            )[-1, 4]
            for up in (0.0, 500.0)
        )
        biases.append(low)
        scales.append((high - low) / 500.0 - 1.0)
    assert np.std(biases) == pytest.approx(4.0, rel=0.25)
    assert np.std(scales) == pytest.approx(0.01, rel=0.25)


def test_antenna_angles():
    config = RunwayAntennaConfig(azimuth_bias_spread=0.0, elevation_bias_spread=0.0, noise=0.0)
    station = RUNWAY.ground_station_n()
    aircraft = state()
    aircraft[:3] = np.add(station, [0.0, 300.0, -300.0])  # east of it, at 45 deg
    out = arrivals(RunwayAntenna(config), {"state": aircraft}, 1.5)
    np.testing.assert_allclose(out[0, 4:6], (math.pi / 2, math.pi / 4))


@pytest.mark.parametrize(("delay", "late"), [(0.0, 0.0), (0.1, 0.12), (0.2, 0.2), (1.3, 1.32)])
def test_a_measurement_comes_out_at_the_first_look_after_its_delay(delay, late):
    """The antenna samples every second and looks every 40 ms."""
    samples = arrivals(RunwayAntenna(RunwayAntennaConfig(delay=delay)), {"state": state()}, 5.1)
    assert len(samples) >= 4
    np.testing.assert_allclose(samples[:, 0], np.arange(len(samples)), atol=1e-9)
    np.testing.assert_allclose(samples[:, 1] - samples[:, 0], late, atol=1e-9)


def test_camera_sees_the_touchdown_point_on_its_axis():
    """On a path of 6 deg with the mounting's 3 deg and a pitch of −3 deg it is in the centre."""
    config = RunwayCameraConfig(
        position=[0.0, 0.0, 0.0],
        position_spread=0.0,
        harmonisation_roll_spread=0.0,
        harmonisation_pitch_spread=0.0,
        harmonisation_yaw_spread=0.0,
    )
    up = 1000.0 * math.tan(math.radians(6.0))
    aircraft = state(up=up, pitch=math.radians(-3.0))
    out = arrivals(RunwayCamera(config), {"state": aircraft}, 0.1)
    np.testing.assert_allclose(out[0, 4:6], (320.0, 240.0), atol=1e-6)
    assert out[0, 3] == 1.0
    # one degree of heading to the left moves it 20 px to the right
    turned = aircraft.copy()
    turned[6] -= math.radians(1.0)
    moved = arrivals(RunwayCamera(config), {"state": turned}, 0.1)
    assert moved[0, 4] == pytest.approx(340.0, abs=0.2)
    behind = aircraft.copy()
    behind[6] += math.pi
    assert arrivals(RunwayCamera(config), {"state": behind}, 0.1)[0, 3] == 0.0


def test_camera_harmonisation_spreads():
    """Yaw and pitch errors of 0.25 deg spread the picture by 5 px over the seeds."""
    config = RunwayCameraConfig(position_spread=0.0)
    pixels = [
        arrivals(RunwayCamera(config, seed), {"state": state(pitch=-0.05)}, 0.02)[0, 4:6]
        for seed in range(120)
    ]
    np.testing.assert_allclose(np.std(pixels, axis=0), 5.0, rtol=0.2)


def picture(u=320.0, v=240.0, validity=0.0) -> np.ndarray:
    values = PICTURE.zeros()
    values[:6] = (validity, 0.0, 0.0, 1.0, u, v)
    return values


def track(config, distance, seed=0, seen=None, duration=0.6):
    seen = picture() if seen is None else seen
    system = RunwayTracker(config, seed)
    return arrivals(system, {"picture": seen, "state": state(along=-distance)}, duration)


def test_tracker_locks_at_the_first_click_and_loses_the_point_near():
    config = RunwayTrackerConfig()
    assert track(config, 4800.0)[0, 3] == 0.0
    assert track(config, 4400.0)[0, 3:7:3].tolist() == [1.0, 1.0]
    assert track(config, 1500.0)[0, 6] == 2.0
    assert track(config, 500.0)[0, 6] == 3.0
    assert track(config, 80.0)[0, 3] == 0.0


def test_tracker_noise_and_click_error():
    """Eq. 15: b_k is common to the pictures after one click, n_k is not."""
    errors = np.array(
        [track(RunwayTrackerConfig(), 500.0, seed)[0, 4:6] - (320.0, 240.0) for seed in range(150)]
    )
    np.testing.assert_allclose(errors.std(axis=0), math.hypot(1.5, 1.0), rtol=0.2)
    quiet = RunwayTrackerConfig(noise=0.0)
    first, second = track(quiet, 500.0, 3), track(quiet, 300.0, 3)
    np.testing.assert_array_equal(first[0, 4:6], second[0, 4:6])
    assert not np.array_equal(first[0, 4:6], track(quiet, 1500.0, 3)[0, 4:6])


def test_latencies_of_camera_and_vision_chain():
    """L_ti shows in the time stamp, L_ci only in the arrival."""
    config = RunwayTrackerConfig(delay=0.2)
    out = track(config, 500.0, seen=picture(validity=0.1))
    assert out[0, 0] == pytest.approx(0.1)
    assert out[0, 1] == pytest.approx(0.325)  # the first of its events from 0.3 s on


def test_false_lock_and_outliers():
    config = RunwayTrackerConfig(
        noise=0.0,
        click_spread=0.0,
        false_lock=[30.0, -20.0],
        false_lock_from=700.0,
        false_lock_until=400.0,
    )
    np.testing.assert_allclose(track(config, 500.0)[0, 4:6], (350.0, 220.0))
    np.testing.assert_allclose(track(config, 300.0)[0, 4:6], (320.0, 240.0))
    wild = RunwayTrackerConfig(noise=0.0, click_spread=0.0, outlier_probability=1.0)
    errors = np.array([track(wild, 500.0, s)[0, 4:6] - (320.0, 240.0) for s in range(50)])
    assert np.abs(errors).max() <= 50.0
    assert np.abs(errors).mean() == pytest.approx(25.0, rel=0.3)


def test_heading_is_magnetic():
    config = RunwayHeadingConfig(
        declination=2.0, declination_spread=0.0, deviation_spread=0.0, noise=0.0
    )
    out = arrivals(RunwayHeading(config), {"state": state()}, 0.1)
    assert math.degrees(out[0, 4]) == pytest.approx(RUNWAY.heading - 2.0)


def test_wheels_and_airspeed_know_the_ground():
    for on_ground in (0.0, 1.0):
        aircraft = state(on_ground=on_ground)
        wheels = arrivals(RunwayWheelEncoder(RunwayWheelEncoderConfig()), {"state": aircraft}, 0.1)
        air = arrivals(RunwayAirspeed(RunwayAirspeedConfig()), {"state": aircraft}, 0.1)
        assert (wheels[0, 3], air[0, 3]) == (on_ground, 1.0 - on_ground)
        assert wheels[0, 4] == pytest.approx(33.0, abs=1.5)
        assert wheels[0, 4] / 0.05 == pytest.approx(round(wheels[0, 4] / 0.05))


def test_gps_is_lost():
    out = arrivals(RunwayGps(RunwayGpsConfig(loss_time=2.0)), {"state": state()}, 5.1)
    np.testing.assert_array_equal(out[:, 3], [1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def test_schuler_oscillation():
    """Fig. 5 and 15: eq. 11 swings with 84.4 min, 2 m/s high, around a drift of 2 nm/h."""
    drift = np.radians([0.033, 0.0]) / 3600.0

    def rates(_, y):
        return [y[1] / 6371008.8 + drift[0], -9.80665 * y[0], y[1]]

    hours = np.linspace(0.0, 3.0 * 3600.0, 50)
    exact = solve_ivp(rates, (0.0, hours[-1]), [0.0, 0.0, 0.0], t_eval=hours, rtol=1e-9).y
    closed = np.array([drift_since_reset(drift, t) for t in hours])
    np.testing.assert_allclose(closed[:, 0], exact[0], atol=1e-9)
    np.testing.assert_allclose(closed[:, 2], exact[1], atol=1e-3)
    np.testing.assert_allclose(closed[:, 4], exact[2], atol=3.0)
    assert np.abs(closed[:, 2]).max() == pytest.approx(2.0, rel=0.05)
    assert abs(closed[-1, 4]) / 3.0 / 1852.0 == pytest.approx(2.0, rel=0.2)
    error = np.zeros(6)
    for _ in range(60 * 3600):  # one hour at 60 Hz is enough to see the discrete model follow
        drift_step(error, 0.0, drift, 1.0 / 60.0)
    np.testing.assert_allclose(error, drift_since_reset(drift, 3600.0), rtol=2e-3, atol=1e-9)


def test_inertial_drift_topology_and_rates():
    assert_contract(RunwayInertialDrift(RunwayInertialDriftConfig()))
    _, values = log_of(RunwayInertialDrift(RunwayInertialDriftConfig(), 3), {"state": state()}, 1.0)
    values = values[1:]
    assert len(np.unique(values[:, 10])) == 100  # attitude at 100 Hz
    assert len(np.unique(values[:, 0])) == 50  # position and speed at 50 Hz
    error = values[-1, 4:6] - state()[:2]
    speed = values[-1, 7:9] - state()[3:5]
    earlier = values[-51, 4:6] - state()[:2]
    np.testing.assert_allclose(error - earlier, speed * 0.5, atol=0.03)
    perfect = RunwayInertialDriftConfig(
        gyro_bias_spread=0.0, tilt_spread=0.0, heading_spread=0.0, vertical_speed_spread=0.0
    )
    _, values = log_of(RunwayInertialDrift(perfect), {"state": state()}, 0.1)
    np.testing.assert_allclose(values[-1, 4:10], state()[:6])
    np.testing.assert_allclose(values[-1, 11:14], state()[6:9])

"""Guidance and autopilot of the fixed wing."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from plants.fixed_wing import FixedWingConfig
from plants.terrain import FlatTerrain
from systems.controllers.fixed_wing_flight_controller import (
    FixedWingFlightController,
    FixedWingFlightControllerConfig,
)
from systems.controllers.fixed_wing_guidance import (
    FlightControllerGains,
    LandingProfileConfig,
    RouteConfig,
    fly_back,
    follow,
    helmsman,
    landing_altitude,
    steer,
    vertical_speed_command,
)
from systems.controllers.fixed_wing_reference_flight import reference_flight
from systems.runway_frames import RunwayConfig, runway_from_ned
from systems.signals.runway_measurement import NAVIGATION_ESTIMATE, PHASE_STATUS
from systems.supervisors.runway_phases import Phase
from tests.runway_bench import assert_contract, log_of
from tests.system_contract import periodic_update

GAINS = FlightControllerGains().vector()
PROFILE = LandingProfileConfig().vector(33.0, 1.2)
RUNWAY = RunwayConfig()


def test_topology():
    controller = FixedWingFlightController(FixedWingFlightControllerConfig())
    assert_contract(controller)
    assert periodic_update(controller) == (0.02, 0.005)


def test_waits_for_an_estimate_and_brakes_on_the_ground():
    config = FixedWingFlightControllerConfig(route=RouteConfig(waypoints=[]))
    phase, estimate = PHASE_STATUS.zeros(), NAVIGATION_ESTIMATE.zeros()
    inputs = {"estimate": estimate, "phase": phase}
    _, command = log_of(FixedWingFlightController(config), inputs, 0.1)
    np.testing.assert_array_equal(command[-1], 0.0)
    estimate[1] = 1.0
    estimate[8] = RUNWAY.heading_radians
    phase[0] = Phase.BRAKING
    _, command = log_of(FixedWingFlightController(config), inputs, 0.1)
    np.testing.assert_allclose(command[-1], [0.0, 0.0, 2.0, 0.0], atol=1e-12)


def test_landing_profile_is_a_slope_and_a_flare():
    s1 = math.tan(math.radians(6.0))
    far, slope = landing_altitude(5000.0, PROFILE)
    assert slope == pytest.approx(s1)
    short = 0.5 * (1.0 - 0.5 / 33.0 / s1) * 105.0
    assert far - 1.2 == pytest.approx((5000.0 - short) * s1)  # the slope aims short of the point
    assert landing_altitude(0.0, PROFILE)[0] == pytest.approx(1.2)  # where the wheels touch
    assert landing_altitude(0.0, PROFILE)[1] * 33.0 == pytest.approx(0.5)
    # the altitude is the integral of the slope
    risen = quad(lambda d: landing_altitude(d, PROFILE)[1], 0.0, 5000.0, points=[105.0])[0]
    assert far - 1.2 == pytest.approx(risen, rel=1e-6)
    # an error of the height makes one along the runway that grows on the way in (Table 5)
    near, farther = (landing_altitude(d, PROFILE)[0] / d for d in (100.0, 300.0))
    assert farther / near > 1.3
    # Fig. 30: the laser's 100 m are about 1000 m before the touch-down point
    assert landing_altitude(1000.0, PROFILE)[0] == pytest.approx(105.0, abs=5.0)


def test_helmsman_turns_towards_the_leg_and_saturates():
    assert helmsman(0.0, 50.0, GAINS) < 0.0  # right of it: roll left
    assert helmsman(0.2, 0.0, GAINS) < 0.0
    assert helmsman(1.5, 0.0, GAINS) == pytest.approx(-math.radians(25.0))
    # however far off, it meets the leg at no more than 45 deg
    assert helmsman(-math.radians(45.0), 5000.0, GAINS) == pytest.approx(0.0)


def test_altitude_control_has_no_windup():
    command, integral = vertical_speed_command(100.0, 0.0, 0.0, 0.02, GAINS)
    assert command == -2.5  # climbs at its limit
    assert integral == 0.0
    command, integral = vertical_speed_command(1.0, 0.0, 3.0, 0.02, GAINS)
    assert command == pytest.approx(3.0 - 0.3 - 0.02 * 0.02)
    assert integral == pytest.approx(0.02)


def test_nose_wheel_aims_at_the_centre_line():
    assert steer(0.0, 5.0, 10.0, GAINS) < 0.0
    assert steer(0.0, -5.0, 10.0, GAINS) > 0.0
    assert abs(steer(1.5, 50.0, 30.0, GAINS)) == pytest.approx(1.5 / 30.0)


def test_legs_give_way_to_each_other_and_to_the_landing():
    waypoints = np.array([[0.0, 0.0, -500.0], [4000.0, 0.0, -400.0], [4000.0, 4000.0, -400.0]])
    guidance = np.zeros(5)
    v = np.array([33.0, 0.0, 0.0])
    limit = math.radians(25.0)

    def at(n, e, z=-450.0):
        return follow(guidance, np.array([n, e, z]), v, waypoints, 0.0, PROFILE, limit)

    course, sink = at(2000.0, 30.0)
    assert (guidance[0], course, guidance[2]) == (0.0, 0.0, pytest.approx(30.0))
    assert guidance[3] == pytest.approx(0.0)
    assert sink == pytest.approx(33.0 * 100.0 / 4000.0)
    course, _ = at(3950.0, 0.0)
    assert (guidance[0], course) == (1.0, pytest.approx(math.pi / 2))
    course, _ = at(4000.0, 3990.0)
    assert (guidance[0], guidance[1], course) == (2.0, 1.0, 0.0)
    at(1000.0, 3000.0)
    assert guidance[0] == 2.0  # a passed leg does not come back


def test_the_fly_back_goes_all_the_way_round_the_ground_station():
    station = np.array([-150.0, 200.0])
    points = np.array(fly_back())[:, :2] - station
    angles = np.unwrap(np.arctan2(points[1:6, 1], points[1:6, 0]))
    assert abs(angles[-1] - angles[0]) == pytest.approx(2.0 * math.pi)
    last = np.array(fly_back())[-2:, :2]
    course = math.degrees(math.atan2(last[1, 0] - last[0, 0], last[1, 1] - last[0, 1]))
    assert course == pytest.approx(30.0)  # intercepts the axis at 30 deg
    assert last[1].tolist() == [0.0, -5000.0]


@pytest.mark.parametrize(
    ("aircraft", "across", "sink"),
    [
        (FixedWingConfig(), 0.5, 1.2),
        (FixedWingConfig(dynamics="lagged"), 0.5, 1.5),
        (FixedWingConfig(dynamics="lagged", wind=[2.0, 4.0], turbulence_wind=5.0), 4.0, 2.5),
    ],
)
def test_with_true_positions_it_lands_on_the_point(aircraft, across, sink):
    controller = FixedWingFlightControllerConfig(route=RouteConfig(waypoints=[]))
    flight = reference_flight(controller, RUNWAY, FlatTerrain(), 1, aircraft)
    p_r = np.array([runway_from_ned(p, RUNWAY.heading_radians) for p in
                    flight[["north", "east", "down"]].to_numpy()])  # fmt: skip
    touchdown = int(np.argmax(p_r[:, 2] >= -1.2 - 1e-6))
    assert abs(p_r[touchdown, 0]) < across
    assert -20.0 < p_r[touchdown, 1] < 120.0
    assert 0.0 < flight["v_down"].iloc[touchdown - 1] < sink
    assert flight["v_north"].iloc[-1] == 0.0
    assert np.abs(p_r[touchdown:, 0]).max() < across + 1.0
    assert p_r[-1, 1] < 400.0


def test_altitude_step():
    """Fig. 53: a step of the altitude command is followed with little overshoot."""
    waypoints = [[0.0, -20000.0, -500.0], [0.0, -19999.0, -500.0], [0.0, -19000.0, -560.0],
                 [0.0, -18900.0, -560.0], [0.0, -5000.0, -560.0]]  # fmt: skip
    controller = FixedWingFlightControllerConfig(route=RouteConfig(waypoints=waypoints))
    aircraft = FixedWingConfig(
        dynamics="lagged", start=[0.0, -20000.0, -500.0], start_vertical_speed=0.0
    )
    flight = reference_flight(controller, RUNWAY, FlatTerrain(), 1, aircraft, longest=300.0)
    altitude = -flight["down"].to_numpy()
    assert altitude.max() < 570.0
    assert altitude[-1] == pytest.approx(560.0, abs=1.0)

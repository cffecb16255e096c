"""The landing down a cone: its table, its decisions, its flights, the wind it observes."""

import math

import numpy as np
import pytest

from systems.schedule import SUPERVISOR_PERIOD
from systems.supervisors.cone import Cone, ConeConfig, ConeMemory
from systems.supervisors.landing_supervisor import LandingSupervisor, LandingSupervisorConfig
from systems.supervisors.mission import MissionConfig, flight_table
from systems.supervisors.situation import Situation
from systems.supervisors.state_machine import problems
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.supervisors.point_mass import Flight, PointMass

PAD = (0.3, -0.2)
GRAVITY = 9.80665


def settings(**fields) -> ConeConfig:
    # The point mass stands with its origin on the ground.
    return ConeConfig(feet_height=0.0, **fields)


def fly(duration=200.0, altitude=6.0, pad=PAD, **plant) -> Flight:
    routine = plant.pop("routine", settings())
    mission = MissionConfig(altitude=altitude, side=0.0, settle_time=0.0)
    config = LandingSupervisorConfig(routine=routine, mission=mission)
    return Flight(config, PointMass(pad=pad, **plant), duration)


def situation(**fields) -> Situation[ConeMemory]:
    """A vehicle that hovers level 1 m over a pad at the origin, in sight for a while."""
    s = Situation(ConeMemory(), SUPERVISOR_PERIOD)
    s.time, s.z, s.height, s.acquired, s.goal_sigma = 50.0, 1.0, 1.0, True, 0.01
    s.goal_x = s.goal_y = s.goal_z = 0.0
    m = s.memory
    m.known, m.pad_x, m.pad_y, m.pad_z = 1.0, 0.0, 0.0, 0.0
    m.landing_started, m.hover_command, m.attempts = 20.0, 0.4, 1.0
    s.command = 0.4
    for name, value in fields.items():
        setattr(m if hasattr(m, name) else s, name, value)
    return s


def test_topology():
    supervisor = LandingSupervisor(LandingSupervisorConfig(routine=settings()))
    assert_matches_docstring(supervisor)
    assert periodic_update(supervisor) == (SUPERVISOR_PERIOD, 0.0)


def test_table_is_sound():
    assert problems(flight_table(Cone.table)) == []
    assert 'label="' in LandingSupervisor(LandingSupervisorConfig(routine=settings())).states_dot()


# -- flights


def test_lands_on_the_pad():
    flight = fly()
    assert flight.landed
    assert flight.states[-4:] == ["descend", "settle", "touch", "landed"]
    np.testing.assert_allclose(flight.position[:2], PAD, atol=0.03)
    assert flight.status.attempts[-1] == 1.0


def test_a_pad_far_away_is_approached_before_the_descent():
    flight = fly(pad=(-8.0, 3.0))
    assert flight.landed
    np.testing.assert_allclose(flight.position[:2], (-8.0, 3.0), atol=0.05)
    at = flight.estimates
    outside = np.hypot(at.p_WB_x + 8.0, at.p_WB_y - 3.0) > 3.0
    landing = flight.times > flight.time_of("descend")
    assert at.p_WB_z[outside & landing].min() > 5.5


def test_the_descent_stays_in_the_cone():
    flight = fly(pad=(-3.0, 0.0))
    c = settings()
    at, down = flight.estimates, flight.setpoints.v_WB_z < -0.05
    radius = c.cone_radius + c.cone_slope * np.maximum(at.p_WB_z, 0.0)
    landing = flight.times > flight.time_of("descend")
    assert (np.hypot(at.p_WB_x + 3.0, at.p_WB_y) <= radius + 0.02)[landing & down].all()


@pytest.mark.parametrize("velocity", [(2.0, 0.0), (-0.5, 1.0)])
def test_lands_on_a_moving_pad(velocity):
    flight = fly(pad_velocity=velocity)
    assert flight.landed
    # The point mass stops where it touches; the pad goes on until that is noticed.
    touched = flight.times[-1]
    miss = flight.position[:2] - np.array(PAD) - np.array(velocity) * touched
    assert np.hypot(*miss) < 0.1 + np.hypot(*velocity) * 1.5


def test_rises_when_it_loses_sight_and_goes_on():
    flight = fly(visible=lambda t, z: not 7.0 < t < 10.0)
    assert ("hold", "descend") in flight.transitions
    assert flight.landed
    np.testing.assert_allclose(flight.position[:2], PAD, atol=0.03)


def test_goes_round_when_sight_is_lost_for_long():
    flight = fly(visible=lambda t, z: not 7.0 < t < 16.0)
    assert ("hold", "go_round") in flight.transitions
    assert flight.landed
    assert flight.status.attempts[-1] == 2.0
    np.testing.assert_allclose(flight.position[:2], PAD, atol=0.03)


def test_attempts_are_bounded_when_the_pad_is_never_seen_close_by():
    flight = fly(visible=lambda t, z: z > 3.0)
    assert flight.landed
    assert flight.status.attempts[-1] == settings().maximum_attempts
    assert flight.landing_time < settings().maximum_time + 25.0
    np.testing.assert_allclose(flight.position[:2], PAD, atol=0.3)


BLIND = {"lost_time": 1e9, "drift": 0.05}  # known ever less, as the estimator says


def test_what_is_not_seen_from_the_beginning_is_landed_on_at_once():
    """Another attempt would see no more, and waiting only makes it worse."""
    flight = fly(visible=lambda t, z: t < 4.5, **BLIND)
    assert flight.landed
    assert ("descend", "land_anyway") in flight.transitions
    assert flight.status.attempts[-1] == 1.0
    assert flight.landing_time < 12.0


def test_what_is_seen_from_close_by_alone_is_found_on_the_way_down():
    flight = fly(visible=lambda t, z: t < 4.5 or z < 1.5, **BLIND)
    assert flight.landed
    assert "touch" in flight.states
    assert flight.status.attempts[-1] == 1.0


def test_what_is_seen_from_above_alone_is_looked_at_once_more():
    flight = fly(visible=lambda t, z: z > 3.0, **BLIND)
    assert flight.landed
    assert ("hold", "go_round") in flight.transitions
    assert flight.states[-2] in ("land_anyway", "touch")
    assert flight.status.attempts[-1] == 2.0
    assert flight.landing_time < 40.0


def test_a_pad_that_was_never_seen_is_found_from_further_down():
    flight = fly(visible=lambda t, z: 0.0 < z < 3.0 and t > 4.0)
    assert ("look_lower", "descend") in flight.transitions
    assert flight.landed
    np.testing.assert_allclose(flight.position[:2], PAD, atol=0.05)


def test_searches_a_spiral_and_then_lands_anyway():
    flight = fly(visible=lambda t, z: False)
    assert {("look", "look_lower"), ("look_lower", "search")} <= flight.transitions
    assert ("search", "land_anyway") in flight.transitions
    assert flight.landed
    np.testing.assert_allclose(flight.position[:2], (2.0, 0.0), atol=0.3)  # where it climbed
    at = flight.estimates
    searching = (flight.times > flight.time_of("search")) & (
        flight.times < flight.time_of("land_anyway")
    )
    radius = np.hypot(at.p_WB_x - 2.0, at.p_WB_y)[searching]
    assert radius.max() > 0.8 * settings().search_radius
    # No winding is further from the one before than the camera sees across.
    angle = np.unwrap(np.arctan2(at.p_WB_y, at.p_WB_x - 2.0)[searching])
    turns = np.interp(angle[200:] - 2 * math.pi, angle, radius)
    assert (radius[200:] - turns)[angle[200:] > angle[0] + 4 * math.pi].max() < 2 * 0.3 * 6.0


def test_finds_a_pad_on_the_spiral():
    # In sight only within 2 m, 6 m beside the mission's end.
    pad = (2.0, 6.0)
    plant: dict[str, PointMass] = {}

    def visible(t, z):
        body = plant["system"].position_now
        return math.hypot(body[0] - pad[0], body[1] - pad[1]) < 2.0

    class Watched(PointMass):
        position_now = (2.0, 0.0)

        def _update(self, context, discrete_state):
            self.position_now = context.get_discrete_state_vector().value()[:2].copy()
            return super()._update(context, discrete_state)

    mission = MissionConfig(altitude=6.0, side=0.0, settle_time=0.0)
    plant["system"] = Watched(pad=pad, visible=visible)
    config = LandingSupervisorConfig(routine=settings(), mission=mission)
    flight = Flight(config, plant["system"], 200.0)
    assert ("search", "descend") in flight.transitions
    assert flight.landed
    np.testing.assert_allclose(flight.position[:2], pad, atol=0.05)


def test_time_is_bounded():
    """A pad that runs away faster than the vehicle: the landing ends all the same."""
    c = settings(maximum_time=10.0, return_time=5.0)
    flight = fly(routine=c, pad=(-60.0, 0.0), pad_velocity=(-8.0, 0.0))
    assert flight.states[-2:] == ["land_anyway", "landed"]
    assert flight.landing_time < 10.0 + 5.0 + 20.0


def test_never_a_hard_landing():
    for flight in (fly(), fly(visible=lambda t, z: z > 3.0), fly(visible=lambda t, z: False)):
        assert flight.estimates.v_WB_z[flight.estimates.p_WB_z < 0.2].min() > -0.7


# -- decisions


def descent(s, config=None):
    Cone(config or settings()).descend_in_cone(s)
    return -s.memory.setpoint_vz


def test_outside_the_cone_it_climbs_near_the_pad_too():
    assert descent(situation(z=0.2, x=0.5)) < -0.2


def test_the_nearer_of_ground_and_pad_is_braked_for():
    """The pad was last known 1 m too low."""
    s = situation(z=1.2, height=0.2, height_measured=True)
    Cone(settings()).sit_down(s)
    assert -s.memory.setpoint_vz == pytest.approx(settings().touch_speed)


def test_uncertainty_stops_the_descent_as_an_error_does():
    assert descent(situation()) > 0.3
    assert descent(situation(x=0.5)) <= 0.0
    assert descent(situation(goal_sigma=0.25)) <= 0.0
    assert descent(situation(x=1.5)) < -0.1


def test_touches_down_when_the_prediction_is_good_and_sooner_or_later():
    cone = Cone(settings())
    low = {"z": 0.15, "goal_sigma": 0.002}
    assert cone.aligned(situation(**low, x=0.01, entered=50.0))
    assert not cone.aligned(situation(**low, x=0.06, entered=50.0))
    assert not cone.aligned(situation(**low, x=0.01, vx=0.3, entered=50.0))
    assert not cone.aligned(situation(z=0.6, x=0.0, entered=50.0))
    patience = settings().patience
    assert cone.aligned(situation(**low, x=0.06, entered=50.0 - patience))


def test_high_up_the_leaning_cameras_look_at_the_pad_once_they_have_seen_it():
    cone = Cone(settings())
    s = situation(z=4.0, lean_ax=3.0, attempt_began=20.0, last_fusion=19.0)
    assert cone._goal(s) == (0.0, 0.0)  # blind from the beginning: straight down
    s.memory.last_fusion = 45.0
    x, y = cone._goal(s)
    # Thrust leans to -3/g: so does the cameras' axis, which meets the ground above the pad.
    assert x + (4.0 - settings().settle_height) * 3.0 / GRAVITY == pytest.approx(0.0)
    assert y == 0.0
    s.z = 0.1
    assert cone._goal(s) == (0.0, 0.0)


def test_what_moves_is_where_it_is_now_when_decisions_are_made():
    """A guard comes before `track_pad`: what the memory holds of the pad is an event old."""
    cone = Cone(settings())
    s = situation(z=0.15, x=0.12, vx=3.0, pad_ux=3.0, entered=50.0)
    assert not cone.aligned(s)
    s.goal_x = 0.12
    assert cone.aligned(s)
    s.goal_z = -0.2
    assert not cone.aligned(s)


def test_misses_are_aborted_while_there_is_room():
    cone = Cone(settings())
    assert cone.missing_pad(situation(z=0.1, x=0.2))
    assert not cone.missing_pad(situation(z=0.1, x=0.05))
    assert not cone.missing_pad(situation(z=0.03, x=0.2))


def test_the_ground_is_felt_and_a_gust_is_not():
    cone = Cone(settings())
    falling = {"setpoint_vz": -0.4, "setpoint_z": math.nan, "vz": -0.3, "push": 1.0}
    assert cone.on_the_ground(situation(z=0.01, az=5.0, **falling))
    assert not cone.on_the_ground(situation(z=0.01, az=3.0, **falling))
    assert not cone.on_the_ground(situation(z=0.8, az=5.0, **falling))
    climbing = {**falling, "setpoint_vz": 0.3}
    assert not cone.on_the_ground(situation(z=0.01, az=5.0, **climbing))


def test_a_soft_touch_is_noticed_after_a_while():
    cone = Cone(settings())
    resting = {"z": 0.02, "setpoint_vz": -0.4, "setpoint_z": math.nan, "push": 0.0}
    s = situation(**resting, time=50.0)
    cone.watch_sinking(s)
    assert not cone.on_the_ground(s)
    s.time += settings().still_time
    s.vz = -0.2  # the estimate drifts, the height does not
    assert cone.on_the_ground(s)
    s.z -= 0.3 * settings().still_time
    assert not cone.on_the_ground(s)
    cone.watch_sinking(s)
    s.time += settings().still_time
    assert cone.on_the_ground(s)


def test_ground_that_was_not_meant_is_left_again():
    cone = Cone(settings())
    grazing = {"z": 0.01, "az": 5.0, "setpoint_vz": -0.1, "setpoint_z": math.nan, "push": 0.0}
    assert cone.on_the_pad(situation(**grazing, x=0.05))
    assert not cone.on_the_pad(situation(**grazing, x=0.2))
    assert cone.on_the_ground(situation(**grazing, x=0.2))


def test_blown_away_goes_back_into_the_cone():
    cone = Cone(settings())
    assert cone.blown_away(situation(z=0.2, x=0.5))
    assert not cone.blown_away(situation(z=0.2, x=0.1))


# -- the wind


def test_a_steady_push_is_observed_and_fed_forward():
    """A wind that begins after the landing did: −d̂ follows it within half a second."""
    cone = Cone(settings())
    s = situation(time=20.0)
    s.memory.landing_started = 20.0
    for k in range(100):
        s.time = 20.0 + SUPERVISOR_PERIOD * k
        wind = 0.6 if s.time > 22.0 else 0.2
        s.ax = wind  # nothing holds against it yet: the vehicle is level and accelerates
        cone.observe_drift(s)
        if s.time <= 20.9:
            assert s.memory.setpoint_ax == 0.0
    assert s.memory.drift_ax == pytest.approx(0.6, abs=0.01)
    # The first 0.2 m/s2 are the integrator's.
    assert s.memory.setpoint_ax == pytest.approx(-0.4, abs=0.01)


def test_a_lean_that_makes_no_acceleration_is_wind_too():
    cone = Cone(settings())
    s = situation(time=20.0)
    lean = 0.1
    s.up_x, s.up_z = -math.sin(lean), math.cos(lean)
    s.command = 0.4 / math.cos(lean)
    for k in range(200):
        s.time = 20.0 + SUPERVISOR_PERIOD * k
        cone.observe_drift(s)
    assert s.memory.drift_ax == pytest.approx(GRAVITY * math.tan(lean), rel=1e-3)
    assert s.memory.push == pytest.approx(0.0, abs=1e-3)
    # Leaning it aims upwind, for it will fall back on its feet.
    x, _ = Cone(ConeConfig())._goal(s)
    assert x == pytest.approx(-0.2 * math.tan(lean), rel=1e-3)


def test_a_heaving_pad_is_sunk_with():
    as_exact = settings(heave_time=0.0)
    s = situation(pad_uz=0.2)
    level = situation()
    assert descent(s, as_exact) == pytest.approx(descent(level, as_exact) - 0.2)
    assert descent(s) < descent(s, as_exact)


def leaning(angle, **fields):
    return situation(up_x=-math.sin(angle), up_z=math.cos(angle), **fields)


def test_who_leans_stays_higher_and_does_not_sit_down_at_first():
    cone = Cone(settings())
    level, a_little, much = (leaning(a, z=0.15, entered=50.0) for a in (0.0, 0.2, 0.6))
    assert cone._settled(level) == cone._settled(a_little) == settings().settle_height
    assert cone._settled(much) > 0.4
    cone.keep_low(much)
    assert much.memory.setpoint_vz > 0.4  # it climbs
    assert cone.aligned(level)
    assert not cone.aligned(much)
    much.time += settings().patience
    assert cone.aligned(much)


def test_sitting_down_waits_for_a_gust_to_pass_but_not_for_ever():
    cone = Cone(settings())
    fields = {"z": 0.3, "height": 0.3, "pad_x": 0.0}
    level, much = leaning(0.0, **fields), leaning(0.6, **fields)
    for s in (level, much):
        cone.sit_down(s)
    assert level.memory.setpoint_vz < -0.3
    assert much.memory.setpoint_vz > 0.0
    late = settings().maximum_time + settings().return_time
    overdue = leaning(0.6, **fields, time=20.0 + late)
    cone.sit_down(overdue)
    assert overdue.memory.setpoint_vz < -0.3


def test_it_looks_where_it_took_off_or_saw_the_pad_from_upwind():
    cone = Cone(settings())
    s = situation(z=5.0, height=5.0, home_x=1.0, home_y=2.0, known=0.0, lean_ax=2.0)
    upwind = -5.0 * 2.0 / GRAVITY
    cone.look_there(s)
    assert (s.memory.setpoint_x, s.memory.setpoint_y) == pytest.approx((1.0 + upwind, 2.0))
    s.memory.known, s.memory.pad_x, s.memory.pad_y = 1.0, -1.0, 0.5
    cone.look_there(s)
    assert (s.memory.setpoint_x, s.memory.setpoint_y) == pytest.approx((-1.0 + upwind, 0.5))


def test_a_pad_of_known_place_is_looked_at_before_the_descent():
    cone = Cone(settings())
    s = situation(entered=50.0, last_fusion=49.9)
    assert not cone.seen_again(s)
    assert not cone.certain_but_not_seen(s)
    s.time += settings().glance_time
    assert cone.certain_but_not_seen(s)
    s.memory.last_fusion = 50.1
    assert cone.seen_again(s)

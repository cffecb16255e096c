"""Both filters of the fixed wing: fusion against the textbook, phases, gates, synchronisation."""

import math

import numpy as np
import pytest

from systems.estimators import runway_error_filter_kernel as thesis
from systems.estimators import runway_improved_filter_kernel as improved
from systems.estimators.runway_error_filter import RunwayErrorFilter, RunwayErrorFilterConfig
from systems.estimators.runway_improved_filter import (
    RunwayImprovedFilter,
    RunwayImprovedFilterConfig,
)
from systems.estimators.runway_kalman import covariance_of_errors, fuse, sight
from systems.estimators.runway_record import (
    RunwayRecord,
    RunwayRecordConfig,
    nees_of_errors,
)
from systems.runway_frames import RunwayConfig, ned_from_runway, pixel_from_angles
from systems.signals.measurement import no_measurement
from systems.signals.runway_measurement import FILTER_INPUTS, NAVIGATION_ESTIMATE
from systems.supervisors.runway_phases import Phase
from tests.runway_bench import assert_contract
from tests.system_contract import periodic_update

RUNWAY = RunwayConfig()
HEADING = RUNWAY.heading_radians
BOTH = pytest.mark.parametrize("kind", ["thesis", "improved"])
LAYOUTS = dict(FILTER_INPUTS)


class Flight:
    """A straight flight towards the touch-down point, seen by a filter's kernel."""

    def __init__(self, kind, along=-3000.0, error=(0.0,) * 5, config=None, level=False):
        self.kind = kind
        kernel = thesis if kind == "thesis" else improved
        config = config or (
            RunwayErrorFilterConfig() if kind == "thesis" else RunwayImprovedFilterConfig()
        )
        self.config = config
        self.parameters = config.parameters(RUNWAY)
        self.kernel_step = kernel.step
        self.estimate, self.memory = NAVIGATION_ESTIMATE.zeros(), kernel.initial_memory()
        self.time = 0.0
        self.tick = 0
        self.start = along
        self.level = level
        self.error = np.array(error, dtype=float)
        self.inputs = {name: no_measurement(layout) for name, layout in LAYOUTS.items()}

    @property
    def p_n(self):
        along = self.start + 33.0 * self.time
        return ned_from_runway(
            np.array([0.0, along, -100.0 if self.level else 0.1 * along]), HEADING
        )

    @property
    def v_n(self):
        return ned_from_runway(np.array([0.0, 33.0, 0.0 if self.level else 3.3]), HEADING)

    def give(self, name, *fields, validity=None):
        layout, old = LAYOUTS[name], self.inputs[name]
        self.inputs[name] = np.array(
            [self.time if validity is None else validity, self.time, old[2] + 1.0, 1.0, *fields]
        )
        assert self.inputs[name].size == layout.size

    def sight(self, p_n=None):
        c = self.config.camera
        bearing, elevation, _ = sight(
            self.p_n if p_n is None else p_n, HEADING, -0.05, 0.0,
            np.array(c.position), c.mounting_radians(),
        )  # fmt: skip
        return pixel_from_angles(bearing, elevation, c.optics())

    def step(self, phase):
        if self.tick % 2 == 0:
            self.inputs["inertial"][:10] = (
                self.time, self.time, self.tick // 2, 1.0,
                *(self.p_n[:2] + self.error[:2]), self.p_n[2],
                *(self.v_n[:2] + self.error[3:5]), self.v_n[2],
            )  # fmt: skip
        self.inputs["inertial"][10:14] = (self.time, HEADING, -0.05, 0.0)
        self.give("baro", -self.p_n[2] - self.error[2])
        self.inputs["phase"] = np.array([float(phase), 0.0, 0.0, 0.0])
        measurements = np.concatenate([self.inputs[name] for name, _ in FILTER_INPUTS])
        self.kernel_step(self.estimate, self.memory, measurements, self.parameters)
        self.tick += 1
        self.time = self.tick * 0.01
        self.error[:2] += 0.01 * self.error[3:5]

    def fix(self, sigma=(50.0, 5.0, 0.5), off=(0.0,) * 5):
        self.give("fix", *(self.p_n + off[:3]), *(self.v_n[:2] + off[3:5]), *sigma)

    def run(self, seconds, phase, pictures=True, laser=False):
        for _ in range(round(seconds / 0.01)):
            if pictures and self.tick % 4 == 0:
                self.give("picture", *self.sight(), 1.0)
            if laser and self.tick % 10 == 0:
                self.give("laser", -self.p_n[2])
            self.step(phase)
        return NAVIGATION_ESTIMATE(self.estimate)


def test_topology():
    for system in (
        RunwayErrorFilter(RunwayErrorFilterConfig()),
        RunwayImprovedFilter(RunwayImprovedFilterConfig()),
    ):
        assert_contract(system)
        assert periodic_update(system) == (0.01, 0.005)
    assert_contract(RunwayRecord(RunwayRecordConfig()))


def test_scalar_fusions_are_the_joint_update_of_equation_19():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(5, 5))
    P0, x0 = A @ A.T, rng.normal(size=5)
    H, R = rng.normal(size=(3, 5)), np.diag([0.5, 2.0, 1.0])
    nu = rng.normal(size=3)
    S = H @ P0 @ H.T + R
    K = P0 @ H.T @ np.linalg.inv(S)
    x, P = x0.copy(), P0.copy()
    for k in range(3):
        fuse(x, P, x0, H[k], nu[k], R[k, k])
    np.testing.assert_allclose(x, x0 + K @ nu)
    np.testing.assert_allclose(P, (np.eye(5) - K @ H) @ P0, atol=1e-12)


def test_sight_derivative_by_differences():
    p = np.array([-800.0, 60.0, -90.0])
    fixed = (0.05, -0.06, 0.02, np.array([2.5, 0.1, 0.5]), np.array([0.01, -0.05, 0.02]))
    _, _, H = sight(p, *fixed)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 0.01
        # the error is taken off the position, so the derivative by it has the other sign
        up, down = sight(p - step, *fixed)[:2], sight(p + step, *fixed)[:2]
        np.testing.assert_allclose(
            H[:, axis], (np.array(up) - np.array(down)) / 0.02, rtol=1e-5, atol=1e-10
        )


@BOTH
def test_nothing_before_the_first_fix(kind):
    flight = Flight(kind)
    flight.run(0.2, Phase.STANDBY, pictures=False)
    assert flight.estimate[1] == 0.0
    np.testing.assert_array_equal(flight.estimate[2:], 0.0)


@BOTH
def test_standby_takes_the_error_from_the_fix(kind):
    """Eq. 24: H = I; the covariance is the receiver's, and shrinks with every fix."""
    flight = Flight(kind, error=(800.0, -400.0, 12.0, 1.0, -0.5))
    flight.fix(off=(10.0, -5.0, 2.0, 0.1, 0.2))
    flight.step(Phase.STANDBY)
    found = flight.estimate[11:16]
    np.testing.assert_allclose(
        found, np.add(flight.error, [-10.0, 5.0, -2.0, -0.1, -0.2]), atol=0.02
    )
    P = covariance_of_errors(flight.estimate)
    np.testing.assert_allclose(np.sqrt(np.diag(P)), [50.0, 50.0, 5.0, 0.5, 0.5], rtol=1e-3)
    for _ in range(8):
        flight.run(0.1, Phase.STANDBY, pictures=False)
        flight.fix()
    flight.step(Phase.STANDBY)
    P = covariance_of_errors(flight.estimate)
    np.testing.assert_allclose(np.sqrt(np.diag(P))[:3], [50 / 3, 50 / 3, 5 / 3], rtol=0.05)


@BOTH
def test_covariance_is_kept_between_phases_and_grows_without_measurement(kind):
    """4.2 and Eq. 23: no jump from Return to Final; Short Final only drifts."""
    flight = Flight(kind)
    flight.fix()
    flight.run(0.5, Phase.STANDBY, pictures=False)
    before = covariance_of_errors(flight.estimate)
    flight.step(Phase.RETURN)
    flight.step(Phase.FINAL)
    after = covariance_of_errors(flight.estimate)
    np.testing.assert_allclose(np.diag(after), np.diag(before), rtol=1e-3)
    flight.run(5.0, Phase.SHORT_FINAL, pictures=False)
    drifted = covariance_of_errors(flight.estimate)
    assert drifted[0, 0] > after[0, 0]


@BOTH
def test_return_finds_the_position_across_the_line_of_sight(kind):
    flight = Flight(kind, along=-6000.0, error=(60.0, 0.0, 0.0, 0.0, 0.0))
    flight.fix(off=(60.0, 0.0, 0.0, 0.0, 0.0))  # starts with an error to the north
    flight.step(Phase.STANDBY)
    station = RUNWAY.ground_station_n()
    for _ in range(60):
        d = flight.p_n - station
        flight.give("antenna", math.atan2(d[1], d[0]), math.atan2(-d[2], math.hypot(d[0], d[1])))
        flight.run(1.0, Phase.RETURN, pictures=False)
    error = flight.estimate[2:4] - flight.p_n[:2]
    across = abs(-math.sin(HEADING) * error[0] + math.cos(HEADING) * error[1])
    assert across < 20.0  # 40 m at the start


@BOTH
def test_final_with_perfect_pictures_and_laser_converges(kind):
    # the thesis's filter with the noise of the tracker alone, which these pictures do not have
    sharp = RunwayErrorFilterConfig(final_noise=1.0, laser_noise=0.1, speed_walk=0.002)
    config = sharp if kind == "thesis" else None
    flight = Flight(kind, error=(30.0, -20.0, 4.0, 0.2, -0.2), config=config)
    flight.fix(off=(20.0, 10.0, 0.0, 0.1, 0.1))
    flight.step(Phase.STANDBY)
    flight.run(58.0, Phase.FINAL)
    flight.run(25.0, Phase.FINAL_WITH_LASER, laser=True)
    error = flight.estimate[2:5] - flight.p_n
    assert np.hypot(*error[:2]) < 4.0
    assert abs(error[2]) < 0.3


def test_laser_activation_resets_widens_or_both():
    """4.2: an altitude reset, a covariance increase, or a mix; here with a 10 m altitude error."""
    found = {}
    for share, increase in ((1.0, 0.0), (0.0, 10.0), (0.5, 3.0)):
        config = RunwayErrorFilterConfig(
            altitude_reset=share, altitude_increase=increase, laser_noise=0.1
        )
        flight = Flight("thesis", along=-1000.0, error=(0.0, 0.0, 10.0, 0.0, 0.0), config=config)
        flight.fix(off=(0.0, 0.0, 10.0, 0.0, 0.0))
        flight.run(0.1, Phase.FINAL, pictures=False)
        flight.step(Phase.STANDBY)
        flight.give("laser", -flight.p_n[2])
        flight.step(Phase.FINAL_WITH_LASER)
        found[share] = abs(flight.estimate[4] - flight.p_n[2])
    assert found[1.0] < 0.4
    assert found[0.0] < 0.5  # a wide covariance lets the first sample do it
    assert found[1.0] < found[0.5] < 10.0


def test_hand_tuning_multiplies_as_section_4_3_says():
    theory = RunwayErrorFilterConfig(tuning="theoretical").parameters(RUNWAY)
    hand = RunwayErrorFilterConfig(tuning="hand").parameters(RUNWAY)
    np.testing.assert_allclose(hand[:6] / theory[:6], [2.25, 2.25, 2.25, 400.0, 100.0, 400.0])


def test_a_faulty_picture_is_refused_and_the_thesis_takes_it():
    """A tracker that jumps by 60 px for two seconds."""
    moved = {}
    for kind in ("thesis", "improved"):
        flight = Flight(kind, along=-1500.0)
        flight.fix()
        flight.step(Phase.STANDBY)
        flight.run(10.0, Phase.FINAL)
        before = np.hypot(*(flight.estimate[2:4] - flight.p_n[:2]))
        for k in range(200):
            if k % 4 == 0:
                u, v = flight.sight()
                flight.give("picture", u + 60.0, v, 1.0)
            flight.step(Phase.FINAL)
        moved[kind] = np.hypot(*(flight.estimate[2:4] - flight.p_n[:2])) - before
        assert flight.estimate[37] == (50.0 if kind == "improved" else 0.0)
    assert moved["improved"] < 1.0
    assert moved["thesis"] > 5.0


def test_a_lasting_contradiction_is_believed_in_the_end():
    config = RunwayImprovedFilterConfig(patience=2.0)
    flight = Flight("improved", along=-3000.0, config=config)
    flight.fix(sigma=(1.0, 1.0, 0.1), off=(150.0, -150.0, 0.0, 0.0, 0.0))  # a liar
    flight.step(Phase.STANDBY)
    flight.run(1.5, Phase.FINAL)
    wrong = np.hypot(*(flight.estimate[2:4] - flight.p_n[:2]))
    flight.run(20.0, Phase.FINAL)
    assert np.hypot(*(flight.estimate[2:4] - flight.p_n[:2])) < 0.6 * wrong


def test_time_stamps_take_the_delay_out():
    """Pictures 0.4 s old: the thesis lags behind by about 13 m, the improved filter does not.

    In level flight: on the glide slope the point stays where it is in the picture,
    which is why the thesis finds so little effect of latency.
    """
    lag = {}
    for kind in ("thesis", "improved"):
        flight = Flight(kind, along=-1300.0, level=True)
        flight.fix(sigma=(50.0, 0.5, 0.5))
        flight.step(Phase.STANDBY)
        for _ in range(3000):
            if flight.tick % 4 == 0 and flight.time > 0.5:
                then = flight.p_n - 0.4 * flight.v_n
                flight.give("picture", *flight.sight(then), 1.0, validity=flight.time - 0.4)
            flight.step(Phase.FINAL)
        error = flight.estimate[2:4] - flight.p_n[:2]
        lag[kind] = -(error @ [math.cos(HEADING), math.sin(HEADING)])
    assert lag["thesis"] > 5.0
    assert abs(lag["improved"]) < 2.0


def test_wind_and_declination_are_found():
    flight = Flight("improved")
    flight.fix(sigma=(1.0, 1.0, 0.05))
    wind = np.array([3.0, -4.0])
    air = flight.v_n[:2] - wind
    flight.step(Phase.STANDBY)
    for _ in range(30):
        flight.give("heading", HEADING - 0.03)
        flight.give("airspeed", math.sqrt(air @ air + 3.3**2))
        flight.run(0.08, Phase.RETURN, pictures=False)
    found = NAVIGATION_ESTIMATE(flight.estimate)
    assert found.declination == pytest.approx(0.03)
    # the nose points along the track here, so only the part along it can be right
    along = np.array([math.cos(HEADING), math.sin(HEADING)])
    expected = (np.hypot(*flight.v_n[:2]) - math.sqrt(air @ air)) * along
    np.testing.assert_allclose([found.wind_x, found.wind_y], expected, atol=0.1)


def test_wheels_hold_the_speed_on_the_ground():
    flight = Flight("improved", along=0.0, error=(0.0, 0.0, 0.0, 0.4, -0.3))
    flight.fix(sigma=(1.0, 1.0, 0.5), off=(0.0, 0.0, 0.0, 0.4, -0.3))
    flight.step(Phase.STANDBY)
    speed = np.hypot(*flight.v_n[:2])
    for _ in range(60):
        flight.give("wheel_speed", speed)
        flight.give("heading", HEADING)
        flight.run(0.08, Phase.BRAKING, pictures=False)
    np.testing.assert_allclose(flight.estimate[5:7], flight.v_n[:2], atol=0.12)


def test_nees_is_the_normalised_square():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(5, 5))
    P, e = A @ A.T, rng.normal(size=5)
    estimate = NAVIGATION_ESTIMATE.zeros()
    estimate[16:31] = P[np.triu_indices(5)]
    assert nees_of_errors(e, estimate) == pytest.approx(e @ np.linalg.solve(P, e))

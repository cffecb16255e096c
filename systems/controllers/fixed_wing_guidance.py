"""The fixed wing's trajectories: en-route legs, the turn around the ground station, the landing.

Pure functions of flat arrays. A route is a list of waypoints; the aircraft
flies the straight legs between them, climbing and descending linearly (Leonard
2016, 2.2), and after the last one the landing trajectory, which is a straight
line over the runway's axis with a vertical profile.
"""

import math

import numpy as np
from numba import njit
from pydantic import Field

from systems.configuration import Finite, Metres, Positive, Seconds, Vector3, configuration
from systems.runway_frames import GRAVITY, RunwayConfig, ned_from_runway, wrap_angle


@configuration
class LandingProfileConfig:
    """The vertical profile of the landing trajectory (2.2): a slope, then a flare.

    The wheels touch at the touch-down point, where the flare ends, so the slope aims short
    of it, and the elevation at which the camera sees the point falls on the way in: 5.3 deg
    at 300 m, 3.7 deg at 100 m. An error of the height makes one along the runway that is
    1/tan of it as large and grows by a third between the two, Table 5's mean by a half.
    """

    slope: Positive = 6.0  # deg (Fig. 25)
    flare: Metres = 105.0  # m, length of the flare, which takes three seconds
    touchdown_sink: Positive = 0.5  # m/s, wanted where the wheels touch
    lead: Seconds = 0.4  # s, the feed-forward looks ahead for the aircraft's lag

    def vector(self, speed: float, gear: float) -> np.ndarray:
        """The flat parameters of `landing_altitude`, shape (5,)."""
        return np.array(
            [
                math.tan(math.radians(self.slope)),
                self.flare,
                self.touchdown_sink / speed,
                gear,
                self.lead,
            ]
        )


@configuration
class RouteConfig:
    """The waypoints of the return in the runway frame, and the landing after them.

    The default is the fly-back of Fig. 42 without its detours: from a place
    beyond the airfield to a complete square around the ground station, out along
    the runway, round, and back along a track that meets the axis at 30 deg; the
    last waypoint lies on the axis, 5 km before the touch-down point.
    """

    waypoints: list[Vector3] = Field(default_factory=lambda: fly_back())  # m, the third down
    profile: LandingProfileConfig = Field(default_factory=LandingProfileConfig)

    def waypoints_n(self, runway: RunwayConfig) -> np.ndarray:
        """The waypoints in NED, shape (n, 3), m; (0, 3) where the flight starts on final."""
        heading = runway.heading_radians
        points = [ned_from_runway(np.array(point), heading) for point in self.waypoints]
        return np.array(points).reshape(-1, 3)


def fly_back(altitude: float = 530.0, side: float = 3000.0) -> list[list[float]]:
    """The waypoints of Fig. 42 in the runway frame: square around the station, then final.

    Parameters
    ----------
    altitude : float
        Of the whole return above the touch-down point, m; that of the landing
        trajectory at 5 km.
    side : float
        Of the square around the ground station at (−150, 200), m.
    """
    x, y, h = -150.0, 200.0, 0.5 * side
    square = [
        (x - h, y + h),
        (x - h, y - h),
        (x + h, y - h),
        (x + h, y + h),
        (x - h, y + h),
    ]
    # out on the left, then a track that meets the axis at 30 deg
    intercept = -5000.0
    out = [(x - h, -7500.0), (-1300.0, intercept - 1300.0 / math.tan(math.radians(30.0)))]
    start = [(-1500.0, 6000.0)]
    points = [*start, *square, *out, (0.0, intercept)]
    return [[px, py, -altitude] for px, py in points]


@njit(cache=True)
def landing_altitude(distance, profile):
    """Altitude (m) on the landing trajectory and its slope, at a distance before touchdown (m).

    Parameters
    ----------
    distance : float
        To the touch-down point, positive before it.
    profile : array, shape (5,)
        Slope s₁, length of the flare d₁ (m), slope at touchdown s₀, height of the gear (m),
        lead of the feed-forward (s).

    Notes
    -----
    h = s₁ d − (s₁ − s₀) d₁/2 before the flare, s₀ d + (s₁ − s₀) d²/(2 d₁) in it,
    s₀ d after it: continuous with its slope.
    """
    s1, d1, s0, gear = profile[0], profile[1], profile[2], profile[3]
    if distance > d1:
        return s1 * distance - 0.5 * (s1 - s0) * d1 + gear, s1
    if distance > 0.0:
        slope = s0 + (s1 - s0) * distance / d1
        return s0 * distance + 0.5 * (s1 - s0) * distance * distance / d1 + gear, slope
    return s0 * distance + gear, s0


@njit(cache=True)
def turn_anticipation(turn, speed, roll_limit):
    """How far before a waypoint a coordinated turn by `turn` (rad) has to begin, m."""
    radius = speed * speed / (GRAVITY * math.tan(0.8 * roll_limit))
    return radius * math.tan(0.5 * min(abs(turn), 2.6))


@njit(cache=True)
def follow(guidance, p_n, v_n, waypoints, heading, profile, roll_limit):
    """Where the aircraft is on its trajectory; moves on to the next leg, in place.

    Parameters
    ----------
    guidance : array, shape (5,)
        Layout `GUIDANCE`; leg i runs from waypoint i to i + 1, the leg after the
        last one is the landing.
    p_n, v_n : array, shape (3,)
        Position (m) and velocity (m/s) as estimated.
    waypoints : array, shape (n, 3)
        m, NED.
    heading : float
        Of the landing, rad.
    profile : array, shape (5,)
        Of `landing_altitude`.
    roll_limit : float
        rad, for the anticipation of turns.

    Returns
    -------
    course : float
        Of the leg, rad.
    sink : float
        Feed-forward vertical speed, m/s, positive down.
    """
    last = max(waypoints.shape[0] - 1, 0)
    leg = int(guidance[0])
    speed = math.hypot(v_n[0], v_n[1])
    while leg < last:
        a, b = waypoints[leg], waypoints[leg + 1]
        north, east = b[0] - a[0], b[1] - a[1]
        length = math.hypot(north, east)
        course = math.atan2(east, north)
        along = ((p_n[0] - a[0]) * north + (p_n[1] - a[1]) * east) / length
        if leg + 1 < last:
            c = waypoints[leg + 2]
            following = math.atan2(c[1] - b[1], c[0] - b[0])
        else:
            following = heading
        turn = wrap_angle(following - course)
        if along < length - min(turn_anticipation(turn, speed, roll_limit), 0.45 * length):
            guidance[0] = leg
            guidance[1] = 0.0
            across = -(p_n[0] - a[0]) * east + (p_n[1] - a[1]) * north
            guidance[2] = across / length
            share = min(max(along / length, 0.0), 1.0)
            guidance[3] = p_n[2] - (a[2] + share * (b[2] - a[2]))
            return course, speed * (b[2] - a[2]) / length
        leg += 1
    guidance[0] = leg
    guidance[1] = 1.0
    s, c = math.sin(heading), math.cos(heading)
    along = c * p_n[0] + s * p_n[1]
    guidance[2] = -s * p_n[0] + c * p_n[1]
    altitude, _ = landing_altitude(-along, profile)
    _, slope = landing_altitude(-along - profile[4] * speed, profile)
    guidance[3] = altitude + p_n[2]
    return heading, slope * speed


@configuration
class FlightControllerGains:
    """Gains of the simplified autopilot (appendix A); the thesis does not print its own."""

    # helmsman's law: natural frequency 0.25 rad/s and damping 0.9 of the cross-track error,
    # roll per course error 2ζω V/g at 33 m/s and roll per metre ω²/g
    roll_per_course: Positive = 1.5  # rad/rad
    roll_per_cross_track: Positive = 0.0064  # rad/m
    roll_limit: Positive = 25.0  # deg
    intercept_limit: Positive = 45.0  # deg, largest course off the leg that a cross track asks
    altitude_gain: Positive = 0.3  # 1/s
    altitude_integral: Finite = 0.02  # 1/s2
    climb_limit: Positive = 2.5  # m/s
    sink_limit: Positive = 5.5  # m/s
    feed_forward: bool = True  # of the profile's slope
    deceleration: Positive = 2.0  # m/s2, wheel brakes
    steering_gain: Positive = 1.0  # 1/s, yaw rate per course error on the ground
    steering_reach: Positive = 40.0  # m, aims at the centre line this far ahead
    side_acceleration: Positive = 1.5  # m/s2, limit of the nose wheel's turn

    def vector(self) -> np.ndarray:
        """The flat parameters of `helmsman`, `vertical_speed_command` and `steer`, (12,)."""
        return np.array(
            [
                self.roll_per_course,
                self.roll_per_cross_track,
                math.radians(self.roll_limit),
                math.radians(self.intercept_limit),
                self.altitude_gain,
                self.altitude_integral,
                self.climb_limit,
                self.sink_limit,
                float(self.feed_forward),
                self.steering_gain,
                self.steering_reach,
                self.side_acceleration,
            ]
        )


@njit(cache=True)
def helmsman(course_error, cross_track, gains):
    """The roll command (rad) from course error (rad) and cross track (m, right positive).

    φ^cmd = sat(−k_χ Δχ − sat(k_e e)): as a boat's autopilot (Fig. 52). The inner
    saturation bounds the interception angle, the outer one the roll.
    """
    limit = gains[0] * gains[3]
    aim = min(max(gains[1] * cross_track, -limit), limit)
    return min(max(-gains[0] * course_error - aim, -gains[2]), gains[2])


@njit(cache=True)
def vertical_speed_command(altitude_error, integral, sink, dt, gains):
    """PI control of the altitude with anti-windup: the command (positive down) and the integral.

    V_Z^cmd = sat(V_Z^ff − k_p e − k_i ∫e); the integral stands still while the
    command is saturated and the error would drive it further.
    """
    grown = integral + altitude_error * dt
    raw = gains[8] * sink - gains[4] * altitude_error - gains[5] * grown
    command = min(max(raw, -gains[6]), gains[7])
    if (raw > command and altitude_error < 0.0) or (raw < command and altitude_error > 0.0):
        grown = integral
    return command, grown


@njit(cache=True)
def steer(course_error, cross_track, speed, gains):
    """The yaw rate (rad/s) of the nose wheel that brings the aircraft onto the centre line."""
    aim = -math.atan(cross_track / gains[10])
    limit = gains[11] / max(speed, 3.0)
    return min(max(gains[9] * (aim - course_error), -limit), limit)

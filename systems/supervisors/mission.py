"""The part of the flight that all landing routines share: from the start to the last waypoint.

The mission of the infrared and marker thesis (Badakis, Thessaly 2020, section 8.2.2): arm 2 m
from the pad, climb to 10 m (6 m for the marker alone), mark the position, fly a square of
four waypoints away from the pad and back to the mark, land.
"""

import math

from systems.configuration import Finite, Metres, Positive, Seconds, configuration
from systems.supervisors.situation import NOT_YET, Memory, Situation
from systems.supervisors.state_machine import State, Transition, TransitionTable

S = Situation[Memory]

_WAYPOINTS = ((1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0))  # sides ahead, sides to the left
_HOVER_TIME = 1.0  # s, time constant of the mean rotor command in level flight


@configuration
class MissionConfig:
    """The flight before the landing."""

    altitude: Metres = 10.0  # m above the place of arming; thesis 8.2.2: 10, marker alone 6
    side: Metres = 2.0  # m, of the square; thesis 8.2.2
    heading: Finite = 0.0  # rad from east, of the first side; 0 leads away from a pad in the west
    settle_time: Seconds = 1.0  # s, for which the estimate must be valid before arming
    climb_speed: Positive = 1.5  # m/s, PX4 MPC_TKO_SPEED
    cruise_speed: Positive = 1.5  # m/s, between the waypoints
    acceptance_radius: Positive = 0.3  # m, at which a waypoint is reached
    acceptance_height: Positive = 0.3  # m, at which the altitude is reached
    maximum_waypoint_speed: Positive = 0.3  # m/s, at which the last waypoint is reached


MISSION_TABLE = TransitionTable(
    initial="wait",
    states=(
        State("wait", stay=("watch_navigation",)),
        State("climb", entry=("arm",), stay=("climb_to_altitude",)),
        *(
            State(f"fly_to_waypoint_{n}", entry=("aim_at_next_waypoint",), stay=("learn_hover",))
            for n in (1, 2, 3, 4)
        ),
    ),
    transitions=(
        Transition("wait", "climb", "navigation_settled"),
        Transition("climb", "fly_to_waypoint_1", "altitude_reached", ("mark_position",)),
        *(
            Transition(f"fly_to_waypoint_{n}", f"fly_to_waypoint_{n + 1}", "waypoint_reached")
            for n in (1, 2, 3)
        ),
    ),
)

LANDED_TABLE = TransitionTable(
    initial="landed", states=(State("landed", entry=("disarm",), final=True),), transitions=()
)


def flight_table(routine: TransitionTable) -> TransitionTable:
    """The whole flight: the mission, a landing routine, and the state `landed` it ends in."""
    begin = Transition("fly_to_waypoint_4", routine.initial, "waypoint_reached", ("begin_landing",))
    return MISSION_TABLE.joined(routine, begin).joined(LANDED_TABLE)


class Mission:
    """Guards and actions of `MISSION_TABLE` and `LANDED_TABLE`."""

    def __init__(self, config: MissionConfig):
        """A mission; see `MissionConfig`."""
        self.config = config

    def watch_navigation(self, s: S) -> None:
        """Keep the time since which the estimate has been valid."""
        if not s.navigation_valid:
            s.memory.ready_since = NOT_YET
        elif s.memory.ready_since < 0.0:
            s.memory.ready_since = s.time

    def navigation_settled(self, s: S) -> bool:
        """Attitude, position and height estimates have been valid for a while."""
        since = s.memory.ready_since
        return since >= 0.0 and s.time - since >= self.config.settle_time

    def arm(self, s: S) -> None:
        """Start the rotors over the present position, which is remembered."""
        m = s.memory
        m.home_x, m.home_y, m.home_z = s.x, s.y, s.z
        m.setpoint_z, m.setpoint_yaw = s.z, s.yaw
        m.armed, m.disarmed = 1.0, 0.0
        s.go_to(s.x, s.y, self.config.cruise_speed)

    def climb_to_altitude(self, s: S) -> None:
        """Climb above the place of arming."""
        s.climb_towards(s.memory.home_z + self.config.altitude, self.config.climb_speed)

    def altitude_reached(self, s: S) -> bool:
        """The altitude of the mission is reached."""
        goal = s.memory.home_z + self.config.altitude
        return abs(goal - s.z) <= self.config.acceptance_height

    def mark_position(self, s: S) -> None:
        """Remember the present position as the last waypoint."""
        s.memory.mark_x, s.memory.mark_y = s.x, s.y

    def aim_at_next_waypoint(self, s: S) -> None:
        """Go to the next corner of the square, at the altitude of the mission."""
        m = s.memory
        m.setpoint_z, m.setpoint_vz = m.home_z + self.config.altitude, 0.0
        ahead, left = _WAYPOINTS[int(m.waypoint)]
        m.waypoint += 1.0
        c, n = math.cos(self.config.heading), math.sin(self.config.heading)
        side = self.config.side
        s.go_to(
            m.mark_x + side * (c * ahead - n * left),
            m.mark_y + side * (n * ahead + c * left),
            self.config.cruise_speed,
        )

    def waypoint_reached(self, s: S) -> bool:
        """The waypoint is reached; at the last one, the vehicle is at rest."""
        m = s.memory
        if s.distance_to(m.setpoint_x, m.setpoint_y) > self.config.acceptance_radius:
            return False
        return (
            m.waypoint < len(_WAYPOINTS)
            or math.hypot(s.vx, s.vy) <= self.config.maximum_waypoint_speed
        )

    def learn_hover(self, s: S) -> None:
        """Average the rotor commands of level flight."""
        m = s.memory
        if math.isnan(s.command):
            return
        if m.hover_command < 0.0:
            m.hover_command = s.command
        m.hover_command += (s.command - m.hover_command) * s.period / _HOVER_TIME

    def begin_landing(self, s: S) -> None:
        """Hand the flight to the landing routine."""
        s.memory.landing_started = s.time
        s.memory.attempts = 1.0

    def disarm(self, s: S) -> None:
        """Stop the rotors."""
        m = s.memory
        m.armed, m.disarmed, m.landed = 0.0, 1.0, 1.0
        m.setpoint_vx = m.setpoint_vy = m.setpoint_vz = 0.0
        m.target_in_use = 0.0

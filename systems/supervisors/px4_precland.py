"""PX4's precision landing `precland`: Start, HorizontalApproach, DescendAboveTarget and the rest.

Facts: PX4's navigator, main branch of August 2026; default parameters in the comments. The
target is its last published position in the local frame, so a short loss does not
matter; a target older than `target_timeout` is lost.

The approach flies at constant height with a setpoint limited in speed and acceleration; above
the target (both axes within `acceptance_radius`) for 2 s, it descends. From then on the
horizontal error is not checked any more.
"""

import math
from typing import Literal

from pydantic import Field

from systems.configuration import Metres, Positive, Seconds, configuration
from systems.supervisors.situation import NOT_YET, Memory, Situation
from systems.supervisors.state_machine import (
    State,
    Transition,
    TransitionTable,
    transitions_from,
)

_POINT_TIME = 2.0  # s, at the start point before a search, and above the target before a descent
_NEAR_GROUND_TIMEOUT = 0.5  # s, for a target within final_approach_height
_SEARCH_MARGIN = 1.0  # m, of climb after the target has come in sight
_SEARCH_SETTLE = 1.0  # s, before the approach


class PX4PreclandMemory(Memory):
    """What the routine remembers besides."""

    starts: float = 0.0
    at_point_since: float = NOT_YET  # s
    approach_z: float = 0.0  # m, height kept during the approach
    search_z: float = 0.0  # m, height to climb to in a search
    found: float = NOT_YET  # s, when the search saw the target
    slew_x: float = math.nan  # m, the limited setpoint of the last event
    slew_y: float = math.nan
    slew_vx: float = 0.0  # m/s, its speed
    slew_vy: float = 0.0


S = Situation[PX4PreclandMemory]


class PX4Precland:
    """Guards and actions of PX4's precision landing."""

    table = TransitionTable(
        initial="start",
        states=(
            State("start", entry=("begin_start",), stay=("watch_start_point",)),
            State("horizontal_approach", entry=("begin_approach",), stay=("approach_target",)),
            State("descend_above_target", stay=("descend_above_target",)),
            State("final_approach", stay=("land",)),
            State("search", entry=("begin_search",), stay=("climb_in_search",)),
            State("fallback", entry=("stay_here",), stay=("land",)),
        ),
        transitions=(
            Transition("start", "horizontal_approach", "target_appears"),
            Transition("start", "fallback", "target_is_optional"),
            Transition("start", "search", "waited_in_vain"),
            Transition("start", "fallback", "at_start_point_without_search"),
            Transition("horizontal_approach", "start", "lost_above_and_may_start", ("stay_here",)),
            Transition("horizontal_approach", "fallback", "lost_above"),
            Transition("horizontal_approach", "descend_above_target", "settled_above_target"),
            *transitions_from(
                ("descend_above_target", "final_approach", "fallback"), "landed", "touched_down"
            ),
            Transition("descend_above_target", "final_approach", "lost_near_ground"),
            Transition(
                "descend_above_target", "start", "lost_in_descent_and_may_start", ("stay_here",)
            ),
            Transition("descend_above_target", "fallback", "lost_in_descent"),
            Transition("search", "horizontal_approach", "found_and_settled"),
            Transition("search", "fallback", "search_timed_out"),
        ),
    )
    memory = PX4PreclandMemory

    def __init__(self, config: "PX4PreclandConfig"):
        """PX4's precision landing; see `PX4PreclandConfig`."""
        self.config = config

    def _valid(self, s: S) -> bool:
        last = s.memory.last_fusion
        return last >= 0.0 and s.time - last <= self.config.target_timeout

    def _above(self, s: S) -> bool:
        x, y = self._goal(s)
        radius = self.config.acceptance_radius
        return abs(x - s.x) < radius and abs(y - s.y) < radius

    def _goal(self, s: S) -> tuple[float, float]:
        """The target's last known place; a moving one is led by the time of the descent."""
        m, c = s.memory, self.config
        if not c.moving_target:
            return m.goal_x, m.goal_y
        lead = min(max(abs(s.z - m.goal_z) / c.descent_speed, c.minimum_lead), c.maximum_lead)
        return m.goal_x + s.pad_vx * lead, m.goal_y + s.pad_vy * lead

    def _near_ground(self, s: S) -> bool:
        return self._valid(s) and s.z - s.memory.goal_z < self.config.final_approach_height

    def _may_start(self, s: S) -> bool:
        return s.memory.starts <= self.config.maximum_searches

    # -- guards

    def target_appears(self, s: S) -> bool:
        """The target has been seen just now."""
        return s.updated and self._valid(s)

    def target_is_optional(self, s: S) -> bool:
        """The mode is opportunistic."""
        return self.config.mode == "opportunistic"

    def _waited(self, s: S) -> bool:
        since = s.memory.at_point_since
        return since >= 0.0 and s.time - since > _POINT_TIME

    def waited_in_vain(self, s: S) -> bool:
        """The vehicle has been at the start point for 2 s."""
        return self.config.search_timeout > 0.0 and self._waited(s)

    def at_start_point_without_search(self, s: S) -> bool:
        """The vehicle is at the start point, and searching is switched off."""
        return self.config.search_timeout == 0.0 and s.memory.at_point_since >= 0.0

    def lost_above(self, s: S) -> bool:
        """Above the target's last known place, it is not seen any more."""
        return self._above(s) and not self._valid(s)

    def lost_above_and_may_start(self, s: S) -> bool:
        """Above the target's last known place, it is not seen, and a search is left."""
        return self._may_start(s) and self.lost_above(s)

    def settled_above_target(self, s: S) -> bool:
        """The target is seen, and the vehicle has come above it more than 2 s ago."""
        return s.updated and self._above(s) and self._waited(s)

    def lost_in_descent(self, s: S) -> bool:
        """The target is lost, near the ground within half a second."""
        if self._near_ground(s):
            return s.time - s.memory.last_fusion >= _NEAR_GROUND_TIMEOUT
        return not self._valid(s)

    def lost_near_ground(self, s: S) -> bool:
        """The target is lost so low that it does not matter."""
        return self._near_ground(s) and self.lost_in_descent(s)

    def lost_in_descent_and_may_start(self, s: S) -> bool:
        """The target is lost, and a search is left."""
        return self._may_start(s) and self.lost_in_descent(s)

    def found_and_settled(self, s: S) -> bool:
        """The target has been in sight for a second."""
        m = s.memory
        return m.found >= 0.0 and s.time - m.found > _SEARCH_SETTLE and self.target_appears(s)

    def search_timed_out(self, s: S) -> bool:
        """The search has taken too long."""
        return s.time - s.memory.entered > self.config.search_timeout

    # -- actions

    def stay_here(self, s: S) -> None:
        """Ask for the present position."""
        m = s.memory
        s.go_to(s.x, s.y, self.config.cruise_speed)
        m.setpoint_z, m.setpoint_vz = s.z, 0.0
        m.target_in_use = 0.0

    def begin_start(self, s: S) -> None:
        """Count a start."""
        m = s.memory
        m.starts += 1.0
        m.attempts = m.starts
        m.at_point_since = NOT_YET

    def watch_start_point(self, s: S) -> None:
        """Keep the time since which the start point has been reached."""
        m = s.memory
        if m.at_point_since < 0.0 and (
            s.distance_to(m.setpoint_x, m.setpoint_y) < self.config.start_radius
        ):
            m.at_point_since = s.time

    def begin_approach(self, s: S) -> None:
        """Keep the present height, and start the limited setpoint from the one before."""
        m = s.memory
        m.approach_z = s.z
        m.at_point_since = NOT_YET
        m.slew_x, m.slew_y, m.slew_vx, m.slew_vy = m.setpoint_x, m.setpoint_y, s.vx, s.vy

    def approach_target(self, s: S) -> None:
        """Fly over the target at constant height.

        The clock `at_point_since` is not stopped by leaving the radius again, as in PX4.
        """
        m, c = s.memory, self.config
        if m.at_point_since < 0.0 and s.updated and self._above(s):
            m.at_point_since = s.time
        self._slew(s, *self._goal(s))
        s.go_to(m.slew_x, m.slew_y, c.cruise_speed)
        m.setpoint_vx, m.setpoint_vy = m.slew_vx, m.slew_vy
        m.setpoint_z, m.setpoint_vz = m.approach_z, 0.0
        m.target_in_use = 1.0

    def _slew(self, s: S, x: float, y: float) -> None:
        """Move the limited setpoint towards (x, y).

        Its speed is at most cruise speed, its change at most the acceleration a, and
        no faster than √(a d) at the distance d it still has to go.
        """
        m, c = s.memory, self.config
        dt = s.period
        dx, dy = x - m.slew_x, y - m.slew_y
        distance = math.hypot(dx, dy)
        vx, vy = _limited(dx / dt, dy / dt, c.cruise_speed)
        change = _limited(vx - m.slew_vx, vy - m.slew_vy, c.acceleration * dt)
        vx, vy = m.slew_vx + change[0], m.slew_vy + change[1]
        vx, vy = _limited(vx, vy, math.sqrt(c.acceleration * distance))
        m.slew_x, m.slew_y, m.slew_vx, m.slew_vy = m.slew_x + vx * dt, m.slew_y + vy * dt, vx, vy

    def descend_above_target(self, s: S) -> None:
        """Land at the target's last known place."""
        s.go_to(*self._goal(s), self.config.cruise_speed)
        s.memory.target_in_use = 1.0
        self.land(s)

    def land(self, s: S) -> None:
        """Descend as PX4 lands."""
        c = self.config
        if s.range_valid and s.height < c.crawl_altitude:
            speed = c.crawl_speed
        else:
            share = (s.height - c.slow_altitude) / (c.fast_altitude - c.slow_altitude)
            share = min(max(share, 0.0), 1.0)
            speed = c.land_speed + share * (c.descent_speed - c.land_speed)
        s.descend_with(speed)

    def begin_search(self, s: S) -> None:
        """Choose the height to climb to."""
        m = s.memory
        m.search_z = m.home_z + self.config.search_altitude
        m.found = NOT_YET

    def climb_in_search(self, s: S) -> None:
        """Climb until the target comes in sight, and a little further."""
        m = s.memory
        if m.found < 0.0 and self.target_appears(s):
            m.found = s.time
            m.search_z = min(s.z + _SEARCH_MARGIN, m.search_z)
        s.climb_towards(m.search_z, self.config.climb_speed)


def _limited(x: float, y: float, length: float) -> tuple[float, float]:
    norm = math.hypot(x, y)
    return (x, y) if norm <= length else (x * length / norm, y * length / norm)


@configuration
class PX4PreclandConfig:
    """PX4's precision landing; defaults are PX4's."""

    kind: Literal["px4_precland"] = "px4_precland"
    mode: Literal["opportunistic", "required"] = "required"
    target_timeout: Seconds = 5.0  # s, PLD_BTOUT
    acceptance_radius: Positive = 0.2  # m, PLD_HACC_RAD, per axis
    final_approach_height: Metres = 0.1  # m above the target, PLD_FAPPR_ALT
    search_altitude: Metres = 10.0  # m above the place of arming, PLD_SRCH_ALT
    search_timeout: Seconds = 10.0  # s, PLD_SRCH_TOUT; 0 never searches
    maximum_searches: int = Field(default=3, ge=0)  # PLD_MAX_SRCH; the SVGS paper takes 20
    start_radius: Positive = 2.0  # m, NAV_ACC_RAD of multicopters
    moving_target: bool = False  # lead a moving target
    minimum_lead: Seconds = 2.0  # s, PLD_MOVING_T_MIN
    maximum_lead: Seconds = 3.0  # s, PLD_MOVING_T_MAX
    cruise_speed: Positive = 5.0  # m/s, MPC_XY_CRUISE
    acceleration: Positive = 3.0  # m/s2, MPC_ACC_HOR
    climb_speed: Positive = 3.0  # m/s, MPC_Z_V_AUTO_UP
    descent_speed: Positive = 1.5  # m/s, MPC_Z_V_AUTO_DN, above fast_altitude
    land_speed: Positive = 0.7  # m/s, MPC_LAND_SPEED, below slow_altitude
    crawl_speed: Positive = 0.3  # m/s, MPC_LAND_CRWL, with a range finder below crawl_altitude
    fast_altitude: Positive = 10.0  # m, MPC_LAND_ALT1
    slow_altitude: Positive = 5.0  # m, MPC_LAND_ALT2
    crawl_altitude: Positive = 1.0  # m, MPC_LAND_ALT3

    def routine(self) -> PX4Precland:
        """The routine with this configuration."""
        return PX4Precland(self)

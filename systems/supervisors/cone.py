"""The laboratory's own landing: down a cone that the estimate's own uncertainty narrows.

The vehicle may be at a height h of its feet above the pad only where the place of the pad is
known and close enough,

    |e| + k σ ≤ ρ(h) = cone_radius + cone_slope h,   e = p_pad + (h_feet d̂ − h₊ d̄)/g − p,

e being the horizontal error and σ the target's standard deviation, which grows while the pad is
not seen: inside it descends, outside it waits, far outside it climbs. The axis leans with the
vehicle: by h_feet (of the feet in B) because a body that leans against the disturbance d̂ falls
back on its feet; and by h₊ = h − settle_height, once the pad has been seen in this attempt, so
that cameras that lean against the mean wind d̄ keep it in the middle of their view. Close to the
pad it waits for a moment at which

    |e + v τ| + σ ≤ r,   r growing from touch_radius to touch_radius_limit while it waits,

v the velocity relative to the pad, and then sits down at `touch_speed`. A gust that makes the
vehicle lean puts a foot deeper and moves it vertically too: the more it leans beyond `free_lean`
the higher it waits, and beyond `touch_lean` it does not sit down.

Disturbances are not left to the position controller's integrator. What accelerates the vehicle
besides its rotors is observed and fed forward with the opposite sign (a disturbance observer;
Ohnishi, Shibata, Murakami, "Motion control for advanced mechatronics", IEEE/ASME T-Mech 1(1),
1996), and near the pad the position loop is stiffened,

    d = a − g c/c_hover z_B,   d̂, d̄ ← low passes of d (drift_time, lean_time),
    d₀ its mean as the landing begins
    a_setpoint = d₀ − d̂ + position_gain e + velocity_gain (v_pad − v)
    a_setpoint,z = sink_gain (v_setpoint,z − v_z)

with c the mean rotor command behind the rotors' lag; d₀ is what the controller's integrator
already holds against the steady wind. So in the last metre, seen or not, the wind is met by
what it did a moment ago. The same d tells the ground: when the legs carry, d_z jumps. (It is
not small before: wind and ground make the rotors lift more. A pad that is met softly is
noticed because the height does not fall as ordered.) The rotors stop at once, because a vehicle
that is light on its legs slides.

A pad that moves is followed with its velocity, vertically too. What is not seen is carried on by
the estimator, so nothing is lost by the clock, but by k σ > ρ(h)/2. Then what another attempt can
show decides. If this one has seen the pad on its way down, the vehicle holds for a while, goes
round (climbs over the place, which counts an attempt) and comes again. Otherwise, and in the last
attempt, every second makes it worse: it lands where the pad should be, at full speed, unless it
sees it on the way, as with sensors that do not reach far. The landing begins with a look at where
the pad was seen last, or where the vehicle took off, from so far upwind that leaning cameras see
it. A pad that was never seen, or is known no more, is looked for from further down and then along
a spiral whose windings lie within the cameras' view. When time is up it lands on the best it
knows. Sensors are not switched by height: their covariances say which one counts.
"""

import math
from typing import Literal

from pydantic import Field

from systems.configuration import Finite, Metres, NonNegative, Positive, Seconds, configuration
from systems.schedule import PLANT_PERIOD
from systems.supervisors.situation import NOT_YET, Memory, Situation
from systems.supervisors.state_machine import (
    State,
    Transition,
    TransitionTable,
    transitions_from,
)

_GRAVITY = 9.80665  # m/s2
_NEAR, _FAR = 0.5, 1.0  # m, of error: the position loop is stiffened within, not beyond
_VERTICAL_GAIN = 1.0  # 1/s, height error to speed
_LOW_GAIN = 2.0  # 1/s, the same just above the pad
_CREEP = 0.05  # m/s, at the end of the descent in the cone
_SLOW = 0.3  # m, of the feet above the pad, below which the vehicle does not brake any more
_CLOSE = 0.12  # m, of the feet above the pad, within which a push from below is the ground
_AT_PAD = 0.06  # m, of the feet above the pad, at which one foot of a tilted vehicle may stand
_ORDERED = 0.2  # m/s, rate of descent from which on not to sink means something
_OBEYED = 0.4  # 1, of what is ordered: to sink less is to stand
_STILL = 0.15  # m/s, vertical speed that tells the ground where no height is known


class ConeMemory(Memory):
    """What the routine remembers besides."""

    drift_ax: float = 0.0  # m/s2, low-passed disturbance
    drift_ay: float = 0.0
    lean_ax: float = 0.0  # m/s2, the same without gusts
    lean_ay: float = 0.0
    held_ax: float = 0.0  # m/s2, what of it the controller's integrator holds
    held_ay: float = 0.0
    push: float = math.nan  # m/s2, low-passed vertical disturbance
    thrust: float = math.nan  # 1, rotor command by that of level flight, behind the rotors' lag
    still_since: float = NOT_YET  # s, at the pad it should have sunk since
    still_feet: float = math.nan  # m, height of the feet then
    known: float = 0.0  # 0/1, the pad has been seen
    pad_x: float = math.nan  # m, the pad as last known
    pad_y: float = math.nan
    pad_z: float = math.nan
    pad_ux: float = 0.0  # m/s
    pad_uy: float = 0.0
    pad_uz: float = 0.0
    turn: float = 0.0  # rad, along the spiral
    centre_x: float = 0.0  # m, of the spiral
    centre_y: float = 0.0
    level_z: float = 0.0  # m, from which the attempt starts
    attempt_began: float = 0.0  # s


S = Situation[ConeMemory]

_WATCH = ("observe_drift", "track_pad", "watch_sinking")


class Cone:
    """Guards and actions of the landing down a cone."""

    table = TransitionTable(
        initial="look",
        states=(
            State("look", entry=("note_start",), stay=(*_WATCH, "look_there", "hold_height")),
            State("descend", stay=(*_WATCH, "follow", "descend_in_cone")),
            State("settle", stay=(*_WATCH, "follow", "keep_low")),
            State("touch", stay=(*_WATCH, "follow", "sit_down")),
            State("hold", stay=(*_WATCH, "follow", "rise_for_view")),
            State("go_round", entry=("begin_attempt",), stay=(*_WATCH, "follow", "climb")),
            State("look_lower", stay=(*_WATCH, "look_there", "sink_to_look")),
            State("search", entry=("begin_search",), stay=(*_WATCH, "fly_spiral")),
            State("land_anyway", stay=(*_WATCH, "follow_or_return", "sit_down_there")),
        ),
        transitions=(
            *transitions_from(("touch", "land_anyway"), "landed", "on_the_ground"),
            *transitions_from(("descend", "settle"), "landed", "on_the_pad"),
            *transitions_from(
                ("descend", "settle", "touch", "land_anyway"), "landed", "touched_down"
            ),
            *transitions_from(
                ("look", "look_lower", "descend", "settle", "hold", "go_round", "search"),
                "land_anyway",
                "time_is_up",
            ),
            Transition("look", "descend", "seen_again"),
            Transition("look", "descend", "certain_but_not_seen"),
            Transition("look", "look_lower", "looked_in_vain"),
            Transition("look_lower", "descend", "certain"),
            Transition("look_lower", "search", "low_enough_to_look"),
            Transition("descend", "land_anyway", "uncertain_for_good"),
            Transition("descend", "hold", "uncertain"),
            Transition("descend", "settle", "close_above_pad"),
            Transition("settle", "touch", "blind_for_good"),
            Transition("settle", "hold", "uncertain"),
            Transition("settle", "touch", "aligned"),
            Transition("settle", "descend", "blown_away"),
            Transition("touch", "descend", "missing_pad"),
            Transition("hold", "descend", "seen_again"),
            Transition("hold", "go_round", "held_long_enough"),
            Transition("go_round", "descend", "high_enough_and_seen"),
            Transition("go_round", "land_anyway", "high_enough_and_known"),
            Transition("go_round", "search", "high_enough"),
            Transition("search", "descend", "seen_again"),
            Transition("search", "land_anyway", "searched_everywhere"),
            Transition("land_anyway", "descend", "seen_in_time"),
        ),
    )
    memory = ConeMemory

    def __init__(self, config: "ConeConfig"):
        """A landing down a cone; see `ConeConfig`."""
        self.config = config

    # -- what is known

    def _pad(self, s: S) -> tuple[float, float, float]:
        """Where the pad is now, or was when that was last known.

        Guards come before actions: what `track_pad` remembers is an event old for them, 12 cm of
        a pad at 3 m/s.
        """
        m = s.memory
        return (s.goal_x, s.goal_y, s.goal_z) if s.acquired else (m.pad_x, m.pad_y, m.pad_z)

    def _feet(self, s: S) -> float:
        """The height of the feet above the pad, m."""
        return s.z - self._pad(s)[2] + self.config.feet_height

    def _settled(self, s: S) -> float:
        """The height of the feet at which to wait for the moment to sit down, m.

        A vehicle that leans has a foot deeper than their middle, and a gust that makes it lean
        moves it vertically too. The height of a pad that heaves is known less well.
        """
        c = self.config
        lean = max(self._lean(s) - c.free_lean, 0.0)
        return c.settle_height + c.lean_height * lean + c.heave_time * abs(s.memory.pad_uz)

    def _lean(self, s: S) -> float:
        """The sine of the vehicle's tilt."""
        return math.hypot(s.up_x, s.up_y)

    def _goal(self, s: S) -> tuple[float, float]:
        """Where the body must be so that it stands over the pad after it has come down level.

        It leans into the wind by −d̂/g, and will fall back on its feet. Its cameras lean with it:
        once they have seen the pad it stays so far upwind, high up, that they look at it.
        """
        m, share = s.memory, self.config.feet_height / _GRAVITY
        x, y, _ = self._pad(s)
        high = self._feet(s) - self.config.settle_height if self._seen_in_attempt(s) else 0.0
        up_x, up_y = self._upwind(s, high)
        return x + share * m.drift_ax + up_x, y + share * m.drift_ay + up_y

    def _upwind(self, s: S, height: float) -> tuple[float, float]:
        """From what leaning cameras look at to where they are, `height` m above it."""
        share = max(height, 0.0) / _GRAVITY
        return -share * s.memory.lean_ax, -share * s.memory.lean_ay

    def _expected(self, s: S) -> tuple[float, float]:
        """Where the pad should be: where it was last known, else where the vehicle took off."""
        m = s.memory
        return (m.pad_x, m.pad_y) if m.known > 0.0 else (m.home_x, m.home_y)

    def _error(self, s: S) -> tuple[float, float]:
        x, y = self._goal(s)
        return x - s.x, y - s.y

    def _distance(self, s: S) -> float:
        return math.hypot(*self._error(s))

    def _radius(self, s: S) -> float:
        return self.config.cone_radius + self.config.cone_slope * max(self._feet(s), 0.0)

    def _spread(self, s: S) -> float:
        """|e| + k σ, m."""
        return self._distance(s) + self.config.sigmas * s.goal_sigma

    def _predicted(self, s: S) -> float:
        """|e + v τ|, m."""
        m, c = s.memory, self.config
        lead = c.touch_lead * max(self._feet(s) / c.settle_height, 1.0)
        ex, ey = self._error(s)
        return math.hypot(ex + (m.pad_ux - s.vx) * lead, ey + (m.pad_uy - s.vy) * lead)

    # -- guards

    def certain(self, s: S) -> bool:
        """The place of the pad is known so well that it does not hinder the descent."""
        return s.acquired and self.config.sigmas * s.goal_sigma <= 0.5 * self._radius(s)

    def uncertain(self, s: S) -> bool:
        """The pad has not been seen for so long that its place is too uncertain for this height."""
        return not self.certain(s)

    def uncertain_for_good(self, s: S) -> bool:
        """That, and another attempt would not see more."""
        return self.uncertain(s) and not self._sees_more_from_above(s)

    def blind_for_good(self, s: S) -> bool:
        """Waiting makes it worse: the pad is not seen, and another attempt would not see more."""
        return s.goal_sigma > self.config.touch_radius and not self._sees_more_from_above(s)

    def _sees_more_from_above(self, s: S) -> bool:
        """Whether this attempt, not the last one, has seen the pad on its way down."""
        m, c = s.memory, self.config
        sunk = m.sighting_z < m.level_z - c.tolerance
        return self._seen_in_attempt(s) and sunk and m.attempts < c.maximum_attempts

    def _seen_in_attempt(self, s: S) -> bool:
        return s.memory.last_fusion > s.memory.attempt_began

    def seen_again(self, s: S) -> bool:
        """The pad has been seen in this state, and its place is certain enough."""
        return s.memory.last_fusion > s.memory.entered and self.certain(s)

    def seen_in_time(self, s: S) -> bool:
        """That, high enough to make use of it and before time is up."""
        return (
            self.seen_again(s)
            and self._feet(s) > self.config.settle_height
            and not self.time_is_up(s)
        )

    def certain_but_not_seen(self, s: S) -> bool:
        """The place of the pad is known from before, and it should have been seen by now."""
        return self.certain(s) and s.time - s.memory.entered >= self.config.glance_time

    def looked_in_vain(self, s: S) -> bool:
        """The target is not seen from here."""
        return s.time - s.memory.entered >= self.config.look_time

    def low_enough_to_look(self, s: S) -> bool:
        """What sees the pad from close by alone would have seen it."""
        return s.height + self.config.feet_height <= self.config.look_height

    def close_above_pad(self, s: S) -> bool:
        """The feet are so low that only sitting down is left."""
        low = self._feet(s) <= self._settled(s) + 0.05
        return low and self._spread(s) <= self._radius(s)

    def aligned(self, s: S) -> bool:
        """The pad will be met where it should be."""
        c = self.config
        share = min((s.time - s.memory.entered) / c.patience, 1.0)
        allowed = c.touch_radius + (c.touch_radius_limit - c.touch_radius) * share * share
        low = self._feet(s) <= self._settled(s) + 0.08
        upright = self._lean(s) <= c.touch_lean + (1.0 - c.touch_lean) * share * share
        return low and upright and self._predicted(s) + s.goal_sigma <= allowed

    def blown_away(self, s: S) -> bool:
        """The vehicle has left the cone."""
        return self._spread(s) > 2.0 * self._radius(s)

    def missing_pad(self, s: S) -> bool:
        """The feet would come down too far from where they should, and there is still room."""
        c = self.config
        return self._feet(s) > _CLOSE / 2 and self._distance(s) > 1.5 * c.touch_radius_limit

    def on_the_ground(self, s: S) -> bool:
        """The legs carry, or the vehicle does not sink any more."""
        return self._struck(s) or self._stands(s)

    def _order(self, s: S) -> float:
        """The rate at which it is asked to sink onto the pad, m/s; 0 if it is not."""
        m = s.memory
        return max(m.pad_uz - m.setpoint_vz, 0.0) if math.isnan(m.setpoint_z) else 0.0

    def _stands(self, s: S) -> bool:
        """At the pad, the vehicle has not sunk for a while, though it should have.

        Told by the height: the velocities of vehicle and pad are known to 0.2 m/s only.
        """
        m = s.memory
        age = s.time - m.still_since
        if m.still_since < 0.0 or age < self.config.still_time:
            return False
        return m.still_feet - self._feet(s) < _OBEYED * self._order(s) * age

    def _struck(self, s: S) -> bool:
        """Something has pushed the vehicle from below just now."""
        if s.memory.setpoint_vz - s.memory.pad_uz >= 0.0 or not math.isnan(s.memory.setpoint_z):
            return False
        jump = self._push(s) - s.memory.push
        if not jump >= self.config.contact_push:
            return False
        if s.memory.known > 0.0:
            return self._feet(s) < _CLOSE
        if s.height_measured:
            return s.height + self.config.feet_height < _CLOSE
        return abs(s.vz) < _STILL

    def on_the_pad(self, s: S) -> bool:
        """The legs carry, where they should: elsewhere it lifts off again."""
        return self._distance(s) <= self.config.touch_radius_limit and self.on_the_ground(s)

    def time_is_up(self, s: S) -> bool:
        """The landing has taken as long as it may."""
        return s.time - s.memory.landing_started >= self.config.maximum_time

    def held_long_enough(self, s: S) -> bool:
        """The target has not come back."""
        return s.time - s.memory.entered >= self.config.hold_time

    def high_enough(self, s: S) -> bool:
        """The height to start again from is reached."""
        return s.z >= s.memory.level_z - self.config.tolerance

    def high_enough_and_seen(self, s: S) -> bool:
        """The height to start again from is reached, and the pad is seen from there."""
        return self.high_enough(s) and self.seen_again(s)

    def high_enough_and_known(self, s: S) -> bool:
        """The height to start again from is reached; the pad should be in view and is not."""
        return self.high_enough(s) and self.certain(s)

    def searched_everywhere(self, s: S) -> bool:
        """The spiral has reached its largest radius."""
        return self._spiral_radius(s) >= self.config.search_radius

    # -- actions

    def _lagged_command(self, s: S) -> float:
        """The rotor command by that of level flight, behind the rotors' lag; NaN if unknown."""
        m = s.memory
        if math.isnan(s.command) or m.hover_command <= 0.0:
            return math.nan
        command = s.command / m.hover_command
        if math.isnan(m.thrust):
            return command
        return m.thrust + (command - m.thrust) * (1.0 - math.exp(-s.period / self.config.rotor_lag))

    def _thrust(self, s: S) -> float:
        """What the rotors' thrust accelerates, along the body's axis, m/s2."""
        lagged = self._lagged_command(s)
        return _GRAVITY * (1.0 / s.up_z if math.isnan(lagged) else lagged)

    def _push(self, s: S) -> float:
        """What accelerates the vehicle upwards besides its rotors, m/s2."""
        return s.az + _GRAVITY - self._thrust(s) * s.up_z

    def observe_drift(self, s: S) -> None:
        """Observe what accelerates the vehicle besides its rotors."""
        m, c = s.memory, self.config
        thrust = self._thrust(s)
        push = self._push(s)
        if math.isnan(m.push):
            m.push = push
        m.push += (push - m.push) * (1.0 - math.exp(-s.period / c.push_time))
        m.thrust = self._lagged_command(s)
        drift_x, drift_y = s.ax - thrust * s.up_x, s.ay - thrust * s.up_y
        age = s.time - m.landing_started
        if age < s.period:
            m.drift_ax, m.drift_ay = drift_x, drift_y
            m.lean_ax, m.lean_ay = drift_x, drift_y
            m.held_ax, m.held_ay = drift_x, drift_y
        gain = 1.0 - math.exp(-s.period / c.drift_time)
        m.drift_ax += gain * (drift_x - m.drift_ax)
        m.drift_ay += gain * (drift_y - m.drift_ay)
        gain = 1.0 - math.exp(-s.period / c.lean_time)
        m.lean_ax += gain * (drift_x - m.lean_ax)
        m.lean_ay += gain * (drift_y - m.lean_ay)
        m.setpoint_ax = m.setpoint_ay = m.setpoint_az = 0.0
        if age < c.learning_time:  # a mean
            share = s.period / (age + s.period)
            m.held_ax += share * (drift_x - m.held_ax)
            m.held_ay += share * (drift_y - m.held_ay)
        else:
            m.setpoint_ax, m.setpoint_ay = m.held_ax - m.drift_ax, m.held_ay - m.drift_ay

    def watch_sinking(self, s: S) -> None:
        """Note from time to time how high the vehicle is while it should sink at the pad."""
        m = s.memory
        if self._order(s) < _ORDERED or self._feet(s) > _AT_PAD:
            m.still_since = NOT_YET
        elif m.still_since < 0.0 or s.time - m.still_since >= self.config.still_time:
            m.still_since, m.still_feet = s.time, self._feet(s)

    def track_pad(self, s: S) -> None:
        """Remember where the pad is and how it moves, or was when that was last known."""
        m = s.memory
        if s.acquired:
            m.known = 1.0
            m.pad_x, m.pad_y, m.pad_z = s.goal_x, s.goal_y, s.goal_z
            m.pad_ux, m.pad_uy, m.pad_uz = s.pad_vx, s.pad_vy, s.pad_vz
        elif m.known > 0.0:
            m.pad_ux = m.pad_uy = m.pad_uz = 0.0
        elif not math.isnan(m.goal_x):  # seen before the landing began
            m.known = 1.0
            m.pad_x, m.pad_y, m.pad_z = m.goal_x, m.goal_y, m.goal_z

    def follow(self, s: S) -> None:
        """Go over the pad and with it."""
        m, c = s.memory, self.config
        # The setpoint stands for one period; the controller moves on from it in each tick.
        lead = 0.5 * (s.period - PLANT_PERIOD)
        x, y = self._goal(s)
        s.go_to(x + m.pad_ux * lead, y + m.pad_uy * lead, c.approach_speed)
        m.setpoint_vx, m.setpoint_vy = m.pad_ux, m.pad_uy
        m.target_in_use = 1.0 if s.acquired else 0.0
        ex, ey = self._error(s)
        share = min(max((_FAR - math.hypot(ex, ey)) / (_FAR - _NEAR), 0.0), 1.0)
        m.setpoint_ax += share * (c.position_gain * ex + c.velocity_gain * (m.pad_ux - s.vx))
        m.setpoint_ay += share * (c.position_gain * ey + c.velocity_gain * (m.pad_uy - s.vy))

    def follow_or_return(self, s: S) -> None:
        """Go over the pad if it has ever been seen, else to where the vehicle took off."""
        m = s.memory
        if m.known > 0.0:
            self.follow(s)
        else:
            s.go_to(m.home_x, m.home_y, self.config.approach_speed)
            m.target_in_use = 0.0

    def _braked(self, height: float, final: float) -> float:
        """The rate from which `braking` leaves `final` (m/s) after a descent of `height` (m)."""
        return math.sqrt(final * final + 2.0 * self.config.braking * max(height, 0.0))

    def _sink(self, s: S, rate: float) -> None:
        m, c = s.memory, self.config
        s.descend_with(rate - m.pad_uz)
        push = c.sink_gain * (m.setpoint_vz - s.vz)
        m.setpoint_az = min(max(push, -c.sink_push), c.sink_push)

    def descend_in_cone(self, s: S) -> None:
        """Descend inside the cone, wait outside, climb far outside."""
        c = self.config
        height = self._feet(s)
        inside = (self._radius(s) - self._spread(s)) / (0.3 * self._radius(s))
        if inside < 0.0:
            self._sink(s, max(inside, -0.3) * c.descent_speed)
        else:
            fastest = self._braked(height - self._settled(s), _CREEP)
            self._sink(s, min(inside, 1.0) * min(c.descent_speed, fastest))

    def keep_low(self, s: S) -> None:
        """Stay with the feet just above the pad."""
        self._sink(s, _LOW_GAIN * (self._feet(s) - self._settled(s)))

    def sit_down(self, s: S) -> None:
        """Sink to the pad or the ground."""
        c, m = self.config, s.memory
        height = s.height + c.feet_height
        if m.known > 0.0:
            height = min(height, self._feet(s)) if s.height_measured else self._feet(s)
        fastest = self._braked(height - _SLOW, c.touch_speed)
        if self._lean(s) > c.touch_lean and not self._overdue(s):  # wait for the gust to pass
            fastest = min(fastest, _LOW_GAIN * (height - self._settled(s)))
        self._sink(s, min(c.descent_speed, fastest))

    def _overdue(self, s: S) -> bool:
        """Time is up, and the way back has taken as long as it may."""
        c = self.config
        return s.time - s.memory.landing_started >= c.maximum_time + c.return_time

    def sit_down_there(self, s: S) -> None:
        """Sink where the pad should be, or anywhere if that takes too long."""
        m = s.memory
        if self._overdue(s) or s.distance_to(m.setpoint_x, m.setpoint_y) < _FAR:
            self.sit_down(s)
        else:
            self._sink(s, 0.0)

    def look_there(self, s: S) -> None:
        """Go to where the cameras look at the place where the pad should be."""
        (x, y), (up_x, up_y) = self._expected(s), self._upwind(s, s.height)
        s.go_to(x + up_x, y + up_y, self.config.approach_speed)
        s.memory.target_in_use = 0.0

    def hold_height(self, s: S) -> None:
        """Stay at the height that the mission ended at."""
        s.hold_height()

    def sink_to_look(self, s: S) -> None:
        """Sink to where sensors that do not reach far see the pad."""
        self._sink(s, self.config.look_speed)

    def rise_for_view(self, s: S) -> None:
        """Stay at the present height, or rise to where the cameras see more of the pad."""
        wanted = self.config.view_height - self._feet(s)
        self._sink(s, -min(max(_VERTICAL_GAIN * wanted, 0.0), 0.5))

    def note_start(self, s: S) -> None:
        """Remember where the first attempt starts."""
        m = s.memory
        m.level_z, m.attempt_began = s.z, s.time

    def begin_attempt(self, s: S) -> None:
        """Count another attempt and choose the height to start it from."""
        m, c = s.memory, self.config
        m.attempts += 1.0
        m.level_z, m.attempt_began = max(m.pad_z + c.retry_height, s.z + 1.0), s.time

    def climb(self, s: S) -> None:
        """Climb to the height of another attempt."""
        s.climb_towards(s.memory.level_z, self.config.climb_speed)

    def begin_search(self, s: S) -> None:
        """Begin a spiral around the place where the pad should be."""
        m = s.memory
        m.turn = 0.0
        m.centre_x, m.centre_y = self._expected(s)
        m.target_in_use = 0.0

    def _pitch(self, s: S) -> float:
        """The distance of the spiral's windings: what the cameras see across, with overlap, m."""
        return max(2.0 * self.config.view * s.height * 0.7, 0.5)

    def _spiral_radius(self, s: S) -> float:
        return self._pitch(s) * s.memory.turn / (2.0 * math.pi)

    def fly_spiral(self, s: S) -> None:
        """Fly along an Archimedean spiral at constant speed, at the height of the attempt."""
        m, c = s.memory, self.config
        s.climb_towards(m.level_z, c.climb_speed)
        pitch = self._pitch(s)
        along = math.hypot(self._spiral_radius(s), pitch / (2.0 * math.pi))
        m.turn += c.search_speed * s.period / along
        radius, (up_x, up_y) = self._spiral_radius(s), self._upwind(s, s.height)
        s.go_to(
            m.centre_x + radius * math.cos(m.turn) + up_x,
            m.centre_y + radius * math.sin(m.turn) + up_y,
            c.approach_speed,
        )
        m.setpoint_vx = -c.search_speed * math.sin(m.turn)
        m.setpoint_vy = c.search_speed * math.cos(m.turn)


@configuration
class ConeConfig:
    """A landing down a cone; the figures are the laboratory's own unless a source is named."""

    kind: Literal["cone"] = "cone"
    feet_height: Finite = -0.2  # m, of the feet in B
    # The cone
    cone_radius: Positive = 0.12  # m, at the pad
    cone_slope: NonNegative = 0.25  # 1
    sigmas: NonNegative = 2.0  # 1, k
    descent_speed: Positive = 1.2  # m/s
    braking: Positive = 0.7  # m/s2, towards the end of a descent
    approach_speed: Positive = 5.0  # m/s, horizontal limit, ArduPilot's WPNAV_SPEED
    # The last step
    settle_height: Metres = 0.15  # m, of the feet above the pad
    free_lean: NonNegative = 0.3  # 1, sine of the lean up to which that holds
    lean_height: Metres = 1.5  # m by the sine of the lean beyond
    heave_time: Seconds = 0.15  # s, by the pad's vertical speed
    touch_lean: Positive = 0.36  # 1, sine of the lean from which it does not sit down at first
    touch_radius: Positive = 0.03  # m
    touch_radius_limit: Positive = 0.10  # m
    patience: Positive = 15.0  # s, over which the radius grows
    touch_lead: Seconds = 0.3  # s, τ
    touch_speed: Positive = 0.4  # m/s
    contact_push: Positive = 2.5  # m/s2, a jump that no vertical gust makes
    still_time: Seconds = 0.2  # s, without sinking, after which the pad has been met softly
    push_time: Positive = 0.3  # s, low pass of what it jumps from
    # The wind
    drift_time: Positive = 0.15  # s, low pass of the disturbance
    lean_time: Positive = 5.0  # s, low pass of the disturbance that the cone leans against
    learning_time: Seconds = 1.0  # s, at the beginning, of the mean d₀
    rotor_lag: Positive = 0.055  # s, of the rotors' thrust behind their command
    position_gain: NonNegative = 1.5  # 1/s2
    velocity_gain: NonNegative = 1.0  # 1/s
    sink_gain: NonNegative = 2.5  # 1/s
    sink_push: Positive = 2.0  # m/s2, at most
    # Losses
    glance_time: Seconds = 1.0  # s, to look at a pad whose place is known
    look_time: Seconds = 3.0  # s, before a search begins
    look_height: Metres = 2.0  # m, of the feet above the ground, down to which it looks first
    look_speed: Positive = 0.7  # m/s
    hold_time: Seconds = 2.0  # s, before going round
    retry_height: Metres = 5.0  # m above the pad; the marker is seen to 6 m and more
    climb_speed: Positive = 1.5  # m/s
    tolerance: Positive = 0.3  # m
    view_height: Metres = 1.2  # m, of the feet above the pad, to which it rises when it loses sight
    view: Positive = 0.3  # 1, tangent of half the narrower field of view: IR-LOCK's 100 x 3 mrad
    search_speed: Positive = 1.5  # m/s
    search_radius: Metres = 12.0  # m
    maximum_attempts: int = Field(default=2, ge=1)
    maximum_time: Positive = 90.0  # s, from the beginning of the landing
    return_time: Seconds = 20.0  # s more, to fly to where it lands anyway

    def routine(self) -> Cone:
        """The routine with this configuration."""
        return Cone(self)

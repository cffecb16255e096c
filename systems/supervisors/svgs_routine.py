"""The SVGS landing routine: which manoeuvre runs when.

After "High-altitude precision landing by SVGS" (Drones 8, 37, 2024), section 2.5.4: scan until the
beacon is seen, align with it, descend; when sight is lost, relocate; at 20 m move over to the
short-range beacon, at about 3 m off it, and land. The manoeuvres themselves (Algorithms 2 to 6)
are in `svgs_motion_control`; here stands the table of the node `routine_commander_drspider`.

Where the paper leaves it open:

* A beacon that is not seen again after both relocations is waited for, then scanned for with
  growing squares. When the last square is done the vehicle flies back over the pad as it was last
  known and lands without sight; it lands where it is if the pad was never seen.
* After `maximum_relocations` the next loss of sight ends in the same way.
* Below `final_height` nothing is relocated any more (the paper's U_min): the landing goes on.
* The vehicle counts as aligned within `align_radius` + `align_slope` · height of the point it
  aligns with, and as not aligned any more beyond twice that.
"""

import math
from typing import Literal

from pydantic import Field

from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Seconds,
    Vector2,
    configuration,
)
from systems.signals.measurement import Layout, vector
from systems.supervisors.situation import NOT_YET, Memory, Situation
from systems.supervisors.state_machine import (
    State,
    Transition,
    TransitionTable,
    transitions_from,
)

# The manoeuvres of the node motion_control_drspider; NONE leaves the setpoint to the mission.
NONE, HOLD, SCAN, ALIGN, DESCEND, RELOCATE_XY, RELOCATE_XYZ, OFFSET, LAND, RETURN = range(10)

# What the commander tells motion control.
COMMAND = Layout(
    "SvgsCommand",
    (
        "manoeuvre",
        "begun",  # s; a new time begins the manoeuvre anew
        "square_side",  # steps, of the scan
        *vector("aim"),  # m, W: the point to be aligned with, and the height of the pad
        "aim_known",  # 0/1
        *vector("trusted"),  # m, W: the vehicle at the last sighting
    ),
)

# What motion control tells the commander.
FEEDBACK = Layout("SvgsFeedback", ("begun", "done"))  # s, of the manoeuvre it is about; 0/1

_APPROACH, _SHORT, _LANDING = range(3)  # stages: over which point
_CONTACT_SPEED = 0.2  # m/s, LNDMC_Z_VEL_MAX is 0.25
_CONTACT_TIME = 1.0  # s, as PX4's land detector
_BLIND_FACTOR = 3.0  # on the time where the rotors' thrust does not tell


class SvgsMemory(Memory):
    """What the routine remembers besides."""

    manoeuvre: float = NONE
    begun: float = NOT_YET  # s, when the manoeuvre began
    done: float = 0.0  # 0/1, motion control has finished it
    square_side: float = 0.0
    scans: float = 0.0
    stage: float = _APPROACH
    ground_since: float = NOT_YET  # s, the ground has been felt since
    aim_x: float = 0.0  # m, the point of the present stage
    aim_y: float = 0.0
    aim_z: float = 0.0
    aim_known: float = 0.0
    trusted_x: float = 0.0  # m, the vehicle at the last sighting
    trusted_y: float = 0.0
    trusted_z: float = 0.0


S = Situation[SvgsMemory]


class SvgsRoutine:
    """Guards and actions of the SVGS landing routine."""

    table = TransitionTable(
        initial="hover",
        states=(
            State("hover", entry=("begin_hold",), stay=("learn_hover", "look")),
            State("scan", entry=("begin_scan",), stay=("look",)),
            State("align", entry=("begin_align",), stay=("look",)),
            State("descend", entry=("begin_descent",), stay=("look",)),
            State("relocate_xy", entry=("begin_relocation_xy",), stay=("look",)),
            State("relocate_xyz", entry=("begin_relocation_xyz",), stay=("look",)),
            State("wait_for_sight", entry=("begin_hold",), stay=("look",)),
            State("return_to_pad", entry=("begin_return",), stay=("look",)),
            State("offset_to_short", entry=("begin_offset_to_short",), stay=("look",)),
            State("final_offset", entry=("begin_final_offset",), stay=("look",)),
            State("land", entry=("begin_landing_below_ground",), stay=("look", "feel_ground")),
            State(
                "land_without_sight",
                entry=("begin_landing_below_ground",),
                stay=("look", "feel_ground"),
            ),
        ),
        transitions=(
            Transition("hover", "align", "hovered_in_sight"),
            Transition("hover", "scan", "hovered_out_of_sight"),
            *transitions_from(
                ("scan", "relocate_xy", "relocate_xyz", "wait_for_sight", "return_to_pad"),
                "align",
                "in_sight",
            ),
            Transition("scan", "scan", "scanned_and_may_scan"),
            Transition("scan", "return_to_pad", "scanned_beside_known_pad"),
            Transition("scan", "land_without_sight", "scanned"),
            Transition("return_to_pad", "land_without_sight", "manoeuvre_done"),
            *transitions_from(("align", "descend"), "land_without_sight", "lost_too_often"),
            *transitions_from(("align", "descend"), "relocate_xy", "lost_above_minimum"),
            Transition("align", "land", "lost_below_minimum"),
            Transition("align", "descend", "aligned"),
            Transition("align", "align", "not_aligned_in_time"),
            Transition("descend", "offset_to_short", "low_enough_for_short"),
            Transition("descend", "final_offset", "low_enough_for_final_offset"),
            Transition("descend", "align", "misaligned"),
            Transition("relocate_xy", "relocate_xyz", "manoeuvre_done"),
            Transition("relocate_xyz", "wait_for_sight", "manoeuvre_done"),
            Transition("wait_for_sight", "scan", "waited"),
            Transition("offset_to_short", "align", "manoeuvre_done"),
            Transition("final_offset", "land", "manoeuvre_done"),
            *transitions_from(("land", "land_without_sight"), "landed", "touched_down"),
        ),
    )
    memory = SvgsMemory

    def __init__(self, config: "SvgsRoutineConfig"):
        """The routine; see `SvgsRoutineConfig`."""
        self.config = config
        c, n = math.cos(config.beacon_heading), math.sin(config.beacon_heading)
        self._points = [
            (c * x - n * y, n * x + c * y)
            for x, y in (config.approach_point, config.short_point, (0.0, 0.0))
        ]

    def height(self, s: S) -> float:
        """The height over the pad by its last sighting, or over the place of arming, m."""
        return s.height if math.isnan(s.memory.goal_z) else s.z - s.memory.goal_z

    def _radius(self, s: S) -> float:
        return self.config.align_radius + self.config.align_slope * max(self.height(s), 0.0)

    def _off(self, s: S) -> float:
        return s.distance_to(s.memory.aim_x, s.memory.aim_y)

    # -- guards

    def in_sight(self, s: S) -> bool:
        """The beacon is in sight."""
        return s.acquired

    def _hovered(self, s: S) -> bool:
        return s.time - s.memory.begun >= self.config.hover_time

    def hovered_in_sight(self, s: S) -> bool:
        """Hovering has ended with the beacon in sight."""
        return self._hovered(s) and s.acquired

    def hovered_out_of_sight(self, s: S) -> bool:
        """Hovering has ended without the beacon in sight."""
        return self._hovered(s)

    def manoeuvre_done(self, s: S) -> bool:
        """Motion control has finished the manoeuvre."""
        return s.memory.done > 0.0

    def scanned(self, s: S) -> bool:
        """The square is scanned, and was the last one."""
        return self.manoeuvre_done(s)

    def scanned_beside_known_pad(self, s: S) -> bool:
        """The last square is scanned, and the pad has been seen before."""
        return self.manoeuvre_done(s) and s.memory.aim_known > 0.0

    def scanned_and_may_scan(self, s: S) -> bool:
        """The square is scanned; the next one is larger."""
        return self.manoeuvre_done(s) and s.memory.scans < self.config.maximum_scans

    def _lost(self, s: S) -> bool:
        return not s.acquired and s.time - s.memory.last_acquired >= self.config.lost_time

    def lost_above_minimum(self, s: S) -> bool:
        """Sight is lost, high enough to relocate."""
        return self._lost(s) and self.height(s) >= self.config.final_height

    def lost_too_often(self, s: S) -> bool:
        """Sight is lost again after as many relocations as there may be."""
        relocations = s.memory.attempts - 1.0
        return self._lost(s) and relocations >= self.config.maximum_relocations

    def lost_below_minimum(self, s: S) -> bool:
        """Sight is lost, too low to relocate."""
        return self._lost(s)

    def aligned(self, s: S) -> bool:
        """The alignment is done, and the vehicle over its point."""
        slow = math.hypot(s.vx, s.vy) < self.config.align_speed
        return self.manoeuvre_done(s) and slow and self._off(s) <= self._radius(s)

    def not_aligned_in_time(self, s: S) -> bool:
        """The alignment is done, but the vehicle not over its point."""
        return self.manoeuvre_done(s)

    def misaligned(self, s: S) -> bool:
        """The vehicle is not sufficiently aligned any more."""
        return s.acquired and self._off(s) > 2.0 * self._radius(s)

    def low_enough_for_short(self, s: S) -> bool:
        """Low enough to move over to the short-range beacon."""
        return s.memory.stage == _APPROACH and self.height(s) <= self.config.short_height

    def low_enough_for_final_offset(self, s: S) -> bool:
        """Low enough for the final offset."""
        return s.memory.stage == _SHORT and self.height(s) <= self.config.final_height

    def waited(self, s: S) -> bool:
        """The beacon has been waited for long enough."""
        return s.time - s.memory.begun >= self.config.wait_time

    def touched_down(self, s: S) -> bool:
        """The ground has been felt for a while."""
        since = s.memory.ground_since
        return since >= 0.0 and s.time - since >= _CONTACT_TIME * (
            1.0 if self._unloaded(s) else _BLIND_FACTOR
        )

    def _unloaded(self, s: S) -> bool:
        return s.command < self.config.low_thrust * s.memory.hover_command

    # -- actions

    def _begin(self, s: S, manoeuvre: int) -> None:
        m = s.memory
        m.manoeuvre, m.begun, m.done = float(manoeuvre), s.time, 0.0
        m.target_in_use = 1.0 if manoeuvre in (ALIGN, DESCEND, OFFSET) else 0.0

    def begin_hold(self, s: S) -> None:
        """Stay here."""
        self._begin(s, HOLD)

    def begin_scan(self, s: S) -> None:
        """Algorithm 2 with a larger square than before."""
        m = s.memory
        m.scans += 1.0
        m.square_side = self.config.first_square + (m.scans - 1.0) * self.config.square_growth
        self._begin(s, SCAN)

    def begin_align(self, s: S) -> None:
        """Algorithm 3; sight ends a search, which may begin anew after the next loss."""
        s.memory.scans = 0.0
        self._begin(s, ALIGN)

    def begin_descent(self, s: S) -> None:
        """Algorithm 6, its first branch."""
        self._begin(s, DESCEND)

    def begin_relocation_xy(self, s: S) -> None:
        """Algorithm 4, horizontally; this is a new attempt."""
        s.memory.attempts += 1.0
        self._begin(s, RELOCATE_XY)

    def begin_relocation_xyz(self, s: S) -> None:
        """Algorithm 4, completely."""
        self._begin(s, RELOCATE_XYZ)

    def begin_return(self, s: S) -> None:
        """Back over the point of the present stage, at this height."""
        self._begin(s, RETURN)

    def begin_offset_to_short(self, s: S) -> None:
        """Algorithm 5, over to the short-range beacon."""
        s.memory.stage = _SHORT
        self._begin(s, OFFSET)

    def begin_final_offset(self, s: S) -> None:
        """Algorithm 5, off the short-range beacon to the landing point."""
        s.memory.stage = _LANDING
        self._begin(s, OFFSET)

    def begin_landing_below_ground(self, s: S) -> None:
        """Algorithm 6, its second branch."""
        m = s.memory
        m.stage, m.ground_since = _LANDING, NOT_YET
        self._begin(s, LAND)

    def look(self, s: S) -> None:
        """Keep where the pad is, and where the vehicle was when it saw it."""
        m = s.memory
        if s.acquired and s.updated:
            m.trusted_x, m.trusted_y, m.trusted_z = s.x, s.y, s.z
            m.aim_known = 1.0
        if m.aim_known > 0.0:
            dx, dy = self._points[int(m.stage)]
            # Within sight the newest estimate; out of sight the last one.
            goal = (s.goal_x, s.goal_y) if s.acquired else (m.goal_x, m.goal_y)
            m.aim_x, m.aim_y, m.aim_z = goal[0] + dx, goal[1] + dy, m.goal_z

    def feel_ground(self, s: S) -> None:
        """Keep the time since which a commanded descent does not go on."""
        m = s.memory
        if s.time - m.begun > self.config.offset_wait + _CONTACT_TIME and (
            abs(s.vz) < _CONTACT_SPEED
        ):
            if m.ground_since < 0.0:
                m.ground_since = s.time
        else:
            m.ground_since = NOT_YET


@configuration
class SvgsRoutineConfig:
    """The SVGS landing routine; figures from the paper's algorithms unless said otherwise."""

    kind: Literal["svgs"] = "svgs"
    hover_time: Seconds = 3.0  # s, before the routine begins; not published
    # Algorithm 2: steps of the first square and how it grows; its step is 0.5 m times the step's
    # number, every 3 s. The figures of the squares are not published.
    first_square: int = Field(default=3, ge=1)
    square_growth: int = Field(default=2, ge=0)
    maximum_scans: int = Field(default=2, ge=1)
    scan_step: Positive = 0.5  # m
    scan_wait: Seconds = 3.0  # s
    # Algorithm 3: position setpoints on the target for 5 s, one a second
    align_time: Seconds = 5.0  # s
    align_wait: Seconds = 1.0  # s
    align_radius: Metres = 0.25  # m, on the ground; not published
    align_slope: NonNegative = 0.015  # m a metre of height; not published
    align_speed: Positive = 0.35  # m/s; not published
    # Algorithm 4: 2 s for each relocation
    relocation_time: Seconds = 2.0  # s
    relocation_radius: Metres = 0.5  # m, at which it is reached, at any time; not published
    relocation_timeout: Seconds = 15.0  # s, for the way there; not published
    # Beacons that are seen from above but not on the way down shall not keep it in the air
    maximum_relocations: int = Field(default=5, ge=0)  # not published
    lost_time: Seconds = 0.5  # s without a target estimate; not published
    wait_time: Seconds = 8.0  # s, at the trusted pose before a new scan; not published
    # Algorithm 5: two requests, 2.5 s apart
    offset_time: Seconds = 5.0  # s
    offset_wait: Seconds = 2.0  # s, before the landing, for the offset to be complete
    short_height: Metres = 20.0  # m, of the first offset
    final_height: Metres = 3.0  # m, of the last one; the algorithms' U_min
    # m in the pad's frame: over what the vehicle aligns above and below `short_height`; the
    # landing point is the pad's centre
    approach_point: Vector2 = Field(default_factory=lambda: [-3.2, -1.5])
    short_point: Vector2 = Field(default_factory=lambda: [-1.7, 0.0])
    beacon_heading: Finite = 0.0  # rad, yaw of the pad's frame in W, as surveyed
    # Algorithm 6
    descent_step: Positive = 0.7  # m
    descent_wait: Seconds = 1.0  # s
    # Steps above `short_height`; the paper's 0.7 m everywhere takes four minutes from 100 m
    high_descent_step: Positive = 0.7  # m
    # Keep the horizontal position while descending, as published, or follow the target
    descend_over: Literal["current", "target"] = "target"
    depth: Positive = 5.0  # m below, the last setpoint
    maximum_speed: Positive = 1.0  # m/s; Table 2 gives 1 mph = 0.447 m/s
    low_thrust: Positive = 0.6  # of the mean rotor command in level flight: on the ground

    def routine(self) -> SvgsRoutine:
        """The routine with this configuration."""
        return SvgsRoutine(self)

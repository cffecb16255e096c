"""What the guards and actions of a supervisor see: this event's inputs and the memory.

The memory is a flat vector in the `Context`. Its layout is declared as annotated floats of a
class; a routine that must remember more subclasses `Memory`. Names ending in `_x`, `_y`,
`_z` are positions in W: they move with the navigation filter when its estimate is reset.
"""

import inspect
import math
from typing import Generic, TypeVar

NOT_YET = -1.0  # s, a time that has not come


class Memory:
    """The numbers every supervisor keeps; class values are the initial ones.

    The first fields are those of the layouts `SETPOINT`, `SUPERVISOR_STATUS`, `VEHICLE_STATUS`.
    """

    setpoint_x: float = math.nan  # m
    setpoint_y: float = math.nan
    setpoint_z: float = math.nan
    setpoint_vx: float = 0.0  # m/s
    setpoint_vy: float = 0.0
    setpoint_vz: float = 0.0
    setpoint_yaw: float = math.nan  # rad
    armed: float = 0.0
    maximum_speed: float = 0.0  # m/s
    setpoint_ax: float = 0.0  # m/s2
    setpoint_ay: float = 0.0
    setpoint_az: float = 0.0

    state: float = 0.0
    time_in_state: float = 0.0  # s
    attempts: float = 0.0
    landing_started: float = NOT_YET  # s
    target_in_use: float = 0.0
    landed: float = 0.0
    disarmed: float = 1.0

    at_rest: float = 1.0
    in_air: float = 0.0
    in_ground_effect: float = 0.0

    entered: float = 0.0  # s, when the present state was entered
    horizontal_resets: float = -1.0  # counters of the navigation filter, as last seen
    vertical_resets: float = -1.0
    ready_since: float = NOT_YET  # s, the estimate has been valid since
    home_x: float = 0.0  # m, where the vehicle was armed
    home_y: float = 0.0
    home_z: float = 0.0
    mark_x: float = 0.0  # m, where the climb ended
    mark_y: float = 0.0
    waypoint: float = 0.0  # number of the waypoint under way, from 1
    hover_command: float = NOT_YET  # mean rotor command in level flight
    contact_since: float = NOT_YET  # s, the ground has been felt since
    last_fusion: float = NOT_YET  # s, validity of the newest sighting of the target
    last_acquired: float = NOT_YET  # s, when the target was last acquired
    goal_x: float = math.nan  # m, `Situation.goal_x` and so on as of the newest sighting
    goal_y: float = math.nan
    goal_z: float = math.nan
    sighting_x: float = math.nan  # m, the vehicle at the newest sighting
    sighting_y: float = math.nan
    sighting_z: float = math.nan

    @classmethod
    def fields(cls) -> tuple[str, ...]:
        """The names of the fields, those of the base classes first."""
        names: list[str] = []
        for base in reversed(cls.__mro__):
            names += inspect.get_annotations(base)
        return tuple(names)

    @classmethod
    def initial(cls) -> list[float]:
        """The initial values, in the order of `fields`."""
        return [getattr(cls, name) for name in cls.fields()]


M = TypeVar("M", bound=Memory)


class Situation(Generic[M]):
    """One event of a supervisor: what is known now, and the setpoint to be decided.

    Attributes
    ----------
    time, period : float
        s.
    memory : Memory
        Read and written by guards and actions.
    x, y, z, vx, vy, vz : float
        The estimated position and velocity in W, m and m/s.
    yaw : float
        rad, counter-clockwise from east.
    navigation_valid : bool
        Attitude, horizontal and vertical estimates are all valid.
    height : float
        Above the ground or, where nothing measures that, above the place of arming, m.
    height_measured : bool
        Whether `height` is a measured height above ground.
    range_valid : bool
        Whether the range finder measures now.
    acquired : bool
        The target estimate may be used for guidance.
    updated : bool
        The target was fused anew since the last event.
    goal_x, goal_y, goal_z : float
        Where the vehicle's origin must go to bring its reference point over the target (x, y),
        and the height of the target itself (z), in W as of now, m; NaN before the first sighting.
    goal_sigma : float
        One sigma of the target's horizontal place, the larger axis, m.
    pad_vx, pad_vy, pad_vz : float
        The velocity of the pad itself, m/s.
    ax, ay, az : float
        The estimated acceleration in W, m/s2.
    up_x, up_y, up_z : float
        The body's z axis in W, along which the rotors push.
    command : float
        Mean rotor command; NaN where not known.
    """

    def __init__(self, memory: M, period: float):
        """A situation before the first event."""
        self.memory = memory
        self.period = period
        self.time = 0.0
        self.x = self.y = self.z = self.vx = self.vy = self.vz = self.yaw = 0.0
        self.navigation_valid = False
        self.height = 0.0
        self.height_measured = False
        self.range_valid = False
        self.acquired = False
        self.updated = False
        self.goal_x = self.goal_y = self.goal_z = math.nan
        self.goal_sigma = math.nan
        self.pad_vx = self.pad_vy = self.pad_vz = 0.0
        self.ax = self.ay = self.az = 0.0
        self.up_x, self.up_y, self.up_z = 0.0, 0.0, 1.0
        self.command = math.nan

    def distance_to(self, x: float, y: float) -> float:
        """The horizontal distance of the vehicle from a point of W, m."""
        return math.hypot(x - self.x, y - self.y)

    def go_to(self, x: float, y: float, speed: float) -> None:
        """Ask for a horizontal position, flown to with at most `speed` (m/s)."""
        m = self.memory
        m.setpoint_x, m.setpoint_y = x, y
        m.setpoint_vx = m.setpoint_vy = 0.0
        m.maximum_speed = speed

    def climb_towards(self, z: float, speed: float) -> None:
        """Move the vertical setpoint towards `z` with `speed` (m/s), fed forward."""
        m = self.memory
        if math.isnan(m.setpoint_z):
            m.setpoint_z = self.z
        step = speed * self.period
        rest = z - m.setpoint_z
        if abs(rest) <= step:
            m.setpoint_z, m.setpoint_vz = z, 0.0
        else:
            m.setpoint_z += math.copysign(step, rest)
            m.setpoint_vz = math.copysign(speed, rest)

    def descend_with(self, rate: float) -> None:
        """Ask for a rate of descent (m/s) in place of a height."""
        m = self.memory
        m.setpoint_z = math.nan
        m.setpoint_vz = -rate

    def hold_horizontally(self) -> None:
        """Stay over the point last asked for, or over the present one if there is none."""
        m = self.memory
        if math.isnan(m.setpoint_x):
            m.setpoint_x, m.setpoint_y = self.x, self.y
        m.setpoint_vx = m.setpoint_vy = 0.0
        m.target_in_use = 0.0

    def hold_height(self) -> None:
        """Stay at the height last asked for, or at the present one while climbing or sinking."""
        m = self.memory
        if math.isnan(m.setpoint_z):
            m.setpoint_z = self.z
        m.setpoint_vz = 0.0

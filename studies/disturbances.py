"""What can go wrong, by name, on one scale from the mildest (0) to the limit (1).

A disturbance changes one number of a scenario, linearly from the scenario's own value (or
nothing at all) to a limit with a source. Some have circumstances, which cost
nothing: where the wind blows to, when the cameras are blind. A new disturbance is one
entry in `DISTURBANCES`.
"""

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagrams.loading import to_plain
from diagrams.scenario import MultirotorLanding
from studies.study import StudyError

_CAMERAS = ("marker_camera", "infrared_camera", "svgs_camera")
_DIGITS = 4  # significant digits of a value: what is flown is what can be read
_QUEUE = 32  # measurements under way in a line that is made late: 50 a second for 0.6 s

# m/s at 6.1 m: sustained wind and gusts in which a vehicle is operated.
_WIND_LIMITS = {
    # SVGS paper, Table 2: 10 and 12 kn.
    "dr_spider": (5.14, 6.17),
    # The thesis gives no limit. It flew on a gusty day: the upper end of Beaufort's force 4
    # (7.9 m/s at 10 m; WMO-No. 8, part I, annex 5.E) at 6.1 m over grass. Gusts: taken, half as
    # much again.
    "thesis_hexacopter": (7.17, 1.5 * 7.17),
    # None is published either: as the hexacopter's.
    "iris": (7.17, 1.5 * 7.17),
}


@dataclass(frozen=True)
class Window:
    """When the undisturbed landing happens, s: from its routine's start to the first contact."""

    start: float
    end: float

    def at(self, fraction: float) -> float:
        """A time, as a fraction of the landing, rounded to the 20 ms of a clock."""
        return round((self.start + fraction * (self.end - self.start)) * 50.0) / 50.0


class Draft:
    """The overrides of one case, while disturbances write into them."""

    def __init__(self, scenario: MultirotorLanding, window: Window):
        self.scenario = scenario
        self.window = window
        self.overrides: dict[str, Any] = {}
        self._plain = to_plain(scenario)

    def __getitem__(self, path: str) -> Any:
        """The present value at a dotted path; None where a map on the way is missing."""
        if path in self.overrides:
            return self.overrides[path]
        node: Any = self._plain
        for key in path.split("."):
            node = node.get(key) if isinstance(node, dict) else None
        return node

    def __setitem__(self, path: str, value: Any) -> None:
        self.overrides[path] = value

    def cameras(self) -> list[str]:
        """Paths of the channels of the landing cameras on board."""
        return [f"sensors.{name}" for name in _cameras(self.scenario)]

    def append(self, path: str, entry: Any) -> None:
        """One entry more in the list at a path."""
        self[path] = [*(self[path] or []), entry]


@dataclass(frozen=True)
class Circumstance:
    """A number that a case is free to choose; from `low` to `high`, or round a circle."""

    name: str
    unit: str
    low: float
    high: float
    periodic: bool = False


@dataclass(frozen=True)
class Disturbance:
    """One thing that can go wrong."""

    name: str
    text: str  # what it is
    unit: str
    mildest: Callable[[MultirotorLanding], float]
    limit: Callable[[MultirotorLanding], float]
    source: str  # of the limit
    write: Callable[..., None]  # (draft, value, *circumstances)
    circumstances: tuple[Circumstance, ...] = ()
    # Why a scenario cannot have it; empty if it can.
    lacks: Callable[[MultirotorLanding], str] = field(default=lambda scenario: "")
    needs_window: bool = False  # whether its times count from the undisturbed landing


def _nothing(scenario: MultirotorLanding) -> float:
    return 0.0


def _up_to(value: float) -> Callable[[MultirotorLanding], float]:
    return lambda scenario: value


def _cameras(scenario: MultirotorLanding) -> list[str]:
    return [name for name in _CAMERAS if getattr(scenario.sensors, name) is not None]


def _no_camera(scenario: MultirotorLanding) -> str:
    return "" if _cameras(scenario) else "it has no landing camera"


def _no_infrared(scenario: MultirotorLanding) -> str:
    return "" if scenario.sensors.infrared_camera is not None else "it has no infrared camera"


def _no_gnss(scenario: MultirotorLanding) -> str:
    return "" if scenario.sensors.gnss is not None else "it has no GNSS receiver"


def _has_moving_pad(scenario: MultirotorLanding) -> str:
    return "its pad moves already" if scenario.pad.moves else ""


def _wind_limit(scenario: MultirotorLanding) -> float:
    return _limits(scenario)[0]


def _gust_limit(scenario: MultirotorLanding) -> float:
    sustained, gusts = _limits(scenario)
    return gusts - sustained


def _limits(scenario: MultirotorLanding) -> tuple[float, float]:
    vehicle = scenario.vehicle.vehicle
    if not isinstance(vehicle, str) or vehicle not in _WIND_LIMITS:
        raise StudyError(
            "the wind limit of this vehicle is not known: give it, as in --limit wind=8"
        )
    return _WIND_LIMITS[vehicle]


def _towards(length: float, direction: float) -> list[float]:
    """An east-north-up vector, rounded to millimetres."""
    return [round(length * f(direction), 3) for f in (math.cos, math.sin)] + [0.0]


def _write_wind(draft: Draft, speed: float, direction: float) -> None:
    draft["wind.speed"], draft["wind.direction"] = speed, direction


def _write_gust(draft: Draft, speed: float, direction: float, fraction: float) -> None:
    start = max(0.0, draft.window.at(fraction) - 2.0)
    gust = {"start": round(start, 2), "duration": 4.0, "velocity": _towards(speed, direction)}
    draft.append("wind.gusts", gust)


def _write_turbulence(draft: Draft, factor: float) -> None:
    draft["wind.turbulence"] = factor


def _write_latency(draft: Draft, delay: float) -> None:
    for camera in draft.cameras():
        draft[f"{camera}.latency.capacity"] = _QUEUE
        path = f"{camera}.latency.transport"
        draft[path] = _rounded((draft[path] or 0.0) + delay)


def _write_jitter(draft: Draft, spread: float) -> None:
    for camera in draft.cameras():
        draft[f"{camera}.latency.capacity"] = _QUEUE
        path = f"{camera}.latency.latency"
        model = dict(draft[path])
        match model["kind"]:
            case "fixed":
                time = model["time"]
                model = {"kind": "uniform", "shortest": time, "longest": _rounded(time + spread)}
            case "uniform":
                model["longest"] = _rounded(model["longest"] + spread)
            case "normal":
                model["standard_deviation"] = _rounded(model["standard_deviation"] + spread)
            case _:
                raise StudyError(f"jitter: {path} is of kind {model['kind']}, which has its own")
        draft[path] = model


def _write_drops(draft: Draft, probability: float) -> None:
    fault = {"kind": "random", "probability": probability}
    for camera in draft.cameras():
        draft.append(f"{camera}.faults.faults", fault)


def _write_dropout(draft: Draft, duration: float, fraction: float) -> None:
    start = draft.window.at(fraction)
    fault = {"kind": "permanent", "start_time": start, "end_time": _rounded(start + duration, 6)}
    for camera in draft.cameras():
        draft.append(f"{camera}.faults.faults", fault)


def _write_blind(draft: Draft, height: float) -> None:
    fault = {"kind": "below", "height": height, "while_landing": True}
    for camera in draft.cameras():
        draft.append(f"{camera}.faults.faults", fault)


def _write_false_beacon(draft: Draft, strength: float, distance: float, direction: float) -> None:
    lamp = {"position": _towards(distance, direction), "strength": strength}
    draft.append("sensors.infrared_camera.sensor.false_beacons", lamp)


def _write_gnss_drift(draft: Draft, drift: float) -> None:
    draft["sensors.gnss.sensor.horizontal_drift"] = drift


def _gnss_drift(scenario: MultirotorLanding) -> float:
    from systems.sensors.gnss import RECEIVERS

    sensor = scenario.sensors.gnss.sensor  # type: ignore[union-attr]  # see `_no_gnss`
    if sensor.horizontal_drift is not None:
        return float(sensor.horizontal_drift)
    return RECEIVERS[sensor.kind].horizontal_drift


def _gnss_limit(scenario: MultirotorLanding) -> float:
    return 0.5 if scenario.sensors.gnss.sensor.kind == "rtk" else 4.25  # type: ignore[union-attr]


def _write_start(draft: Draft, distance: float, direction: float) -> None:
    x, y, z = draft["vehicle.position"]
    east, north, _ = _towards(distance, direction)
    draft["vehicle.position"] = [round(x + east, 3), round(y + north, 3), z]


def _write_pad_speed(draft: Draft, speed: float, direction: float) -> None:
    draft["pad.velocity"] = _towards(speed, direction)
    draft["pad.motion_from"] = "landing"


def _write_heave(draft: Draft, amplitude: float, period: float) -> None:
    draft["pad.heave_amplitude"], draft["pad.heave_period"] = amplitude, period


_DIRECTION = Circumstance("direction", "rad", -math.pi, math.pi, periodic=True)
_TIME = Circumstance("time", "of the landing", 0.0, 1.0)

DISTURBANCES = {
    entry.name: entry
    for entry in (
        Disturbance(
            "wind",
            "steady wind, with the turbulence that belongs to it",
            "m/s",
            lambda scenario: scenario.wind.speed,
            _wind_limit,
            "the vehicle's limit",
            _write_wind,
            (_DIRECTION,),
        ),
        Disturbance(
            "turbulence",
            "factor on the turbulence of MIL-F-8785C",
            "",
            lambda scenario: scenario.wind.turbulence,
            _up_to(2.0),
            "taken: twice the model's, which is that of open country",
            _write_turbulence,
        ),
        Disturbance(
            "gust",
            "one gust of 4 s on top of the wind, by its peak",
            "m/s",
            _nothing,
            _gust_limit,
            "gusts less sustained wind of the vehicle's limit",
            _write_gust,
            (_DIRECTION, _TIME),
            needs_window=True,
        ),
        Disturbance(
            "latency",
            "every camera's measurements come later",
            "s",
            _nothing,
            _up_to(0.25),
            "SVGS paper, 2.4: 175 to 230 ms from the exposure to the flight controller",
            _write_latency,
            lacks=_no_camera,
        ),
        Disturbance(
            "jitter",
            "every camera's latency varies, uniformly up to this much more",
            "s",
            _nothing,
            _up_to(0.15),
            "taken: most of the mean above",
            _write_jitter,
            lacks=_no_camera,
        ),
        Disturbance(
            "drops",
            "every camera's measurements are lost at random with this probability",
            "",
            _nothing,
            _up_to(0.9),
            "thesis, Table 2: up to 0.75",
            _write_drops,
            lacks=_no_camera,
        ),
        Disturbance(
            "dropout",
            "all cameras are blind at once for a while",
            "s",
            _nothing,
            _up_to(10.0),
            "taken: about half of a landing",
            _write_dropout,
            (_TIME,),
            lacks=_no_camera,
            needs_window=True,
        ),
        Disturbance(
            "blind",
            "no camera sees anything below this height, while landing",
            "m",
            _nothing,
            _up_to(3.0),
            "thesis, Table 2: below 3 m",
            _write_blind,
            lacks=_no_camera,
        ),
        Disturbance(
            "false-beacon",
            "a second infrared lamp, by its strength relative to the beacon",
            "",
            _nothing,
            _up_to(1.5),
            "taken: half as strong again as the beacon",
            _write_false_beacon,
            (Circumstance("distance", "m", 0.6, 4.0), _DIRECTION),
            lacks=_no_infrared,
        ),
        Disturbance(
            "gnss-drift",
            "slow horizontal error of GNSS, one sigma an axis",
            "m",
            _gnss_drift,
            _gnss_limit,
            "standalone: twice the NEO-M8's data sheet, 2.5 m CEP; RTK: taken, 0.5 m, as if afloat",
            _write_gnss_drift,
            lacks=_no_gnss,
        ),
        Disturbance(
            "start",
            "take-off farther from where the scenario has it",
            "m",
            _nothing,
            _up_to(5.0),
            "what an IR-LOCK sees from 10 m: half of 320 pixels of 3 mrad",
            _write_start,
            (_DIRECTION,),
        ),
        Disturbance(
            "pad-speed",
            "the pad drives off as the landing begins",
            "m/s",
            _nothing,
            _up_to(1.0),
            "walking pace",
            _write_pad_speed,
            (_DIRECTION,),
            lacks=_has_moving_pad,
            needs_window=True,
        ),
        Disturbance(
            "heave",
            "the pad rises and falls, by the amplitude",
            "m",
            _nothing,
            _up_to(0.5),
            "sea state 3 on the scale of Douglas: waves of 0.5 to 1.25 m",
            _write_heave,
            (Circumstance("period", "s", 4.0, 12.0),),
            lacks=_has_moving_pad,
        ),
    )
}


@dataclass(frozen=True)
class Variable:
    """One coordinate of a `Space`."""

    name: str
    unit: str
    low: float
    high: float
    periodic: bool
    counts: bool  # whether it is a disturbance's strength, and adds to the severity

    def value(self, coordinate: float) -> float:
        """The value at a coordinate in [0, 1] (any number, round a circle), as it is flown."""
        share = coordinate % 1.0 if self.periodic else min(max(coordinate, 0.0), 1.0)
        return _rounded(self.low + share * (self.high - self.low))


class Space:
    """The cases of a scenario under some disturbances, as points of a unit cube.

    Parameters
    ----------
    scenario : MultirotorLanding
        Undisturbed.
    names : sequence of str
        Of `DISTURBANCES`.
    limits : mapping
        Other limits, by name.

    Attributes
    ----------
    disturbances : list of Disturbance
    variables : list of Variable
        The coordinates: each disturbance's strength, followed by its circumstances.
    window : Window
        Set once the undisturbed landing has been flown; needed where `needs_window`.

    Raises
    ------
    StudyError
        A name is unknown, or the scenario has nothing that could be disturbed so.
    """

    def __init__(
        self, scenario: Any, names: Sequence[str], limits: Mapping[str, float] | None = None
    ):
        limits = dict(limits or {})
        if not isinstance(scenario, MultirotorLanding):
            raise StudyError(
                f"scenario {scenario.name} is a {scenario.kind}: disturbances are known for "
                "multirotor_landing"
            )
        self.scenario = scenario
        self.disturbances = [_named(name) for name in dict.fromkeys(names)]
        if not self.disturbances:
            raise StudyError(f"--vary: expected one or more of {', '.join(DISTURBANCES)}")
        self.window = Window(0.0, 0.0)
        self.variables: list[Variable] = []
        for entry in self.disturbances:
            if reason := entry.lacks(scenario):
                raise StudyError(f"--vary {entry.name}: not for {scenario.name}: {reason}")
            low = entry.mildest(scenario)
            high = limits.pop(entry.name) if entry.name in limits else entry.limit(scenario)
            if not (math.isfinite(high) and high > low):
                raise StudyError(
                    f"--vary {entry.name}: expected a limit above the scenario's "
                    f"{low:g} {entry.unit}, found {high:g}: give another, as in "
                    f"--limit {entry.name}={2.0 * low or 1.0:g}"
                )
            self.variables.append(Variable(entry.name, entry.unit, low, high, False, True))
            self.variables += [
                Variable(f"{entry.name} {c.name}", c.unit, c.low, c.high, c.periodic, False)
                for c in entry.circumstances
            ]
        if limits:
            raise StudyError(f"--limit {next(iter(limits))}: is not among what is varied")

    @property
    def needs_window(self) -> bool:
        """Whether `window` must be known before a case can be written."""
        return any(entry.needs_window for entry in self.disturbances)

    @property
    def strengths(self) -> list[int]:
        """The coordinates that are strengths, one a disturbance."""
        return [index for index, variable in enumerate(self.variables) if variable.counts]

    def severity(self, point: NDArray[np.float64]) -> float:
        """The Euclidean norm of the strengths: 1 is one disturbance at its limit."""
        return float(np.linalg.norm(np.clip(point[self.strengths], 0.0, 1.0)))

    def undisturbed(self) -> NDArray[np.float64]:
        """The point of no disturbance, circumstances in the middle."""
        return np.array([0.0 if variable.counts else 0.5 for variable in self.variables])

    def values(self, point: NDArray[np.float64]) -> dict[str, float]:
        """The values at a point, of disturbances above their mildest and their circumstances."""
        values: dict[str, float] = {}
        active = False
        for variable, coordinate in zip(self.variables, point, strict=True):
            value = variable.value(float(coordinate))
            active = value > variable.value(0.0) if variable.counts else active
            if active:
                values[variable.name] = value
        return values

    def overrides(self, point: NDArray[np.float64]) -> dict[str, Any]:
        """The case as overrides of the scenario; nothing for what is at its mildest."""
        values, draft = self.values(point), Draft(self.scenario, self.window)
        for entry in self.disturbances:
            if entry.name in values:
                names = [f"{entry.name} {c.name}" for c in entry.circumstances]
                entry.write(draft, values[entry.name], *(values[name] for name in names))
        return draft.overrides

    def describe(self, point: NDArray[np.float64]) -> str:
        """The case in words: `wind 4.2 m/s (direction 0.3 rad), latency 0.1 s`."""
        values, parts = self.values(point), []
        units = {variable.name: variable.unit for variable in self.variables}
        for entry in self.disturbances:
            if entry.name not in values:
                continue
            details = ", ".join(
                f"{c.name} {values[name]:.3g} {units[name]}".strip()
                for c in entry.circumstances
                for name in [f"{entry.name} {c.name}"]
            )
            strength = f"{entry.name} {values[entry.name]:.3g} {entry.unit}".strip()
            parts.append(f"{strength} ({details})" if details else strength)
        return ", ".join(parts) or "undisturbed"


def _named(name: str) -> Disturbance:
    if name not in DISTURBANCES:
        close = difflib.get_close_matches(name, DISTURBANCES, n=1, cutoff=0.4)
        hint = f"; the nearest is {close[0]}" if close else ""
        raise StudyError(
            f"--vary {name}: there is no such disturbance, expected one of "
            f"{', '.join(DISTURBANCES)}{hint}"
        )
    return DISTURBANCES[name]


def _rounded(value: float, digits: int = _DIGITS) -> float:
    return float(f"{value:.{digits}g}")

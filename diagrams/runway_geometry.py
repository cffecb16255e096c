"""Whether a landing without GPS can be flown at all: the checks before the flight.

Each refuses what no flight could survive, whatever its seed, and says which field, what
was expected of it and what it is.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from numba import njit

from plants.fixed_wing import FixedWingConfig
from plants.fixed_wing_dynamics import equilibrium_pitch
from plants.terrain import TerrainFile, TerrainGrid, elevation_at
from systems.controllers.fixed_wing_guidance import landing_altitude
from systems.runway_frames import (
    bearing_and_elevation,
    direction_in_camera,
    ned_from_runway,
    pixel_from_angles,
)
from systems.sensors.runway_sensor import RunwaySensor
from systems.sensors.runway_tracker import PICTURES_UNDER_WAY
from systems.signals.runway_measurement import LASER_PERIOD, NAVIGATION_PERIOD

_STALL_INCIDENCE = 15.0  # deg, where wings of this class stall
# m: SRTM's specified error of height is 16 m (Farr et al. 2007, Reviews of Geophysics 45, table 1)
_TERRAIN_ERROR = 16.0
_APPROACH = 1000.0  # m, from where a laser of 100 m reach has the ground in sight (6.1, Fig. 30)
_DEEPEST, _HIGHEST = -12000.0, 9000.0  # m, the Earth's deepest trench and highest mountain
_NOSE = 20.0  # m, farther from its centre no camera is on an aircraft of 18 m span
_AT_THE_POINT = 60.0  # m, nearer the sight line is as low as a grid may be wrong
_LOOKS = 40  # places on the landing trajectory that are tried
# of one's radio horizon over an earth of 4/3 radius: 4.12 km for the square root of a metre
# (Recommendation ITU-R P.310)
_RADIO_HORIZON = 4120.0


def require_landing(scenario: Any, grid: TerrainGrid, track: np.ndarray | None = None) -> None:
    """Be sure that a landing without GPS is geometrically possible.

    Parameters
    ----------
    scenario : LandingWithoutGpsScenario
    grid : TerrainGrid
        Of its terrain about its runway.
    track : array, shape (n, 3), optional
        A recorded flight in NED, m; it is not asked whether it could be flown.

    Raises
    ------
    ValueError
        One sentence: field, what was expected, what is there.
    """
    _require_site(scenario, grid)
    if track is None:
        _require_approach(scenario)
        _require_start(scenario, grid)
        _require_room_above_ground(scenario, grid)
    else:
        _require_recording(scenario, grid, track)
    _require_sensors(scenario)
    _require_sight(scenario, grid)


def _refuse(field: str, expected: str, found: Any) -> None:
    if isinstance(found, float):
        found = f"{found:g}"
    raise ValueError(f"{field}: expected {expected}, found {found}")


def _require_site(scenario: Any, grid: TerrainGrid) -> None:
    runway = scenario.runway
    for name, limit, unit in (
        ("latitude", 89.0, "deg; no plane of north and east is drawn at a pole"),
        ("longitude", 360.0, "deg"),
        ("heading", 360.0, "deg"),
        ("altitude", _HIGHEST, "m above mean sea level"),
    ):
        if abs(getattr(runway, name)) > limit:
            _refuse(f"runway.{name}", f"-{limit:g} to {limit:g} {unit}", getattr(runway, name))
    lowest, highest = (
        float(end) + runway.altitude for end in (grid.values.min(), grid.values.max())
    )
    if lowest < _DEEPEST or highest > _HIGHEST:
        _refuse("terrain", f"elevations of {_DEEPEST:g} to {_HIGHEST:g} m above mean sea level",
                f"{lowest:g} to {highest:g}")  # fmt: skip
    if isinstance(scenario.terrain, TerrainFile):
        for place, along in (
            ("the end of the runway (runway.length)", runway.length),
            (f"the last {_APPROACH:g} m of the approach, where the laser measures", -_APPROACH),
        ):
            north, east, _ = ned_from_runway(np.array([0.0, along, 0.0]), runway.heading_radians)
            if not grid.covers(north, east):
                raise ValueError(
                    f"{scenario.terrain.path}: expected a grid that covers {place}, at {north:.0f} "
                    f"m north and {east:.0f} m east of the touch-down point"
                )
    ground = grid.elevation(0.0, 0.0)
    if abs(ground) > _TERRAIN_ERROR:
        there = runway.altitude + ground
        _refuse("runway.altitude", f"{there:g} m, the terrain's at the touch-down point",
                runway.altitude)  # fmt: skip
    station = runway.ground_station_n()
    height = -station[2] - grid.elevation(station[0], station[1])
    if height < 0.0:
        _refuse("runway.ground_station", "an antenna above the ground, its third number at most "
                f"{runway.ground_station[2] + height:g} m", runway.ground_station)  # fmt: skip
    top = max([1.0, *(-point[2] for point in _planned(scenario))])
    reach = _RADIO_HORIZON * (math.sqrt(top) + math.sqrt(height))
    away = math.hypot(station[0], station[1])
    if away > reach:
        _refuse("runway.ground_station", f"within {reach / 1000:.0f} km of the touch-down point, "
                f"the radio horizon of a flight {top:.0f} m up", f"{away / 1000:g} km")  # fmt: skip


def _planned(scenario: Any) -> list[list[float]]:
    """Start and waypoints in the runway frame, as far as they are known before the flight."""
    aircraft, route = scenario.aircraft, scenario.flight_controller.route.waypoints
    return [aircraft.start, *route] if isinstance(aircraft, FixedWingConfig) else list(route)


def _require_approach(scenario: Any) -> None:
    """Speeds, slope and flare that fit each other, and a runway to stop on."""
    aircraft, controller = scenario.aircraft, scenario.flight_controller
    profile, gains = controller.route.profile, controller.gains
    slowest = math.sqrt(
        aircraft.pitch_a / (math.radians(_STALL_INCIDENCE) + max(aircraft.pitch_b, 0.0))
    )
    if aircraft.speed < slowest:
        _refuse("aircraft.speed", f"at least {slowest:.1f} m/s, where {_STALL_INCIDENCE:g} deg of "
                "incidence carry it", aircraft.speed)  # fmt: skip
    for name, room in (("speed", 0.25 * aircraft.speed), ("gear", 2.0)):
        own, believed = getattr(aircraft, name), getattr(controller, name)
        if abs(believed - own) > room:
            _refuse(f"flight_controller.{name}", f"about {own:g}, as aircraft.{name}", believed)
    if math.hypot(*aircraft.wind) >= aircraft.speed:
        _refuse("aircraft.wind", f"less than aircraft.speed, {aircraft.speed:g} m/s", aircraft.wind)
    if profile.touchdown_sink >= gains.sink_limit:
        _refuse("flight_controller.route.profile.touchdown_sink", "less than gains.sink_limit, "
                f"{gains.sink_limit:g} m/s", profile.touchdown_sink)  # fmt: skip
    steepest = math.degrees(math.atan(gains.sink_limit / aircraft.speed))
    shallowest = math.degrees(math.atan(profile.touchdown_sink / aircraft.speed))
    if not shallowest < profile.slope <= steepest:
        _refuse("flight_controller.route.profile.slope", f"more than {shallowest:.2g} deg, "
                "touchdown_sink's, and at most "
                f"{steepest:.2g} deg, sink_limit's at {aircraft.speed:g} m/s",
                profile.slope)  # fmt: skip
    if not -gains.climb_limit <= aircraft.start_vertical_speed <= gains.sink_limit:
        _refuse("aircraft.start_vertical_speed", f"-{gains.climb_limit:g} to {gains.sink_limit:g} "
                "m/s (climb_limit, sink_limit)", aircraft.start_vertical_speed)  # fmt: skip
    stopping = aircraft.speed**2 / (2.0 * (gains.deceleration + aircraft.rolling_deceleration))
    if scenario.runway.length < stopping:
        _refuse("runway.length", f"at least {stopping:.0f} m, in which "
                f"{aircraft.speed:g} m/s come to a stop", scenario.runway.length)  # fmt: skip


def _require_start(scenario: Any, grid: TerrainGrid) -> None:
    """A start in the air, and a way from it to the runway."""
    aircraft, controller, heading = (
        scenario.aircraft, scenario.flight_controller, scenario.runway.heading_radians
    )  # fmt: skip
    route = controller.route.waypoints
    places = [("aircraft.start", aircraft.start)]
    places += [(f"flight_controller.route.waypoints.{i}", point) for i, point in enumerate(route)]
    heights = []
    for field, place in places:
        p_n = ned_from_runway(np.array(place), heading)
        heights.append(-p_n[2] - grid.elevation(p_n[0], p_n[1]))
        if heights[-1] <= aircraft.gear:
            _refuse(field, "a place in the air, its third number less than "
                    f"{place[2] + heights[-1] - aircraft.gear:g} m", place)  # fmt: skip
    for i in range(1, len(route)):
        if math.dist(route[i][:2], route[i - 1][:2]) < 1.0:
            _refuse(f"flight_controller.route.waypoints.{i}", "another place than the one before",
                    route[i])  # fmt: skip
    field, (right, along, down) = places[0] if len(route) < 2 else places[-1]
    flare = controller.route.profile.flare
    if -along <= flare:
        _refuse(field, "a place before the landing's flare, its second number less than "
                f"-{flare:g} m", [right, along, down])  # fmt: skip
    intercept = math.tan(math.radians(min(controller.gains.intercept_limit, 89.0)))
    if abs(right) > -along * intercept:
        _refuse(field, f"a place at most {-along * intercept:.0f} m beside the runway's axis, from "
                "where intercept_limit leads onto it", [right, along, down])  # fmt: skip
    highest = -along * controller.gains.sink_limit / aircraft.speed
    if -down > highest:
        _refuse(field, f"at most {highest:.0f} m above the touch-down point, from where "
                "sink_limit leads down to it", f"{-down:g} m")  # fmt: skip
    if len(route) < 2 and math.cos(math.radians(aircraft.start_course)) <= 0.0:
        _refuse("aircraft.start_course", "less than 90 deg off the landing, for no route leads "
                "back", aircraft.start_course)  # fmt: skip
    if scenario.laser.activation_height > max(heights):
        _refuse("laser.activation_height", "less than the height of the flight, "
                f"{max(heights):.0f} m over the ground",
                scenario.laser.activation_height)  # fmt: skip


def _landing_places(scenario: Any, distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """NED (n, 3) and slopes (n,) of the landing trajectory at distances before its end (m)."""
    controller = scenario.flight_controller
    profile = controller.route.profile.vector(controller.speed, controller.gear)
    planned = np.array([landing_altitude(distance, profile) for distance in distances])
    heading = scenario.runway.heading_radians
    places = [
        ned_from_runway(np.array([0.0, -distance, -altitude]), heading)
        for distance, altitude in zip(distances, planned[:, 0], strict=True)
    ]
    return np.array(places), planned[:, 1]


def _require_room_above_ground(scenario: Any, grid: TerrainGrid) -> None:
    """No ground in the way of the landing trajectory."""
    flare = scenario.flight_controller.route.profile.flare
    start = -_planned(scenario)[-1][1]
    # the ground is asked every 20 m: a grid may hold a house
    distances = np.arange(max(flare, 20.0), start, 20.0)
    places, _ = _landing_places(scenario, distances)
    gear = scenario.aircraft.gear
    for distance, place in zip(distances[::-1], places[::-1], strict=True):
        ground = grid.elevation(place[0], place[1])
        if ground > -place[2] - gear:
            _refuse("terrain", f"ground below the landing trajectory, which is {-place[2]:.0f} m "
                    f"up at {distance:.0f} m before the touch-down point",
                    f"{ground:.0f} m there")  # fmt: skip


def _require_recording(scenario: Any, grid: TerrainGrid, track: np.ndarray) -> None:
    """A recorded flight over the ground, past a distance at which errors are noted."""
    name = scenario.aircraft.path or "the reference flight"
    under = np.array([grid.elevation(n, e) for n, e in track[::50, :2]]) + track[::50, 2]
    if under.max() > _TERRAIN_ERROR:
        raise ValueError(
            f"{name}: expected a flight above the ground, but in row {50 * int(under.argmax()) + 1}"
            f" it is {under.max():.0f} m below it (down is positive downwards, from the "
            "touch-down point)"
        )
    away = np.hypot(track[:, 0], track[:, 1])
    if not any(away.min() <= distance <= away.max() for distance in scenario.record.distances):
        noted = ", ".join(f"{distance:g}" for distance in scenario.record.distances)
        raise ValueError(
            f"{name}: expected a flight past one of record.distances ({noted} m before the "
            f"touch-down point), but it only lies {away.min():.0f} to {away.max():.0f} m from it"
        )


def _require_sensors(scenario: Any) -> None:
    """Delays that fit into what holds the measurements on their way, and distances in order."""
    clicks = scenario.tracker.clicks
    if sorted(clicks, reverse=True) != list(clicks):
        _refuse("tracker.clicks", "distances from the farthest to the nearest, "
                f"{sorted(clicks, reverse=True)}", clicks)  # fmt: skip
    if not scenario.record.distances:
        _refuse("record.distances", "at least one distance, as [300, 150, 100]", "none")
    camera = scenario.camera
    longest = PICTURES_UNDER_WAY * camera.period
    on_the_way = camera.latency + scenario.tracker.delay
    if on_the_way > longest > 0.0:
        field = "camera.latency" if camera.latency > scenario.tracker.delay else "tracker.delay"
        _refuse(field, f"at most {longest:g} s, camera.latency and tracker.delay together",
                f"{on_the_way:g} s")  # fmt: skip
    for name, least in (("laser", LASER_PERIOD), ("antenna", 0.0), ("baro", NAVIGATION_PERIOD)):
        sensor = getattr(scenario, name)
        longest = RunwaySensor.capacity * max(sensor.period, least)
        if sensor.delay > longest:
            _refuse(f"{name}.delay", f"at most {longest:g} s, {RunwaySensor.capacity} of its "
                    "periods", sensor.delay)  # fmt: skip


def _require_sight(scenario: Any, grid: TerrainGrid) -> None:
    """The camera has the touch-down point in its picture while the tracker may hold it.

    With the errors of one sigma that no filter takes out before the first pictures: the camera's
    harmonisation, and the place of the start beside the planned one.
    """
    camera, tracker = scenario.camera, scenario.tracker
    aircraft = scenario.aircraft
    if not isinstance(aircraft, FixedWingConfig):
        aircraft = FixedWingConfig()  # its recording may be of any; the trim is about the same
    axes = ("horizontal", "vertical")
    fields = [f"camera.{axis}_field_of_view" for axis in axes]
    for field, axis in zip(fields, axes, strict=True):
        wide = getattr(camera, f"{axis}_field_of_view")
        if wide >= 180.0:
            _refuse(field, "less than 180 deg", wide)
    if float(np.linalg.norm(camera.position)) > _NOSE:
        _refuse("camera.position", f"a place on the aircraft, within {_NOSE:g} m", camera.position)
    far, near = max(tracker.clicks), max(tracker.loss_distance, 1.0)
    if far <= near:
        raise ValueError(
            f"tracker.clicks: expected a click farther than tracker.loss_distance ({near:g} m), "
            "or the tracker never has the touch-down point"
        )
    optics, heading = camera.optics(), scenario.runway.heading_radians
    distances = np.linspace(far, near, _LOOKS)
    places, slopes = _landing_places(scenario, distances)
    open_view = [_clear(place, grid) for place in places]
    if not any(open_view):
        hill = int(np.argmax([_hill(place, grid) for place in places]))
        raise ValueError(
            "terrain: expected a view of the touch-down point from the landing trajectory between "
            f"{far:g} m (tracker.clicks) and {near:g} m (tracker.loss_distance), but ground up to "
            f"{_hill(places[hill], grid):.0f} m above the line of sight hides it"
        )
    position, mounting = np.array(camera.position), camera.mounting_radians()
    unmounted, seen = [], False
    # deg, half the field of view that either axis needs at the best of all places, and how much
    # of it for the errors
    needed, blur = np.full(2, math.inf), np.full(2, math.inf)
    for distance, place, slope, clear in zip(distances, places, slopes, open_view, strict=True):
        pitch = equilibrium_pitch(
            aircraft.speed, slope * aircraft.speed, aircraft.pitch_a, aircraft.pitch_b
        )
        p_c = direction_in_camera(place, heading, pitch, 0.0, position, mounting)
        straight = direction_in_camera(place, heading, pitch, 0.0, position, np.zeros(3))
        unmounted.append(bearing_and_elevation(straight))
        if p_c[0] <= 0.0 or not clear:
            continue
        bearing, elevation = bearing_and_elevation(p_c)
        u, v = pixel_from_angles(bearing, elevation, optics)
        seen = seen or (0.0 <= u < camera.columns and 0.0 <= v < camera.rows)
        gps = scenario.gps
        errors = (
            math.hypot(camera.harmonisation_yaw_spread,
                       math.degrees(math.atan2(gps.horizontal_noise, distance))),
            math.hypot(camera.harmonisation_pitch_spread,
                       math.degrees(math.atan2(gps.vertical_noise, distance))),
        )  # fmt: skip
        offsets = np.abs(np.degrees([bearing, elevation]))
        needed = np.minimum(needed, offsets + errors)
        blur = np.minimum(blur, errors)
    for k, (field, axis) in enumerate(zip(fields, axes, strict=True)):
        wide = getattr(camera, f"{axis}_field_of_view")
        # the mounting is at fault where the errors alone would fit
        if math.inf > 2.0 * needed[k] > wide and (seen or 2.0 * blur[k] > wide):
            _refuse(field, f"at least {2.0 * needed[k] + 0.05:.1f} deg, for the touch-down point "
                    "to stay in the picture with errors of one sigma in harmonisation and "
                    "position", wide)  # fmt: skip
    if not seen:
        bearing, elevation = np.degrees(np.mean(unmounted, axis=0))
        where = f"at ({u:.0f}, {v:.0f}) px" if math.isfinite(needed[0]) else "behind it"
        raise ValueError(
            "camera.mounting: expected a camera that sees the touch-down point on the landing "
            f"trajectory, but there the point lies {where}, and the picture has "
            f"{camera.columns:g} x {camera.rows:g} px; [{bearing:.1f}, {-elevation:.1f}, 0] has "
            "it in the middle"
        )


def _hill(place: np.ndarray, grid: TerrainGrid) -> float:
    """How far (m) the ground rises over the line from a place to the touch-down point."""
    away = math.hypot(place[0], place[1])
    steps = max(int(away / 10.0), 10)
    nearest = min(_AT_THE_POINT / away, 0.5)
    highest: float = highest_over_line(place, nearest, steps, grid.values, grid.geometry)
    return highest


@njit(cache=True)
def highest_over_line(place, nearest, steps, values, geometry):
    """The highest (m) that a terrain rises over the line to the origin, up to a share of it."""
    highest = -math.inf
    for k in range(steps):
        share = nearest + (1.0 - nearest) * k / steps
        ground = elevation_at(values, geometry, share * place[0], share * place[1])
        highest = max(highest, ground + share * place[2])
    return highest


def _clear(place: np.ndarray, grid: TerrainGrid) -> bool:
    return bool(_hill(place, grid) <= 0.0)


def same_but_for_seed(one: Any, other: Any) -> bool:
    """Whether two scenarios are the same as far as these checks look at them."""
    names = [field.name for field in dataclasses.fields(one) if field.name != "seed"]
    return all(getattr(one, name) == getattr(other, name) for name in names)

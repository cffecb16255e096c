"""The 3-D replay and the live view of a landing without GPS, in Meshcat."""

from collections.abc import Callable

import numpy as np
import pyarrow as pa
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.framework import Context

from diagrams.landing_without_gps import (
    RECORDED,
    LandingWithoutGpsDiagram,
    LandingWithoutGpsScenario,
)
from plants.fixed_wing import FixedWingConfig
from plants.runway_illustration import Lens, draw_runway, in_picture, move_world, positions
from runs.logs import port_samples
from runs.replay_3d import PATH, empty_scene, paced, recorded_page, rows
from systems.controllers.fixed_wing_guidance import landing_altitude
from systems.signals.runway_measurement import NAVIGATION_ESTIMATE

_SHOWN = ("state", "estimate", "antenna", "picture")
_FRAMES = 3000  # of a replay at most: Meshcat moves evenly from one to the next
_TRUTH = Rgba(0.0, 0.45, 0.70, 1.0)
_ESTIMATE = Rgba(0.34, 0.71, 0.91, 1.0)
_PLAN = Rgba(0.90, 0.62, 0.0, 1.0)


def runway_replay_html(scenario: LandingWithoutGpsScenario, log: pa.Table) -> str:
    """A self-contained page that replays a landing without GPS in 3-D.

    Parameters
    ----------
    scenario : LandingWithoutGpsScenario
        Whose runway, terrain and route to draw.
    log : pa.Table
        Whose ports `state`, `estimate`, `antenna` and `picture` to follow.
    """
    times = port_samples(log, "state")["time"]
    samples = {port: _latest(log, port, times) for port in _SHOWN}
    truth, estimate = samples["state"], samples["estimate"]
    known = estimate[estimate[:, NAVIGATION_ESTIMATE.index("initialised")] > 0.0]
    scene = _scene(scenario, positions(truth))
    _line(scene, "track", positions(truth), _TRUTH)
    _line(scene, "believed", positions(known, NAVIGATION_ESTIMATE), _ESTIMATE)
    every = 1 + len(truth) // _FRAMES
    period = every * float(times[1] - times[0]) if len(times) > 1 else 1.0
    scene.StartRecording(1.0 / period, set_visualizations_while_recording=False)
    lens = _lens(scenario)
    for frame, index in enumerate(range(0, len(truth), every)):
        now = {port: values[index] for port, values in samples.items()}
        # half a frame later, because Meshcat rounds down
        move_world(scene, now, scenario.runway, lens, PATH, (frame + 0.5) * period)
    return recorded_page(scene)


def runway_live_view(
    landing: LandingWithoutGpsDiagram, scenario: LandingWithoutGpsScenario
) -> Callable:
    """A monitor for `Simulator.set_monitor` that shows the flight as it happens."""
    scene, lens = _scene(scenario), _lens(scenario)

    def show(context: Context) -> None:
        now = {port: landing.evaluate(port, context) for port in _SHOWN}
        move_world(scene, now, scenario.runway, lens, PATH)

    return paced(show)


def _latest(log: pa.Table, port: str, times: np.ndarray) -> np.ndarray:
    """The newest sample of a port at each time, zeros before its first, shape (n, fields)."""
    recorded = rows(log, port, RECORDED[port].fields)
    samples = np.vstack((np.zeros(RECORDED[port].size), recorded))
    newest = np.searchsorted(port_samples(log, port)["time"], times, side="right")
    latest: np.ndarray = samples[newest]
    return latest


def _scene(scenario: LandingWithoutGpsScenario, track: np.ndarray | None = None) -> Meshcat:
    """Meshcat with the world of the flight, and an eye behind the aircraft."""
    scene = empty_scene(near=1.0, far=40000.0)
    aircraft, runway = scenario.aircraft, scenario.runway
    planned = [*scenario.flight_controller.route.waypoints, [0.0, runway.length, 0.0]]
    if isinstance(aircraft, FixedWingConfig):
        planned.append(aircraft.start)
    if track is None:
        track = np.empty((0, 3))
    plan = in_picture(np.array(planned), runway)
    draw_runway(scene, runway, scenario.terrain, aircraft.gear, np.vstack((track, plan)), PATH)
    _line(scene, "plan", _plan(scenario), _PLAN)
    # of the aircraft at the origin, heading along x
    scene.SetCameraPose(np.array([-27.0, 7.0, 7.5]), np.array([0.0, 0.0, 1.0]))
    return scene


def _plan(scenario: LandingWithoutGpsScenario) -> np.ndarray:
    """The route and the landing trajectory after it, shape (n, 3), ENU."""
    controller = scenario.flight_controller
    profile = controller.route.profile.vector(controller.speed, controller.gear)
    route = [list(point) for point in controller.route.waypoints]
    farthest = -route[-1][1] if route else 5000.0
    for distance in np.append(np.arange(farthest, 120.0, -100.0), np.arange(120.0, -1.0, -10.0)):
        route.append([0.0, -distance, -landing_altitude(distance, profile)[0]])
    return in_picture(np.array(route), scenario.runway)


def _lens(scenario: LandingWithoutGpsScenario) -> Lens:
    camera = scenario.camera
    return Lens(np.array(camera.position), camera.mounting_radians(), camera.optics())


def _line(scene: Meshcat, name: str, points: np.ndarray, colour: Rgba) -> None:
    if len(points) > 1:
        scene.SetLine(f"{PATH}/world/{name}", np.asfortranarray(points.T), 2.0, colour)

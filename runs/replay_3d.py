"""The 3-D replay of a run, and the live view of one that is going on, in Meshcat."""

import logging
from collections.abc import Callable
from functools import cache

import numpy as np
import pyarrow as pa
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.systems.framework import Context, EventStatus

from diagrams.landing import LandingDiagram
from diagrams.scenario import MultirotorLanding
from plants.illustration import draw, move
from runs.logs import port_samples
from systems.signals.measurement import BODY_STATE, PAD_STATE

_LIVE_PERIOD = 0.04  # s of simulated time between two poses of the live view
_TRACK = Rgba(0.0, 0.45, 0.70, 1.0)
PATH = "/plumbline"


@cache
def meshcat() -> Meshcat:
    """The Meshcat of this process, started when it is first asked for."""
    logging.getLogger("drake").setLevel(logging.WARNING)  # it would announce its port
    return Meshcat(MeshcatParams(show_stats_plot=False))


def replay_html(scenario: MultirotorLanding, log: pa.Table) -> str:
    """A self-contained page that replays a flight in 3-D.

    Parameters
    ----------
    scenario : MultirotorLanding
        Whose vehicle, pad and LED beacons (if it has an SVGS camera) to draw.
    log : pa.Table
        Whose ports `body` and `pad` to follow.
    """
    scene = _scene(scenario)
    body, pad = rows(log, "body", BODY_STATE.fields), rows(log, "pad", PAD_STATE.fields)
    track = body[::4, BODY_STATE.slice("p_WB")].T
    scene.SetLine(f"{PATH}/track", np.asfortranarray(track), 2.0, _TRACK)
    move(scene, body[0], pad[0])
    period = scenario.recording.period
    scene.StartRecording(1.0 / period, set_visualizations_while_recording=False)
    for frame in range(len(body)):
        # half a frame later, because Meshcat rounds down
        move(scene, body[frame], pad[frame], (frame + 0.5) * period)
    return recorded_page(scene)


def recorded_page(scene: Meshcat) -> str:
    """The self-contained page of what has been recorded; clears the scene."""
    scene.StopRecording()
    scene.PublishRecording()
    page = scene.StaticHtml()
    scene.Delete(PATH)
    scene.DeleteRecording()
    return page


def live_view(landing: LandingDiagram, scenario: MultirotorLanding) -> Callable:
    """A monitor for `Simulator.set_monitor` that shows the flight as it happens.

    The page's address is `meshcat().web_url()`.
    """
    scene = _scene(scenario)
    return paced(
        lambda context: move(
            scene, landing.evaluate("body", context), landing.evaluate("pad", context)
        )
    )


def paced(show: Callable[[Context], None]) -> Callable[[Context], EventStatus]:
    """A monitor that calls `show` every 40 ms of simulated time."""
    shown = -1.0

    def monitor(context: Context) -> EventStatus:
        nonlocal shown
        time = context.get_time()
        if time >= shown + _LIVE_PERIOD:
            shown = time
            show(context)
        return EventStatus.DidNothing()

    return monitor


def _scene(scenario: MultirotorLanding) -> Meshcat:
    """Meshcat with the vehicle, the pad and the ground, and a camera that sees the flight."""
    scene = empty_scene()
    phone = scenario.sensors.svgs_camera
    beacons = None if phone is None else phone.sensor.beacons
    draw(scene, scenario.vehicle.resolved_vehicle(), scenario.pad, PATH, beacons)
    scene.SetCameraPose(np.array([-3.2, -5.2, 2.8]), np.array([0.4, 0.0, 1.0]))
    return scene


def empty_scene(near: float = 0.01, far: float = 100.0) -> Meshcat:
    """Meshcat with sky and light alone, seen from `near` to `far` (m)."""
    scene = meshcat()
    scene.Delete(PATH)
    for name, distance in (("near", near), ("far", far)):
        scene.SetProperty("/Cameras/default/rotated/<object>", name, distance)
    scene.SetProperty("/Grid", "visible", False)
    scene.SetProperty("/Axes", "visible", False)
    scene.SetProperty("/Background", "top_color", [0.62, 0.74, 0.88])
    scene.SetProperty("/Background", "bottom_color", [0.93, 0.95, 0.97])
    scene.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.2)
    scene.SetProperty("/Lights/FillLight/<object>", "intensity", 1.0)
    return scene


def rows(log: pa.Table, port: str, fields: tuple[str, ...]) -> np.ndarray:
    """The samples of a port, shape (n, fields)."""
    samples = port_samples(log, port)
    return np.column_stack([samples[field] for field in fields])

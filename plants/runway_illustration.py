"""What the second vehicle's world looks like: fixed wing, runway and terrain, for Meshcat.

Pictures only; no sensor sees these shapes. The world of the picture is east,
north and up of the touch-down point. The picture's eye flies along: everything
lies below `PATH/world`, which `move_world` shifts so that the aircraft stays where it is and
heads the same way. (Meshcat's own camera can be moved, but looks at a fixed point then.)
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from plants.illustration import CARBON, FRONT, RUBBER, Piece
from plants.terrain import Terrain
from systems.runway_frames import RunwayConfig, angles_from_pixel, ned_from_runway, rotation
from systems.signals.runway_measurement import (
    ANTENNA,
    FIXED_WING_STATE,
    NAVIGATION_ESTIMATE,
    PICTURE,
)

_SHELL = Rgba(0.92, 0.93, 0.94, 1.0)
_GLASS = Rgba(0.16, 0.22, 0.30, 1.0)
_DISC = Rgba(0.2, 0.2, 0.2, 0.18)
_GHOST = Rgba(0.20, 0.62, 0.92, 0.45)  # the colour of the estimate in the plots
_ASPHALT = Rgba(0.42, 0.43, 0.46, 1.0)
_PAINT = Rgba(0.97, 0.97, 0.96, 1.0)
_METAL = Rgba(0.62, 0.64, 0.67, 1.0)
_ANTENNA_RAY = Rgba(0.60, 0.25, 0.62, 0.55)
_CAMERA_RAY = Rgba(0.93, 0.33, 0.12, 0.55)
_GRASS, _HIGH, _SEA = (0.47, 0.58, 0.36), (0.62, 0.58, 0.46), (0.33, 0.51, 0.66)
_HAZE = (0.94, 0.98, 1.0)  # the sky above the horizon, into which the far ground fades
_FIELD = 360.0  # m, side of the fields that the ground is patched with
_HIGH_AT = 300.0  # m above the touch-down point, where the grass has turned into rock
_LIGHT = np.array([-0.45, 0.25, 0.86])  # towards the sun, east-north-up: shades the terrain
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_BEFORE = 300.0  # m of runway before the touch-down point, as the camera sees it
_MARGIN, _HORIZON = 2500.0, 25000.0  # m of terrain about the flight: clear, and in all
_COARSE, _FINE = 120.0, 15.0  # m between the terrain's points, far from the approach and in it
_FINE_ALONG, _FINE_ACROSS = (-1600.0, 300.0), 150.0  # m
_SUNK = 0.8  # m, terrain under runway and wheels, so that neither flickers through the other


@dataclass(frozen=True)
class Lens:
    """Where the camera sits and how it sees.

    Attributes
    ----------
    position : array, shape (3,)
        In the body frame, m.
    mounting : array, shape (3,)
        Yaw, pitch and roll in the body frame, rad.
    optics : array, shape (4,)
        FOV_H, FOV_V (rad), IFOV_H and IFOV_V (rad/px).
    """

    position: np.ndarray
    mounting: np.ndarray
    optics: np.ndarray


def _at(
    x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> RigidTransform:
    p: Any = np.array([x, y, z])
    return RigidTransform(RollPitchYaw(roll, pitch, yaw), p)


def aircraft_pieces(gear: float) -> list[Piece]:
    """A motor glider of 18 m span in B: x forward, y right, z down; wheels `gear` m below it."""
    quarter = 0.5 * math.pi
    pieces = [
        Piece("fuselage", Ellipsoid(3.3, 0.55, 0.62), _at(0.3, 0, 0), _SHELL),
        Piece("boom", Capsule(0.24, 4.6), _at(-2.9, 0, -0.12, pitch=quarter), _SHELL),
        Piece("canopy", Ellipsoid(1.15, 0.42, 0.42), _at(1.2, 0, -0.38), _GLASS),
        Piece("spinner", Ellipsoid(0.45, 0.24, 0.24), _at(3.5, 0, 0), FRONT),
        Piece("propeller", Cylinder(0.95, 0.02), _at(3.55, 0, 0, pitch=quarter), _DISC),
        Piece("fin", Ellipsoid(0.62, 0.07, 0.95), _at(-5.0, 0, -0.85, pitch=-0.25), FRONT),
        Piece("tailplane", Ellipsoid(0.42, 1.75, 0.05), _at(-5.25, 0, -1.72), _SHELL),
        Piece("turret", Sphere(0.24), _at(2.5, 0, 0.5), CARBON),
    ]
    for side, name in ((-1.0, "left"), (1.0, "right")):
        pieces += [
            Piece(
                f"{name} wing",
                Ellipsoid(0.62, 4.7, 0.09),
                _at(0.1, side * 4.4, -0.38, roll=-side * 0.05),
                _SHELL,
            ),
            Piece(
                f"{name} winglet",
                Ellipsoid(0.28, 0.05, 0.42),
                _at(0.0, side * 8.85, -0.9, roll=side * 0.25, pitch=-0.2),
                FRONT,
            ),
            Piece(f"{name} pod", Ellipsoid(0.95, 0.22, 0.24), _at(0.6, side * 2.9, 0.12), _SHELL),
        ]
    for name, x, y in (("left", -0.3, -1.25), ("right", -0.3, 1.25), ("nose", 2.2, 0.0)):
        pieces += [
            Piece(
                f"{name} wheel", Cylinder(0.2, 0.14), _at(x, y, gear - 0.2, roll=quarter), RUBBER
            ),
            Piece(
                f"{name} strut", Box(0.1, 0.05, gear - 0.2), _at(x, y, 0.5 * (gear - 0.2)), _METAL
            ),
        ]
    return pieces


def runway_pieces(runway: RunwayConfig) -> list[Piece]:
    """The runway from above its touch-down point: x along it, y to its left, z up."""
    first, last, width = -_BEFORE, runway.length, runway.width
    edge = 0.5 * width - 1.5
    middle, long = 0.5 * (first + last), last - first

    def paint(name: str, length: float, wide: float, x: float, y: float) -> Piece:
        return Piece(name, Box(length, wide, 0.1), _at(x, y, 0.0), _PAINT)

    pieces = [
        Piece("asphalt", Box(long, width, 0.6), _at(middle, 0, -0.35), _ASPHALT),
        paint("left edge", long, 0.9, middle, edge),
        paint("right edge", long, 0.9, middle, -edge),
    ]
    for k in range(int((long - 120.0) / 50.0)):
        pieces.append(paint(f"centre line {k}", 30.0, 0.9, first + 85.0 + 50.0 * k, 0.0))
    bars = int((edge - 3.0) / 4.5)
    for k in range(bars):
        for side in (-1.0, 1.0):
            y = side * (4.25 + 4.5 * k)
            pieces.append(paint(f"threshold {side * (k + 1):+g}", 30.0, 2.5, first + 21.0, y))
            pieces.append(paint(f"far threshold {side * (k + 1):+g}", 30.0, 2.5, last - 21.0, y))
    # the touch-down point lies between the two blocks
    offset = min(12.0, 0.25 * width)
    pieces += [
        paint("left aim", 45.0, 0.5 * offset, 0, offset),
        paint("right aim", 45.0, 0.5 * offset, 0, -offset),
    ]
    return pieces


def station_pieces(height: float) -> list[Piece]:
    """The ground station below its antenna, `height` m over the ground, z up; without its dish."""
    mast = max(height, 1.0)
    return [
        Piece("cabin", Box(7.0, 3.0, 3.0), _at(4.5, 0, 1.5 - mast), _SHELL),
        Piece("mast", Cylinder(0.3, mast), _at(0, 0, -0.5 * mast), _METAL),
    ]


def _terrain_mesh(
    runway: RunwayConfig, terrain: Terrain, track: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (3, n), faces (3, m), colours (3, n) of the ground about a track (n, 3), ENU."""
    heading, grid = runway.heading_radians, terrain.grid(runway)
    s, c = math.sin(heading), math.cos(heading)
    along_track = s * track[:, 0] + c * track[:, 1]
    across_track = c * track[:, 0] - s * track[:, 1]
    along = _points(along_track, _FINE_ALONG)
    across = _points(across_track, (-_FINE_ACROSS, _FINE_ACROSS))
    Y, X = np.meshgrid(along, across, indexing="ij")
    east, north = c * X + s * Y, -s * X + c * Y
    up = np.array(
        [
            [grid.elevation(n, e) for n, e in zip(*row, strict=True)]
            for row in zip(north, east, strict=True)
        ]
    )
    sea = up <= 0.5 - runway.altitude
    rows, columns = up.shape
    slope_y, slope_x = np.gradient(up, along, across)
    normal = np.stack(
        (-(c * slope_x + s * slope_y), s * slope_x - c * slope_y, np.ones_like(up)), axis=-1
    )
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    shade = np.clip(0.35 + 0.75 * normal @ _LIGHT, 0.25, 1.0)
    high = np.clip(up / _HIGH_AT, 0.0, 1.0)[..., None]
    land = ((1.0 - high) * np.array(_GRASS) + high * np.array(_HIGH)) * shade[..., None]
    land *= 1.0 + 0.22 * (_patchwork(X, Y) - 0.5)
    colours = np.where(sea[..., None], np.array(_SEA), land)
    off = np.hypot(
        X - np.clip(X, across_track.min(), across_track.max()),
        Y - np.clip(Y, along_track.min(), along_track.max()),
    )
    haze = np.clip((off - _MARGIN) / (0.4 * _HORIZON), 0.0, 1.0)[..., None]
    colours = (1.0 - haze) * colours + haze * np.array(_HAZE)
    vertices = np.stack((east, north, up - _SUNK), axis=-1).reshape(-1, 3).T
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, d, e = (
        part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    )
    faces = np.hstack((np.stack((a, d, b)), np.stack((b, d, e))))
    return vertices, faces, np.clip(colours, 0.0, 1.0).reshape(-1, 3).T


def _points(track: np.ndarray, fine: tuple[float, float]) -> np.ndarray:
    """Places across the terrain: dense within `fine`, then sparse, then farther and farther."""
    sides = []
    for start, end in (
        (fine[0], fine[0] - float(track.min())),
        (fine[1], float(track.max()) - fine[1]),
    ):
        clear = max(end, 0.0) + _MARGIN
        steps = [*np.arange(_COARSE, clear, _COARSE)]
        while steps[-1] < clear + _HORIZON:
            steps.append(1.5 * steps[-1])
        sides.append((start, np.array(steps)))
    (low, down), (high, up) = sides
    return np.concatenate(((low - down)[::-1], np.arange(low, high, _FINE), [high], high + up))


def _patchwork(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How light the fields are, 0 to 1 in three colours; the same at the same place always."""
    cell = np.floor(x / _FIELD) * 12.9898 + np.floor(y / (1.5 * _FIELD)) * 78.233
    phase = np.stack((cell, cell + 0.35, cell + 0.1), axis=-1)
    return np.mod(np.sin(phase) * 43758.5453, 1.0) * np.array([1.0, 0.8, 0.9])


def aircraft_pose(state: np.ndarray, layout: Any = FIXED_WING_STATE) -> RigidTransform:
    """The aircraft in the picture, from a `FIXED_WING_STATE` or a `NAVIGATION_ESTIMATE`."""
    yaw, pitch, roll = state[layout.index("yaw") :][:3]
    turn: Any = RotationMatrix(_ENU_FROM_NED @ rotation(yaw, pitch, roll))
    p: Any = positions(state, layout)
    return RigidTransform(turn, p)


def positions(state: np.ndarray, layout: Any = FIXED_WING_STATE) -> np.ndarray:
    """East, north and up (m) from one state or rows of them, shape (3,) or (n, 3)."""
    return np.asarray(state)[..., layout.slice("p_n")] @ _ENU_FROM_NED.T


def draw_runway(
    meshcat: Meshcat,
    runway: RunwayConfig,
    terrain: Terrain,
    gear: float,
    track: np.ndarray,
    path: str,
) -> None:
    """Draw everything below `path`; pose it with `move_world`.

    Parameters
    ----------
    meshcat : Meshcat
    runway : RunwayConfig
    terrain : Terrain
    gear : float
        From the wheels up to the body origin, m.
    track : array, shape (n, 3)
        East, north, up, m: where the flight leads, so how far the terrain has to be drawn.
    path : str
    """
    world = f"{path}/world"
    vertices, faces, colours = _terrain_mesh(runway, terrain, track)
    meshcat.SetTriangleColorMesh(
        f"{world}/terrain",
        np.asfortranarray(vertices),
        np.asfortranarray(faces),
        np.asfortranarray(colours),
    )
    station = _ENU_FROM_NED @ runway.ground_station_n()
    ground = terrain.grid(runway).elevation(station[1], station[0])
    groups = {
        "runway": runway_pieces(runway),
        "station": station_pieces(station[2] - ground),
        "aircraft": aircraft_pieces(gear),
        "estimate": [
            Piece(piece.name, piece.shape, piece.pose, _GHOST) for piece in aircraft_pieces(gear)
        ],
    }
    for group, pieces in groups.items():
        for piece in pieces:
            name = f"{world}/{group}/{piece.name}"
            meshcat.SetObject(name, piece.shape, piece.colour)
            meshcat.SetTransform(name, piece.pose)
    # rays of one metre, which are stretched
    for ray, radius, colour in (("antenna", 0.25, _ANTENNA_RAY), ("sight", 0.12, _CAMERA_RAY)):
        name = f"{world}/{ray}/length/shaft"
        meshcat.SetObject(name, Cylinder(radius, 1.0), colour)
        meshcat.SetTransform(name, _at(0, 0, 0.5))
    meshcat.SetObject(f"{world}/antenna/dish", Ellipsoid(1.5, 1.5, 0.4), _PAINT)
    p: Any = station
    meshcat.SetTransform(f"{world}/station", RigidTransform(p))
    turn = RotationMatrix.MakeZRotation(0.5 * math.pi - runway.heading_radians)
    meshcat.SetTransform(f"{world}/runway", RigidTransform(turn, np.zeros(3)))


def move_world(
    meshcat: Meshcat,
    samples: dict[str, np.ndarray],
    runway: RunwayConfig,
    lens: Lens,
    path: str,
    time: float | None = None,
) -> None:
    """Pose aircraft, estimate and rays; the picture's eye keeps behind the aircraft.

    Parameters
    ----------
    meshcat : Meshcat
    samples : dict
        `state`, `estimate`, `antenna` and `picture`, each a vector of the layout of that name.
    runway : RunwayConfig
    lens : Lens
        Of the camera, as it is meant to be mounted.
    path : str
    time : float, optional
        s; with it the poses are also a frame of a recording, if one is on.
    """
    world, state = f"{path}/world", samples["state"]
    body = aircraft_pose(state)
    meshcat.SetTransform(f"{world}/aircraft", body, time)
    yaw = 0.5 * math.pi - state[FIXED_WING_STATE.index("yaw")]
    meshcat.SetTransform(
        path, RigidTransform(RotationMatrix.MakeZRotation(-yaw), np.zeros(3)), time
    )
    meshcat.SetTransform(world, RigidTransform(-body.translation()), time)
    estimate = samples["estimate"]
    known = bool(estimate[NAVIGATION_ESTIMATE.index("initialised")])
    meshcat.SetProperty(f"{world}/estimate", "visible", known, time)
    if known:
        meshcat.SetTransform(
            f"{world}/estimate", aircraft_pose(estimate, NAVIGATION_ESTIMATE), time
        )

    def ray(name: str, start: np.ndarray, direction: np.ndarray, length: float) -> None:
        turn = RotationMatrix.MakeFromOneVector(direction, 2)
        meshcat.SetTransform(f"{world}/{name}", RigidTransform(turn, start), time)
        meshcat.SetProperty(f"{world}/{name}/length", "scale", [1.0, 1.0, length], time)

    station = _ENU_FROM_NED @ runway.ground_station_n()
    antenna = samples["antenna"]
    heard = antenna[ANTENNA.index("valid")] > 0.0
    meshcat.SetProperty(f"{world}/antenna/length", "visible", bool(heard), time)
    if heard:
        azimuth, elevation = antenna[ANTENNA.index("azimuth") :][:2]
        flat = math.cos(elevation)
        towards = np.array(
            [flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(elevation)]
        )
        ray("antenna", station, towards, float(np.linalg.norm(body.translation() - station)))
    picture = samples["picture"]
    locked = picture[PICTURE.index("valid")] > 0.0
    meshcat.SetProperty(f"{world}/sight", "visible", bool(locked), time)
    if locked:
        bearing, down = angles_from_pixel(
            picture[PICTURE.index("u")], picture[PICTURE.index("v")], lens.optics
        )
        flat = math.cos(down)
        in_camera = np.array([flat * math.cos(bearing), flat * math.sin(bearing), math.sin(down)])
        towards = body.rotation().matrix() @ rotation(*lens.mounting) @ in_camera
        eye = body.multiply(lens.position)
        ray("sight", eye, towards, float(np.linalg.norm(eye)))


def in_picture(points: np.ndarray, runway: RunwayConfig) -> np.ndarray:
    """East, north and up (m) of rows in the runway's frame, shape (n, 3)."""
    ned = [ned_from_runway(point, runway.heading_radians) for point in points]
    return np.array(ned).reshape(-1, 3) @ _ENU_FROM_NED.T

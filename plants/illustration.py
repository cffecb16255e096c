"""What the world looks like: a multirotor, its pad, LED beacons and the ground, for Meshcat.

Pictures only; no sensor sees these shapes. `draw` puts them into a `Meshcat`
once and `move` poses them; `add_illustration` registers them with a SceneGraph
and wires the poses, so that Drake's `MeshcatVisualizer` records them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakePhongIllustrationProperties,
    Meshcat,
    Rgba,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from plants.pads import MARKER_CELLS, MARKER_DICTIONARY, NestedMarkerConfig, PadConfig
from plants.svgs_beacons import BEACON_NAMES, COLOURS, SvgsBeaconsConfig
from plants.vehicles import Vehicle
from systems.signals.measurement import BODY_STATE, PAD_STATE

# Of every vehicle
CARBON = Rgba(0.12, 0.13, 0.15, 1.0)
FRONT = Rgba(0.93, 0.33, 0.12, 1.0)
RUBBER = Rgba(0.05, 0.05, 0.05, 1.0)

_SHELL = Rgba(0.86, 0.88, 0.90, 1.0)
_METAL = Rgba(0.55, 0.57, 0.60, 1.0)
_REAR = Rgba(0.16, 0.42, 0.70, 1.0)
_BATTERY = Rgba(0.93, 0.73, 0.16, 1.0)
_GRASS = Rgba(0.45, 0.55, 0.38, 1.0)
_BOARD = Rgba(0.97, 0.97, 0.96, 1.0)
_INK = Rgba(0.03, 0.03, 0.03, 1.0)
_BEACON = Rgba(0.75, 0.08, 0.25, 1.0)
_RELIEF = 0.001  # m, height of one printed layer over the one below
_BOARD_THICKNESS = 0.02  # m
_GLOW = 2.0  # drawn radius of an LED over its own, to be seen from some metres away
# m, opacity: of the edges between a beacon's LEDs, which show what belongs together; nothing stands
# there for a vehicle to hit
_EDGE_RADIUS, _EDGE_OPACITY = 0.008, 0.35


@dataclass(frozen=True)
class Piece:
    """One coloured shape of a picture, posed in its frame."""

    name: str
    shape: Shape
    pose: RigidTransform
    colour: Rgba


def _at(x: float, y: float, z: float) -> RigidTransform:
    p: Any = np.array([x, y, z])
    return RigidTransform(p)


def _rod(
    name: str, start: np.ndarray[Any, Any], end: np.ndarray[Any, Any], radius: float, colour: Rgba
) -> Piece:
    """A capsule from `start` to `end`."""
    along = end - start
    length = float(np.linalg.norm(along))
    turn = RotationMatrix.MakeFromOneVector(along / length, 2)
    pose = RigidTransform(turn, 0.5 * (start + end))
    return Piece(name, Capsule(radius, length), pose, colour)


def vehicle_pieces(vehicle: Vehicle) -> list[Piece]:
    """The multirotor in B: hull, arms, motors, propeller discs (orange in front) and legs."""
    hubs = np.array(vehicle.rotor_positions)
    span = float(np.max(np.hypot(hubs[:, 0], hubs[:, 1])))
    deck = float(np.mean(hubs[:, 2])) - 0.02
    hull = 0.3 * span
    pieces = [
        Piece("hull", Ellipsoid(hull, 0.85 * hull, 0.42 * hull), _at(0, 0, deck), _SHELL),
        Piece("plate", Cylinder(1.1 * hull, 0.008), _at(0, 0, deck), CARBON),
        Piece(
            "battery",
            Box(1.3 * hull, 0.6 * hull, 0.3 * hull),
            _at(-0.1 * hull, 0, deck + 0.45 * hull),
            _BATTERY,
        ),
        Piece("nose", Sphere(0.22 * hull), _at(0.92 * hull, 0, deck), FRONT),
        Piece("mast", Cylinder(0.006, 0.6 * hull), _at(-0.8 * hull, 0, deck + 0.5 * hull), CARBON),
        Piece("gnss", Cylinder(0.25 * hull, 0.02), _at(-0.8 * hull, 0, deck + 0.8 * hull), CARBON),
        Piece("cameras", Box(0.05, 0.07, 0.03), _at(0, 0, deck - 0.5 * hull), _INK),
    ]
    for i, hub in enumerate(hubs):
        colour = FRONT if hub[0] > 0.3 * span else _REAR
        disc = Rgba(colour.r(), colour.g(), colour.b(), 0.28)
        foot = np.array([0.0, 0.0, deck])
        end = np.array([hub[0], hub[1], deck])
        pieces += [
            _rod(f"arm{i}", foot, end, 0.022 * span + 0.004, CARBON),
            Piece(f"motor{i}", Cylinder(0.014 + 0.02 * span, 0.035), _at(*end), _METAL),
            Piece(f"disc{i}", Cylinder(vehicle.rotor_radius, 0.003), _at(*hub), disc),
            Piece(f"cap{i}", Cylinder(0.012, 0.014), _at(*hub), colour),
        ]
    feet = np.array(vehicle.feet)
    for i, foot in enumerate(feet):
        top = np.array([0.45 * foot[0], 0.45 * foot[1], deck - 0.02])
        pieces.append(_rod(f"leg{i}", top, foot + np.array([0.0, 0.0, 0.012]), 0.008, CARBON))
    for side in (1.0, -1.0):
        skid = feet[feet[:, 1] * side > 0.0]
        if len(skid) >= 2:
            first, last = skid[np.argmax(skid[:, 0])], skid[np.argmin(skid[:, 0])]
            over = np.array([0.05, 0.0, 0.0])
            lift = np.array([0.0, 0.0, 0.01])
            name = "skid_left" if side > 0.0 else "skid_right"
            pieces.append(_rod(name, first + over + lift, last - over + lift, 0.01, RUBBER))
    return pieces


def _white_runs(marker_id: int) -> Iterable[tuple[int, int, int]]:
    """The white cells of an ArUco marker as runs: row from the top, first column, length."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARY))
    cells = cv2.aruco.generateImageMarker(dictionary, marker_id, MARKER_CELLS) > 127
    for row in range(MARKER_CELLS):
        column = 0
        while column < MARKER_CELLS:
            first = column
            while column < MARKER_CELLS and cells[row, column]:
                column += 1
            if column > first:
                yield row, first, column - first
            column += 1


def marker_pieces(marker: NestedMarkerConfig) -> list[Piece]:
    """The nested marker in P: every level a black square with white cells on it."""
    pieces = []
    for depth, level in enumerate(marker.levels):
        z = (2 * depth + 0.5) * _RELIEF
        black = Box(level.side, level.side, _RELIEF)
        pieces.append(Piece(f"level{depth}", black, _at(0, 0, z), _INK))
        cell = level.side / MARKER_CELLS
        for k, (row, column, length) in enumerate(_white_runs(level.id)):
            x = (column + 0.5 * length) * cell - 0.5 * level.side
            y = 0.5 * level.side - (row + 0.5) * cell
            white = Box(length * cell, cell, _RELIEF)
            pose = _at(x, y, z + _RELIEF)
            pieces.append(Piece(f"level{depth}_white{k}", white, pose, _BOARD))
    return pieces


def pad_pieces(pad: PadConfig, svgs_beacons: SvgsBeaconsConfig | None = None) -> list[Piece]:
    """The pad in P: a white board with a coloured rim, its marker, beacon and LED beacons."""
    side = max(pad.side, 0.1)
    middle = -0.5 * _BOARD_THICKNESS
    pieces = [
        Piece("board", Box(side, side, _BOARD_THICKNESS), _at(0, 0, middle), _BOARD),
        Piece("rim", Box(1.06 * side, 1.06 * side, 0.018), _at(0, 0, middle - 0.002), FRONT),
    ]
    if pad.marker is not None:
        pieces += marker_pieces(pad.marker)
    if pad.beacon is not None:
        x, y, z = pad.beacon.position
        pieces.append(Piece("beacon", Cylinder(0.006, 0.008), _at(x, y, z + 0.008), _BEACON))
    if svgs_beacons is not None:
        pieces += svgs_pieces(svgs_beacons)
    return pieces


def svgs_pieces(beacons: SvgsBeaconsConfig) -> list[Piece]:
    """The SVGS beacons in P: tetrahedra of LEDs in their colours, and the false lights."""
    pieces = []
    for name, beacon in zip(BEACON_NAMES, beacons.beacons(), strict=True):
        colour, leds = Rgba(*COLOURS[beacon.colour], 1.0), beacon.led_positions_in_pad()
        edge = Rgba(colour.r(), colour.g(), colour.b(), _EDGE_OPACITY)
        lamp = Sphere(_GLOW * beacon.lamp_radius)
        pieces += [Piece(f"{name}_led{i}", lamp, _at(*led), colour) for i, led in enumerate(leds)]
        pieces += [
            _rod(f"{name}_edge{i}{j}", leds[i], leds[j], _EDGE_RADIUS, edge)
            for i, j in combinations(range(len(leds)), 2)
        ]
    for i, glint in enumerate(beacons.glints):
        colour, light = Rgba(*COLOURS[glint.colour], 1.0), Sphere(_GLOW * glint.radius)
        pieces.append(Piece(f"glint{i}", light, _at(*glint.position), colour))
    return pieces


def ground_pieces(size: float = 60.0) -> list[Piece]:
    """The ground in W: a lawn a little under z = 0 with a line every ten metres."""
    top = -_BOARD_THICKNESS - 0.005
    pieces = [Piece("lawn", Box(size, size, 0.1), _at(0, 0, top - 0.05), _GRASS)]
    line = Rgba(0.40, 0.50, 0.34, 1.0)
    for k in range(-int(size / 20), int(size / 20) + 1):
        pieces += [
            Piece(f"east{k}", Box(size, 0.05, 0.002), _at(0, 10.0 * k, top), line),
            Piece(f"north{k}", Box(0.05, size, 0.002), _at(10.0 * k, 0, top), line),
        ]
    return pieces


def body_pose(body: np.ndarray[Any, Any]) -> RigidTransform:
    """X_WB of a `BODY_STATE`."""
    q = body[BODY_STATE.slice("q_WB")]
    p: Any = body[BODY_STATE.slice("p_WB")]
    return RigidTransform(Quaternion(q / np.linalg.norm(q)), p)


def pad_pose(pad: np.ndarray[Any, Any]) -> RigidTransform:
    """X_WP of a `PAD_STATE`."""
    turn = RotationMatrix.MakeZRotation(pad[PAD_STATE.index("yaw")])
    p: Any = pad[PAD_STATE.slice("p_WP")]
    return RigidTransform(turn, p)


def draw(
    meshcat: Meshcat,
    vehicle: Vehicle,
    pad: PadConfig,
    path: str = "/plumbline",
    svgs_beacons: SvgsBeaconsConfig | None = None,
) -> None:
    """Draw ground, pad and vehicle into `meshcat` below `path`; pose them with `move`."""
    groups = {
        "ground": ground_pieces(),
        "pad": pad_pieces(pad, svgs_beacons),
        "multirotor": vehicle_pieces(vehicle),
    }
    for group, pieces in groups.items():
        for piece in pieces:
            name = f"{path}/{group}/{piece.name}"
            meshcat.SetObject(name, piece.shape, piece.colour)
            meshcat.SetTransform(name, piece.pose)
    meshcat.SetTransform(f"{path}/pad", pad_pose(pad.state(0.0)))


def move(
    meshcat: Meshcat,
    body: np.ndarray[Any, Any],
    pad: np.ndarray[Any, Any] | None = None,
    time: float | None = None,
    path: str = "/plumbline",
) -> None:
    """Pose what `draw` drew after a `BODY_STATE` and a `PAD_STATE` (None: leave the pad).

    With a `time` (s) the pose is also a frame of a recording, if one is on.
    """
    meshcat.SetTransform(f"{path}/multirotor", body_pose(body), time)
    if pad is not None:
        meshcat.SetTransform(f"{path}/pad", pad_pose(pad), time)


class MultirotorGeometry(LeafSystem):
    """The poses of the multirotor's and the pad's frames, for SceneGraph.

    .. pydrake_system::

        name: MultirotorGeometry
        input_ports:
        - body
        - pad
        output_ports:
        - geometry_pose

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the vehicle |
    | `pad` (optional) | `PAD_STATE` | unconnected: where its configuration has it at t = 0 |
    | `geometry_pose` | FramePoseVector | the poses of both frames in W |

    Registers its source, frames and shapes with the `SceneGraph` it is given.
    It has no state and no events.
    """

    def __init__(
        self,
        scene_graph: SceneGraph,
        vehicle: Vehicle,
        pad: PadConfig,
        svgs_beacons: SvgsBeaconsConfig | None = None,
    ):
        super().__init__()
        self._pad = pad.state(0.0)
        self.source_id = scene_graph.RegisterSource("plumbline")
        self._frames: dict[str, FrameId] = {}
        for group, pieces in (
            ("multirotor", vehicle_pieces(vehicle)),
            ("pad", pad_pieces(pad, svgs_beacons)),
        ):
            frame = scene_graph.RegisterFrame(self.source_id, GeometryFrame(group))
            self._frames[group] = frame
            for piece in pieces:
                scene_graph.RegisterGeometry(self.source_id, frame, _instance(piece, group))
        for piece in ground_pieces():
            scene_graph.RegisterAnchoredGeometry(self.source_id, _instance(piece, "ground"))
        self.DeclareVectorInputPort("body", BODY_STATE.size)
        self.DeclareVectorInputPort("pad", PAD_STATE.size)
        self.DeclareAbstractOutputPort(
            "geometry_pose",
            lambda: AbstractValue.Make(FramePoseVector()),
            self._calc_poses,
            {self.GetInputPort(name).ticket() for name in ("body", "pad")},
        )

    def _calc_poses(self, context: Any, output: Any) -> None:
        pad = self.EvalVectorInput(context, 1)
        poses = FramePoseVector()
        poses.set_value(
            self._frames["multirotor"], body_pose(self.EvalVectorInput(context, 0).get_value())
        )
        poses.set_value(
            self._frames["pad"], pad_pose(self._pad if pad is None else pad.get_value())
        )
        output.set_value(poses)


def _instance(piece: Piece, group: str) -> GeometryInstance:
    instance = GeometryInstance(piece.pose, piece.shape, f"{group}_{piece.name}")
    colour = piece.colour
    rgba: Any = np.array([colour.r(), colour.g(), colour.b(), colour.a()])
    instance.set_illustration_properties(MakePhongIllustrationProperties(rgba))
    return instance


def add_illustration(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    vehicle: Vehicle,
    pad: PadConfig,
    body: OutputPort,
    pad_port: OutputPort | None = None,
    name: str = "illustration",
    svgs_beacons: SvgsBeaconsConfig | None = None,
) -> MultirotorGeometry:
    """Show the vehicle of port `body` (and the pad of `pad_port`) in `scene_graph`."""
    system = MultirotorGeometry(scene_graph, vehicle, pad, svgs_beacons)
    builder.AddNamedSystem(name, system)
    builder.Connect(body, system.GetInputPort("body"))
    if pad_port is not None:
        builder.Connect(pad_port, system.GetInputPort("pad"))
    builder.Connect(
        system.GetOutputPort("geometry_pose"),
        scene_graph.get_source_pose_port(system.source_id),
    )
    return system

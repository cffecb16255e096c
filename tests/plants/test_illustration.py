"""The picture: its marker is read by OpenCV, its frames follow the states, Meshcat gets it."""

import cv2
import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    SceneGraph,
    Sphere,
    StartMeshcat,
)
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from plants import illustration
from plants.multirotor import MultirotorConfig
from plants.pads import NestedMarkerConfig, Pad, PadConfig
from plants.svgs_beacons import COLOURS, SvgsBeaconsConfig, SvgsGlint
from plants.vehicles import VEHICLES, vehicle_named
from systems.frames import quaternion_from_yaw
from systems.signals.measurement import BODY_STATE
from tests.system_contract import assert_matches_docstring


def paint(pieces, extent: float, pixels: int) -> np.ndarray:
    """Boxes from above, the lowest first, as a grey picture of `extent` metres a side."""
    image = np.full((pixels, pixels), 255, np.uint8)
    for piece in sorted(pieces, key=lambda piece: piece.pose.translation()[2]):
        assert isinstance(piece.shape, Box)
        half = 0.5 * np.array([piece.shape.width(), piece.shape.depth()])
        corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half
        corners = corners @ piece.pose.rotation().matrix()[:2, :2].T + piece.pose.translation()[:2]
        pixel = np.array([1, -1]) * corners * pixels / extent + 0.5 * pixels
        colour = int(255 * piece.colour.g())
        cv2.fillConvexPoly(image, np.round(16 * (pixel - 0.5)).astype(int), colour, cv2.LINE_8, 4)
    return image


def test_opencv_reads_every_level_with_its_corners():
    marker = NestedMarkerConfig()
    pieces = illustration.marker_pieces(marker)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    for level, (marker_id, side) in enumerate(zip(marker.ids(), marker.sides(), strict=True)):
        # OpenCV keeps only the innermost of nested markers: look at one level's boxes at a time.
        own = [piece for piece in pieces if piece.name.startswith(f"level{level}")]
        image = paint(own, extent=2.0 * side, pixels=400)
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
        assert np.ravel(ids).tolist() == [marker_id]
        found = (np.reshape(corners, (4, 2)) - 199.5) * [1, -1] * 2.0 * side / 400
        np.testing.assert_allclose(found, marker.corners()[level, :, :2], atol=side / 100)


def test_inner_levels_lie_on_outer_ones():
    pieces = illustration.marker_pieces(NestedMarkerConfig())
    heights = {piece.name: piece.pose.translation()[2] for piece in pieces}
    assert heights["level0"] < heights["level0_white0"] < heights["level1"]
    assert heights["level1"] < heights["level1_white0"] < heights["level2"]


def test_svgs_beacons_are_tetrahedra_of_leds_in_their_colours():
    beacons = SvgsBeaconsConfig(glints=[SvgsGlint(position=[1.0, 2.0, 0.3], colour="red")])
    beacons.medium.yaw = 0.4
    pieces = illustration.svgs_pieces(beacons)
    assert len({piece.name for piece in pieces}) == len(pieces)
    lights = [piece for piece in pieces if isinstance(piece.shape, Sphere)]
    lamps = beacons.lamps()  # what the camera sees: place, light
    np.testing.assert_allclose([piece.pose.translation() for piece in lights], lamps[:, :3])
    drawn = [[piece.colour.r(), piece.colour.g(), piece.colour.b()] for piece in lights]
    np.testing.assert_allclose(drawn, lamps[:, 3:6])
    assert drawn[0] == list(COLOURS["yellow"])
    # The six edges of a beacon, each from one LED to another.
    leds = beacons.medium.led_positions_in_pad()
    edges = {piece.name: piece for piece in pieces if isinstance(piece.shape, Capsule)}
    assert len(edges) == 3 * 6
    for i in range(4):
        for j in range(i + 1, 4):
            edge = edges[f"medium_edge{i}{j}"]
            assert edge.shape.length() == pytest.approx(np.linalg.norm(leds[j] - leds[i]))
            half = 0.5 * edge.shape.length() * edge.pose.rotation().col(2)
            np.testing.assert_allclose(edge.pose.translation() + half, leds[j], atol=1e-12)


def test_a_pad_shows_what_it_has():
    names = {piece.name for piece in illustration.pad_pieces(PadConfig(marker=None, beacon=None))}
    assert names == {"board", "rim"}
    pieces = illustration.pad_pieces(PadConfig(marker=None), SvgsBeaconsConfig())
    names = {piece.name for piece in pieces}
    assert names >= {"board", "beacon", "short_led0", "medium_led3", "long_led3"}
    assert not [name for name in names if name.startswith("level")]


@pytest.mark.parametrize("name", VEHICLES)
def test_the_vehicle_has_a_disc_a_rotor_and_the_front_ones_stand_out(name: str):
    vehicle = vehicle_named(name)
    pieces = illustration.vehicle_pieces(vehicle)
    assert len({piece.name for piece in pieces}) == len(pieces)
    discs = [piece for piece in pieces if piece.name.startswith("disc")]
    assert len(discs) == vehicle.rotor_count
    for disc, hub in zip(discs, vehicle.rotor_positions, strict=True):
        assert isinstance(disc.shape, Cylinder)
        assert disc.shape.radius() == vehicle.rotor_radius
        np.testing.assert_allclose(disc.pose.translation(), hub)
    red = [disc.colour.r() > disc.colour.b() for disc in discs]
    ahead = [hub[0] > 0.1 for hub in vehicle.rotor_positions]
    assert red == ahead
    assert any(red)
    assert not all(red)
    lowest = min(piece.pose.translation()[2] for piece in pieces)
    assert lowest > min(foot[2] for foot in vehicle.feet)


@pytest.fixture(scope="module")
def meshcat():
    return StartMeshcat()


def test_scene_graph_and_meshcat_follow_the_states(meshcat):
    meshcat.Delete()
    body = BODY_STATE.zeros()
    body[:4] = quaternion_from_yaw(0.5)
    body[4:7] = 1.0, 2.0, 3.0
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    config = PadConfig(position=[4.0, 0.0, 0.5], velocity=[1.0, 0.0, 0.0])
    source = builder.AddSystem(ConstantVectorSource(body))
    pad = config.add_to(builder, "pad")
    assert isinstance(pad, Pad)
    geometry = illustration.add_illustration(
        builder,
        scene_graph,
        vehicle_named("thesis_hexacopter"),
        config,
        source.get_output_port(),
        pad.GetOutputPort("pad"),
    )
    contract = assert_matches_docstring(geometry)
    assert contract.optional == {"pad"}
    parameters = MeshcatVisualizerParams()
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    context.SetTime(2.0)
    diagram.ForcedPublish(context)
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    poses = {
        query.inspector().GetName(frame): query.GetPoseInWorld(frame)
        for frame in query.inspector().GetAllFrameIds()
    }
    np.testing.assert_allclose(poses["multirotor"].translation(), [1.0, 2.0, 3.0])
    assert poses["multirotor"].rotation().ToRollPitchYaw().yaw_angle() == pytest.approx(0.5)
    np.testing.assert_allclose(poses["pad"].translation(), [6.0, 0.0, 0.5])
    assert meshcat.HasPath("/drake/visualizer/multirotor")
    assert meshcat.HasPath("/drake/visualizer/pad")


def test_drawn_directly_into_meshcat(meshcat):
    meshcat.Delete()
    config = MultirotorConfig(vehicle="dr_spider", position=[0.0, 1.0, 2.0], flying=True)
    pad = PadConfig(beacon=None)
    illustration.draw(meshcat, config.resolved_vehicle(), pad)
    illustration.move(meshcat, config.initial_body(), pad.state(0.0))
    assert meshcat.HasPath("/plumbline/multirotor/disc7")
    assert meshcat.HasPath("/plumbline/pad/level2")
    assert not meshcat.HasPath("/plumbline/pad/beacon")
    assert len(meshcat.StaticHtml()) > 1_000_000

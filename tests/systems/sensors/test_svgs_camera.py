"""The SVGS camera: ports, rate, both fidelities, exposure, images."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from benchmarks.svgs_camera import fly
from plants.svgs_beacons import SvgsBeaconsConfig
from systems.frames import rotation_matrix
from systems.schedule import CLOCK_PERIOD
from systems.sensors.svgs_camera import SvgsCamera, SvgsCameraConfig
from systems.signals.measurement import BODY_STATE, SVGS
from systems.vision import svgs_selection as selection
from systems.vision.svgs_drawing import draw_svgs_detection
from tests.system_contract import assert_matches_docstring, periodic_update

SHORT, MEDIUM, LONG = range(3)


def body_at(height: float, x: float = -3.2, y: float = -1.5, rate: float = 0.0) -> np.ndarray:
    body = BODY_STATE(BODY_STATE.zeros())
    body.q_WB_w = 1.0
    body.p_WB_x, body.p_WB_y, body.p_WB_z = x, y, height
    body.w_WB_B_x = rate
    return np.asarray(body[:])


class Run:
    """A camera over a vehicle at rest for some seconds."""

    def __init__(self, config: SvgsCameraConfig, body: np.ndarray, duration: float, seed: int = 1):
        builder = DiagramBuilder()
        self.camera = config.add_to(builder, "camera", seed)
        source = builder.AddSystem(ConstantVectorSource(body))
        builder.Connect(source.get_output_port(), self.camera.GetInputPort("body"))
        log = LogVectorOutput(self.camera.GetOutputPort("measurement"), builder, CLOCK_PERIOD)
        simulator = Simulator(builder.Build())
        simulator.AdvanceTo(duration)
        context = simulator.get_context()
        self.context = self.camera.GetMyContextFromRoot(context)
        rows = log.FindLog(context).data().T
        first = np.flatnonzero(np.diff(rows[:, 1], prepend=-2.0) != 0.0)
        self.rows = rows[first][rows[first, 1] >= 0.0]
        self.measurements = [SVGS(row) for row in self.rows]


def true_pose(camera: SvgsCamera, body: np.ndarray, beacon: int) -> np.ndarray:
    """The beacon's origin in the camera's frame, m."""
    R_WC = rotation_matrix(body[:4]) @ camera.X_BC[:, :3]
    p_WC = body[4:7] + rotation_matrix(body[:4]) @ camera.X_BC[:, 3]
    return R_WC.T @ (camera.config.beacons.placements()[beacon, :3] - p_WC)


def test_topology():
    camera = SvgsCamera(SvgsCameraConfig())
    assert_matches_docstring(camera)
    assert periodic_update(camera) == (CLOCK_PERIOD, 0.0)


def test_initial_state():
    camera = SvgsCamera(SvgsCameraConfig())
    context = camera.CreateDefaultContext()
    view = SVGS(camera.GetOutputPort("measurement").Eval(context))
    assert (view.valid, view.sequence_number, view.beacon) == (0.0, -1.0, -1.0)
    assert camera.GetOutputPort("image").Eval(context).shape == (800, 800, 3)


@pytest.mark.parametrize("fidelity", ["geometric", "pixels"])
@pytest.mark.parametrize(("height", "beacon"), [(150.0, LONG), (12.0, SHORT), (9.0, MEDIUM)])
def test_pose_of_a_beacon(fidelity, height, beacon):
    beacons = SvgsBeaconsConfig()
    body = body_at(height, x=-1.7, y=0.0) if beacon == SHORT else body_at(height)
    # The others stand far away.
    for other in {"short", "medium", "long"} - {("short", "medium", "long")[beacon]}:
        getattr(beacons, other).position = [1000.0, 0.0, 0.0]
    run = Run(SvgsCameraConfig(fidelity=fidelity, beacons=beacons), body, 1.0)
    valid = [m for m in run.measurements if m.valid and m.beacon == beacon]
    assert len(valid) >= 5
    errors = [
        np.array([m.p_CT_x, m.p_CT_y, m.p_CT_z]) - true_pose(run.camera, body, beacon)
        for m in valid
    ]
    sigma = np.sqrt([[m.covariance_00, m.covariance_11, m.covariance_22] for m in valid])
    assert np.abs(np.array(errors) / sigma).max() < 5.0
    assert np.max(np.abs(errors)) < 0.005 * height


@pytest.mark.parametrize(("height", "slowest", "fastest"), [(150.0, 13.0, 15.5), (25.0, 6.0, 11.0)])
def test_rate_depends_on_the_number_of_blobs(height, slowest, fastest):
    run = Run(SvgsCameraConfig(), body_at(height), 8.0)
    times = run.rows[:, 1]
    assert slowest < (len(times) - 1) / (times[-1] - times[0]) < fastest
    periods = np.diff(times)
    ticks = periods / CLOCK_PERIOD
    np.testing.assert_allclose(ticks, np.rint(ticks), atol=1e-6)
    assert len(set(np.rint(ticks))) > 1  # it is not deterministic
    assert np.all(np.diff(run.rows[:, 2]) == 1.0)


def test_glints_slow_the_phone_down():
    run = Run(SvgsCameraConfig(random_glints=12), body_at(150.0), 8.0)
    assert 5.0 < len(run.rows) / 8.0 < 9.0
    assert max(m.blob_count for m in run.measurements) >= 15


def test_same_seed_same_measurements():
    def rows(seed):
        return Run(SvgsCameraConfig(random_glints=3), body_at(100.0), 2.0, seed).rows

    first = rows(7)
    np.testing.assert_array_equal(first, rows(7))
    assert first.shape != rows(8).shape or np.any(first != rows(8))


def test_validity_is_the_middle_of_the_exposure():
    run = Run(SvgsCameraConfig(), body_at(150.0), 1.0)
    np.testing.assert_allclose(run.rows[:, 1] - run.rows[:, 0], 0.004)
    # Close to the LEDs the exposure gets shorter.
    near = Run(SvgsCameraConfig(), body_at(1.0, x=-1.7, y=0.0), 3.0)
    assert near.rows[-1, 1] - near.rows[-1, 0] < 0.0039


def test_nothing_in_view_is_an_error_code():
    run = Run(SvgsCameraConfig(), body_at(50.0, x=150.0), 1.0)
    assert {m.error_code for m in run.measurements} == {selection.NO_BLOBS}
    assert not any(m.valid for m in run.measurements)


@pytest.mark.parametrize("fidelity", ["geometric", "pixels"])
def test_image_is_rendered_again(fidelity):
    run = Run(SvgsCameraConfig(fidelity=fidelity), body_at(60.0), 0.5)
    image = run.camera.GetOutputPort("image").Eval(run.context)
    assert image.shape == (800, 800, 3)
    view = run.measurements[-1]
    u, v = round(view.led_3_u), round(view.led_3_v)
    blue, green, red = image[v, u].astype(int)
    brightest = {MEDIUM: red, LONG: green}[int(view.beacon)]
    assert brightest == max(blue, green, red) > 100
    np.testing.assert_array_equal(image, run.camera.GetOutputPort("image").Eval(run.context))
    drawing = draw_svgs_detection(image, run.rows[-1], width=640)
    assert drawing.shape == (640, 640, 3)
    lost = run.rows[-1].copy()
    lost[3], lost[SVGS.index("error_code")] = 0.0, selection.AMBIGUOUS
    assert np.any(draw_svgs_detection(image, lost, width=640) != drawing)


@pytest.mark.parametrize("variant", selection.VARIANTS)
def test_fidelities_agree_in_flight(variant):
    """Rate of poses and their spread in range, with a turning vehicle."""
    spread, rate = {}, {}
    for fidelity in ("geometric", "pixels"):
        config = SvgsCameraConfig(fidelity=fidelity, variant=variant)
        run = Run(config, body_at(160.0, rate=0.2), 5.0)
        depth = [m.p_CT_z for m in run.measurements if m.valid]
        spread[fidelity], rate[fidelity] = np.std(depth), len(depth) / len(run.rows)
    assert rate["geometric"] == pytest.approx(rate["pixels"], abs=0.05)
    assert 0.4 < spread["geometric"] / spread["pixels"] < 2.5


def test_configure_changes_everything():
    run = Run(SvgsCameraConfig(), body_at(150.0), 0.5)
    run.camera.configure(SvgsCameraConfig(focal_length=700.0, variant="published"), 3)
    assert run.camera.camera[2] == 700.0


@pytest.mark.slow
def test_ten_thousand_frames_among_glints():
    """Up to twelve glints of the beacon's colour: a pose in 99 % of frames, never a wrong one."""
    right = wrong = count = 0
    for height in (60.0, 90.0, 120.0, 150.0, 190.0):
        for glints in (4, 12):
            config = SvgsCameraConfig(random_glints=glints, glint_beacon="long")
            flown = fly(config, height, 1000, seed=glints)
            right, wrong, count = right + flown.right, wrong + flown.wrong, count + flown.count
    assert count == 10_000
    assert wrong == 0
    assert right >= 0.99 * count


def test_right_among_glints_in_images():
    config = SvgsCameraConfig(fidelity="pixels", random_glints=12, glint_beacon="long")
    flown = fly(config, 120.0, 150)
    assert flown.wrong == 0
    assert flown.right >= 0.97 * flown.count  # the first frame of a track is never a pose

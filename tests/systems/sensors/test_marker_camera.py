"""The marker camera as a system: ports, timing, both fidelities, its image."""

import numpy as np
import pytest
from pydantic import ValidationError
from pydrake.systems.analysis import Simulator

from systems.schedule import CLOCK_PERIOD
from systems.sensors.marker_camera import MarkerCamera, MarkerCameraConfig
from systems.signals.measurement import BODY_STATE, MARKER, PAD_STATE, VALID, no_measurement
from systems.vision.planar_pose import pad_position_from_marker
from tests.system_contract import assert_matches_docstring, periodic_update
from tests.systems.sensors.camera_bench import FIDELITIES, body, measurements, simulated


def marker(seed=1, **fields) -> MarkerCamera:
    return MarkerCamera(MarkerCameraConfig(**fields), seed)


def test_topology():
    camera = marker()
    contract = assert_matches_docstring(camera)
    assert contract.optional == {"pad"}
    assert periodic_update(camera) == (CLOCK_PERIOD, 0.0)


def test_before_the_first_frame():
    _, read = simulated(marker(), body=body())
    np.testing.assert_array_equal(read("measurement"), no_measurement(MARKER))
    np.testing.assert_array_equal(read("image"), np.zeros((480, 640), np.uint8))


def test_header():
    """Thirty frames a second on the grid, valid at the middle of an exposure that ends then."""
    rows = measurements(marker(exposure_time=0.006), body(), 2.0)
    assert len(rows) == 60
    np.testing.assert_array_equal(rows[:, 2], np.arange(60))
    np.testing.assert_allclose(rows[:, 1] - rows[:, 0], 0.003, atol=1e-12)
    ticks = rows[:, 1] / CLOCK_PERIOD
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-9)
    late = rows[:, 1] - np.arange(60) / 30.0
    assert np.all((late > -1e-9) & (late < CLOCK_PERIOD))


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_the_pad_s_position(fidelity):
    """To a few millimetres at 4 m, by the vehicle's attitude and the mount."""
    config = MarkerCameraConfig(fidelity=fidelity, position=[0.1, -0.05, -0.1], yaw=0.5)
    pad = PAD_STATE.zeros()
    pad[:4] = [0.3, -0.2, 0.1, 0.8]
    state = body()
    camera = MarkerCamera(config, seed=1)
    simulator, read = simulated(camera, body=state, pad=pad)
    simulator.AdvanceTo(0.1)
    measurement = read("measurement")
    assert measurement[VALID] == 1.0
    result = pad_position_from_marker(measurement, state[:4], camera.X_BC)
    error = result[:3] - (pad[:3] - state[BODY_STATE.slice("p_WB")])
    assert np.abs(error[:2]).max() < 0.002
    assert abs(error[2]) < 0.005
    assert np.sqrt(result[8]) < 0.005


def test_the_pose_is_taken_back_to_the_middle_of_the_exposure():
    """At 3 m/s and 8 ms of exposure the vehicle was 12 mm further back."""
    config = MarkerCameraConfig(exposure_time=0.008)
    moving = measurements(MarkerCamera(config, seed=1), body(v_WB=(3.0, 0.0, 0.0)), 1.0)
    still = measurements(MarkerCamera(config, seed=1), body(), 1.0)
    forward = np.array([pad_position_from_marker(m, body()[:4], MarkerCamera(config).X_BC)[0]
                        for m in (*moving, *still)])  # fmt: skip
    shift = forward[:30].mean() - forward[30:].mean()
    assert shift == pytest.approx(0.012, abs=0.002)


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_out_of_view_is_a_measurement_that_is_not_valid(fidelity):
    rows = measurements(marker(fidelity=fidelity), body((20.0, 0.0, 4.0)), 0.2)
    assert len(rows) == 6
    np.testing.assert_array_equal(rows[:, VALID], 0.0)
    assert np.isnan(rows[:, MARKER.index("corner_0_0_u") :]).all()


def test_the_image_is_what_was_detected_in():
    """Rendered again on demand: the corners measured lie on its edges, in both fidelities."""
    images = []
    for fidelity in FIDELITIES:
        simulator, read = simulated(marker(fidelity=fidelity), body=body())
        simulator.AdvanceTo(0.1)
        images.append(read("image").copy())
        u, v = read("measurement")[MARKER.index("corner_0_0_u") :][:2]
        outside = images[-1][round(v) - 4 : round(v) + 5, round(u) - 4 : round(u) + 5]
        assert outside.max() > 130
        assert outside.min() < 40
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_same_seed_same_measurements(fidelity):
    config = MarkerCameraConfig(fidelity=fidelity)
    first, again, other = (
        measurements(MarkerCamera(config, seed), body(), 0.3) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[:, 4:], other[:, 4:], equal_nan=True)


def test_a_run_resumed_from_its_state_goes_on_alike():
    simulator, read = simulated(marker(fidelity="pixels"), body=body())
    simulator.AdvanceTo(0.1)
    context = simulator.get_context().Clone()
    simulator.AdvanceTo(0.3)
    expected = np.array(read("measurement"))
    resumed = Simulator(simulator.get_system(), context)
    resumed.AdvanceTo(0.3)
    camera = simulator.get_system().GetSubsystemByName("camera")
    found = camera.GetOutputPort("measurement").Eval(camera.GetMyContextFromRoot(context))
    np.testing.assert_array_equal(found, expected)


def test_configure_changes_everything():
    camera = marker()
    camera.configure(
        MarkerCameraConfig(
            fidelity="pixels", frame_rate=10.0, marker_ids=[3], marker_sides=[0.5], plate_side=0.7
        ),
        seed=2,
    )
    simulator, read = simulated(camera, body=body((0.0, 0.0, 2.0)))
    simulator.AdvanceTo(0.95)
    view = MARKER(read("measurement"))
    assert view.sequence_number == 9.0
    assert view.valid == 1.0
    assert view.range == pytest.approx(1.95, abs=0.003)
    assert np.isnan(view.corner_1_0_u)


@pytest.mark.parametrize(
    ("field", "value"),
    [("frame_rate", 200.0), ("fidelity", "photo"), ("light", 0.0), ("marker_sides", [])],
)
def test_configuration_is_validated(field, value):
    with pytest.raises(ValidationError):
        MarkerCameraConfig(**{field: value})


def test_levels_have_to_fit():
    with pytest.raises(ValueError, match="does not fit into the white centre"):
        marker(marker_sides=[0.8, 0.5, 0.03])

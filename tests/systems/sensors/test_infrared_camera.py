"""The infrared camera as a system: ports, timing, both fidelities, its image."""

import numpy as np
import pytest
from pydantic import ValidationError
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from systems.schedule import CLOCK_PERIOD
from systems.sensors.infrared_camera import FalseBeacon, InfraredCamera, InfraredCameraConfig
from systems.signals.measurement import (
    BODY_STATE,
    INFRARED,
    PAD_STATE,
    TIME_OF_VALIDITY,
    VALID,
    no_measurement,
)
from systems.vision.infrared_blobs import pad_position_from_infrared
from tests.system_contract import assert_matches_docstring, periodic_update

FIDELITIES = ("geometric", "pixels")


def body(p_WB=(0.2, 0.1, 4.0)) -> np.ndarray:
    state = BODY_STATE.zeros()
    state[0] = 1.0
    state[BODY_STATE.slice("p_WB")] = p_WB
    return state


def camera_over_pad(config: InfraredCameraConfig, state, pad=None, seed=1):
    """A simulator, and a function that reads the camera's ports."""
    builder = DiagramBuilder()
    camera = config.add_to(builder, "infrared_camera", seed)
    for port, value in (("body", state), ("pad", pad)):
        if value is not None:
            source = builder.AddSystem(ConstantVectorSource(value))
            builder.Connect(source.get_output_port(), camera.GetInputPort(port))
    simulator = Simulator(builder.Build())

    def read(port: str):
        context = camera.GetMyContextFromRoot(simulator.get_context())
        return camera.GetOutputPort(port).Eval(context)

    return simulator, read


def measurements(config: InfraredCameraConfig, state, duration: float, seed=1) -> np.ndarray:
    """Each measurement of a run, shape (n, INFRARED.size)."""
    simulator, read = camera_over_pad(config, state, seed=seed)
    rows = []
    for tick in range(round(duration / CLOCK_PERIOD)):
        simulator.AdvanceTo((tick + 0.5) * CLOCK_PERIOD)
        rows.append(np.array(read("measurement")))
    rows = np.array(rows)
    return rows[np.flatnonzero(np.diff(rows[:, 1], prepend=-1.0))]


def test_topology():
    camera = InfraredCamera(InfraredCameraConfig())
    contract = assert_matches_docstring(camera)
    assert contract.optional == {"pad"}
    assert periodic_update(camera) == (CLOCK_PERIOD, 0.0)


def test_before_the_first_frame():
    _, read = camera_over_pad(InfraredCameraConfig(), body())
    np.testing.assert_array_equal(read("measurement"), no_measurement(INFRARED))
    np.testing.assert_array_equal(read("image"), np.zeros((200, 320), np.uint8))


def test_fifty_frames_a_second():
    rows = measurements(InfraredCameraConfig(), body(), 2.0)
    assert len(rows) == 100
    np.testing.assert_array_equal(rows[:, 2], np.arange(100))
    np.testing.assert_array_equal(rows[:, 0], rows[:, 1])
    late = rows[:, 1] - np.arange(100) / 50.0
    assert np.all((late > -1e-9) & (late < CLOCK_PERIOD))


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_direction_of_the_beacon(fidelity):
    """To a pixel of 3 mrad, by the vehicle's attitude, its height and the mount."""
    config = InfraredCameraConfig(
        fidelity=fidelity, position=[0.1, -0.05, -0.1], yaw=0.5, beacon_position=[0.2, 0.0, 0.05]
    )
    pad = PAD_STATE.zeros()
    pad[:4] = [0.3, -0.2, 0.1, np.pi / 2]
    state = body()
    simulator, read = camera_over_pad(config, state, pad)
    simulator.AdvanceTo(0.1)
    measurement = read("measurement")
    assert measurement[VALID] == 1.0
    beacon = np.array([0.3, 0.0, 0.15])
    camera = InfraredCamera(config)
    result = pad_position_from_infrared(measurement, state[:4], 4.0 - beacon[2], camera.X_BC)
    error = result[:3] - (beacon - state[BODY_STATE.slice("p_WB")])
    assert np.hypot(*error[:2]) < 1.0 * 0.003 * 3.75
    assert abs(error[2]) < 1e-9


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_range_and_field_of_view(fidelity):
    config = InfraredCameraConfig(fidelity=fidelity)
    far = InfraredCameraConfig(fidelity=fidelity, maximum_range=55.0)
    for settings, place, valid in (
        (config, (0.0, 0.0, 12.0), 1.0),
        (config, (0.0, 0.0, 20.0), 0.0),
        (far, (0.0, 0.0, 45.0), 1.0),
        (config, (4.0, 0.0, 5.0), 0.0),  # the image's height is 33 degrees
        (config, (0.0, 2.0, 5.0), 1.0),  # its width 51
    ):
        rows = measurements(settings, body(place), 0.1)
        np.testing.assert_array_equal(rows[:, VALID], valid, err_msg=f"at {place}")


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_false_beacons(fidelity):
    """A brighter lamp comes first: the camera cannot know better."""
    lamp = FalseBeacon(position=[1.0, 0.5, 0.0], strength=4.0)
    config = InfraredCameraConfig(fidelity=fidelity, false_beacons=[lamp])
    view = INFRARED(measurements(config, body((0.0, 0.0, 5.0)), 0.1)[-1])
    assert view.count == 2.0
    assert view.blob_0_area > view.blob_1_area > 0.0
    # Ahead is up in the image, left is left.
    assert view.blob_0_y == pytest.approx(-1.0 / 4.95, abs=0.003)
    assert view.blob_0_x == pytest.approx(-0.5 / 4.95, abs=0.003)
    assert view.blob_2_area == 0.0


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_a_false_beacon_shines_in_its_time(fidelity):
    lamp = FalseBeacon(position=[1.0, 0.5, 0.0], start_time=0.1, end_time=0.2)
    config = InfraredCameraConfig(fidelity=fidelity, false_beacons=[lamp])
    rows = measurements(config, body((0.0, 0.0, 5.0)), 0.3)
    count, time = rows[:, INFRARED.index("count")], rows[:, TIME_OF_VALIDITY]
    np.testing.assert_array_equal(count, np.where((time >= 0.1) & (time < 0.2), 2.0, 1.0))


@pytest.mark.parametrize("quantised", [True, False])
def test_quantisation(quantised):
    rows = measurements(InfraredCameraConfig(quantised=quantised), body(), 0.5)
    x = rows[:, INFRARED.index("blob_0_x")] / 0.003 + 159.5
    assert np.all(np.abs(x - np.round(x)) < 1e-9) == quantised


def test_the_image_is_the_same_in_both_fidelities():
    images = []
    for fidelity in FIDELITIES:
        simulator, read = camera_over_pad(InfraredCameraConfig(fidelity=fidelity), body())
        simulator.AdvanceTo(0.1)
        images.append(read("image").copy())
        view = INFRARED(read("measurement"))
        u, v = view.blob_0_x / 0.003 + 159.5, view.blob_0_y / 0.003 + 99.5
        assert images[-1][round(v), round(u)] == 255
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_same_seed_same_measurements(fidelity):
    config = InfraredCameraConfig(fidelity=fidelity, quantised=False)
    first, again, other = (measurements(config, body(), 0.2, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_configure_changes_everything():
    camera = InfraredCamera(InfraredCameraConfig(), seed=1)
    camera.configure(InfraredCameraConfig(frame_rate=10.0, maximum_range=55.0), seed=2)
    builder = DiagramBuilder()
    builder.AddSystem(camera)
    source = builder.AddSystem(ConstantVectorSource(body((0.0, 0.0, 40.0))))
    builder.Connect(source.get_output_port(), camera.GetInputPort("body"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.95)
    context = camera.GetMyContextFromRoot(simulator.get_context())
    measurement = camera.GetOutputPort("measurement").Eval(context)
    assert measurement[2] == 9.0
    assert measurement[VALID] == 1.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("frame_rate", 200.0),
        ("maximum_range", 0.0),
        ("false_beacons", [FalseBeacon()] * 16),
        ("fidelity", "photo"),
    ],
)
def test_configuration_is_validated(field, value):
    with pytest.raises(ValidationError):
        InfraredCameraConfig(**{field: value})

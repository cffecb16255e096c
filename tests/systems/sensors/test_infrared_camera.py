"""The infrared camera as a system: ports, timing, both fidelities, its image."""

import numpy as np
import pytest
from pydantic import ValidationError

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
from tests.systems.sensors.camera_bench import FIDELITIES, body, measurements, simulated


def infrared(seed=1, **fields) -> InfraredCamera:
    return InfraredCamera(InfraredCameraConfig(**fields), seed)


def test_topology():
    camera = infrared()
    contract = assert_matches_docstring(camera)
    assert contract.optional == {"pad"}
    assert periodic_update(camera) == (CLOCK_PERIOD, 0.0)


def test_before_the_first_frame():
    _, read = simulated(infrared(), body=body())
    np.testing.assert_array_equal(read("measurement"), no_measurement(INFRARED))
    np.testing.assert_array_equal(read("image"), np.zeros((200, 320), np.uint8))


def test_fifty_frames_a_second():
    rows = measurements(infrared(), body(), 2.0)
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
    camera = InfraredCamera(config, seed=1)
    simulator, read = simulated(camera, body=state, pad=pad)
    simulator.AdvanceTo(0.1)
    measurement = read("measurement")
    assert measurement[VALID] == 1.0
    beacon = np.array([0.3, 0.0, 0.15])
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
        rows = measurements(InfraredCamera(settings, seed=1), body(place), 0.1)
        np.testing.assert_array_equal(rows[:, VALID], valid, err_msg=f"at {place}")


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_false_beacons(fidelity):
    """A brighter lamp comes first: the camera cannot know better."""
    lamp = FalseBeacon(position=[1.0, 0.5, 0.0], strength=4.0)
    config = InfraredCameraConfig(fidelity=fidelity, false_beacons=[lamp])
    view = INFRARED(measurements(InfraredCamera(config, seed=1), body((0.0, 0.0, 5.0)), 0.1)[-1])
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
    rows = measurements(InfraredCamera(config, seed=1), body((0.0, 0.0, 5.0)), 0.3)
    count, time = rows[:, INFRARED.index("count")], rows[:, TIME_OF_VALIDITY]
    np.testing.assert_array_equal(count, np.where((time >= 0.1) & (time < 0.2), 2.0, 1.0))


@pytest.mark.parametrize("quantised", [True, False])
def test_quantisation(quantised):
    rows = measurements(infrared(quantised=quantised), body(), 0.5)
    x = rows[:, INFRARED.index("blob_0_x")] / 0.003 + 159.5
    assert np.all(np.abs(x - np.round(x)) < 1e-9) == quantised


def test_the_image_is_the_same_in_both_fidelities():
    images = []
    for fidelity in FIDELITIES:
        simulator, read = simulated(infrared(fidelity=fidelity), body=body())
        simulator.AdvanceTo(0.1)
        images.append(read("image").copy())
        view = INFRARED(read("measurement"))
        u, v = view.blob_0_x / 0.003 + 159.5, view.blob_0_y / 0.003 + 99.5
        assert images[-1][round(v), round(u)] == 255
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_same_seed_same_measurements(fidelity):
    config = InfraredCameraConfig(fidelity=fidelity, quantised=False)
    first, again, other = (
        measurements(InfraredCamera(config, seed), body(), 0.2) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_configure_changes_everything():
    camera = infrared()
    camera.configure(InfraredCameraConfig(frame_rate=10.0, maximum_range=55.0), seed=2)
    simulator, read = simulated(camera, body=body((0.0, 0.0, 40.0)))
    simulator.AdvanceTo(0.95)
    measurement = read("measurement")
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

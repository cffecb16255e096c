"""`LogPlayback`: logged samples in measurement ports."""

import numpy as np
import pytest

from systems.sensors.log_playback import IN_AIR, VEHICLE_FLAGS, LogPlayback
from systems.signals import sensor_log as logs
from systems.signals.measurement import (
    EXTERNAL_VISION,
    GNSS,
    INERTIAL,
    MAGNETOMETER,
    no_measurement,
)
from systems.signals.sensor_log import SensorLog
from tests.system_contract import assert_matches_docstring


def sample_log(frame=logs.LOCAL_NED):
    vision = [1.9e6, 1, 2, -3, *[np.nan] * 3, *[np.nan] * 4, 4, 5, 6, *[np.nan] * 6]
    samples = [
        (logs.IMU, 2.0e6, [2.0e6, 0.1, 0.2, 0.3, 1, 2, 3, 0.004, 0.005, 0, 1, 0]),
        (logs.MAGNETOMETER, 2.0e6, [1.9e6, 0.1, 0.2, 0.3, 0]),
        (logs.GNSS, 2.1e6, [2.0e6, 47, 8, 500, 1, 2, 3, 0.5, 0.8, 0.3, 3, 14, 1.1, 0, 0]),
        (logs.EXTERNAL_VISION, 2.2e6, [*vision, frame, logs.BODY_FRD, 7, 90]),
        (logs.IMU, 2.3e6, [2.3e6, 1, 1, 1, 1, 1, 1, 0.004, 0.005, 0, 0, 0]),
    ]
    rows = np.zeros((len(samples), logs.ROW))
    for row, (*_, values) in zip(rows, samples, strict=True):
        row[: len(values)] = values
    kinds, arrivals = (np.array([s[i] for s in samples]) for i in (0, 1))
    return SensorLog(kinds, arrivals.astype(float), rows)


def port(playback, name, time):
    context = playback.CreateDefaultContext()
    context.SetTime(time)
    return playback.GetOutputPort(name).Eval(context)


def test_topology():
    assert_matches_docstring(LogPlayback(sample_log()))


def test_nothing_before_the_first_arrival():
    playback = LogPlayback(sample_log())
    for name, layout in (("imu", INERTIAL), ("vehicle_flags", VEHICLE_FLAGS), ("in_air", IN_AIR)):
        np.testing.assert_array_equal(port(playback, name, 1.99), no_measurement(layout))


def test_samples_stand_from_their_arrival_in_w_and_b():
    playback = LogPlayback(sample_log(), gnss_delay=30_000.0)
    imu = port(playback, "imu", 2.0)
    np.testing.assert_array_equal(
        imu, [2.0, 2.0, 0, 1, 0.1, -0.2, -0.3, 1, -2, -3, 0.004, 0.005, 1]
    )
    np.testing.assert_array_equal(port(playback, "imu", 2.29), imu)
    assert port(playback, "imu", 2.3)[INERTIAL.index("sequence_number")] == 1
    field = port(playback, "magnetometer", 2.0)
    np.testing.assert_array_equal(field[MAGNETOMETER.slice("field_B")], [0.1, -0.2, -0.3])
    gnss = port(playback, "gnss", 2.1)
    np.testing.assert_array_equal(gnss[GNSS.slice("v_W")], [2, 1, -3])
    np.testing.assert_allclose(gnss[:2], [1.97, 2.1])
    vision = port(playback, "external_vision", 5.0)
    np.testing.assert_array_equal(vision[EXTERNAL_VISION.slice("p_WB")], [2, 1, 3])
    np.testing.assert_array_equal(vision[EXTERNAL_VISION.slice("position_variance")], [5, 4, 6])
    assert np.isnan(vision[EXTERNAL_VISION.index("yaw")])
    np.testing.assert_array_equal(vision[-2:], [7, 90])


def test_refuses_vision_in_another_frame():
    with pytest.raises(ValueError, match="not in NED"):
        LogPlayback(sample_log(frame=logs.LOCAL_FRD))

"""Layouts: names, indices, views, and the header that all measurements share."""

import numpy as np
import pytest

from systems.signals import measurement
from systems.signals.measurement import (
    BODY_STATE,
    HEADER,
    INERTIAL,
    INFRARED,
    INFRARED_BLOBS,
    MARKER,
    MARKER_LEVELS,
    SEQUENCE_NUMBER,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    VALID,
    Layout,
    measurement_layout,
    no_measurement,
    vector,
)

LAYOUTS = [value for value in vars(measurement).values() if isinstance(value, Layout)]
MEASUREMENTS = [layout for layout in LAYOUTS if layout.fields[: len(HEADER)] == HEADER]


def test_index_and_size():
    layout = Layout("Pose", (*vector("p_WB"), "yaw"))
    assert layout.size == 4
    assert [layout.index(field) for field in layout.fields] == [0, 1, 2, 3]
    np.testing.assert_array_equal(layout.zeros(), np.zeros(4))
    with pytest.raises(KeyError):
        layout.index("pitch")


def test_slice_covers_exactly_the_components():
    layout = Layout("Pose", ("time", *vector("q_WB", "wxyz"), *vector("p_WB")))
    assert layout.slice("q_WB") == slice(1, 5)
    assert layout.slice("p_WB") == slice(5, 8)
    with pytest.raises(KeyError, match="no vector v_WB"):
        layout.slice("v_WB")


def test_slice_is_not_misled_by_a_scalar_of_a_similar_name():
    """`delta_angle_dt` is no component of `delta_angle`."""
    assert INERTIAL.slice("delta_angle") == slice(4, 7)
    assert INERTIAL.slice("delta_velocity") == slice(7, 10)
    assert MARKER.slice("q_CP").stop == MARKER.slice("q_CP_second").start


def test_a_field_has_one_name():
    with pytest.raises(ValueError, match="twice"):
        Layout("Twins", ("a", "a"))


def test_view_reads_and_writes_through():
    array = BODY_STATE.zeros()
    view = BODY_STATE(array)
    view.p_WB_z = 3.0
    assert array[BODY_STATE.index("p_WB_z")] == 3.0
    array[0] = 1.0
    assert view.q_WB_w == 1.0


def test_header_indices():
    layout = measurement_layout("Thing", ("field",))
    named = dict(zip(HEADER, range(len(HEADER)), strict=True))
    assert named == {
        "time_of_validity": TIME_OF_VALIDITY,
        "time_of_arrival": TIME_OF_ARRIVAL,
        "sequence_number": SEQUENCE_NUMBER,
        "valid": VALID,
    }
    assert layout.index("field") == len(HEADER)


@pytest.mark.parametrize("layout", MEASUREMENTS, ids=lambda layout: layout.name)
def test_no_measurement_is_before_everything_and_not_valid(layout):
    none = layout(no_measurement(layout))
    assert none.time_of_arrival < 0.0
    assert none.time_of_validity < 0.0
    assert none.sequence_number < 0.0
    assert none.valid == 0.0


def test_every_sensor_has_a_measurement_layout():
    assert {layout.name for layout in MEASUREMENTS} >= {
        "InertialMeasurement",
        "GnssMeasurement",
        "BarometerMeasurement",
        "MagnetometerMeasurement",
        "RangeFinderMeasurement",
        "ExternalVisionMeasurement",
        "MarkerMeasurement",
        "InfraredMeasurement",
        "TargetMeasurement",
    }


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_layout_names_are_unique(layout):
    assert [other.name for other in LAYOUTS].count(layout.name) == 1


def test_repeated_groups_have_their_stride():
    for blob in range(INFRARED_BLOBS):
        assert INFRARED.index(f"blob_{blob}_x") == INFRARED.index("count") + 1 + 3 * blob
    assert INFRARED.size == len(HEADER) + 1 + 3 * INFRARED_BLOBS
    first = MARKER.index("corner_0_0_u")
    assert MARKER.size - first == MARKER_LEVELS * 4 * 2
    assert MARKER.index("corner_1_0_u") == first + 8
    assert INERTIAL.slice("delta_velocity").start == INERTIAL.slice("delta_angle").stop

"""What travels between the blocks: flat vectors with a header, by named layout.

A measurement starts with the same four numbers, whatever the sensor:

| field | unit | meaning |
|---|---|---|
| `time_of_validity` | s | when the world was as the measurement says |
| `time_of_arrival` | s | when the present consumer could first see it |
| `sequence_number` | 1 | counts the sensor's samples from 0; kept by delay lines and faults |
| `valid` | 0/1 | whether the fields mean anything (a camera frame without a detection has 0) |

A consumer finds a new measurement by a new `time_of_arrival`. Before the first
one, `no_measurement(layout)` stands in the port.

World frame W is local east-north-up with the origin at the landing pad, body
frame B forward-left-up, camera frame C x right, y down, z along the optical
axis. Quaternions are w first.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.common.containers import namedview

HEADER = ("time_of_validity", "time_of_arrival", "sequence_number", "valid")
TIME_OF_VALIDITY, TIME_OF_ARRIVAL, SEQUENCE_NUMBER, VALID = range(4)


class Layout:
    """The names of the entries of a flat vector.

    Attributes
    ----------
    name : str
        The name of the layout, CamelCase.
    fields : tuple of str
        One name an entry, in order; the components of a vector called `p_WB`
        are `p_WB_x`, `p_WB_y`, `p_WB_z`.
    size : int
        The number of entries.
    """

    def __init__(self, name: str, fields: Sequence[str]):
        self.name = name
        self.fields = tuple(fields)
        self.size = len(self.fields)
        self._index = {field: i for i, field in enumerate(self.fields)}
        if len(self._index) != self.size:
            raise ValueError(f"layout {name} names a field twice")
        self.view = namedview(name, self.fields)

    def index(self, field: str) -> int:
        """The index of one entry; raises `KeyError` if there is none of that name."""
        return self._index[field]

    def slice(self, vector: str) -> slice:
        """The slice of a vector's components: `slice("p_WB")` covers `p_WB_x` … `p_WB_z`."""
        components = [_is_component(field, vector) for field in self.fields]
        if vector in self._index or not any(components):
            raise KeyError(f"layout {self.name} has no vector {vector}")
        start = components.index(True)
        length = next((n for n, own in enumerate(components[start:]) if not own), None)
        return slice(start, self.size if length is None else start + length)

    def zeros(self) -> np.ndarray:
        """A vector of this layout, all zeros."""
        return np.zeros(self.size)

    def __call__(self, array: np.ndarray) -> Any:
        """A named view of `array` (shape (size,)): reads and writes go through."""
        return self.view(array)


def _is_component(field: str, name: str) -> bool:
    """Whether `field` is `name` with an axis: `delta_angle_x` is, `delta_angle_dt` is not."""
    prefix, _, axis = field.rpartition("_")
    return prefix == name and set(axis) <= set("wxyzr")


def vector(name: str, components: Sequence[str] = "xyz") -> tuple[str, ...]:
    """The component names of a vector: `p_WB` gives `p_WB_x`, `p_WB_y`, `p_WB_z`."""
    return tuple(f"{name}_{component}" for component in components)


def measurement_layout(name: str, fields: Sequence[str]) -> Layout:
    """The layout of a measurement: the header, then `fields`."""
    return Layout(name, (*HEADER, *fields))


def no_measurement(layout: Layout) -> np.ndarray:
    """What stands in a measurement port before the first sample, shape (layout.size,)."""
    measurement = layout.zeros()
    measurement[TIME_OF_VALIDITY] = measurement[TIME_OF_ARRIVAL] = -1.0
    measurement[SEQUENCE_NUMBER] = -1.0
    return measurement


# The state of a vehicle's body, the truth that sensors sample.
BODY_STATE = Layout(
    "BodyState",
    (
        *vector("q_WB", "wxyz"),  # unit quaternion
        *vector("p_WB"),  # m
        *vector("v_WB"),  # m/s
        *vector("w_WB_B"),  # rad/s
        *vector("f_B"),  # m/s2, specific force, mean over the last plant step
        "contact_force",  # N, sum of the normal forces on the legs
    ),
)

# The landing pad: the pose and velocity of its centre, upright.
PAD_STATE = Layout(
    "PadState",
    (
        *vector("p_WP"),  # m
        "yaw",  # rad, counter-clockwise from east
        *vector("v_WP"),  # m/s
        "yaw_rate",  # rad/s
        "side",  # m, of the square that can be stood on; around it is the ground at z = 0
    ),
)

INERTIAL = measurement_layout(
    "InertialMeasurement",
    (
        *vector("delta_angle"),  # rad, B, integrated over delta_angle_dt
        *vector("delta_velocity"),  # m/s, B, integrated over delta_velocity_dt
        "delta_angle_dt",  # s
        "delta_velocity_dt",  # s
        "clipping",  # 0/1, an accelerometer axis at its range
    ),
)
GNSS = measurement_layout(
    "GnssMeasurement",
    (
        "latitude",  # deg, WGS84
        "longitude",  # deg
        "altitude",  # m above mean sea level
        *vector("v_W"),  # m/s
        "horizontal_accuracy",  # m, one sigma as reported
        "vertical_accuracy",  # m
        "speed_accuracy",  # m/s
        "fix_type",  # 0 none, 3 3-D, 4 DGPS, 5 RTK float, 6 RTK fixed
        "satellites",  # 1
        "position_dilution",  # PDOP, 1
    ),
)
BAROMETER = measurement_layout("BarometerMeasurement", ("altitude",))  # m above mean sea level
MAGNETOMETER = measurement_layout("MagnetometerMeasurement", vector("field_B"))  # gauss
RANGE_FINDER = measurement_layout(
    "RangeFinderMeasurement",
    ("range", "signal_quality"),  # m along the beam; 0..100, -1 unknown
)
EXTERNAL_VISION = measurement_layout(
    "ExternalVisionMeasurement",
    (
        *vector("p_WB"),  # m; NaN if not measured
        *vector("position_variance"),  # m2
        *vector("v_WB"),  # m/s; NaN if not measured
        *vector("velocity_variance"),  # (m/s)2
        "yaw",  # rad, counter-clockwise from east; NaN if not measured
        "yaw_variance",  # rad2
        "reset_counter",  # 1
        "quality",  # 0..100
    ),
)

MARKER_LEVELS = 3
MARKER = measurement_layout(
    "MarkerMeasurement",
    (
        "level",  # the level that the pose was taken from, 0 the outermost
        *vector("bearing_C"),  # unit vector from the camera to the pad's centre
        "range",  # m
        # covariance of (bearing x, bearing y, range): rad2, rad m, m2
        *vector("covariance", ("xx", "xy", "yy", "xr", "yr", "rr")),
        *vector("q_CP", "wxyz"),  # attitude of the pad, the better planar solution
        *vector("q_CP_second", "wxyz"),  # the other planar solution
        "reprojection_error",  # px rms
        "reprojection_error_second",  # px rms
        *(
            f"corner_{level}_{corner}_{axis}"  # px, NaN where the level was not detected
            for level in range(MARKER_LEVELS)
            for corner in range(4)
            for axis in "uv"
        ),
    ),
)

INFRARED_BLOBS = 5
INFRARED = measurement_layout(
    "InfraredMeasurement",
    (
        "count",  # blobs reported, 0..5, the largest first
        *(
            f"blob_{i}_{field}"  # tangents x/z and y/z in C; area in px
            for i in range(INFRARED_BLOBS)
            for field in ("x", "y", "area")
        ),
    ),
)

SVGS_LEDS = 4
SVGS = measurement_layout(
    "SvgsMeasurement",
    (
        "beacon",  # 0 short, 1 medium, 2 long range; -1 none
        "error_code",  # 0 a pose, otherwise see systems.vision.svgs_selection
        "blob_count",  # all blobs of the frame
        *vector("p_CT"),  # m, the beacon's origin from the camera
        *vector("q_CT", "wxyz"),  # attitude of the beacon
        # Covariance of p_CT (m2) and of a small turn about C's axes (rad2), upper triangle
        *(f"covariance_{i}{j}" for i in range(6) for j in range(i, 6)),
        "reprojection_error",  # px rms
        *(f"led_{i}_{axis}" for i in range(SVGS_LEDS) for axis in "uv"),  # px, blobs used
    ),
)

# The vehicle as the navigation filter knows it now, in W and B.
VEHICLE_ESTIMATE = Layout(
    "VehicleEstimate",
    (
        "time_of_validity",  # s
        "attitude_valid",  # 0/1
        "horizontal_valid",  # 0/1, horizontal position and velocity
        "vertical_valid",  # 0/1
        *vector("q_WB", "wxyz"),
        *vector("p_WB"),  # m
        *vector("v_WB"),  # m/s
        *vector("w_WB_B"),  # rad/s, bias removed
        *vector("a_WB"),  # m/s2, bias and gravity removed
        *vector("attitude_variance"),  # rad2, about W's axes
        *vector("velocity_variance"),  # (m/s)2
        *vector("position_variance"),  # m2
        "height_above_ground",  # m
        "height_above_ground_valid",  # 0/1
        "horizontal_reset_counter",  # 1
        *vector("horizontal_reset", "xy"),  # m, the last jump of the estimate
        "vertical_reset_counter",  # 1
        "vertical_reset",  # m
    ),
)

# The landing target as a sensor front end reports it.
TARGET_MEASUREMENT = measurement_layout(
    "TargetMeasurement",
    (
        *vector("p_BP_W"),  # m, from the vehicle's body origin to the pad's centre
        # m2, covariance of p_BP_W
        *vector("covariance", ("xx", "xy", "yy", "xz", "yz", "zz")),
        "source",  # bit 0 infrared, bit 1 marker, bit 2 SVGS
    ),
)

# The landing target as an estimator knows it now.
TARGET_ESTIMATE = Layout(
    "TargetEstimate",
    (
        "time_of_validity",  # s
        "acquired",  # 0/1, may be used for guidance
        "time_of_last_fusion",  # s, validity of the newest measurement that was fused; -1 none
        *vector("p_BP_W"),  # m, from the vehicle's body origin to the pad's centre
        *vector("v_BP_W"),  # m/s, its rate of change
        *vector("v_WP"),  # m/s, velocity of the pad itself, 0 where not estimated
        *vector("position_variance"),  # m2
        *vector("velocity_variance"),  # (m/s)2
        "innovation_test_ratio",  # of the newest measurement
        "rejected_count",  # measurements rejected in a row
        "source",  # bits as in TargetMeasurement, of the newest measurement
    ),
)

# What a supervisor asks of the controller. NaN leaves an entry uncontrolled.
SETPOINT = Layout(
    "Setpoint",
    (
        *vector("p_WB"),  # m
        *vector("v_WB"),  # m/s: target where the position is NaN, feed-forward otherwise
        "yaw",  # rad, counter-clockwise from east
        "armed",  # 0/1, 0 stops the rotors
        "maximum_speed",  # m/s, horizontal limit on the way to p_WB
        *vector("a_WB"),  # m/s2, feed-forward on top of what the controller asks for itself
    ),
)

SUPERVISOR_STATUS = Layout(
    "SupervisorStatus",
    (
        "state",  # index in the routine's transition table
        "time_in_state",  # s
        "attempts",  # landing attempts begun
        "landing_started",  # s, when the landing routine took over; -1 not yet
        "target_in_use",  # 0/1, whether guidance follows the target estimate
        "landed_detected",  # 0/1, as the vehicle itself believes
        "disarmed",  # 0/1
    ),
)

VEHICLE_STATUS = Layout(
    "VehicleStatus",
    (
        "at_rest",  # 0/1, stands still on the ground
        "in_air",  # 0/1
        "in_ground_effect",  # 0/1
    ),
)

# The run's verdict, from the true states.
TOUCHDOWN = Layout(
    "Touchdown",
    (
        "landed",  # 0/1, at rest on its legs with stopped rotors
        "reason",  # code, see plants.touchdown
        "time",  # s, first contact; -1 not yet
        *vector("offset", "xy"),  # m, of the reference point from the pad's centre, in W
        "vertical_speed",  # m/s, downwards, just before the first contact
        "horizontal_speed",  # m/s, relative to the pad
        "tilt",  # rad
    ),
)

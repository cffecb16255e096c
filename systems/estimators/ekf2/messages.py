"""Between the laboratory's ports and the filter: layouts, frames, units, one call a tick.

W is east-north-up with its origin at the pad and B forward-left-up; the filter works
in NED and FRD, in microseconds. A measurement is new when its time of arrival
is. As long as the filter has no geodetic origin (no GNSS yet), its local position is
taken as relative to the pad, which is what external vision gives it.
"""

import math

import numpy as np

from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.fusion import covariance
from systems.estimators.ekf2.geometry import project
from systems.estimators.ekf2.output_predictor import output_position
from systems.estimators.ekf2.range_finder import height_above_ground_valid
from systems.signals.measurement import (
    BAROMETER,
    EXTERNAL_VISION,
    GNSS,
    HEADER,
    INERTIAL,
    MAGNETOMETER,
    RANGE_FINDER,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    VALID,
    VEHICLE_ESTIMATE,
    Layout,
    vector,
)

DELAYED_STATE = Layout(
    "Ekf2DelayedState",
    (
        "time_of_validity",  # s
        *vector("quaternion", "wxyz"),  # FRD to NED
        *vector("velocity"),  # m/s, NED
        *vector("position"),  # m, NED from the filter's local origin
        *vector("gyro_bias"),  # rad/s, FRD
        *vector("accel_bias"),  # m/s2, FRD
        *vector("earth_field"),  # gauss, NED
        *vector("body_field"),  # gauss, FRD
        *vector("wind", "xy"),  # m/s, NED
        "terrain",  # m, down
        *vector("rotation_variance"),  # rad2, about the axes of NED
        *vector("velocity_variance"),
        *vector("position_variance"),
        *vector("gyro_bias_variance"),
        *vector("accel_bias_variance"),
        *vector("earth_field_variance"),
        *vector("body_field_variance"),
        *vector("wind_variance", "xy"),
        "terrain_variance",
    ),
)

INNOVATIONS = Layout(
    "Ekf2Innovations",
    [
        field
        for source, axes in zip(at.AID_NAMES, at.AID_AXES, strict=True)
        for field in (
            f"{source}_time",  # s, validity of the newest observation; 0 none yet
            f"{source}_fused",  # 0/1
            f"{source}_rejected",  # 0/1
            *(
                f"{source}_{quantity}_{axis}"
                for axis in range(axes)
                for quantity in ("innovation", "innovation_variance", "test_ratio")
            ),
        )
    ],
)

STATUS = Layout(
    "Ekf2Status",
    (
        "time_of_validity",  # s, of the delayed horizon
        *at.FLAG_NAMES,  # 0/1, PX4's control status
        *at.FAULT_NAMES,  # 0/1, PX4's fault status
        "height_reference",  # 0 barometer, 1 GNSS, 2 range finder, 3 external vision, 4 none
        "barometer_bias",  # m
        "gnss_height_bias",  # m
        "vision_height_bias",  # m, down
        *vector("vision_bias", ("north", "east")),  # m
        "velocity_ne_resets",
        "velocity_d_resets",
        "position_ne_resets",
        "position_d_resets",
        "quaternion_resets",
        "terrain_resets",
        *vector("tracking_error", ("attitude", "velocity", "position")),  # rad, m/s, m
    ),
)
_AXES = np.array(at.AID_AXES)

# Where the fields of the messages stand.
_FIELDS = len(HEADER)
_CLIPPING = INERTIAL.index("clipping")
_DT = INERTIAL.index("delta_angle_dt")
_GNSS_V = GNSS.slice("v_W").start
_GNSS_REST = GNSS.index("horizontal_accuracy")
_ALTITUDE = BAROMETER.index("altitude")
_FIELD = MAGNETOMETER.slice("field_B").start
_RANGE = RANGE_FINDER.index("range")
_EV_P = EXTERNAL_VISION.slice("p_WB").start
_EV_P_VAR = EXTERNAL_VISION.slice("position_variance").start
_EV_V = EXTERNAL_VISION.slice("v_WB").start
_EV_V_VAR = EXTERNAL_VISION.slice("velocity_variance").start
_EV_YAW = EXTERNAL_VISION.index("yaw")
_ARRIVED_IMU, _ARRIVED_GNSS, _ARRIVED_BARO = at.ARRIVED, at.ARRIVED + 1, at.ARRIVED + 2
_ARRIVED_MAG, _ARRIVED_RANGE, _ARRIVED_EV = at.ARRIVED + 3, at.ARRIVED + 4, at.ARRIVED + 5

# Entries of VEHICLE_ESTIMATE.
_ATTITUDE_VALID = VEHICLE_ESTIMATE.index("attitude_valid")
_HORIZONTAL_VALID = VEHICLE_ESTIMATE.index("horizontal_valid")
_VERTICAL_VALID = VEHICLE_ESTIMATE.index("vertical_valid")
_Q = VEHICLE_ESTIMATE.slice("q_WB").start
_P = VEHICLE_ESTIMATE.slice("p_WB").start
_V = VEHICLE_ESTIMATE.slice("v_WB").start
_W = VEHICLE_ESTIMATE.slice("w_WB_B").start
_A = VEHICLE_ESTIMATE.slice("a_WB").start
_VARIANCES = VEHICLE_ESTIMATE.slice("attitude_variance").start
_HEIGHT = VEHICLE_ESTIMATE.index("height_above_ground")
_RESETS = VEHICLE_ESTIMATE.index("horizontal_reset_counter")
_VERTICAL_RESETS = VEHICLE_ESTIMATE.index("vertical_reset_counter")

_STATUS_PERIOD = 500_000.0  # us, the vehicle's status is repeated so often if it does not change
_EQUATORIAL_RADIUS, _ECCENTRICITY_SQUARED = 6378137.0, 0.0818191908425**2  # m, 1; WGS84
_HALF_SQRT2 = math.sqrt(0.5)


@kernel
def _microseconds(seconds):
    return math.floor(seconds * 1e6 + 0.5)


@kernel
def _is_new(x, arrived, message):
    """Whether a message has arrived since the last one that was valid, and remember it."""
    if message.size == 0 or not message[TIME_OF_ARRIVAL] > x[arrived]:
        return False
    x[arrived] = message[TIME_OF_ARRIVAL]
    return message[VALID] != 0.0


@kernel
def take_measurements(
    x, p, row, by_validity, limit, gnss, barometer, magnetometer, ranging, vision
):
    """Feed the filter all messages that are new and arrived before `limit` (s).

    Parameters
    ----------
    row : np.ndarray
        Scratch, shape (24,).
    by_validity : bool
        Whether observations are stamped with their time of validity or of arrival.
    gnss, barometer, magnetometer, ranging, vision : np.ndarray
        The messages in the ports; size 0 if the port is not connected.
    """
    stamp = TIME_OF_VALIDITY if by_validity else TIME_OF_ARRIVAL
    if _due(gnss, limit) and _is_new(x, _ARRIVED_GNSS, gnss):
        row[0] = _microseconds(gnss[stamp])
        if not by_validity:
            row[0] -= p[prm.EKF2_GPS_DELAY] * 1e3
        row[1], row[2], row[3] = gnss[_FIELDS], gnss[_FIELDS + 1], gnss[_FIELDS + 2]
        row[4], row[5], row[6] = gnss[_GNSS_V + 1], gnss[_GNSS_V], -gnss[_GNSS_V + 2]
        for i in range(6):
            row[7 + i] = gnss[_GNSS_REST + i]
        row[13] = row[14] = 0.0
        kernels.push_gnss(x, p, row)
    if _due(barometer, limit) and _is_new(x, _ARRIVED_BARO, barometer):
        row[0], row[1], row[2] = _microseconds(barometer[stamp]), barometer[_ALTITUDE], 0.0
        kernels.push_barometer(x, p, row)
    if _due(magnetometer, limit) and _is_new(x, _ARRIVED_MAG, magnetometer):
        row[0] = _microseconds(magnetometer[stamp])
        row[1] = magnetometer[_FIELD]
        row[2], row[3], row[4] = -magnetometer[_FIELD + 1], -magnetometer[_FIELD + 2], 0.0
        kernels.push_magnetometer(x, p, row)
    if _due(ranging, limit) and _is_new(x, _ARRIVED_RANGE, ranging):
        row[0] = _microseconds(ranging[stamp])
        row[1], row[2] = ranging[_RANGE], ranging[_RANGE + 1]
        kernels.push_range(x, p, row)
    if _due(vision, limit) and _is_new(x, _ARRIVED_EV, vision):
        _take_vision(x, p, row, vision, _microseconds(vision[stamp]))


@kernel
def _due(message, limit):
    return message.size > 0 and message[TIME_OF_ARRIVAL] < limit


@kernel
def _take_vision(x, p, row, m, time):
    row[0] = time
    for first, position, variance in ((1, _EV_P, _EV_P_VAR), (4, _EV_V, _EV_V_VAR)):
        row[first], row[first + 1] = m[position + 1], m[position]
        row[first + 2] = -m[position + 2]
        at_variance = first + 10
        row[at_variance], row[at_variance + 1] = m[variance + 1], m[variance]
        row[at_variance + 2] = m[variance + 2]
    half = 0.5 * (0.5 * math.pi - m[_EV_YAW])
    row[7], row[8], row[9], row[10] = math.cos(half), 0.0, 0.0, math.sin(half)
    if not math.isfinite(half):
        row[8] = row[9] = math.nan
    row[17] = row[18] = math.nan  # roll and pitch are not measured
    row[19] = m[_EV_YAW + 1]
    row[20] = row[21] = at.FRAME_NED
    row[22], row[23] = m[_EV_YAW + 2], m[_EV_YAW + 3]
    kernels.push_external_vision(x, p, row)


@kernel
def _take_status(x, p, row, status):
    """Feed the vehicle's status when it changes, and twice a second."""
    if status.size == 0 or not x[at.INITIALISED]:
        return
    now = x[at.TIME_LATEST]
    sent = at.STATUS_SENT
    same = x[sent] == status[0] and x[sent + 1] == status[1] and x[sent + 2] == status[2]
    if same and now < x[sent + 3] + _STATUS_PERIOD:
        return
    row[0] = now
    for i in range(3):
        row[1 + i] = x[sent + i] = status[i]
    row[4] = row[5] = 0.0
    x[sent + 3] = now
    kernels.push_status(x, p, row)


@kernel
def take_imu(x, p, row, imu):
    """Feed the filter a new IMU sample; true if a filter step is due."""
    if not _is_new(x, _ARRIVED_IMU, imu):
        return False
    row[0] = _microseconds(imu[TIME_OF_VALIDITY])
    for i in range(6):
        row[1 + i] = imu[_FIELDS + i] if i % 3 == 0 else -imu[_FIELDS + i]
    row[7], row[8] = imu[_DT], imu[_DT + 1]
    row[9] = row[10] = row[11] = imu[_CLIPPING]
    return kernels.push_imu(x, p, row)


@kernel
def position_in_world(x, p, origin):
    """The body's position now (m, W), for W's origin at a latitude, longitude (rad), altitude (m).

    Exact on the ellipsoid, by way of earth-centred coordinates.
    """
    latitude, longitude, altitude = output_position(x, p)
    if math.isfinite(x[at.ORIGIN_ALTITUDE]):
        altitude -= origin[2]
    if not x[at.ORIGIN_SET]:
        north, east = project(latitude, longitude, 0.0, 0.0)
        return east, north, altitude
    altitude += origin[2]
    sin_o, cos_o = math.sin(origin[0]), math.cos(origin[0])
    sin_p, cos_p = math.sin(latitude), math.cos(latitude)
    turn = longitude - origin[1]
    radius_o = _EQUATORIAL_RADIUS / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * sin_o * sin_o)
    radius_p = _EQUATORIAL_RADIUS / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * sin_p * sin_p)
    outward = (radius_p + altitude) * cos_p * math.cos(turn) - (radius_o + origin[2]) * cos_o
    polar = ((1.0 - _ECCENTRICITY_SQUARED) * radius_p + altitude) * sin_p - (
        (1.0 - _ECCENTRICITY_SQUARED) * radius_o + origin[2]
    ) * sin_o
    return (
        (radius_p + altitude) * cos_p * math.sin(turn),
        cos_o * polar - sin_o * outward,
        cos_o * outward + sin_o * polar,
    )


@kernel
def write_motion(x, p, origin, out):
    """Write `VEHICLE_ESTIMATE` but for the resets: the output predictor's state now, in W and B."""
    out[0] = x[at.OUT_TIME] * 1e-6
    out[_ATTITUDE_VALID] = x[at.TILT_ALIGN] != 0.0 and x[at.YAW_ALIGN] != 0.0
    out[_HORIZONTAL_VALID] = x[at.HORIZONTAL_EXCEEDED] == 0.0
    out[_VERTICAL_VALID] = x[at.VERTICAL_POSITION_EXCEEDED] == 0.0
    # q_W,NED ⊗ q ⊗ q_FRD,B; both are half turns
    w, i = x[at.OUT_QUATERNION], x[at.OUT_QUATERNION + 1]
    j, k = x[at.OUT_QUATERNION + 2], x[at.OUT_QUATERNION + 3]
    s = _HALF_SQRT2 if w + k >= 0.0 else -_HALF_SQRT2
    out[_Q], out[_Q + 1], out[_Q + 2], out[_Q + 3] = (
        s * (w + k),
        s * (i + j),
        s * (i - j),
        s * (w - k),
    )
    out[_P], out[_P + 1], out[_P + 2] = position_in_world(x, p, origin)
    v, u = at.OUT_VELOCITY, at.OUT_IMU_VELOCITY
    out[_V], out[_V + 1], out[_V + 2] = x[v + 1] - x[u + 1], x[v] - x[u], x[u + 2] - x[v + 2]
    r, a = at.OUT_ANGULAR_VELOCITY, at.OUT_ACCELERATION
    out[_W], out[_W + 1], out[_W + 2] = x[r], -x[r + 1], -x[r + 2]
    out[_A], out[_A + 1], out[_A + 2] = x[a + 1], x[a], -x[a + 2]
    P = covariance(x)
    for group in range(3):
        first, e = _VARIANCES + 3 * group, 3 * group
        out[first], out[first + 1], out[first + 2] = P[e + 1, e + 1], P[e, e], P[e + 2, e + 2]
    _, _, altitude = output_position(x, p)
    out[_HEIGHT] = x[at.TERRAIN] + altitude
    out[_HEIGHT + 1] = height_above_ground_valid(x)


@kernel
def write_resets(x, p, origin, out):
    """Write how far a filter step made the position jump; `out` still holds the last estimate.

    What the vehicle moved since then is taken off with that estimate's velocity.
    """
    horizontal, vertical = x[at.R_POSITION_NE], x[at.R_POSITION_D]
    if horizontal == out[_RESETS] and vertical == out[_VERTICAL_RESETS]:
        return
    dt = max(x[at.OUT_TIME] * 1e-6 - out[0], 0.0) if out[0] >= 0.0 else 0.0
    east, north, up = position_in_world(x, p, origin)
    if horizontal != out[_RESETS]:
        out[_RESETS] = horizontal
        out[_RESETS + 1] = east - out[_P] - dt * out[_V]
        out[_RESETS + 2] = north - out[_P + 1] - dt * out[_V + 1]
    if vertical != out[_VERTICAL_RESETS]:
        out[_VERTICAL_RESETS] = vertical
        out[_VERTICAL_RESETS + 1] = up - out[_P + 2] - dt * out[_V + 2]


@kernel
def write_delayed_state(x, out):
    """Write `DELAYED_STATE`."""
    out[0] = x[at.TIME_DELAYED] * 1e-6
    for i in range(at.NOMINAL_SIZE):
        out[1 + i] = x[i]
    for i in range(at.ERRORS):
        out[1 + at.NOMINAL_SIZE + i] = x[at.COVARIANCE + i * (at.ERRORS + 1)]


@kernel
def write_innovations(x, out):
    """Write `INNOVATIONS`."""
    to = 0
    for source in range(_AXES.size):
        aid = at.AID + source * at.A_SIZE
        out[to] = x[aid + at.A_TIME] * 1e-6
        out[to + 1], out[to + 2] = x[aid + at.A_FUSED], x[aid + at.A_REJECTED]
        to += 3
        for axis in range(_AXES[source]):
            a = aid + axis * at.A_AXIS
            out[to] = x[a + at.A_INNOVATION]
            out[to + 1] = x[a + at.A_INNOVATION_VARIANCE]
            out[to + 2] = x[a + at.A_TEST_RATIO]
            to += 3


@kernel
def write_status(x, out):
    """Write `STATUS`."""
    out[0] = x[at.TIME_DELAYED] * 1e-6
    to = 1
    for first, count in ((at.FLAGS, at.FLAG_COUNT), (at.FAULTS, at.FAULT_COUNT)):
        for i in range(count):
            out[to + i] = x[first + i]
        to += count
    out[to] = x[at.HEIGHT_REFERENCE]
    to += 1
    for bias in (at.BIAS_BARO, at.BIAS_GNSS_HGT, at.BIAS_EV_HGT, at.BIAS_EV_NORTH, at.BIAS_EV_EAST):
        out[to] = x[bias + at.B_BIAS]
        to += 1
    for i in range(6):
        out[to + i] = x[at.RESET_COUNTS + i]
    for i in range(3):
        out[to + 6 + i] = x[at.OUT_TRACKING_ERROR + i]


@kernel
def receive(x, p, by_validity, imu, gnss, barometer, magnetometer, ranging, vision, vehicle_status):
    """Take all messages that have arrived; true if a filter step is due.

    What arrived earlier than this IMU sample is taken as of the one before.

    Parameters
    ----------
    x, p : np.ndarray
        The filter and its parameters.
    by_validity : bool
        As in `take_measurements`.
    imu, gnss, barometer, magnetometer, ranging, vision, vehicle_status : np.ndarray
        The messages in the ports; size 0 if the port is not connected.
    """
    row = np.empty(24)
    take_measurements(
        x, p, row, by_validity, imu[TIME_OF_ARRIVAL],
        gnss, barometer, magnetometer, ranging, vision,
    )  # fmt: skip
    take_imu(x, p, row, imu)
    _take_status(x, p, row, vehicle_status)
    take_measurements(
        x, p, row, by_validity, math.inf, gnss, barometer, magnetometer, ranging, vision
    )
    return x[at.IMU_UPDATED] != 0.0


@kernel
def write_step(x, p, origin, out):
    """Write `VEHICLE_ESTIMATE` after a tick, once there was an IMU sample."""
    if x[at.INITIALISED] == 0.0:
        return
    write_resets(x, p, origin, out)
    write_motion(x, p, origin, out)

"""Where everything stands in the filter's one flat float64 array.

The whole filter — states, covariance, rings, flags, timers — is one array, so
that it is Drake's discrete state as it is, can be copied, stored and compared,
and passes into compiled code without unpacking. The constants here are indices
into it. Times are whole microseconds; flags are 0 or 1; frames are PX4's, NED
and FRD. The rings stand at the end, because their lengths follow from the
parameters.
"""

import numpy as np

from systems.estimators.ekf2 import parameters as prm

STANDARD_GRAVITY = 9.80665  # m/s2

_size = 0


def _reserve(count: int = 1) -> int:
    global _size
    first = _size
    _size += count
    return first


# The nominal state at the delayed horizon, 25 numbers.
QUATERNION = _reserve(4)  # FRD to NED, w first
VELOCITY = _reserve(3)  # m/s, NED
POSITION = _reserve(3)  # m, NED from the local origin; a copy of the three below, for readers
GYRO_BIAS = _reserve(3)  # rad/s
ACCEL_BIAS = _reserve(3)  # m/s2
MAG_EARTH = _reserve(3)  # gauss, NED
MAG_BODY = _reserve(3)  # gauss, FRD
WIND = _reserve(2)  # m/s, north and east
TERRAIN = _reserve()  # m, down, in the frame of ALTITUDE
NOMINAL_SIZE = _size
LATITUDE = _reserve()  # rad, from (0, 0) as long as there is no origin
LONGITUDE = _reserve()  # rad
ALTITUDE = _reserve()  # m
ROTATION = _reserve(9)  # rotation matrix of QUATERNION, row by row

# The covariance of the 24 error states, row by row, and where the groups stand in it.
ERRORS = 24
E_ROTATION, E_VELOCITY, E_POSITION, E_GYRO_BIAS, E_ACCEL_BIAS = 0, 3, 6, 9, 12
E_MAG_EARTH, E_MAG_BODY, E_WIND, E_TERRAIN = 15, 18, 21, 23
COVARIANCE = _reserve(ERRORS * ERRORS)

# Time.
INITIALISED = _reserve()  # the first IMU sample has come
FILTER_INITIALISED = _reserve()  # the tilt is known
TIME_LATEST = _reserve()
TIME_DELAYED = _reserve()
IMU_UPDATED = _reserve()  # a filter step is due
DT_AVERAGE = _reserve()  # s, mean filter step
FIRST_STEP_DONE = _reserve()
MINIMUM_INTERVAL = _reserve()  # us, observations closer than this are dropped
RING_LENGTH = _reserve()  # entries of an observation ring

# The IMU down-sampler.
DS_DELTA_ANGLE = _reserve(4)  # quaternion
DS_DELTA_VELOCITY = _reserve(3)
DS_ANGLE_DT = _reserve()
DS_VELOCITY_DT = _reserve()
DS_CLIPPING = _reserve(3)
DS_COUNT = _reserve()
DS_REQUIRED = _reserve()
DS_TARGET_DT = _reserve()
DS_MINIMUM_DT = _reserve()
DS_AVERAGE_DT = _reserve()

# The sample at the delayed horizon.
IMU_DELTA_ANGLE = _reserve(3)
IMU_DELTA_VELOCITY = _reserve(3)
IMU_ANGLE_DT = _reserve()
IMU_VELOCITY_DT = _reserve()
IMU_CLIPPING = _reserve(3)

# The earth.
EARTH_RATE = _reserve(3)  # rad/s, NED
EARTH_RATE_LATITUDE = _reserve()  # rad
GRAVITY = _reserve()  # m/s2
ORIGIN_SET = _reserve()
ORIGIN_LATITUDE = _reserve()  # rad
ORIGIN_LONGITUDE = _reserve()  # rad
ORIGIN_TIME = _reserve()
ORIGIN_ALTITUDE = _reserve()  # m, NaN until known
LAST_KNOWN = _reserve(3)  # latitude, longitude, altitude
LAST_GROUND_DOWN = _reserve()  # m

# Low-pass filters and envelopes.
ACCEL_LPF = _reserve(3)
GYRO_LPF = _reserve(3)
ACCEL_HORIZONTAL_LPF = _reserve(2)
HEIGHT_RATE_LPF = _reserve()
BARO_LPF = _reserve()
MAG_LPF = _reserve(3)
MAG_HEADING_LPF = _reserve()
ACCEL_ENVELOPE = _reserve()
GYRO_ENVELOPE = _reserve()
GYRO_BIAS_INHIBITED = _reserve()
ACCEL_BIAS_INHIBITED = _reserve(3)
CLIP_COUNTER = _reserve(3)
ZERO_GYRO_ANGLE = _reserve(3)
ZERO_GYRO_DT = _reserve()

# Timers.
T_HORIZONTAL_AIDING = _reserve()
T_VERTICAL_POSITION_AIDING = _reserve()
T_VERTICAL_VELOCITY_AIDING = _reserve()
T_HORIZONTAL_POSITION = _reserve()
T_HEIGHT = _reserve()
T_HORIZONTAL_VELOCITY = _reserve()
T_VERTICAL_VELOCITY = _reserve()
T_HEADING = _reserve()
T_TERRAIN = _reserve()
T_ON_GROUND = _reserve()
T_IN_AIR = _reserve()
T_GROUND_EFFECT = _reserve()
T_BAD_ACCEL = _reserve()
T_GOOD_ACCEL = _reserve()
T_ZERO_VELOCITY = _reserve()
T_GNSS_HEIGHT_REJECTED = _reserve()
T_WORLD_MODEL = _reserve()
T_MAG_CHECK_FAILING = _reserve()
HORIZONTAL_EXCEEDED = _reserve()  # dead reckoning for too long
VERTICAL_POSITION_EXCEEDED = _reserve()
VERTICAL_VELOCITY_EXCEEDED = _reserve()

# Control status: PX4's bits, in order.
FLAG_NAMES = [
    "tilt_align",
    "yaw_align",
    "gnss_pos",
    "opt_flow",
    "mag_hdg",
    "mag_3D",
    "mag_dec",
    "in_air",
    "wind",
    "baro_hgt",
    "rng_hgt",
    "gps_hgt",
    "ev_pos",
    "ev_yaw",
    "ev_hgt",
    "fuse_beta",
    "mag_field_disturbed",
    "fixed_wing",
    "mag_fault",
    "fuse_aspd",
    "gnd_effect",
    "rng_stuck",
    "gnss_yaw",
    "mag_aligned_in_flight",
    "ev_vel",
    "synthetic_mag_z",
    "vehicle_at_rest",
    "gnss_yaw_fault",
    "rng_fault",
    "inertial_dead_reckoning",
    "wind_dead_reckoning",
    "rng_kin_consistent",
    "fake_pos",
    "fake_hgt",
    "gravity_vector",
    "mag",
    "ev_yaw_fault",
    "mag_heading_consistent",
    "aux_gpos",
    "rng_terrain",
    "opt_flow_terrain",
    "valid_fake_pos",
    "constant_pos",
    "baro_fault",
    "gnss_vel",
    "gnss_fault",
    "yaw_manual",
    "gnss_hgt_fault",
    "in_transition",
    "heading_observable",
    "rngbcn_fusion",
]
FLAG_COUNT = len(FLAG_NAMES)
FLAGS = _reserve(FLAG_COUNT)
BEFORE = _reserve(FLAG_COUNT) - FLAGS  # x[IN_AIR + BEFORE] is the flag one step ago
TILT_ALIGN, YAW_ALIGN, GNSS_POS = FLAGS, FLAGS + 1, FLAGS + 2
MAG_HDG, MAG_3D, MAG_DEC, IN_AIR = FLAGS + 4, FLAGS + 5, FLAGS + 6, FLAGS + 7
WIND_ESTIMATED, BARO_HGT, RNG_HGT, GPS_HGT = FLAGS + 8, FLAGS + 9, FLAGS + 10, FLAGS + 11
EV_POS, EV_YAW, EV_HGT = FLAGS + 12, FLAGS + 13, FLAGS + 14
MAG_FIELD_DISTURBED, FIXED_WING, MAG_FAULT = FLAGS + 16, FLAGS + 17, FLAGS + 18
GND_EFFECT, MAG_ALIGNED_IN_FLIGHT, EV_VEL = FLAGS + 20, FLAGS + 23, FLAGS + 24
SYNTHETIC_MAG_Z, AT_REST, RNG_FAULT = FLAGS + 25, FLAGS + 26, FLAGS + 28
INERTIAL_DEAD_RECKONING, RNG_KIN_CONSISTENT = FLAGS + 29, FLAGS + 31
FAKE_POS, FAKE_HGT, GRAVITY_VECTOR, MAG = FLAGS + 32, FLAGS + 33, FLAGS + 34, FLAGS + 35
EV_YAW_FAULT, MAG_HEADING_CONSISTENT, RNG_TERRAIN = FLAGS + 36, FLAGS + 37, FLAGS + 39
VALID_FAKE_POS, CONSTANT_POS, BARO_FAULT = FLAGS + 41, FLAGS + 42, FLAGS + 43
GNSS_VEL, GNSS_FAULT, YAW_MANUAL = FLAGS + 44, FLAGS + 45, FLAGS + 46
GNSS_HGT_FAULT, HEADING_OBSERVABLE = FLAGS + 47, FLAGS + 49

# Fault status: PX4's bits, in order.
FAULT_NAMES = [
    "bad_mag_x",
    "bad_mag_y",
    "bad_mag_z",
    "bad_hdg",
    "bad_mag_decl",
    "bad_airspeed",
    "bad_sideslip",
    "bad_optflow_X",
    "bad_optflow_Y",
    "unused",
    "bad_acc_vertical",
    "bad_acc_clipping",
]
FAULT_COUNT = len(FAULT_NAMES)
FAULTS = _reserve(FAULT_COUNT)
BAD_MAG, BAD_HDG, BAD_MAG_DECL = FAULTS, FAULTS + 3, FAULTS + 4
BAD_ACC_VERTICAL, BAD_ACC_CLIPPING = FAULTS + 10, FAULTS + 11

# State resets: how many, and by how much the last one moved the state.
RESET_COUNTS = _reserve(6)
RESETS_BEFORE = _reserve(6) - RESET_COUNTS
R_VELOCITY_NE, R_VELOCITY_D = RESET_COUNTS, RESET_COUNTS + 1
R_POSITION_NE, R_POSITION_D = RESET_COUNTS + 2, RESET_COUNTS + 3
R_QUATERNION, R_TERRAIN = RESET_COUNTS + 4, RESET_COUNTS + 5
CHANGE_VELOCITY = _reserve(3)  # m/s
CHANGE_POSITION = _reserve(3)  # m
CHANGE_QUATERNION = _reserve(4)
CHANGE_TERRAIN = _reserve()  # m

# Height reference.
HEIGHT_REFERENCE = _reserve()
BARO, GNSS, RANGE, EV, UNKNOWN = 0, 1, 2, 3, 4

# Status of each source of observations: a header, then three axes.
AID_NAMES = [
    "fake_pos",
    "fake_hgt",
    "mag",
    "gnss_vel",
    "gnss_pos",
    "gnss_hgt",
    "baro_hgt",
    "rng_hgt",
    "gravity",
    "ev_yaw",
    "ev_vel",
    "ev_pos",
    "ev_hgt",
]
AID_AXES = (2, 1, 3, 3, 2, 1, 1, 1, 3, 1, 3, 2, 1)
A_TIME, A_LAST_FUSE, A_REJECTED, A_FUSED = 0, 1, 2, 3  # header
A_OBSERVATION, A_VARIANCE, A_INNOVATION, A_INNOVATION_VARIANCE = 4, 5, 6, 7  # of axis 0
A_TEST_RATIO, A_TEST_RATIO_FILTERED = 8, 9
A_AXIS = 6  # from one axis to the next
A_SIZE = 4 + 3 * A_AXIS
AID = _reserve(A_SIZE * len(AID_NAMES))
AID_FAKE_POS, AID_FAKE_HGT, AID_MAG = AID, AID + A_SIZE, AID + 2 * A_SIZE
AID_GNSS_VEL, AID_GNSS_POS, AID_GNSS_HGT = AID + 3 * A_SIZE, AID + 4 * A_SIZE, AID + 5 * A_SIZE
AID_BARO_HGT, AID_RNG_HGT, AID_GRAVITY = AID + 6 * A_SIZE, AID + 7 * A_SIZE, AID + 8 * A_SIZE
AID_EV_YAW, AID_EV_VEL, AID_EV_POS = AID + 9 * A_SIZE, AID + 10 * A_SIZE, AID + 11 * A_SIZE
AID_EV_HGT = AID + 12 * A_SIZE

# Bias estimators.
B_BIAS, B_VARIANCE, B_DENSITY, B_MAXIMUM, B_DT, B_ALPHA, B_LPF = 0, 1, 2, 3, 4, 5, 6
B_SINCE_NEGATIVE, B_SINCE_POSITIVE, B_ACTIVE, B_WAS_ACTIVE = 7, 8, 9, 10
B_REPORTED = 11  # the bias when it was last fused, which is what PX4 logs
B_SIZE = 12
BIAS_BARO = _reserve(B_SIZE)
BIAS_GNSS_HGT = _reserve(B_SIZE)
BIAS_EV_HGT = _reserve(B_SIZE)
BIAS_EV_NORTH = _reserve(B_SIZE)
BIAS_EV_EAST = _reserve(B_SIZE)

# Barometer and magnetometer.
BARO_COUNT = _reserve()
MAG_COUNT = _reserve()
MAG_ALIGN_TIME = _reserve()
WORLD_DECLINATION = _reserve()  # rad, NaN until the model was read
WORLD_INCLINATION = _reserve()
WORLD_STRENGTH = _reserve()
WORLD_FIELD = _reserve(3)  # gauss, NED

# GNSS.
GNSS_READY = _reserve()  # a sample passed the checks in this step
GNSS_SAMPLE = _reserve(19)  # the last sample popped, fields as in the ring
CHECKS_PASSED = _reserve()
CHECKS_INITIAL = _reserve()  # passed once since take-off
CHECKS_LAST_FAIL = _reserve()
CHECKS_LAST_PASS = _reserve()
CHECKS_FAILED = _reserve(12)  # one by one, in PX4's order
CHECKS_PREVIOUS = _reserve(4)  # latitude, longitude (rad), altitude, time
CHECKS_DRIFT = _reserve(3)  # m/s, filtered derivative of position
CHECKS_SPEED = _reserve(3)  # m/s, filtered velocity

# Range finder.
RNG_TIME = _reserve()
RNG_RANGE = _reserve()
RNG_QUALITY = _reserve()
RNG_READY = _reserve()
RNG_VALID = _reserve()
RNG_REGULAR = _reserve()
RNG_LAST_VALID = _reserve()
RNG_STUCK = _reserve()
RNG_STUCK_MINIMUM = _reserve()
RNG_STUCK_MAXIMUM = _reserve()
RNG_DT_LPF = _reserve()  # us
RNG_COS_TILT = _reserve()
RNG_BAD_QUALITY = _reserve()  # us
RNG_BLOCKED = _reserve()
RNG_MEDIAN_HISTORY = _reserve(6)  # five distances, and where the next one goes
RNG_MEDIAN_BEFORE = _reserve()
RNG_CHECK_TIME = _reserve()
RNG_CHECK_BEFORE = _reserve()
RNG_CHECK_RATIO = _reserve()
RNG_CHECK_LPF = _reserve()
RNG_CHECK_INCONSISTENT = _reserve()
RNG_CHECK_MOTION = _reserve()
RNG_CONSISTENT = _reserve()
RNG_TERRAIN_VALID = _reserve()  # the height above ground may be used

# External vision.
EV_PREVIOUS_TIME = _reserve()
EV_PREVIOUS_RESETS = _reserve()
EV_PREVIOUS_QUALITY = _reserve()
EV_PREVIOUS_POSITION_FRAME = _reserve()
EV_PREVIOUS_VELOCITY_FRAME = _reserve()
EV_POS_RESETS_LEFT = _reserve()
EV_VEL_RESETS_LEFT = _reserve()
EV_YAW_RESETS_LEFT = _reserve()
EV_ERROR = _reserve(4)  # quaternion from the camera's frame to NED, low-passed
EV_ERROR_SET = _reserve()
FRAME_NED, FRAME_FRD, FRAME_BODY = 0, 1, 2

# Yaw estimator (a Gaussian sum of five filters).
MODELS = 5
# The quaternion comes first, from 0.
G_GYRO_BIAS, G_STATE, G_COVARIANCE, G_INNOVATION = 4, 7, 10, 19
G_NIS, G_DETERMINANT, G_WEIGHT = 21, 22, 23
G_SIZE = 24
GSF = _reserve(G_SIZE * MODELS)
GSF_ACCEL = _reserve(3)
GSF_TILT_ALIGNED = _reserve()
GSF_STARTED = _reserve()
GSF_YAW = _reserve()
GSF_VARIANCE = _reserve()

# Output predictor.
OUT_TIME = _reserve()
OUT_QUATERNION = _reserve(4)
OUT_VELOCITY = _reserve(3)  # m/s, of the IMU
OUT_POSITION = _reserve(3)  # m, of the IMU, from OUT_REFERENCE
OUT_VERTICAL = _reserve(4)  # time, velocity, its integral, time step
OUT_REFERENCE = _reserve(3)  # latitude, longitude (rad), altitude
OUT_ROTATION = _reserve(9)
OUT_IMU_VELOCITY = _reserve(3)  # m/s, of the IMU from the body origin, NED
OUT_ACCELERATION = _reserve(3)  # m/s2, NED, over the last IMU sample
OUT_ANGULAR_VELOCITY = _reserve(3)  # rad/s, FRD, bias removed, over the last IMU sample
OUT_GYRO_BIAS = _reserve(3)
OUT_ACCEL_BIAS = _reserve(3)
OUT_GRAVITY = _reserve()
OUT_UNAIDED_YAW = _reserve()  # rad
OUT_ANGLE_CORRECTION = _reserve(3)  # rad, added to every delta angle
OUT_VELOCITY_INTEGRAL = _reserve(3)
OUT_POSITION_INTEGRAL = _reserve(3)
OUT_TRACKING_ERROR = _reserve(3)  # rad, m/s, m
OUT_LAST_UPDATE = _reserve()
OUT_LAST_CORRECTION = _reserve()
OUT_IMU_DT = _reserve()  # s, mean
OUT_FILTER_DT = _reserve()  # s, mean

# What the system's ports have already delivered, see `messages`.
ARRIVED = _reserve(6)  # s, time of arrival of the last message of each sensor
CONNECTED = _reserve(6)  # which optional ports have a source, in their order
STATUS_SENT = _reserve(4)  # at rest, in air, ground effect, and when

# The state of another filter to start from, see `warm_start`; no time (0) means there is none.
START_TIME = _reserve()
START_NOMINAL = _reserve(NOMINAL_SIZE)
START_PLACE = _reserve(3)  # latitude, longitude (rad), altitude (m)
START_VARIANCES = _reserve(ERRORS)
START_FLAGS = _reserve(FLAG_COUNT)
START_BIASES = _reserve(2 * 5)  # bias and variance of each bias estimator, NaN where not known

# Rings: a header each; the entries stand behind the fixed part, a time first.
RING_DATA, RING_ENTRIES, RING_WIDTH, RING_HEAD, RING_TAIL, RING_EMPTY = 0, 1, 2, 3, 4, 5
RING_POPPED_TIME, RING_PUSH_TIME, RING_IN_USE = 6, 7, 8
_RING_SIZE = 9
RING_IMU = _reserve(_RING_SIZE)
RING_OUTPUT = _reserve(_RING_SIZE)
RING_VERTICAL = _reserve(_RING_SIZE)
RING_GNSS = _reserve(_RING_SIZE)
RING_BARO = _reserve(_RING_SIZE)
RING_MAG = _reserve(_RING_SIZE)
RING_RANGE = _reserve(_RING_SIZE)
RING_EV = _reserve(_RING_SIZE)
RING_STATUS = _reserve(_RING_SIZE)
FIXED_SIZE = _size

# Fields behind the time of a ring's entries.
IMU_FIELDS = 11  # delta angle 3, delta velocity 3, two time steps, clipping 3
OUTPUT_FIELDS = 10  # quaternion 4, velocity 3, position 3
VERTICAL_FIELDS = 3  # velocity, integral, time step
# latitude, longitude (deg), altitude, velocity 3, three accuracies, fix, satellites, PDOP,
# spoofed, jammed
GNSS_FIELDS = 14
(GNSS_LAT, GNSS_LON, GNSS_ALT, GNSS_V, GNSS_HACC, GNSS_VACC, GNSS_SACC, GNSS_FIX, GNSS_SATS) = (
    1, 2, 3, 4, 7, 8, 9, 10, 11,
)  # fmt: skip
GNSS_PDOP, GNSS_SPOOFED, GNSS_JAMMED = 12, 13, 14
BARO_FIELDS = 2  # altitude, reset
MAG_FIELDS = 4  # field 3, reset
RANGE_FIELDS = 2  # range, quality
# position 3, velocity 3, quaternion 4, their variances 3 each, two frames, reset counter, quality
EV_FIELDS = 23
EV_P, EV_V, EV_Q, EV_P_VAR, EV_V_VAR, EV_Q_VAR = 1, 4, 7, 11, 14, 17
EV_P_FRAME, EV_V_FRAME, EV_RESETS, EV_QUALITY = 20, 21, 22, 23
STATUS_FIELDS = 5  # at rest, in air, ground effect, constant position, fixed wing

_RINGS = (
    (RING_IMU, IMU_FIELDS, True),
    (RING_OUTPUT, OUTPUT_FIELDS, True),
    (RING_VERTICAL, VERTICAL_FIELDS, True),
    (RING_GNSS, GNSS_FIELDS, False),
    (RING_BARO, BARO_FIELDS, False),
    (RING_MAG, MAG_FIELDS, False),
    (RING_RANGE, RANGE_FIELDS, False),
    (RING_EV, EV_FIELDS, False),
    (RING_STATUS, STATUS_FIELDS, False),
)


def initial_state(p: np.ndarray) -> np.ndarray:
    """The filter before its first sample, for a parameter array.

    Parameters
    ----------
    p : np.ndarray
        From `parameters.parameter_array`, shape (parameters.SIZE,).

    Returns
    -------
    np.ndarray
        One-dimensional; its size depends on EKF2_DELAY_MAX and EKF2_PREDICT_US.
    """
    imu_length, observation_length = prm.ring_lengths(p)
    lengths = [imu_length if at_imu_rate else observation_length for *_, at_imu_rate in _RINGS]
    widths = [1 + fields for _, fields, _ in _RINGS]
    x = np.zeros(FIXED_SIZE + sum(n * w for n, w in zip(lengths, widths, strict=True)))
    data = FIXED_SIZE
    for (ring, _, at_imu_rate), length, width in zip(_RINGS, lengths, widths, strict=True):
        x[ring + RING_DATA], x[ring + RING_ENTRIES], x[ring + RING_WIDTH] = data, length, width
        x[ring + RING_EMPTY] = 1.0
        x[ring + RING_IN_USE] = at_imu_rate
        data += length * width
    outputs = int(x[RING_OUTPUT + RING_DATA])
    x[outputs + 1 : outputs + imu_length * widths[1] : widths[1]] = 1.0  # identity quaternions

    for quaternion in (QUATERNION, DS_DELTA_ANGLE, CHANGE_QUATERNION, EV_ERROR, OUT_QUATERNION):
        x[quaternion] = 1.0
    for matrix in (ROTATION, OUT_ROTATION):
        x[[matrix, matrix + 4, matrix + 8]] = 1.0
    x[RING_LENGTH] = observation_length
    x[TERRAIN] = p[prm.EKF2_MIN_RNG]
    x[DT_AVERAGE] = 0.010  # s
    # the first accumulation of IMU samples, before EKF2_PREDICT_US is known
    x[DS_AVERAGE_DT], x[DS_REQUIRED] = 0.005, 2.0  # s, samples
    x[DS_TARGET_DT], x[DS_MINIMUM_DT] = 0.010, 0.005  # s
    x[GRAVITY] = x[OUT_GRAVITY] = STANDARD_GRAVITY
    x[ORIGIN_ALTITUDE] = np.nan
    x[HORIZONTAL_EXCEEDED] = x[VERTICAL_POSITION_EXCEEDED] = x[VERTICAL_VELOCITY_EXCEEDED] = 1.0
    x[IN_AIR] = x[IN_AIR + BEFORE] = 1.0  # until told otherwise
    x[HEIGHT_REFERENCE] = UNKNOWN
    x[WORLD_DECLINATION] = x[WORLD_INCLINATION] = x[WORLD_STRENGTH] = np.nan
    x[RNG_CONSISTENT] = 1.0
    x[RNG_COS_TILT] = 1.0
    x[EV_PREVIOUS_POSITION_FRAME] = FRAME_FRD
    x[EV_PREVIOUS_VELOCITY_FRAME] = FRAME_BODY
    x[GSF_VARIANCE] = np.inf
    x[OUT_IMU_DT], x[OUT_FILTER_DT] = 0.005, 0.010  # s
    x[GSF : GSF + G_SIZE * MODELS : G_SIZE] = 1.0
    for bias in (BIAS_BARO, BIAS_GNSS_HGT, BIAS_EV_HGT, BIAS_EV_NORTH, BIAS_EV_EAST):
        x[bias + B_DENSITY] = 1.25e-6  # m2/s2/Hz
        x[bias + B_MAXIMUM] = 2.0  # m2
        x[bias + B_DT] = 0.01  # s
    x[BIAS_EV_NORTH + B_VARIANCE] = x[BIAS_EV_EAST + B_VARIANCE] = 0.1  # m2
    x[ARRIVED : ARRIVED + 6] = -1.0
    x[STATUS_SENT : STATUS_SENT + 4] = -1.0
    return x

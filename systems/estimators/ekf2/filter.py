"""The filter as a whole: feeding it samples, and one step at the delayed horizon.

`initialise` makes the flat array, the `push_…` functions feed it, `update` does a
filter step whenever the IMU down-sampler has completed one. All are plain
functions over arrays and compiled, so a log is replayed at the speed of C; the
Drake system in `ekf2` calls the same ones. Times are whole microseconds as
floats, frames NED and FRD.
"""

import math

import numpy as np

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.aiding import north_east_aiding
from systems.estimators.ekf2.buffers import (
    down_sample,
    oldest,
    pop,
    push_down_sampled,
    push_observation,
)
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.external_vision import control_external_vision
from systems.estimators.ekf2.geometry import limit
from systems.estimators.ekf2.gnss import control_gnss
from systems.estimators.ekf2.height import (
    check_vertical_acceleration,
    choose_reference,
    control_barometer,
    control_gnss_height,
    update_ground_effect,
)
from systems.estimators.ekf2.magnetometer import control_magnetometer
from systems.estimators.ekf2.output_predictor import (
    align_output,
    correct_output,
    predict_lever_arm,
    predict_output,
    remember_output,
)
from systems.estimators.ekf2.prediction import (
    inhibit_biases,
    initialise_covariance,
    initialise_tilt,
    predict_covariance,
    predict_state,
)
from systems.estimators.ekf2.range_finder import (
    control_range_finder,
    control_terrain,
    height_above_ground,
    height_above_ground_valid,
    update_terrain_validity,
)
from systems.estimators.ekf2.resets import local_position
from systems.estimators.ekf2.unaided import (
    control_fake_height,
    control_fake_position,
    control_gravity,
    tilt_variance,
    update_dead_reckoning,
    update_zero_gyro,
    update_zero_velocity,
)
from systems.estimators.ekf2.warm_start import take_over

_ALIGNED = math.radians(3.0) ** 2  # rad2, tilt variance of an aligned filter
_SENSOR_ALPHA = 0.01 / (0.01 + 0.09)  # low-pass of 0.09 s at the nominal filter step


def initialise(p: np.ndarray) -> np.ndarray:
    """The filter's array before the first sample.

    Parameters
    ----------
    p : np.ndarray
        From `parameters.parameter_array`, shape (parameters.SIZE,).
    """
    return at.initial_state(p)


@kernel
def push_imu(x, p, imu):
    """Feed an IMU sample; true if a filter step is due.

    Parameters
    ----------
    imu : np.ndarray
        Time (us), delta angle 3 (rad), delta velocity 3 (m/s), the two time
        steps (s), clipping 3 (0/1), shape (12,).
    """
    if not x[at.INITIALISED]:
        x[at.INITIALISED] = 1.0
        x[at.TIME_DELAYED] = imu[0]
    x[at.TIME_LATEST] = imu[0]
    predict_output(x, imu)
    predict_lever_arm(x, p, imu)
    if down_sample(x, imu):
        push_down_sampled(x, p, imu[0])
    return x[at.IMU_UPDATED] != 0.0


@kernel
def _fill(x, entry, row, fields):
    if entry >= 0:
        for i in range(1, 1 + fields):
            x[entry + i] = row[i]


@kernel
def push_gnss(x, p, row):
    """Feed a GNSS sample.

    Parameters
    ----------
    row : np.ndarray
        Time (us), latitude, longitude (deg), altitude (m), velocity NED 3 (m/s),
        horizontal, vertical (m) and speed accuracy (m/s), fix type, satellites,
        PDOP, spoofed, jammed, shape (15,).
    """
    _fill(x, push_observation(x, at.RING_GNSS, row[0], 0.0), row, at.GNSS_FIELDS)


@kernel
def push_barometer(x, p, row):
    """Feed a barometer sample: time (us), altitude (m), sensor changed (0/1), shape (3,)."""
    entry = push_observation(x, at.RING_BARO, row[0], p[prm.EKF2_BARO_DELAY])
    _fill(x, entry, row, at.BARO_FIELDS)


@kernel
def push_magnetometer(x, p, row):
    """Feed a magnetometer sample: time (us), field 3 (gauss), sensor changed (0/1), shape (5,)."""
    entry = push_observation(x, at.RING_MAG, row[0], p[prm.EKF2_MAG_DELAY])
    _fill(x, entry, row, at.MAG_FIELDS)


@kernel
def push_range(x, p, row):
    """Feed a range: time (us), range (m), quality (0..100, −1 unknown), shape (3,)."""
    entry = push_observation(x, at.RING_RANGE, row[0], p[prm.EKF2_RNG_DELAY])
    _fill(x, entry, row, at.RANGE_FIELDS)


@kernel
def push_external_vision(x, p, row):
    """Feed an external vision sample.

    Parameters
    ----------
    row : np.ndarray
        Time (us), position 3 (m), velocity 3 (m/s), attitude (w first, body to the
        position's frame), variances of position 3, velocity 3, angles 3, frame of
        position and of velocity (`layout.FRAME_…`), reset counter, quality,
        shape (24,). NaN where not measured.
    """
    entry = push_observation(x, at.RING_EV, row[0], p[prm.EKF2_EV_DELAY])
    if entry < 0:
        return
    _fill(x, entry, row, at.EV_FIELDS)
    for i in range(3):
        for first, noise in (
            (at.EV_P_VAR, p[prm.EKF2_EVP_NOISE]),
            (at.EV_V_VAR, p[prm.EKF2_EVV_NOISE]),
            (at.EV_Q_VAR, p[prm.EKF2_EVA_NOISE]),
        ):
            variance = x[entry + first + i]
            if p[prm.EKF2_EV_NOISE_MD] != 0.0 or not math.isfinite(variance):
                x[entry + first + i] = noise * noise


@kernel
def push_status(x, p, row):
    """Feed the vehicle's status.

    Parameters
    ----------
    row : np.ndarray
        Time (us), at rest, in the air, in ground effect, at a constant position,
        fixed wing (0/1), shape (6,).
    """
    _fill(x, push_observation(x, at.RING_STATUS, row[0], 0.0), row, at.STATUS_FIELDS)


@kernel
def _take_status(x):
    sample = pop(x, at.RING_STATUS, x[at.TIME_DELAYED])
    if sample < 0:
        return
    x[at.AT_REST] = x[sample + 1]
    set_in_air(x, x[sample + 2])
    if x[sample + 3]:
        x[at.GND_EFFECT] = 1.0
        x[at.T_GROUND_EFFECT] = x[at.TIME_DELAYED]
    x[at.CONSTANT_POS] = x[sample + 4]
    x[at.FIXED_WING] = x[sample + 5]


@kernel
def set_in_air(x, in_air):
    """Tell the filter at once whether the vehicle is in the air."""
    x[at.T_IN_AIR if in_air else at.T_ON_GROUND] = x[at.TIME_DELAYED]
    x[at.IN_AIR] = in_air


@kernel
def _load_delayed_sample(x):
    """Copy the oldest IMU sample to its place, and low-pass it; false if it is empty."""
    entry = oldest(x, at.RING_IMU)
    for i in range(at.IMU_FIELDS):
        x[at.IMU_DELTA_ANGLE + i] = x[entry + 1 + i]
    return x[at.IMU_VELOCITY_DT] >= 1e-4 and x[at.IMU_ANGLE_DT] >= 1e-4


@kernel
def _average_step(x, p):
    nominal = 1e-6 * p[prm.EKF2_PREDICT_US]
    step = np.float32(0.5) * (np.float32(x[at.IMU_VELOCITY_DT]) + np.float32(x[at.IMU_ANGLE_DT]))
    step = np.float32(limit(step, 0.5 * nominal, 2.0 * nominal))
    if not x[at.FIRST_STEP_DONE]:
        alpha = 1.0
        x[at.DT_AVERAGE] = step
        x[at.FIRST_STEP_DONE] = 1.0
    else:
        alpha = _SENSOR_ALPHA
        # in single precision, see `buffers`
        x[at.DT_AVERAGE] = np.float32(0.99) * np.float32(x[at.DT_AVERAGE]) + np.float32(0.01) * step
    for i in range(3):
        accel = x[at.IMU_DELTA_VELOCITY + i] / x[at.IMU_VELOCITY_DT]
        x[at.ACCEL_LPF + i] += alpha * (accel - x[at.ACCEL_LPF + i])
        rate = x[at.IMU_DELTA_ANGLE + i] / x[at.IMU_ANGLE_DT]
        x[at.GYRO_LPF + i] += alpha * (rate - x[at.GYRO_LPF + i])


@kernel
def _control_fusion(x, p):
    """Fuse what the horizon has reached, in PX4's order."""
    for i in range(at.FLAGS, at.FLAGS + at.FLAG_COUNT):
        x[i + at.BEFORE] = x[i]
    for i in range(at.RESET_COUNTS, at.RESET_COUNTS + 6):
        x[i + at.RESETS_BEFORE] = x[i]
    _take_status(x)
    if not x[at.TILT_ALIGN] and tilt_variance(x) < _ALIGNED:
        x[at.TILT_ALIGN] = 1.0
    control_magnetometer(x, p)
    control_gnss(x, p)
    check_vertical_acceleration(x)
    update_ground_effect(x, p, height_above_ground_valid(x), height_above_ground(x))
    control_barometer(x, p)
    control_gnss_height(x, p)
    control_range_finder(x, p)
    choose_reference(x, p)
    control_gravity(x, p)
    control_external_vision(x, p)
    control_terrain(x, p)
    update_terrain_validity(x)
    update_zero_velocity(x, p)
    if (int(p[prm.EKF2_IMU_CTRL]) & 1) != 0:
        update_zero_gyro(x, p)
    control_fake_position(x, p)
    control_fake_height(x, p)
    update_dead_reckoning(x, p)
    yaw_aided = x[at.MAG_HDG] or x[at.MAG_3D] or x[at.EV_YAW]
    x[at.HEADING_OBSERVABLE] = bool(north_east_aiding(x) or yaw_aided)


@kernel
def update(x, p):
    """Do a filter step if one is due; true if the state at the horizon was updated."""
    if not x[at.IMU_UPDATED]:
        return False
    x[at.IMU_UPDATED] = 0.0
    if not _load_delayed_sample(x):
        return False
    _average_step(x, p)
    if x[at.START_TIME] != 0.0:
        remember_output(x)
        if x[at.TIME_DELAYED] < x[at.START_TIME]:
            return False
        take_over(x, p)
        x[at.FILTER_INITIALISED] = 1.0
        return True
    if not x[at.FILTER_INITIALISED]:
        if not initialise_tilt(x):
            return False
        initialise_covariance(x, p)
        align_output(x)
        x[at.FILTER_INITIALISED] = 1.0
    inhibit_biases(x, p)
    predict_covariance(x, p)
    predict_state(x, p)
    _control_fusion(x, p)
    correct_output(x, p)
    x[at.POSITION], x[at.POSITION + 1] = local_position(x)
    datum = x[at.ORIGIN_ALTITUDE]
    x[at.POSITION + 2] = (datum if math.isfinite(datum) else 0.0) - x[at.ALTITUDE]
    return True

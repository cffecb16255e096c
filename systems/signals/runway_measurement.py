"""What travels between the blocks of the fixed wing that lands without GPS, and when.

A second vehicle has its own layouts and its own clock. All positions and
velocities are in the NED frame of the touch-down point (subscript `n`, see
`systems.runway_frames`), all angles in radians, yaw-pitch-roll in that order.

The clock is the one of the thesis (Leonard 2016, Tables 3 and 21): 100, 50 and
25 Hz, periods of 10 ms times powers of two, which are exact multiples of each
other in floating point. The laser's 10 Hz and the antenna's 1 or 2 Hz are
counted on the 20 or 40 ms grid by the sensor's own sample clock. This vehicle shares
no diagram with the multirotor.

| phase | offset | who, in order of cause |
|---|---|---|
| sense and decide | 0 ms | plant, sensors, phase supervisor, error record |
| estimate and act | 5 ms | tracker, filter, flight controller |
"""

from itertools import accumulate

import numpy as np
from numba import njit

from systems.signals.measurement import Layout, measurement_layout, no_measurement, vector

ATTITUDE_PERIOD = 0.01  # s, IMU attitude and filter, 100 Hz (Table 3)
NAVIGATION_PERIOD = 0.02  # s, IMU position and speed, baro, flight controller, 50 Hz (Table 3)
PICTURE_PERIOD = 0.04  # s, camera and tracker, 25 Hz (Table 3)
LASER_PERIOD = 0.1  # s, 10 Hz (Table 3)
SLOW_PERIOD = 0.08  # s, compass, air data and wheels: no rate in the thesis
ANTENNA_PERIOD = 1.0  # s, 1 Hz (Table 21; Table 3 says 2 Hz)
ACT_OFFSET = 0.005  # s, the phase of tracker, filter and flight controller

# The aircraft as it is: the truth that sensors sample.
FIXED_WING_STATE = Layout(
    "FixedWingState",
    (
        *vector("p_n"),  # m, body origin (centre of gravity), NED at the touch-down point
        *vector("v_n"),  # m/s, ground velocity
        "yaw",  # rad, clockwise from north
        "pitch",  # rad, nose up
        "roll",  # rad, right wing down
        "yaw_rate",  # rad/s
        "pitch_rate",  # rad/s
        "roll_rate",  # rad/s
        "airspeed",  # m/s, true
        "height",  # m, of the body origin above the ground below it
        "on_ground",  # 0/1, weight on wheels
    ),
)

# What the flight controller asks of the aircraft.
FIXED_WING_COMMAND = Layout(
    "FixedWingCommand",
    (
        "roll",  # rad
        "vertical_speed",  # m/s, positive down (V_Z of the thesis)
        "deceleration",  # m/s2, wheel brakes, on the ground only
        "yaw_rate",  # rad/s, nose wheel, on the ground only
    ),
)

INERTIAL_NAVIGATION = measurement_layout(
    "InertialNavigationMeasurement",
    (
        *vector("p_n"),  # m; the vertical comes from the baro-inertial altitude
        *vector("v_n"),  # m/s
        "attitude_time",  # s, the attitude is renewed twice as often as the rest
        "yaw",  # rad
        "pitch",  # rad
        "roll",  # rad
    ),
)
BARO_INERTIAL = measurement_layout(
    "BaroInertialMeasurement", ("altitude",)
)  # m above the touch-down point
LASER_HEIGHT = measurement_layout("LaserHeightMeasurement", ("height",))  # m above ground
ANTENNA = measurement_layout(
    "AntennaMeasurement",
    (
        "azimuth",  # rad, of the aircraft seen from the ground station, clockwise from north
        "elevation",  # rad, above the horizon
    ),
)
PICTURE = measurement_layout(
    "PictureMeasurement",
    (
        "u",  # px, of the touch-down point from the left edge
        "v",  # px, from the top edge
        "click",  # how often the operator has pointed at it so far
    ),
)
FIX = measurement_layout(
    "FixMeasurement",
    (
        *vector("p_n"),  # m
        *vector("v_n", "xy"),  # m/s
        "horizontal_accuracy",  # m, one sigma, as the receiver reports it
        "vertical_accuracy",  # m
        "speed_accuracy",  # m/s
    ),
)
MAGNETIC_HEADING = measurement_layout("MagneticHeadingMeasurement", ("heading",))  # rad
WHEEL_SPEED = measurement_layout("WheelSpeedMeasurement", ("speed",))  # m/s
AIRSPEED = measurement_layout("AirspeedMeasurement", ("airspeed",))  # m/s, true

ERROR_STATES = ("x", "y", "z", "vn", "ve")
# The filter's answer: the corrected inertial navigation, its errors and their covariance.
NAVIGATION_ESTIMATE = Layout(
    "NavigationEstimate",
    (
        "time_of_validity",  # s
        "initialised",  # 0/1
        *vector("p_n"),  # m
        *vector("v_n"),  # m/s
        "yaw",  # rad
        "pitch",  # rad
        "roll",  # rad
        *(f"error_{name}" for name in ERROR_STATES),  # estimated error of the inertial navigation
        # covariance of the five errors, upper triangle by rows: m2, m2/s, (m/s)2
        *(f"covariance_{a}_{b}" for i, a in enumerate(ERROR_STATES) for b in ERROR_STATES[i:]),
        "bearing_innovation",  # rad, of the newest picture
        "bearing_innovation_variance",  # rad2
        "elevation_innovation",  # rad
        "elevation_innovation_variance",  # rad2
        "laser_innovation",  # m
        "laser_innovation_variance",  # m2
        "rejected",  # measurements refused by the gate so far
        *vector("wind", "xy"),  # m/s, north and east; 0 where not estimated
        "declination",  # rad; 0 where not estimated
    ),
)

GUIDANCE = Layout(
    "Guidance",
    (
        "leg",  # index of the route's leg; the last one is the landing
        "landing",  # 0/1, the last waypoint of the return is passed
        "cross_track",  # m, right of the leg
        "altitude_error",  # m, positive where the aircraft is too low
        "integral",  # m s, of the altitude error
    ),
)

PHASE_STATUS = Layout(
    "PhaseStatus",
    (
        "phase",  # index, see systems.supervisors.runway_phases.Phase
        "time_in_phase",  # s
        "silent",  # s, since the last fix of the receiver
        "stopped",  # 0/1, at a standstill after braking
    ),
)

# What the filter works on: the newest measurement of each sensor, and the phase, one after the
# other in one port, because reading ten ports costs a Python system ten microseconds.
FILTER_INPUTS: tuple[tuple[str, Layout], ...] = (
    ("inertial", INERTIAL_NAVIGATION),
    ("baro", BARO_INERTIAL),
    ("fix", FIX),
    ("antenna", ANTENNA),
    ("picture", PICTURE),
    ("laser", LASER_HEIGHT),
    ("phase", PHASE_STATUS),
    ("heading", MAGNETIC_HEADING),
    ("wheel_speed", WHEEL_SPEED),
    ("airspeed", AIRSPEED),
)
MEASUREMENTS = Layout(
    "Measurements",
    tuple(f"{name}_{field}" for name, layout in FILTER_INPUTS for field in layout.fields),
)
# where each of them begins, and the end: the baro's are the entries BARO_AT to FIX_AT
(
    BARO_AT, FIX_AT, ANTENNA_AT, PICTURE_AT, LASER_AT, PHASE_AT, HEADING_AT, WHEELS_AT,
    AIRSPEED_AT, MEASUREMENTS_END,
) = accumulate(layout.size for _, layout in FILTER_INPUTS)  # fmt: skip


def no_measurements() -> np.ndarray:
    """What stands in `MEASUREMENTS` before the first samples, shape (MEASUREMENTS.size,)."""
    first = [
        layout.zeros() if layout is PHASE_STATUS else no_measurement(layout)
        for _, layout in FILTER_INPUTS
    ]
    return np.concatenate(first)


@njit(cache=True)
def enqueue(pipeline, message, ready):
    """Put `message` into a sensor's pipeline; it may leave at time `ready` (s).

    Parameters
    ----------
    pipeline : array, shape (2 + capacity * (size + 1),)
        `[a number of its owner's, count, (ready, message …) …]`, the oldest first.
        When it is full the newest message is lost.
    message : array, shape (size,)
    ready : float
    """
    stride = message.shape[0] + 1
    count = int(pipeline[1])
    start = 2 + count * stride
    if start + stride > pipeline.shape[0]:
        return
    pipeline[start] = ready
    pipeline[start + 1 : start + stride] = message
    pipeline[1] = count + 1


@njit(cache=True)
def release(pipeline, output, time):
    """Move every message that is ready at `time` (s) to `output`, stamping its arrival.

    Only the newest of them stays in `output`, shape (size,).
    """
    stride = output.shape[0] + 1
    count = int(pipeline[1])
    due = 0
    while due < count and pipeline[2 + due * stride] <= time + 1e-9:
        due += 1
    if due == 0:
        return
    last = 2 + (due - 1) * stride
    output[:] = pipeline[last + 1 : last + stride]
    output[1] = time  # time_of_arrival
    for i in range((count - due) * stride):
        pipeline[2 + i] = pipeline[2 + due * stride + i]
    pipeline[1] = count - due

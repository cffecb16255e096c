"""A log of a simulated flight: sensors whose errors are known exactly, and the truth.

The vehicle stands for `REST` s, climbs and flies a figure; its attitude is the one that
gives a multirotor its acceleration. For studies of the filter alone, where a whole
vehicle in the loop would add nothing but time.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from systems.estimators.ekf2.geometry import EARTH_SPIN, metres_per_radian, normal_gravity
from systems.signals import sensor_log as logs
from systems.signals.noise import stream_key
from systems.signals.sensor_log import SensorLog

ORIGIN = (47.3977, 8.5456, 488.0)  # deg, deg, m: Zurich, where PX4's simulations start
EARTH_FIELD = (3.4056, 63.157, 0.48239)  # deg, deg (down), gauss; PX4's model there
IMU_RATE = 250.0  # Hz
REST = 8.0  # s
_RISE = 4.0  # s, in which the figure grows to its size
_STATUS_PERIOD = 0.5  # s


@dataclass(frozen=True)
class Errors:
    """Errors of the sensors: standard deviations, of each axis."""

    gyro: float = 0.0212  # rad/s, white, of a sample
    accelerometer: float = 0.495  # m/s2, white, of a sample
    gyro_bias: float = 0.03  # rad/s, at the start
    accelerometer_bias: float = 0.1  # m/s2
    gyro_walk: float = 5.7e-6  # rad/s, step of the bias at each sample
    accelerometer_walk: float = 1.7e-5  # m/s2
    gnss_position: float = 0.5  # m, horizontal; 1.5 times as much vertical
    gnss_velocity: float = 0.3  # m/s, horizontal; 1.5 times as much vertical
    gnss_correlation: float = 0.0  # s, time constant of the position error; 0: white
    barometer: float = 3.5  # m, white
    barometer_offset: float = 10.0  # m
    magnetometer: float = 0.05  # gauss, white
    earth_field: float = 0.005  # gauss, of the model
    body_field: float = 0.005  # gauss, of the vehicle's own magnetism
    vision: float = 0.1  # m


# The defaults are what PX4's default parameters say; EKF2_GYR_NOISE and EKF2_ACC_NOISE act as
# standard deviations of a filter step, here of two samples. Only the biases are smaller than
# EKF2_GBIAS_INIT and EKF2_ABIAS_INIT, or one in seven would lie beyond the filter's own limits,
# and the field errors smaller than EKF2_MAG_NOISE, so that the first heading is right to 2 deg.
MATCHED = Errors()
# With field errors of EKF2_MAG_NOISE the first heading is wrong by 15 deg rms.
WRONG_HEADING = replace(MATCHED, earth_field=0.05, body_field=0.05)
# A calibrated vehicle: MEMS data sheets, vibration, a receiver whose error wanders.
PLAUSIBLE = Errors(
    gyro=0.004,
    accelerometer=0.15,
    gyro_bias=0.005,
    accelerometer_bias=0.05,
    gyro_walk=1.4e-7,
    accelerometer_walk=5.4e-6,
    gnss_position=0.5,
    gnss_velocity=0.1,
    gnss_correlation=30.0,
    barometer=0.15,
    magnetometer=0.01,
    earth_field=0.01,
    body_field=0.01,
    vision=0.03,
)


@dataclass(frozen=True)
class Truth:
    """What really happened, at the times of the IMU's samples.

    Attributes
    ----------
    time : np.ndarray
        us, shape (n,).
    attitude : np.ndarray
        Quaternion FRD to NED, w first, shape (n, 4).
    velocity, position : np.ndarray
        NED (m/s, m from `ORIGIN`), shape (n, 3).
    gyro_bias, accel_bias : np.ndarray
        FRD (rad/s, m/s2), shape (n, 3).
    """

    time: np.ndarray
    attitude: np.ndarray
    velocity: np.ndarray
    position: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


@dataclass(frozen=True)
class Rates:
    """How often the sensors measure (Hz; 0 never), and how old a measurement arrives (s)."""

    gnss: float = 5.0
    barometer: float = 25.0
    magnetometer: float = 25.0
    vision: float = 0.0
    gnss_delay: float = 0.110
    vision_delay: float = 0.200
    vision_outliers: tuple[float, ...] = field(default=())  # s, when vision is 15 m off


def simulated_log(
    seed: int, seconds: float = 60.0, errors: Errors = MATCHED, rates: Rates | None = None
) -> tuple[SensorLog, Truth]:
    """Fly and measure.

    GNSS samples are stamped with the time of their measurement, vision with its arrival.

    Parameters
    ----------
    seed : int
        Of all errors; the flight itself is always the same.
    seconds : float
        How long.
    errors : Errors
        Of the sensors.
    rates : Rates, optional
        Of the sensors.
    """
    rates = rates or Rates()
    # arrays of noise are drawn at once, by a generator that only this seed decides
    random = np.random.Generator(np.random.Philox(key=int(stream_key(seed, "simulated log"))))
    step = 1.0 / IMU_RATE
    half_steps = np.arange(2 * round(seconds * IMU_RATE) + 1) * (0.5 * step)
    position, velocity, acceleration = _motion(half_steps, 0.5 * step)
    latitude = np.radians(ORIGIN[0])
    earth = EARTH_SPIN * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])
    gravity = np.array([0.0, 0.0, normal_gravity(latitude)])
    force = acceleration - gravity + 2.0 * np.cross(earth, velocity)  # NED, with Coriolis
    attitude = _attitude(force, 0.4 * _grown(half_steps) * np.sin(0.35 * (half_steps - REST)))

    turn = (attitude[:-2:2].inv() * attitude[2::2]).as_rotvec()
    turn += attitude[1::2].inv().apply(earth) * step
    felt = attitude.inv().apply(force)
    push = (felt[:-2:2] + 4.0 * felt[1::2] + felt[2::2]) * (step / 6.0)  # Simpson's rule
    n = len(turn)
    biases = [
        start * random.standard_normal(3) + walk * np.cumsum(random.standard_normal((n, 3)), axis=0)
        for start, walk in (
            (errors.gyro_bias, errors.gyro_walk),
            (errors.accelerometer_bias, errors.accelerometer_walk),
        )
    ]
    turn += (biases[0] + errors.gyro * random.standard_normal((n, 3))) * step
    push += (biases[1] + errors.accelerometer * random.standard_normal((n, 3))) * step
    time = np.round(half_steps[2::2] * 1e6) + 1e6  # us; a filter's clock never shows 0
    truth = Truth(
        time, np.roll(attitude[2::2].as_quat(), 1, axis=1), velocity[2::2], position[2::2], *biases
    )
    ones = np.ones(n)
    blocks = [(logs.IMU, time, np.column_stack([time, turn, push, ones * step, ones * step]))]
    blocks += _observations(truth, errors, rates, random)
    return _merged(blocks), truth


def _grown(time: np.ndarray) -> np.ndarray:
    """From 0 at rest to 1 in flight, with four derivatives that are continuous."""
    s = np.clip((time - REST) / _RISE, 0.0, 1.0)
    return s**5 * (126.0 + s * (-420.0 + s * (540.0 + s * (-315.0 + s * 70.0))))


def _motion(time: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity, acceleration (NED), shape (n, 3) each."""
    since = time - REST
    grown = _grown(time)[:, None]
    position = grown * np.column_stack(
        [8.0 * np.sin(0.55 * since), 6.0 * np.sin(0.8 * since), -6.0 - 2.0 * np.sin(0.4 * since)]
    )
    velocity = np.gradient(position, step, axis=0, edge_order=2)
    return position, velocity, np.gradient(velocity, step, axis=0, edge_order=2)


def _attitude(force: np.ndarray, yaw: np.ndarray) -> Rotation:
    """FRD to NED of a multirotor that pushes along `force` (NED) and looks towards `yaw`."""
    down = -force / np.linalg.norm(force, axis=1, keepdims=True)
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
    right = np.cross(down, ahead)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([np.cross(right, down), right, down], axis=2))


def _observations(
    truth: Truth, errors: Errors, rates: Rates, random: np.random.Generator
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    last = len(truth.time) - 1
    blocks: list[tuple[int, np.ndarray, np.ndarray]] = []

    def at_rate(rate: float) -> np.ndarray:
        """Indices of the IMU samples at which a sensor measures."""
        return np.arange(0, last + 1, round(IMU_RATE / rate)) if rate > 0.0 else np.arange(0)

    def noise(count: int, *sigmas: float) -> np.ndarray:
        return random.standard_normal((count, len(sigmas))) * sigmas

    k = at_rate(rates.gnss)
    if len(k):
        h, v = errors.gnss_position, errors.gnss_velocity
        wander = noise(len(k), h, h, 1.5 * h)
        if errors.gnss_correlation > 0.0:
            kept = np.exp(-1.0 / (rates.gnss * errors.gnss_correlation))
            for i in range(1, len(k)):
                wander[i] = kept * wander[i - 1] + np.sqrt(1.0 - kept * kept) * wander[i]
        measured = truth.position[k] + wander
        north, east = metres_per_radian(np.radians(ORIGIN[0]), ORIGIN[2])
        ones = np.ones(len(k))
        rows = np.column_stack([
            truth.time[k],
            ORIGIN[0] + np.degrees(measured[:, 0] / north),
            ORIGIN[1] + np.degrees(measured[:, 1] / east),
            ORIGIN[2] - measured[:, 2],
            truth.velocity[k] + noise(len(k), v, v, 1.5 * v),
            *(ones * value for value in (h, 1.5 * h, v, 3.0, 16.0, 1.0, 0.0, 0.0)),
        ])  # fmt: skip
        blocks.append((logs.GNSS, truth.time[k] + round(1e6 * rates.gnss_delay), rows))
    k = at_rate(rates.barometer)
    offset = ORIGIN[2] + errors.barometer_offset * random.standard_normal()
    altitude = offset - truth.position[k, 2] + noise(len(k), errors.barometer)[:, 0]
    rows = np.column_stack([truth.time[k], altitude])
    blocks.append((logs.BAROMETER, truth.time[k], rows))
    k = at_rate(rates.magnetometer)
    declination, inclination = np.radians(EARTH_FIELD[:2])
    field_ned = EARTH_FIELD[2] * np.array([
        np.cos(inclination) * np.cos(declination), np.cos(inclination) * np.sin(declination),
        np.sin(inclination),
    ])  # fmt: skip
    field_ned += noise(1, *[errors.earth_field] * 3)[0]
    attitude = Rotation.from_quat(np.roll(truth.attitude[k], -1, axis=1))
    strength = attitude.inv().apply(field_ned) + noise(1, *[errors.body_field] * 3)
    strength += noise(len(k), *[errors.magnetometer] * 3)
    rows = np.column_stack([truth.time[k], strength])
    blocks.append((logs.MAGNETOMETER, truth.time[k], rows))
    k = at_rate(rates.vision)
    if len(k):
        blocks.append(_vision(truth, k, errors, rates, noise(len(k), *[errors.vision] * 3)))
    status = np.arange(0, last + 1, round(IMU_RATE * _STATUS_PERIOD))
    flying = truth.time[status] - 1e6 > REST * 1e6
    rows = np.column_stack([truth.time[status], ~flying, flying])
    blocks.append((logs.STATUS, truth.time[status], rows))
    return blocks


def _vision(
    truth: Truth, k: np.ndarray, errors: Errors, rates: Rates, noise: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray]:
    """Positions in NED, stamped with their arrival as a companion computer's often are."""
    arrival = truth.time[k] + round(1e6 * rates.vision_delay)
    rows = np.full((len(k), logs.ROW), np.nan)
    rows[:, 0] = arrival
    rows[:, 1:4] = truth.position[k] + noise
    for when in rates.vision_outliers:
        rows[int(np.argmin(np.abs(truth.time[k] - 1e6 * (when + 1.0)))), 1] += 15.0
    rows[:, 11:14] = errors.vision**2
    rows[:, 20], rows[:, 21] = logs.LOCAL_NED, logs.LOCAL_NED
    rows[:, 22], rows[:, 23] = 0.0, 100.0
    return logs.EXTERNAL_VISION, arrival, rows


def _merged(blocks: list[tuple[int, np.ndarray, np.ndarray]]) -> SensorLog:
    """All samples in order of arrival, up to the IMU's last one."""
    kinds = np.concatenate([np.full(len(t), kind, dtype=np.int64) for kind, t, _ in blocks])
    arrivals = np.concatenate([t for _, t, _ in blocks])
    rows = np.zeros((len(kinds), logs.ROW))
    first = 0
    for _, times, own in blocks:
        rows[first : first + len(times), : own.shape[1]] = own
        first += len(times)
    order = np.lexsort((kinds, arrivals))
    order = order[arrivals[order] <= blocks[0][1][-1]]
    return SensorLog(kinds[order], arrivals[order], rows[order])


def without(samples: SensorLog, kind: int, keep_every: int = 0) -> SensorLog:
    """The same log without one kind of sample, or with only every so many-th of them."""
    own = np.flatnonzero(samples.kinds == kind)
    dropped = np.setdiff1d(own, own[::keep_every]) if keep_every else own
    kept = np.ones(len(samples.kinds), dtype=bool)
    kept[dropped] = False
    return replace(
        samples, kinds=samples.kinds[kept], arrivals=samples.arrivals[kept], rows=samples.rows[kept]
    )

"""Whether the samples of a log are believable: times, magnitudes, and the IMU as a whole."""

from collections.abc import Callable
from typing import Any

import numpy as np

from runs.flight_log import ReplayError
from systems.signals import sensor_log as logs
from systems.signals.sensor_log import SensorLog

Fail = Callable[[Any, str], None]  # says what is wrong with a row, by raising

_LATEST_US = 4e15  # us; float64 counts whole microseconds to 9e15
_LONGEST_DELAY_US = 10e6
_GAP_US = 10e6  # longest hole in the IMU's samples
_IMU_PERIOD_US = (400.0, 50_000.0)  # 2500 to 20 Hz
_SPECIFIC_FORCE = (4.0, 25.0)  # m/s2, median over a flight

# Largest believable magnitudes: (columns, limit, what).
_LIMITS: dict[int, tuple[tuple[slice, float, str], ...]] = {
    logs.GNSS: (
        (slice(1, 2), 90.0, "latitude (deg)"),
        (slice(2, 3), 180.0, "longitude (deg)"),
        (slice(3, 4), 1e6, "altitude (m)"),
        (slice(4, 7), 1e3, "velocity (m/s)"),
        (slice(7, 10), 1e7, "accuracy"),
        (slice(10, 12), 255.0, "fix type or satellites"),
        (slice(12, 13), 1e3, "PDOP"),
    ),
    logs.BAROMETER: ((slice(1, 2), 1e5, "altitude (m)"),),
    logs.MAGNETOMETER: ((slice(1, 4), 100.0, "field (gauss)"),),
    logs.RANGE_FINDER: ((slice(1, 2), 1e4, "range (m)"), (slice(2, 3), 127.0, "quality")),
    logs.EXTERNAL_VISION: (
        (slice(1, 4), 1e6, "position (m)"),
        (slice(4, 7), 1e3, "velocity (m/s)"),
        (slice(7, 11), 1.01, "quaternion"),
        (slice(11, 20), 1e6, "variance"),
        (slice(22, 24), 255.0, "reset counter or quality"),
    ),
    logs.STATUS: ((slice(1, 6), 1.0, "flag"),),
    logs.IN_AIR: ((slice(1, 2), 1.0, "flag"),),
}
_GYRO_LIMIT, _ACCELEROMETER_LIMIT = 100.0, 1000.0  # rad/s, m/s2
_NOT_NEGATIVE = {logs.GNSS: slice(7, 13), logs.EXTERNAL_VISION: slice(11, 20)}


def checked(samples: SensorLog, where: list[str], name: str) -> SensorLog:
    """The same samples if they are believable; `where` says of each which line it is.

    Raises
    ------
    ReplayError
        At the first sample that is not.
    """

    def fail(row: int, sentence: str) -> None:
        raise ReplayError(f"{name}, {where[row]}: {sentence}")

    _check_times(samples, fail)
    _check_limits(samples, fail)
    _check_imu(samples, fail, name)
    return samples


def _check_times(samples: SensorLog, fail: Fail) -> None:
    arrivals, stamps = samples.arrivals, samples.rows[:, 0]
    with np.errstate(invalid="ignore"):
        if (i := _first(~((arrivals >= 0.0) & (arrivals <= _LATEST_US)))) is not None:
            fail(i, f"expected a time of arrival in microseconds, not {arrivals[i]:g}")
        if (i := _first(np.diff(arrivals, prepend=-1.0) < 0.0)) is not None:
            fail(i, f"arrives before its predecessor ({arrivals[i]:.0f} us)")
        in_time = (stamps <= arrivals + 1e5) & (stamps >= arrivals - _LONGEST_DELAY_US)
        if (i := _first((samples.kinds != logs.IN_AIR) & ~in_time)) is not None:
            fail(
                i,
                f"expected a time stamp up to {_LONGEST_DELAY_US * 1e-6:.0f} s before the arrival "
                f"at {arrivals[i]:.0f} us, not {stamps[i]:.0f} us",
            )


def _check_limits(samples: SensorLog, fail: Fail) -> None:
    for kind, limits in _LIMITS.items():
        own = np.flatnonzero(samples.kinds == kind)
        rows, name = samples.rows[own], logs.KINDS[kind]
        for columns, limit, what in limits:
            values = rows[:, columns]
            bad = ~(np.abs(values) <= limit)
            if kind == logs.EXTERNAL_VISION:  # NaN where not measured
                bad &= ~np.isnan(values)
            if (i := _first(bad.any(axis=1))) is not None:
                found = _worst(values[i])
                fail(own[i], f"{name}: expected {what} of magnitude up to {limit:g}, not {found}")
        if kind in _NOT_NEGATIVE:
            negative = (rows[:, _NOT_NEGATIVE[kind]] < 0.0).any(axis=1)
            if (i := _first(negative)) is not None:
                fail(own[i], f"{name}: a standard deviation or variance is negative")


def _check_imu(samples: SensorLog, fail: Fail, name: str) -> None:
    own = np.flatnonzero(samples.kinds == logs.IMU)
    if len(own) < 10:
        raise ReplayError(f"{name}: expected IMU samples, found {len(own)}")
    rows = samples.rows[own]
    periods = np.diff(rows[:, 0])
    steps = rows[:, 7:9]
    if (i := _first(~((steps >= 1e-5) & (steps <= 1.0)).all(axis=1))) is not None:
        fail(own[i], f"IMU: expected time steps of 10 us to 1 s, not {steps[i]} s")
    for first, step, limit, what in (
        (1, 7, _GYRO_LIMIT, "turn rate (rad/s)"),
        (4, 8, _ACCELEROMETER_LIMIT, "specific force (m/s2)"),
    ):
        with np.errstate(over="ignore"):
            values = rows[:, first : first + 3] / rows[:, step : step + 1]
        if (i := _first(~(np.abs(values) <= limit).all(axis=1))) is not None:
            fail(own[i], f"IMU: expected a {what} up to {limit:g}, not {_worst(values[i])}")
    if (i := _first(periods < 0.0)) is not None:
        fail(own[i + 1], "IMU: its time stamp is earlier than its predecessor's")
    if (i := _first(periods > _GAP_US)) is not None:
        fail(own[i + 1], f"IMU: {periods[i] * 1e-6:.0f} s without a sample before it")
    period = float(np.median(periods))
    if not _IMU_PERIOD_US[0] <= period <= _IMU_PERIOD_US[1]:
        raise ReplayError(
            f"{name}: expected IMU samples every {_IMU_PERIOD_US[0] * 1e-3:g} to "
            f"{_IMU_PERIOD_US[1] * 1e-3:g} ms, they come every {period * 1e-3:g} ms"
        )
    integrated = 1e6 * float(np.median(steps))
    if not 0.5 <= integrated / period <= 2.0:
        raise ReplayError(
            f"{name}: IMU samples come every {period * 1e-3:g} ms but integrate over "
            f"{integrated * 1e-3:g} ms: the time steps have another unit or stand in another column"
        )
    force = float(np.median(np.linalg.norm(rows[:, 4:7], axis=1) / rows[:, 8]))
    if not _SPECIFIC_FORCE[0] <= force <= _SPECIFIC_FORCE[1]:
        raise ReplayError(
            f"{name}: the accelerometer shows {force:.3g} m/s2 in the median where gravity is 9.8: "
            "columns are swapped or have another unit"
        )


def _first(bad: Any) -> int | None:
    """The first index that is bad, if any."""
    return int(np.argmax(bad)) if bad.any() else None


def _worst(values: np.ndarray) -> str:
    if np.isnan(values).any():
        return "NaN"
    return f"{values[np.argmax(np.abs(values))]:g}"

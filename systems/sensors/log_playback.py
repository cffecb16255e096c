"""Logged samples put back into measurement ports at the times at which they had arrived."""

import math
from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from systems.frames import yaw_of
from systems.signals import sensor_log as logs
from systems.signals.measurement import (
    BAROMETER,
    EXTERNAL_VISION,
    GNSS,
    HEADER,
    INERTIAL,
    MAGNETOMETER,
    RANGE_FINDER,
    Layout,
    measurement_layout,
    no_measurement,
)
from systems.signals.sensor_log import SensorLog

VEHICLE_FLAGS = measurement_layout(
    "VehicleFlags", ("at_rest", "in_air", "ground_effect", "constant_position", "fixed_wing")
)
IN_AIR = measurement_layout("InAir", ("in_air",))  # 0/1, told at once

_PORTS = (
    ("imu", INERTIAL, logs.IMU),
    ("gnss", GNSS, logs.GNSS),
    ("barometer", BAROMETER, logs.BAROMETER),
    ("magnetometer", MAGNETOMETER, logs.MAGNETOMETER),
    ("range_finder", RANGE_FINDER, logs.RANGE_FINDER),
    ("external_vision", EXTERNAL_VISION, logs.EXTERNAL_VISION),
    ("vehicle_flags", VEHICLE_FLAGS, logs.STATUS),
    ("in_air", IN_AIR, logs.IN_AIR),
)


class LogPlayback(LeafSystem):
    """The sensors of a logged flight.

    .. pydrake_system::
        name: LogPlayback
        output_ports:
        - imu
        - gnss
        - barometer
        - magnetometer
        - range_finder
        - external_vision
        - vehicle_flags
        - in_air

    | port | layout | meaning |
    |---|---|---|
    | `imu` | `INERTIAL` | in B |
    | `gnss` | `GNSS` | velocity in W's axes |
    | `barometer` | `BAROMETER` | altitude |
    | `magnetometer` | `MAGNETOMETER` | in B |
    | `range_finder` | `RANGE_FINDER` | along the beam |
    | `external_vision` | `EXTERNAL_VISION` | in W's axes, from the log's local origin |
    | `vehicle_flags` | `VEHICLE_FLAGS` | what the land detector said |
    | `in_air` | `IN_AIR` | the same for "in the air", told at once |

    It has no state: each port is a function of time alone, the newest sample of its
    kind that has arrived, and before the first one `no_measurement`. A sample's
    time of validity is its stamp in the log. NED and FRD become W and B by exchanging
    and negating components, which is exact; only the yaw of external vision is
    computed. Of two samples of one kind and one time of arrival the port shows the later.

    Parameters
    ----------
    samples : SensorLog
        The log.
    gnss_delay : float
        us, taken off the stamps of GNSS samples.

    Raises
    ------
    ValueError
        If external vision is not given in NED: its attitude would be needed, which the
        port does not carry.
    """

    def __init__(self, samples: SensorLog, gnss_delay: float = 0.0):
        super().__init__()
        for name, layout, kind in _PORTS:
            arrivals, rows = samples.of(kind)
            table = np.vstack([no_measurement(layout), np.empty((len(rows), layout.size))])
            if kind == logs.GNSS:
                rows[:, 0] -= gnss_delay
            table[1:, 0], table[1:, 1] = rows[:, 0] * 1e-6, arrivals * 1e-6
            table[1:, 2], table[1:, 3] = np.arange(len(rows)), 1.0
            table[1:, len(HEADER) :] = _FIELDS[kind](rows[:, 1:])
            self.DeclareVectorOutputPort(
                name, layout.size, self._port(table, layout), {self.time_ticket()}
            )

    @staticmethod
    def _port(table: np.ndarray, layout: Layout) -> Callable[[Context, BasicVector], None]:
        arrivals = np.ascontiguousarray(table[:, 1])

        def calc(context: Context, output: BasicVector) -> None:
            newest = arrivals.searchsorted(context.get_time(), side="right") - 1
            output.set_value(table[max(newest, 0)])

        calc.__doc__ = f"The newest {layout.name}."
        return calc


def _flu(rows: np.ndarray) -> np.ndarray:
    return rows * [1.0, -1.0, -1.0]


def _enu(rows: np.ndarray) -> np.ndarray:
    return np.column_stack([rows[:, 1], rows[:, 0], -rows[:, 2]])


def _inertial(rows: np.ndarray) -> np.ndarray:
    clipping = rows[:, 8:].any(axis=1)
    return np.column_stack([_flu(rows[:, :3]), _flu(rows[:, 3:6]), rows[:, 6:8], clipping])


def _gnss(rows: np.ndarray) -> np.ndarray:
    return np.column_stack([rows[:, :3], _enu(rows[:, 3:6]), rows[:, 6:12]])


def _vision(rows: np.ndarray) -> np.ndarray:
    position, velocity, attitude = rows[:, :3], rows[:, 3:6], rows[:, 6:10]
    moving = np.isfinite(velocity).any(axis=1)
    if (rows[:, 19] != logs.LOCAL_NED).any() or (rows[moving, 20] != logs.LOCAL_NED).any():
        raise ValueError("external vision is not in NED: a measurement port cannot carry it")
    yaw = np.array([0.5 * math.pi - yaw_of(q) for q in attitude])
    variances = [rows[:, first : first + 3] for first in (10, 13)]
    east_north = [v[:, [1, 0, 2]] for v in variances]
    return np.column_stack(
        [
            _enu(position), east_north[0], _enu(velocity), east_north[1],
            yaw, rows[:, 18], rows[:, 21:23],
        ]
    )  # fmt: skip


_FIELDS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    logs.IMU: _inertial,
    logs.GNSS: _gnss,
    logs.BAROMETER: lambda rows: rows[:, :1],
    logs.MAGNETOMETER: lambda rows: _flu(rows[:, :3]),
    logs.RANGE_FINDER: lambda rows: rows,
    logs.EXTERNAL_VISION: _vision,
    logs.STATUS: lambda rows: rows,
    logs.IN_AIR: lambda rows: rows,
}

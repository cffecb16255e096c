"""What a vehicle's sensors delivered, as one table in order of arrival.

A row is one sample: its time stamp, then the columns of its kind. Frames are those of the
logs, NED and FRD, times whole microseconds.

`IMU`
    delta angle 3 (rad), delta velocity 3 (m/s), their time steps (s), clipping 3 (0/1)
`GNSS`
    latitude, longitude (deg), altitude (m), velocity 3 (m/s), horizontal, vertical (m) and
    speed accuracy (m/s), fix type, satellites, PDOP, spoofed, jammed
`BAROMETER`
    altitude (m), sensor changed (0/1)
`MAGNETOMETER`
    field 3 (gauss), sensor changed (0/1)
`RANGE_FINDER`
    range (m), quality (0..100, −1 unknown)
`EXTERNAL_VISION`
    position 3 (m), velocity 3 (m/s), attitude 4, variances of position 3, velocity 3 and
    angles 3, frame of position and of velocity, reset counter, quality; NaN where not measured
`STATUS`
    at rest, in the air, in ground effect, at a constant position, fixed wing (0/1)
`IN_AIR`
    in the air (0/1), told at once instead of at the delayed horizon
"""

from dataclasses import dataclass

import numpy as np

KINDS = (
    "IMU",
    "GNSS",
    "barometer",
    "magnetometer",
    "range finder",
    "external vision",
    "status",
    "in air",
)
IMU, GNSS, BAROMETER, MAGNETOMETER, RANGE_FINDER, EXTERNAL_VISION, STATUS, IN_AIR = range(8)
WIDTHS = (12, 15, 3, 5, 3, 24, 6, 2)  # columns of each kind, the time stamp included
ROW = max(WIDTHS)
LOCAL_NED, LOCAL_FRD, BODY_FRD = 0, 1, 2  # frames of external vision


@dataclass(frozen=True)
class SensorLog:
    """The samples of all sensors.

    Attributes
    ----------
    kinds : np.ndarray
        Kind of each sample, int64, shape (n,).
    arrivals : np.ndarray
        us, when each sample could first be used, float64, never decreasing, shape (n,).
        Samples of one time are in the order in which they were handed on.
    rows : np.ndarray
        The samples, shape (n, ROW): the time stamp (us), then the columns of the kind.
    gnss_by_arrival : bool
        Whether GNSS samples are stamped with their arrival, so that EKF2_GPS_DELAY is
        still to be taken off.
    """

    kinds: np.ndarray
    arrivals: np.ndarray
    rows: np.ndarray
    gnss_by_arrival: bool = False

    def of(self, kind: int) -> tuple[np.ndarray, np.ndarray]:
        """Arrivals (us), shape (m,), and rows, shape (m, WIDTHS[kind]), of one kind."""
        chosen = self.kinds == kind
        return self.arrivals[chosen], self.rows[chosen, : WIDTHS[kind]]

    def origin(self) -> np.ndarray | None:
        """Latitude, longitude (deg), altitude (m): the median of all 3-D fixes; None without."""
        _, gnss = self.of(GNSS)
        fixes = gnss[gnss[:, 10] >= 3.0, 1:4]
        return np.median(fixes, axis=0) if len(fixes) else None

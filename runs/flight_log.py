"""A flight log as a replay reads it, whatever file it came from."""

from dataclasses import dataclass, field

from runs.on_board import OnBoard
from systems.estimators.ekf2.warm_start import Start
from systems.signals.sensor_log import SensorLog

Parameters = dict[str, int | float]


class ReplayError(ValueError):
    """A log, or what was asked of it, cannot be replayed."""


@dataclass(frozen=True)
class FlightLog:
    """A log that can be replayed.

    Attributes
    ----------
    name : str
        Of the file.
    samples : SensorLog
        Of all sensors.
    parameters : dict
        The `EKF2_…` parameters of the flight.
    on_board : OnBoard or None
        The estimates of the flight.
    start : Start or None
        The state that the filter on board had when the log began, if it was aligned by then;
        a replay starts from it.
    range_limits : tuple of float
        Shortest and longest range (m) of the range finder.
    notes : tuple of str
        Sentences about what was read differently from how it was logged.
    """

    name: str
    samples: SensorLog
    parameters: Parameters = field(default_factory=dict)
    on_board: OnBoard | None = None
    start: Start | None = None
    range_limits: tuple[float, float] = (0.1, 40.0)
    notes: tuple[str, ...] = ()

"""Open loop: a recorded flight in the aircraft's place (Leonard 2016, 5.2).

The file is a CSV table with one row a sample, rising in time, and a header:

| column | unit | |
|---|---|---|
| `time` | s | required |
| `north`, `east`, `down` | m | required, from the touch-down point |
| `v_north`, `v_east`, `v_down` | m/s | required |
| `yaw`, `pitch`, `roll` | deg | required |
| `laser_height` | m | above the ground |
| `baro_altitude` | m | above the touch-down point |
| `tracker_u`, `tracker_v` | px | the tracker's touch-down point in the picture |
| `antenna_azimuth`, `antenna_elevation` | deg | seen from the ground station |
| `inertial_north`, `inertial_east` | m | the unaided inertial position |
| `inertial_v_north`, `inertial_v_east` | m/s | its velocity |

A sensor whose columns are there is replayed (an empty cell is no sample), the
others are simulated from the recorded flight.
"""

import difflib
import math
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from numba import njit
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from plants.terrain import FlatTerrain, Terrain, elevation_at
from systems.configuration import Finite, Metres, configuration
from systems.runway_frames import RunwayConfig
from systems.signals.measurement import Layout, no_measurement
from systems.signals.runway_measurement import (
    ANTENNA,
    ATTITUDE_PERIOD,
    BARO_INERTIAL,
    FIXED_WING_COMMAND,
    FIXED_WING_STATE,
    INERTIAL_NAVIGATION,
    LASER_HEIGHT,
    PICTURE,
)

FLIGHT_COLUMNS = (
    "time",
    "north",
    "east",
    "down",
    "v_north",
    "v_east",
    "v_down",
    "yaw",
    "pitch",
    "roll",
)
_IN_DEGREES = ("yaw", "pitch", "roll", "antenna_azimuth", "antenna_elevation")
# the sensors that a recording may hold: their columns and their measurement
RECORDED_SENSORS: dict[str, tuple[tuple[str, ...], Layout]] = {
    "laser": (("laser_height",), LASER_HEIGHT),
    "baro": (("baro_altitude",), BARO_INERTIAL),
    "picture": (("tracker_u", "tracker_v"), PICTURE),
    "antenna": (("antenna_azimuth", "antenna_elevation"), ANTENNA),
    "inertial": (
        ("inertial_north", "inertial_east", "inertial_v_north", "inertial_v_east"),
        INERTIAL_NAVIGATION,
    ),
}


_COLUMNS = (*FLIGHT_COLUMNS, *(name for names, _ in RECORDED_SENSORS.values() for name in names))
_MISSPELT = 0.85  # how much alike (difflib) a column is to one of ours that it was meant to be


def _require_columns(path: Path, found: list[str]) -> None:
    """All columns of the flight, all or none of each sensor, and no misspelt one."""
    for column in found:
        meant = difflib.get_close_matches(column.lower(), _COLUMNS, n=1, cutoff=_MISSPELT)
        if column not in _COLUMNS and meant and meant[0] not in found:
            raise ValueError(
                f"{path}: unknown column {column!r} in a recorded flight; the nearest is {meant[0]}"
            )
    for column in FLIGHT_COLUMNS:
        if column not in found:
            raise ValueError(
                f"{path}: expected the column {column} in a recorded flight, found "
                f"{', '.join(found)}"
            )
    for columns, _ in RECORDED_SENSORS.values():
        present = [column for column in columns if column in found]
        missing = [column for column in columns if column not in found]
        if present and missing:
            raise ValueError(f"{path}: expected the column {missing[0]} beside {present[0]}")


def read_flight(path: Path) -> pd.DataFrame:
    """Read a recorded flight; angles become rad, the yaw continuous.

    Raises
    ------
    ValueError
        Names the file, the column and what was expected of it.
    """
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        why = str(error).strip().splitlines()[0]
        raise ValueError(f"{path}: expected a recorded flight as CSV ({why})") from error
    table = table.rename(columns=str.strip)
    _require_columns(path, list(table.columns))
    table = table[[column for column in table if column in _COLUMNS]].copy()
    for column in table:
        values = pd.to_numeric(table[column], errors="coerce")
        empty = table[column].isna()
        wrong = (values.isna() & ~empty) | np.isinf(values)
        if column in FLIGHT_COLUMNS:
            wrong |= empty
        elif empty.all():
            raise ValueError(f"{path}: expected numbers in the column {column}, but it is empty")
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ValueError(
                f"{path}: expected numbers in the column {column}, found "
                f"{'nothing' if empty[row] else table[column][row]} in row {row + 1}"
            )
        table[column] = np.radians(values) if column in _IN_DEGREES else values
    if len(table) < 2:
        raise ValueError(f"{path}: expected at least two rows, found {len(table)}")
    late = np.diff(table["time"]) <= 0.0
    if late.any():
        row = int(np.argmax(late)) + 1
        raise ValueError(
            f"{path}: expected rising times, but row {row + 1} has {table['time'][row]:g} s after "
            f"{table['time'][row - 1]:g} s"
        )
    table["time"] -= table["time"].iloc[0]
    table["yaw"] = np.unwrap(table["yaw"])
    return table


def write_flight(table: pd.DataFrame, path: Path) -> None:
    """Write a recorded flight (angles in rad, as `read_flight` returns it) to a file."""
    out = table.copy()
    for column in _IN_DEGREES:
        if column in out:
            out[column] = np.degrees(out[column])
    out.to_csv(path, index=False, float_format="%.6f")


@configuration
class RecordedFlightConfig:
    """A flight that does not answer to the flight controller."""

    kind: Literal["recorded_flight"] = "recorded_flight"
    path: str = ""  # CSV; empty: the reference flight of the laboratory, by the next field
    flight_seed: int = 1  # of the reference flight's turbulence: the same flight in every run
    # m, by which the recorded altitude is too high: "probably a bias in the altitude
    # considered as the real altitude", taken out by a correction of 4 m (6.1, Table 6)
    altitude_error: Finite = 0.0
    start_distance: Metres = 0.0  # m, the replay begins this far from the point; 0: at the start
    gear: Metres = 1.2  # m, from the wheels up to the centre of gravity

    def add_to(
        self,
        builder: DiagramBuilder,
        name: str,
        seed: int,
        runway: RunwayConfig | None = None,
        terrain: Terrain | None = None,
        flight: pd.DataFrame | None = None,
    ) -> "RecordedFlight":
        """Add the flight to a builder."""
        system = RecordedFlight(self, seed, runway, terrain, flight)
        return builder.AddNamedSystem(name, system)


@njit(cache=True)
def interpolate_flight(state, samples, time, terrain, geometry, altitude_error, gear):
    """The recorded state at a time (s), in place.

    Parameters
    ----------
    state : array, shape (15,)
        Layout `FIXED_WING_STATE`.
    samples : array, shape (n, 13)
        Time, position, velocity, yaw, pitch, roll and their rates.
    time : float
    terrain, geometry : arrays
        Of a `TerrainGrid`.
    altitude_error : float
        Added to the altitude, m.
    gear : float
        Height of the body origin over the wheels, m.
    """
    times = samples[:, 0]
    i = min(max(np.searchsorted(times, time) - 1, 0), samples.shape[0] - 2)
    u = min(max((time - times[i]) / (times[i + 1] - times[i]), 0.0), 1.0)
    for k in range(12):
        state[k] = (1.0 - u) * samples[i, 1 + k] + u * samples[i + 1, 1 + k]
    state[12] = math.sqrt(state[3] ** 2 + state[4] ** 2 + state[5] ** 2)
    down = state[2]
    state[2] -= altitude_error
    ground = elevation_at(terrain, geometry, state[0], state[1])
    state[14] = 1.0 if -down - ground <= gear + 0.02 else 0.0
    state[13] = -state[2] - ground


class RecordedFlight(LeafSystem):
    """A recorded flight, interpolated, with the sensors that were recorded along with it.

    .. pydrake_system::

        name: RecordedFlight
        input_ports:
        - command
        output_ports:
        - state
        - seen_state
        - laser
        - baro
        - picture
        - antenna
        - inertial

    | port | layout | meaning |
    |---|---|---|
    | command | FIXED_WING_COMMAND | (optional) ignored: the flight is over |
    | state | FIXED_WING_STATE | the flight as recorded: what the sensors are simulated from |
    | seen_state | FIXED_WING_STATE | the same without `altitude_error`: what the camera saw |
    | laser | LASER_HEIGHT | replayed where recorded |
    | baro | BARO_INERTIAL | replayed where recorded |
    | picture | PICTURE | replayed where recorded |
    | antenna | ANTENNA | replayed where recorded |
    | inertial | INERTIAL_NAVIGATION | replayed where recorded |

    | event | when | does |
    |---|---|---|
    | initialize | at the start | the first sample |
    | advance | every 10 ms from 0 | the flight at t + 10 ms, and the samples up to t |
    """

    def __init__(
        self,
        config: RecordedFlightConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
        terrain: Terrain | None = None,
        flight: pd.DataFrame | None = None,
    ):
        super().__init__()
        self._site: tuple[RunwayConfig, Terrain] | None = None
        self.configure(config, seed, runway, terrain, flight)
        self.DeclareVectorInputPort("command", FIXED_WING_COMMAND.size)
        for name in ("state", "seen_state"):
            group = self.DeclareDiscreteState(FIXED_WING_STATE.size)
            self.DeclareStateOutputPort(name, group)
        for name, (_, layout) in RECORDED_SENSORS.items():
            group = self.DeclareDiscreteState(no_measurement(layout))
            self.DeclareStateOutputPort(name, group)
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(ATTITUDE_PERIOD, 0.0, self._advance)

    def configure(
        self,
        config: RecordedFlightConfig,
        seed: int,
        runway: RunwayConfig | None = None,
        terrain: Terrain | None = None,
        flight: pd.DataFrame | None = None,
    ) -> None:
        """Take a new flight, from the configuration's file or as a table.

        Raises
        ------
        ValueError
            If the file cannot be read, or there is neither file nor table.
        """
        site = (runway or RunwayConfig(), terrain or FlatTerrain())
        if site != self._site:
            self._grid = site[1].grid(site[0])
            self._site = site
        self._altitude_error = config.altitude_error
        self._gear = config.gear
        if config.path:
            flight = read_flight(Path(config.path))
        if flight is None:
            raise ValueError("RecordedFlightConfig.path: expected a file, or a flight as a table")
        if config.start_distance > 0.0:
            near = np.hypot(flight["north"], flight["east"]) <= config.start_distance
            if near.sum() < 2:
                raise ValueError(
                    f"{config.path or 'the reference flight'}: expected a flight that comes within "
                    f"{config.start_distance:g} m of the touch-down point (start_distance)"
                )
            flight = flight.iloc[int(np.argmax(near)) :].reset_index(drop=True)
            flight["time"] -= flight["time"].iloc[0]
        samples = flight[list(FLIGHT_COLUMNS)].to_numpy(dtype=float)
        rates = np.gradient(samples[:, 7:10], samples[:, 0], axis=0)
        self._samples = np.ascontiguousarray(np.hstack((samples, rates)))
        self._recorded: list[tuple[int, str, np.ndarray, np.ndarray]] = []
        for group, (name, (columns, _)) in enumerate(RECORDED_SENSORS.items(), start=2):
            if set(columns) <= set(flight.columns):
                values = flight[list(columns)].to_numpy(dtype=float)
                kept = np.isfinite(values).all(axis=1)
                times = flight["time"].to_numpy(dtype=float)[kept]
                self._recorded.append((group, name, times, values[kept]))

    @property
    def recorded_sensors(self) -> tuple[str, ...]:
        """The sensors that the recording holds."""
        return tuple(name for _, name, _, _ in self._recorded)

    @property
    def duration(self) -> float:
        """The length of the recording, s."""
        return float(self._samples[-1, 0])

    @property
    def model(self) -> tuple:
        """Samples of the flight, error of its altitude (m), height of its gear (m), terrain."""
        return self._samples, self._altitude_error, self._gear, self._grid

    def _interpolate(self, discrete_state, time):
        for group, error in ((0, self._altitude_error), (1, 0.0)):
            interpolate_flight(
                discrete_state.get_mutable_value(group),
                self._samples,
                time,
                self._grid.values,
                self._grid.geometry,
                error,
                self._gear,
            )

    def _initialize(self, context, discrete_state):
        if discrete_state.get_mutable_value(0)[12] == 0.0:
            self._interpolate(discrete_state, context.get_time())

    def _advance(self, context, discrete_state):
        time = context.get_time()
        self._interpolate(discrete_state, time + ATTITUDE_PERIOD)
        for group, name, times, values in self._recorded:
            i = int(np.searchsorted(times, time + 1e-9)) - 1
            output = discrete_state.get_mutable_value(group)
            if i < 0 or output[2] == float(i):
                if name == "inertial" and i >= 0:
                    self._replay_attitude(discrete_state, output, time)
                continue
            output[:4] = (times[i], time, float(i), 1.0)
            if name == "inertial":
                state = discrete_state.get_mutable_value(0)
                output[4:6] = values[i, :2]
                output[6] = state[2]
                output[7:9] = values[i, 2:]
                output[9] = state[5]
                self._replay_attitude(discrete_state, output, time)
            else:
                output[4 : 4 + values.shape[1]] = values[i]
                if name == "picture":
                    output[6] = 1.0  # recordings do not tell the operator's clicks

    @staticmethod
    def _replay_attitude(discrete_state, output, time):
        output[10] = time
        output[11:14] = discrete_state.get_mutable_value(0)[6:9]

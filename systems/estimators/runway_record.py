"""Observer: how far the estimate is off at given distances, and where the aircraft ends.

It sees the truth, so it is no part of the vehicle: it makes the figures of the
thesis's tables.
"""

import math

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem

from systems.configuration import Positive, StructureChangedError, configuration
from systems.runway_frames import RunwayConfig
from systems.signals.measurement import Layout
from systems.signals.runway_measurement import (
    FIXED_WING_STATE,
    NAVIGATION_ESTIMATE,
    PHASE_STATUS,
    PICTURE_PERIOD,
)

# The estimation error as the aircraft passes a distance; NaN where it did not.
PASSAGE = Layout(
    "Passage",
    (
        "time",  # s
        "lateral",  # m, estimate less truth on X_r
        "longitudinal",  # m, on Y_r: positive where the estimate is ahead
        "vertical",  # m, of the altitude
        "lateral_speed",  # m/s
        "longitudinal_speed",  # m/s
        "lateral_sigma",  # m, as the filter believes
        "longitudinal_sigma",  # m
        "nees",  # 1, normalised square of the five errors
        "phase",  # index
        "cross_track",  # m, true X_r: how well it was flown
        "altitude",  # m, true, above the touch-down point
    ),
)
END = Layout(
    "LandingEnd",
    (
        "touchdown_time",  # s, -1 not yet
        "touchdown_x",  # m, X_r
        "touchdown_y",  # m, Y_r
        "touchdown_sink",  # m/s
        "touchdown_roll",  # rad
        "stop_time",  # s, -1 not yet
        "stop_x",  # m, X_r
        "stop_y",  # m, Y_r
        "farthest_x",  # m, largest |X_r| while rolling
    ),
)


@configuration
class RunwayRecordConfig:
    """Where the error is noted."""

    # m before the touch-down point, the farthest first
    distances: list[Positive] = Field(
        default_factory=lambda: [4000.0, 3000.0, 2000.0, 1000.0, 500.0, 300.0, 150.0, 100.0]
    )

    def add_to(
        self,
        builder: DiagramBuilder,
        name: str,
        seed: int,
        runway: RunwayConfig | None = None,
        time_limit: float = math.inf,
    ) -> "RunwayRecord":
        """Add the observer to a builder."""
        return builder.AddNamedSystem(name, RunwayRecord(self, seed, runway, time_limit))


@njit(cache=True)
def nees_of_errors(error, estimate):
    """eᵀ P⁻¹ e of the five errors, `estimate` by layout `NAVIGATION_ESTIMATE`."""
    P = np.zeros((5, 5))
    k = 16
    for i in range(5):
        for j in range(i, 5):
            P[i, j] = P[j, i] = estimate[k]
            k += 1
    return error @ np.linalg.solve(P, error)


@njit(cache=True)
def note(passages, end, state, estimate, phase, distances, heading, time):
    """Note a passage, the touchdown and the standstill as they happen, in place.

    Parameters
    ----------
    passages : array, shape (len(distances), 12)
        Layout `PASSAGE`, NaN until it happens.
    end : array, shape (9,)
        Layout `LandingEnd`.
    state, estimate : arrays
        Layouts `FIXED_WING_STATE` and `NAVIGATION_ESTIMATE`.
    phase : float
    distances : array, shape (n,)
        m, falling.
    heading : float
        Of the runway, rad.
    time : float
        s.
    """
    s, c = math.sin(heading), math.cos(heading)
    x_r = -s * state[0] + c * state[1]
    y_r = c * state[0] + s * state[1]
    if phase >= 2.0 and estimate[1] > 0.0:
        for i in range(distances.shape[0]):
            # the aircraft comes from farther away; what it started within, it does not pass
            if math.isnan(passages[i, 0]) and -distances[i] <= y_r < -distances[i] + 10.0:
                error = np.empty(5)
                for j in range(3):
                    error[j] = estimate[2 + j] - state[j]
                error[3] = estimate[5] - state[3]
                error[4] = estimate[6] - state[4]
                row = passages[i]
                row[0] = time
                row[1] = -s * error[0] + c * error[1]
                row[2] = c * error[0] + s * error[1]
                row[3] = -error[2]
                row[4] = -s * error[3] + c * error[4]
                row[5] = c * error[3] + s * error[4]
                xx, xy, yy = estimate[16], estimate[17], estimate[21]
                row[6] = math.sqrt(max(s * s * xx - 2.0 * s * c * xy + c * c * yy, 0.0))
                row[7] = math.sqrt(max(c * c * xx + 2.0 * s * c * xy + s * s * yy, 0.0))
                row[8] = nees_of_errors(error, estimate)
                row[9] = phase
                row[10] = x_r
                row[11] = -state[2]
    if state[14] > 0.0:
        if end[0] < 0.0:
            end[0] = time
            end[1] = x_r
            end[2] = y_r
        end[8] = max(end[8], abs(x_r))
        if end[5] < 0.0 and math.hypot(state[3], state[4]) == 0.0:
            end[5] = time
            end[6] = x_r
            end[7] = y_r
    else:
        end[3] = state[5]
        end[4] = state[8]


class RunwayRecord(LeafSystem):
    """The estimation error at given distances, the touchdown and the standstill.

    .. pydrake_system::

        name: RunwayRecord
        input_ports:
        - state
        - estimate
        - phase
        output_ports:
        - passages
        - end

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | estimate | NAVIGATION_ESTIMATE | where the filter believes it is |
    | phase | PHASE_STATUS | passages count from Final on |
    | passages | (n · PASSAGE.size,) | one `PASSAGE` a distance, row by row |
    | end | END | touchdown and standstill |

    | event | when | does |
    |---|---|---|
    | note | every 40 ms from 0 | what has happened since; ends the simulation at the time limit |
    """

    def __init__(
        self,
        config: RunwayRecordConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
        time_limit: float = math.inf,
    ):
        super().__init__()
        self._config = config
        self.configure(config, seed, runway, time_limit)
        self._state = self.DeclareVectorInputPort("state", FIXED_WING_STATE.size).Eval
        self._estimate = self.DeclareVectorInputPort("estimate", NAVIGATION_ESTIMATE.size).Eval
        self._phase = self.DeclareVectorInputPort("phase", PHASE_STATUS.size).Eval
        passages = self.DeclareDiscreteState(
            np.full(len(config.distances) * PASSAGE.size, math.nan)
        )
        initial = END.zeros()
        initial[END.index("touchdown_time")] = initial[END.index("stop_time")] = -1.0
        end = self.DeclareDiscreteState(initial)
        self.DeclareStateOutputPort("passages", passages)
        self.DeclareStateOutputPort("end", end)
        self.DeclarePeriodicDiscreteUpdateEvent(PICTURE_PERIOD, 0.0, self._note)

    def configure(
        self,
        config: RunwayRecordConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
        time_limit: float = math.inf,
    ) -> None:
        """Take new distances, as many as before, a new runway and a time limit (s)."""
        if len(config.distances) != len(self._config.distances):
            raise StructureChangedError(
                f"RunwayRecordConfig.distances has {len(self._config.distances)} entries in the "
                f"diagram and cannot get {len(config.distances)}: build a new diagram"
            )
        self._config = config
        self._distances = np.array(config.distances)
        self._heading = (runway or RunwayConfig()).heading_radians
        self._time_limit = time_limit

    def _note(self, context, discrete_state):
        time = context.get_time()
        passages = discrete_state.get_mutable_value(0)
        note(
            passages.reshape(len(self._distances), PASSAGE.size),
            discrete_state.get_mutable_value(1),
            self._state(context),
            self._estimate(context),
            self._phase(context)[0],
            self._distances,
            self._heading,
            time,
        )
        if time >= self._time_limit:
            return EventStatus.ReachedTermination(self, "time limit")
        return None

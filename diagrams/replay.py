"""A logged flight wired to EKF2: `LogPlayback` in the place of the sensors.

Logged samples do not fall on the laboratory's grid of time. So the filter updates at
every step of the simulator, and the simulator makes one step to every time of arrival.
"""

from collections.abc import Callable, Iterator

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
)

from systems.estimators.ekf2 import filter as kernels
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import messages
from systems.estimators.ekf2.ekf2 import Ekf2, Ekf2Config
from systems.estimators.ekf2.warm_start import Start, with_start
from systems.sensors.log_playback import IN_AIR, VEHICLE_FLAGS, LogPlayback
from systems.signals.measurement import TIME_OF_ARRIVAL, TIME_OF_VALIDITY
from systems.signals.sensor_log import SensorLog

_SENSORS = ("imu", "gnss", "barometer", "magnetometer", "range_finder", "external_vision")
_FIRST_FLAG = VEHICLE_FLAGS.index("at_rest")
_IN_AIR = IN_AIR.index("in_air")
# `_take_status` of `messages` keeps what it sent in these; here they hold times of arrival (s).
_FLAGS_ARRIVED, _IN_AIR_ARRIVED = at.STATUS_SENT, at.STATUS_SENT + 1


class ReplayEkf2(Ekf2):
    """`Ekf2` that updates at every step of the simulator, with a log's flags.

    .. pydrake_system::
        name: ReplayEkf2
        input_ports:
        - imu
        - gnss (optional)
        - barometer (optional)
        - magnetometer (optional)
        - range_finder (optional)
        - external_vision (optional)
        - vehicle_status (optional)
        - vehicle_flags (optional)
        - in_air (optional)
        output_ports:
        - estimate
        - delayed_state
        - innovations
        - status

    | port | layout | meaning |
    |---|---|---|
    | `imu` | `INERTIAL` | every sample is integrated |
    | `gnss` (optional) | `GNSS` | as `Ekf2` |
    | `barometer` (optional) | `BAROMETER` | as `Ekf2` |
    | `magnetometer` (optional) | `MAGNETOMETER` | as `Ekf2` |
    | `range_finder` (optional) | `RANGE_FINDER` | as `Ekf2` |
    | `external_vision` (optional) | `EXTERNAL_VISION` | as `Ekf2` |
    | `vehicle_status` (optional) | 3 numbers | not looked at |
    | `vehicle_flags` (optional) | `VEHICLE_FLAGS` | at the horizon; unconnected: in the air |
    | `in_air` (optional) | `IN_AIR` | taken at once; unconnected: only the flags say so |
    | `estimate` | `VEHICLE_ESTIMATE` | as `Ekf2` |
    | `delayed_state` | `messages.DELAYED_STATE` | as `Ekf2` |
    | `innovations` | `messages.INNOVATIONS` | as `Ekf2` |
    | `status` | `messages.STATUS` | as `Ekf2` |

    An observation is stamped with its time of validity, from which PX4's EKF2_…_DELAY are
    taken off (but for GNSS, whose driver knows its delay).

    | event | when | does |
    |---|---|---|
    | update | every step | takes the samples that have arrived since the last one, IMU first |

    Parameters
    ----------
    config : Ekf2Config
        Its parameters are replaced.
    parameters : np.ndarray
        As the kernels read them.
    start : Start, optional
        The state to start from.
    """

    def __init__(self, config: Ekf2Config, parameters: np.ndarray, start: Start | None = None):
        self._replayed = parameters, start
        super().__init__(config)
        self.DeclareVectorInputPort("vehicle_flags", VEHICLE_FLAGS.size)
        self.DeclareVectorInputPort("in_air", IN_AIR.size)

    def _declare_update(self) -> None:
        self.DeclarePerStepDiscreteUpdateEvent(self._update)  # a log has its own times

    def _configure(self, config: Ekf2Config) -> None:
        super()._configure(config)
        self._parameters, start = self._replayed
        self._initial = kernels.initialise(self._parameters)
        if start is not None:
            self._initial = with_start(self._initial, start)
        self._row = np.empty(24)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        x = discrete_state.get_mutable_value(0)
        estimate = discrete_state.get_mutable_value(1)
        imu, *sensors = (self._input(context, index) for index in range(6))
        flags, in_air = self._input(context, 7), self._input(context, 8)
        p = self._parameters
        messages.take_imu(x, p, self._row, imu)
        messages.take_measurements(x, p, self._row, True, np.inf, *sensors)
        if flags.size and flags[TIME_OF_ARRIVAL] > x[_FLAGS_ARRIVED]:
            x[_FLAGS_ARRIVED] = flags[TIME_OF_ARRIVAL]
            stamp = round(1e6 * flags[TIME_OF_VALIDITY])
            kernels.push_status(x, p, np.append(float(stamp), flags[_FIRST_FLAG:]))
        if in_air.size and in_air[TIME_OF_ARRIVAL] > x[_IN_AIR_ARRIVED]:
            x[_IN_AIR_ARRIVED] = in_air[TIME_OF_ARRIVAL]
            kernels.set_in_air(x, in_air[_IN_AIR])
        if x[at.INITIALISED]:
            messages.write_motion(x, p, self._origin, estimate)
        if x[at.IMU_UPDATED]:
            kernels.update(x, p)
            messages.write_step(x, p, self._origin, estimate)


class ReplayDiagram:
    """A log's playback, wired to a filter.

    Parameters
    ----------
    samples : SensorLog
        What is played back.
    parameters : np.ndarray
        Of the filter.
    gnss_delay : float
        us, taken off the stamps of GNSS samples.
    start : Start, optional
        The state to start from; by default the filter starts anew.

    Raises
    ------
    ValueError
        If the ports cannot carry the log, see `LogPlayback`.
    """

    def __init__(
        self,
        samples: SensorLog,
        parameters: np.ndarray,
        gnss_delay: float = 0.0,
        start: Start | None = None,
    ):
        origin = samples.origin()
        config = Ekf2Config() if origin is None else Ekf2Config(origin=[*map(float, origin)])
        builder = DiagramBuilder()
        self.playback = builder.AddNamedSystem("log", LogPlayback(samples, gnss_delay))
        self.ekf2 = builder.AddNamedSystem("ekf2", ReplayEkf2(config, parameters, start))
        for name in (*_SENSORS, "vehicle_flags", "in_air"):
            source, sink = self.playback.GetOutputPort(name), self.ekf2.GetInputPort(name)
            builder.Connect(source, sink)
        for name in ("estimate", "delayed_state", "innovations", "status"):
            builder.ExportOutput(self.ekf2.GetOutputPort(name), name)
        self.diagram: Diagram = builder.Build()
        self.arrivals = np.unique(samples.arrivals)

    def play(self, after: Callable[[float, np.ndarray], None] | None = None) -> Context:
        """Play the log from start to end; the context at its end.

        Parameters
        ----------
        after : callable, optional
            Called after each update with the time of arrival (us) and the filter's array.
        """
        simulator = Simulator(self.diagram)
        context = simulator.get_mutable_context()
        own = self.ekf2.GetMyContextFromRoot(context)
        for arrival in self._advance(simulator, context):
            if after is not None:
                after(arrival, own.get_discrete_state(0).value())
        return context

    def _advance(self, simulator: Simulator, context: Context) -> Iterator[float]:
        """Step to each arrival; a step's update runs when the next one begins."""
        context.SetTime(self.arrivals[0] * 1e-6)
        simulator.Initialize()
        for arrival, following in zip(self.arrivals, self.arrivals[1:], strict=False):
            simulator.AdvanceTo(following * 1e-6)
            yield arrival
        simulator.AdvancePendingEvents()
        yield self.arrivals[-1]

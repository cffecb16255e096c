"""Inertial navigation without aiding: drift with Schuler oscillation."""

import math

import numpy as np
from numba import njit
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import NonNegative, Seconds, configuration
from systems.runway_frames import EARTH_RADIUS, GRAVITY, RunwayConfig
from systems.sensors.runway_sensor import turn_on
from systems.signals.measurement import no_measurement
from systems.signals.noise import stream_key, uniform
from systems.signals.runway_measurement import (
    ATTITUDE_PERIOD,
    FIXED_WING_STATE,
    INERTIAL_NAVIGATION,
)


@configuration
class RunwayInertialDriftConfig:
    """A laser-gyro unit whose velocity error swings by 2 m/s and drifts by 2 nm/h (Fig. 5).

    A constant drift D gives ϵV = −R_T D (1 − cos ω_S t): its mean R_T D is
    2 nm/h for 0.033 deg/h. Attitude as ARINC 704 asks of an inertial reference
    system: pitch and roll 0.1 deg, true heading 0.4 deg, both 95 %.
    """

    gyro_bias_spread: NonNegative = 0.033  # deg/h, of each horizontal axis, one sigma
    longest_since_reset: Seconds = 3600.0  # s, time since the last reset is uniform up to it
    tilt_spread: NonNegative = 0.05  # deg, roll and pitch bias, one sigma
    heading_spread: NonNegative = 0.2  # deg, heading bias, one sigma
    vertical_speed_spread: NonNegative = 0.05  # m/s, of the baro-inertial vertical speed

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayInertialDrift":
        """Add the sensor to a builder."""
        return builder.AddNamedSystem(name, RunwayInertialDrift(self, seed, runway))


@njit(cache=True)
def drift_since_reset(drift, time):
    """The solution of (11) in continuous time, from rest, for constant drift.

    Parameters
    ----------
    drift : array, shape (2,)
        D in north and east, rad/s.
    time : float
        Since the reset, s.

    Returns
    -------
    array, shape (6,)
        Attitude (rad), speed (m/s) and position error (m), north and east each.
    """
    w = math.sqrt(GRAVITY / EARTH_RADIUS)
    s, c = math.sin(w * time), math.cos(w * time)
    error = np.empty(6)
    for i in range(2):
        error[i] = drift[i] * s / w
        error[2 + i] = -EARTH_RADIUS * drift[i] * (1.0 - c)
        error[4 + i] = -EARTH_RADIUS * drift[i] * (time - s / w)
    return error


@njit(cache=True)
def drift_step(error, yaw, drift_b, dt):
    """One step of (11) in place; `error` as from `drift_since_reset`, `drift_b` D_X, D_Y."""
    c, s = math.cos(yaw), math.sin(yaw)
    for i in range(2):
        d = c * drift_b[0] - s * drift_b[1] if i == 0 else s * drift_b[0] + c * drift_b[1]
        error[i] += (error[2 + i] / EARTH_RADIUS + d) * dt
        error[2 + i] -= error[i] * GRAVITY * dt
        error[4 + i] += error[2 + i] * dt


@njit(cache=True)
def inertial_sample(output, memory, state, time, parameters, dt):
    """Attitude at every call, position and speed at every second one (50 Hz), in place.

    Parameters
    ----------
    output : array, shape (14,)
        Layout `INERTIAL_NAVIGATION`.
    memory : array, shape (7,)
        The error of (11) and the number of calls.
    state : array, shape (15,)
        The aircraft.
    parameters : array, shape (12,)
        D_X, D_Y (rad/s), roll, pitch, heading bias (rad), vertical-speed bias
        (m/s), then the error at the start.
    dt : float
        Period of the calls, s.
    """
    calls = int(memory[6])
    if calls == 0:
        memory[:6] = parameters[6:12]
    if calls % 2 == 0:
        if calls > 0:
            drift_step(memory[:6], state[6], parameters[:2], 2.0 * dt)
        output[0] = time
        output[1] = time
        output[2] = calls // 2
        output[3] = 1.0
        output[4] = state[0] + memory[4]
        output[5] = state[1] + memory[5]
        output[6] = state[2]
        output[7] = state[3] + memory[2]
        output[8] = state[4] + memory[3]
        output[9] = state[5] + parameters[5]
    output[10] = time
    output[11] = state[6] + parameters[4]
    output[12] = state[7] + parameters[3]
    output[13] = state[8] + parameters[2]
    memory[6] += 1.0


class RunwayInertialDrift(LeafSystem):
    """The inertial measurement unit's own navigation.

    .. pydrake_system::

        name: RunwayInertialDrift
        input_ports:
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | INERTIAL_NAVIGATION | drifting position and speed, attitude with biases |

    With the attitude error ϵφ, the speed error ϵV and the position error ϵP in
    north and east (Leonard 2016, Eq. 11)

        ϵφ_{k+1} = ϵφ_k + ϵV_k/R_T dt + R(ψ) (D_X, D_Y) dt
        ϵV_{k+1} = ϵV_k − ϵφ_{k+1} g dt
        ϵP_{k+1} = ϵP_k + ϵV_{k+1} dt

    which swings with the period 2π √(R_T/g) = 84.4 min. The vertical position in
    the measurement is the true one: the filter takes the altitude from the
    baro-inertial sensor instead. At the start the unit has drifted along a
    straight flight since its last reset.

    | event | when | does |
    |---|---|---|
    | sample | every 10 ms from 0 | attitude, and every second time the rest |
    """

    def __init__(
        self,
        config: RunwayInertialDriftConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
    ):
        super().__init__()
        self.configure(config, seed, runway)
        self._state = self.DeclareVectorInputPort("state", FIXED_WING_STATE.size).Eval
        output = self.DeclareDiscreteState(no_measurement(INERTIAL_NAVIGATION))
        self.DeclareDiscreteState(7)
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(ATTITUDE_PERIOD, 0.0, self._sample)

    def configure(
        self, config: RunwayInertialDriftConfig, seed: int, runway: RunwayConfig | None = None
    ) -> None:
        """Take a new configuration and seed."""
        stream = "runway_inertial_drift"
        gyro = math.radians(config.gyro_bias_spread) / 3600.0
        tilt = math.radians(config.tilt_spread)
        draws = turn_on(
            seed,
            stream,
            [
                gyro,
                gyro,
                tilt,
                tilt,
                math.radians(config.heading_spread),
                config.vertical_speed_spread,
            ],
        )
        since_reset = config.longest_since_reset * uniform(stream_key(seed, stream), 0, 0)
        self._parameters = np.array([*draws, *drift_since_reset(draws[:2], since_reset)])

    @property
    def model(self) -> np.ndarray:
        """The parameters of one run, see `inertial_sample`."""
        return self._parameters

    def _sample(self, context, discrete_state):
        inertial_sample(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            self._state(context),
            context.get_time(),
            self._parameters,
            ATTITUDE_PERIOD,
        )

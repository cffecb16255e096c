"""The companion computer's filter: an even 30 Hz of external vision from irregular sightings."""

import math

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from systems.configuration import Metres, Positive, Seconds, Vector2, Vector3, configuration
from systems.estimators.fused_sensor import POLL_PERIOD, no_target
from systems.signals.measurement import (
    EXTERNAL_VISION,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    Layout,
    no_measurement,
    vector,
)

# Eqs. 4 and 5 of the paper: μ and the entries of Θ for (turn rate, heading, ẋ, x, ẏ, y).
COVARIANCE_FACTOR = 1.6
COVARIANCE_FLOOR = np.array(
    [
        [0.000027, -0.000003, 0.0, 0.0, 0.0, 0.0],
        [-0.000003, 0.000016, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.006, -0.0069, 0.0, 0.0],
        [0.0, 0.0, -0.0069, 0.0552, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0051, 0.0003],
        [0.0, 0.0, 0.0, 0.0, 0.0003, 0.0405],
    ]
)

# What the filter remembers, before the history of positions.
MEMORY = Layout(
    "SvgsFilterMemory",
    (
        "seen",  # s, arrival of the newest sighting
        "last_fusion",  # s, validity of the newest one that was fused; -1 none
        "count",  # sightings fused since sight was gained
        "rejected",  # in a row
        "test_ratio",
        *vector("p_WP"),  # m, the pad in the local frame
        *vector("p_WP_variance"),  # m2
        *vector("r"),  # m, the pad from the vehicle, at relative_time
        *vector("r_rate"),  # m/s
        *vector(
            "r_covariance", [f"{axis}_{entry}" for axis in "xyz" for entry in ("pp", "pv", "vv")]
        ),
        "relative_time",  # s
        *vector("reference"),  # m, where the pad is for external vision
        "referenced",  # 0/1
        "reset_counter",
        "next_vision",  # s
        "horizontal_resets",
        "vertical_resets",
        "newest",  # entry of the history
    ),
)
# Indices as the compiled functions read them; a test holds them to the layouts.
_SEEN, _LAST, _COUNT, _REJECTED, _RATIO, _PAD, _PAD_VARIANCE = 0, 1, 2, 3, 4, 5, 8
_R, _R_RATE, _R_COVARIANCE, _R_TIME, _REFERENCE, _REFERENCED = 11, 14, 17, 26, 27, 30
_RESET_COUNTER, _NEXT, _H_RESETS, _V_RESETS, _NEWEST = 31, 32, 33, 34, 35
_E_TIME, _E_HORIZONTAL, _E_VERTICAL, _E_P, _E_V = 0, 2, 3, 8, 11
_E_H_COUNTER, _E_H_RESET, _E_V_COUNTER, _E_V_RESET = 31, 32, 34, 35
_M_P, _M_COVARIANCE = 4, 7
_T_TIME, _T_ACQUIRED, _T_FUSED, _T_P, _T_V, _T_P_VARIANCE, _T_V_VARIANCE = 0, 1, 2, 3, 6, 12, 15
_T_RATIO, _T_REJECTED, _T_SOURCE = 18, 19, 20
_V_P, _V_P_VARIANCE, _V_V, _V_YAW, _V_RESET_COUNTER, _V_QUALITY = 4, 7, 10, 16, 18, 19

_HISTORY = 36  # where it begins: entries of time (s) and p_WB (m)
_ENTRIES, _ENTRY = 40, 4  # times 20 ms: 0.8 s
MEMORY_SIZE = _HISTORY + _ENTRIES * _ENTRY

# The parameters.
(
    _DRIFT,  # m2, in one period
    _ACCELERATION,  # (m/s2)2
    _GATE,
    _MAXIMUM_REJECTIONS,
    _LOCK_COUNT,
    _ALIGNMENT,  # m
    _LOST_TIME,  # s
    _VISION_TIMEOUT,  # s
    _VISION_PERIOD,  # s
    _LAG,  # s
    _FLOOR_X,  # m2
    _FLOOR_Y,
    _SURVEYED_X,  # m
    _SURVEYED_Y,
    _SURVEYED_Z,
) = range(15)

_INITIAL_RATE = 1.0  # m/s, one sigma
_CONTINUITY = 1.0  # s, a longer gap starts the relative filter anew
_TICK = 1e-6  # s


@configuration
class SvgsFilterConfig:
    """How sightings become a target, and external vision."""

    drift: Positive = 0.05  # m/√s, of the local frame against the ground
    acceleration: Positive = 1.5  # m/s2, one sigma of the vehicle's, white, in the relative filter
    gate: Positive = 5.0  # standard deviations
    maximum_rejections: int = Field(default=8, ge=1)  # in a row, before starting anew
    lock_count: int = Field(default=5, ge=1)  # sightings before the target counts as locked
    # Paper 2.5.2: vision begins when sufficiently aligned; not published
    alignment: Metres = 1e3  # m, horizontal distance; the gates do the rest
    lost_time: Seconds = 1.0  # s without a sighting
    vision_timeout: Seconds = 0.5  # s, vision is sent so long after the last sighting arrived
    vision_rate: Positive = 30.0  # 1/s; paper 4.5: PX4 asks for 30 Hz
    lag: Seconds = 0.22  # s, age of what is sent: nearly that of the slowest packet (0.23 s)
    # m2, least variance of x and y: Eqs. 4 and 5
    floor: Vector2 = Field(
        default_factory=lambda: [
            COVARIANCE_FACTOR * COVARIANCE_FLOOR[3, 3],
            COVARIANCE_FACTOR * COVARIANCE_FLOOR[5, 5],
        ]
    )
    # m, W: where the pad is, as long as nothing else says where the vehicle is
    pad_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])

    def parameters(self) -> np.ndarray:
        """The parameter vector of `filter_step`."""
        return np.array(
            [
                self.drift**2 * POLL_PERIOD,
                self.acceleration**2,
                self.gate,
                self.maximum_rejections,
                self.lock_count,
                self.alignment,
                self.lost_time,
                self.vision_timeout,
                1.0 / self.vision_rate,
                self.lag,
                *self.floor,
                *self.pad_position,
            ]
        )

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "SvgsFilter":
        """Add a filter called `name` to `builder`."""
        return builder.AddNamedSystem(name, SvgsFilter(self, seed))


@njit(cache=True)
def _remember(memory, estimate):
    """Follow the navigation filter's resets, and keep its newest position."""
    h, v = estimate[_E_H_COUNTER], estimate[_E_V_COUNTER]
    jump = np.zeros(3)
    if memory[_H_RESETS] >= 0.0 and h != memory[_H_RESETS]:
        jump[0], jump[1] = estimate[_E_H_RESET], estimate[_E_H_RESET + 1]
    if memory[_V_RESETS] >= 0.0 and v != memory[_V_RESETS]:
        jump[2] = estimate[_E_V_RESET]
    memory[_H_RESETS], memory[_V_RESETS] = h, v
    if jump[0] != 0.0 or jump[1] != 0.0 or jump[2] != 0.0:
        for i in range(3):
            memory[_PAD + i] += jump[i]
            for k in range(_ENTRIES):
                memory[_HISTORY + k * _ENTRY + 1 + i] += jump[i]
    newest = int(memory[_NEWEST])
    if estimate[_E_TIME] > memory[_HISTORY + newest * _ENTRY]:
        newest = (newest + 1) % _ENTRIES
        memory[_NEWEST] = newest
        at = _HISTORY + newest * _ENTRY
        memory[at] = estimate[_E_TIME]
        memory[at + 1 : at + 4] = estimate[_E_P : _E_P + 3]


@njit(cache=True)
def position_at(memory, time, p):
    """p_WB at `time` (s) from the history, interpolated, into p (3,)."""
    newest = int(memory[_NEWEST])
    after = _HISTORY + newest * _ENTRY
    p[:] = memory[after + 1 : after + 4]
    for back in range(1, _ENTRIES):
        at = _HISTORY + ((newest - back) % _ENTRIES) * _ENTRY
        if memory[at] < 0.0:
            return
        if memory[at] <= time:
            part = min(max((time - memory[at]) / (memory[after] - memory[at]), 0.0), 1.0)
            for i in range(3):
                p[i] = (1.0 - part) * memory[at + 1 + i] + part * memory[after + 1 + i]
            return
        after = at
        p[:] = memory[after + 1 : after + 4]


@njit(cache=True)
def _predict_relative(r, rate, pp, pv, vv, dt, q):
    """One axis of the relative filter after dt (s): constant velocity, white acceleration."""
    pp += dt * (2.0 * pv + dt * vv) + 0.25 * q * dt**4
    pv += dt * vv + 0.5 * q * dt**3
    vv += q * dt * dt
    return r + rate * dt, rate, pp, pv, vv


@njit(cache=True)
def _fuse(memory, measurement, p):
    """Take a sighting into both filters."""
    validity = measurement[0]
    p_WB = np.empty(3)
    position_at(memory, validity, p_WB)
    R = np.array([measurement[_M_COVARIANCE], measurement[_M_COVARIANCE + 2], 0.0])
    R[2] = measurement[_M_COVARIANCE + 5]
    fresh = memory[_LAST] < 0.0
    ratio = 0.0
    if not fresh:
        for i in range(3):
            innovation = p_WB[i] + measurement[_M_P + i] - memory[_PAD + i]
            variance = memory[_PAD_VARIANCE + i] + R[i]
            ratio = max(ratio, innovation * innovation / (p[_GATE] ** 2 * variance))
    memory[_RATIO] = ratio
    if ratio > 1.0:
        memory[_REJECTED] += 1.0
        if memory[_REJECTED] < p[_MAXIMUM_REJECTIONS]:
            return
        fresh = True
    memory[_REJECTED] = 0.0
    if fresh:
        memory[_COUNT] = 0.0
    for i in range(3):
        seen = p_WB[i] + measurement[_M_P + i]
        if fresh:
            memory[_PAD + i] = seen
            memory[_PAD_VARIANCE + i] = R[i]
        else:
            gain = memory[_PAD_VARIANCE + i] / (memory[_PAD_VARIANCE + i] + R[i])
            memory[_PAD + i] += gain * (seen - memory[_PAD + i])
            memory[_PAD_VARIANCE + i] *= 1.0 - gain
    dt = validity - memory[_R_TIME]
    restart = fresh or dt > _CONTINUITY
    if dt > 0.0 or restart:
        for i in range(3):
            c = _R_COVARIANCE + 3 * i
            if restart:
                memory[_R + i], memory[_R_RATE + i] = measurement[_M_P + i], 0.0
                memory[c], memory[c + 1], memory[c + 2] = R[i], 0.0, _INITIAL_RATE**2
                continue
            r, rate, pp, pv, vv = _predict_relative(
                memory[_R + i], memory[_R_RATE + i], memory[c], memory[c + 1], memory[c + 2],
                dt, p[_ACCELERATION],
            )  # fmt: skip
            innovation = measurement[_M_P + i] - r
            k_r, k_v = pp / (pp + R[i]), pv / (pp + R[i])
            memory[_R + i], memory[_R_RATE + i] = r + k_r * innovation, rate + k_v * innovation
            memory[c], memory[c + 1] = (1.0 - k_r) * pp, (1.0 - k_r) * pv
            memory[c + 2] = vv - k_v * pv
        memory[_R_TIME] = validity
    memory[_LAST] = validity
    memory[_COUNT] += 1.0


@njit(cache=True)
def _send_vision(time, estimate, p, memory, vision):
    """Where the vehicle is by vision, `lag` ago, if the target is in sight."""
    if time - memory[_SEEN] > p[_VISION_TIMEOUT] or memory[_COUNT] < p[_LOCK_COUNT]:
        return
    if memory[_REFERENCED] == 0.0:
        if math.hypot(memory[_R], memory[_R + 1]) > p[_ALIGNMENT]:
            return
        known = estimate[_E_HORIZONTAL] > 0.0
        for i in range(3):
            if i == 2:
                known = estimate[_E_VERTICAL] > 0.0
            memory[_REFERENCE + i] = memory[_PAD + i] if known else p[_SURVEYED_X + i]
        memory[_REFERENCED] = 1.0
    vision[0] = time - p[_LAG]
    vision[1] = time
    vision[2] += 1.0
    vision[3] = 1.0
    for i in range(3):
        c = _R_COVARIANCE + 3 * i
        r, _, pp, _, _ = _predict_relative(
            memory[_R + i], memory[_R_RATE + i], memory[c], memory[c + 1], memory[c + 2],
            vision[0] - memory[_R_TIME], p[_ACCELERATION],
        )  # fmt: skip
        floor = p[_FLOOR_Y] if i == 1 else p[_FLOOR_X]
        vision[_V_P + i] = memory[_REFERENCE + i] - r
        vision[_V_P_VARIANCE + i] = max(pp, floor)
    vision[_V_RESET_COUNTER] = memory[_RESET_COUNTER]
    vision[_V_QUALITY] = 100.0


@njit(cache=True)
def filter_step(time, measurement, estimate, p, memory, target, vision):
    """One event of the filter.

    Parameters
    ----------
    time : float
        s, now.
    measurement, estimate : arrays of the layouts TARGET_MEASUREMENT and VEHICLE_ESTIMATE
    p : array
        From `SvgsFilterConfig.parameters`.
    memory : array of shape (MEMORY_SIZE,)
        Changed in place, like the following.
    target : array of the layout TARGET_ESTIMATE
    vision : array of the layout EXTERNAL_VISION
    """
    _remember(memory, estimate)
    for i in range(3):
        memory[_PAD_VARIANCE + i] += p[_DRIFT]
    if measurement[1] > memory[_SEEN] and measurement[3] > 0.0:
        memory[_SEEN] = measurement[1]
        _fuse(memory, measurement, p)
    if memory[_COUNT] > 0.0 and time - memory[_SEEN] > p[_LOST_TIME]:
        memory[_COUNT] = 0.0
    locked = memory[_COUNT] >= p[_LOCK_COUNT]
    if time >= memory[_NEXT] - _TICK:
        memory[_NEXT] = max(memory[_NEXT] + p[_VISION_PERIOD], time)
        _send_vision(time, estimate, p, memory, vision)
    target[_T_TIME] = time
    target[_T_ACQUIRED] = 1.0 if locked else 0.0
    target[_T_FUSED] = memory[_LAST]
    for i in range(3):
        target[_T_P + i] = memory[_PAD + i] - estimate[_E_P + i]
        target[_T_V + i] = -estimate[_E_V + i]
        target[_T_P_VARIANCE + i] = memory[_PAD_VARIANCE + i]
    target[_T_RATIO] = memory[_RATIO]
    target[_T_REJECTED] = memory[_REJECTED]
    target[_T_SOURCE] = measurement[13]


class SvgsFilter(LeafSystem):
    """Two filters: the pad in the local frame for guidance, and the vehicle for the autopilot.

    .. pydrake_system::
        name: SvgsFilter
        input_ports:
        - measurement
        - estimate
        output_ports:
        - target
        - external_vision

    | port | layout | meaning |
    |---|---|---|
    | `measurement` | `TARGET_MEASUREMENT` | the pad from the vehicle; once per time of arrival |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle's position, velocity and resets |
    | `target` | `TARGET_ESTIMATE` | the pad now; acquired after `lock_count` sightings |
    | `external_vision` | `EXTERNAL_VISION` | the vehicle `lag` ago, 30 times a second in sight |

    The pad stands still, the local frame drifts; a sighting z of time t_v is compared at t_v:

        p_WP' = drift,    z + p_WB(t_v) = p_WP + noise

    It is rejected beyond `gate`; after `maximum_rejections` in a row the filter starts anew. A
    reset of the navigation filter moves p_WP and the history of p_WB with it. What guidance gets is

        p_BP_W = p_WP − p_WB(now)

    so the latency of the sightings costs nothing but drift. For the autopilot a second filter
    (constant velocity, white acceleration) evens the irregular sightings out, and what is sent is

        p_WB = p_ref − r(now − lag),    variance ≥ floor        (Eqs. 4 and 5)

    in which p_ref is the pad's place in the local frame as it was when sight was first locked:
    the vehicle's motion is the difference of two sightings (section 2.5.2). Where the vehicle does
    not know its position at that time, p_ref is the surveyed `pad_position`.

    After "High-altitude precision landing by SVGS" (Drones 8, 37, 2024, sections 2.4, 2.5.2).

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | take a sighting; target; vision if it is due |
    """

    def __init__(self, config: SvgsFilterConfig, seed: int = 0):
        """A filter; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        measurement = self.DeclareVectorInputPort("measurement", TARGET_MEASUREMENT.size)
        estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size)
        self._measurement, self._estimate = measurement.Eval, estimate.Eval
        target = self.DeclareDiscreteState(BasicVector(no_target()))
        initial = no_measurement(EXTERNAL_VISION)
        initial[_V_V : _V_YAW + 1] = np.nan
        vision = self.DeclareDiscreteState(BasicVector(initial))
        memory = np.zeros(MEMORY_SIZE)
        memory[[_SEEN, _LAST, _R_TIME, _H_RESETS, _V_RESETS]] = -1.0
        memory[_HISTORY::_ENTRY] = -1.0
        self.DeclareDiscreteState(BasicVector(memory))
        self.DeclareStateOutputPort("target", target)
        self.DeclareStateOutputPort("external_vision", vision)
        self.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, self._update)

    def configure(self, config: SvgsFilterConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        self._parameters = config.parameters()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        filter_step(
            context.get_time(),
            self._measurement(context),
            self._estimate(context),
            self._parameters,
            discrete_state.get_mutable_value(2),
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
        )

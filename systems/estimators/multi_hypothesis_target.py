"""Our own landing-target estimator: any sensor, in its own time, several hypotheses."""

from typing import Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from scipy.stats import chi2

from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Probability,
    Seconds,
    Vector3,
    configuration,
)
from systems.estimators import multi_hypothesis_target_kernel as kernel
from systems.estimators.fused_sensor import POLL_PERIOD, no_target
from systems.estimators.fused_sensor_kernel import INFRARED_SOURCE, MARKER_SOURCE
from systems.estimators.multi_hypothesis_target_filter import BORN, TRACK
from systems.estimators.multi_hypothesis_target_kernel import (
    HYPOTHESES,
    MEMORY,
    PARAMETERS,
    TARGET_HYPOTHESES,
)
from systems.signals.measurement import (
    INFRARED,
    MARKER,
    RANGE_FINDER,
    TARGET_MEASUREMENT,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from systems.signals.optional_input import optional_input
from systems.vision.pinhole import camera_mount

_SOURCES = {
    "infrared": INFRARED_SOURCE,
    "marker": MARKER_SOURCE,
    "fused": INFRARED_SOURCE | MARKER_SOURCE,
}


@configuration
class TargetSensorsConfig:
    """Which sensors are listened to, where they sit and how well they measure."""

    mode: Literal["infrared", "marker", "fused"] = "fused"
    infrared_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    infrared_yaw: Finite = 0.0  # rad, turn of the camera about z_B
    marker_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    marker_yaw: Finite = 0.0  # rad
    range_finder_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m, p_BR
    infrared_angle_noise: Positive = 1.5e-3  # rad, half a pixel of 3 mrad, one sigma
    infrared_lamp_noise: Positive = 0.01  # m, half the lamp's radius
    marker_noise: Positive = 0.005  # m, on top of the measurement's own covariance
    attitude_noise: NonNegative = 3e-3  # rad, the quick part of the attitude's error
    range_noise: Positive = 0.05  # m, TFmini Plus up to 6 m; its constant part counts as noise
    ground_noise: Positive = 0.3  # m, of the pad's top over the ground that the beam hits beside it
    pad_radius: Metres = 0.4  # m, within which the beam surely meets the pad


@configuration
class MultiHypothesisTargetConfig:
    """A bank of filters of the pad's place, motion and the cameras' bearing bias."""

    kind: Literal["multi_hypothesis"] = "multi_hypothesis"
    front_end: TargetSensorsConfig = Field(default_factory=TargetSensorsConfig)
    # How the pad seems to move in the navigation frame: the filter's own drift, and the pad
    position_noise: NonNegative = 0.01  # m/√s, random walk of the navigation filter's position
    horizontal_acceleration: Positive = 0.15  # (m/s)/√s, random walk of the pad's velocity
    vertical_acceleration: Positive = 0.15  # (m/s)/√s
    # Attitude error and misalignment of the cameras, a first-order Gauss-Markov process
    bearing_bias: NonNegative = 0.01  # rad, one sigma
    bearing_bias_time: Positive = 30.0  # s, of correlation
    initial_radius: Positive = 5.0  # m, one sigma of a new hypothesis
    initial_speed: Positive = 1.5  # m/s, one sigma of the pad's speed
    gate_probability: Probability = 0.999  # of a true measurement to be inside the gate
    late_probability: Probability = 1e-3  # that a target seen after the first one is the pad
    marker_odds: Positive = 0.5  # 1, log of the odds that each marker measurement adds; frames
    # are not independent, so much less than one code's odds of ln 1000
    marker_odds_limit: Positive = 12.0  # 1, and no more than this
    confirmations: int = Field(default=8, ge=1)  # measurements before the target is acquired
    lost_time: Seconds = 1.0  # s without a camera measurement
    forget_time: Seconds = 10.0  # s, after which an unseen hypothesis gives way to a seen one

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "MultiHypothesisTarget":
        """Add an estimator called `name` to `builder`."""
        return builder.AddNamedSystem(name, MultiHypothesisTarget(self, seed))


class MultiHypothesisTarget(LeafSystem):
    """The pad's place and motion, from any sensor at its own time, with several hypotheses.

    .. pydrake_system::
        name: MultiHypothesisTarget
        input_ports:
        - infrared (optional)
        - marker (optional)
        - range_finder (optional)
        - estimate
        output_ports:
        - target
        - measurement
        - hypotheses

    | port | layout | meaning |
    |---|---|---|
    | `infrared` (optional) | `INFRARED` | every blob may be the beacon; unconnected: none |
    | `marker` (optional) | `MARKER` | the detected marker; unconnected: none |
    | `range_finder` (optional) | `RANGE_FINDER` | the pad's height; unconnected: from the marker |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle, whose GNSS receiver is in it |
    | `target` | `TARGET_ESTIMATE` | the most probable hypothesis now |
    | `measurement` | `TARGET_MEASUREMENT` | the newest camera measurement fused into it |
    | `hypotheses` | `TARGET_HYPOTHESES` | all hypotheses with their probabilities |

    State of a hypothesis: the pad's place p and velocity v as they appear in the navigation
    filter's frame (so that v holds the filter's own velocity error, which the controller has
    too), and a bearing bias b of both cameras, attitude error and misalignment together:

        ṗ = v + √position_noise² w_p,   v̇ = √acceleration² w_v,   ḃ = −b/τ + σ √(2/τ) w_b

    Measurements, with the vehicle's pose p_WB, q_WB at the measurement's own time of validity
    (interpolated in a memory of 2 s), h the height above the pad:

        marker      p_BP_W = p − p_WB + h (b, 0)                              three rows
        infrared    0 = (p − p_WC)_xy − (d_xy/d_z)(p − p_WC)_z + h b          two rows a blob
        range       p_z = p_WB.z − height, less certain where the beam misses the pad

    d is the blob's ray in W. Latency needs no parameter. A measurement that comes after a younger
    one is put in its place among the last 48, and all behind it are filtered anew: exactly the
    filter that had them in order (Bar-Shalom, "Update with out-of-sequence measurements in
    tracking: exact solution", IEEE T-AES 38(3), 2002, section II, gives re-processing as the
    reference). For one older than these some estimates x_k are kept as they leave, every 0.1 s,
    with C_k = cov(e, e_k), which follows the filter, C_k ← (I − K H) F C_k (the product of
    gains in Larsen et al., "Incorporation of time delayed measurements in a discrete-time
    Kalman filter", CDC 1998). Predicted to the measurement's time x_k gives the innovation
    ν, and the oldest estimate is corrected by C_k Hᵀ S⁻¹ ν: the best use of ν, with its true
    covariance, though x_k knows less than what was fused since.
    What is older than the memory of poses is not used. A constant error of the time stamps
    themselves is not estimated: without a motion that the vehicle makes on purpose it
    cannot be told from b.

    Hypotheses (a small multiple hypothesis tracker, one association each; Blackman,
    "Multiple hypothesis tracking for multiple target tracking", IEEE AESM 19(1), 2004). A
    measurement belongs to the hypothesis under which it is likeliest, νᵀ S⁻¹ ν + ln |S|; where
    νᵀ S⁻¹ ν exceeds the chi-square gate for all of them, it begins another one. So a gate never
    gives in: what persists outside of it becomes a rival that has to win by evidence,

        ln odds = (first: 0; later: ln late_probability) + min(marker_odds · n, limit)

    n being the marker measurements that belong to it, less those that belonged elsewhere while
    nothing was seen of it: the marker's code tells the pad from a lamp.
    A lamp that appears later than the pad, or without a marker on it, loses for as long as
    the pad is seen, and `forget_time` longer; then what is left inherits. Rivals within 0.25 m
    are one. `target` is the most probable hypothesis i, its
    covariance that of the mixture, P_i + Σ probability_j (p_j − p_i)².

    The target is acquired after `confirmations` camera measurements, and as long as the last is
    not older than `lost_time`.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | take what has arrived, predict to now |
    """

    def __init__(self, config: MultiHypothesisTargetConfig, seed: int = 0):
        """An estimator; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        declare = self.DeclareVectorInputPort
        self._infrared = optional_input(
            declare("infrared", INFRARED.size), no_measurement(INFRARED)
        )
        self._marker = optional_input(declare("marker", MARKER.size), no_measurement(MARKER))
        self._range_finder = optional_input(
            declare("range_finder", RANGE_FINDER.size), no_measurement(RANGE_FINDER)
        )
        self._estimate = declare("estimate", VEHICLE_ESTIMATE.size).Eval
        memory = MEMORY(MEMORY.zeros())
        memory.infrared_arrival = memory.marker_arrival = memory.range_arrival = -1.0
        memory.horizontal_resets = memory.vertical_resets = -1.0
        tracks = np.zeros((HYPOTHESES, TRACK))
        tracks[:, BORN] = -1.0
        target = self.DeclareDiscreteState(BasicVector(no_target()))
        measurement = self.DeclareDiscreteState(BasicVector(no_measurement(TARGET_MEASUREMENT)))
        hypotheses = self.DeclareDiscreteState(BasicVector(TARGET_HYPOTHESES.zeros()))
        self.DeclareDiscreteState(BasicVector(memory[:]))
        self.DeclareDiscreteState(BasicVector(tracks.ravel()))
        self.DeclareStateOutputPort("target", target)
        self.DeclareStateOutputPort("measurement", measurement)
        self.DeclareStateOutputPort("hypotheses", hypotheses)
        self.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, self._update)

    def configure(self, config: MultiHypothesisTargetConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        c, s = config, config.front_end
        k = PARAMETERS(PARAMETERS.zeros())
        k.density_position = c.position_noise**2
        k.density_horizontal = c.horizontal_acceleration**2
        k.density_vertical = c.vertical_acceleration**2
        k.bias_sigma = c.bearing_bias
        k.bias_time = c.bearing_bias_time
        k.sources = _SOURCES[s.mode]
        for name in ("infrared_angle_noise", "infrared_lamp_noise", "marker_noise",
                     "attitude_noise", "range_noise", "ground_noise", "pad_radius"):  # fmt: skip
            setattr(k, name, getattr(s, name))
        for name in ("initial_radius", "initial_speed", "marker_odds", "marker_odds_limit",
                     "confirmations", "lost_time", "forget_time"):  # fmt: skip
            setattr(k, name, getattr(c, name))
        k.gate_2, k.gate_3 = chi2.ppf(c.gate_probability, (2, 3))
        k.late_odds = float(np.log(c.late_probability))
        self._parameters = k[:]
        self._parameters[PARAMETERS.slice("range_finder")] = s.range_finder_position
        self._X_BI = camera_mount(s.infrared_position, s.infrared_yaw)
        self._X_BM = camera_mount(s.marker_position, s.marker_yaw)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        kernel.poll(
            discrete_state.get_mutable_value(0),
            discrete_state.get_mutable_value(1),
            discrete_state.get_mutable_value(2),
            discrete_state.get_mutable_value(3),
            discrete_state.get_mutable_value(4).reshape(HYPOTHESES, TRACK),
            context.get_time(),
            self._infrared(context),
            self._marker(context),
            self._range_finder(context),
            self._estimate(context),
            self._parameters,
            self._X_BI,
            self._X_BM,
        )

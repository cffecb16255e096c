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
from scipy.special import chdtri

from plants.svgs_beacons import SvgsBeaconsConfig
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
    SVGS_SOURCE,
    TARGET_HYPOTHESES,
)
from systems.signals.measurement import (
    GNSS,
    INFRARED,
    MARKER,
    RANGE_FINDER,
    SVGS,
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
    "svgs": SVGS_SOURCE,
    "all": INFRARED_SOURCE | MARKER_SOURCE | SVGS_SOURCE,
}


@configuration
class TargetSensorsConfig:
    """Which sensors are listened to, where they sit and how well they measure."""

    mode: Literal["infrared", "marker", "fused", "svgs", "all"] = "fused"
    infrared_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    infrared_yaw: Finite = 0.0  # rad, turn of the camera about z_B
    marker_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    marker_yaw: Finite = 0.0  # rad
    svgs_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    svgs_yaw: Finite = 0.0  # rad
    beacons: SvgsBeaconsConfig = Field(default_factory=SvgsBeaconsConfig)  # what SVGS looks for
    range_finder_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])  # m, p_BR
    infrared_angle_noise: Positive = 1.5e-3  # rad, half a pixel of 3 mrad, one sigma
    infrared_lamp_noise: Positive = 0.01  # m, half the lamp's radius
    marker_noise: Positive = 0.005  # m, on top of the measurement's own covariance
    attitude_noise: NonNegative = 3e-3  # rad, the quick part of the attitude's error
    range_noise: Positive = 0.05  # m, TFmini Plus up to 6 m; its constant part counts as noise
    ground_noise: Positive = 0.3  # m, of the pad's top over the ground that the beam hits beside it
    pad_radius: Metres = 0.4  # m, within which the beam surely meets the pad
    # m, one sigma an axis by which the place of the pad by its receiver and that of the vehicle by
    # its own are apart, unless both have fixed ambiguities: √2 · 2.5 m CEP / 1.1774, two NEO-M8
    gnss_error: Positive = 3.0
    # deg, deg, m: latitude, longitude and altitude of W's origin
    origin: Vector3 = Field(default_factory=lambda: [39.3622, 22.9420, 10.0])


@configuration
class MultiHypothesisTargetConfig:
    """A bank of filters of the pad's place, motion and the cameras' bearing bias."""

    kind: Literal["multi_hypothesis"] = "multi_hypothesis"
    front_end: TargetSensorsConfig = Field(default_factory=TargetSensorsConfig)
    # How a pad at rest seems to move: by the error of EKF2's velocity. Flown with the thesis's
    # hexacopter, what was seen for a while and then lost for 1, 2, 4 s was 2.0, 4.7, 9.7 cm from
    # where it was expected, an axis, in 5 m/s of wind, 2.3, 5.6, 12 cm in 10; so by these figures:
    # 2.2, 5.5, 12 cm
    drift_speed: Positive = 0.05  # m/s, one sigma of the velocity's error
    drift_time: Positive = 2.5  # s, of its correlation
    position_noise: NonNegative = 0.005  # m/√s, of the odometry besides
    # How it moves itself
    horizontal_acceleration: Positive = 0.15  # (m/s)/√s, random walk of the velocity
    vertical_acceleration: Positive = 0.15  # (m/s)/√s, at rest too, where the height's error is it
    initial_speed: Positive = 1.5  # m/s, one sigma, of a new hypothesis or of one that sets off
    # Attitude error and misalignment of the cameras, a first-order Gauss-Markov process
    bearing_bias: NonNegative = 0.01  # rad, one sigma
    bearing_bias_time: Positive = 30.0  # s, of correlation
    initial_radius: Positive = 5.0  # m, one sigma of a new hypothesis
    gate_probability: Probability = 0.999  # of a true measurement to be inside the gate
    late_probability: Probability = 1e-3  # that a target seen after the first one is the pad
    marker_odds: Positive = 6.9  # 1, log of the odds that a marker measurement adds: of 1000 codes
    marker_time: Seconds = 0.5  # s, within which two measurements are not independent
    marker_odds_limit: Positive = 12.0  # 1, the log of the odds itself grows no further
    known_radius: Positive = 1.0  # m, one sigma in a second from now, to which a place is known
    known_slope: NonNegative = 0.05  # 1, or to so much of the height above it
    forget_radius: Positive = 3.0  # m, one sigma, at which a hypothesis says nothing any more
    forget_slope: NonNegative = 0.15  # 1, or so much of the height above it
    forget_time: Seconds = 10.0  # s, by which another must have been seen longer to remain alone

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
        - svgs (optional)
        - gnss (optional)
        - pad_gnss (optional)
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
    | `svgs` (optional) | `SVGS` | the pose of a light beacon; unconnected: none |
    | `gnss` (optional) | `GNSS` | the vehicle's receiver, of use with the pad's alone |
    | `pad_gnss` (optional) | `GNSS` | the pad's own receiver, by radio; unconnected: none |
    | `range_finder` (optional) | `RANGE_FINDER` | the pad's height; unconnected: from the marker |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle, whose GNSS receiver is in it |
    | `target` | `TARGET_ESTIMATE` | the most probable hypothesis now |
    | `measurement` | `TARGET_MEASUREMENT` | the newest camera measurement fused into it |
    | `hypotheses` | `TARGET_HYPOTHESES` | all hypotheses with their probabilities |

    State of a hypothesis: the pad's place p and velocity v as they appear to the vehicle's
    odometry, the integral of the navigation filter's velocity, and a bearing bias b of both
    cameras, attitude error and misalignment together:

        ṗ = v + position_noise w_p,   ḃ = −b/τ_b + σ_b √(2/τ_b) w_b
        v̇ = −v/τ + σ √(2/τ) w_v            at rest: the odometry's error, σ = drift_speed
        v̇ = horizontal_acceleration w_v    moving; vertically always, by vertical_acceleration

    Odometry, because the navigation filter's position follows that of its GNSS receiver, by some
    9 cm in two seconds, and its velocity does not: half of that. It has no resets either. A
    hypothesis moves if the odometry does not explain its velocity, Σ v_i²/(P_ii + σ²) over the
    chi-square gate. Then v is the pad's with the odometry's error, which the controller has too.

    Measurements, with the vehicle's odometry p_OB and attitude q_WB at the measurement's own time
    of validity (interpolated in a memory of 2 s), h the height above the pad:

        marker      p_BP_W = p − p_OB + h (b, 0)                              three rows
        SVGS        the same, p_BP_W from the beacon's pose and its place on the pad
        infrared    0 = (p − p_OC)_xy − (d_xy/d_z)(p − p_OC)_z + h b          two rows a blob
        range       p_z = p_OB.z − height, less certain where the beam misses the pad
        pad's GNSS  p_WP − p_WB = p − p_OB by the two receivers, horizontally   two rows
                    v_WP = v, with the odometry's drift_speed                 three rows

    d is the blob's ray in W. The receivers' positions differ by `gnss_error` for long, so without
    fixed ambiguities on both sides they are fused only while less is known, and begin nothing;
    with them (fix type 6) they are a sighting like the marker's: they begin hypotheses, count as
    evidence, and a pad that no camera sees is landed on.

    Latency needs no parameter. A measurement that comes after a younger one is put in its place
    among the last 48, and all behind it are filtered anew: exactly the filter that had them in
    order (Bar-Shalom, "Update with out-of-sequence measurements in tracking: exact solution", IEEE
    T-AES 38(3), 2002, section II, gives re-processing as the reference). For one older than these
    some estimates x_k are kept as they leave, every 0.1 s, with C_k = cov(e, e_k), which follows
    the filter, C_k ← (I − K H) F C_k (the product of gains in Larsen et al., "Incorporation of
    time delayed measurements in a discrete-time Kalman filter", CDC 1998). Predicted to the
    measurement's time x_k gives the innovation ν, and the oldest estimate is corrected by
    C_k Hᵀ S⁻¹ ν: the best use of ν, with its true covariance, though x_k knows less than what was
    fused since.
    What is older than the memory of poses is not used. A constant error of the time stamps
    themselves is not estimated: without a motion that the vehicle makes on purpose it
    cannot be told from b.

    Hypotheses (a small multiple hypothesis tracker, one association each; Blackman,
    "Multiple hypothesis tracking for multiple target tracking", IEEE AESM 19(1), 2004). A
    measurement belongs to the hypothesis under which it is likeliest, νᵀ S⁻¹ ν + ln |S|. Where
    νᵀ S⁻¹ ν exceeds the chi-square gate for all of them, it belongs to one whose velocity may have
    changed at once, by `initial_speed`: the marker's code names the pad; a blob does not, and must
    be where nothing else can be, within 0.25 m (one sigma) since it was last seen. Otherwise it
    begins another hypothesis. So a gate never gives in: what persists outside of it becomes a
    rival that has to win by evidence,

        ln odds = (first: 0; later: ln late_probability)
                  + Σ marker_odds (1 − e^(−Δt/marker_time)),            limited

    over the marker measurements that belong to it, less those that belonged elsewhere while
    nothing was seen of it: the marker's code tells the pad from a lamp, and what follows the
    measurement before it after Δt tells little new.
    A lamp that appears later than the pad, or without a marker on it, loses for as long as
    the pad is seen, and `forget_time` longer; then what is left inherits. Rivals within 0.25 m
    are one. `target` is the most probable hypothesis i, its
    covariance that of the mixture, P_i + Σ probability_j (p_j − p_i)².

    Nothing is counted, as frames come from once to fifty times a second. A hypothesis is known,
    and then begins to rival others, while its place will be known to `known_radius` in a second
    from now: after a few frames, when its velocity is, and for as long as nobody has to see it,
    which is some seconds for a pad that moves and a minute for one at rest. The target is
    acquired while it is known; how well is told by its variance, when it was last seen by
    `time_of_last_fusion`. A hypothesis uncertain to `forget_radius` is given up.

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
        self._svgs = optional_input(declare("svgs", SVGS.size), no_measurement(SVGS))
        self._gnss = optional_input(declare("gnss", GNSS.size), no_measurement(GNSS))
        self._pad_gnss = optional_input(declare("pad_gnss", GNSS.size), no_measurement(GNSS))
        self._range_finder = optional_input(
            declare("range_finder", RANGE_FINDER.size), no_measurement(RANGE_FINDER)
        )
        self._estimate = declare("estimate", VEHICLE_ESTIMATE.size).Eval
        memory = MEMORY(MEMORY.zeros())
        memory.infrared_arrival = memory.marker_arrival = memory.range_arrival = -1.0
        memory.svgs_arrival = memory.pad_gnss_arrival = memory.pad_gnss_fused = -1.0
        memory.gnss_arrival = memory.fix_time = -1.0
        memory.code_seen = -np.inf
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
        k.density_position_at_rest = k.density_position_moving = c.position_noise**2
        k.density_horizontal_at_rest = 2.0 * c.drift_speed**2 / c.drift_time
        k.density_horizontal_moving = c.horizontal_acceleration**2
        k.density_vertical_at_rest = k.density_vertical_moving = c.vertical_acceleration**2
        k.velocity_time_at_rest, k.velocity_time_moving = c.drift_time, np.inf
        k.bias_sigma_at_rest = k.bias_sigma_moving = c.bearing_bias
        k.bias_time_at_rest = k.bias_time_moving = c.bearing_bias_time
        k.sources = _SOURCES[s.mode]
        for name in ("infrared_angle_noise", "infrared_lamp_noise", "marker_noise",
                     "attitude_noise", "range_noise", "ground_noise", "pad_radius",
                     "gnss_error"):  # fmt: skip
            setattr(k, name, getattr(s, name))
        for name in ("drift_speed", "initial_radius", "initial_speed", "marker_odds", "marker_time",
                     "marker_odds_limit", "known_radius", "known_slope", "forget_radius",
                     "forget_slope", "forget_time"):  # fmt: skip
            setattr(k, name, getattr(c, name))
        k.gate_2, k.gate_3 = chdtri((2, 3), 1.0 - c.gate_probability)  # chi-square quantiles
        k.late_odds = float(np.log(c.late_probability))
        k.latitude, k.longitude, k.altitude = s.origin
        self._parameters = k[:]
        self._parameters[PARAMETERS.slice("range_finder")] = s.range_finder_position
        self._X_BI = camera_mount(s.infrared_position, s.infrared_yaw)
        self._X_BM = camera_mount(s.marker_position, s.marker_yaw)
        self._X_BS = camera_mount(s.svgs_position, s.svgs_yaw)
        self._placements = s.beacons.placements()

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
            self._svgs(context),
            self._gnss(context),
            self._pad_gnss(context),
            self._range_finder(context),
            self._estimate(context),
            self._parameters,
            self._X_BI,
            self._X_BM,
            self._X_BS,
            self._placements,
        )

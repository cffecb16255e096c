"""From sensors to hypotheses, compiled; the equations are in `multi_hypothesis_target`."""

import math

import numpy as np
from numba import njit

from systems.estimators import multi_hypothesis_target_filter as track_filter
from systems.estimators.fused_sensor_kernel import INFRARED_SOURCE, MARKER_SOURCE
from systems.estimators.multi_hypothesis_target_filter import (
    BIAS_SIGMA,
    BORN,
    CODE,
    COUNT,
    FUSED,
    KICK,
    MOVES,
    NOISE,
    OBSERVATION,
    PRIOR,
    ROW_COUNT,
    SEEN,
    SINCE,
    STATES,
    TIME,
)
from systems.estimators.svgs_companion_transformations import SVGS_SOURCE as _SVGS_BIT
from systems.estimators.svgs_companion_transformations import pad_from_pose
from systems.frames import rotation_matrix
from systems.geodesy import world_from_geodetic
from systems.signals.measurement import (
    GNSS,
    INFRARED,
    INFRARED_BLOBS,
    RANGE_FINDER,
    SEQUENCE_NUMBER,
    SVGS,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    VALID,
    VEHICLE_ESTIMATE,
    Layout,
    vector,
)
from systems.vision.planar_pose import pad_position_from_marker

SVGS_SOURCE = int(_SVGS_BIT)

PARAMETERS = Layout(
    "MultiHypothesisTargetParameters",
    (
        # The process noise of a pad at rest and of one that moves come first, both in the order
        # of `multi_hypothesis_target_filter`
        *(
            f"{name}_{pad}"
            for pad in ("at_rest", "moving")
            for name in (
                "density_position",  # m2/s
                "density_horizontal",  # m2/s3
                "density_vertical",  # m2/s3
                "velocity_time",  # s
                "bias_sigma",  # rad
                "bias_time",  # s
            )
        ),
        "drift_speed",  # m/s, one sigma of the odometry's
        "sources",  # bits of the sensors that are listened to
        "infrared_angle_noise",  # rad
        "infrared_lamp_noise",  # m
        "marker_noise",  # m
        "attitude_noise",  # rad
        "range_noise",  # m
        "ground_noise",  # m, of the pad's height over the ground around it
        "pad_radius",  # m
        "initial_radius",  # m
        "initial_speed",  # m/s
        "gate_2",  # 1, chi-square with two degrees of freedom
        "gate_3",  # 1, with three
        "late_odds",  # 1, log of the odds of a hypothesis that is not the first
        "marker_odds",  # 1, log of the odds that a marker measurement adds
        "marker_time",  # s, within which two of them tell the same
        "marker_odds_limit",  # 1
        "known_radius",  # m
        "known_slope",  # 1
        "forget_radius",  # m
        "forget_slope",  # 1
        "forget_time",  # s
        "range_finder_x",  # m, in B
        "range_finder_y",
        "range_finder_z",
        "gnss_error",  # m, of the difference of two receivers, unless both have fixed ambiguities
        "latitude",  # deg, of W's origin
        "longitude",  # deg
        "altitude",  # m
        "odometry_z",  # m, of the vehicle now
    ),
)
POSES = 128  # polls that are remembered, 2 s
_POSE = 11  # time, p_OB, q_WB, v_WB
MEMORY = Layout(
    "MultiHypothesisTargetMemory",
    (
        "infrared_arrival",  # s, of the newest measurement taken
        "marker_arrival",
        "range_arrival",
        "svgs_arrival",
        "pad_gnss_arrival",
        "pad_gnss_fused",  # s, validity of the newest one fused; -1 none
        "gnss_arrival",
        "fix_time",  # s, validity of the vehicle's own newest fix; -1 none
        *vector("fix"),  # m, from the odometry's origin to W's, by that fix
        *vector("fix_variance"),  # m2
        "fix_type",  # as in `GNSS`
        "polls",  # so far
        "range_polls",  # polls since a range was taken
        "code_seen",  # s, validity of the newest marker measurement that was evidence
        *(f"pose_{i}_{entry}" for i in range(POSES) for entry in range(_POSE)),
    ),
)
HYPOTHESES = 3
# What is thought possible, the most probable first.
TARGET_HYPOTHESES = Layout(
    "TargetHypotheses",
    tuple(
        f"{name}_{i}"
        for i in range(HYPOTHESES)
        for name in (
            "probability",  # 0..1, that this is the pad; 0 no hypothesis
            "p_WP_x",  # m, in the navigation filter's frame
            "p_WP_y",
            "p_WP_z",
            "evidence",  # 1, log of its odds
            "count",  # measurements fused
        )
    ),
)
_PER_HYPOTHESIS = TARGET_HYPOTHESES.size // HYPOTHESES

_i = PARAMETERS.index
_SOURCES, _ANGLE, _LAMP = _i("sources"), _i("infrared_angle_noise"), _i("infrared_lamp_noise")
_MARKER_NOISE, _ATTITUDE = _i("marker_noise"), _i("attitude_noise")
_RANGE_NOISE, _GROUND_NOISE, _PAD_RADIUS = _i("range_noise"), _i("ground_noise"), _i("pad_radius")
_RADIUS, _SPEED = _i("initial_radius"), _i("initial_speed")
_GATE_2, _GATE_3 = _i("gate_2"), _i("gate_3")
_LATE, _MARKER_ODDS, _ODDS_LIMIT = _i("late_odds"), _i("marker_odds"), _i("marker_odds_limit")
_MARKER_TIME, _DRIFT_SPEED = _i("marker_time"), _i("drift_speed")
_KNOWN, _FORGET_RADIUS, _FORGET = _i("known_radius"), _i("forget_radius"), _i("forget_time")
_KNOWN_SLOPE, _FORGET_SLOPE = _i("known_slope"), _i("forget_slope")
_ARM, _GNSS_ERROR, _ORIGIN = _i("range_finder_x"), _i("gnss_error"), _i("latitude")
_HERE = _i("odometry_z")

_m = MEMORY.index
_IR_ARRIVAL, _MARKER_ARRIVAL = _m("infrared_arrival"), _m("marker_arrival")
_RANGE_ARRIVAL, _SVGS_ARRIVAL = _m("range_arrival"), _m("svgs_arrival")
_PAD_GNSS_ARRIVAL, _PAD_GNSS_FUSED = _m("pad_gnss_arrival"), _m("pad_gnss_fused")
_GNSS_ARRIVAL, _FIX_TIME, _FIX_X = _m("gnss_arrival"), _m("fix_time"), _m("fix_x")
_FIX_VARIANCE, _FIX_TYPE = _m("fix_variance_x"), _m("fix_type")
_POLLS, _RANGE_POLLS, _CODE_SEEN = _m("polls"), _m("range_polls"), _m("code_seen")
_RING = _m("pose_0_0")
_RANGE_EVERY = 4  # polls, so that ranges do not crowd the slots
_MERGE_DISTANCE = 0.25  # m, hypotheses closer than this are the same pad
_AHEAD = 1.0  # s, in which the vehicle answers: so long the place must stay known
_UNSEEN = 0.25  # s, after which a marker seen elsewhere counts against a hypothesis
_FURTHEST_RAY = 0.2  # 1, least slope of a ray that says where a lamp is
_EDGE = 0.42  # 1, tangent; a lamp this far from the middle may be cut off by the image's edge

_E_T = VEHICLE_ESTIMATE.index("time_of_validity")
_E_ATTITUDE_VALID = VEHICLE_ESTIMATE.index("attitude_valid")
_E_H_VALID = VEHICLE_ESTIMATE.index("horizontal_valid")
_E_Q = VEHICLE_ESTIMATE.index("q_WB_w")
_E_P = VEHICLE_ESTIMATE.index("p_WB_x")
_E_V = VEHICLE_ESTIMATE.index("v_WB_x")
_E_HEIGHT = VEHICLE_ESTIMATE.index("height_above_ground")
_E_HEIGHT_VALID = VEHICLE_ESTIMATE.index("height_above_ground_valid")
_RANGE = RANGE_FINDER.index("range")
_BEACON = SVGS.index("beacon")
_LATITUDE, _GNSS_V = GNSS.index("latitude"), GNSS.index("v_W_x")
_H_ACCURACY, _V_ACCURACY = GNSS.index("horizontal_accuracy"), GNSS.index("vertical_accuracy")
_SPEED_ACCURACY, _FIX = GNSS.index("speed_accuracy"), GNSS.index("fix_type")
_RTK_FIXED = 6.0
_FIX_OLD = 2.0  # s, at which the vehicle's own fix is no base for the pad's any more
_COUNT_BLOBS = INFRARED.index("count")
_BLOB = INFRARED.index("blob_0_x")
_M_P = TARGET_MEASUREMENT.index("p_BP_W_x")
_M_SOURCE = TARGET_MEASUREMENT.index("source")
_VALIDITY, _ACQUIRED, _T_FUSED, _T_P = range(4)
_T_V = TARGET_ESTIMATE.index("v_BP_W_x")
_T_V_PAD = TARGET_ESTIMATE.index("v_WP_x")
_T_P_VARIANCE = TARGET_ESTIMATE.index("position_variance_x")
_T_V_VARIANCE = TARGET_ESTIMATE.index("velocity_variance_x")
_T_RATIO = TARGET_ESTIMATE.index("innovation_test_ratio")
_T_REJECTED = TARGET_ESTIMATE.index("rejected_count")
_T_SOURCE = TARGET_ESTIMATE.index("source")


@njit(cache=True)
def _remember_pose(memory, estimate):
    """Append the vehicle's pose, its place by odometry: the integral of the estimated velocity."""
    polls = int(memory[_POLLS])
    start = _RING + _POSE * (polls % POSES)
    before = _RING + _POSE * ((polls - 1) % POSES)
    for i in range(3):
        v = estimate[_E_V + i]
        if polls == 0:
            memory[start + 1 + i] = estimate[_E_P + i]
        else:
            way = 0.5 * (memory[before + 8 + i] + v) * (estimate[_E_T] - memory[before])
            memory[start + 1 + i] = memory[before + 1 + i] + way
        memory[start + 8 + i] = v
    memory[start] = estimate[_E_T]
    memory[start + 4 : start + 8] = estimate[_E_Q : _E_Q + 4]
    memory[_POLLS] = polls + 1.0


@njit(cache=True)
def _pose_at(memory, time, p, q):
    """Position and attitude of the vehicle at `time`; False if that is forgotten."""
    polls = int(memory[_POLLS])
    oldest = max(polls - POSES, 0)
    k = polls - 1
    while k >= oldest and memory[_RING + _POSE * (k % POSES)] > time:
        k -= 1
    if k < oldest:
        return False
    a = _RING + _POSE * (k % POSES)
    since = time - memory[a]
    if k == polls - 1:
        for i in range(3):
            p[i] = memory[a + 1 + i] + since * memory[a + 8 + i]
        q[:] = memory[a + 4 : a + 8]
        return True
    b = _RING + _POSE * ((k + 1) % POSES)
    span = memory[b] - memory[a]
    share = since / span if span > 0.0 else 0.0
    dot = norm = 0.0
    for i in range(4):
        dot += memory[a + 4 + i] * memory[b + 4 + i]
    sign = 1.0 if dot >= 0.0 else -1.0
    for i in range(4):
        q[i] = (1.0 - share) * memory[a + 4 + i] + share * sign * memory[b + 4 + i]
        norm += q[i] * q[i]
    for i in range(4):
        q[i] /= math.sqrt(norm)
    for i in range(3):
        p[i] = (1.0 - share) * memory[a + 1 + i] + share * memory[b + 1 + i]
    return True


@njit(cache=True)
def observe_marker(observation, time, marker, p_OB, q_WB, X_BC, parameters):
    """Write a marker measurement; returns p_BP_W and its covariance, shape (9,)."""
    found = pad_position_from_marker(marker, q_WB, X_BC)
    noise = parameters[_MARKER_NOISE] ** 2
    lateral = noise + (found[2] * parameters[_ATTITUDE]) ** 2
    found[3] += lateral
    found[5] += lateral
    found[8] += noise
    _observe_place(observation, time, found, p_OB)
    return found


@njit(cache=True)
def observe_svgs(observation, time, pose, p_OB, q_WB, X_BC, placements, parameters):
    """Write the pose of an SVGS beacon; returns p_BP_W and its covariance, shape (9,)."""
    found = np.empty(9)
    pad_from_pose(pose, q_WB, X_BC, placements, parameters[_ATTITUDE], False, found)
    _observe_place(observation, time, found, p_OB)
    return found


@njit(cache=True)
def _observe_place(observation, time, found, p_OB):
    """Write p_BP_W and its covariance: all of p, and the bearing's bias at its height."""
    height = -found[2]
    H = np.zeros((3, STATES))
    values = np.empty(3)
    for i in range(3):
        H[i, i] = 1.0
        values[i] = p_OB[i] + found[i]
    H[0, 6] = H[1, 7] = height
    R = np.array(
        [
            [found[3], found[4], found[6]],
            [found[4], found[5], found[7]],
            [found[6], found[7], found[8]],
        ]
    )
    track_filter.whiten(observation, time, H, values, R, 3)


@njit(cache=True)
def observe_blob(observation, time, x, y, height, p_OB, q_WB, X_BC, parameters):
    """Write the direction of one blob, a lamp `height` (m) below the body: two rows.

        0 = (p − p_OC)_i − d_i/d_z (p − p_OC)_z + height b_i,   i = x, y,   d = R_WC (x, y, 1)

    Returns p_BP_W of the lamp at that height and its covariance, shape (9,); NaN if the ray
    is too flat.
    """
    R_WB = rotation_matrix(q_WB)
    R_WC = R_WB @ np.ascontiguousarray(X_BC[:, :3])
    arm = R_WB @ np.ascontiguousarray(X_BC[:, 3])
    d = R_WC @ np.array([x, y, 1.0])
    found = np.full(9, np.nan)
    length = math.sqrt(x * x + y * y + 1.0)
    if -d[2] < _FURTHEST_RAY * length:
        return found
    s = -(max(height, 0.05) + arm[2]) / d[2]
    if s <= 0.0:
        return found
    H = np.zeros((3, STATES))
    values = np.zeros(3)
    J = np.empty((2, 2))
    for i in range(2):
        slope = d[i] / d[2]
        H[i, i] = 1.0
        H[i, 2] = -slope
        H[i, 6 + i] = height
        values[i] = p_OB[i] + arm[i] - slope * (p_OB[2] + arm[2])
        J[i, 0] = s * (R_WC[i, 0] - slope * R_WC[2, 0])
        J[i, 1] = s * (R_WC[i, 1] - slope * R_WC[2, 1])
    angle = parameters[_ANGLE] ** 2
    lateral = parameters[_LAMP] ** 2 + (height * parameters[_ATTITUDE]) ** 2
    R = np.zeros((3, 3))
    R[0, 0] = angle * (J[0, 0] ** 2 + J[0, 1] ** 2) + lateral
    R[1, 0] = R[0, 1] = angle * (J[0, 0] * J[1, 0] + J[0, 1] * J[1, 1])
    R[1, 1] = angle * (J[1, 0] ** 2 + J[1, 1] ** 2) + lateral
    for i in range(3):
        found[i] = arm[i] + s * d[i]
        found[3 + i] = found[6 + i] = 0.0
    found[3], found[4], found[5] = R[0, 0], R[0, 1], R[1, 1]
    track_filter.whiten(observation, time, H, values, R, 2)
    return found


@njit(cache=True)
def observe_range(observation, time, ranging, p_OB, q_WB, off_pad, parameters):
    """Write a range: p_z, where the beam meets the pad or the ground around it."""
    R_WB = rotation_matrix(q_WB)
    arm = R_WB[2, 0] * parameters[_ARM] + R_WB[2, 1] * parameters[_ARM + 1]
    height = R_WB[2, 2] * (ranging[_RANGE] - parameters[_ARM + 2]) - arm
    noise = parameters[_RANGE_NOISE] ** 2
    if off_pad:
        noise += parameters[_GROUND_NOISE] ** 2
    H = np.zeros((3, STATES))
    H[0, 2] = 1.0
    values = np.zeros(3)
    values[0] = p_OB[2] - height
    R = np.zeros((3, 3))
    R[0, 0] = noise
    track_filter.whiten(observation, time, H, values, R, 1)


@njit(cache=True)
def _noise(track, parameters):
    """The process noise of a track, of a pad at rest or of one that moves."""
    start = NOISE if track[MOVES] > 0.0 else 0
    return parameters[start : start + NOISE]


@njit(cache=True)
def _squared_innovation(track, observation, x, P, parameters):
    """Normalised innovation squared and log-determinant of a measurement at its own time."""
    if not track_filter.prior(track, observation, x, P, _noise(track, parameters)):
        return math.inf, 0.0
    return track_filter.fuse(x, P, observation)


@njit(cache=True)
def _likeliest(tracks, observation, gate, taken, x, P, parameters):
    """The likeliest track (in use, not yet `taken`) of a measurement, and its NIS; -1 if none.

    Likeliest, not nearest: a track that has just begun is so uncertain that it is near everything.
    """
    best, best_squared, least = -1, 0.0, math.inf
    for i in range(tracks.shape[0]):
        if tracks[i, BORN] < 0.0 or taken[i]:
            continue
        squared, spread = _squared_innovation(tracks[i], observation, x, P, parameters)
        if squared <= gate and squared + spread < least:
            best, best_squared, least = i, squared, squared + spread
    return best, best_squared


@njit(cache=True)
def _associate(tracks, observation, gate, taken, named, x, P, parameters):
    """The track of a measurement and its NIS; -1 if it belongs to none.

    What no track has foreseen may be a pad that has set off or stopped since it was last seen. A
    measurement whose code does not name the pad must be so near that it can be nothing else.
    """
    best, best_squared = _likeliest(tracks, observation, gate, taken, x, P, parameters)
    if best >= 0:
        return best, best_squared
    best_since = math.inf
    for i in range(tracks.shape[0]):
        since = observation[TIME] - tracks[i, FUSED]
        if tracks[i, BORN] < 0.0 or taken[i] or since <= 0.0 or since >= best_since:
            continue
        if not named and since * parameters[_SPEED] > _MERGE_DISTANCE:
            continue
        observation[KICK], observation[SINCE] = parameters[_SPEED] ** 2, since
        squared, _ = _squared_innovation(tracks[i], observation, x, P, parameters)
        if squared <= gate:
            best, best_squared, best_since = i, squared, since
    observation[KICK] = 0.0 if best < 0 else parameters[_SPEED] ** 2
    observation[SINCE] = 0.0 if best < 0 else best_since
    return best, best_squared


@njit(cache=True)
def _known(track, t, x, P, parameters):
    """Whether the place of a track is known for a while; x and P are its estimate at t (s).

    From high up less need be known.
    """
    track_filter.newest(track, t, x, P, _noise(track, parameters))
    ahead = 0.0
    for i in range(2):
        spread = P[i, i] + _AHEAD * (2.0 * P[i, 3 + i] + _AHEAD * P[3 + i, 3 + i])
        ahead = max(ahead, spread)
    enough = max(parameters[_KNOWN], parameters[_KNOWN_SLOPE] * (parameters[_HERE] - x[2]))
    return ahead <= enough * enough


@njit(cache=True)
def _room(tracks, t, x, P, parameters):
    """A track that is not in use or else the least probable that is not known; -1 if all are."""
    least = -1
    for i in range(tracks.shape[0]):
        if tracks[i, BORN] < 0.0:
            return i
        if tracks[i, SEEN] == t or _known(tracks[i], t, x, P, parameters):
            continue
        if least < 0 or _evidence(tracks[i]) < _evidence(tracks[least]):
            least = i
    return least


@njit(cache=True)
def _begin(tracks, t, time, found, p_OB, height_sigma, parameters, x, P):
    """Begin a hypothesis around a measured p_BP_W; returns its number, -1 if there is no room."""
    i = _room(tracks, t, x, P, parameters)
    if i < 0:
        return -1
    late = False
    for j in range(tracks.shape[0]):
        late |= j != i and tracks[j, BORN] >= 0.0 and _known(tracks[j], t, x, P, parameters)
    P[:] = 0.0
    x[:] = 0.0
    for k in range(3):
        x[k] = p_OB[k] + found[k]
        P[k, k] = parameters[_RADIUS] ** 2
        P[3 + k, 3 + k] = parameters[_SPEED] ** 2
    P[2, 2] = height_sigma * height_sigma
    P[6, 6] = P[7, 7] = parameters[BIAS_SIGMA] ** 2
    track_filter.begin(tracks[i], time, x, P)
    tracks[i, PRIOR] = parameters[_LATE] if late else 0.0
    return i


@njit(cache=True)
def _take(track, observation, t, x, P, parameters):
    """Fuse a sighting into a track at time t."""
    noise = _noise(track, parameters)
    track_filter.insert(track, observation, x, P, noise)
    track[FUSED] = max(track[FUSED], observation[TIME])
    track[SEEN] = t
    track[COUNT] += 1.0
    _see_motion(track, t, x, P, parameters)


@njit(cache=True)
def _see_motion(track, t, x, P, parameters):
    """See whether a track moves: if its velocity is not explained by the odometry's error."""
    track_filter.newest(track, t, x, P, _noise(track, parameters))
    drift = parameters[_DRIFT_SPEED] ** 2
    speed = x[3] * x[3] / (P[3, 3] + drift) + x[4] * x[4] / (P[4, 4] + drift)
    track[MOVES] = 1.0 if speed > parameters[_GATE_2] else 0.0


@njit(cache=True)
def _evidence(track):
    """The log of the odds of a hypothesis."""
    return track[PRIOR] + track[CODE]


@njit(cache=True)
def _credit(tracks, i, time, memory, parameters):
    """The marker was seen on track i, so not on those that nothing is seen of.

    Frames that follow each other closely tell the same: 1 − exp(−Δt/marker_time) of the odds.
    """
    interval = time - memory[_CODE_SEEN]
    if interval <= 0.0:
        return
    memory[_CODE_SEEN] = time
    odds = -parameters[_MARKER_ODDS] * math.expm1(-interval / parameters[_MARKER_TIME])
    limit = parameters[_ODDS_LIMIT] - tracks[i, PRIOR]
    tracks[i, CODE] = min(tracks[i, CODE] + odds, limit)
    for j in range(tracks.shape[0]):
        if j != i and time - tracks[j, FUSED] > _UNSEEN:
            tracks[j, CODE] = max(tracks[j, CODE] - odds, 0.0)


@njit(cache=True)
def _probabilities(tracks, t, x, P, parameters, probability):
    """Write each track's probability, the odds normalised; the most probable one or -1.

    A track that is not known yet, a reflection perhaps, counts only while no other is.
    """
    best, known = -1, False
    for i in range(tracks.shape[0]):
        probability[i] = 0.0
        if tracks[i, BORN] < 0.0:
            continue
        own = _known(tracks[i], t, x, P, parameters)
        if own and not known:
            probability[:i] = 0.0
            best, known = -1, True
        if own == known:
            probability[i] = 1.0
            if best < 0 or _evidence(tracks[i]) > _evidence(tracks[best]):
                best = i
    total = 0.0
    for i in range(tracks.shape[0]):
        if probability[i] > 0.0:
            probability[i] = math.exp(_evidence(tracks[i]) - _evidence(tracks[best]))
            total += probability[i]
    for i in range(tracks.shape[0]):
        if total > 0.0:
            probability[i] /= total
    return best


@njit(cache=True)
def _write_measurement(measurement, t, validity, found, source):
    measurement[TIME_OF_VALIDITY] = validity
    measurement[TIME_OF_ARRIVAL] = t
    measurement[SEQUENCE_NUMBER] += 1.0
    measurement[VALID] = 1.0
    measurement[_M_P : _M_P + 9] = found
    measurement[_M_SOURCE] = source


@njit(cache=True)
def _arrived(measurement, memory, last):
    """Whether a measurement is new; `last` is the place of the last arrival in the memory."""
    if measurement[VALID] == 0.0 or measurement[TIME_OF_ARRIVAL] == memory[last]:
        return False
    memory[last] = measurement[TIME_OF_ARRIVAL]
    return True


@njit(cache=True)
def _sight(
    target,
    measurement,
    tracks,
    observation,
    found,
    p_OB,
    height_sigma,
    source,
    taken,
    leader,
    t,
    x,
    P,
    parameters,
):
    """Give a sighting to its track or begin one; returns its number, -1 if there is no room.

    What belongs to the leader, or to anything while there is none, becomes the `measurement`.
    """
    gate = parameters[_GATE_2] if observation[ROW_COUNT] == 2.0 else parameters[_GATE_3]
    named = source == MARKER_SOURCE
    i, squared = _associate(tracks, observation, gate, taken, named, x, P, parameters)
    if i < 0:
        time = observation[TIME]
        i = _begin(tracks, t, time, found, p_OB, height_sigma, parameters, x, P)
        squared = 0.0
    if i < 0:
        return i
    _take(tracks[i], observation, t, x, P, parameters)
    if i == leader or leader < 0:
        target[_T_RATIO] = squared / gate
        target[_T_SOURCE] = source
        _write_measurement(measurement, t, observation[TIME], found, source)
    return i


@njit(cache=True)
def _place_blob(
    tracks, validity, x_C, y_C, estimate, p_OB, q_WB, X_BI, leader, observation, x, P, parameters
):
    """Write the observation of a blob at the pad's height; p_BP_W, and the height's sigma (m).

    NaN for a blob that says nothing.
    """
    height, sigma = math.nan, parameters[_GROUND_NOISE]
    if leader >= 0:
        observation[TIME], observation[KICK] = validity, 0.0
        track_filter.prior(tracks[leader], observation, x, P, _noise(tracks[leader], parameters))
        height = p_OB[2] - x[2]
        sigma = max(sigma, math.sqrt(P[2, 2]))
    elif estimate[_E_HEIGHT_VALID] > 0.0:
        height = estimate[_E_HEIGHT]
    cut_off = height < 1.0 and max(abs(x_C), abs(y_C)) > _EDGE
    if cut_off or not math.isfinite(height):
        return np.full(9, np.nan), sigma
    found = observe_blob(observation, validity, x_C, y_C, height, p_OB, q_WB, X_BI, parameters)
    return found, sigma


@njit(cache=True)
def _take_range(tracks, ranging, p_OB, q_WB, observation, x, P, parameters):
    """Fuse a range into every track that it fits. It is no sighting: it does not count."""
    validity, reach = ranging[TIME_OF_VALIDITY], ranging[_RANGE]
    R_WB = rotation_matrix(q_WB)
    for i in range(tracks.shape[0]):
        if tracks[i, BORN] < 0.0:
            continue
        observation[TIME], observation[KICK] = validity, 0.0
        noise = _noise(tracks[i], parameters)
        track_filter.prior(tracks[i], observation, x, P, noise)
        off = math.hypot(p_OB[0] - reach * R_WB[0, 2] - x[0], p_OB[1] - reach * R_WB[1, 2] - x[1])
        off_pad = off > parameters[_PAD_RADIUS]
        observe_range(observation, validity, ranging, p_OB, q_WB, off_pad, parameters)
        squared, _ = _squared_innovation(tracks[i], observation, x, P, parameters)
        if squared <= parameters[_GATE_2]:
            track_filter.insert(tracks[i], observation, x, P, noise)


@njit(cache=True)
def _keep_fix(memory, gnss, p_OB, parameters):
    """Remember where the vehicle's own receiver puts the odometry's origin."""
    place = world_from_geodetic(gnss[_LATITUDE : _LATITUDE + 3], parameters[_ORIGIN : _ORIGIN + 3])
    memory[_FIX_TIME], memory[_FIX_TYPE] = gnss[TIME_OF_VALIDITY], gnss[_FIX]
    for i in range(3):
        memory[_FIX_X + i] = p_OB[i] - place[i]
        memory[_FIX_VARIANCE + i] = gnss[_H_ACCURACY if i < 2 else _V_ACCURACY] ** 2


@njit(cache=True)
def _take_pad_gnss(tracks, memory, t, gnss, p_OB, taken, observation, x, P, parameters):
    """Fuse what the pad's own receiver says; begin a hypothesis if it is precise enough.

    A receiver's errors last, so the place is fused only where less is known than it says.
    """
    time = gnss[TIME_OF_VALIDITY]
    if memory[_FIX_TIME] < 0.0 or abs(time - memory[_FIX_TIME]) > _FIX_OLD:
        return
    precise = gnss[_FIX] >= _RTK_FIXED and memory[_FIX_TYPE] >= _RTK_FIXED
    lasting = 0.0 if precise else parameters[_GNSS_ERROR] ** 2
    place = world_from_geodetic(gnss[_LATITUDE : _LATITUDE + 3], parameters[_ORIGIN : _ORIGIN + 3])
    H, R, values = np.zeros((3, STATES)), np.zeros((3, 3)), np.zeros(3)
    found = np.zeros(9)
    for i in range(3):
        values[i] = place[i] + memory[_FIX_X + i]
        found[i] = values[i] - p_OB[i]
        H[i, i] = 1.0
        accuracy = gnss[_H_ACCURACY if i < 2 else _V_ACCURACY]
        R[i, i] = accuracy * accuracy + memory[_FIX_VARIANCE + i] + lasting
    variance, height_sigma = R[0, 0], math.sqrt(R[2, 2])
    track_filter.whiten(observation, time, H, values, R, 2)
    i, _ = _associate(tracks, observation, parameters[_GATE_2], taken, True, x, P, parameters)
    if i < 0 and variance <= parameters[_KNOWN] ** 2:
        i = _begin(tracks, t, time, found, p_OB, height_sigma, parameters, x, P)
    if i < 0:
        return
    noise = _noise(tracks[i], parameters)
    if track_filter.prior(tracks[i], observation, x, P, noise) and P[0, 0] > variance:
        track_filter.insert(tracks[i], observation, x, P, noise)

    H[:], R[:] = 0.0, 0.0
    for k in range(3):
        H[k, 3 + k] = 1.0
        values[k] = gnss[_GNSS_V + k]
        R[k, k] = gnss[_SPEED_ACCURACY] ** 2 + parameters[_DRIFT_SPEED] ** 2
    track_filter.whiten(observation, time, H, values, R, 3)
    squared, _ = _squared_innovation(tracks[i], observation, x, P, parameters)
    since = time - max(tracks[i, FUSED], memory[_PAD_GNSS_FUSED])
    if squared > parameters[_GATE_3] and since > 0.0:
        observation[KICK], observation[SINCE] = parameters[_SPEED] ** 2, since
        squared, _ = _squared_innovation(tracks[i], observation, x, P, parameters)
    if squared <= parameters[_GATE_3]:
        track_filter.insert(tracks[i], observation, x, P, noise)
        memory[_PAD_GNSS_FUSED] = time
    if precise:
        tracks[i, FUSED] = max(tracks[i, FUSED], time)
        tracks[i, SEEN] = t
        tracks[i, COUNT] += 1.0
        _credit(tracks, i, time, memory, parameters)
    _see_motion(tracks[i], t, x, P, parameters)


@njit(cache=True)
def poll(
    target,
    measurement,
    hypotheses,
    memory,
    tracks,
    t,
    infrared,
    marker,
    svgs,
    gnss,
    pad_gnss,
    ranging,
    estimate,
    parameters,
    X_BI,
    X_BM,
    X_BS,
    placements,
):
    """One event at time t (s).

    Parameters
    ----------
    target, measurement, hypotheses : arrays
        Of the layouts TARGET_ESTIMATE, TARGET_MEASUREMENT, TARGET_HYPOTHESES; updated in place.
    memory : array of shape (MEMORY.size,)
        Updated in place.
    tracks : array of shape (HYPOTHESES, TRACK)
        Updated in place.
    infrared, marker, svgs, gnss, pad_gnss, ranging, estimate : arrays
        Of the layouts INFRARED, MARKER, SVGS, GNSS twice, RANGE_FINDER and VEHICLE_ESTIMATE.
    parameters : array of shape (PARAMETERS.size,)
    X_BI, X_BM, X_BS : arrays of shape (3, 4)
        Mounts of the infrared, the marker and the SVGS camera.
    placements : array of shape (3, 4)
        Of the SVGS beacons in P, as in `pad_from_pose`.
    """
    if estimate[_E_ATTITUDE_VALID] > 0.0 and estimate[_E_H_VALID] > 0.0:
        _remember_pose(memory, estimate)
    if memory[_POLLS] == 0.0:
        return
    x = np.empty(STATES)
    P = np.empty((STATES, STATES))
    p, q = np.empty(3), np.empty(4)
    observation = np.zeros(OBSERVATION)
    taken = np.zeros(tracks.shape[0], np.bool_)
    probability = np.empty(tracks.shape[0])
    parameters = parameters.copy()
    parameters[_HERE] = memory[_RING + _POSE * (int(memory[_POLLS] - 1.0) % POSES) + 3]
    leader = _probabilities(tracks, t, x, P, parameters, probability)
    sources = int(parameters[_SOURCES])

    if (
        sources & MARKER_SOURCE
        and _arrived(marker, memory, _MARKER_ARRIVAL)
        and _pose_at(memory, marker[TIME_OF_VALIDITY], p, q)
    ):
        validity = marker[TIME_OF_VALIDITY]
        found = observe_marker(observation, validity, marker, p, q, X_BM, parameters)
        i = _sight(
            target, measurement, tracks, observation, found, p, parameters[_RADIUS],
            MARKER_SOURCE, taken, leader, t, x, P, parameters,
        )  # fmt: skip
        if i >= 0:
            _credit(tracks, i, validity, memory, parameters)
        own = i >= 0 and (i == leader or leader < 0)
        target[_T_REJECTED] = 0.0 if own else target[_T_REJECTED] + 1.0

    if (
        sources & SVGS_SOURCE
        and _arrived(svgs, memory, _SVGS_ARRIVAL)
        and svgs[_BEACON] >= 0.0
        and _pose_at(memory, svgs[TIME_OF_VALIDITY], p, q)
    ):
        validity = svgs[TIME_OF_VALIDITY]
        found = observe_svgs(observation, validity, svgs, p, q, X_BS, placements, parameters)
        i = _sight(
            target, measurement, tracks, observation, found, p, parameters[_RADIUS],
            SVGS_SOURCE, taken, leader, t, x, P, parameters,
        )  # fmt: skip
        own = i >= 0 and (i == leader or leader < 0)
        target[_T_REJECTED] = 0.0 if own else target[_T_REJECTED] + 1.0

    if (
        sources & INFRARED_SOURCE
        and _arrived(infrared, memory, _IR_ARRIVAL)
        and _pose_at(memory, infrared[TIME_OF_VALIDITY], p, q)
    ):
        validity = infrared[TIME_OF_VALIDITY]
        fused = False
        for blob in range(min(int(infrared[_COUNT_BLOBS]), INFRARED_BLOBS)):
            bx, by = infrared[_BLOB + 3 * blob], infrared[_BLOB + 3 * blob + 1]
            found, sigma = _place_blob(
                tracks, validity, bx, by, estimate, p, q, X_BI, leader, observation, x, P,
                parameters,
            )  # fmt: skip
            if not math.isfinite(found[0]):
                continue
            i = _sight(
                target, measurement, tracks, observation, found, p, sigma,
                INFRARED_SOURCE, taken, leader, t, x, P, parameters,
            )  # fmt: skip
            if i >= 0:
                taken[i] = True
                fused |= i == leader or leader < 0
        target[_T_REJECTED] = 0.0 if fused else target[_T_REJECTED] + 1.0

    memory[_RANGE_POLLS] += 1.0
    if (
        memory[_RANGE_POLLS] >= _RANGE_EVERY
        and _arrived(ranging, memory, _RANGE_ARRIVAL)
        and _pose_at(memory, ranging[TIME_OF_VALIDITY], p, q)
    ):
        memory[_RANGE_POLLS] = 0.0
        _take_range(tracks, ranging, p, q, observation, x, P, parameters)

    if _arrived(gnss, memory, _GNSS_ARRIVAL) and _pose_at(memory, gnss[TIME_OF_VALIDITY], p, q):
        _keep_fix(memory, gnss, p, parameters)
    if _arrived(pad_gnss, memory, _PAD_GNSS_ARRIVAL) and _pose_at(
        memory, pad_gnss[TIME_OF_VALIDITY], p, q
    ):
        taken[:] = False
        _take_pad_gnss(tracks, memory, t, pad_gnss, p, taken, observation, x, P, parameters)

    _tidy(tracks, t, x, P, parameters)
    _write_target(target, hypotheses, tracks, t, memory, estimate, x, P, parameters, probability)
    if target[_ACQUIRED] == 0.0:
        measurement[VALID] = 0.0


@njit(cache=True)
def _tidy(tracks, t, x, P, parameters):
    """Forget hypotheses that say nothing any more or are long out of sight; merge equal ones."""
    count = tracks.shape[0]
    for i in range(count):
        if tracks[i, BORN] < 0.0:
            continue
        known = _known(tracks[i], t, x, P, parameters)
        slope = parameters[_FORGET_SLOPE] * (parameters[_HERE] - x[2])
        if max(P[0, 0], P[1, 1]) > max(parameters[_FORGET_RADIUS], slope) ** 2:
            tracks[i, BORN] = -1.0
            continue
        ix, iy = x[0], x[1]
        for j in range(count):
            if j == i or tracks[j, BORN] < 0.0 or not _known(tracks[j], t, x, P, parameters):
                continue
            if tracks[j, SEEN] - tracks[i, SEEN] > parameters[_FORGET]:
                tracks[i, BORN] = -1.0
                break
            near = math.hypot(ix - x[0], iy - x[1]) < _MERGE_DISTANCE
            if known and near and _evidence(tracks[i]) <= _evidence(tracks[j]):
                tracks[i, BORN] = -1.0
                break


@njit(cache=True)
def _write_target(target, hypotheses, tracks, t, memory, estimate, x, P, parameters, probability):
    leader = _probabilities(tracks, t, x, P, parameters, probability)
    target[_VALIDITY] = t
    target[_ACQUIRED] = 0.0
    hypotheses[:] = 0.0
    if leader < 0:
        return
    now = _RING + _POSE * (int(memory[_POLLS] - 1.0) % POSES)
    since = t - memory[now]
    target[_ACQUIRED] = 1.0 if _known(tracks[leader], t, x, P, parameters) else 0.0
    own = x[:3].copy()
    for i in range(3):
        v = memory[now + 8 + i]
        target[_T_P + i] = x[i] - memory[now + 1 + i] - since * v
        target[_T_V + i] = x[3 + i] - v
        target[_T_V_PAD + i] = x[3 + i]
        target[_T_P_VARIANCE + i] = P[i, i]
        target[_T_V_VARIANCE + i] = P[3 + i, 3 + i]
    target[_T_FUSED] = tracks[leader, FUSED]
    for j in range(tracks.shape[0]):
        if tracks[j, BORN] < 0.0:
            continue
        rank = 0
        for k in range(tracks.shape[0]):
            tie = probability[k] == probability[j] and k < j
            rank += k not in (j, leader) and (probability[k] > probability[j] or tie)
        start = 0 if j == leader else (rank + 1) * _PER_HYPOTHESIS
        track_filter.newest(tracks[j], t, x, P, _noise(tracks[j], parameters))
        hypotheses[start] = probability[j]
        for i in range(3):
            target[_T_P_VARIANCE + i] += probability[j] * (x[i] - own[i]) ** 2
            hypotheses[start + 1 + i] = x[i] - memory[now + 1 + i] + estimate[_E_P + i]
        hypotheses[start + 4] = _evidence(tracks[j])
        hypotheses[start + 5] = tracks[j, COUNT]

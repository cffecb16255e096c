"""From sensors to hypotheses, compiled; the equations are in `multi_hypothesis_target`."""

import math

import numpy as np
from numba import njit

from systems.estimators import multi_hypothesis_target_filter as track_filter
from systems.estimators.fused_sensor_kernel import INFRARED_SOURCE, MARKER_SOURCE
from systems.estimators.multi_hypothesis_target_filter import (
    BIAS_SIGMA,
    BORN,
    COUNT,
    FUSED,
    MARKERS,
    NOISE,
    OBSERVATION,
    PRIOR,
    SEEN,
    STATES,
    TIME,
)
from systems.frames import rotation_matrix
from systems.signals.measurement import (
    INFRARED,
    INFRARED_BLOBS,
    RANGE_FINDER,
    SEQUENCE_NUMBER,
    TARGET_ESTIMATE,
    TARGET_MEASUREMENT,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    VALID,
    VEHICLE_ESTIMATE,
    Layout,
)
from systems.vision.planar_pose import pad_position_from_marker

PARAMETERS = Layout(
    "MultiHypothesisTargetParameters",
    (
        # The process noise first, in the order of `multi_hypothesis_target_filter`
        "density_position",  # m2/s
        "density_horizontal",  # m2/s3
        "density_vertical",  # m2/s3
        "bias_sigma",  # rad
        "bias_time",  # s
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
        "marker_odds_limit",  # 1
        "confirmations",  # 1
        "lost_time",  # s
        "forget_time",  # s
        "range_finder_x",  # m, in B
        "range_finder_y",
        "range_finder_z",
    ),
)
POSES = 128  # polls that are remembered, 2 s
_POSE = 11  # time, p_WB, q_WB, v_WB
MEMORY = Layout(
    "MultiHypothesisTargetMemory",
    (
        "infrared_arrival",  # s, of the newest measurement taken
        "marker_arrival",
        "range_arrival",
        "polls",  # so far
        "range_polls",  # polls since a range was taken
        "horizontal_resets",  # counters of the navigation filter; -1 not yet seen
        "vertical_resets",
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
            "p_WP_x",  # m, in the navigation frame
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
_CONFIRM, _LOST, _FORGET = _i("confirmations"), _i("lost_time"), _i("forget_time")
_ARM = _i("range_finder_x")

(
    _IR_ARRIVAL,
    _MARKER_ARRIVAL,
    _RANGE_ARRIVAL,
    _POLLS,
    _RANGE_POLLS,
    _H_RESETS,
    _V_RESETS,
    _RING,
) = range(8)
_RANGE_EVERY = 4  # polls, so that ranges do not crowd the slots
_MERGE_DISTANCE = 0.25  # m, hypotheses closer than this are the same pad
_NEWBORN = 5  # measurements, with fewer a hypothesis may be replaced
_NEWBORN_TIME = 0.3  # s, after this without one
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
_E_H_COUNTER = VEHICLE_ESTIMATE.index("horizontal_reset_counter")
_E_H_RESET = VEHICLE_ESTIMATE.index("horizontal_reset_x")
_E_V_COUNTER = VEHICLE_ESTIMATE.index("vertical_reset_counter")
_E_V_RESET = VEHICLE_ESTIMATE.index("vertical_reset")
_RANGE = RANGE_FINDER.index("range")
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
def _remember_pose(memory, tracks, estimate):
    """Append the vehicle's pose; a reset of the navigation filter moves everything kept."""
    jump = np.zeros(3)
    if memory[_H_RESETS] >= 0.0 and estimate[_E_H_COUNTER] != memory[_H_RESETS]:
        jump[0], jump[1] = estimate[_E_H_RESET], estimate[_E_H_RESET + 1]
    if memory[_V_RESETS] >= 0.0 and estimate[_E_V_COUNTER] != memory[_V_RESETS]:
        jump[2] = estimate[_E_V_RESET]
    memory[_H_RESETS], memory[_V_RESETS] = estimate[_E_H_COUNTER], estimate[_E_V_COUNTER]
    polls = int(memory[_POLLS])
    if jump[0] != 0.0 or jump[1] != 0.0 or jump[2] != 0.0:
        for i in range(tracks.shape[0]):
            if tracks[i, BORN] >= 0.0:
                track_filter.shift(tracks[i], jump)
        for k in range(max(polls - POSES, 0), polls):
            start = _RING + _POSE * (k % POSES)
            for i in range(3):
                memory[start + 1 + i] += jump[i]
    start = _RING + _POSE * (polls % POSES)
    memory[start] = estimate[_E_T]
    memory[start + 1 : start + 4] = estimate[_E_P : _E_P + 3]
    memory[start + 4 : start + 8] = estimate[_E_Q : _E_Q + 4]
    memory[start + 8 : start + 11] = estimate[_E_V : _E_V + 3]
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
def observe_marker(observation, time, marker, p_WB, q_WB, X_BC, parameters):
    """Write a marker measurement: all of p, and the bearing's bias at its height.

    Returns p_BP_W and its covariance, shape (9,).
    """
    found = pad_position_from_marker(marker, q_WB, X_BC)
    height = -found[2]
    noise = parameters[_MARKER_NOISE] ** 2
    lateral = noise + (height * parameters[_ATTITUDE]) ** 2
    found[3] += lateral
    found[5] += lateral
    found[8] += noise
    H = np.zeros((3, 5))
    values = np.empty(3)
    for i in range(3):
        H[i, i] = 1.0
        values[i] = p_WB[i] + found[i]
    H[0, 3] = H[1, 4] = height
    R = np.array(
        [
            [found[3], found[4], found[6]],
            [found[4], found[5], found[7]],
            [found[6], found[7], found[8]],
        ]
    )
    track_filter.whiten(observation, time, H, values, R, 3)
    return found


@njit(cache=True)
def observe_blob(observation, time, x, y, height, p_WB, q_WB, X_BC, parameters):
    """Write the direction of one blob, a lamp `height` (m) below the body: two rows.

        0 = (p − p_WC)_i − d_i/d_z (p − p_WC)_z + height b_i,   i = x, y,   d = R_WC (x, y, 1)

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
    H = np.zeros((3, 5))
    values = np.zeros(3)
    J = np.empty((2, 2))
    for i in range(2):
        slope = d[i] / d[2]
        H[i, i] = 1.0
        H[i, 2] = -slope
        H[i, 3 + i] = height
        values[i] = p_WB[i] + arm[i] - slope * (p_WB[2] + arm[2])
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
def observe_range(observation, time, ranging, p_WB, q_WB, off_pad, parameters):
    """Write a range: p_z, where the beam meets the pad or the ground around it."""
    R_WB = rotation_matrix(q_WB)
    arm = R_WB[2, 0] * parameters[_ARM] + R_WB[2, 1] * parameters[_ARM + 1]
    height = R_WB[2, 2] * (ranging[_RANGE] - parameters[_ARM + 2]) - arm
    noise = parameters[_RANGE_NOISE] ** 2
    if off_pad:
        noise += parameters[_GROUND_NOISE] ** 2
    H = np.zeros((3, 5))
    H[0, 2] = 1.0
    values = np.zeros(3)
    values[0] = p_WB[2] - height
    R = np.zeros((3, 3))
    R[0, 0] = noise
    track_filter.whiten(observation, time, H, values, R, 1)


@njit(cache=True)
def _squared_innovation(track, observation, x, P, noise):
    """Normalised innovation squared and log-determinant of a measurement at its own time."""
    if not track_filter.prior(track, observation[TIME], x, P, noise):
        return math.inf, 0.0
    return track_filter.fuse(x, P, observation)


@njit(cache=True)
def _associate(tracks, observation, gate, taken, x, P, noise):
    """The likeliest track (in use, not yet `taken`) of a measurement, and its NIS; -1 if none.

    Likeliest, not nearest: a track that has just begun is so uncertain that it is near everything.
    """
    best, best_squared, least = -1, 0.0, math.inf
    for i in range(tracks.shape[0]):
        if tracks[i, BORN] < 0.0 or taken[i]:
            continue
        squared, spread = _squared_innovation(tracks[i], observation, x, P, noise)
        if squared <= gate and squared + spread < least:
            best, best_squared, least = i, squared, squared + spread
    return best, best_squared


@njit(cache=True)
def _free_track(tracks):
    """A track that is not in use; -1 if there is none."""
    for i in range(tracks.shape[0]):
        if tracks[i, BORN] < 0.0:
            return i
    return -1


@njit(cache=True)
def _begin(tracks, time, found, p_WB, height_sigma, parameters, noise, x, P):
    """Begin a hypothesis around a measured p_BP_W; returns its number, -1 if there is no room."""
    i = _free_track(tracks)
    if i < 0:
        return -1
    others = False
    for j in range(tracks.shape[0]):
        others |= j != i and tracks[j, BORN] >= 0.0 and tracks[j, COUNT] >= _NEWBORN
    P[:] = 0.0
    x[:] = 0.0
    for k in range(3):
        x[k] = p_WB[k] + found[k]
        P[k, k] = parameters[_RADIUS] ** 2
        P[3 + k, 3 + k] = parameters[_SPEED] ** 2
    P[2, 2] = height_sigma * height_sigma
    P[6, 6] = P[7, 7] = noise[BIAS_SIGMA] ** 2
    track_filter.begin(tracks[i], time, x, P)
    tracks[i, PRIOR] = parameters[_LATE] if others else 0.0
    return i


@njit(cache=True)
def _take(track, observation, t, x, P, noise):
    """Fuse a camera's measurement into a track at time t."""
    track_filter.insert(track, observation, x, P, noise)
    track[FUSED] = max(track[FUSED], observation[TIME])
    track[SEEN] = t
    track[COUNT] += 1.0


@njit(cache=True)
def _evidence(track, parameters):
    """The log of the odds of a hypothesis."""
    return track[PRIOR] + parameters[_MARKER_ODDS] * track[MARKERS]


@njit(cache=True)
def _credit(tracks, i, time, parameters):
    """The marker was seen on track i, so not on those that nothing is seen of."""
    most = parameters[_ODDS_LIMIT] / parameters[_MARKER_ODDS]
    tracks[i, MARKERS] = min(tracks[i, MARKERS] + 1.0, most)
    for j in range(tracks.shape[0]):
        if j != i and time - tracks[j, FUSED] > _UNSEEN:
            tracks[j, MARKERS] = max(tracks[j, MARKERS] - 1.0, 0.0)


@njit(cache=True)
def _probabilities(tracks, parameters, probability):
    """Write each track's probability, the odds normalised; the most probable one or -1."""
    best = -1
    highest = -math.inf
    for i in range(tracks.shape[0]):
        if tracks[i, BORN] >= 0.0 and _evidence(tracks[i], parameters) > highest:
            best, highest = i, _evidence(tracks[i], parameters)
    total = 0.0
    for i in range(tracks.shape[0]):
        probability[i] = 0.0
        if tracks[i, BORN] >= 0.0:
            probability[i] = math.exp(_evidence(tracks[i], parameters) - highest)
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
def poll(
    target,
    measurement,
    hypotheses,
    memory,
    tracks,
    t,
    infrared,
    marker,
    ranging,
    estimate,
    parameters,
    X_BI,
    X_BM,
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
    infrared, marker, ranging, estimate : arrays
        Of the layouts INFRARED, MARKER, RANGE_FINDER and VEHICLE_ESTIMATE.
    parameters : array of shape (PARAMETERS.size,)
    X_BI, X_BM : arrays of shape (3, 4)
        Mounts of the infrared and of the marker camera.
    """
    noise = parameters[:NOISE]
    if estimate[_E_ATTITUDE_VALID] > 0.0 and estimate[_E_H_VALID] > 0.0:
        _remember_pose(memory, tracks, estimate)
    if memory[_POLLS] == 0.0:
        return
    x = np.empty(STATES)
    P = np.empty((STATES, STATES))
    p, q = np.empty(3), np.empty(4)
    observation = np.zeros(OBSERVATION)
    taken = np.zeros(tracks.shape[0], np.bool_)
    probability = np.empty(tracks.shape[0])
    leader = _probabilities(tracks, parameters, probability)
    sources = int(parameters[_SOURCES])

    if (
        sources & MARKER_SOURCE
        and marker[VALID] > 0.0
        and marker[TIME_OF_ARRIVAL] != memory[_MARKER_ARRIVAL]
    ):
        memory[_MARKER_ARRIVAL] = marker[TIME_OF_ARRIVAL]
        validity = marker[TIME_OF_VALIDITY]
        if _pose_at(memory, validity, p, q):
            found = observe_marker(observation, validity, marker, p, q, X_BM, parameters)
            gate = parameters[_GATE_3]
            i, squared = _associate(tracks, observation, gate, taken, x, P, noise)
            if i < 0:
                sigma = parameters[_RADIUS]
                i = _begin(tracks, validity, found, p, sigma, parameters, noise, x, P)
                squared = 0.0
            if i >= 0:
                _take(tracks[i], observation, t, x, P, noise)
                _credit(tracks, i, validity, parameters)
            if i == leader or leader < 0:
                target[_T_RATIO] = squared / gate
                target[_T_REJECTED] = 0.0
                target[_T_SOURCE] = MARKER_SOURCE
                _write_measurement(measurement, t, validity, found, MARKER_SOURCE)
            else:
                target[_T_REJECTED] += 1.0

    if (
        sources & INFRARED_SOURCE
        and infrared[VALID] > 0.0
        and infrared[TIME_OF_ARRIVAL] != memory[_IR_ARRIVAL]
    ):
        memory[_IR_ARRIVAL] = infrared[TIME_OF_ARRIVAL]
        validity = infrared[TIME_OF_VALIDITY]
        if _pose_at(memory, validity, p, q):
            fused = False
            for blob in range(min(int(infrared[_COUNT_BLOBS]), INFRARED_BLOBS)):
                bx, by = infrared[_BLOB + 3 * blob], infrared[_BLOB + 3 * blob + 1]
                height, height_sigma = math.nan, parameters[_GROUND_NOISE]
                if leader >= 0:
                    track_filter.prior(tracks[leader], validity, x, P, noise)
                    height = p[2] - x[2]
                    height_sigma = max(height_sigma, math.sqrt(P[2, 2]))
                elif estimate[_E_HEIGHT_VALID] > 0.0:
                    height = estimate[_E_HEIGHT]
                if not math.isfinite(height):
                    continue
                if height < 1.0 and max(abs(bx), abs(by)) > _EDGE:
                    continue
                found = observe_blob(observation, validity, bx, by, height, p, q, X_BI, parameters)
                if not math.isfinite(found[0]):
                    continue
                gate = parameters[_GATE_2]
                i, squared = _associate(tracks, observation, gate, taken, x, P, noise)
                if i < 0:
                    i = _begin(tracks, validity, found, p, height_sigma, parameters, noise, x, P)
                    squared = 0.0
                if i < 0:
                    continue
                taken[i] = True
                _take(tracks[i], observation, t, x, P, noise)
                if i == leader or leader < 0:
                    fused = True
                    target[_T_RATIO] = squared / gate
                    target[_T_SOURCE] = INFRARED_SOURCE
                    _write_measurement(measurement, t, validity, found, INFRARED_SOURCE)
            target[_T_REJECTED] = 0.0 if fused else target[_T_REJECTED] + 1.0

    memory[_RANGE_POLLS] += 1.0
    if (
        memory[_RANGE_POLLS] >= _RANGE_EVERY
        and ranging[VALID] > 0.0
        and ranging[TIME_OF_ARRIVAL] != memory[_RANGE_ARRIVAL]
        and _pose_at(memory, ranging[TIME_OF_VALIDITY], p, q)
    ):
        memory[_RANGE_ARRIVAL] = ranging[TIME_OF_ARRIVAL]
        memory[_RANGE_POLLS] = 0.0
        for i in range(tracks.shape[0]):
            if tracks[i, BORN] < 0.0:
                continue
            track_filter.prior(tracks[i], ranging[TIME_OF_VALIDITY], x, P, noise)
            R_WB = rotation_matrix(q)
            reach = ranging[_RANGE]
            off = math.hypot(p[0] - reach * R_WB[0, 2] - x[0], p[1] - reach * R_WB[1, 2] - x[1])
            off_pad = off > parameters[_PAD_RADIUS]
            validity = ranging[TIME_OF_VALIDITY]
            observe_range(observation, validity, ranging, p, q, off_pad, parameters)
            squared, _ = _squared_innovation(tracks[i], observation, x, P, noise)
            if squared <= parameters[_GATE_2]:
                # A range is no sighting: it does not count.
                track_filter.insert(tracks[i], observation, x, P, noise)

    _tidy(tracks, t, parameters, noise, x, P)
    _write_target(target, hypotheses, tracks, t, estimate, parameters, noise, x, P, probability)
    if t - measurement[TIME_OF_ARRIVAL] > parameters[_LOST]:
        measurement[VALID] = 0.0


@njit(cache=True)
def _tidy(tracks, t, parameters, noise, x, P):
    """Forget hypotheses that are not seen any more beside one that is, and merge equal ones."""
    count = tracks.shape[0]
    seen = False
    for i in range(count):
        seen |= tracks[i, BORN] >= 0.0 and t - tracks[i, SEEN] <= parameters[_LOST]
    for i in range(count):
        unseen = t - tracks[i, SEEN]
        vain = tracks[i, COUNT] < _NEWBORN and unseen > _NEWBORN_TIME
        if tracks[i, BORN] >= 0.0 and (vain or (seen and unseen > parameters[_FORGET])):
            tracks[i, BORN] = -1.0
    for i in range(count):
        for j in range(i):
            if tracks[i, BORN] < 0.0 or tracks[j, BORN] < 0.0:
                continue
            if min(tracks[i, COUNT], tracks[j, COUNT]) < _NEWBORN:
                continue
            track_filter.newest(tracks[i], t, x, P, noise)
            ax, ay = x[0], x[1]
            track_filter.newest(tracks[j], t, x, P, noise)
            if math.hypot(ax - x[0], ay - x[1]) < _MERGE_DISTANCE:
                weaker = _evidence(tracks[i], parameters) <= _evidence(tracks[j], parameters)
                loser = i if weaker else j
                tracks[loser, BORN] = -1.0


@njit(cache=True)
def _write_target(target, hypotheses, tracks, t, estimate, parameters, noise, x, P, probability):
    leader = _probabilities(tracks, parameters, probability)
    target[_VALIDITY] = t
    hypotheses[:] = 0.0
    if leader < 0:
        target[_ACQUIRED] = 0.0
        return
    since = t - estimate[_E_T]
    track_filter.newest(tracks[leader], t, x, P, noise)
    own = x[:3].copy()
    for i in range(3):
        v = estimate[_E_V + i]
        target[_T_P + i] = x[i] - estimate[_E_P + i] - since * v
        target[_T_V + i] = x[3 + i] - v
        target[_T_V_PAD + i] = x[3 + i]
        target[_T_P_VARIANCE + i] = P[i, i]
        target[_T_V_VARIANCE + i] = P[3 + i, 3 + i]
    for j in range(tracks.shape[0]):
        if tracks[j, BORN] < 0.0:
            continue
        start = 0
        if j != leader:
            rank = 1
            for k in range(tracks.shape[0]):
                tie = probability[k] == probability[j] and k < j
                rank += k not in (j, leader) and (probability[k] > probability[j] or tie)
            start = rank * _PER_HYPOTHESIS
            track_filter.newest(tracks[j], t, x, P, noise)
            for i in range(3):
                target[_T_P_VARIANCE + i] += probability[j] * (x[i] - own[i]) ** 2
        hypotheses[start] = probability[j]
        hypotheses[start + 1 : start + 4] = own if j == leader else x[:3]
        hypotheses[start + 4] = _evidence(tracks[j], parameters)
        hypotheses[start + 5] = tracks[j, COUNT]
    target[_T_FUSED] = tracks[leader, FUSED]
    fresh = t - tracks[leader, FUSED] <= parameters[_LOST]
    confirmed = tracks[leader, COUNT] >= parameters[_CONFIRM]
    target[_ACQUIRED] = 1.0 if fresh and confirmed else 0.0

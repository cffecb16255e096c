"""Which four blobs are the beacon: SVGS as published, and a variant that does not guess.

Published ("High-altitude precision landing by SVGS", Drones 8, 37, 2024, section 2.1.2): among
the blobs of one colour the four whose ratio of mass to area has the least standard deviation
(Algorithm 1, all C(n, 4) combinations, n bounded), a check of the ratios of their distances
against those expected, and the pose linearised about the last one. Nothing tells it that it
took a wrong blob.

Robust: two of the blobs, taken for the two LEDs on the beacon's y axis, and the direction of
gravity give the whole pose (`svgs_pose.level_pose`); the other two LEDs must be where this says.
Among the sets of four that pass, each is solved, and kept if

    its residual is within the gate,
    the beacon stands upright within the noise of the pose and of gravity, and
    height and heading agree with the track, once there is one.

Two different sets that fit about equally well are no answer. A track begins with two poses in
successive frames that agree; until then there is no answer either.
"""

import math

import numpy as np
from numba import njit

from systems.signals.measurement import VALID, Layout
from systems.vision.pinhole import FX, tangents_of_pixel
from systems.vision.svgs_blobs import (
    BLOB_AREA,
    BLOB_COLOUR,
    BLOB_MASS,
    BLOB_U,
    BLOB_V,
    MAXIMUM_BLOBS,
)
from systems.vision.svgs_pose import (
    ANGLES,
    LED_COUNT,
    angles_of_pixels,
    level_frame,
    level_pose,
    predict,
    solve_pose,
    up_of_pose,
)

PUBLISHED, ROBUST = range(2)
VARIANTS = ("published", "robust")

(
    POSE,
    NO_BLOBS,
    TOO_FEW_BLOBS,
    TOO_MANY_BLOBS,
    BAD_GEOMETRY,
    NOT_SOLVED,
    AMBIGUOUS,
    UNCONFIRMED,
) = range(8)
ERRORS = {
    POSE: "a pose",
    NO_BLOBS: "no blobs",
    TOO_FEW_BLOBS: "fewer than four blobs of any beacon's colour",
    TOO_MANY_BLOBS: "more blobs of one colour than permutations are allocated for",
    BAD_GEOMETRY: "no four blobs look like a beacon",
    NOT_SOLVED: "the least squares did not converge",
    AMBIGUOUS: "two different sets of blobs look like the beacon",
    UNCONFIRMED: "a first pose, not confirmed by the next frame yet",
}

# What the robust variant remembers from frame to frame.
TRACK = Layout(
    "SvgsTrack",
    (
        "confirmations",  # poses in agreement so far; 0: there is no track
        "time",  # s, of the last pose
        "height",  # m, of the camera over the beacons' ground
        "height_sigma",  # m
        "yaw",  # rad, of P in the camera's level frame
    ),
)
_CONFIRMATIONS, _TIME, _HEIGHT, _HEIGHT_SIGMA, _TRACK_YAW = range(5)

# The options of `select`.
(
    VARIANT,
    PIXEL_NOISE,  # px, one sigma of a centroid, for the covariance
    GATE,  # px, largest residual (rms)
    GRAVITY_NOISE,  # rad, one sigma of the direction of gravity
    PUBLISHED_BOUND,  # blobs of a colour
    PUBLISHED_TOLERANCE,  # largest deviation of a ratio of distances
) = range(6)
OPTIONS = 6

_GATING_NOISE = 0.1  # px, centroid noise assumed in the gates
_SIGMAS = 4.0  # of the gates
_CONFIRMED = 2  # poses in agreement
_TRACK_LIFETIME = 3.0  # s without a pose
_TRACK_SPEED = 4.0  # m/s, largest change of height
_TRACK_SCALE = 0.01  # of the height, for lens and attitude
_TRACK_TURN = 0.6  # rad/s, largest change of heading
_TRACK_YAW_ERROR = 0.1  # rad
_MATCH, _MATCH_SPAN = 4.0, 0.04  # px and part of the span: where the other LEDs may be
_RIVAL = 9.0  # χ² by which a set must be better than any other
_LOWEST, _HIGHEST = 0.2, 260.0  # m
_STEEPEST = 0.2  # cosine of the tilt beyond which a ray is not followed to the ground
_DISTANCES = LED_COUNT * (LED_COUNT - 1) // 2

# Indices of the layout SVGS as the compiled functions read them; a test holds them to it.
_BEACON, _ERROR, _BLOBS, _P, _Q, _COVARIANCE, _REPROJECTION, _LED = 4, 5, 6, 7, 10, 14, 35, 36


# -- published


@njit(cache=True)
def least_deviation(ratios, chosen):
    """Algorithm 1: the four of n ratios (n,) with the least standard deviation.

    All C(n, 4) combinations are looked at; `chosen` (4,) is overwritten with their indices.
    Returns the variance.
    """
    n = ratios.size
    best = math.inf
    for i in range(n):
        for j in range(i + 1, n):
            for k in range(j + 1, n):
                for m in range(k + 1, n):
                    a, b, c, d = ratios[i], ratios[j], ratios[k], ratios[m]
                    mean = 0.25 * (a + b + c + d)
                    deviation = (a - mean) ** 2 + (b - mean) ** 2
                    deviation += (c - mean) ** 2 + (d - mean) ** 2
                    if deviation < best:
                        best = deviation
                        chosen[0], chosen[1], chosen[2], chosen[3] = i, j, k, m
    return 0.25 * best


@njit(cache=True)
def _distance_ratios(points, ratios):
    """The six distances of four points (4, 2), as parts of their sum, into `ratios` (6,)."""
    total, k = 0.0, 0
    for i in range(LED_COUNT):
        for j in range(i + 1, LED_COUNT):
            ratios[k] = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            total += ratios[k]
            k += 1
    ratios /= max(total, 1e-12)


@njit(cache=True)
def _handedness(points):
    """Twice the signed area of the triangle of points 0, 1 and 3."""
    ax, ay = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1]
    bx, by = points[3, 0] - points[0, 0], points[3, 1] - points[0, 1]
    return ax * by - ay * bx


@njit(cache=True)
def assign_by_geometry(points, expected, assigned):
    """Which point is which LED: the permutation whose ratios of distances are as expected.

    Parameters
    ----------
    points : array of shape (4, 2)
        Centroids.
    expected : array of shape (4, 2)
        Where the LEDs would be, up to shift, turn and scale.
    assigned : array of int, shape (4,)
        Overwritten: the number of the point of each LED.

    Returns
    -------
    float
        The largest deviation of a ratio, over the largest ratio; infinite if there is no
        permutation with the right handedness.
    """
    wanted, ratios = np.empty(_DISTANCES), np.empty(_DISTANCES)
    _distance_ratios(expected, wanted)
    side = _handedness(expected)
    trial = np.empty((LED_COUNT, 2))
    best = math.inf
    for a in range(4):
        for b in range(4):
            for c in range(4):
                d = 6 - a - b - c
                if a in (b, c) or b == c or d < 0 or d > 3 or d in (a, b, c):
                    continue
                trial[0], trial[1], trial[2], trial[3] = points[a], points[b], points[c], points[d]
                if _handedness(trial) * side <= 0.0:
                    continue
                _distance_ratios(trial, ratios)
                deviation = np.max(np.abs(ratios - wanted)) / np.max(wanted)
                if deviation < best:
                    best = deviation
                    assigned[0], assigned[1], assigned[2], assigned[3] = a, b, c, d
    return best


@njit(cache=True)
def _select_published(points, ratios, leds, last, has_last, camera, options, pose, covariance):
    """Algorithm 1, geometric check, least squares; returns (error code, residual, LEDs' points)."""
    n = points.shape[0]
    used = np.zeros((LED_COUNT, 2))
    if n > options[PUBLISHED_BOUND]:
        return TOO_MANY_BLOBS, 0.0, used
    chosen = np.zeros(LED_COUNT, np.int64)
    least_deviation(ratios, chosen)
    # About the last pose or, at the first time, straight below with the camera's own attitude
    level = level_frame(np.array([0.0, 0.0, -1.0]))
    if has_last:
        pose[:] = last
    else:
        level_pose(leds, level, 0, 1, np.array([0.0, 0.0]), np.array([0.1, 0.0]), pose)
    angles, J = np.empty(ANGLES), np.empty((ANGLES, 6))
    if not predict(leds, pose, angles, J):
        return NOT_SOLVED, 0.0, used
    expected = np.ascontiguousarray(angles).reshape(LED_COUNT, 2)
    four = points[chosen]
    assigned = np.zeros(LED_COUNT, np.int64)
    if assign_by_geometry(four, expected, assigned) > options[PUBLISHED_TOLERANCE]:
        return BAD_GEOMETRY, 0.0, used
    for k in range(LED_COUNT):
        used[k] = four[assigned[k]]
    if not has_last:
        n_a, n_b = np.empty(2), np.empty(2)
        _ground_tangents(camera, level, used[0], n_a)
        _ground_tangents(camera, level, used[1], n_b)
        level_pose(leds, level, 0, 1, n_a, n_b, pose)
    angles_of_pixels(camera, used, angles)
    residual = solve_pose(leds, angles, pose, covariance)
    if not residual < math.inf:
        return NOT_SOLVED, 0.0, used
    return POSE, residual * camera[FX], used


# -- robust


@njit(cache=True)
def _ground_tangents(camera, level, pixel, n):
    """Where the ray of a pixel cuts the level plane at unit depth below the camera, into n (2,)."""
    x, y = tangents_of_pixel(camera, pixel[0], pixel[1])
    d0 = level[0, 0] * x + level[0, 1] * y + level[0, 2]
    d1 = level[1, 0] * x + level[1, 1] * y + level[1, 2]
    d2 = level[2, 0] * x + level[2, 1] * y + level[2, 2]
    if d2 > -_STEEPEST:
        return False
    n[0], n[1] = -d0 / d2, -d1 / d2
    return True


@njit(cache=True)
def _wrapped(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


@njit(cache=True)
def yaw_in_level(pose, level):
    """The heading of T's x axis in the level frame L, rad."""
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    ax, ay, az = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    return math.atan2(
        level[1, 0] * ax + level[1, 1] * ay + level[1, 2] * az,
        level[0, 0] * ax + level[0, 1] * ay + level[0, 2] * az,
    )


@njit(cache=True)
def _select_robust(
    points, leds, level, camera, low, high, yaw, yaw_width, options, pose, covariance
):
    """The one set of four points that is the beacon.

    Returns (error code, residual in px, LEDs' points (4, 2), height over the beacon's ground).
    """
    n = points.shape[0]
    f = camera[FX]
    ground = np.empty((n, 2))
    usable = np.empty(n, np.bool_)
    for i in range(n):
        usable[i] = _ground_tangents(camera, level, points[i], ground[i])
    best, rival = math.inf, math.inf
    best_height, best_residual = 0.0, 0.0
    used, trial_points = np.zeros((LED_COUNT, 2)), np.empty((LED_COUNT, 2))
    best_set = np.full(LED_COUNT, -1)
    trial, trial_covariance = np.empty(7), np.empty((6, 6))
    angles = np.empty(ANGLES)
    for a in range(n):
        for b in range(n):
            if a == b or not usable[a] or not usable[b]:
                continue
            span = math.hypot(ground[b, 0] - ground[a, 0], ground[b, 1] - ground[a, 1])
            length = math.hypot(leds[1, 0] - leds[0, 0], leds[1, 1] - leds[0, 1])
            depth = length / max(span, 1e-9)
            slack = 1.0 + _MATCH / max(span * f, _MATCH)
            if depth > high * slack or depth * slack < low:
                continue
            turn = math.atan2(ground[b, 1] - ground[a, 1], ground[b, 0] - ground[a, 0])
            turn -= math.atan2(leds[1, 1] - leds[0, 1], leds[1, 0] - leds[0, 0])
            if abs(_wrapped(turn - yaw)) > yaw_width + 2.0 / max(span * f, 1.0):
                continue
            c, s = math.cos(turn), math.sin(turn)
            near = (_MATCH + _MATCH_SPAN * span * f) / f
            for third in range(n):
                if third in (a, b) or not usable[third]:
                    continue
                if not _is_near(leds, 0, 2, ground[a], depth, c, s, ground[third], near):
                    continue
                for fourth in range(n):
                    if fourth in (a, b, third) or not usable[fourth]:
                        continue
                    if not _is_near(leds, 0, 3, ground[a], depth, c, s, ground[fourth], near):
                        continue
                    trial_points[0], trial_points[1] = points[a], points[b]
                    trial_points[2], trial_points[3] = points[third], points[fourth]
                    level_pose(leds, level, 0, 1, ground[a], ground[b], trial)
                    angles_of_pixels(camera, trial_points, angles)
                    residual = f * solve_pose(leds, angles, trial, trial_covariance)
                    if not residual < options[GATE]:
                        continue
                    height = -(
                        level[2, 0] * trial[0] + level[2, 1] * trial[1] + level[2, 2] * trial[2]
                    )
                    if not low < height < high:
                        continue
                    if abs(_wrapped(yaw_in_level(trial, level) - yaw)) > yaw_width:
                        continue
                    variance = (_GATING_NOISE / f) ** 2
                    up = up_of_pose(trial)
                    # Tilt about L's x and y axes
                    tilt2 = 0.0
                    for k in range(2):
                        other = 1 - k
                        sine = (
                            level[other, 0] * up[0] + level[other, 1] * up[1]
                            + level[other, 2] * up[2]
                        )  # fmt: skip
                        own = 0.0
                        for i in range(3):
                            for j in range(3):
                                own += level[k, i] * trial_covariance[3 + i, 3 + j] * level[k, j]
                        tilt2 += sine * sine / (own * variance + options[GRAVITY_NOISE] ** 2)
                    if tilt2 > _SIGMAS * _SIGMAS:
                        continue
                    cost = ANGLES * (residual / _GATING_NOISE) ** 2 + tilt2
                    same = (
                        best_set[0] == a
                        and best_set[1] == b
                        and best_set[2] == third
                        and best_set[3] == fourth
                    )
                    if cost < best:
                        if not same:
                            rival = best
                        best = cost
                        best_height, best_residual = height, residual
                        pose[:] = trial
                        covariance[:] = trial_covariance
                        used[:] = trial_points
                        best_set[0], best_set[1], best_set[2], best_set[3] = a, b, third, fourth
                    elif not same:
                        rival = min(rival, cost)
    if best == math.inf:
        return BAD_GEOMETRY, 0.0, used, 0.0
    if rival - best < _RIVAL:
        return AMBIGUOUS, 0.0, used, 0.0
    return POSE, best_residual, used, best_height


@njit(cache=True)
def _is_near(leds, first, other, n_first, depth, c, s, n, near):
    """Whether LED `other` of a level beacon with LED `first` at n_first would be seen at n."""
    dx, dy = leds[other, 0] - leds[first, 0], leds[other, 1] - leds[first, 1]
    rise = leds[other, 2] - leds[first, 2]
    if depth - rise < 0.1:
        return False
    x = (n_first[0] * depth + c * dx - s * dy) / (depth - rise)
    y = (n_first[1] * depth + s * dx + c * dy) / (depth - rise)
    return math.hypot(n[0] - x, n[1] - y) < near


# -- both


@njit(cache=True)
def select(
    blobs, count, leds, placements, camera, up, time, frame, options, last, track, measurement
):
    """Find a beacon among the blobs of a frame and write its pose into an SVGS measurement.

    Parameters
    ----------
    blobs : array of shape (MAXIMUM_BLOBS, BLOB_SIZE)
    count : int
        Number of blobs.
    leds : array of shape (3, 4, 3)
        The LEDs of each beacon in its frame T, m.
    placements : array of shape (3, 4)
        Where the beacons stand: x, y, z in P (m), yaw (rad).
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    up : array of shape (3,)
        The direction against gravity in C, as the host's own sensors say; robust variant only.
    time : float
        s, of the frame.
    frame : int
        Its number. The published variant begins with the beacon number `frame` modulo 3, since
        nothing tells it which one to take.
    options : array of shape (OPTIONS,)
    last : array of shape (3, 8)
        For each beacon its last pose and whether there is one; the published variant's memory.
    track : array of the layout TRACK
        The robust variant's memory.
    measurement : array of the layout SVGS
        Overwritten but for its times and sequence number.
    """
    measurement[VALID] = 0.0
    measurement[_BEACON] = -1.0
    measurement[_BLOBS] = count
    measurement[_P:] = 0.0
    measurement[_Q] = 1.0
    if count == 0:
        measurement[_ERROR] = NO_BLOBS
        return
    robust = options[VARIANT] == ROBUST
    f = camera[FX]
    error = TOO_FEW_BLOBS
    level = level_frame(up)
    tracking = track[_CONFIRMATIONS] > 0.0 and time - track[_TIME] <= _TRACK_LIFETIME
    if not tracking:
        track[_CONFIRMATIONS] = 0.0
    age = max(time - track[_TIME], 0.0)
    best_sigma, best_height, best_height_sigma, best_yaw = math.inf, 0.0, 0.0, 0.0
    pose, covariance = np.empty(7), np.empty((6, 6))
    points, ratios = np.empty((MAXIMUM_BLOBS, 2)), np.empty(MAXIMUM_BLOBS)
    for turn in range(leds.shape[0]):
        beacon = (frame + turn) % leds.shape[0]
        n = 0
        for i in range(count):
            if blobs[i, BLOB_COLOUR] == beacon:
                points[n, 0], points[n, 1] = blobs[i, BLOB_U], blobs[i, BLOB_V]
                ratios[n] = blobs[i, BLOB_MASS] / blobs[i, BLOB_AREA]
                n += 1
        if n < LED_COUNT:
            continue
        if not robust:
            code, residual, used = _select_published(
                points[:n], ratios[:n], leds[beacon], last[beacon, :7], last[beacon, 7] > 0.0,
                camera, options, pose, covariance,
            )  # fmt: skip
            if code != POSE:
                error = code
                continue
            last[beacon, :7] = pose
            last[beacon, 7] = 1.0
            _write(beacon, pose, covariance, options, f, residual, used, measurement)
            return
        low, high, yaw, width = _LOWEST, _HIGHEST, 0.0, 2.0 * math.pi
        if tracking:
            sigma = _SIGMAS * track[_HEIGHT_SIGMA] + _TRACK_SPEED * age
            sigma += _TRACK_SCALE * track[_HEIGHT]
            ground = track[_HEIGHT] - placements[beacon, 2]
            low, high = max(low, ground - 2.0 * sigma), ground + 2.0 * sigma
            yaw = track[_TRACK_YAW] + placements[beacon, 3]
            width = _TRACK_YAW_ERROR + _TRACK_TURN * age
            if leds[beacon, 0, 1] / ground * f < 30.0:
                width += 1.0 / max(leds[beacon, 0, 1] / ground * f, 1.0)
        code, residual, used, height = _select_robust(
            points[:n], leds[beacon], level, camera, low, high, yaw, width, options, pose,
            covariance,
        )  # fmt: skip
        if code != POSE:
            if measurement[VALID] == 0.0 and best_sigma == math.inf:
                error = code
            continue
        variance = (_GATING_NOISE / f) ** 2
        trace = math.sqrt((covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) * variance)
        if trace < best_sigma:
            best_sigma = trace
            best_height = height + placements[beacon, 2]
            best_height_sigma = math.sqrt(max(covariance[2, 2] * variance, 1e-8))
            best_yaw = _wrapped(yaw_in_level(pose, level) - placements[beacon, 3])
            _write(beacon, pose, covariance, options, f, residual, used, measurement)
    if best_sigma < math.inf:
        error = POSE
        track[_CONFIRMATIONS] += 1.0
        track[_TIME] = time
        track[_HEIGHT], track[_HEIGHT_SIGMA] = best_height, best_height_sigma
        track[_TRACK_YAW] = best_yaw
        if track[_CONFIRMATIONS] < _CONFIRMED:
            error = UNCONFIRMED
            measurement[VALID] = 0.0
    elif track[_CONFIRMATIONS] < _CONFIRMED:
        track[_CONFIRMATIONS] = 0.0
    measurement[_ERROR] = error


@njit(cache=True)
def _write(beacon, pose, covariance, options, f, residual, used, measurement):
    measurement[VALID] = 1.0
    measurement[_BEACON] = beacon
    measurement[_ERROR] = POSE
    measurement[_P : _P + 7] = pose
    variance = (options[PIXEL_NOISE] / f) ** 2
    k = _COVARIANCE
    for i in range(6):
        for j in range(i, 6):
            measurement[k] = variance * covariance[i, j]
            k += 1
    measurement[_REPROJECTION] = residual
    for i in range(LED_COUNT):
        measurement[_LED + 2 * i] = used[i, 0]
        measurement[_LED + 2 * i + 1] = used[i, 1]

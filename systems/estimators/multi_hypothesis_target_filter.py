"""One hypothesis of where the pad is: a Kalman filter that takes measurements in any order.

Compiled; the equations are in `multi_hypothesis_target`. A track is a flat vector: its header, then
up to `SLOTS` slots in order of time, each a measurement with the estimate after it. A
measurement that comes late is put in its place, and the slots behind it are filtered anew, so the
answer is that of a filter that was given everything in order. Of what falls out of the slots some
estimates are kept, with the covariance of their errors and those of the oldest slot, so that an
even older measurement can still be fused there.

A measurement is at most three rows that are linear in the state, whitened:
value = h · x + N(0, 1). It may say that the pad's velocity has changed at
once some time before: a kick.
"""

import math

import numpy as np
from numba import njit

STATES = 8  # p (m), v (m/s) by odometry; b (rad)
_PACKED = STATES * (STATES + 1) // 2
ROW = STATES + 1  # coefficients, value
ROWS = 3

# The header of a track.
(
    BORN,  # s, when it began; -1 the track is not in use
    PRIOR,  # log of the odds at its beginning
    CODE,  # log of the odds that the marker's code has added
    FUSED,  # s, validity of the newest camera measurement fused
    SEEN,  # s, when the last one was fused
    COUNT,  # camera measurements fused
    MOVES,  # 0/1, the pad itself moves
    USED,  # slots in use
) = range(8)
HEADER = 8

# A slot.
TIME, ROW_COUNT = 0, 1  # s; 1
KICK, SINCE = 2, 3  # (m/s)2, variance of a change of the horizontal velocity; s, so long before
_FIRST_ROW = 4
_X = _FIRST_ROW + ROWS * ROW
_P = _X + STATES
SLOT = _P + _PACKED
SLOTS = 48  # half a second of two cameras and a range finder

# An archived estimate. C is the covariance of its error and that of the oldest slot.
_A_TIME, _A_X = 0, 1
_A_P = _A_X + STATES
_A_C = _A_P + _PACKED
_ARCHIVED = _A_C + STATES * STATES
ARCHIVE = 12
ARCHIVE_INTERVAL = 0.1  # s
_ARCHIVE = HEADER + SLOTS * SLOT
TRACK = _ARCHIVE + ARCHIVE * _ARCHIVED

OBSERVATION = _X  # size of a measurement: time, number of rows, kick, its time, rows

# The process noise, in the order of the parameters of the functions below.
NOISE = 6
(
    DENSITY_POSITION,  # m2/s, of the odometry
    DENSITY_HORIZONTAL,  # m2/s3, of the apparent acceleration
    DENSITY_VERTICAL,  # m2/s3
    VELOCITY_TIME,  # s, of correlation of the horizontal velocity; infinite where it goes on
    BIAS_SIGMA,  # rad, stationary
    BIAS_TIME,  # s, of correlation
) = range(NOISE)
_SHORT = 0.01  # 1, of the correlation time


@njit(cache=True)
def load(track, slot, x, P):
    """Copy the estimate of a slot into x (8,) and P (8, 8)."""
    start = HEADER + slot * SLOT
    for i in range(STATES):
        x[i] = track[start + _X + i]
    k = start + _P
    for i in range(STATES):
        for j in range(i, STATES):
            P[i, j] = track[k]
            P[j, i] = track[k]
            k += 1


@njit(cache=True)
def _store(track, slot, x, P):
    start = HEADER + slot * SLOT
    for i in range(STATES):
        track[start + _X + i] = x[i]
    k = start + _P
    for i in range(STATES):
        for j in range(i, STATES):
            track[k] = P[i, j]
            k += 1


@njit(cache=True)
def _transition(dt, noise):
    """How v_xy and b decay in dt (s), and how far v_xy gets, s: F without its ones.

    ∫ exp(−s/τ) ds = τ (1 − exp(−dt/τ)), dt where τ is infinite.
    """
    tau = noise[VELOCITY_TIME]
    reach = dt if math.isinf(tau) else -tau * math.expm1(-dt / tau)
    return math.exp(-dt / tau), math.exp(-dt / noise[BIAS_TIME]), reach


@njit(cache=True)
def _advance_rows(A, dt, slow, decay, reach):
    """A ← F A in place, A of shape (8, n)."""
    for j in range(A.shape[1]):
        for i in range(2):
            A[i, j] += reach * A[3 + i, j]
            A[3 + i, j] *= slow
            A[6 + i, j] *= decay
        A[2, j] += dt * A[5, j]


@njit(cache=True)
def _wander(span, tau):
    """Variances of p and v and their covariance from white acceleration of density 1 in span (s).

    Of v̇ = −v/τ + w; for short spans by their series, as differences of nearly equal numbers say
    nothing.
    """
    share = span / tau
    if share < _SHORT:
        square = share * share
        return (
            span * span * span * (1.0 / 3.0 - share / 4.0 + 7.0 / 60.0 * square),
            span * span * (0.5 - 0.5 * share + 7.0 / 24.0 * square),
            span * (1.0 - share + 2.0 / 3.0 * square),
        )
    gone = -math.expm1(-share)
    left = 1.0 - gone
    vv = 0.5 * tau * (1.0 - left * left)
    return tau * tau * (span - 2.0 * tau * gone + vv), 0.5 * tau * tau * gone * gone, vv


@njit(cache=True)
def predict(x, P, dt, noise):
    """Predict x (8,) and P (8, 8) by dt (s) in place; back where dt is negative.

    Back, x(t − Δ) = F(−Δ)(x − w) with w's covariance but without its correlation with the
    error of x (Hilton, Martin and Blair's approximation, "C" in Bar-Shalom, IEEE T-AES 38(3),
    2002): good enough for a gate.
    """
    if dt == 0.0:
        return
    slow, decay, reach = _transition(dt, noise)
    _advance_rows(x.reshape(STATES, 1), dt, slow, decay, reach)
    _advance_rows(P, dt, slow, decay, reach)
    _advance_rows(P.T, dt, slow, decay, reach)
    span = abs(dt)
    sign = 1.0 if dt > 0.0 else -1.0
    for i in range(3):
        q = noise[DENSITY_HORIZONTAL] if i < 2 else noise[DENSITY_VERTICAL]
        pp, pv, vv = _wander(span, noise[VELOCITY_TIME] if i < 2 else math.inf)
        P[i, i] += span * noise[DENSITY_POSITION] + pp * q
        P[i, 3 + i] += sign * pv * q
        P[3 + i, i] += sign * pv * q
        P[3 + i, 3 + i] += vv * q
    grown = noise[BIAS_SIGMA] * noise[BIAS_SIGMA] * abs(1.0 - decay * decay)
    P[6, 6] += grown
    P[7, 7] += grown


@njit(cache=True)
def _reach(x, P, dt, observation, noise):
    """Predict to a measurement, before which the velocity may have changed at once."""
    predict(x, P, dt, noise)
    kick, since = observation[KICK], observation[SINCE]
    for i in range(2):
        P[i, i] += kick * since * since
        P[i, 3 + i] += kick * since
        P[3 + i, i] += kick * since
        P[3 + i, 3 + i] += kick


@njit(cache=True)
def _row(observation, row, h):
    """Write the coefficients of a row over the state into h (8,); returns its value."""
    start = _FIRST_ROW + row * ROW
    for i in range(STATES):
        h[i] = observation[start + i]
    return observation[start + STATES]


@njit(cache=True)
def fuse(x, P, observation):
    """Fuse the rows of a measurement (OBSERVATION,) in place.

    Returns
    -------
    squared : float
        The normalised innovation squared: chi-square with as many degrees as rows.
    spread : float
        The log of the determinant of the innovation's covariance, the noise's being 1.
    """
    h = np.empty(STATES)
    gain = np.empty(STATES)
    squared = spread = 0.0
    for row in range(int(observation[ROW_COUNT])):
        innovation = _row(observation, row, h)
        total = 1.0
        for i in range(STATES):
            gain[i] = 0.0
            for j in range(STATES):
                gain[i] += P[i, j] * h[j]
            innovation -= h[i] * x[i]
        for i in range(STATES):
            total += h[i] * gain[i]
        for i in range(STATES):
            x[i] += gain[i] / total * innovation
            for j in range(i, STATES):
                P[i, j] -= gain[i] * gain[j] / total
                P[j, i] = P[i, j]
        squared += innovation * innovation / total
        spread += math.log(total)
    return squared, spread


@njit(cache=True)
def _archived(track, time):
    """Where the youngest archived estimate not younger than `time` begins; -1 if there is none."""
    best = -1
    for k in range(ARCHIVE):
        start = _ARCHIVE + k * _ARCHIVED
        then = track[start + _A_TIME]
        if 0.0 <= then <= time and (best < 0 or then > track[best + _A_TIME]):
            best = start
    return best


@njit(cache=True)
def _load_archived(track, start, x, P):
    k = start + _A_P
    for i in range(STATES):
        x[i] = track[start + _A_X + i]
        for j in range(i, STATES):
            P[i, j] = P[j, i] = track[k]
            k += 1


@njit(cache=True)
def _drop_oldest(track, noise):
    """Let the oldest slot go; the archive's covariances follow the filter to the next one."""
    x, P = np.empty(STATES), np.empty((STATES, STATES))
    load(track, 0, x, P)
    time = track[HEADER + TIME]
    latest = -1.0
    into = _ARCHIVE
    for k in range(ARCHIVE):
        start = _ARCHIVE + k * _ARCHIVED
        latest = max(latest, track[start + _A_TIME])
        if track[start + _A_TIME] < track[into + _A_TIME]:
            into = start
    if time - latest >= ARCHIVE_INTERVAL:
        track[into + _A_TIME] = time
        packed = into + _A_P
        for i in range(STATES):
            track[into + _A_X + i] = x[i]
            for j in range(STATES):
                track[into + _A_C + i * STATES + j] = P[i, j]
                if j >= i:
                    track[packed] = P[i, j]
                    packed += 1

    # cov(e, e_k) ← (I − K H) F cov(e, e_k), by the gains that took slot 0 to slot 1
    following = HEADER + SLOT
    dt = track[following + TIME] - time
    observation = track[following : following + OBSERVATION]
    slow, decay, reach = _transition(dt, noise)
    _reach(x, P, dt, observation, noise)
    rows = int(observation[ROW_COUNT])
    h = np.empty((ROWS, STATES))
    gains = np.zeros((ROWS, STATES))
    for row in range(rows):
        _row(observation, row, h[row])
        total = 1.0
        for i in range(STATES):
            for j in range(STATES):
                gains[row, i] += P[i, j] * h[row, j]
            total += h[row, i] * gains[row, i]
        outer = gains[row].copy()
        for i in range(STATES):
            gains[row, i] /= total
            for j in range(STATES):
                P[i, j] -= gains[row, i] * outer[j]
    for k in range(ARCHIVE):
        start = _ARCHIVE + k * _ARCHIVED
        if track[start + _A_TIME] < 0.0:
            continue
        C = track[start + _A_C : start + _ARCHIVED].reshape(STATES, STATES)
        _advance_rows(C, dt, slow, decay, reach)
        for row in range(rows):
            for j in range(STATES):
                seen = 0.0
                for i in range(STATES):
                    seen += h[row, i] * C[i, j]
                for i in range(STATES):
                    C[i, j] -= gains[row, i] * seen
    for i in range(HEADER, _ARCHIVE - SLOT):
        track[i] = track[i + SLOT]
    track[USED] -= 1.0


@njit(cache=True)
def _fuse_old(track, observation, noise):
    """Fuse a measurement that is older than the oldest slot there; False if it is too old.

    With ν the innovation of the archived estimate x_k predicted to the measurement's time and
    C = cov(x, x_k) Fᵀ, the gain C Hᵀ (H P_k Hᵀ + R)⁻¹ is the best for ν, and the covariance
    that follows is true. What was fused since does not sharpen ν; in order it would have.
    """
    time = observation[TIME]
    start = _archived(track, time)
    if start < 0:
        return False
    x, P = np.empty(STATES), np.empty((STATES, STATES))
    x_k, P_k = np.empty(STATES), np.empty((STATES, STATES))
    load(track, 0, x, P)
    _load_archived(track, start, x_k, P_k)
    dt = time - track[start + _A_TIME]
    slow, decay, reach = _transition(dt, noise)
    predict(x_k, P_k, dt, noise)
    C = track[start + _A_C : start + _ARCHIVED].copy().reshape(STATES, STATES)
    _advance_rows(C.T, dt, slow, decay, reach)
    h = np.empty(STATES)
    gain, cross = np.empty(STATES), np.empty(STATES)
    for row in range(int(observation[ROW_COUNT])):
        innovation = _row(observation, row, h)
        total = 1.0
        for i in range(STATES):
            gain[i] = cross[i] = 0.0
            for j in range(STATES):
                gain[i] += P_k[i, j] * h[j]
                cross[i] += C[i, j] * h[j]
            innovation -= h[i] * x_k[i]
        for i in range(STATES):
            total += h[i] * gain[i]
        for i in range(STATES):
            x[i] += cross[i] / total * innovation
            x_k[i] += gain[i] / total * innovation
            for j in range(STATES):
                P[i, j] -= cross[i] * cross[j] / total
                C[i, j] -= cross[i] * gain[j] / total
                P_k[i, j] -= gain[i] * gain[j] / total
    _store(track, 0, x, P)
    # The archived estimate moves to the measurement. What the others share with the oldest
    # slot has changed in a way that is not known: they go.
    for k in range(ARCHIVE):
        track[_ARCHIVE + k * _ARCHIVED + _A_TIME] = -1.0
    track[start + _A_TIME] = time
    packed = start + _A_P
    for i in range(STATES):
        track[start + _A_X + i] = x_k[i]
        for j in range(STATES):
            track[start + _A_C + i * STATES + j] = C[i, j]
            if j >= i:
                track[packed] = P_k[i, j]
                packed += 1
    return True


@njit(cache=True)
def _place(track, time):
    """The last slot that is not younger than `time`; -1 if all are."""
    k = int(track[USED]) - 1
    while k >= 0 and track[HEADER + k * SLOT + TIME] > time:
        k -= 1
    return k


@njit(cache=True)
def prior(track, observation, x, P, noise):
    """The estimate for the gate of a measurement, into x and P; False if that is forgotten.

    From what is older, or back from the oldest slot.
    """
    time = observation[TIME]
    place = _place(track, time)
    if place < 0 and _archived(track, time) < 0:
        return False
    slot = max(place, 0)
    load(track, slot, x, P)
    _reach(x, P, time - track[HEADER + slot * SLOT + TIME], observation, noise)
    return True


@njit(cache=True)
def newest(track, time, x, P, noise):
    """The estimate predicted from the newest slot to `time`, into x and P."""
    last = int(track[USED]) - 1
    load(track, last, x, P)
    predict(x, P, time - track[HEADER + last * SLOT + TIME], noise)


@njit(cache=True)
def begin(track, time, x, P):
    """Begin a track at `time` with an estimate: a slot without a measurement."""
    track[:] = 0.0
    track[BORN] = time
    track[FUSED] = track[SEEN] = -1.0
    for k in range(ARCHIVE):
        track[_ARCHIVE + k * _ARCHIVED + _A_TIME] = -1.0
    track[USED] = 1.0
    track[HEADER + TIME] = time
    _store(track, 0, x, P)


@njit(cache=True)
def insert(track, observation, x, P, noise):
    """Fuse a measurement at its own time, whatever came in between; x and P are scratch.

    Returns whether it could be: it is lost if nothing as old is known any more.
    """
    time = observation[TIME]
    place = _place(track, time)
    if place >= 0 and int(track[USED]) == SLOTS:  # the oldest slot becomes part of the past
        _drop_oldest(track, noise)
        place -= 1
    if place < 0:
        if not _fuse_old(track, observation, noise):
            return False
        _refilter(track, 1, x, P, noise)
        return True
    start = HEADER + (place + 1) * SLOT
    for i in range(HEADER + int(track[USED]) * SLOT - 1, start - 1, -1):
        track[i + SLOT] = track[i]
    for i in range(OBSERVATION):
        track[start + i] = observation[i]
    track[USED] += 1.0
    _refilter(track, place + 1, x, P, noise)
    return True


@njit(cache=True)
def _refilter(track, first, x, P, noise):
    """Filter the slots from `first` on anew."""
    if first >= int(track[USED]):
        return
    load(track, first - 1, x, P)
    for slot in range(first, int(track[USED])):
        start = HEADER + slot * SLOT
        dt = track[start + TIME] - track[start - SLOT + TIME]
        observation = track[start : start + OBSERVATION]
        _reach(x, P, dt, observation, noise)
        fuse(x, P, observation)
        _store(track, slot, x, P)


@njit(cache=True)
def whiten(observation, time, H, values, R, count):
    """Write a measurement of `count` rows: values = H x + N(0, R).

    Parameters
    ----------
    observation : array of shape (OBSERVATION,)
        Overwritten.
    time : float
        s, of validity.
    H : array of shape (3, 8)
    values : array of shape (3,)
    R : array of shape (3, 3)
        Positive definite in its first `count` rows; changed in place (its Cholesky factor).
    count : int
    """
    observation[TIME] = time
    observation[ROW_COUNT] = count
    observation[KICK] = observation[SINCE] = 0.0
    for i in range(count):
        for j in range(i + 1):
            total = R[i, j]
            for k in range(j):
                total -= R[i, k] * R[j, k]
            R[i, j] = math.sqrt(total) if i == j else total / R[j, j]
        row = _FIRST_ROW + i * ROW
        for c in range(ROW):
            value = H[i, c] if c < STATES else values[i]
            for k in range(i):
                value -= R[i, k] * observation[_FIRST_ROW + k * ROW + c]
            observation[row + c] = value / R[i, i]

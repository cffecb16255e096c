"""From four blobs to the pose of a beacon: the collinearity equations of SVGS.

A pose of the beacon's frame T in the camera's frame C is a flat vector: p_CT (m), then q_CT
(w first), shape (7,). LED i lies at p_i = p_CT + R_CT l_i and is seen at

    azimuth    Az_i = atan(x_i / z_i)           elevation   El_i = asin(y_i / |p_i|)

("High-altitude precision landing by SVGS", Drones 8, 37, 2024, Eq. 1; the paper's f is the unit
of x and y). The eight angles of four blobs give the six numbers of the pose by least squares,
linearised about the last pose and repeated. Small turns δθ are about C's axes:

    ∂p_i/∂p = 1,    ∂p_i/∂θ = −[R_CT l_i]×,    covariance = σ² (JᵀJ)⁻¹

With σ the noise of an angle this is also the Cramér-Rao bound of any estimator.
"""

import math

import numpy as np
from numba import njit

from systems.frames import (
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_matrix,
)
from systems.vision.pinhole import tangents_of_pixel
from systems.vision.planar_pose import quaternion_from_matrix

LED_COUNT = 4
ANGLES = 8

_ITERATIONS = 20
_STEP = 1e-9  # m and rad, of a converged step
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e8


@njit(cache=True)
def angles_of_pixels(camera, pixels, angles):
    """Azimuth and elevation (rad) of pixels (n, 2), into `angles` (2n,)."""
    for i in range(pixels.shape[0]):
        x, y = tangents_of_pixel(camera, pixels[i, 0], pixels[i, 1])
        angles[2 * i] = math.atan(x)
        angles[2 * i + 1] = math.asin(y / math.sqrt(1.0 + x * x + y * y))


@njit(cache=True)
def predict(leds, pose, angles, jacobian):
    """The angles at which LEDs are seen, and their derivatives.

    Parameters
    ----------
    leds : array of shape (4, 3)
        In T, m.
    pose : array of shape (7,)
    angles : array of shape (8,)
        Overwritten, rad; Az and El of each LED.
    jacobian : array of shape (8, 6)
        Overwritten: by p_CT (m) and by a turn about C's axes (rad).

    Returns
    -------
    bool
        Whether all LEDs are in front of the camera.
    """
    R = rotation_matrix(pose[3:])
    for i in range(LED_COUNT):
        lx = R[0, 0] * leds[i, 0] + R[0, 1] * leds[i, 1] + R[0, 2] * leds[i, 2]
        ly = R[1, 0] * leds[i, 0] + R[1, 1] * leds[i, 1] + R[1, 2] * leds[i, 2]
        lz = R[2, 0] * leds[i, 0] + R[2, 1] * leds[i, 1] + R[2, 2] * leds[i, 2]
        x, y, z = pose[0] + lx, pose[1] + ly, pose[2] + lz
        if z <= 1e-3:
            return False
        flat2 = x * x + z * z
        flat = math.sqrt(flat2)
        r2 = flat2 + y * y
        angles[2 * i] = math.atan2(x, z)
        angles[2 * i + 1] = math.asin(y / math.sqrt(r2))
        # ∂Az/∂p = (z, 0, −x)/flat²;  ∂El/∂p = (−x y, flat², −z y)/(r² flat)
        ax, az = z / flat2, -x / flat2
        ex, ey, ez = -x * y / (r2 * flat), flat / r2, -z * y / (r2 * flat)
        jacobian[2 * i, 0], jacobian[2 * i, 1], jacobian[2 * i, 2] = ax, 0.0, az
        jacobian[2 * i + 1, 0], jacobian[2 * i + 1, 1], jacobian[2 * i + 1, 2] = ex, ey, ez
        # a · (δθ × l) = δθ · (l × a)
        jacobian[2 * i, 3] = ly * az
        jacobian[2 * i, 4] = lz * ax - lx * az
        jacobian[2 * i, 5] = -ly * ax
        jacobian[2 * i + 1, 3] = ly * ez - lz * ey
        jacobian[2 * i + 1, 4] = lz * ex - lx * ez
        jacobian[2 * i + 1, 5] = lx * ey - ly * ex
    return True


@njit(cache=True)
def _invert(A):
    """The inverse of a symmetric positive definite matrix (6, 6); zeros if it is not one."""
    n = A.shape[0]
    L = np.zeros((n, n))
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= L[j, k] * L[j, k]
        if not d > 0.0:
            return np.zeros((n, n))
        L[j, j] = math.sqrt(d)
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j]
    inverse = np.zeros((n, n))
    for c in range(n):
        column = np.zeros(n)
        for i in range(n):
            total = 1.0 if i == c else 0.0
            for k in range(i):
                total -= L[i, k] * column[k]
            column[i] = total / L[i, i]
        for i in range(n - 1, -1, -1):
            total = column[i]
            for k in range(i + 1, n):
                total -= L[k, i] * column[k]
            column[i] = total / L[i, i]
        inverse[:, c] = column
    return inverse


@njit(cache=True)
def moved(pose, step):
    """A pose after a step (6,): of p_CT (m), and a turn about C's axes (rad)."""
    out = np.empty(7)
    out[:3] = pose[:3] + step[:3]
    q = quaternion_multiply(quaternion_from_rotation_vector(step[3:]), pose[3:])
    out[3:] = q / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return out


@njit(cache=True)
def solve_pose(leds, angles, pose, covariance):
    """Least squares of the eight angles, linearised about `pose`.

    The steps are damped (Levenberg and Marquardt) where a full one would not lower the residual.

    Parameters
    ----------
    leds : array of shape (4, 3)
        In T, m.
    angles : array of shape (8,)
        Measured, rad.
    pose : array of shape (7,)
        The first guess; overwritten with the solution.
    covariance : array of shape (6, 6)
        Overwritten with (JᵀJ)⁻¹; times the variance of an angle it is that of p_CT (m²) and of
        the turn about C's axes (rad²). Zeros where the pose is not determined.

    Returns
    -------
    float
        Root mean square of the residuals, rad; infinite without a solution.
    """
    predicted, J = np.empty(ANGLES), np.empty((ANGLES, 6))
    trial_angles, trial_J = np.empty(ANGLES), np.empty((ANGLES, 6))
    covariance[:] = 0.0
    if not predict(leds, pose, predicted, J):
        return math.inf
    residual = angles - predicted
    cost = np.sum(residual * residual)
    damping = _FIRST_DAMPING
    A, b = np.zeros((6, 6)), np.zeros(6)
    stale = True
    for _ in range(_ITERATIONS):
        if stale:
            for i in range(6):
                total = 0.0
                for k in range(ANGLES):
                    total += J[k, i] * residual[k]
                b[i] = total
                for j in range(i + 1):
                    total = 0.0
                    for k in range(ANGLES):
                        total += J[k, i] * J[k, j]
                    A[i, j] = A[j, i] = total
        damped = A.copy()
        for i in range(6):
            damped[i, i] *= 1.0 + damping
        inverse = _invert(damped)
        step = np.zeros(6)
        for i in range(6):
            for j in range(6):
                step[i] += inverse[i, j] * b[j]
        trial = moved(pose, step)
        seen = predict(leds, trial, trial_angles, trial_J)
        trial_cost = math.inf
        if seen:
            difference = angles - trial_angles
            trial_cost = np.sum(difference * difference)
        stale = trial_cost <= cost
        if stale:
            gain = cost - trial_cost
            pose[:] = trial
            J[:] = trial_J
            residual = difference
            cost = trial_cost
            damping = max(damping * 0.1, 1e-12)
            small = True
            for i in range(6):
                small = small and abs(step[i]) < _STEP * (1.0 + abs(pose[2]))
            if small or gain < 1e-9 * cost:
                break
        else:
            damping *= 10.0
            if damping > _LARGEST_DAMPING:
                break
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(ANGLES):
                total += J[k, i] * J[k, j]
            A[i, j] = A[j, i] = total
    covariance[:] = _invert(A)
    if covariance[0, 0] <= 0.0:
        return math.inf
    return math.sqrt(cost / ANGLES)


def cramer_rao(leds: np.ndarray, pose: np.ndarray, angle_noise: float | np.ndarray) -> np.ndarray:
    """The Cramér-Rao bound of a pose, shape (6, 6): p_CT (m²), turn about C's axes (rad²).

    Parameters
    ----------
    leds : array of shape (4, 3)
        In T, m.
    pose : array of shape (7,)
        The true one.
    angle_noise : float or array of shape (8,)
        One sigma of the angles, rad: of all, or Az and El of each LED.

    Raises
    ------
    ValueError
        If an LED is behind the camera.
    """
    angles, jacobian = np.empty(ANGLES), np.empty((ANGLES, 6))
    if not predict(leds, pose, angles, jacobian):
        raise ValueError("an LED is behind the camera")
    whitened = jacobian / np.broadcast_to(angle_noise, ANGLES)[:, np.newaxis]
    return np.linalg.inv(whitened.T @ whitened)


@njit(cache=True)
def up_of_pose(pose):
    """T's z axis in C, shape (3,)."""
    R = rotation_matrix(pose[3:])
    return np.array([R[0, 2], R[1, 2], R[2, 2]])


@njit(cache=True)
def level_frame(up):
    """The rotation R_LC to a level frame L from the direction `up` in C (unit, (3,)).

    L's z axis is up; its x axis is C's as far as that is level.
    """
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    y = np.array(
        [up[1] * x[2] - up[2] * x[1], up[2] * x[0] - up[0] * x[2], up[0] * x[1] - up[1] * x[0]]
    )
    R = np.empty((3, 3))
    R[0], R[1], R[2] = x, y, up
    return R


@njit(cache=True)
def level_pose(leds, level, first, second, n_first, n_second, pose):
    """The pose of a level beacon two of whose LEDs, equally high, are seen.

    In L's plane at unit depth the LEDs a and b are seen at n_a and n_b; with Δl and Δn the ways
    from a to b the depth is |Δl| / |Δn| and the yaw the angle from Δl to Δn.

    Parameters
    ----------
    leds : array of shape (4, 3)
    level : array of shape (3, 3)
        R_LC, from `level_frame`.
    first, second : int
        Numbers of the two LEDs.
    n_first, n_second : arrays of shape (2,)
        Where they are seen.
    pose : array of shape (7,)
        Overwritten.

    Returns
    -------
    float
        The depth of the two LEDs below the camera, m.
    """
    dl_x, dl_y = leds[second, 0] - leds[first, 0], leds[second, 1] - leds[first, 1]
    dn_x, dn_y = n_second[0] - n_first[0], n_second[1] - n_first[1]
    depth = math.sqrt((dl_x**2 + dl_y**2) / max(dn_x**2 + dn_y**2, 1e-12))
    yaw = math.atan2(dn_y, dn_x) - math.atan2(dl_y, dl_x)
    c, s = math.cos(yaw), math.sin(yaw)
    p_L = np.array(
        [
            n_first[0] * depth - (c * leds[first, 0] - s * leds[first, 1]),
            n_first[1] * depth - (s * leds[first, 0] + c * leds[first, 1]),
            -depth - leds[first, 2],
        ]
    )
    R_LT = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    R_CL = np.ascontiguousarray(level.T)
    pose[:3] = R_CL @ p_L
    pose[3:] = quaternion_from_matrix(R_CL @ R_LT)
    return depth

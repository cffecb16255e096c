"""Pieces that both filters of the fixed wing share: scalar fusion, what the camera should see.

Measurements of one instant with independent noise are fused one after the
other. With every row linearised at the common prior that is the joint update of
Leonard 2016, Eq. 19, without a matrix inverse.
"""

import math

import numpy as np
from numba import njit

from systems.runway_frames import bearing_and_elevation, rotation


@njit(cache=True)
def fuse(x, P, prior, H, innovation, variance):
    """Fuse one scalar in place; returns its innovation variance.

    Parameters
    ----------
    x : array, shape (n,)
        State, updated by earlier scalars of the same instant.
    P : array, shape (n, n)
        Its covariance.
    prior : array, shape (n,)
        The state at which H and the innovation were computed.
    H : array, shape (n,)
        Row of the measurement matrix.
    innovation : float
        y − h(prior).
    variance : float
        Of the measurement noise.
    """
    n = x.shape[0]
    PH = np.zeros(n)
    for j in range(n):
        if H[j] != 0.0:
            innovation -= H[j] * (x[j] - prior[j])
            for i in range(n):
                PH[i] += P[i, j] * H[j]
    S = variance
    for j in range(n):
        S += H[j] * PH[j]
    for i in range(n):
        gain = PH[i] / S
        x[i] += gain * innovation
        for j in range(n):
            P[i, j] -= gain * PH[j]
    for i in range(n):  # rounding must not break the symmetry
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    return S


@njit(cache=True)
def innovation_variance(P, H, variance):
    """H P Hᵀ + R of one scalar."""
    S = variance
    for i in range(H.shape[0]):
        if H[i] != 0.0:
            for j in range(H.shape[0]):
                S += H[i] * P[i, j] * H[j]
    return S


@njit(cache=True)
def sight(p_n, yaw, pitch, roll, camera_b, mounting):
    """What the camera should see of the touch-down point, and how that depends on the position.

    Parameters
    ----------
    p_n : array, shape (3,)
        Position of the aircraft, m.
    yaw, pitch, roll : float
        Attitude, rad.
    camera_b, mounting : array, shape (3,)
        Position (m) and yaw, pitch, roll (rad) of the camera in the body frame.

    Returns
    -------
    bearing, elevation : float
        rad, Eq. 14.
    H : array, shape (2, 3)
        Their derivative by a displacement of the touch-down point relative to the
        aircraft in NED, which is the one by the position error of the inertial
        navigation (rad/m).
    """
    to_camera = rotation(mounting[0], mounting[1], mounting[2]).T @ rotation(yaw, pitch, roll).T
    offset = rotation(mounting[0], mounting[1], mounting[2]).T @ camera_b
    p_c = to_camera @ (-p_n) - offset
    bearing, elevation = bearing_and_elevation(p_c)
    x, y, z = p_c[0], p_c[1], p_c[2]
    rho2 = x * x + y * y
    rho = math.sqrt(rho2)
    d2 = rho2 + z * z
    H = np.empty((2, 3))
    for j in range(3):
        gx, gy, gz = to_camera[0, j], to_camera[1, j], to_camera[2, j]
        H[0, j] = (-y * gx + x * gy) / rho2
        H[1, j] = (-x * z * gx - y * z * gy) / (d2 * rho) + rho / d2 * gz
    return bearing, elevation, H


@njit(cache=True)
def write_covariance(P, estimate, start):
    """The upper triangle of the first five states, by rows, into `estimate[start:]`."""
    k = start
    for i in range(5):
        for j in range(i, 5):
            estimate[k] = P[i, j]
            k += 1


def covariance_of_errors(estimate: np.ndarray) -> np.ndarray:
    """The covariance of the five errors from a `NAVIGATION_ESTIMATE`, shape (5, 5)."""
    P = np.zeros((5, 5))
    P[np.triu_indices(5)] = estimate[16:31]
    return P + np.triu(P, 1).T

"""The pinhole camera with distortion, and how a camera hangs under a vehicle.

Camera frame C is OpenCV's: x right, y down, z along the optical axis. Pixel
(0, 0) is the centre of the first pixel. A camera is a flat vector, so that
compiled code can take it:

| entry | unit | meaning |
|---|---|---|
| `WIDTH`, `HEIGHT` | px | size of the image |
| `FX`, `FY` | px | focal lengths |
| `CX`, `CY` | px | principal point |
| `K1`, `K2`, `P1`, `P2` | 1 | radial and tangential distortion (Brown 1966, as in OpenCV) |

A mount X_BC is the matrix [R_BC | p_BC], shape (3, 4): p_B = X_BC [p_C; 1].
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

WIDTH, HEIGHT, FX, FY, CX, CY, K1, K2, P1, P2 = range(10)

_UNDISTORT_ITERATIONS = 20  # of the fixed point; a mild lens takes four or five
_UNDISTORT_TOLERANCE = 1e-9  # 1, change of a tangent


def pinhole_camera(
    width: int,
    height: int,
    focal_length: float,
    distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
) -> np.ndarray:
    """A camera with square pixels and the principal point in the middle, shape (10,).

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    focal_length : float
        In pixels.
    distortion : sequence of 4 floats
        k1, k2, p1, p2.
    """
    principal_point = (0.5 * (width - 1), 0.5 * (height - 1))
    return np.array([width, height, focal_length, focal_length, *principal_point, *distortion])


def camera_mount(p_BC: Sequence[float], yaw: float = 0.0) -> np.ndarray:
    """The mount of a camera that looks down, X_BC of shape (3, 4).

    With `yaw` = 0 the top of the image is the body's front and its right-hand
    side the body's right:

        x_C = −y_B    y_C = −x_B    z_C = −z_B

    Parameters
    ----------
    p_BC : sequence of 3 floats
        Position of the camera in B, m.
    yaw : float
        Turn of the camera about z_B, rad, counter-clockwise seen from above.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    down = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.column_stack([turn @ down, np.asarray(p_BC, dtype=float)])


@njit(cache=True)
def distort(camera, x, y):
    """The distorted tangents of the ray with the ideal tangents (x, y)."""
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (camera[K1] + r2 * camera[K2])
    return (
        x * radial + 2.0 * camera[P1] * xy + camera[P2] * (r2 + 2.0 * xx),
        y * radial + camera[P1] * (r2 + 2.0 * yy) + 2.0 * camera[P2] * xy,
    )


@njit(cache=True)
def pixel_of_tangents(camera, x, y):
    """The pixel (u, v) that sees the ray with tangents (x/z, y/z)."""
    xd, yd = distort(camera, x, y)
    return camera[FX] * xd + camera[CX], camera[FY] * yd + camera[CY]


@njit(cache=True)
def tangents_of_pixel(camera, u, v):
    """The ideal tangents (x/z, y/z) of the ray that pixel (u, v) sees."""
    xd = (u - camera[CX]) / camera[FX]
    yd = (v - camera[CY]) / camera[FY]
    x, y = xd, yd
    if camera[K1] == 0.0 and camera[K2] == 0.0 and camera[P1] == 0.0 and camera[P2] == 0.0:
        return x, y
    for _ in range(_UNDISTORT_ITERATIONS):
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (camera[K1] + r2 * camera[K2])
        x_new = (xd - 2.0 * camera[P1] * xy - camera[P2] * (r2 + 2.0 * xx)) / radial
        y_new = (yd - camera[P1] * (r2 + 2.0 * yy) - 2.0 * camera[P2] * xy) / radial
        change = abs(x_new - x) + abs(y_new - y)
        x, y = x_new, y_new
        if change < _UNDISTORT_TOLERANCE:
            break
    return x, y


@njit(cache=True)
def is_in_image(camera, u, v, margin):
    """Whether pixel (u, v) is at least `margin` px inside the border."""
    return (
        margin <= u <= camera[WIDTH] - 1.0 - margin and margin <= v <= camera[HEIGHT] - 1.0 - margin
    )

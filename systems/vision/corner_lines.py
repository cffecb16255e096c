"""Corners of a marker to a few hundredths of a pixel: fit its sides, intersect them.

Across each side the image rises from black to white. At many places along it
the centroid of that gradient is taken, a line is fitted to the centroids, and
neighbouring lines meet in a corner. A symmetric blur moves no centroid, so the
square keeps its size, while a corner searched in place (`cornerSubPix`) is
rounded off by the blur and drawn inwards: a range bias of centimetres.

With a camera given the centroids are freed from distortion before the fit,
because a straight side is not straight in a distorted image.
"""

import math

import numpy as np
from numba import njit

from systems.vision.pinhole import CX, CY, FX, FY, pixel_of_tangents, tangents_of_pixel

_STEP = 0.5  # px, between samples across a side
# Of a cell, to each side: no other edge lies so near, and none that rises outwards so near
# as the first window reaches, which makes up for corners found inside a faint border
_WINDOW, _FIRST_WINDOW = 0.45, 0.9
_SMALLEST_WINDOW = 1.5  # px
_LARGEST_WINDOW = 16.0  # px
_SPREADS = 2.2  # of the gradient, and
_MARGIN = 1.2  # px more: the window of the next pass covers lens and smear
END = 0.08  # of the side, left out at each end where the corner's blur bends the edge
_SMALLEST_END = 1.5  # px
PROFILES = (12, 16, 48)  # at most, a side, in each pass
NOISE_FLOOR = 0.1  # of the strongest gradient of a profile, ignored below
_OUTLIER = 3.0  # of the robust sigma of a side
_SMALLEST_SIGMA = 0.05  # px, below which no centroid is an outlier


@njit(cache=True, error_model="numpy")
def _sample(image, u, v):
    """The grey level at (u, v) by bilinear interpolation, NaN outside the image."""
    if not (0.0 <= u <= image.shape[1] - 1.001 and 0.0 <= v <= image.shape[0] - 1.001):
        return np.nan
    i, j = np.uint64(v), np.uint64(u)
    a, b = v - int(v), u - int(u)
    k, m = i + np.uint64(1), j + np.uint64(1)
    top = float(image[i, j]) * (1.0 - b) + float(image[i, m]) * b
    bottom = float(image[k, j]) * (1.0 - b) + float(image[k, m]) * b
    return top * (1.0 - a) + bottom * a


@njit(cache=True)
def _distance_to_border(image, u, v):
    return min(min(u, image.shape[1] - 1.0 - u), min(v, image.shape[0] - 1.0 - v))


@njit(cache=True, error_model="numpy")
def _edge(image, u, v, nx, ny, window):
    """Centroid and spread of the rise along the outward normal (px from (u, v)), and its weight."""
    half = math.ceil(window / _STEP)
    values = np.empty(2 * half + 1)
    for i in range(2 * half + 1):
        s = (i - half) * _STEP
        values[i] = _sample(image, u + s * nx, v + s * ny)
        if math.isnan(values[i]):
            return 0.0, 0.0, 0.0
    # Differences over a whole pixel: finer ones would see the pixels' raster.
    strongest = 0.0
    for i in range(2 * half - 1):
        strongest = max(strongest, values[i + 2] - values[i])
    floor = NOISE_FLOOR * strongest
    weight = first = second = 0.0
    for i in range(2 * half - 1):
        g = values[i + 2] - values[i] - floor
        if g > 0.0:
            s = (i + 1 - half) * _STEP
            weight += g
            first += g * s
            second += g * s * s
    if weight <= 0.0:
        return 0.0, 0.0, 0.0
    centroid = first / weight
    return centroid, math.sqrt(max(second / weight - centroid * centroid, 0.0)), weight


@njit(cache=True, error_model="numpy")
def _fit_line(a, s, w, count):
    """Weighted regression s = offset + slope · a, twice, the second time without outliers."""
    offset = slope = 0.0
    limit = np.inf
    for _ in range(2):
        sw = sa = ss = saa = sas = 0.0
        used = 0
        for i in range(count):
            if abs(s[i] - offset - slope * a[i]) <= limit:
                used += 1
                sw += w[i]
                sa += w[i] * a[i]
                ss += w[i] * s[i]
                saa += w[i] * a[i] * a[i]
                sas += w[i] * a[i] * s[i]
        determinant = sw * saa - sa * sa
        if used < 3 or determinant <= 0.0:
            return np.nan, np.nan
        slope = (sw * sas - sa * ss) / determinant
        offset = (ss - slope * sa) / sw
        residuals = np.empty(count)
        for i in range(count):
            residuals[i] = abs(s[i] - offset - slope * a[i])
        limit = _OUTLIER * max(1.4826 * np.median(residuals), _SMALLEST_SIGMA)
    return offset, slope


@njit(cache=True)
def _distorted(camera, u, v):
    """Where a pixel of an image free of distortion is in the image."""
    return pixel_of_tangents(camera, (u - camera[CX]) / camera[FX], (v - camera[CY]) / camera[FY])


@njit(cache=True)
def _undistorted(camera, u, v):
    """The inverse of `_distorted`."""
    x, y = tangents_of_pixel(camera, u, v)
    return camera[FX] * x + camera[CX], camera[FY] * y + camera[CY]


@njit(cache=True, error_model="numpy")
def _refine(image, corners, camera, distorted, count_max, windows, spreads, refined):
    """One pass over the sides with a window for each; False if a side could not be fitted.

    All coordinates are of an image free of distortion; only the samples are taken where
    that distortion puts them.
    """
    a = np.empty(count_max)
    s = np.empty(count_max)
    w = np.empty(count_max)
    lines = np.empty((4, 4))  # a point and the direction of each
    for k in range(4):
        u0, v0 = corners[k, 0], corners[k, 1]
        du, dv = corners[(k + 1) % 4, 0] - u0, corners[(k + 1) % 4, 1] - v0
        length = math.sqrt(du * du + dv * dv)
        if not length > 3.0:
            return False
        du, dv = du / length, dv / length
        nx, ny = dv, -du
        end = max(END * length, min(max(_SMALLEST_END, 2.0 * spreads[k]), 0.25 * length))
        count = min(count_max, max(4, int(length - 2.0 * end)))
        used = 0
        total = 0.0
        for i in range(count):
            along = end + (length - 2.0 * end) * (i + 0.5) / count
            u, v = u0 + along * du, v0 + along * dv
            if distorted:
                u, v = _distorted(camera, u, v)
            # Near the border of the image the window shrinks to what is there.
            room = _distance_to_border(image, u, v) - _STEP
            window = max(min(windows[k], room), _SMALLEST_WINDOW)
            centroid, spread, weight = _edge(image, u, v, nx, ny, window)
            if weight <= 0.0:
                continue
            u += centroid * nx
            v += centroid * ny
            if distorted:
                u, v = _undistorted(camera, u, v)
            a[used] = (u - u0) * du + (v - v0) * dv
            s[used] = (u - u0) * nx + (v - v0) * ny
            w[used] = weight
            total += spread
            used += 1
        if 2 * used < count:
            return False
        spreads[k] = total / used
        offset, slope = _fit_line(a, s, w, used)
        if math.isnan(offset):
            return False
        lines[k, 0] = u0 + offset * nx
        lines[k, 1] = v0 + offset * ny
        lines[k, 2] = du + slope * nx
        lines[k, 3] = dv + slope * ny
    for k in range(4):
        p, q = lines[(k + 3) % 4], lines[k]
        determinant = p[2] * q[3] - p[3] * q[2]
        if abs(determinant) < 0.1:
            return False
        t = ((q[0] - p[0]) * q[3] - (q[1] - p[1]) * q[2]) / determinant
        refined[k, 0] = p[0] + t * p[2]
        refined[k, 1] = p[1] + t * p[3]
    return True


@njit(cache=True, error_model="numpy")
def refine_quadrilateral(image, corners, camera, distorted, cells, refined):
    """Compiled core of `refine_corners`; returns False if the corners could not be refined."""
    present = corners.copy()
    if distorted:
        for k in range(4):
            u, v = _undistorted(camera, corners[k, 0], corners[k, 1])
            present[k, 0] = u
            present[k, 1] = v
    moved = np.empty((4, 2))
    widest = np.empty(4)
    windows = np.empty(4)
    for k in range(4):
        cell = (
            math.hypot(
                corners[(k + 1) % 4, 0] - corners[k, 0], corners[(k + 1) % 4, 1] - corners[k, 1]
            )
            / cells
        )
        windows[k] = min(max(_FIRST_WINDOW * cell, _SMALLEST_WINDOW), _LARGEST_WINDOW)
        widest[k] = min(max(_WINDOW * cell, _SMALLEST_WINDOW), _LARGEST_WINDOW)
    spreads = np.zeros(4)
    for count in PROFILES:
        if not _refine(image, present, camera, distorted, count, windows, spreads, moved):
            refined[:] = corners
            return False
        present[:] = moved
        for k in range(4):
            windows[k] = min(widest[k], _SPREADS * spreads[k] + _MARGIN)
    refined[:] = present
    if distorted:
        for k in range(4):
            u, v = _distorted(camera, present[k, 0], present[k, 1])
            refined[k, 0] = u
            refined[k, 1] = v
    return True


_NO_CAMERA = np.zeros(10)


def refine_corners(
    image: np.ndarray,
    corners: np.ndarray,
    camera: np.ndarray | None = None,
    cells: int = 6,
) -> np.ndarray:
    """The corners of a black square on white to a few hundredths of a pixel.

    Parameters
    ----------
    image : uint8 array of shape (height, width)
    corners : array of shape (4, 2)
        px, clockwise, to about a pixel.
    camera : array of shape (10,), optional
        See `systems.vision.pinhole`; without it the image is taken as free of distortion.
    cells : int
        Cells a side, with the border: how near the next edge is.

    Returns
    -------
    array of shape (4, 2)
        px; the given corners where a side shows no clear edge.
    """
    refined = np.empty((4, 2))
    refine_quadrilateral(
        image,
        np.asarray(corners, dtype=float),
        _NO_CAMERA if camera is None else camera,
        camera is not None,
        cells,
        refined,
    )
    return refined

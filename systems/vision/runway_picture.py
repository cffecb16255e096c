"""The runway as the all-weather camera sees it: a picture by the angles of Eq. 14.

Pure functions, without Drake. Every pixel is a bearing and an elevation
(Leonard 2016, Eq. 14); its ray is cut with the horizontal plane through the
touch-down point and coloured there: asphalt, markings, grass. Edges are softened
by the pixel's footprint on the ground, so that far markings fade and do not flicker.
"""

import math

import cv2
import numpy as np
from numba import njit

from systems.runway_frames import rotation
from systems.signals.noise import uniform

_GRASS, _ASPHALT, _PAINT, _SKY = 95.0, 55.0, 215.0, 180.0  # grey levels of 255
# wavelengths (m) and amplitudes (grey levels) of the grass, from fields down to tufts
_OCTAVES = ((500.0, 24.0), (160.0, 22.0), (48.0, 16.0), (14.0, 10.0), (4.0, 8.0))
_RUNWAY_BEFORE = 300.0  # m of runway before the touch-down point


@njit(cache=True)
def _covered(a, b, x, footprint):
    """How much of a pixel of that footprint at x lies between a and b, 0..1."""
    left = min(max((x - a) / footprint + 0.5, 0.0), 1.0)
    right = min(max((x - b) / footprint + 0.5, 0.0), 1.0)
    return left - right


@njit(cache=True)
def _lattice(i, j, octave):
    """A fixed number in 0..1 for each point of a lattice."""
    z = np.uint64(i * 73856093 + j * 19349663 + octave * 83492791)
    return uniform(z, 0, 0)


@njit(cache=True)
def _grass(x, y, footprint):
    shade = _GRASS
    for octave in range(5):
        wavelength, amplitude = _OCTAVES[octave]
        if footprint > wavelength:
            continue
        a, b = x / wavelength, y / wavelength
        i, j = math.floor(a), math.floor(b)
        u, v = a - i, b - j
        u, v = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v)
        near = (1.0 - u) * _lattice(i, j, octave) + u * _lattice(i + 1, j, octave)
        far = (1.0 - u) * _lattice(i, j + 1, octave) + u * _lattice(i + 1, j + 1, octave)
        fade = min(1.0, 2.0 * (1.0 - footprint / wavelength))
        shade += fade * 2.0 * amplitude * ((1.0 - v) * near + v * far - 0.5)
    return shade


@njit(cache=True)
def ground_shade(x, y, across, along, width, length):
    """Grey level of the ground at (X_r, Y_r) (m), seen with footprints across and along (m)."""
    runway = _covered(-0.5 * width, 0.5 * width, x, across)
    runway *= _covered(-_RUNWAY_BEFORE, length, y, along)
    shade = _grass(x, y, max(across, along))
    if runway <= 0.0:
        return shade
    paint = 0.0
    # threshold: eight bars, 30 m long
    for k in range(4):
        start = 3.0 + 4.5 * k
        bar = _covered(start, start + 2.5, abs(x), across)
        paint += bar * _covered(-_RUNWAY_BEFORE + 6.0, -_RUNWAY_BEFORE + 36.0, y, along)
    # aiming point: two blocks of 6 x 45 m at the touch-down point (ICAO Annex 14, 5.2.5)
    paint += _covered(9.0, 15.0, abs(x), across) * _covered(-22.5, 22.5, y, along)
    # centre line: 30 m on, 20 m off
    phase = y - 50.0 * math.floor(y / 50.0)
    if along < 25.0:
        paint += _covered(-0.45, 0.45, x, across) * _covered(10.0, 40.0, phase, along)
    else:
        paint += 0.6 * _covered(-0.45, 0.45, x, across)
    paint = min(paint, 1.0)
    asphalt = _ASPHALT + 0.25 * (_grass(7.0 * x, 3.0 * y, 3.0 * max(across, along)) - _GRASS)
    surface = (1.0 - paint) * asphalt + paint * _PAINT
    return (1.0 - runway) * shade + runway * surface


@njit(cache=True)
def draw_picture(
    p_n, attitude, camera_b, mounting, optics, runway, corner, shape, noise, key, index
):
    """Draw a window of the camera's picture.

    Parameters
    ----------
    p_n : array, shape (3,)
        Position of the aircraft in NED, m.
    attitude : array, shape (3,)
        Yaw, pitch, roll, rad.
    camera_b, mounting : array, shape (3,)
        True position (m) and yaw, pitch, roll (rad) of the camera in the body frame.
    optics : array, shape (4,)
        FOV_H, FOV_V (rad), IFOV_H, IFOV_V (rad/px).
    runway : array, shape (3,)
        Heading (rad), width and length beyond the touch-down point (m).
    corner, shape : tuple of int
        Column and row of the window's top left pixel; its rows and columns.
    noise : float
        Grey levels, one sigma.
    key, index : np.uint64, int
        Of the sensor's noise.

    Returns
    -------
    array of uint8, shape `shape`
        The centre of pixel (row, column) is at v = row + ½, u = column + ½ of Eq. 14.
    """
    R_nb = rotation(attitude[0], attitude[1], attitude[2])
    R_nc = R_nb @ rotation(mounting[0], mounting[1], mounting[2])
    eye = p_n + R_nb @ camera_b
    s, c = math.sin(runway[0]), math.cos(runway[0])
    picture = np.empty(shape, np.uint8)
    for row in range(shape[0]):
        elevation = (corner[1] + row + 0.5) * optics[3] - 0.5 * optics[1]
        for column in range(shape[1]):
            bearing = (corner[0] + column + 0.5) * optics[2] - 0.5 * optics[0]
            rx = math.cos(elevation) * math.cos(bearing)
            ry = math.cos(elevation) * math.sin(bearing)
            rz = math.sin(elevation)
            down = R_nc[2, 0] * rx + R_nc[2, 1] * ry + R_nc[2, 2] * rz
            shade = _SKY
            if down > 0.003:
                distance = -eye[2] / down
                north = eye[0] + distance * (R_nc[0, 0] * rx + R_nc[0, 1] * ry + R_nc[0, 2] * rz)
                east = eye[1] + distance * (R_nc[1, 0] * rx + R_nc[1, 1] * ry + R_nc[1, 2] * rz)
                x = -s * north + c * east
                y = c * north + s * east
                across = max(distance * optics[2], 0.01)
                along = max(distance * optics[3] / down, 0.01)
                shade = ground_shade(x, y, across, along, runway[1], runway[2])
            # a sum of four uniforms is normal enough for grey levels, and cheap
            place = (corner[1] + row) * 4096 + corner[0] + column
            grain = -2.0
            for lane in range(4):
                grain += uniform(key, index * 16777216 + place, lane)
            shade += noise * 1.7320508 * grain
            picture[row, column] = min(max(shade + 0.5, 0.0), 255.0)
    return picture


def draw_tracked_point(
    picture: np.ndarray, point: tuple[float, float] | None, caption: str
) -> np.ndarray:
    """Draw the tracked touch-down point as the operator sees it (Fig. 10): a cross in a box.

    Parameters
    ----------
    picture : array of uint8, shape (rows, columns)
    point : tuple of float, optional
        u, v of Eq. 14, px; None where the tracker has no point.
    caption : str
        Written into the lower left corner.

    Returns
    -------
    array of uint8, shape (rows, columns, 3)
        Blue, green, red.
    """
    canvas = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    if point is not None:
        u, v = round(point[0] - 0.5), round(point[1] - 0.5)
        cv2.drawMarker(canvas, (u, v), (40, 60, 230), cv2.MARKER_CROSS, 16, 1, cv2.LINE_AA)
        cv2.rectangle(canvas, (u - 24, v - 24), (u + 24, v + 24), (66, 228, 240), 1)
    text = caption if point is not None else f"{caption}, not tracked"
    place = (10, picture.shape[0] - 12)
    for colour, width in (((24, 24, 24), 3), ((255, 255, 255), 1)):
        cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_DUPLEX, 0.6, colour, width, cv2.LINE_AA)
    return canvas

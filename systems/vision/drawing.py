"""What a camera saw, drawn for people: the image with its detections on top."""

import cv2
import numpy as np

from systems.frames import rotation_matrix
from systems.signals.measurement import INFRARED, INFRARED_BLOBS, MARKER, MARKER_LEVELS, VALID
from systems.vision.pinhole import pixel_of_tangents

# BGR, of levels 0, 1, 2: they stay apart for colour-blind eyes (Okabe and Ito, 2008)
_LEVEL_COLOURS = ((0, 159, 230), (233, 180, 86), (115, 158, 0))
_AXIS_COLOURS = ((60, 60, 230), (80, 190, 60), (230, 130, 40))  # x, y, z
_TEXT, _SHADE, _ALARM = (255, 255, 255), (24, 24, 24), (60, 60, 230)
_SHIFT = 4  # fractional bits of OpenCV's coordinates
_FONT = cv2.FONT_HERSHEY_DUPLEX


def _fixed(point: np.ndarray) -> tuple[int, int]:
    """A point (px) in OpenCV's fixed-point coordinates."""
    u, v = np.rint(np.clip(point, -4096.0, 4096.0) * (1 << _SHIFT)).astype(int)
    return int(u), int(v)


def _line(image: np.ndarray, a: np.ndarray, b: np.ndarray, colour: tuple, width: int) -> None:
    cv2.line(image, _fixed(a), _fixed(b), colour, width, cv2.LINE_AA, _SHIFT)


def _polygon(image: np.ndarray, points: np.ndarray, colour: tuple, width: int) -> None:
    fixed = np.array([_fixed(point) for point in points], np.int32).reshape(-1, 1, 2)
    # A dark rim keeps the line legible on white and on black.
    cv2.polylines(image, [fixed], True, _SHADE, width + 2, cv2.LINE_AA, _SHIFT)
    cv2.polylines(image, [fixed], True, colour, width, cv2.LINE_AA, _SHIFT)


def _caption(image: np.ndarray, text: str, colour: tuple = _TEXT) -> None:
    """A line of text on a dark band along the lower edge."""
    height = image.shape[0]
    scale = image.shape[1] / 1280.0
    band = round(44 * scale)
    image[height - band :] = (0.35 * image[height - band :]).astype(np.uint8)
    origin = (round(14 * scale), height - round(14 * scale))
    cv2.putText(image, text, origin, _FONT, 0.78 * scale, colour, 1, cv2.LINE_AA)


def _canvas(image: np.ndarray, width: int) -> tuple[np.ndarray, float]:
    """The image in colour, enlarged by a whole number to at least `width` px, and that number."""
    factor = max(1, round(width / image.shape[1]))
    grown = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    return cv2.cvtColor(grown, cv2.COLOR_GRAY2BGR), float(factor)


def draw_marker_detection(
    image: np.ndarray,
    measurement: np.ndarray,
    camera: np.ndarray | None = None,
    width: int = 1280,
) -> np.ndarray:
    """Draw the levels found, the pad's centre and axes, and the pose in words.

    Parameters
    ----------
    image : uint8 array of shape (height, width)
        From the `image` port of a `MarkerCamera`.
    measurement : array of shape (MARKER.size,)
        From its `measurement` port.
    camera : array of shape (10,), optional
        See `systems.vision.pinhole`; with it centre and axes of the pad are drawn.
    width : int
        Of the drawing, px; the image is enlarged by the nearest whole number.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Blue, green, red.
    """
    canvas, factor = _canvas(image, width)
    view = MARKER(measurement)
    corners = measurement[MARKER.index("corner_0_0_u") :].reshape(MARKER_LEVELS, 4, 2)
    for level in range(MARKER_LEVELS):
        if view.valid and np.all(np.isfinite(corners[level])):
            colour = _LEVEL_COLOURS[level]
            points = (corners[level] + 0.5) * factor - 0.5
            _polygon(canvas, points, colour, 3 if level == int(view.level) else 2)
            for point in points:
                for radius, fill in ((5.0, _SHADE), (3.5, colour)):
                    size = round(radius * (1 << _SHIFT))
                    cv2.circle(canvas, _fixed(point), size, fill, -1, cv2.LINE_AA, _SHIFT)
    if not view.valid:
        _caption(canvas, f"frame {view.sequence_number:.0f}   no marker", _ALARM)
        return canvas
    if camera is not None:
        p_CP = view.range * measurement[MARKER.slice("bearing_C")]
        R_CP = rotation_matrix(measurement[MARKER.slice("q_CP")])
        # Axes as long as a quarter of the level's image.
        extent = np.linalg.norm(corners[int(view.level), 0] - corners[int(view.level), 2])
        length = 0.35 * extent * p_CP[2] / camera[2]
        ends = [p_CP, *(p_CP + length * R_CP[:, axis] for axis in range(3))]
        if min(end[2] for end in ends) > 0.0:
            pixels = [
                (np.array(pixel_of_tangents(camera, *(end[:2] / end[2]))) + 0.5) * factor - 0.5
                for end in ends
            ]
            for end, colour in zip(pixels[1:], _AXIS_COLOURS, strict=True):
                _line(canvas, pixels[0], end, _SHADE, 5)
                _line(canvas, pixels[0], end, colour, 3)
    sigma = float(np.sqrt(max(view.covariance_rr, 0.0)))
    _caption(
        canvas,
        f"frame {view.sequence_number:.0f}   level {view.level:.0f}   "
        f"range {view.range:.3f} m ± {1e3 * sigma:.1f} mm   "
        f"reprojection {view.reprojection_error:.3f} px",
    )
    return canvas


def draw_infrared_detection(
    image: np.ndarray, measurement: np.ndarray, camera: np.ndarray, width: int = 1280
) -> np.ndarray:
    """Draw the blobs reported, the largest strongest, and their directions in words.

    Parameters
    ----------
    image : uint8 array of shape (height, width)
        From the `image` port of an `InfraredCamera`.
    measurement : array of shape (INFRARED.size,)
        From its `measurement` port.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    width : int
        Of the drawing, px; the image is enlarged by the nearest whole number.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Blue, green, red.
    """
    canvas, factor = _canvas(image, width)
    view = INFRARED(measurement)
    if not measurement[VALID]:
        _caption(canvas, f"frame {view.sequence_number:.0f}   no beacon", _ALARM)
        return canvas
    start = INFRARED.index("blob_0_x")
    blobs = measurement[start : start + 3 * INFRARED_BLOBS].reshape(INFRARED_BLOBS, 3)
    for i in range(int(view.count)):
        x, y, area = blobs[i]
        point = (np.array(pixel_of_tangents(camera, x, y)) + 0.5) * factor - 0.5
        radius = factor * (np.sqrt(area / np.pi) + 3.0)
        colour = _LEVEL_COLOURS[0] if i == 0 else _LEVEL_COLOURS[1]
        size = round(radius * (1 << _SHIFT))
        for width_px, paint in ((4, _SHADE), (2, colour)):
            cv2.circle(canvas, _fixed(point), size, paint, width_px, cv2.LINE_AA, _SHIFT)
        for axis in np.eye(2):
            for sign in (-1.0, 1.0):
                inner, outer = point + sign * radius * axis, point + sign * 1.6 * radius * axis
                _line(canvas, inner, outer, colour, 2)
        label = tuple(int(c) for c in np.rint(point + radius * np.array([1.2, -1.2])))
        cv2.putText(canvas, f"{i + 1}", label, _FONT, 0.6, colour, 1, cv2.LINE_AA)
    x, y, area = blobs[0]
    _caption(
        canvas,
        f"frame {view.sequence_number:.0f}   blobs {view.count:.0f}   largest at "
        f"{np.degrees(np.arctan(x)):+.2f}°, {np.degrees(np.arctan(y)):+.2f}°, {area:.0f} px",
    )
    return canvas

"""What the SVGS camera saw, drawn for people: the image with the four LEDs it used."""

import cv2
import numpy as np

from systems.signals.measurement import SVGS, SVGS_LEDS
from systems.vision.svgs_selection import ERRORS

_NAMES = ("short-range", "medium-range", "long-range")
_RING, _TEXT, _ALARM = (255, 255, 255), (255, 255, 255), (60, 60, 230)  # BGR
_BRIGHTEN = 1.6  # exposed for LEDs, the ground is dark


def draw_svgs_detection(
    image: np.ndarray,
    measurement: np.ndarray,
    camera: np.ndarray | None = None,
    width: int = 800,
) -> np.ndarray:
    """Draw rings around the LEDs used, joined to the beacon's figure, and the pose in words.

    Parameters
    ----------
    image : uint8 array of shape (height, width, 3)
        From the `image` port of an `SvgsCamera`.
    measurement : array of shape (SVGS.size,)
        From its `measurement` port.
    camera : array of shape (10,), optional
        Not needed; every camera's drawing takes one.
    width : int
        Of the drawing, px.

    Returns
    -------
    uint8 array of shape (height, width, 3)
        Blue, green, red.
    """
    scale = width / image.shape[1]
    grown = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = cv2.convertScaleAbs(grown, alpha=_BRIGHTEN)
    view = SVGS(measurement)
    if view.valid:
        first = SVGS.index("led_0_u")
        leds = scale * measurement[first : first + 2 * SVGS_LEDS].reshape(SVGS_LEDS, 2)
        points = [tuple(round(float(c)) for c in led) for led in leds]
        for a, b in ((0, 1), (0, 3), (1, 3), (2, 0), (2, 1), (2, 3)):
            cv2.line(canvas, points[a], points[b], (120, 120, 120), 1, cv2.LINE_AA)
        for point in points:
            cv2.circle(canvas, point, round(9 * scale), _RING, 1, cv2.LINE_AA)
        distance = float(np.linalg.norm([view.p_CT_x, view.p_CT_y, view.p_CT_z]))
        text = (
            f"{_NAMES[int(view.beacon)]} beacon at {distance:.2f} m, "
            f"residual {view.reprojection_error:.2f} px"
        )
        colour = _TEXT
    else:
        text, colour = f"no pose: {ERRORS[int(view.error_code)]}", _ALARM
    cv2.putText(
        canvas, text, (10, canvas.shape[0] - 12), cv2.FONT_HERSHEY_DUPLEX, 0.5, colour, 1,
        cv2.LINE_AA,
    )  # fmt: skip
    return canvas

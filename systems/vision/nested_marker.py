"""A nested ArUco marker: what is printed on the pad, and how its levels are found in an image.

Each level is a marker of 4x4 cells with a black border of one cell; the next
level sits in the middle of its white centre, 1.2 of its cells wide, so that
some level is readable from touchdown to the largest height. The pattern lies
in the pad's frame P: x to the marker's right, y to its top.

OpenCV drops a marker that contains an identified one, so a nested marker loses
its outer level as soon as the inner one is read. `detectMarkersMultiDict` with
one dictionary of a single id for each level keeps them all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from systems.signals.measurement import MARKER_LEVELS
from systems.vision.corner_lines import refine_quadrilateral
from systems.vision.pinhole import HEIGHT, WIDTH

CELLS = 6  # a side, with the border
SMALLEST_BORDER = 3.0  # px, between a level and the border of the image
_DICTIONARY = cv2.aruco.DICT_4X4_1000


@dataclass(frozen=True)
class NestedMarker:
    """The nested marker on a white square plate.

    Attributes
    ----------
    ids : tuple of int
        Ids in OpenCV's DICT_4X4_1000, outermost level first, at most MARKER_LEVELS.
    sides : tuple of float
        Outer sides of the black borders, m, each smaller than a third of the one before.
    plate_side : float
        m.
    """

    ids: tuple[int, ...]
    sides: tuple[float, ...]
    plate_side: float

    def __post_init__(self) -> None:
        if not 1 <= len(self.ids) == len(self.sides) <= MARKER_LEVELS:
            raise ValueError(
                f"a nested marker has 1 to {MARKER_LEVELS} ids and as many sides, "
                f"not {list(self.ids)} and {list(self.sides)}"
            )
        count = len(cv2.aruco.getPredefinedDictionary(_DICTIONARY).bytesList)
        if not all(0 <= marker_id < count for marker_id in self.ids):
            raise ValueError(f"marker ids go from 0 to {count - 1}, not {list(self.ids)}")
        for outer, inner in zip(self.sides, self.sides[1:], strict=False):
            if not 0.0 < inner < outer / 3.0:
                raise ValueError(
                    f"a level of {inner} m does not fit into the white centre of one of {outer} m"
                )
        if self.plate_side < self.sides[0]:
            raise ValueError(
                f"a marker of {self.sides[0]} m does not fit on a plate of {self.plate_side} m"
            )

    def cells(self, level: int) -> np.ndarray:
        """The cells of a level, 1 white and 0 black, top row first, shape (CELLS, CELLS)."""
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        image = dictionary.generateImageMarker(self.ids[level], CELLS)
        return (image > 127).astype(float)

    def dictionaries(self) -> list[cv2.aruco.Dictionary]:
        """One dictionary with a single id for each level."""
        table = cv2.aruco.getPredefinedDictionary(_DICTIONARY).bytesList
        # Exact matches only: a wrong bit would make a marker of one cell pattern in a thousand.
        return [cv2.aruco.Dictionary(table[i : i + 1].copy(), CELLS - 2, 0) for i in self.ids]

    def padded_sides(self) -> np.ndarray:
        """The sides (m), 0 for levels that do not exist, shape (MARKER_LEVELS,)."""
        sides = np.zeros(MARKER_LEVELS)
        sides[: len(self.sides)] = self.sides
        return sides


@dataclass(frozen=True)
class DetectedMarker:
    """A marker found in an image.

    Attributes
    ----------
    dictionary : int
        Index of the dictionary it was read with.
    marker_id : int
    corners : array of shape (4, 2)
        px, clockwise from the marker's top left; pixel (0, 0) is a pixel's centre.
    """

    dictionary: int
    marker_id: int
    corners: np.ndarray


class MarkerDetector:
    """OpenCV's ArUco detector for any set of dictionaries.

    Parameters
    ----------
    dictionaries : sequence of cv2.aruco.Dictionary
    threshold_windows : sequence of int
        Sides of the windows of the adaptive threshold, px, evenly spaced: one
        is fast, several find markers over a larger range of sizes and lights.
    magnification : int
        By which the image is enlarged first; 2 helps with markers below 20 px.
    """

    def __init__(
        self,
        dictionaries: Sequence[cv2.aruco.Dictionary],
        threshold_windows: Sequence[int] = (3, 13, 23),
        magnification: int = 1,
    ):
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMin = threshold_windows[0]
        parameters.adaptiveThreshWinSizeMax = threshold_windows[-1]
        if len(threshold_windows) > 1:
            parameters.adaptiveThreshWinSizeStep = threshold_windows[1] - threshold_windows[0]
        # The default of 0.125 takes the edge of the plate and the marker for the same thing.
        parameters.minMarkerDistanceRate = 0.02
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        self._detector = cv2.aruco.ArucoDetector(list(dictionaries), parameters)
        self._magnification = magnification

    def detect(self, image: np.ndarray) -> list[DetectedMarker]:
        """The markers in a grey image (uint8, shape (height, width)), corners to a pixel."""
        m = self._magnification
        if m > 1:
            image = cv2.resize(image, None, fx=m, fy=m, interpolation=cv2.INTER_CUBIC)
        corners, ids, _, dictionaries = self._detector.detectMarkersMultiDict(image)
        if ids is None:
            return []
        return [
            DetectedMarker(
                int(dictionary), int(marker_id), (quad.reshape(4, 2).astype(float) + 0.5) / m - 0.5
            )
            for dictionary, marker_id, quad in zip(
                np.ravel(dictionaries), np.ravel(ids), corners, strict=True
            )
        ]


class NestedMarkerDetector:
    """Finds the levels of a nested marker in the images of one camera.

    Parameters
    ----------
    pad : NestedMarker
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    """

    def __init__(self, pad: NestedMarker, camera: np.ndarray):
        # One window, because this runs thirty times a second: 11 px is the
        # smallest that still finds large markers in poor light and smear.
        self._detector = MarkerDetector(pad.dictionaries(), threshold_windows=(11,))
        self._camera = camera
        self._last_pixel = camera[[WIDTH, HEIGHT]] - 1.0

    def detect(self, image: np.ndarray, corners: np.ndarray) -> None:
        """Find the levels.

        Parameters
        ----------
        image : uint8 array of shape (height, width)
        corners : array of shape (MARKER_LEVELS, 4, 2)
            Overwritten: px, refined; NaN where a level was not found whole and at
            least SMALLEST_BORDER px inside the image. Of two markers that read the
            same the larger counts.
        """
        corners[:] = np.nan
        sizes = np.zeros(MARKER_LEVELS)
        refined = np.empty((4, 2))
        for marker in self._detector.detect(image):
            size = float(np.ptp(marker.corners, axis=0).max())
            if size <= sizes[marker.dictionary] or not refine_quadrilateral(
                image, marker.corners, self._camera, True, CELLS, refined
            ):
                continue
            # A marker that the border cuts off may be read, but is not placed well.
            border = np.minimum(refined, self._last_pixel - refined).min()
            if border >= SMALLEST_BORDER:
                sizes[marker.dictionary] = size
                corners[marker.dictionary] = refined

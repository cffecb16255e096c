"""Holding a point of the scene from picture to picture, with OpenCV's pyramidal Lucas–Kanade.

Pure functions, without Drake. The point itself may lie on plain asphalt, so it is
carried by its surroundings: corners near it are followed, a similarity (shift, turn,
scale: the runway comes nearer) is fitted to them robustly and applied to the point.
"""

from typing import Any

import cv2
import numpy as np

_FLOW: dict[str, Any] = {
    "winSize": (15, 15),
    "maxLevel": 2,
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003),
}


def follow_point(
    before: np.ndarray,
    after: np.ndarray,
    point: tuple[float, float],
    fewest: int = 8,
    largest_error: float = 0.6,
) -> tuple[float, float] | None:
    """Where a point of one picture is in the next.

    Parameters
    ----------
    before, after : array of uint8, shape (rows, columns)
        Windows of two pictures with the same corner.
    point : tuple of float
        Column and row of the point in `before`, counted from pixel centres.
    fewest : int
        Corners that have to agree.
    largest_error : float
        px, forward and backward flow together, above which a corner is dropped.

    Returns
    -------
    tuple of float or None
        Column and row in `after`; None if too few corners agree.
    """
    corners = cv2.goodFeaturesToTrack(before, 120, 0.01, 4.0)
    if corners is None or len(corners) < fewest:
        return None
    corners = corners.reshape(-1, 1, 2).astype(np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty(0), **_FLOW)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, np.empty(0), **_FLOW)
    error = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = (found.ravel() == 1) & (found_back.ravel() == 1) & (error < largest_error)
    if int(good.sum()) < fewest:
        return None
    cv2.setRNGSeed(0)  # RANSAC must not depend on what ran before
    similarity, inliers = cv2.estimateAffinePartial2D(
        corners[good], moved[good], ransacReprojThreshold=0.7, maxIters=200
    )
    if similarity is None or int(inliers.sum()) < fewest:
        return None
    u, v = similarity @ np.array([point[0], point[1], 1.0])
    return float(u), float(v)

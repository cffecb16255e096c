"""The detector on real photographs with reference corners, by the functions the camera uses."""

import csv
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from systems.vision.corner_lines import refine_corners
from systems.vision.nested_marker import DetectedMarker, MarkerDetector
from systems.vision.planar_pose import corner_shifts
from tests.shared_data import shared

OPENCV, APRILTAG = "data/photos/opencv", "data/photos/apriltag"
CELLS = 8  # a side of the 6x6 markers and of 36h11, with the border

# photograph, its file, markers in it
TUTORIAL = [
    ("singlemarkersoriginal.jpg", "singlemarkersoriginal.jpg", 6),
    ("gboriginal.jpg", "gboriginal.jpg", 35),
    ("choriginal.jpg", "choriginal.jpg", 17),
    ("chocclusion.jpg", "chocclusion_original.jpg", 13),
]


def grey(file: Path) -> np.ndarray:
    return cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)


def tutorial_dictionaries() -> list[cv2.aruco.Dictionary]:
    storage = cv2.FileStorage(str(shared(f"{OPENCV}/tutorial_dict.yml")), cv2.FileStorage_READ)
    own = cv2.aruco.Dictionary()
    own.readDictionary(storage.root())
    return [cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250), own]


def gold_corners(photograph: str) -> list[tuple[int, np.ndarray]]:
    with open(shared(f"{OPENCV}/gold_corners.csv"), encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["image"] == photograph]
    return [
        (int(row["id"]), np.array([[float(row[f"{a}{i}"]) for a in "xy"] for i in range(4)]))
        for row in rows
    ]


def nearest(found: list[DetectedMarker], marker_id: int, corners: np.ndarray) -> DetectedMarker:
    """The marker of that id nearest to the reference."""
    same = [marker for marker in found if marker.marker_id == marker_id]
    assert same, f"marker {marker_id} was not found"
    return min(same, key=lambda m: np.linalg.norm((m.corners - corners).mean(axis=0)))


@pytest.mark.parametrize(("photograph", "file", "count"), TUTORIAL)
def test_all_markers_of_the_opencv_photographs(photograph, file, count):
    """All 71 within a pixel of gold, which is whole pixels of the border's outline.

    The black of an outline's pixel ends half a pixel further out: that is where
    the refined corners have to be, to the pixel to which gold is good.
    """
    image = grey(shared(f"{OPENCV}/{file}"))
    gold = gold_corners(photograph)
    assert len(gold) == count
    found = MarkerDetector(tutorial_dictionaries()).detect(image)
    distances = []
    for marker_id, corners in gold:
        marker = nearest(found, marker_id, corners)
        assert np.abs(marker.corners - corners).max() <= 1.0
        refined = refine_corners(image, marker.corners, cells=CELLS)
        outline = corners + corner_shifts(corners, np.full((4, 2), 0.5))
        distances += list(np.linalg.norm(refined - outline, axis=1))
    assert np.median(distances) < 0.75
    assert np.percentile(distances, 95) < 1.0
    assert np.max(distances) < 1.5


def reference_tags(file: Path) -> list[tuple[int, np.ndarray]]:
    """Ids and corners; the reference counts pixels from their edges, OpenCV from their centres."""
    tags = []
    for line in file.read_text().splitlines():
        pairs = re.findall(r"\((\S+) (\S+)\)", line)
        tags.append((int(line.split(",")[0]), np.array(pairs, dtype=float) - 0.5))
    return tags


def tag_distances(detector: MarkerDetector) -> list[np.ndarray]:
    """Distances (4,) of the refined corners of each tag found to the reference."""
    result = []
    for text in sorted(shared(APRILTAG).glob("*.txt")):
        image = grey(text.with_suffix(".jpg"))
        found = detector.detect(image)
        for tag_id, corners in reference_tags(text):
            middle = corners.mean(axis=0)
            near = [
                marker
                for marker in found
                if marker.marker_id == tag_id
                and np.linalg.norm(marker.corners.mean(axis=0) - middle) < 5.0
            ]
            if near:
                refined = refine_corners(image, near[0].corners, cells=CELLS)
                # The reference begins at another corner and runs the other way round.
                orders = [np.roll(c, k, axis=0) for c in (corners, corners[::-1]) for k in range(4)]
                result.append(
                    min((np.linalg.norm(refined - c, axis=1) for c in orders), key=np.sum)
                )
    return result


@pytest.mark.parametrize(
    ("windows", "magnification", "least"),
    [((3, 13, 23), 1, 36), ((5, 15, 25, 35, 45), 1, 39), ((5, 15, 25, 35, 45), 2, 42)],
)
def test_tags_of_the_outdoor_photographs(windows, magnification, least):
    """Of 47 tags of 36h11; many are 20 px small, seen obliquely or behind grass."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    distances = tag_distances(MarkerDetector([dictionary], windows, magnification))
    assert len(distances) >= least
    assert np.median(distances) < 0.45


def test_lines_place_tags_better_than_the_corner_search():
    """The reference corners are nearer to the lines' than to `cornerSubPix`'s."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = MarkerDetector([dictionary])
    lines = np.median(tag_distances(detector))
    searched = []
    for text in sorted(shared(APRILTAG).glob("*.txt")):
        image = grey(text.with_suffix(".jpg"))
        references = np.concatenate([corners for _, corners in reference_tags(text)])
        for marker in detector.detect(image):
            corners = marker.corners.astype(np.float32).reshape(-1, 1, 2)
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
            cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria)
            for corner in corners.reshape(4, 2):
                distance = np.linalg.norm(references - corner, axis=1).min()
                if distance < 5.0:
                    searched.append(distance)
    assert lines < 0.6 * np.median(searched)

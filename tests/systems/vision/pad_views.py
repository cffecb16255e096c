"""Cameras over pads for the tests of the vision modules, with their truth by numpy and scipy."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from systems.vision.exposure import EXPOSURE, SMEAR
from systems.vision.nested_marker import NestedMarker
from systems.vision.pinhole import CX, CY, FX, FY, pinhole_camera

PAD = NestedMarker((16, 45, 59), (0.8, 0.16, 0.032), 1.2)
DISTORTION = (-0.05, 0.01, 0.0, 0.0)
CAMERA = pinhole_camera(640, 480, 530.0, DISTORTION)
LOOKING_DOWN = Rotation.from_euler("x", np.pi)


def rng(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


def camera_matrix(camera: np.ndarray) -> np.ndarray:
    """The matrix K of OpenCV's functions, shape (3, 3)."""
    return np.array([[camera[FX], 0.0, camera[CX]], [0.0, camera[FY], camera[CY]], [0.0, 0.0, 1.0]])


def exposure_at(p_WC, tilt=(0.0, 0.0), yaw=0.0, smear=(0.0, 0.0)) -> np.ndarray:
    """An exposure of a camera that looks down, turned by `yaw` and then by `tilt` (rad)."""
    rotation = LOOKING_DOWN * Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_euler("z", yaw)
    exposure = EXPOSURE.zeros()
    exposure[EXPOSURE.slice("q_WC")] = np.roll(rotation.as_quat(), 1)
    exposure[EXPOSURE.slice("p_WC")] = p_WC
    exposure[SMEAR] = smear
    return exposure


def camera_pose(exposure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_WC and p_WC of an exposure."""
    q = exposure[EXPOSURE.slice("q_WC")]
    return Rotation.from_quat(np.roll(q, -1)).as_matrix(), exposure[EXPOSURE.slice("p_WC")]


def pad_pose(exposure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_CP and p_CP of an exposure."""
    R_WC, p_WC = camera_pose(exposure)
    R_WP = Rotation.from_euler("z", exposure[EXPOSURE.index("yaw")]).as_matrix()
    return R_WC.T @ R_WP, R_WC.T @ (exposure[EXPOSURE.slice("p_WP")] - p_WC)


def square(side: float) -> np.ndarray:
    """The corners of a marker in P, m, in OpenCV's order."""
    return 0.5 * side * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=float)


def projected(points_P: np.ndarray, exposure: np.ndarray, distortion=DISTORTION) -> np.ndarray:
    """Pixels of points of P by OpenCV's own projection."""
    R_CP, p_CP = pad_pose(exposure)
    pixels, _ = cv2.projectPoints(
        points_P, Rotation.from_matrix(R_CP).as_rotvec(), p_CP, camera_matrix(CAMERA),
        np.array(distortion),
    )  # fmt: skip
    return pixels.reshape(-1, 2)

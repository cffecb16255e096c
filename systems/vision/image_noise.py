"""Noise for whole images at the price of reading memory.

Drawing three hundred thousand normals for each frame would cost more than
rendering it. So a bank of them is drawn once, the same in all runs, and each
frame reads it from a place of its own.
"""

from functools import lru_cache

import numpy as np
from numba import njit

from systems.signals.noise import standard_normal, stream_key, uniform

BANK_SIZE = 1 << 20  # normals
STEPS = 32.0  # per sigma in the bank
_LARGEST = 3.9  # sigma, the ends of the normals that fit into a byte


@njit(cache=True)
def _draw_bank(key):
    bank = np.empty(BANK_SIZE, np.int8)
    for i in range(BANK_SIZE):
        normal = max(-_LARGEST, min(_LARGEST, standard_normal(key, 0, i)))
        bank[i] = np.int8(round(normal * STEPS))
    return bank


@lru_cache(maxsize=1)
def noise_bank() -> np.ndarray:
    """The bank: standard normals in steps of 1 / STEPS, int8 of shape (BANK_SIZE,)."""
    return _draw_bank(stream_key(0, "image_noise"))


def frame_noise(key: np.uint64, frame: int, height: int, width: int) -> np.ndarray:
    """The normals of one frame, int8 of shape (height, width), a view of the bank.

    Parameters
    ----------
    key : np.uint64
        Of the camera, from `systems.signals.noise.stream_key`.
    frame : int
        Number of the frame.
    height, width : int
        Of the image, px.

    Raises
    ------
    ValueError
        If the image is larger than half the bank.
    """
    count = height * width
    if count > BANK_SIZE // 2:
        raise ValueError(f"an image of {width}x{height} px is too large for the bank of noise")
    start = int(uniform(key, frame, 0) * (BANK_SIZE - count))
    return noise_bank()[start : start + count].reshape(height, width)

"""Noise without hidden state: random numbers as a pure function of (seed, stream, index).

A generator object would be state outside the `Context`. Here the n-th draw of
a stream is a hash of its coordinates, so a run can be cloned, resumed or split
over machines and still sees the same noise.

The hash is two rounds of the SplitMix64 finaliser (Steele, Lea, Flood, "Fast
splittable pseudorandom number generators", OOPSLA 2014); normals are by Box
and Muller.
"""

import hashlib
import math

import numpy as np
from numba import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_LANE = np.uint64(0xD1B54A32D192ED03)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


def stream_key(seed: int, stream: str) -> np.uint64:
    """The key of a named stream of random numbers.

    Parameters
    ----------
    seed : int
        The seed of the scenario, any integer.
    stream : str
        The name of the stream, for example ``"imu.gyro"``. Streams with
        different names are independent.
    """
    digest = hashlib.blake2b(f"{seed}/{stream}".encode(), digest_size=8).digest()
    return np.uint64(int.from_bytes(digest, "little"))


def derived_seed(seed: int, block: str) -> int:
    """The seed of one block of a scenario: blocks with different names see different noise."""
    return int(stream_key(seed, block) >> np.uint64(1))


@njit(cache=True, inline="always")
def _mix(z):
    z = (z ^ (z >> _S30)) * _M1
    z = (z ^ (z >> _S27)) * _M2
    return z ^ (z >> _S31)


@njit(cache=True)
def uniform(key, index, lane):
    """One draw from the open interval (0, 1).

    Parameters
    ----------
    key : np.uint64
        From `stream_key`.
    index, lane : int
        Which sample, and which number of that sample.
    """
    z = _mix(np.uint64(key) + np.uint64(index) * _GOLDEN)
    z = _mix(z + np.uint64(lane + 1) * _LANE)
    return (float(z >> _S11) + 0.5) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def standard_normal(key, index, lane):
    """One draw from N(0, 1); parameters as in `uniform`."""
    pair = lane // 2
    radius = math.sqrt(-2.0 * math.log(uniform(key, index, 2 * pair)))
    angle = 2.0 * math.pi * uniform(key, index, 2 * pair + 1)
    if lane % 2 == 0:
        return radius * math.cos(angle)
    return radius * math.sin(angle)


@njit(cache=True)
def standard_normals(key, index, count):
    """`count` independent draws from N(0, 1) as an array of shape (count,)."""
    out = np.empty(count)
    for pair in range((count + 1) // 2):
        radius = math.sqrt(-2.0 * math.log(uniform(key, index, 2 * pair)))
        angle = 2.0 * math.pi * uniform(key, index, 2 * pair + 1)
        out[2 * pair] = radius * math.cos(angle)
        if 2 * pair + 1 < count:
            out[2 * pair + 1] = radius * math.sin(angle)
    return out

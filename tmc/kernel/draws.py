"""Addressed randomness: every draw is a pure function of (seed, stream, episode, tick, UAV).

NumPy's Philox is a counter-based generator: its key holds the seed and the stream, its counter the address. No process
has a hidden random state, so a process that is restarted or replaced draws the same numbers. Raw 64-bit words are
turned into floats here, since NumPy guarantees only the bit stream between versions.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.random import Philox
from numpy.typing import NDArray


class Stream(IntEnum):
    """The purpose of a draw. Streams are independent of each other."""

    STARTS = 1
    AGES = 2
    EVENTS = 3
    EXPLORATION = 4
    PLANNER = 5
    REPLAY = 6
    WEIGHTS = 7
    STALLS = 8


def uniforms(
    seed: int, stream: Stream, n: int, *, episode: int = 0, tick: int = 0, uav: int = 0
) -> NDArray[np.float64]:
    """Return `n` numbers in [0, 1) of one address; shape (n,), float64, 53 random bits each.

    The lowest counter word counts within the address, so `n` may be any number below 2^64.
    """
    counter = np.array([0, tick, uav, episode], np.uint64)
    bits = Philox(key=np.array([seed, int(stream)], np.uint64), counter=counter)
    raw: NDArray[np.uint64] = bits.random_raw(n)
    return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53


def distinct(u: NDArray[np.float64], candidates: NDArray[np.int64], n: int) -> list[int]:
    """Return `n` different candidates, each equally likely, from `n` uniforms `u` (Fisher-Yates from the front)."""
    pool = [int(c) for c in candidates]
    for i in range(n):
        j = i + int(u[i] * (len(pool) - i))
        pool[i], pool[j] = pool[j], pool[i]
    return pool[:n]

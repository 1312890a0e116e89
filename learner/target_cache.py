"""Caches the target values of transitions until theta- changes, so that none is computed twice.

The value in eq. (8), max_a' Q(o', a'; theta-), of a stored transition is constant until theta- = theta. In that time
Algorithm 1 draws each stored transition about six times (5,000 minibatches of 128 from 100,000). So about four fifths
of the values are cached when they are needed, and the forward pass of theta- shrinks to the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.observation import Floats

MAX_VALUES = 2**20
"""Most values kept, 12 bytes each: from a larger replay memory, a transition is drawn less often."""


class TargetValueCache:
    """Holds one value per transition, by the transition's number. Transition n has place n mod `size`.

    The TMC's numbers grow with the mission, so the newest `size` of them have a place each; of two that share one, the
    later one stays. The number is stored beside the value, so a value is never another transition's.
    """

    def __init__(self, size: int) -> None:
        self._number = np.full(min(size, MAX_VALUES), -1, np.int64)
        self._value = np.zeros(self._number.size, np.float32)

    def forget(self) -> None:
        """Clear the cache, because theta- has changed or the numbers start again."""
        self._number.fill(-1)

    def keep(self, index: NDArray[np.int64], value: Floats) -> None:
        """Store the values of transitions `index`. Shapes (n,)."""
        place = index % self._number.size
        # Each assignment is one loop in order, so of two that share a place the last one wins in both arrays.
        self._number[place], self._value[place] = index, value

    def look_up(self, index: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the values of transitions `index`, and whether each is cached; shapes (n,). Others are arbitrary."""
        place = index % self._number.size
        return self._value[place], self._number[place] == index

"""What theta- says of transitions it has seen before: kept until theta- changes, so that nothing is computed twice.

The value in eq. (8), max_a' Q(o', a'; theta-), of a stored transition stays what it is until theta- = theta, and in
that time Algorithm 1 draws each transition held about six times (5,000 minibatches of 128 from 100,000). So about four
fifths of the values are known when they are needed: the forward pass of theta- shrinks to the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.observation import Floats

LARGEST = 2**20
"""Values kept at most, 12 bytes each: a larger memory of transitions than that is drawn from less often."""


class TargetValueCache:
    """One value a transition, by the number that a minibatch gives it. Transition n has place n mod `size`.

    The TMC's numbers grow with the mission, so the newest `size` of them have a place each; of two that share one, the
    later drawn stays. The number stands beside the value: what is found is never another transition's.
    """

    def __init__(self, size: int) -> None:
        self._number = np.full(min(size, LARGEST), -1, np.int64)
        self._value = np.zeros(self._number.size, np.float32)

    def forget(self) -> None:
        """Nothing is known any more: theta- has changed, or the numbers begin anew."""
        self._number.fill(-1)

    def keep(self, index: NDArray[np.int64], value: Floats) -> None:
        """These are the values of transitions `index`. Shapes (n,)."""
        place = index % self._number.size
        # One loop a statement: of two that share a place, both statements let the last one stay.
        self._number[place], self._value[place] = index, value

    def look_up(self, index: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """The values of transitions `index`, and whether each is known; shapes (n,). Unknown ones have any value."""
        place = index % self._number.size
        return self._value[place], self._number[place] == index

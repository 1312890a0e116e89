"""Prioritised sampling: how often each transition is drawn (Schaul et al. 2016, Sec. 3.3; Horgan et al. 2018).

Transition i is drawn with P(i) = m_i / sum_k m_k, where its mass is m_i = (|TD error| + epsilon)^alpha. Masses lie in
blocks, with the sum of each block beside them. A draw finds its block among the sums, then its place in it. A sum tree
has a level for each power of two instead; two levels need only a few NumPy calls for a whole minibatch. A block's
sum is always computed from its masses, so rounding errors do not accumulate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.observation import Floats, Ints

BLOCK = 128
"""Masses per block: both searches are short for 100,000 transitions."""
EPSILON = 1e-3
"""Added to each error, in scaled reward, so that a transition without an error is still drawn now and then."""
Reals = NDArray[np.float64]


class Priorities:
    """Hold the priorities of the newest `size` transitions, numbered 0, 1, 2, ... in order of arrival.

    `alpha` in (0, 1]: exponent of the errors. A transition without a known error has the largest priority so far.
    """

    def __init__(self, size: int, alpha: float) -> None:
        self.size, self.alpha, self.added = size, alpha, 0
        self._blocks = np.zeros((-(-size // BLOCK), BLOCK))
        self._mass = self._blocks.reshape(-1)  # the same memory: transition n stands at n mod `size`
        self._sums = np.zeros(len(self._blocks))
        self._largest = 1.0

    @property
    def nbytes(self) -> int:
        """Return the memory that the masses take (bytes)."""
        return self._mass.nbytes + self._sums.nbytes

    @property
    def total(self) -> float:
        """Return the sum of all masses; 0 while nothing can be drawn."""
        return float(self._sums.sum())

    def add(self, present: NDArray[np.bool_]) -> None:
        """Add the next transitions, (n,) bool, each in place of the oldest; False: it is never drawn."""
        numbers = np.arange(self.added, self.added + present.size)[-self.size :]
        self.added += present.size
        self._put(numbers % self.size, np.where(present[-self.size :], self._largest**self.alpha, 0.0))

    def set(self, numbers: Ints, errors: Floats | Reals) -> None:
        """Set |TD error| of transitions, shapes (n,); those not held, or never drawn, keep their mass."""
        place = numbers % self.size
        known = (numbers >= self.added - self.size) & (numbers < self.added) & (numbers >= 0)
        known &= self._mass[place] > 0.0
        priority = errors[known].astype(np.float64) + EPSILON
        self._largest = max(self._largest, float(priority.max(initial=0.0)))
        self._put(place[known], priority**self.alpha)

    def drop(self, numbers: Ints) -> None:
        """Make these held transitions never be drawn again."""
        self._put(numbers % self.size, np.zeros(numbers.size))

    def _put(self, place: Ints, mass: Reals) -> None:
        self._mass[place] = mass
        block = np.unique(place // BLOCK)
        self._sums[block] = self._blocks[block].sum(axis=1)

    def draw(self, u: Reals) -> Ints:
        """Draw transition numbers, (B,), one from each of B equal shares of the total mass (Schaul et al., App. B.2.1).

        `u` (B,) in [0, 1): the place in each share. Needs `total` > 0.
        """
        ends = np.cumsum(self._sums)
        mass = _below((np.arange(u.size) + u) / u.size * ends[-1], ends[-1])
        block = np.searchsorted(ends, mass, side="right")  # the first that ends behind it, so none that is empty
        inside = np.cumsum(self._blocks[block], axis=1)
        rest = _below(mass - np.append(0.0, ends)[block], inside[:, -1])
        place = block * BLOCK + (inside <= rest[:, None]).sum(axis=1)
        newest = self.added - 1
        return np.asarray(newest - (newest - place) % self.size)

    def mass(self, numbers: Ints) -> Reals:
        """Return the masses of held transitions, (n,), to which P(i) is proportional."""
        return np.asarray(self._mass[numbers % self.size])

    def weights(self, numbers: Ints, beta: float) -> Floats:
        """Return (held P(i))^-beta over the largest in the minibatch (Schaul et al., Sec. 3.4): (B,), in (0, 1].

        The number held and the total are common factors, and cancel.
        """
        mass = self.mass(numbers)
        return np.asarray((mass / mass.min()) ** -beta, np.float32)


def _below(values: Reals, end: Reals) -> Reals:
    """Move values that rounding may have moved out of [0, end) back into it."""
    return np.clip(values, 0.0, np.nextafter(end, 0.0))


def first_errors(reward: Reals, values: Floats, gamma: float, following: Floats) -> Reals:
    """Return |r + gamma max_a Q(o', a) - Q(o, a)| by the values of the UAV that flew it, (n, N); NaN if not known.

    `reward` (n, N), scaled. `values` (n, N, 2): Q(o, a) and max_a Q(o, a) at these ticks; `following`: one tick later.
    """
    return np.abs(reward + gamma * following[..., 1].astype(np.float64) - values[..., 0])

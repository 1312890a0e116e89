"""The uncertainty of both scenarios (eqs. 1-4), its updates (Sec. II-D), and the average that is minimised (eq. 6).

Scenario II keeps, for every cell, the tick of its last visit `tau_k` and computes

    u_k(t) = 1 - exp(-alpha_k (t - tau_k))                                         (eq. 3)

An initial map that is not "all visited at t = 0" is carried by one factor a cell, `s_k = 1 - u_k(0)`, in force until
the first visit: u_k(t) = 1 - s_k exp(-alpha_k t). Values come from a table of exp(-alpha n), so that
every process, and the replay that rebuilds what a UAV saw, gets the same bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class UncertaintyLaw:
    """Eq. (3) for a fixed set of cells and rates; holds tables, no state.

    Arguments: `alpha`, shape (K,), events a tick in each cell (0 where nothing is monitored); `ticks`, the longest age
    that is asked for. All arrays are over the R monitored cells, in ascending order of k.
    """

    def __init__(self, alpha: NDArray[np.float64], ticks: int) -> None:
        self.cells = np.flatnonzero(alpha > 0).astype(np.int32)
        """Shape (R,): the monitored cells k."""
        self.index = np.full(alpha.size, -1, np.int32)
        """Shape (K,): where cell k stands in `cells`, or -1."""
        self.index[self.cells] = np.arange(self.cells.size)
        self.index_list = [int(i) for i in self.index]
        self.q = np.exp(-alpha[self.cells])
        """Shape (R,): q_k = exp(-alpha_k), what is left of certainty after one tick."""
        rates, rate_of = np.unique(alpha[self.cells], return_inverse=True)
        self._decay = np.exp(-rates[:, None] * np.arange(ticks + 1)[None, :]).ravel()
        self._offset = rate_of.astype(np.int64) * (ticks + 1)
        self._offsets: list[int] = self._offset.tolist()
        self._single = (1.0 - self._decay).astype(np.float32)
        self._rows = np.int32(0) if rates.size < 2 else self._offset.astype(np.int32)

    def values(
        self, last_visit: NDArray[np.uint16], t: int | NDArray[np.int64], s: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """u_k(t) from the ticks of the last visits. Shapes (..., R) and () or (..., 1) -> (..., R), float64.

        `s`, shape (..., R): the initial map's factors 1 - u_k(0), for cells with `last_visit` 0, "not since the start".
        """
        left = self._decay.take(self._offset + t - last_visit)
        if s is not None:
            left = np.where(last_visit == 0, s * left, left)
        return np.asarray(1.0 - left)

    def singles(
        self, last_visit: NDArray[np.uint16], t: NDArray[np.int64], s: NDArray[np.float64] | None = None
    ) -> NDArray[np.float32]:
        """`values` rounded to float32, in a tenth of the time where there is no `s`."""
        if s is not None:
            return self.values(last_visit, t, s).astype(np.float32)
        age = np.subtract(t.astype(np.uint16), last_visit, dtype=np.uint16)
        # Every age is in the table; where NumPy has to check that, it takes half as long again.
        return self._single.take(age if self._rows.ndim == 0 else age + self._rows, mode="clip")

    def value(self, i: int, last_visit: int, t: int, s: NDArray[np.float64] | None = None) -> float:
        """u of the one cell `cells[i]`; the same bits as `values`."""
        left: float = self._decay.item(self._offsets[i] + t - last_visit)
        if s is not None and last_visit == 0:
            left = float(s[i]) * left
        return 1.0 - left


def merge(a: NDArray[np.uint16], b: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """The one law of local and global update: the latest visit wins (Sec. II-D).

    Commutative, associative and idempotent, so late, doubled or reordered records cannot corrupt a map.
    """
    return np.maximum(a, b)


def step_events(
    active: NDArray[np.bool_], visited: list[int], arrivals: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Scenario I, one slot, in the paper's order: cells visited in [t, t+1) are cleared, then its new events appear.

    Returns e(t+1), shape (K,), and the cells whose event is new in it. An arrival at an active cell adds nothing.
    """
    cleared = active.copy()
    cleared[visited] = False
    new = np.flatnonzero(arrivals & ~cleared)
    cleared[new] = True
    return cleared, new


def arrival_probability(alpha: NDArray[np.float64]) -> NDArray[np.float64]:
    """P(at least one Poisson arrival in a tick) = 1 - exp(-alpha_k), so that both scenarios share alpha."""
    return -np.expm1(-alpha)


ROUNDING = 1e-12
"""A bound below this share of the rates is 0: what is left of it is rounding, and nothing can be compared with it."""


def lower_bound(alpha: NDArray[np.float64], uavs: int, ticks: int) -> float:
    """No team of N UAVs can have a smaller eq. (6) in scenario II, from a map all visited.

    Returns the sum over cells, averaged over ticks 1..T. For uneven rates, the N T visits go where they save most.
    Where UAVs stand, and that one visits one cell a tick, is ignored.
    """
    rates = alpha[alpha > 0]
    relaxed = _best_spread(rates, uavs * ticks, ticks)
    bound = max(relaxed, _youngest(rates, uavs, ticks)) if np.ptp(rates) == 0 else relaxed
    return bound if bound > ROUNDING * rates.sum() else 0.0


def _youngest(rates: NDArray[np.float64], uavs: int, ticks: int) -> float:
    """Equal rates: at each tick at most N cells have age 0, at most N have age 1, and so on; the rest have age t."""
    ages = np.arange(rates.size) // max(uavs, 1)
    sums = (-np.expm1(-rates * np.minimum(ages, t)).sum() for t in range(1, ticks + 1))
    return float(sum(sums)) / ticks


def _best_spread(rates: NDArray[np.float64], visits: int, ticks: int) -> float:
    """Any rates: `visits` visits in all, each cell's evenly spaced, spent where they save most.

    A cell with n visits has n + 1 stretches of T - n unvisited ticks together. What it costs is convex in n, so taking
    the largest savings first is the optimum of this relaxed problem.
    """
    n = np.arange(ticks + 1)
    length, longer = np.divmod(ticks - n, n + 1)
    distinct_rates, cells = np.unique(rates, return_counts=True)
    u = -np.expm1(-distinct_rates[:, None] * np.arange(ticks + 1))
    stretch = np.cumsum(u, axis=1)  # the sum of u over ages 1..l, since u at age 0 is 0
    cost = (n + 1 - longer) * stretch[:, length] + longer * stretch[:, np.minimum(length + 1, ticks)]
    saved = -np.diff(cost, axis=1).ravel()
    order = np.argsort(-saved, kind="stable")
    counts = np.repeat(cells, ticks)[order]
    spent = np.clip(visits - (np.cumsum(counts) - counts), 0, counts)
    return float(cells @ cost[:, 0] - saved[order] @ spent) / ticks

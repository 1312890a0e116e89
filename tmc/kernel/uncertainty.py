"""Compute the uncertainty of both scenarios (eqs. 1-4), its updates (Sec. II-D), and the bound of its mean (eq. 6).

Scenario II keeps, for every cell, the tick of its last visit `tau_k` and computes

    u_k(t) = 1 - exp(-alpha_k (t - tau_k))                                         (eq. 3)

An initial map that is not visited at t = 0 has one factor per cell, `s_k = 1 - u_k(0)`, which applies until the first
visit: u_k(t) = 1 - s_k exp(-alpha_k t). Values come from a table of exp(-alpha n), so that all processes, and the
replay memory that rebuilds observations, get the same bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class UncertaintyLaw:
    """Compute eq. (3) for a fixed set of cells and rates. Holds tables, no state.

    `alpha`: events per tick in each cell, shape (K,), 0 where a cell is not monitored. `ticks`: the longest age. All
    other arrays are over the R monitored cells, in ascending order of k.
    """

    def __init__(self, alpha: NDArray[np.float64], ticks: int) -> None:
        self.cells = np.flatnonzero(alpha > 0).astype(np.int32)
        """The monitored cells k; shape (R,), int32."""
        self.index = np.full(alpha.size, -1, np.int32)
        """The index of cell k in `cells`, or -1; shape (K,), int32."""
        self.index[self.cells] = np.arange(self.cells.size)
        self.index_list = [int(i) for i in self.index]
        self.q = np.exp(-alpha[self.cells])
        """q_k = exp(-alpha_k), the certainty that is left after one tick; shape (R,)."""
        rates, rate_of = np.unique(alpha[self.cells], return_inverse=True)
        self._decay = np.exp(-rates[:, None] * np.arange(ticks + 1)[None, :]).ravel()
        self._offset = rate_of.astype(np.int64) * (ticks + 1)
        self._offsets: list[int] = self._offset.tolist()
        self._single = (1.0 - self._decay).astype(np.float32)
        self._rows = np.int32(0) if rates.size < 2 else self._offset.astype(np.int32)

    def values(
        self, last_visit: NDArray[np.uint16], t: int | NDArray[np.int64], s: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return u_k(t) from the ticks of the last visits. Shapes (..., R) and () or (..., 1) -> (..., R), float64.

        `s`: the initial map's factors 1 - u_k(0), shape (..., R), for cells with `last_visit` 0, not visited since.
        """
        left = self._decay.take(self._offset + t - last_visit)
        if s is not None:
            left = np.where(last_visit == 0, s * left, left)
        return np.asarray(1.0 - left)

    def singles(
        self, last_visit: NDArray[np.uint16], t: NDArray[np.int64], s: NDArray[np.float64] | None = None
    ) -> NDArray[np.float32]:
        """Return `values` rounded to float32; without `s`, in a tenth of the time."""
        if s is not None:
            return self.values(last_visit, t, s).astype(np.float32)
        age = np.subtract(t.astype(np.uint16), last_visit, dtype=np.uint16)
        # Every age is in the table. With a check of that, NumPy takes 1.5 times as long.
        return self._single.take(age if self._rows.ndim == 0 else age + self._rows, mode="clip")

    def value(self, i: int, last_visit: int, t: int, s: NDArray[np.float64] | None = None) -> float:
        """Return u of the cell `cells[i]`; the same bits as `values`."""
        left: float = self._decay.item(self._offsets[i] + t - last_visit)
        if s is not None and last_visit == 0:
            left = float(s[i]) * left
        return 1.0 - left


def merge(a: NDArray[np.uint16], b: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Merge two maps of last visits: the later visit counts (Sec. II-D). Local and global updates both use it.

    It is commutative, associative and idempotent, so late, repeated or reordered records cannot corrupt a map.
    """
    return np.maximum(a, b)


def step_events(
    active: NDArray[np.bool_], visited: list[int], arrivals: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Advance scenario I by one tick, in the paper's order: clear the cells visited in [t, t+1), then add new events.

    Returns e(t+1), shape (K,), and the cells of its new events. An arrival at an active cell has no effect.
    """
    cleared = active.copy()
    cleared[visited] = False
    new = np.flatnonzero(arrivals & ~cleared)
    cleared[new] = True
    return cleared, new


def arrival_probability(alpha: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return P(at least one Poisson arrival in a tick) = 1 - exp(-alpha_k). So both scenarios share alpha."""
    return -np.expm1(-alpha)


MIN_BOUND_SHARE = 1e-12
"""A bound below this share of the sum of the rates is only rounding, and counts as 0."""


def lower_bound(alpha: NDArray[np.float64], uavs: int, ticks: int) -> float:
    """Return a lower bound of eq. (6) for N UAVs in scenario II, from a map that starts visited.

    A sum over cells, averaged over ticks 1..T. For uneven rates, the N T visits go where they save most. The bound
    ignores positions, and that a UAV visits one cell per tick.
    """
    rates = alpha[alpha > 0]
    relaxed = _best_spread(rates, uavs * ticks, ticks)
    bound = max(relaxed, _youngest(rates, uavs, ticks)) if np.ptp(rates) == 0 else relaxed
    return bound if bound > MIN_BOUND_SHARE * rates.sum() else 0.0


def _youngest(rates: NDArray[np.float64], uavs: int, ticks: int) -> float:
    """Return the bound for equal rates: at most N cells have age 0, N have age 1, and so on; the others have age t."""
    ages = np.arange(rates.size) // max(uavs, 1)
    sums = (-np.expm1(-rates * np.minimum(ages, t)).sum() for t in range(1, ticks + 1))
    return float(sum(sums)) / ticks


def _best_spread(rates: NDArray[np.float64], visits: int, ticks: int) -> float:
    """Return the bound for any rates: `visits` visits, evenly spaced in each cell, spent where they save most.

    A cell with n visits has n + 1 intervals of T - n unvisited ticks together. Its cost is convex in n, so taking the
    largest savings first is optimal for this relaxed problem.
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

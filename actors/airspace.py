"""The look-ahead airspace: a UAV waits for a peer's position only when that peer could matter (ADR 0001).

UAV i in cell c_i needs peer j's cell at tick t' only if j could be next to it by then, that is when
`chebyshev(c_i, c_j(s_j)) - (t' - s_j) <= reach`, with c_j(s_j) the last cell known of j. Otherwise it flies on. So any
interleaving of processes flies the same cells as the lock-step fleet.
"""

from __future__ import annotations

import math
from typing import Protocol

from tmc.kernel.grid import Grid


class Tracks(Protocol):
    """Where the UAVs of the episode were, as far as this process knows; the transport behind it is somebody else's."""

    def begin(self, episode: int, starts: list[int]) -> None:
        """A new episode: all that is known is where each UAV starts."""

    def newest(self, uav: int) -> tuple[int, int]:
        """(tick, cell) of the newest position known of a UAV."""

    def at(self, uav: int, tick: int) -> int:
        """The cell of a UAV at a tick not later than its newest; -1 when it is not known here."""

    def publish(self, tick: int, cell: int) -> None:
        """This process's UAV stands on `cell` at `tick`."""

    def lose(self, uav: int) -> None:
        """A UAV is lost for the rest of the episode: it need not be told any more."""


class Waiting(Exception):  # noqa: N818  it is no error: it says what must be known before the UAV can go on
    """The cell of UAV `peer` at `tick` is needed."""

    def __init__(self, peer: int, tick: int) -> None:
        super().__init__(f"waiting for UAV {peer} at tick {tick}")
        self.peer, self.tick = peer, tick


class Airspace:
    """What UAV `uav` of a team must know of the others, and no more."""

    def __init__(self, uav: int, team: int, grid: Grid, sensing: float, tracks: Tracks) -> None:
        self.uav, self.grid, self.sensing, self.tracks = uav, grid, sensing, tracks
        self._peers = [j for j in range(team) if j != uav]
        self._reach = max(grid.size if math.isinf(sensing) else math.floor(sensing), 1)
        self._quiet = [0] * team
        self._lost: set[int] = set()

    def begin(self, episode: int, starts: list[int]) -> None:
        """A new episode."""
        self.tracks.begin(episode, starts)
        self._quiet = [0] * len(self._quiet)
        self._lost.clear()

    def lose(self, uav: int) -> None:
        """Never wait for this UAV again: where it is not known, it is not."""
        self._lost.add(uav)
        self.tracks.lose(uav)

    def sense(self, t: int, cell: int) -> list[int]:
        """Cells of the peers in N_i(t), in order of their ids; raises Waiting when one may be near and is unknown."""
        seen = []
        for j in self._peers:
            if t < self._quiet[j]:
                continue
            try:
                where = self._cell(j, t, cell, self._reach)
            except Waiting:
                raise Waiting(self._slowest(t, cell), t) from None
            if where >= 0 and (math.isinf(self.sensing) or self.grid.within(cell, where, self.sensing)):
                seen.append(where)
            self._quiet[j] = self._quiet_until(j, t, cell, where)
        return seen

    def held(self, t: int, cell: int, target: int) -> bool:
        """True when another UAV holds `target`: a lower id at t + 1, or a higher one at t. Raises Waiting."""
        if target == cell:
            return False
        return any(
            t + 1 >= self._quiet[j] and self._cell(j, t + (j < self.uav), target, 0) == target for j in self._peers
        )

    def _cell(self, j: int, t: int, centre: int, reach: int) -> int:
        """j's cell at t, or -1 when it is not known but surely farther than `reach` from `centre`."""
        s, newest = self.tracks.newest(j)
        where = self.tracks.at(j, t) if s >= t else -1
        if where < 0 and j not in self._lost and self.grid.chebyshev(centre, newest) - abs(t - s) <= reach:
            raise Waiting(j, t)
        return where

    def _slowest(self, t: int, cell: int) -> int:
        """Of the peers who keep this UAV from sensing at t, the one farthest back: the others will be there by then."""
        far_back = sorted((self.tracks.newest(j)[0], j) for j in self._peers if t >= self._quiet[j])
        for _, j in far_back:
            try:
                self._cell(j, t, cell, self._reach)
            except Waiting:
                return j
        return far_back[0][1]  # it has come in since

    def _quiet_until(self, j: int, t: int, cell: int, where: int) -> int:
        """The first tick at which j and this UAV, flying towards each other from now on, could be within reach."""
        s, known = (t, where) if where >= 0 else self.tracks.newest(j)
        gap = self.grid.chebyshev(cell, known) - self._reach
        return (gap + t + s + 1) // 2 if gap > 0 and s <= t else 0

    def lead(self, t: int) -> int:
        """Ticks that this UAV is ahead of the slowest peer it knows of."""
        return max((t - self.tracks.newest(j)[0] for j in self._peers), default=0)

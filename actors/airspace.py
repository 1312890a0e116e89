"""The look-ahead airspace: a UAV waits for a peer's position only when that peer could be within reach (ADR 0001).

UAV i in cell c_i needs peer j's cell at tick t' only if j could be next to it by then, that is when
`chebyshev(c_i, c_j(s_j)) - (t' - s_j) <= reach`, with c_j(s_j) the newest known cell of j. Otherwise it flies on. So
any interleaving of processes flies the same cells as the lock-step fleet.
"""

from __future__ import annotations

import math
from typing import Protocol

from tmc.kernel.grid import Grid


class Tracks(Protocol):
    """The known positions of the UAVs in the current episode, over any transport."""

    def start_episode(self, episode: int, starts: list[int]) -> None:
        """Forget all positions but the start cell of each UAV."""

    def newest(self, uav: int) -> tuple[int, int]:
        """Return (tick, cell) of the newest known position of a UAV."""

    def at(self, uav: int, tick: int) -> int:
        """Return the cell of a UAV at a tick not later than its newest; -1 when it is not known here."""

    def publish(self, tick: int, cell: int) -> None:
        """Publish that this process's UAV is on `cell` at `tick`."""

    def drop_peer(self, uav: int) -> None:
        """Send nothing more to a UAV that is lost for the rest of the episode."""


class Waiting(Exception):  # noqa: N818  not an error: it names what must be known before the UAV can move on
    """The cell of UAV `peer` at `tick` is needed."""

    def __init__(self, peer: int, tick: int) -> None:
        super().__init__(f"waiting for UAV {peer} at tick {tick}")
        self.peer, self.tick = peer, tick


class Airspace:
    """Tells UAV `uav` of a team which peers it senses and which cells are held. `sensing`: radius in cells."""

    def __init__(self, uav: int, team: int, grid: Grid, sensing: float, tracks: Tracks) -> None:
        self.uav, self.grid, self.sensing, self.tracks = uav, grid, sensing, tracks
        self._peers = [j for j in range(team) if j != uav]
        self._reach = max(grid.size if math.isinf(sensing) else math.floor(sensing), 1)
        self._clear_until = [0] * team
        self._lost: set[int] = set()

    def start_episode(self, episode: int, starts: list[int]) -> None:
        """Start an episode from the start cell of each UAV."""
        self.tracks.start_episode(episode, starts)
        self._clear_until = [0] * len(self._clear_until)
        self._lost.clear()

    def drop_peer(self, uav: int) -> None:
        """Never wait for a lost UAV again in this episode: at a tick without a known position, it is absent."""
        self._lost.add(uav)
        self.tracks.drop_peer(uav)

    def sense(self, t: int, cell: int) -> list[int]:
        """Return the cells of the peers in N_i(t), by id. Raises Waiting when a peer may be near and is unknown."""
        seen = []
        for j in self._peers:
            if t < self._clear_until[j]:
                continue
            try:
                where = self._cell(j, t, cell, self._reach)
            except Waiting:
                raise Waiting(self._slowest(t, cell), t) from None
            if where >= 0 and (math.isinf(self.sensing) or self.grid.within(cell, where, self.sensing)):
                seen.append(where)
            self._clear_until[j] = self._earliest_contact(j, t, cell, where)
        return seen

    def is_held(self, t: int, cell: int, target: int) -> bool:
        """Return whether another UAV holds `target`: a lower id at t + 1, or a higher one at t. Raises Waiting."""
        if target == cell:
            return False
        return any(
            t + 1 >= self._clear_until[j] and self._cell(j, t + (j < self.uav), target, 0) == target
            for j in self._peers
        )

    def _cell(self, j: int, t: int, centre: int, reach: int) -> int:
        """Return j's cell at t, or -1 when it is unknown but certainly farther than `reach` from `centre`."""
        s, newest = self.tracks.newest(j)
        where = self.tracks.at(j, t) if s >= t else -1
        if where < 0 and j not in self._lost and self.grid.chebyshev(centre, newest) - abs(t - s) <= reach:
            raise Waiting(j, t)
        return where

    def _slowest(self, t: int, cell: int) -> int:
        """Return the slowest peer that keeps this UAV from sensing at t: the others will be at t before it is."""
        far_back = sorted((self.tracks.newest(j)[0], j) for j in self._peers if t >= self._clear_until[j])
        for _, j in far_back:
            try:
                self._cell(j, t, cell, self._reach)
            except Waiting:
                return j
        return far_back[0][1]  # the missing position has arrived since

    def _earliest_contact(self, j: int, t: int, cell: int, where: int) -> int:
        """Return the first tick at which j and this UAV, flying towards each other, could be within reach."""
        s, known = (t, where) if where >= 0 else self.tracks.newest(j)
        gap = self.grid.chebyshev(cell, known) - self._reach
        return (gap + t + s + 1) // 2 if gap > 0 and s <= t else 0

    def lead(self, t: int) -> int:
        """Return how many ticks this UAV is ahead of its slowest peer, as far as known here."""
        return max((t - self.tracks.newest(j)[0] for j in self._peers), default=0)

"""Beacons over ZeroMQ, for UAVs that share no memory: sent to a peer only when it could need them.

Peer j, last known to be in c_j at tick s_j, was last told that this UAV was in c at tick s. By tick t the two can
have come within reach only if `chebyshev(c_j, c) - |t - s_j| - (t - s) <= reach`; until then no beacon goes out. This
mirrors the rule by which the peer waits (actors.airspace), so whoever waits is always told. Should a beacon be lost with
a process, the one that waits asks.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tmc.kernel.grid import Grid
from tmc.wire.messages import Beacon


class RadioTracks:
    """`Tracks` from beacons. `send` puts a beacon on the air; `hear` takes one that came in."""

    def __init__(self, uav: int, team: int, grid: Grid, sensing: float, send: Callable[[Beacon], None]) -> None:
        self.uav, self.team, self.grid, self._send = uav, team, grid, send
        self._reach = max(grid.size if math.isinf(sensing) else math.floor(sensing), 1)
        self._episode = 0
        self._early: list[Beacon] = []
        self.sent = 0

    def begin(self, episode: int, starts: list[int]) -> None:
        self._episode = episode
        self._known: list[dict[int, int]] = [{0: cell} for cell in starts]
        self._newest = [(0, cell) for cell in starts]
        self._told = [(0, starts[self.uav])] * self.team
        early, self._early = self._early, []
        for beacon in early:
            self.hear(beacon)

    def newest(self, uav: int) -> tuple[int, int]:
        return self._newest[uav]

    def at(self, uav: int, tick: int) -> int:
        return self._known[uav].get(tick, -1)

    def publish(self, tick: int, cell: int) -> None:
        self._known[self.uav][tick] = cell
        self._newest[self.uav] = (tick, cell)
        to = [j for j in range(self.team) if j != self.uav and self._could_matter(j, tick)]
        if to:
            self._send(self._beacon(tick, np.array([cell], "<u2"), to))
            for j in to:
                self._told[j] = (tick, cell)

    def _could_matter(self, j: int, t: int) -> bool:
        (s_j, c_j), (s, c) = self._newest[j], self._told[j]
        return self.grid.chebyshev(c_j, c) - abs(t - s_j) - (t - s) <= self._reach

    def _beacon(
        self, tick: int, cells: np.ndarray[tuple[int], np.dtype[np.uint16]], to: list[int], ask: int = -1
    ) -> Beacon:
        self.sent += 1
        return Beacon(self.uav, self._episode, tick, cells, np.array(to, "<u2"), ask)

    def ask(self, peer: int, tick: int) -> None:
        """Ask a peer for its track from `tick` on, and tell it where this UAV is."""
        t, cell = self._newest[self.uav]
        self._send(self._beacon(t, np.array([cell], "<u2"), [peer], tick))

    def hear(self, beacon: Beacon) -> None:
        """Take a peer's beacon; one of an episode that this UAV has not begun yet is kept until it has."""
        if beacon.uav >= self.team or beacon.uav == self.uav or beacon.episode < self._episode:
            return
        if beacon.episode > self._episode:
            self._early.append(beacon)
            return
        if beacon.cells.size and beacon.cells.max() >= self.grid.size:
            return
        for tick, cell in enumerate(beacon.cells.tolist(), beacon.tick):
            self._known[beacon.uav][tick] = cell
            if tick > self._newest[beacon.uav][0]:
                self._newest[beacon.uav] = (tick, cell)
        if beacon.ask >= 0:
            self._tell(beacon.uav, beacon.ask)

    def _tell(self, peer: int, tick: int) -> None:
        """The own track from `tick` on, which has no gaps unless this process was started in between."""
        own, (last, cell) = self._known[self.uav], self._newest[self.uav]
        if last < tick:
            self._told[peer] = (0, self._known[self.uav][0])  # it waits: tell it as soon as there is something
            return
        ticks = [t for t in range(tick, last + 1) if t in own]
        if ticks and ticks == list(range(ticks[0], last + 1)):
            self._send(self._beacon(ticks[0], np.array([own[t] for t in ticks], "<u2"), [peer]))
            self._told[peer] = (last, cell)

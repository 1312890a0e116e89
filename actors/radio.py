"""Beacons over ZeroMQ, for UAVs that share no memory: sent to a peer only when it could need them.

Peer j, last known to be in c_j at tick s_j, was last told that this UAV was in c at tick s. By tick t the two can
have come within reach only if `chebyshev(c_j, c) - |t - s_j| - (t - s) <= reach`; until then no beacon goes out.
This mirrors the rule by which the peer waits (actors.airspace), so whoever waits is always told. Should a beacon be
lost with a process, the one that waits asks.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tmc.kernel.grid import Grid
from tmc.wire.messages import Beacon


class RadioTracks:
    """`Tracks` from beacons. `send` puts a beacon on the air; `hear` takes one that came in.

    A beacon holds all cells since the one before it, so what is known of a track never has a gap; should a beacon get
    lost with a process, the next one shows it, and the rest is asked for.
    """

    def __init__(self, uav: int, team: int, grid: Grid, sensing: float, send: Callable[[Beacon], None]) -> None:
        self.uav, self.team, self.grid, self._send = uav, team, grid, send
        self._reach = max(grid.size if math.isinf(sensing) else math.floor(sensing), 1)
        self._episode = 0
        self._early: list[Beacon] = []

    def begin(self, episode: int, starts: list[int]) -> None:
        self._episode = episode
        self._known = [[cell] for cell in starts]
        self._told, self._lost = [0] * self.team, set[int]()
        early, self._early = self._early, []
        for beacon in early:
            self.hear(beacon)

    def newest(self, uav: int) -> tuple[int, int]:
        track = self._known[uav]
        return len(track) - 1, track[-1]

    def at(self, uav: int, tick: int) -> int:
        track = self._known[uav]
        return track[tick] if tick < len(track) else -1

    def publish(self, tick: int, cell: int) -> None:
        own = self._known[self.uav]
        if tick >= len(own):
            own.append(cell)
        by_start: dict[int, list[int]] = {}  # those who were told up to the same tick get the same beacon
        for j in range(self.team):
            if j != self.uav and j not in self._lost and self._could_matter(j, tick):
                by_start.setdefault(self._told[j] + 1, []).append(j)
        for start, to in by_start.items():
            self._tell(start, to)

    def lose(self, uav: int) -> None:
        self._lost.add(uav)

    def _could_matter(self, j: int, t: int) -> bool:
        s, (s_j, c_j) = self._told[j], self.newest(j)
        return s < t and self.grid.chebyshev(c_j, self._known[self.uav][s]) - abs(t - s_j) - (t - s) <= self._reach

    def _tell(self, start: int, to: list[int], ask: int = -1) -> None:
        """Send the own track from tick `start` on, if there is any yet."""
        own = self._known[self.uav]
        cells = np.array(own[start:], "<u2")
        self._send(Beacon(self.uav, self._episode, start, cells, np.array(to, "<u2"), ask))
        for j in to:
            self._told[j] = len(own) - 1

    def ask(self, peer: int) -> None:
        """Ask a peer for what is not known of its track, and tell it what it was not told of this UAV's."""
        self._tell(self._told[peer] + 1, [peer], len(self._known[peer]))

    def hear(self, beacon: Beacon) -> None:
        """Take a peer's beacon; one of an episode that this UAV has not begun yet is kept until it has."""
        if beacon.uav >= self.team or beacon.uav == self.uav or beacon.episode < self._episode:
            return
        if beacon.cells.size and beacon.cells.max() >= self.grid.size:
            return
        if beacon.episode > self._episode:
            self._early.append(beacon)
            return
        track = self._known[beacon.uav]
        if beacon.tick > len(track):  # one before it is lost
            self.ask(beacon.uav)
        else:
            track.extend(beacon.cells.tolist()[len(track) - beacon.tick :])
        if beacon.ask >= 0:
            self._tell(max(beacon.ask, 1), [beacon.uav])

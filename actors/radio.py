"""Beacons over ZeroMQ, for UAVs that share no memory: a beacon goes to a peer only when the peer could need it.

Peer j was last known in c_j at tick s_j, and the last beacon to it said that this UAV was in c at tick s. By tick t the
two can be within reach only if `chebyshev(c_j, c) - |t - s_j| - (t - s) <= reach`; until then no beacon goes out. This
mirrors the rule by which the peer waits (actors.airspace), so a peer that waits always gets its beacon. If a beacon is
lost with a process, the waiting UAV requests the track.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tmc.kernel.grid import Grid
from tmc.wire.messages import Beacon


class RadioTracks:
    """Implements `Tracks` with beacons: `send` sends one, `on_beacon` handles a received one.

    A beacon holds all cells since the beacon before it, so a known track never has a gap. If a beacon is lost with a
    process, the next one shows the gap, and the missing part is requested.
    """

    def __init__(self, uav: int, team: int, grid: Grid, sensing: float, send: Callable[[Beacon], None]) -> None:
        self.uav, self.team, self.grid, self._send = uav, team, grid, send
        self._reach = max(grid.size if math.isinf(sensing) else math.floor(sensing), 1)
        self._episode = 0
        self._future_beacons: list[Beacon] = []

    def start_episode(self, episode: int, starts: list[int]) -> None:
        self._episode = episode
        self._tracks = [[cell] for cell in starts]
        self._sent_up_to, self._lost = [0] * self.team, set[int]()
        early, self._future_beacons = self._future_beacons, []
        for beacon in early:
            self.on_beacon(beacon)

    def newest(self, uav: int) -> tuple[int, int]:
        track = self._tracks[uav]
        return len(track) - 1, track[-1]

    def at(self, uav: int, tick: int) -> int:
        track = self._tracks[uav]
        return track[tick] if tick < len(track) else -1

    def publish(self, tick: int, cell: int) -> None:
        own = self._tracks[self.uav]
        if tick >= len(own):
            own.append(cell)
        by_start: dict[int, list[int]] = {}  # peers that have the track up to the same tick get the same beacon
        for j in range(self.team):
            if j != self.uav and j not in self._lost and self._could_matter(j, tick):
                by_start.setdefault(self._sent_up_to[j] + 1, []).append(j)
        for start, to in by_start.items():
            self._send_track(start, to)

    def drop_peer(self, uav: int) -> None:
        self._lost.add(uav)

    def _could_matter(self, j: int, t: int) -> bool:
        s, (s_j, c_j) = self._sent_up_to[j], self.newest(j)
        return s < t and self.grid.chebyshev(c_j, self._tracks[self.uav][s]) - abs(t - s_j) - (t - s) <= self._reach

    def _send_track(self, start: int, to: list[int], ask: int = -1) -> None:
        """Send this UAV's track from tick `start` on. `ask`: request the peer's track from this tick on; -1: none."""
        own = self._tracks[self.uav]
        cells = np.array(own[start:], "<u2")
        self._send(
            Beacon(uav=self.uav, episode=self._episode, tick=start, cells=cells, to=np.array(to, "<u2"), ask=ask)
        )
        for j in to:
            self._sent_up_to[j] = len(own) - 1

    def request_track(self, peer: int) -> None:
        """Request the unknown part of a peer's track, and send it the part of this UAV's track that it lacks."""
        self._send_track(self._sent_up_to[peer] + 1, [peer], len(self._tracks[peer]))

    def on_beacon(self, beacon: Beacon) -> None:
        """Handle a peer's beacon; keep one of a later episode until this UAV starts that episode."""
        if beacon.uav >= self.team or beacon.uav == self.uav or beacon.episode < self._episode:
            return
        if beacon.cells.size and beacon.cells.max() >= self.grid.size:
            return
        if beacon.episode > self._episode:
            self._future_beacons.append(beacon)
            return
        track = self._tracks[beacon.uav]
        if beacon.tick > len(track):  # a beacon before it was lost
            self.request_track(beacon.uav)
        else:
            track.extend(beacon.cells.tolist()[len(track) - beacon.tick :])
        if beacon.ask >= 0:
            self._send_track(max(beacon.ask, 1), [beacon.uav])

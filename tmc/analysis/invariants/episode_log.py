"""The TMC's journal as evidence, episode by episode: what it says, in the order in which it says so, and unjudged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.world import World
from tmc.record import builders
from tmc.record.reader import LogMessage

UNKNOWN = -1
"""In arrays by tick and UAV: no record tells."""


@dataclass(frozen=True)
class Record:
    """One flight record, less its arrays.

    `given`: the version of the map that its UAV was given: at its last exchange, or before the episode.
    """

    uav: int
    sequence: int
    first: int
    tick: int
    version: int
    given: int


@dataclass
class Sync:
    """One exchange. `reported`: the tick of each UAV's last record before it; `lost`: the UAVs that were lost by then;
    `last_visit`: the map logged with it."""

    tick: int
    version: int
    uavs: list[int]
    believed: float
    reported: list[int]
    lost: frozenset[int]
    last_visit: NDArray[np.uint32] | None = None


@dataclass(frozen=True)
class Metrics:
    """One overfly.TeamMetrics: values from tick `first` on; steps of all UAVs so far."""

    first: int
    steps: int
    uncertainty: list[float]
    reward: list[float]


@dataclass
class Before:
    """What the episodes before have come to: next sequence by UAV, newest version, number."""

    sequence: dict[int, int] = field(default_factory=dict)
    version: int = 0
    number: int = 0

    def copy(self) -> Before:
        return Before(dict(self.sequence), self.version, self.number)


class EpisodeLog:
    """All that the journal says of one episode; T ticks, N UAVs, as the config has them.

    `cells`, `actions`, `blocks`: shape (T + 1, N), int64, UNKNOWN where no record tells; `own`: the rewards in records,
    shape (T + 1, N), float64, NaN there. A move is found at the tick at which it ends. `seen`: by UAV, the ticks and
    cells of its sightings. `lost`: UAV, and the tick of its last record, as told and as it was then. `anomalies`: what
    makes no sense: (tick, UAV, why).
    """

    def __init__(self, world: World, number: int, before: Before) -> None:
        self.world, self.number, self.before = world, number, before
        self.T, self.N = world.config.training.ticks, world.config.team.size
        shape = (self.T + 1, self.N)
        self.cells, self.actions, self.blocks = (np.full(shape, UNKNOWN, np.int64) for _ in range(3))
        self.own = np.full(shape, np.nan)
        self.seen: list[tuple[list[int], list[int]]] = [([], []) for _ in range(self.N)]
        self.records: list[Record] = []
        self.syncs: list[Sync] = []
        self.metrics: list[Metrics] = []
        self.events: list[tuple[int, int]] = []
        self.begins: list[Any] = []
        self.ends: list[Any] = []
        self.lost: list[tuple[int, int, int]] = []
        self.anomalies: list[tuple[int | None, int | None, str]] = []
        self.reported = [-1] * self.N
        self.last = True
        """Nothing follows in the journal: it may not be finished."""

    @property
    def ended(self) -> bool:
        """The TMC said that the episode was over."""
        return bool(self.ends)

    def settled(self) -> int:
        """The last tick of which the journal tells the uncertainty; -1 when of none."""
        return max((m.first + len(m.uncertainty) - 1 for m in self.metrics), default=-1)


class Gathering:
    """Sorts the messages of a journal by episode."""

    def __init__(self, world: World) -> None:
        self.world, self.before = world, Before()
        self.episode: EpisodeLog | None = None

    def episodes(self, entries: Iterable[LogMessage]) -> Iterator[EpisodeLog]:
        """One after the other, as soon as the next one begins."""
        for entry in entries:
            name = entry.message.DESCRIPTOR.full_name
            if name in _TAKERS:
                done = self._turn(entry.message.episode) if name != "foxglove.Grid" else None
                if done is not None:
                    yield done
                if self.episode is not None:
                    _TAKERS[name](self, self.episode, entry.message)
        if self.episode is not None:
            yield self.episode

    def _turn(self, number: int) -> EpisodeLog | None:
        """Turn to the episode of a message; returns the one that is over with that."""
        done = self.episode
        if done is not None and number <= done.number:
            if number < done.number:
                done.anomalies.append(
                    (None, None, f"a message of episode {number} stands among those of {done.number}")
                )
            return None
        if done is not None:
            done.last = False
            self.before.number = done.number
        self.episode = EpisodeLog(self.world, number, self.before.copy())
        return done

    def _lost(self, e: EpisodeLog, m: Any) -> None:
        if m.uav < e.N:
            e.lost.append((m.uav, m.tick, e.reported[m.uav]))
        else:
            e.anomalies.append((None, m.uav, f"it is lost, and there is none of that number in a team of {e.N}"))

    def _record(self, e: EpisodeLog, m: Any) -> None:
        anomalies = misfit(e, m)
        if anomalies:
            e.anomalies.append((m.tick, m.uav, anomalies))
            return
        before, i = self.before, m.uav
        answered = next((s.version for s in reversed(e.syncs) if i in s.uavs), e.before.version)
        e.records.append(Record(i, m.sequence, m.first, m.tick, m.version, answered))
        before.sequence[i] = m.sequence + 1
        e.reported[i] = max(e.reported[i], m.tick)
        moves = slice(max(m.first, 1), m.tick + 1)
        e.cells[m.first : m.tick + 1, i] = m.cells[:]
        e.actions[moves, i], e.blocks[moves, i], e.own[moves, i] = m.actions[:], m.blocks[:], m.rewards[:]
        e.seen[i][0].extend(m.seen_tick[:])
        e.seen[i][1].extend(m.seen_cell[:])

    def _sync(self, e: EpisodeLog, m: Any) -> None:
        e.syncs.append(
            Sync(m.tick, m.version, m.uavs[:], m.believed, list(e.reported), frozenset(i for i, *_ in e.lost))
        )
        self.before.version = m.version

    def _grid(self, e: EpisodeLog, m: Any) -> None:
        if not e.syncs or e.syncs[-1].last_visit is not None:
            e.anomalies.append((None, None, "a map stands behind no exchange"))
            return
        grid = self.world.grid
        strides = (m.column_count, m.row_stride) == (grid.cols, grid.cols * m.cell_stride)
        if not strides or len(m.data) != grid.size * m.cell_stride:
            e.anomalies.append((e.syncs[-1].tick, None, f"a map is not of {grid.rows} x {grid.cols} cells"))
            return
        e.syncs[-1].last_visit = builders.last_visit(m)

    def _metrics(self, e: EpisodeLog, m: Any) -> None:
        e.metrics.append(Metrics(m.first, m.steps, m.uncertainty[:], m.reward[:]))

    def _events(self, e: EpisodeLog, m: Any) -> None:
        e.events += zip(m.ticks[:], m.cells[:], strict=False)
        if len(m.ticks) != len(m.cells):
            e.anomalies.append((None, None, f"{len(m.ticks)} ticks of events have {len(m.cells)} cells"))

    def _episode(self, e: EpisodeLog, m: Any) -> None:
        (e.ends if m.phase == "end" else e.begins).append(m)


def misfit(e: EpisodeLog, m: Any) -> str:
    """Why a flight record cannot be put where it says; empty when it can."""
    moves, size = m.tick - max(m.first, 1) + 1, e.world.grid.size
    if m.uav >= e.N:
        return f"there is no UAV {m.uav} in a team of {e.N}"
    if not m.first <= m.tick <= e.T:
        return f"ticks {m.first}..{m.tick} are none of an episode of {e.T}"
    valued = bool(e.world.config.replay.priority_exponent) and e.world.config.team.controller == "policy"
    lengths = [len(m.cells), len(m.actions), len(m.blocks), len(m.rewards), len(m.seen_tick), len(m.values)]
    if lengths != [m.tick - m.first + 1, moves, moves, moves, len(m.seen_cell), 2 * moves * valued]:
        return "its arrays do not match its ticks"
    if max(m.cells) >= size or max(m.seen_cell, default=0) >= size:
        return "a cell is off the grid"
    if max(m.actions, default=0) > 8 or max(m.blocks, default=0) > 3:
        return "an action or a block is unknown"
    return ""


_TAKERS: dict[str, Callable[[Gathering, EpisodeLog, Any], None]] = {
    "overfly.FlightRecord": Gathering._record,
    "overfly.Lost": Gathering._lost,
    "overfly.Sync": Gathering._sync,
    "foxglove.Grid": Gathering._grid,
    "overfly.TeamMetrics": Gathering._metrics,
    "overfly.Events": Gathering._events,
    "overfly.Episode": Gathering._episode,
}

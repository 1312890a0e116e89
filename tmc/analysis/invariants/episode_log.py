"""Read the TMC's journal episode by episode, in its order, without checking it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.world import World
from tmc.record import builders, overfly_pb2
from tmc.record.reader import LogMessage

if TYPE_CHECKING:
    from foxglove_schemas_protobuf.Grid_pb2 import Grid

UNKNOWN = -1
"""In arrays by tick and UAV: no record holds the value."""


@dataclass(frozen=True)
class RecordHead:
    """One flight record without its arrays.

    `version`: of the map in the record. `given`: of the map that the UAV got last, at an exchange or
    before the episode.
    """

    uav: int
    sequence: int
    first: int
    tick: int
    version: int
    given: int


@dataclass
class Sync:
    """One exchange.

    `reported`: tick of each UAV's last record before it. `lost`: the UAVs that were lost by then. `last_visit`: the map
    that was logged with it, shape (K,), ticks.
    """

    tick: int
    version: int
    uavs: list[int]
    believed: float
    reported: list[int]
    lost: frozenset[int]
    last_visit: NDArray[np.uint32] | None = None


@dataclass(frozen=True)
class Metrics:
    """One overfly.TeamMetrics: values from tick `first` on, and steps of all UAVs so far."""

    first: int
    steps: int
    uncertainty: list[float]
    reward: list[float]


@dataclass
class Before:
    """The state after the episodes before: next sequence number by UAV, newest map version, number of the last one."""

    sequence: dict[int, int] = field(default_factory=dict)
    version: int = 0
    number: int = 0

    def copy(self) -> Before:
        """Return a copy that can change without this one."""
        return Before(dict(self.sequence), self.version, self.number)


class EpisodeLog:
    """The content of the journal for one episode; T ticks and N UAVs by the config.

    `cells`, `actions`, `blocks`: shape (T + 1, N), int64; UNKNOWN where no record holds the value.
    `own`: the rewards in the records, shape (T + 1, N), float64; NaN where no record holds one.
    A move is stored at the tick at which it ends.
    `seen`: by UAV, the ticks and cells of its sightings.
    `lost`: (UAV, tick of its last record as logged, tick of its last record in the journal).
    `anomalies`: messages that cannot be right: (tick, UAV, why).
    """

    def __init__(self, world: World, number: int, before: Before) -> None:
        self.world, self.number, self.before = world, number, before
        self.T, self.N = world.config.training.ticks, world.config.team.size
        shape = (self.T + 1, self.N)
        self.cells, self.actions, self.blocks = (np.full(shape, UNKNOWN, np.int64) for _ in range(3))
        self.own = np.full(shape, np.nan)
        self.seen: list[tuple[list[int], list[int]]] = [([], []) for _ in range(self.N)]
        self.records: list[RecordHead] = []
        self.syncs: list[Sync] = []
        self.metrics: list[Metrics] = []
        self.events: list[tuple[int, int]] = []
        self.begins: list[overfly_pb2.Episode] = []
        self.ends: list[overfly_pb2.Episode] = []
        self.lost: list[tuple[int, int, int]] = []
        self.anomalies: list[tuple[int | None, int | None, str]] = []
        self.reported = [-1] * self.N
        self.last = True
        """True when no episode follows in the journal: then this one may not be finished."""

    @property
    def ended(self) -> bool:
        """True when the TMC logged the end of the episode."""
        return bool(self.ends)

    def last_final(self) -> int:
        """Return the last tick whose uncertainty is in the journal; -1 when there is none."""
        return max((m.first + len(m.uncertainty) - 1 for m in self.metrics), default=-1)


class EpisodeCollector:
    """Sort the messages of a journal by episode."""

    def __init__(self, world: World) -> None:
        self.world, self.before = world, Before()
        self.episode: EpisodeLog | None = None

    def episodes(self, entries: Iterable[LogMessage]) -> Iterator[EpisodeLog]:
        """Yield the episodes, each as soon as the next one begins."""
        for entry in entries:
            name = entry.message.DESCRIPTOR.full_name
            if name in _HANDLERS:
                number = getattr(entry.message, "episode", None)  # a map belongs to the exchange before it
                done = None if number is None else self._turn(number)
                if done is not None:
                    yield done
                if self.episode is not None:
                    _HANDLERS[name](self, self.episode, entry.message)
        if self.episode is not None:
            yield self.episode

    def _turn(self, number: int) -> EpisodeLog | None:
        """Switch to the episode of a message; return the one that is complete by that, or None."""
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

    def _lost(self, e: EpisodeLog, m: overfly_pb2.Lost) -> None:
        if m.uav < e.N:
            e.lost.append((m.uav, m.tick, e.reported[m.uav]))
        else:
            e.anomalies.append((None, m.uav, f"it is lost, but a team of {e.N} has no UAV of this number"))

    def _record(self, e: EpisodeLog, m: overfly_pb2.FlightRecord) -> None:
        why = misfit(e, m)
        if why:
            e.anomalies.append((m.tick, m.uav, why))
            return
        before, i = self.before, m.uav
        answered = next((s.version for s in reversed(e.syncs) if i in s.uavs), e.before.version)
        e.records.append(RecordHead(i, m.sequence, m.first, m.tick, m.version, answered))
        before.sequence[i] = m.sequence + 1
        e.reported[i] = max(e.reported[i], m.tick)
        moves = slice(max(m.first, 1), m.tick + 1)
        e.cells[m.first : m.tick + 1, i] = m.cells[:]
        e.actions[moves, i], e.blocks[moves, i], e.own[moves, i] = m.actions[:], m.blocks[:], m.rewards[:]
        e.seen[i][0].extend(m.seen_tick[:])
        e.seen[i][1].extend(m.seen_cell[:])

    def _sync(self, e: EpisodeLog, m: overfly_pb2.Sync) -> None:
        e.syncs.append(
            Sync(m.tick, m.version, m.uavs[:], m.believed, list(e.reported), frozenset(i for i, *_ in e.lost))
        )
        self.before.version = m.version

    def _grid(self, e: EpisodeLog, m: Grid) -> None:
        if not e.syncs or e.syncs[-1].last_visit is not None:
            e.anomalies.append((None, None, "a map does not follow an exchange"))
            return
        grid = self.world.grid
        strides = (m.column_count, m.row_stride) == (grid.cols, grid.cols * m.cell_stride)
        if not strides or len(m.data) != grid.size * m.cell_stride:
            e.anomalies.append((e.syncs[-1].tick, None, f"a map is not of {grid.rows} x {grid.cols} cells"))
            return
        e.syncs[-1].last_visit = builders.last_visit(m)

    def _metrics(self, e: EpisodeLog, m: overfly_pb2.TeamMetrics) -> None:
        e.metrics.append(Metrics(m.first, m.steps, m.uncertainty[:], m.reward[:]))

    def _events(self, e: EpisodeLog, m: overfly_pb2.Events) -> None:
        e.events += zip(m.ticks[:], m.cells[:], strict=False)
        if len(m.ticks) != len(m.cells):
            e.anomalies.append((None, None, f"{len(m.ticks)} ticks of events have {len(m.cells)} cells"))

    def _episode(self, e: EpisodeLog, m: overfly_pb2.Episode) -> None:
        (e.ends if m.phase == "end" else e.begins).append(m)


def misfit(e: EpisodeLog, m: overfly_pb2.FlightRecord) -> str:
    """Return why a flight record does not fit the episode; empty when it does."""
    moves, size = m.tick - max(m.first, 1) + 1, e.world.grid.size
    if m.uav >= e.N:
        return f"there is no UAV {m.uav} in a team of {e.N}"
    if not m.first <= m.tick <= e.T:
        return f"ticks {m.first}..{m.tick} do not lie in an episode of {e.T} ticks"
    valued = bool(e.world.config.replay.priority_exponent) and e.world.config.team.controller == "policy"
    lengths = [len(m.cells), len(m.actions), len(m.blocks), len(m.rewards), len(m.seen_tick), len(m.values)]
    if lengths != [m.tick - m.first + 1, moves, moves, moves, len(m.seen_cell), 2 * moves * valued]:
        return "its arrays do not match its ticks"
    if max(m.cells) >= size or max(m.seen_cell, default=0) >= size:
        return "a cell is off the grid"
    if max(m.actions, default=0) > 8 or max(m.blocks, default=0) > 3:
        return "an action or a block is unknown"
    return ""


_HANDLERS: dict[str, Callable[[EpisodeCollector, EpisodeLog, Any], None]] = {
    "overfly.FlightRecord": EpisodeCollector._record,
    "overfly.Lost": EpisodeCollector._lost,
    "overfly.Sync": EpisodeCollector._sync,
    "foxglove.Grid": EpisodeCollector._grid,
    "overfly.TeamMetrics": EpisodeCollector._metrics,
    "overfly.Events": EpisodeCollector._events,
    "overfly.Episode": EpisodeCollector._episode,
}

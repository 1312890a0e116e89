"""Compare the logs of two runs of one mission, and find the first fact that differs, with its tick and its UAV.

What depends on the timing of the processes is not compared: wall times, the incarnations of processes, and how many
ticks one message holds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from tmc.record import builders
from tmc.record.errors import RecordError
from tmc.record.overfly_pb2 import Episode, Events, FlightRecord, ObservationHashes, Sync, TeamMetrics
from tmc.record.reader import Log, decode
from tmc.record.run_folder import run_files
from tmc.record.schemas import foxglove

TEAM = -1
"""The UAV number in facts of the whole team."""
KINDS: tuple[str, ...] = (
    "begin of the episode", "cell", "block", "own reward", "sightings", "record", "events", "uncertainty",
    "team's reward", "sync reply", "map handed out", "observation", "action", "end of the episode",
)  # fmt: skip
"""What is compared, causes before effects within a tick."""
_RANK = {kind: rank for rank, kind in enumerate(KINDS)}

Key = tuple[int, int, int, int]
"""(episode, tick, index in KINDS, UAV). In this order, the first difference is the cause of the others."""
Value = int | float | bytes | tuple[Any, ...]
Keyed = Iterator[tuple[Key, Value]]
Facts = Mapping[Key, Value]


@dataclass(frozen=True)
class Difference:
    """A fact that differs. `first`, `second`: its values in the two logs, in words."""

    what: str
    episode: int
    tick: int
    uav: int
    first: str
    second: str

    def __str__(self) -> str:
        owner = "" if self.uav == TEAM else f" of UAV {self.uav}"
        return f"{self.what}{owner} at tick {self.tick} of episode {self.episode}: {self.first} against {self.second}"


def facts_of(folder: str | os.PathLike[str]) -> dict[Key, Value]:
    """Return every fact in the logs of a run; RecordError when a log is damaged or contradicts itself."""
    facts: dict[Key, Value] = {}
    for path in run_files(folder).values():
        log = Log(path)
        for key, value in _read(log):
            if facts.setdefault(key, value) != value:
                raise RecordError(f"{path} contradicts itself: {_difference(key, facts[key], value)}")
        if log.damage:
            raise RecordError(f"{path} cannot be compared: {log.damage}")
    return facts


def first_difference(first: Facts, second: Facts) -> Difference | None:
    """Return the earliest fact that differs, or None when all are equal."""
    if first == second:
        return None
    key = min(k for k in first.keys() | second.keys() if first.get(k) != second.get(k))
    return _difference(key, first.get(key), second.get(key))


def moves(facts: Facts) -> int:
    """Return the number of moves of UAVs in the facts."""
    return sum(rank == _RANK["action"] for _, _, rank, _ in facts)


def cell(facts: Facts, episode: int, tick: int, uav: int) -> int:
    """Return the cell of a UAV at a tick; KeyError when the facts do not hold it."""
    return int(facts[episode, tick, _RANK["cell"], uav])  # type: ignore[arg-type]  # cells are integers


def _difference(key: Key, first: Value | None, second: Value | None) -> Difference:
    episode, tick, rank, uav = key
    if isinstance(first, bytes) and isinstance(second, bytes) and len(first) == len(second):
        a, b = np.frombuffer(first, "<u4"), np.frombuffer(second, "<u4")
        k = int(np.flatnonzero(a != b)[0])
        return Difference(KINDS[rank], episode, tick, uav, f"cell {k} visited at tick {a[k]}", f"at tick {b[k]}")
    return Difference(KINDS[rank], episode, tick, uav, _words(first), _words(second))


def _words(value: Value | None) -> str:
    if isinstance(value, bytes):
        return f"a map of {len(value) // 4} cells"
    return "nothing" if value is None else repr(value)


def _read(log: Log) -> Keyed:
    at = (0, 0)
    for raw in log.raw():
        if raw.schema == "foxglove.Grid":  # the map of the sync reply before it
            grid = decode(raw, foxglove("Grid").Grid)
            yield (*at, _RANK["map handed out"], TEAM), builders.last_visit(grid).tobytes()
            continue
        message = decode(raw)
        if raw.schema in _READERS:
            yield from _READERS[raw.schema](message)
        if isinstance(message, Sync):
            at = (message.episode, message.tick)


def _record(r: FlightRecord) -> Keyed:
    e, i = r.episode, r.uav
    start = max(r.first, 1)
    yield (e, r.tick, _RANK["record"], i), (r.sequence, r.first, r.version, r.policy)
    yield from (((e, t, _RANK["cell"], i), cell) for t, cell in enumerate(r.cells[:], r.first))
    yield from (((e, t, _RANK["block"], i), block) for t, block in enumerate(r.blocks[:], start))
    yield from (((e, t, _RANK["own reward"], i), reward) for t, reward in enumerate(r.rewards[:], start))
    yield from (((e, t, _RANK["action"], i), action) for t, action in enumerate(r.actions[:], start - 1))
    for t, seen in groupby(zip(r.seen_tick[:], r.seen_cell[:], strict=True), key=lambda pair: pair[0]):
        yield (e, t, _RANK["sightings"], i), tuple(cell for _, cell in seen)


def _sync(s: Sync) -> Keyed:
    yield (s.episode, s.tick, _RANK["sync reply"], TEAM), (s.version, s.policy, *s.uavs[:], s.believed)


def _metrics(m: TeamMetrics) -> Keyed:
    for kind, values in (("uncertainty", m.uncertainty[:]), ("team's reward", m.reward[:])):
        yield from (((m.episode, t, _RANK[kind], TEAM), value) for t, value in enumerate(values, m.first))


def _events(m: Events) -> Keyed:
    for t, events in groupby(zip(m.ticks[:], m.cells[:], strict=True), key=lambda pair: pair[0]):
        yield (m.episode, t, _RANK["events"], TEAM), tuple(cell for _, cell in events)


def _episode(m: Episode) -> Keyed:
    values = tuple((field.name, _plain(value)) for field, value in m.ListFields())
    yield (m.episode, m.ticks, _RANK[f"{m.phase} of the episode"], TEAM), values


def _plain(value: Any) -> Any:
    return value if isinstance(value, int | float | str) else tuple(value)


def _hashes(m: ObservationHashes) -> Keyed:
    first = max(m.first, 1) - 1
    yield from (((m.episode, t, _RANK["observation"], m.uav), value) for t, value in enumerate(m.hashes[:], first))


_READERS: dict[str, Callable[[Any], Keyed]] = {
    "overfly.FlightRecord": _record,
    "overfly.Sync": _sync,
    "overfly.TeamMetrics": _metrics,
    "overfly.Events": _events,
    "overfly.Episode": _episode,
    "overfly.ObservationHashes": _hashes,
}

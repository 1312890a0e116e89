"""Query a run, from `tmc.mcap` alone: the cells of the UAVs, the uncertainty of the true map, and the events.

Delivery is at least once and services restart, so repeats are dropped here. A log that contradicts itself is refused.
A damaged log is read up to the damage, which `Log.damage` reports.
"""

from __future__ import annotations

import hashlib
import os
from array import array
from collections import defaultdict
from collections.abc import Collection, Iterator
from typing import TypeVar

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from tmc.record.errors import RecordError
from tmc.record.overfly_pb2 import Episode, Events, FlightRecord, TeamMetrics
from tmc.record.reader import Log
from tmc.record.run_folder import tmc_log

Folder = str | os.PathLike[str]
M = TypeVar("M", bound=Message)
_UNKNOWN = -1


def messages(folder: Folder, *kinds: type[M]) -> Iterator[M]:
    """Return the messages of these types in tmc.mcap, in the order of the log."""
    return Log(tmc_log(folder)).messages(*kinds)


class Tracks:
    """The cells of all UAVs in one episode, tick by tick. Memory: four bytes per move."""

    def __init__(self, episode: int) -> None:
        self.episode = episode
        self._cells: dict[int, array[int]] = {}

    def add(self, record: FlightRecord) -> None:
        """Add an overfly.FlightRecord; RecordError when it contradicts the cells of an earlier one."""
        cells = self._cells.setdefault(record.uav, array("i"))
        new, first = record.cells[:], record.first
        cells.extend([_UNKNOWN] * (first + len(new) - len(cells)))
        for tick, cell in enumerate(new, start=first):
            if cells[tick] not in (_UNKNOWN, cell):
                raise RecordError(
                    f"two records disagree where UAV {record.uav} was at tick {tick} of episode {self.episode}: "
                    "the log mixes two runs, so use neither"
                )
            cells[tick] = cell

    def rows(self) -> NDArray[np.uint32]:
        """Return (tick, uav, cell) in order of tick and uav; shape (moves, 3), uint32."""
        parts = [np.zeros((0, 3), np.int64)]
        for uav, track in sorted(self._cells.items()):
            cells = np.array(track, np.int64)
            ticks = np.flatnonzero(cells != _UNKNOWN)
            parts.append(np.stack((ticks, np.full_like(ticks, uav), cells[ticks]), axis=1))
        rows = np.concatenate(parts)
        return rows[np.argsort(rows[:, 0], kind="stable")].astype(np.uint32)


def tracks(folder: Folder) -> dict[int, Tracks]:
    """Return {episode: tracks} of all flight records, in order of the episodes. A (uav, sequence) counts once."""
    found: dict[int, Tracks] = {}
    known: dict[int, set[int]] = defaultdict(set)
    for record in messages(folder, FlightRecord):
        if record.sequence not in known[record.uav]:
            known[record.uav].add(record.sequence)
            found.setdefault(record.episode, Tracks(record.episode)).add(record)
    return dict(sorted(found.items()))


def moves(folder: Folder, episode: int) -> Iterator[tuple[int, int, int]]:
    """Return (tick, uav, cell) for ticks 0..T, in order of tick and uav. RecordError for an unknown episode."""
    found = tracks(folder)
    _check_known(folder, episode, found)
    return ((t, uav, cell) for t, uav, cell in found[episode].rows().tolist())


def digest(folder: Folder) -> str:
    """Return the SHA-256 (hex) of all (episode, tick, uav, cell), sorted, as little-endian uint32.

    Two runs with the same digest flew the same cells at the same ticks.
    """
    sha = hashlib.sha256()
    for episode, found in tracks(folder).items():
        rows = found.rows()
        sha.update(np.insert(rows, 0, episode, axis=1).astype("<u4").tobytes())
    return sha.hexdigest()


def uncertainty(folder: Folder, episode: int) -> Iterator[tuple[int, float]]:
    """Return (tick, sum over cells of the uncertainty of the true map), in order of tick. Raises RecordError."""
    values: dict[int, dict[int, float]] = defaultdict(dict)
    for m in messages(folder, TeamMetrics):
        values[m.episode].update(enumerate(m.uncertainty[:], start=m.first))
    _check_known(folder, episode, values)
    return iter(sorted(values[episode].items()))


def events(folder: Folder, episode: int) -> Iterator[tuple[int, int]]:
    """Return (tick, cell) of each event of scenario I, in that order; nothing in scenario II. Raises RecordError."""
    found: dict[int, set[tuple[int, int]]] = defaultdict(set)
    found_messages: Iterator[Events | Episode] = messages(folder, Events, Episode)
    for m in found_messages:
        events_found = found[m.episode]
        if isinstance(m, Events):
            events_found.update(zip(m.ticks[:], m.cells[:], strict=True))
    _check_known(folder, episode, found)
    return iter(sorted(found[episode]))


def episodes(folder: Folder) -> list[Episode]:
    """Return the overfly.Episode messages, in the order of the log."""
    return list(messages(folder, Episode))


def _check_known(folder: Folder, episode: int, known: Collection[int]) -> None:
    if episode not in known:
        raise RecordError(f"{folder} holds nothing of episode {episode}: ask for one of {_ranges(known)}")


def _ranges(numbers: Collection[int]) -> str:
    """Return numbers in words: `1 to 3, 7`."""
    spans: list[list[int]] = []
    for n in sorted(numbers):
        if spans and n == spans[-1][1] + 1:
            spans[-1][1] = n
        else:
            spans.append([n, n])
    return ", ".join(f"{a} to {b}" if b > a else f"{a}" for a, b in spans) or "those that are flown from now on"

"""Two ways to know where the others are: one table in memory that several processes map, or one in this process alone.

A slot holds (episode, tick, cell) in one 64-bit word, so a reader can tell by the word alone whether it is the one it
wants: no lock, no order of writes to rely on. A UAV writes only its own row, and a process that is started again
writes the same words again.
"""

from __future__ import annotations

import mmap
import os
from pathlib import Path


class TrackTable:
    """The rows of all UAVs: N x (T_ep + 2) words, of which the first of each row is the newest position."""

    def __init__(self, team: int, ticks: int, memory: memoryview | None = None) -> None:
        self.team, self.width = team, ticks + 2
        self.words = memory if memory is not None else memoryview(bytearray(8 * team * self.width)).cast("Q")


def create_table(path: Path, team: int, ticks: int) -> None:
    """A table file of zeros, which other processes then open; refuses a path that exists."""
    with path.open("xb") as file:
        file.truncate(8 * team * (ticks + 2))


def open_table(path: Path, team: int, ticks: int) -> TrackTable:
    """Map the table that the TMC made; raises OSError or ValueError when it is not there or has another size."""
    with path.open("r+b") as file:
        size = os.fstat(file.fileno()).st_size
        if size != 8 * team * (ticks + 2):
            raise ValueError(f"the track table {path} has {size} bytes, expected {8 * team * (ticks + 2)}")
        return TrackTable(team, ticks, memoryview(mmap.mmap(file.fileno(), size)).cast("Q"))


class TableTracks:
    """`Tracks` over a table, for UAV `uav`."""

    def __init__(self, table: TrackTable, uav: int) -> None:
        self._words, self._width = table.words, table.width
        self._row = uav * table.width
        self._episode = 0
        self._starts: list[int] = []

    def begin(self, episode: int, starts: list[int]) -> None:
        self._episode, self._starts = episode << 32, starts

    def newest(self, uav: int) -> tuple[int, int]:
        word = self._words[uav * self._width]
        if word < self._episode:  # still in the episode before
            return 0, self._starts[uav]
        return (word >> 16) & 0xFFFF, word & 0xFFFF

    def at(self, uav: int, tick: int) -> int:
        if tick == 0:
            return self._starts[uav]
        word = self._words[uav * self._width + 1 + tick]
        return word & 0xFFFF if word >> 16 == (self._episode | tick << 16) >> 16 else -1

    def publish(self, tick: int, cell: int) -> None:
        word = self._episode | tick << 16 | cell
        self._words[self._row + 1 + tick] = word
        self._words[self._row] = word

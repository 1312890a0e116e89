"""Two ways to know where the others are: one table in memory that several processes map, or one in this process alone.

A slot holds (episode, tick, cell) in one 64-bit word, so a reader can tell by the word alone whether it is the one it
wants: no lock, no order of writes to rely on. A UAV writes only its own row, and a process that is started again
writes the same words again. Whoever waits for a UAV says in that row for which tick, and is woken when it is there.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
from pathlib import Path
from typing import IO

from actors import futex

_HEAD = 2
"""Words of a row before its slots: the newest position, and the first tick that somebody waits for (0: nobody does)."""

_NOT_KNOWN = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)
"""Errors of a file system that cannot reserve room: there, zeros are written."""
_PIECE = 2**20


class TrackTable:
    """The rows of all UAVs: N x (T_ep + 3) words, of which the first two are its head, then one a tick."""

    def __init__(self, team: int, ticks: int, memory: memoryview | None = None) -> None:
        self.team, self.width = team, ticks + 1 + _HEAD
        self.words = (memory if memory is not None else memoryview(bytearray(8 * team * self.width))).cast("Q")
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self.words))


def create_table(path: Path, team: int, ticks: int) -> None:
    """A table file of zeros, which other processes then open; refuses a path that exists. OSError without the room.

    Its room is taken now: a process that writes into a page for which there is none is killed by SIGBUS.
    """
    with path.open("xb") as file:
        reserve(file, table_bytes(team, ticks))


def reserve(file: IO[bytes], size: int) -> None:
    """Give a new file so many bytes of zeros, and the room that they take."""
    try:
        os.posix_fallocate(file.fileno(), 0, size)
    except (AttributeError, OSError) as error:
        if getattr(error, "errno", errno.EOPNOTSUPP) not in _NOT_KNOWN:
            raise
        for first in range(0, size, _PIECE):
            file.write(bytes(min(_PIECE, size - first)))


def open_table(path: Path, team: int, ticks: int) -> TrackTable:
    """Map the table that the TMC made; raises OSError or ValueError when it is not there or has another size."""
    with path.open("r+b") as file:
        size = os.fstat(file.fileno()).st_size
        if size != table_bytes(team, ticks):
            raise ValueError(f"the track table {path} has {size} bytes, expected {table_bytes(team, ticks)}")
        return TrackTable(team, ticks, memoryview(mmap.mmap(file.fileno(), size)))


def table_bytes(team: int, ticks: int) -> int:
    """The size of a table."""
    return 8 * team * (ticks + 1 + _HEAD)


class TableTracks:
    """`Tracks` over a table, for UAV `uav`."""

    def __init__(self, table: TrackTable, uav: int) -> None:
        self._words, self._width, self._address = table.words, table.width, table.address
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
        word = self._words[uav * self._width + _HEAD + tick]
        return word & 0xFFFF if word >> 16 == (self._episode | tick << 16) >> 16 else -1

    def publish(self, tick: int, cell: int) -> None:
        words, row = self._words, self._row
        word = self._episode | tick << 16 | cell
        words[row + _HEAD + tick] = word
        words[row] = word
        if 0 < words[row + 1] <= word:
            words[row + 1] = 0
            futex.wake(self._address + 8 * row)

    def lose(self, uav: int) -> None:
        """Nobody is told anything here."""

    def wait(self, uav: int, tick: int, seconds: float) -> None:
        """Sleep until another UAV has published `tick`, at most so many seconds; may return early, so look again.

        What two who start to wait for the same UAV at the same time write can hide one from the other: the one
        that is not woken wakes by the time.
        """
        words, row = self._words, uav * self._width
        known, wanted = words[row], self._episode | tick << 16
        if known >= wanted:
            return
        if not 0 < words[row + 1] <= wanted:
            words[row + 1] = wanted
        futex.wait(self._address + 8 * row, known & 0xFFFF_FFFF, seconds)

"""The track table: all positions of an episode in memory, shared by several processes or private to one.

A slot holds (episode, tick, cell) in one 64-bit word, so a reader sees by the word alone whether it is the one it
needs: there is no lock, and no order of writes to rely on. A UAV writes only its own row; a restarted process writes
the same words again. A UAV that waits for another writes the tick into that UAV's row, and is woken when it is there.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
from pathlib import Path
from typing import IO

from actors import futex

_HEAD_WORDS = 2
"""Words of a row before its slots: the newest position, and the first tick that a peer waits for (0: none)."""

_UNSUPPORTED = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)
"""Errors of a file system that cannot reserve space: there, zeros are written."""
_CHUNK_BYTES = 2**20
"""Most bytes of one write of zeros."""


class TrackTable:
    """The rows of all UAVs: N x (T_ep + 3) words of 64 bits; a row has two head words, then one word per tick."""

    def __init__(self, team: int, ticks: int, memory: memoryview | None = None) -> None:
        self.team, self.width = team, ticks + 1 + _HEAD_WORDS
        self.words = (memory if memory is not None else memoryview(bytearray(8 * team * self.width))).cast("Q")
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self.words))


def create_table(path: Path, team: int, ticks: int) -> None:
    """Create a table file of zeros, for other processes to open. Raises OSError if it exists or has no space.

    Its space is reserved now, because a process that writes to a page without space is killed by SIGBUS.
    """
    with path.open("xb") as file:
        reserve(file, table_bytes(team, ticks))


def reserve(file: IO[bytes], size: int) -> None:
    """Fill a new file with `size` bytes of zeros whose disk space is reserved. Raises OSError."""
    try:
        os.posix_fallocate(file.fileno(), 0, size)
    except (AttributeError, OSError) as error:
        if getattr(error, "errno", errno.EOPNOTSUPP) not in _UNSUPPORTED:
            raise
        for first in range(0, size, _CHUNK_BYTES):
            file.write(bytes(min(_CHUNK_BYTES, size - first)))


def open_table(path: Path, team: int, ticks: int) -> TrackTable:
    """Map the table that the TMC made. Raises OSError if it is missing, ValueError if it has another size."""
    with path.open("r+b") as file:
        size = os.fstat(file.fileno()).st_size
        if size != table_bytes(team, ticks):
            raise ValueError(f"the track table {path} has {size} bytes, expected {table_bytes(team, ticks)}")
        return TrackTable(team, ticks, memoryview(mmap.mmap(file.fileno(), size)))


def table_bytes(team: int, ticks: int) -> int:
    """Return the size of a table in bytes."""
    return 8 * team * (ticks + 1 + _HEAD_WORDS)


class TableTracks:
    """Implements `Tracks` with a table, for UAV `uav`."""

    def __init__(self, table: TrackTable, uav: int) -> None:
        self._words, self._width, self._address = table.words, table.width, table.address
        self._row = uav * table.width
        self._episode = 0
        self._starts: list[int] = []

    def start_episode(self, episode: int, starts: list[int]) -> None:
        self._episode, self._starts = episode << 32, starts

    def newest(self, uav: int) -> tuple[int, int]:
        word = self._words[uav * self._width]
        if word < self._episode:  # the UAV is still in the previous episode
            return 0, self._starts[uav]
        return (word >> 16) & 0xFFFF, word & 0xFFFF

    def at(self, uav: int, tick: int) -> int:
        if tick == 0:
            return self._starts[uav]
        word = self._words[uav * self._width + _HEAD_WORDS + tick]
        return word & 0xFFFF if word >> 16 == (self._episode | tick << 16) >> 16 else -1

    def publish(self, tick: int, cell: int) -> None:
        words, row = self._words, self._row
        word = self._episode | tick << 16 | cell
        words[row + _HEAD_WORDS + tick] = word
        words[row] = word
        if 0 < words[row + 1] <= word:
            words[row + 1] = 0
            futex.wake(self._address + 8 * row)

    def drop_peer(self, uav: int) -> None:
        """Do nothing: nothing is sent here."""

    def wait(self, uav: int, tick: int, seconds: float) -> None:
        """Sleep until another UAV has published `tick`, at most `seconds`. May return early, so check again.

        Two UAVs that start to wait for the same UAV at the same time may overwrite each other's tick. The one that is
        not woken then returns when its time is up.
        """
        words, row = self._words, uav * self._width
        known, wanted = words[row], self._episode | tick << 16
        if known >= wanted:
            return
        if not 0 < words[row + 1] <= wanted:
            words[row + 1] = wanted
        futex.wait(self._address + 8 * row, known & 0xFFFF_FFFF, seconds)

"""One line of progress on stderr: overwritten on a terminal, printed now and then elsewhere."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from typing import Self, TextIO

from tmc.kernel.text import printable

TERMINAL_EVERY_S, PLAIN_EVERY_S = 0.2, 5.0
"""Time (s) between two lines on a terminal, and elsewhere."""
BETWEEN = " · "

Part = tuple[int, str]
"""A part of the line, with its rank: on a narrow terminal, the part of the largest rank is left out first."""


class Line:
    """Shows progress; as a context manager, clears the line at its end.

    It never raises: a stderr that is closed, full or gone must not fail the work. `delay`: time (s) before the first
    line, so that short work shows none.
    """

    def __init__(self, out: TextIO | None = None, delay: float = 0.0) -> None:
        self._out = out or sys.stderr
        self._terminal, self._width = False, 0
        with suppress(OSError, ValueError, AttributeError):  # AttributeError: closed before Python started
            self._terminal = self._out.isatty()
        self._next = time.monotonic() + delay

    def due(self) -> bool:
        """Return whether it is time for the next line."""
        return time.monotonic() >= self._next

    def show(self, *parts: Part | str) -> None:
        """Show a line, if one is due."""
        if self.due():
            self._next = time.monotonic() + (TERMINAL_EVERY_S if self._terminal else PLAIN_EVERY_S)
            ranked = [part if isinstance(part, tuple) else (0, part) for part in parts]
            if self._terminal:
                self._write_over(fit(ranked, columns(self._out) - 1))
            else:
                self._put(fit(ranked, 0) + "\n")

    def share(self, what: str, share: float) -> None:
        """Show which share in [0, 1] of something is done, if a line is due."""
        self.show(f"{what}: {share:.0%}")

    def print(self, text: str) -> None:
        """Print a line that stays."""
        self.clear()
        self._put(printable(text) + "\n")

    def clear(self) -> None:
        """Erase the line of progress, to make room for one that stays."""
        if self._terminal and self._width:
            self._write_over("")
            self._put("\r")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def _write_over(self, text: str) -> None:
        """Overwrite the line, padded by spaces, since not every terminal can erase; not beyond the terminal's width."""
        room = columns(self._out) - 1
        width = self._width if room <= 0 else min(self._width, room)
        self._put("\r" + text.ljust(width))
        self._width = len(text)

    def _put(self, text: str) -> None:
        with suppress(OSError, ValueError, AttributeError):
            self._out.write(text)
            self._out.flush()


def fit(parts: list[Part], room: int) -> str:
    """Return the parts as one line of at most `room` characters, without those of the largest ranks; 0: no limit."""
    kept = [(rank, printable(text)) for rank, text in parts]
    while (text := BETWEEN.join(text for _, text in kept)) and 0 < room < len(text) and len(kept) > 1:
        kept.remove(max(kept))
    return text[:room] if room > 0 else text


def columns(out: TextIO) -> int:
    """Return the current width of the terminal, 0 if unknown. The environment variable COLUMNS takes precedence."""
    with suppress(ValueError):
        if (chosen := int(os.environ.get("COLUMNS", ""))) > 0:
            return chosen
    with suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(out.fileno()).columns
    return 0

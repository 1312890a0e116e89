"""One line on stderr that tells how far the work is: written over on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from typing import Self, TextIO

from tmc.kernel.text import printable

TERMINAL_EVERY_S, PLAIN_EVERY_S = 0.2, 5.0
"""Time between two lines on a terminal, and where the output is none."""
BETWEEN = " · "

Part = tuple[int, str]
"""A piece of the line, and its rank: where the terminal is narrow, that of the largest number is left out first."""


class Line:
    """Never raises: a stderr that is closed, full or gone must not fail the work.

    A context that clears the line at its end. `delay`: seconds before the first, so that what is done at once says
    nothing.
    """

    def __init__(self, out: TextIO | None = None, delay: float = 0.0) -> None:
        self._out = out or sys.stderr
        self._terminal, self._width = False, 0
        with suppress(OSError, ValueError, AttributeError):  # AttributeError: closed before Python started
            self._terminal = self._out.isatty()
        self._next = time.monotonic() + delay

    def due(self) -> bool:
        """True when it is time for the next line."""
        return time.monotonic() >= self._next

    def say(self, *parts: Part | str) -> None:
        """Show a line, when it is time to."""
        if self.due():
            self._next = time.monotonic() + (TERMINAL_EVERY_S if self._terminal else PLAIN_EVERY_S)
            ranked = [part if isinstance(part, tuple) else (0, part) for part in parts]
            if self._terminal:
                self._write_over(fit(ranked, columns(self._out) - 1))
            else:
                self._put(fit(ranked, 0) + "\n")

    def share(self, what: str, share: float) -> None:
        """Show how much of something is done, when it is time to."""
        self.say(f"{what}: {share:.0%}")

    def keep(self, text: str) -> None:
        """Write a line that stays."""
        self.clear()
        self._put(printable(text) + "\n")

    def clear(self) -> None:
        """End the line that is written over, to make room for one that stays."""
        if self._terminal and self._width:
            self._write_over("")
            self._put("\r")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.clear()

    def _write_over(self, text: str) -> None:
        """By spaces, since not every terminal knows how to erase; not beyond its end, were it made narrower since."""
        room = columns(self._out) - 1
        width = self._width if room <= 0 else min(self._width, room)
        self._put("\r" + text.ljust(width))
        self._width = len(text)

    def _put(self, text: str) -> None:
        with suppress(OSError, ValueError, AttributeError):
            self._out.write(text)
            self._out.flush()


def fit(parts: list[Part], room: int) -> str:
    """The parts on one line of at most `room` characters, without those that are least wanted; 0 or less: no end."""
    kept = [(rank, printable(text)) for rank, text in parts]
    while (text := BETWEEN.join(text for _, text in kept)) and 0 < room < len(text) and len(kept) > 1:
        kept.remove(max(kept))
    return text[:room] if room > 0 else text


def columns(out: TextIO) -> int:
    """How wide the terminal is now; 0 where that is not known. COLUMNS has the last word, as everywhere."""
    with suppress(ValueError):
        if (chosen := int(os.environ.get("COLUMNS", ""))) > 0:
            return chosen
    with suppress(OSError, ValueError, AttributeError):
        return os.get_terminal_size(out.fileno()).columns
    return 0

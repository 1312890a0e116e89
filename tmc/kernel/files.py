"""Files that others made: only regular ones are read, so that none blocks for ever; and words of others on one line."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import IO

KINDS = (
    (stat.S_ISFIFO, "it is a pipe"),
    (stat.S_ISSOCK, "it is a socket"),
    (stat.S_ISCHR, "it is a device"),
    (stat.S_ISBLK, "it is a device"),
)
"""What a path may name that is no file, and the words for it; of a folder the system says so."""
_NEVER_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_CLOEXEC", 0)


def check(path: str | os.PathLike[str]) -> None:
    """Raise OSError, with the reason in `strerror`, unless the path names a regular file."""
    mode = Path(path).stat().st_mode
    for is_kind, words in KINDS:
        if is_kind(mode):
            raise OSError(errno.EINVAL, words, os.fspath(path))


def opened(path: str | os.PathLike[str]) -> IO[bytes]:
    """Open a regular file to read bytes. OSError as `check`; never waits for another process."""
    check(path)  # first: to open a device may already do something
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NEVER_WAIT))


def read_bytes(path: str | os.PathLike[str], most: int = -1) -> bytes:
    """The bytes of a regular file, the first `most` of them when given. OSError as `opened`."""
    with opened(path) as file:
        return file.read(most) or b""  # None: a file of the kernel's that would make its reader wait


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a regular file in UTF-8. OSError as `opened`; UnicodeDecodeError, a ValueError, for other text."""
    return read_bytes(path).decode("utf-8")


def plain(text: object, longest: int = 500) -> str:
    """Text of others as one line of a message: blanks for control characters, and not longer than `longest`."""
    line = "".join(c if c.isprintable() else " " for c in str(text)).strip()
    return line if len(line) <= longest else line[: longest - 1] + "…"

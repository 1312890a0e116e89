"""Read foreign files, only regular ones, so that no read blocks; and put foreign text on one line."""

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
"""Kinds of paths that are not files, in words. The system itself reports folders."""
_NON_BLOCKING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_CLOEXEC", 0)


def check(path: str | os.PathLike[str]) -> None:
    """Raise OSError, with the reason in `strerror`, unless the path names a regular file."""
    mode = Path(path).stat().st_mode
    for is_kind, words in KINDS:
        if is_kind(mode):
            raise OSError(errno.EINVAL, words, os.fspath(path))


def opened(path: str | os.PathLike[str]) -> IO[bytes]:
    """Open a regular file to read bytes. Raises OSError as `check` does; never waits for another process."""
    check(path)  # first, since opening a device may have an effect
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NON_BLOCKING))


def read_bytes(path: str | os.PathLike[str], limit_bytes: int = -1) -> bytes:
    """Return the bytes of a regular file, at most `limit_bytes` when given. Raises OSError as `opened` does."""
    with opened(path) as file:
        return file.read(limit_bytes) or b""  # None: a file of the system that would block


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a regular UTF-8 file. Raises OSError as `opened` does; UnicodeDecodeError (a ValueError)."""
    return read_bytes(path).decode("utf-8")


def plain(text: object, limit_chars: int = 500) -> str:
    """Return foreign text as one line of at most `limit_chars` characters, with blanks for control characters."""
    line = "".join(c if c.isprintable() else " " for c in str(text)).strip()
    return line if len(line) <= limit_chars else line[: limit_chars - 1] + "…"

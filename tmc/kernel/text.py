"""Text that comes from elsewhere: made fit to be shown, and compared with the names that exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def printable(text: object) -> str:
    """The text on one line, with every character that is not one to read written as an escape.

    Escape sequences move the cursor, a newline forges a line of ours, marks of direction turn words round, and bytes
    of a name that are no UTF-8 (surrogates) can be neither encoded nor logged.
    """
    words = str(text)
    return words if words.isprintable() else "".join(c if c.isprintable() else _escaped(c) for c in words)


def _escaped(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file's name, as `os.fsdecode` keeps it
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that is most similar to a mistyped one; empty where none is similar."""
    lower = {k.lower(): k for k in known}
    return next((lower[k] for k in difflib.get_close_matches(name.lower(), lower, n=1)), "")


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return how to correct a name that does not exist: the nearest one that does, or else all of them."""
    known = list(known)
    near = nearest(name, known)
    return f"did you mean {near}?" if near else f"choose {', '.join(known)}"

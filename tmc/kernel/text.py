"""Make foreign text safe to print: names of maps, paths, and the content of damaged or foreign logs."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def printable(text: object) -> str:
    """Return the text on one line, with every character that is not printable as an escape sequence.

    Escape sequences move the cursor, a newline imitates a line of Overfly, and marks of direction reorder words. Bytes
    of a name that are not UTF-8 (surrogates) can be neither encoded nor logged.
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

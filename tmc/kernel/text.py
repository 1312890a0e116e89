"""Text that comes from elsewhere, made fit to be shown: names of maps, paths, what a damaged or a foreign log says."""

from __future__ import annotations


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

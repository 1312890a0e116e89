"""Make foreign text safe to print: names of maps, paths, and the content of damaged or foreign logs."""

from __future__ import annotations


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

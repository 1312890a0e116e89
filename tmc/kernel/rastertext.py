"""Parse and write the text raster of a user: one line per row, `#` road, `.` free, `X` blocked, after a header.

name: Old town
cell_m: 60
# # # # #
# . X . #
# # # # #
// 3 x 5 cells

Cells stand side by side, or with a blank or a comma between two of them. 0, 1 and 2 stand for free, road and blocked,
as `overfly map export` writes them. The header has `key: value` lines. Lines that begin with `//` are comments.
"""

from __future__ import annotations

from collections.abc import Iterable

from tmc.kernel.errors import OverflyError
from tmc.kernel.files import plain

FREE, ROAD, BLOCKED = ".", "#", "X"
CELLS = {FREE: FREE, ROAD: ROAD, BLOCKED: BLOCKED, "0": FREE, "1": ROAD, "2": BLOCKED}
"""The signs that may stand for a cell, and their meaning."""
COMMENT = "//"
HEADER_KEYS = ("name", "cell_m", "attribution")
CELL_M = (0.01, 100_000.0)
"""Least and largest width of a cell, metres."""


class MapError(OverflyError, ValueError):
    """A road map cannot be used. The text is one sentence: what is wrong, where, and the fix."""


def parse_text(text: str, where: str) -> tuple[dict[str, str], list[str]]:
    """Return the header and the rows of a raster: at least one row, all of one length, 65,535 cells at most.

    Rows consist of FREE, ROAD and BLOCKED, without separators. Blank lines may surround the header and end the text.
    `where`: the name of the text in errors. Raises MapError.
    """
    numbered = [(number, line.rstrip()) for number, line in enumerate(text.splitlines(), 1)]
    lines = [(number, line) for number, line in numbered if not line.startswith(COMMENT)]
    while lines and not lines[-1][1]:
        lines.pop()
    first = next((i for i, (_, line) in enumerate(lines) if line and ":" not in line), len(lines))
    header = _header(lines[:first], where)
    if first == len(lines):
        raise MapError(f"{where} has no raster row: write one line per row in # (road), . (free) and X (blocked)")
    return header, _rows(lines[first:], where)


def raster_text(header: dict[str, str], rows: Iterable[str], notes: Iterable[str] = ()) -> str:
    """Return the text that `parse_text` reads, with `notes` after the rows, as comments."""
    lines = [f"{key}: {value}" for key, value in header.items()]
    return "\n".join([*lines, *([""] if lines else []), *rows, *([""] if notes else []),
                      *(f"{COMMENT} {note}" for note in notes), ""])  # fmt: skip


def _header(lines: list[tuple[int, str]], where: str) -> dict[str, str]:
    header: dict[str, str] = {}
    for number, line in lines:
        key, colon, value = (part.strip() for part in line.partition(":"))
        if colon and key not in HEADER_KEYS:
            raise MapError(f"{where}: line {number} has the unknown key {key[:40]!r}: use {', '.join(HEADER_KEYS)}")
        if key in header:
            raise MapError(f"{where}: line {number} repeats '{key}': keep one")
        if key == "cell_m":
            _check_cell_m(value, f"{where}: line {number}")
        if colon:
            header[key] = plain(value, 1000)
    return header


def _check_cell_m(value: str, where: str) -> None:
    try:
        valid = CELL_M[0] <= float(value) <= CELL_M[1]
    except ValueError:
        valid = False
    if not valid:
        fix = f"give the width of a cell in metres, such as 60, from {CELL_M[0]:g} to {CELL_M[1]:,.0f}"
        raise MapError(f"{where}: cell_m is '{value[:40]}': {fix}")


def _rows(lines: list[tuple[int, str]], where: str) -> list[str]:
    rows: list[str] = []
    for number, line in lines:
        row = ""
        for column, sign in enumerate(_signs(line), 1):
            if sign not in CELLS:
                known = "# (road), . (free) or X (blocked)"
                raise MapError(f"{where}: line {number}, column {column} is {sign[:40]!r}: use {known}")
            row += CELLS[sign]
        if rows and len(row) != len(rows[0]):
            width = len(rows[0])
            raise MapError(
                f"{where}: line {number} has {len(row)} cells and the first row {width}: give all rows the same length"
            )
        rows.append(row)
    if len(rows) * len(rows[0]) > 65_535:
        raise MapError(f"{where} has {len(rows)} x {len(rows[0])} cells, over 65,535 of them: make the cells wider")
    return rows


def _signs(line: str) -> list[str]:
    """Return the sign of each cell of a row."""
    if "," in line:
        return [part.strip() for part in line.split(",")]
    return line.split(" ") if " " in line else list(line)

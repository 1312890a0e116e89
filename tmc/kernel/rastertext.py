"""The text raster that a user draws: a line a row, `#` road, `.` free, `X` blocked; `key: value` lines may lead.

name: Old town
cell_m: 60
#####
#.X.#
#####
"""

from __future__ import annotations

import math

FREE, ROAD, BLOCKED = ".", "#", "X"
HEADER_KEYS = ("name", "cell_m", "attribution")


class MapError(ValueError):
    """A road map that cannot be used: the message says what was wrong, where, and the mend, in one sentence."""


def parse_text(text: str, where: str) -> tuple[dict[str, str], list[str]]:
    """The header and the rows of a raster: at least one row, all equally long, 65,535 cells at most.

    Blank lines may surround the header and end the text. `where` is what messages call the text. Raises MapError.
    """
    lines = [line.rstrip() for line in text.rstrip().splitlines()]
    first = next((i for i, line in enumerate(lines) if line and ":" not in line), len(lines))
    header, rows = _header(lines[:first], where), lines[first:]
    if not rows:
        raise MapError(f"{where} has no raster row: write a line a row in # (road), . (free) and X (blocked)")
    _check_rows(rows, first, where)
    return header, rows


def _header(lines: list[str], where: str) -> dict[str, str]:
    header: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        key, colon, value = (part.strip() for part in line.partition(":"))
        if colon and key not in HEADER_KEYS:
            raise MapError(f"{where}: line {number} has the unknown key '{key}': use {', '.join(HEADER_KEYS)}")
        if key in header:
            raise MapError(f"{where}: line {number} gives '{key}' a second time: keep one")
        if key == "cell_m":
            _check_cell_m(value, f"{where}: line {number}")
        if colon:
            header[key] = value
    return header


def _check_cell_m(value: str, where: str) -> None:
    try:
        good = 0 < float(value) < math.inf
    except ValueError:
        good = False
    if not good:
        raise MapError(f"{where}: cell_m is '{value}': give the width of a cell in metres, such as 60")


def _check_rows(rows: list[str], first: int, where: str) -> None:
    width = len(rows[0])
    for number, row in enumerate(rows, first + 1):
        for column, character in enumerate(row, 1):
            if character not in (FREE, ROAD, BLOCKED):
                raise MapError(
                    f"{where}: line {number}, column {column} is {character!r}: use # (road), . (free) or X (blocked)"
                )
        if len(row) != width:
            raise MapError(
                f"{where}: line {number} has {len(row)} cells and the first row {width}: make all rows alike"
            )
    if len(rows) * width > 65_535:
        raise MapError(f"{where} has {len(rows)} x {width} cells, over 65,535 of them: make the cells wider")

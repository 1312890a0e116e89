"""Convert streets on the globe to cells: the projection, the raster rule, and floods over the grid.

Distances are in metres unless a name says otherwise; x runs street-east and y street-north from the south-west corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, zip_longest

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.grid import OFF_GRID, Grid

STEPS_PER_CELL = 40
"""Samples per cell width along a street."""
UNREACHABLE = 2**30
"""The distance of a cell that cannot be reached. It is large, so that a minimum over neighbours never picks it."""


@dataclass(frozen=True)
class Georeference:
    """The affine map between WGS84 and a grid: `x = a (lon - lon0) + b (lat - lat0) + c`, and `y` likewise.

    `x` and `y` hold (a, b, c) in metres per degree, and metres; `origin` is (lon0, lat0) in degrees.
    """

    grid: Grid
    cell_m: float
    origin: tuple[float, float]
    x: tuple[float, float, float]
    y: tuple[float, float, float]

    def metres(self, lonlat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (lon, lat) in degrees, shape (..., 2), to (x, y) in metres, shape (..., 2)."""
        slopes, shift = np.array([self.x[:2], self.y[:2]]), np.array([self.x[2], self.y[2]])
        return np.asarray((lonlat - np.array(self.origin)) @ slopes.T + shift)

    def lonlat(self, cell: int) -> tuple[float, float]:
        """Return (lon, lat) of the centre of `cell`, degrees."""
        row, col = divmod(cell, self.grid.cols)
        u = (col + 0.5) * self.cell_m - self.x[2]
        v = (self.grid.rows - row - 0.5) * self.cell_m - self.y[2]
        (a, b, _), (c, d, _) = self.x, self.y
        det = a * d - b * c
        return self.origin[0] + (d * u - b * v) / det, self.origin[1] + (a * v - c * u) / det

    def cell_at(self, lon: float, lat: float) -> int | None:
        """Return the cell that holds a point, or None when it lies outside the window."""
        x, y = self.metres(np.array([lon, lat]))
        row, col = self.grid.rows - 1 - math.floor(y / self.cell_m), math.floor(x / self.cell_m)
        inside = 0 <= row < self.grid.rows and 0 <= col < self.grid.cols
        return self.grid.cell(row, col) if inside else None

    def street_cells(self, lonlat: NDArray[np.float64]) -> list[int]:
        """Return the cells of one street inside the window, in order, by the raster rule. `lonlat`: (V, 2), degrees."""
        path = thin(walk(self.metres(lonlat) / self.cell_m))
        rows, cols = self.grid.rows, self.grid.cols
        return [self.grid.cell(rows - 1 - y, x) for x, y in path if 0 <= x < cols and 0 <= y < rows]


def walk(points: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the (x, y) squares that a polyline passes, in order, without immediate repeats.

    `points`: shape (V, 2), in cell widths. The line is sampled STEPS_PER_CELL times per cell width, so a square that
    it cuts by less may be missed.
    """
    squares: list[tuple[int, int]] = []
    for start, end in pairwise(points):
        n = max(1, math.ceil(float(np.hypot(*(end - start))) * STEPS_PER_CELL))
        samples = start + (end - start) * (np.arange(n + 1)[:, None] / n)
        for x, y in np.floor(samples).astype(int).tolist():
            if not squares or squares[-1] != (x, y):
                squares.append((x, y))
    return squares


def thin(squares: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Drop each corner square whose neighbours on the path touch, which leaves a thin, 8-connected path.

    "Neighbours" are the last square kept and the next one of the walk, so a staircase loses every second square.
    """
    kept: list[tuple[int, int]] = []
    for square, following in zip_longest(squares, squares[1:]):
        if not (kept and following and _touch(kept[-1], following)):
            kept.append(square)
    return kept


def _touch(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return max(abs(a[0] - b[0]), abs(a[1] - b[1])) <= 1


def flood(grid: Grid, start: NDArray[np.bool_], passable: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the fewest moves from any `start` cell over `passable` cells, or UNREACHABLE; shape (K,), int32.

    A move goes to one of the 8 neighbours. As in the model, only its target must be passable, so it may pass between
    two blocked cells diagonally.
    """
    distance = np.full(grid.size, UNREACHABLE, np.int32)
    frontier = np.flatnonzero(start)
    distance[frontier] = moves = 0
    while frontier.size:
        moves += 1
        reached = np.unique(grid.targets[frontier])
        reached = reached[reached != OFF_GRID]
        frontier = reached[passable[reached] & (distance[reached] == UNREACHABLE)]
        distance[frontier] = moves
    return distance


def components(grid: Grid, cells: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Return the 8-connected components of a set of cells, shape (K,), largest first; each in ascending order."""
    left, pieces = cells.copy(), []
    while left.any():
        seed = np.zeros(grid.size, np.bool_)
        seed[int(left.argmax())] = True
        piece = np.flatnonzero(flood(grid, seed, left) != UNREACHABLE)
        left[piece] = False
        pieces.append(piece)
    return sorted(pieces, key=lambda piece: (-piece.size, int(piece[0])))

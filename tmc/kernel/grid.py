"""The grid world (Sec. II): cells, the nine actions, and distances.

A cell is one integer, `k = row * cols + col`, with row 0 in the (street-) north and column 0 in the west.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

# (name, d_row, d_col) of each action id, in the paper's order (Sec. III-B, Action).
ACTIONS: tuple[tuple[str, int, int], ...] = (
    ("N", -1, 0),
    ("S", +1, 0),
    ("W", 0, -1),
    ("E", 0, +1),
    ("NW", -1, -1),
    ("NE", -1, +1),
    ("SW", +1, -1),
    ("SE", +1, +1),
    ("stay", 0, 0),
)
N_ACTIONS = len(ACTIONS)
STAY = 8
OFF_GRID = -1


@dataclass(frozen=True)
class Grid:
    """`rows` x `cols` square cells; K = rows * cols."""

    rows: int
    cols: int

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1 or self.rows * self.cols > 65_535:
            raise ValueError(f"a grid of {self.rows} x {self.cols} cells is not supported: 1 to 65,535 cells")

    @property
    def size(self) -> int:
        """K, the number of cells."""
        return self.rows * self.cols

    def cell(self, row: int, col: int) -> int:
        """Return the cell at a row and a column."""
        return row * self.cols + col

    @cached_property
    def targets(self) -> NDArray[np.int32]:
        """The cell that each action leads to, or OFF_GRID; shape (K, 9), int32."""
        table = np.full((self.size, N_ACTIONS), OFF_GRID, np.int32)
        rows, cols = np.divmod(np.arange(self.size), self.cols)
        for a, (_, dr, dc) in enumerate(ACTIONS):
            r, c = rows + dr, cols + dc
            inside = (r >= 0) & (r < self.rows) & (c >= 0) & (c < self.cols)
            table[inside, a] = (r * self.cols + c)[inside]
        return table

    @cached_property
    def target_lists(self) -> list[list[int]]:
        """`targets` as lists: indexing one element of an array is several times slower."""
        return [[int(k) for k in row] for row in self.targets]

    def chebyshev(self, a: int, b: int) -> int:
        """Return the moves that a UAV needs from cell `a` to cell `b` without obstacles."""
        (ra, ca), (rb, cb) = divmod(a, self.cols), divmod(b, self.cols)
        return max(abs(ra - rb), abs(ca - cb))

    def within(self, a: int, b: int, radius: float) -> bool:
        """Return True when the centres of two cells are at most `radius` cell widths apart (Euclidean, Sec. II-C)."""
        (ra, ca), (rb, cb) = divmod(a, self.cols), divmod(b, self.cols)
        return (ra - rb) ** 2 + (ca - cb) ** 2 <= radius * radius + 1e-9

    def window(self, radius: int) -> NDArray[np.int32]:
        """Return the cells around each cell, row by row, K where off the grid; shape (K, (2 radius + 1)^2), int32."""
        rows, cols = np.divmod(np.arange(self.size), self.cols)
        d = np.arange(-radius, radius + 1)
        r = rows[:, None, None] + d[None, :, None]
        c = cols[:, None, None] + d[None, None, :]
        inside = (r >= 0) & (r < self.rows) & (c >= 0) & (c < self.cols)
        return np.where(inside, r * self.cols + c, self.size).reshape(self.size, -1).astype(np.int32)

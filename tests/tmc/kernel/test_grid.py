"""The grid world: the paper's nine actions, targets, distances and windows, against plain arithmetic and search."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmc.kernel.grid import ACTIONS, N_ACTIONS, OFF_GRID, STAY, Grid

QUICK = settings(max_examples=50, deadline=None)

GRIDS = st.builds(Grid, st.integers(1, 9), st.integers(1, 9))


def test_actions_stand_in_the_papers_order() -> None:
    assert [name for name, _, _ in ACTIONS] == ["N", "S", "W", "E", "NW", "NE", "SW", "SE", "stay"]
    assert ACTIONS[STAY] == ("stay", 0, 0)
    assert N_ACTIONS == 9


def test_action_names_say_where_they_lead() -> None:
    """Row 0 is the north and column 0 the west."""
    for name, down, right in ACTIONS[:STAY]:
        assert down == ("S" in name) - ("N" in name)
        assert right == ("E" in name) - ("W" in name)


@QUICK
@given(GRIDS)
def test_each_target_is_one_step_away_or_off_the_grid(grid: Grid) -> None:
    for k in range(grid.size):
        row, col = divmod(k, grid.cols)
        for a, (_, down, right) in enumerate(ACTIONS):
            r, c = row + down, col + right
            inside = 0 <= r < grid.rows and 0 <= c < grid.cols
            assert grid.targets[k, a] == (grid.cell(r, c) if inside else OFF_GRID)


@QUICK
@given(GRIDS)
def test_staying_is_always_possible_and_moves_can_be_undone(grid: Grid) -> None:
    undo = [next(b for b, y in enumerate(ACTIONS) if y[1:] == (-x[1], -x[2])) for x in ACTIONS]
    assert (grid.targets[:, STAY] == np.arange(grid.size)).all()
    for k, a in np.argwhere(grid.targets != OFF_GRID):
        assert grid.targets[grid.targets[k, a], undo[a]] == k


@QUICK
@given(GRIDS)
def test_plain_lists_hold_the_same_targets(grid: Grid) -> None:
    assert grid.target_lists == grid.targets.tolist()
    assert all(type(k) is int for row in grid.target_lists for k in row)


def test_cells_count_from_the_north_west_row_by_row() -> None:
    grid = Grid(3, 5)
    assert [grid.cell(r, c) for r in range(3) for c in range(5)] == list(range(grid.size))


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (1, 65_535), (65_535, 1), (30, 30), (255, 257)])
def test_supported_sizes(rows: int, cols: int) -> None:
    assert Grid(rows, cols).size == rows * cols


@pytest.mark.parametrize(("rows", "cols"), [(0, 5), (5, 0), (-1, -1), (256, 256), (1, 65_536)])
def test_other_sizes_are_refused(rows: int, cols: int) -> None:
    """A cell must fit into 16 bits, with one value to spare."""
    with pytest.raises(ValueError, match=rf"{rows} x {cols} cells is not supported"):
        Grid(rows, cols)


@QUICK
@given(GRIDS, st.data())
def test_chebyshev_is_the_number_of_moves(grid: Grid, data: st.DataObject) -> None:
    """Breadth first over the nine actions needs exactly as many moves."""
    start = data.draw(st.integers(0, grid.size - 1))
    moves, queue = {start: 0}, deque([start])
    while queue:
        k = queue.popleft()
        for target in grid.target_lists[k]:
            if target != OFF_GRID and target not in moves:
                moves[target] = moves[k] + 1
                queue.append(target)
    assert moves == {k: grid.chebyshev(start, k) for k in range(grid.size)}
    assert all(grid.chebyshev(start, k) == grid.chebyshev(k, start) for k in range(grid.size))


@QUICK
@given(GRIDS, st.data())
def test_within_is_the_euclidean_distance_of_the_centres(grid: Grid, data: st.DataObject) -> None:
    a, b = data.draw(st.integers(0, grid.size - 1)), data.draw(st.integers(0, grid.size - 1))
    radius = data.draw(st.sampled_from([0.0, 0.99, 1.0, 1.4, 1.5, 2.0, 2.9, 3.0, 100.0]))
    distance = math.dist(divmod(a, grid.cols), divmod(b, grid.cols))
    assert grid.within(a, b, radius) is (distance <= radius)
    assert grid.within(b, a, radius) is grid.within(a, b, radius)


@pytest.mark.parametrize(("radius", "cells"), [(0.0, 1), (1.0, 5), (math.sqrt(2), 9), (1.5, 9), (2.0, 13), (2.9, 25)])
def test_cells_within_a_radius(radius: float, cells: int) -> None:
    """1.5 cell widths, the paper's r_s, hold exactly the eight neighbours; sqrt(2) is not lost to rounding."""
    grid = Grid(9, 9)
    assert sum(grid.within(40, k, radius) for k in range(grid.size)) == cells


@QUICK
@given(GRIDS, st.integers(1, 10))
def test_window_lists_the_square_around_each_cell(grid: Grid, radius: int) -> None:
    """Row by row with the cell itself in the middle; K stands for cells off the grid."""
    window = grid.window(radius)
    side = 2 * radius + 1
    assert window.shape == (grid.size, side * side)
    assert (window[:, side * side // 2] == np.arange(grid.size)).all()
    for k in (0, grid.size // 2, grid.size - 1):
        row, col = divmod(k, grid.cols)
        expected = [
            grid.cell(r, c) if 0 <= r < grid.rows and 0 <= c < grid.cols else grid.size
            for r in range(row - radius, row + radius + 1)
            for c in range(col - radius, col + radius + 1)
        ]
        assert window[k].tolist() == expected


def test_equal_grids_are_equal_and_frozen() -> None:
    assert Grid(3, 4) == Grid(3, 4) != Grid(4, 3)
    with pytest.raises(AttributeError):
        Grid(3, 4).rows = 5  # type: ignore[misc]

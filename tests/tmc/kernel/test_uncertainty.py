"""Uncertainty: eq. (3) cell by cell, the merge law, the order of scenario I, the accounting identity, the bound."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement, pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from tmc.kernel.grid import OFF_GRID, Grid
from tmc.kernel.uncertainty import UncertaintyLaw, arrival_probability, lower_bound, merge, step_events

QUICK = settings(max_examples=50, deadline=None)

TICKS = 60
UNEVEN = np.array([0.0, 0.01, 0.5, 0.0, 0.01, 3.0, 0.2])
UNIFORM = np.full(7, 0.01)
VISITS = arrays(np.uint16, 6, elements=st.integers(0, 65_535))
MASKS = arrays(np.bool_, 6)


# Eq. (3)


@pytest.mark.parametrize("alpha", [UNIFORM, UNEVEN], ids=["uniform", "uneven"])
def test_values_are_eq_3_in_every_cell_at_every_tick(alpha: NDArray[np.float64]) -> None:
    law = UncertaintyLaw(alpha, TICKS)
    for last, t in combinations_with_replacement(range(TICKS + 1), 2):
        values = law.values(np.full(law.cells.size, last, np.uint16), t)
        expected = [1.0 - math.exp(-alpha[k] * (t - last)) for k in law.cells]
        assert values == pytest.approx(expected, rel=0, abs=1e-15)


def test_only_cells_with_a_rate_are_monitored() -> None:
    law = UncertaintyLaw(UNEVEN, TICKS)
    assert law.cells.tolist() == [1, 2, 4, 5, 6]
    assert law.index.tolist() == law.index_list == [-1, 0, 1, -1, 2, 3, 4]
    assert law.q == pytest.approx([math.exp(-UNEVEN[k]) for k in law.cells], abs=1e-15)


@QUICK
@given(arrays(np.uint16, 5, elements=st.integers(0, TICKS)), st.booleans(), st.data())
def test_value_of_one_cell_has_the_same_bits_as_values(
    last: NDArray[np.uint16], random_map: bool, data: st.DataObject
) -> None:
    t = data.draw(st.integers(int(last.max()), TICKS))
    s = data.draw(arrays(np.float64, 5, elements=st.floats(0, 1))) if random_map else None
    law = UncertaintyLaw(UNEVEN, TICKS)
    values = law.values(last, t, s)
    assert values.dtype == np.float64
    assert [law.value(i, int(last[i]), t, s) for i in range(5)] == values.tolist()


@QUICK
@given(arrays(np.uint16, (3, 4, 5), elements=st.integers(0, 30)))
def test_values_of_a_batch_are_those_of_each_row(last: NDArray[np.uint16]) -> None:
    """Shapes (..., R) and (..., 1): the replay asks for many ticks at once."""
    law, t = UncertaintyLaw(UNEVEN, TICKS), np.arange(30, 42).reshape(3, 4, 1)
    batch = law.values(last, t)
    assert batch.shape == (3, 4, 5)
    for i, j in product(range(3), range(4)):
        assert (batch[i, j] == law.values(last[i, j], int(t[i, j, 0]))).all()


def test_uncertainty_is_zero_at_a_visit_and_tends_to_one() -> None:
    law = UncertaintyLaw(np.array([0.01]), 60_000)
    age = [law.value(0, 0, t) for t in range(0, 60_001, 100)]
    assert age[0] == 0.0
    assert all(b >= a for a, b in pairwise(age))
    assert age[-1] == 1.0
    assert law.value(0, 60_000, 60_000) == 0.0


def test_initial_map_holds_until_the_first_visit() -> None:
    """u_k(t) = 1 - s_k exp(-alpha_k t), and eq. (3) from the first visit on."""
    law, s = UncertaintyLaw(np.array([0.01, 0.2]), TICKS), np.array([0.3, 1.0])
    assert law.values(np.zeros(2, np.uint16), 0, s) == pytest.approx([0.7, 0.0])
    assert law.values(np.zeros(2, np.uint16), 9, s) == pytest.approx([1 - 0.3 * math.exp(-0.09), 1 - math.exp(-1.8)])
    assert law.values(np.array([5, 5], np.uint16), 9, s) == pytest.approx([1 - math.exp(-0.04), 1 - math.exp(-0.8)])


# Sec. II-D


@QUICK
@given(VISITS, VISITS, VISITS)
def test_merge_is_commutative_associative_and_idempotent(
    a: NDArray[np.uint16], b: NDArray[np.uint16], c: NDArray[np.uint16]
) -> None:
    assert (merge(a, b) == merge(b, a)).all()
    assert (merge(merge(a, b), c) == merge(a, merge(b, c))).all()
    assert (merge(a, a) == a).all()


@QUICK
@given(st.lists(VISITS, min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_late_doubled_and_reordered_records_give_the_same_map(
    records: list[NDArray[np.uint16]], random: object
) -> None:
    def total(maps: Sequence[NDArray[np.uint16]]) -> list[int]:
        merged = np.zeros(6, np.uint16)
        for one in maps:
            merged = merge(merged, one)
        return merged.tolist()

    shuffled = [*records, *records]
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert total(shuffled) == total(records) == np.max(records, axis=0).tolist()


@QUICK
@given(VISITS, VISITS)
def test_merge_never_forgets_a_visit_and_keeps_its_arguments(a: NDArray[np.uint16], b: NDArray[np.uint16]) -> None:
    before = a.copy(), b.copy()
    merged = merge(a, b)
    assert merged.dtype == np.uint16
    assert (merged >= a).all()
    assert (merged >= b).all()
    assert (a == before[0]).all()
    assert (b == before[1]).all()


def test_a_new_event_in_a_visited_cell_survives_the_slot() -> None:
    """The paper's order: clear, then appear."""
    active = np.array([True, True, False, False])
    after, new = step_events(active, [0, 2], np.array([True, False, True, False]))
    assert after.tolist() == [True, True, True, False]
    assert new.tolist() == [0, 2]


@QUICK
@given(MASKS, st.sets(st.integers(0, 5)), MASKS)
def test_events_clear_then_appear(active: NDArray[np.bool_], visited: set[int], arrivals: NDArray[np.bool_]) -> None:
    before = active.copy()
    after, new = step_events(active, sorted(visited), arrivals)
    for k in range(6):
        still = bool(before[k]) and k not in visited
        assert after[k] == (still or arrivals[k])
        assert (k in new) == (arrivals[k] and not still), "an arrival at an active cell adds nothing"
    assert (active == before).all()


def test_arrival_probability_is_that_of_at_least_one_poisson_event() -> None:
    alpha = np.array([0.0, 1e-12, 0.01, 1.0, 10.0])
    assert arrival_probability(alpha) == pytest.approx([-math.expm1(-a) for a in alpha], rel=1e-14)


# The accounting identity (ADR 0006)


def random_flight(grid: Grid, team: int, ticks: int, seed: int) -> NDArray[np.int64]:
    """Cells of a team that moves at random, shape (ticks + 1, team)."""
    rng = np.random.default_rng(seed)
    cells = np.empty((ticks + 1, team), np.int64)
    cells[0] = rng.choice(grid.size, team, replace=False)
    for t in range(ticks):
        for i in range(team):
            cells[t + 1, i] = rng.choice([k for k in grid.target_lists[cells[t, i]] if k != OFF_GRID])
    return cells


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rates", ["uniform", "uneven"])
@pytest.mark.parametrize("initial", ["visited", "random"])
def test_accounting_identity(seed: int, rates: str, initial: str) -> None:
    """Sum of u_k over ticks = the sum without visits - what each visit took away, for any flight and every cell."""
    grid, ticks = Grid(5, 6), 80
    rng = np.random.default_rng(100 + seed)
    alpha = np.full(grid.size, 0.01) if rates == "uniform" else rng.choice([0.0, 0.003, 0.01, 0.4, 2.0], grid.size)
    law = UncertaintyLaw(alpha, ticks)
    s = rng.uniform(0.0, 1.0, law.cells.size) if initial == "random" else None
    last, total = np.zeros(law.cells.size, np.uint16), np.zeros(law.cells.size)
    taken = np.zeros(law.cells.size)
    for t, cells in enumerate(random_flight(grid, 3, ticks, seed)):
        if t == 0:
            continue
        for i in {law.index_list[k] for k in cells.tolist()} - {-1}:
            q = law.q[i]
            taken[i] += law.value(i, int(last[i]), t, s) * (1 - q ** (ticks - t + 1)) / (1 - q)
            last[i] = t
        total += law.values(last, t, s)
    unvisited = law.values(np.zeros((ticks, law.cells.size), np.uint16), np.arange(1, ticks + 1)[:, None], s).sum(
        axis=0
    )
    assert taken.sum() > 0
    assert total == pytest.approx(unvisited - taken, rel=0, abs=1e-9)


# The bound on eq. (6)


def average(alpha: NDArray[np.float64], flight: Sequence[Sequence[int]]) -> float:
    """Eq. (6) of a flight, the cells of the team at each tick from 0 on, by hand: all cells visited at t = 0."""
    last, total = [0] * alpha.size, 0.0
    for t, cells in enumerate(flight):
        for k in cells:
            last[k] = t
        total += sum(1 - math.exp(-alpha[k] * (t - last[k])) for k in range(alpha.size))
    return total / (len(flight) - 1)


def flights(grid: Grid, team: int, ticks: int) -> Iterator[list[tuple[int, ...]]]:
    """Every flight of a team without two UAVs in one cell."""

    def onwards(path: list[tuple[int, ...]]) -> Iterator[list[tuple[int, ...]]]:
        if len(path) == ticks + 1:
            yield path
            return
        for cells in product(*([k for k in grid.target_lists[c] if k != OFF_GRID] for c in path[-1])):
            if len(set(cells)) == team:
                yield from onwards([*path, cells])

    for start in product(range(grid.size), repeat=team):
        if len(set(start)) == team:
            yield from onwards([start])


@pytest.mark.parametrize(
    ("grid", "team", "ticks", "alpha"),
    [
        (Grid(2, 3), 1, 4, np.full(6, 0.01)),
        (Grid(2, 3), 1, 4, np.full(6, 1.5)),
        (Grid(1, 4), 2, 3, np.full(4, 0.1)),
        (Grid(1, 5), 1, 4, np.array([0.2, 0.01, 0.0, 0.1, 0.05])),
        (Grid(1, 4), 2, 3, np.array([0.3, 0.01, 0.2, 0.05])),
    ],
)
def test_bound_is_below_every_flight_of_a_tiny_map(
    grid: Grid, team: int, ticks: int, alpha: NDArray[np.float64]
) -> None:
    best = min(average(alpha, flight) for flight in flights(grid, team, ticks))
    assert 0 < lower_bound(alpha, team, ticks) <= best + 1e-12


@pytest.mark.parametrize("alpha", [0.001, 0.01, 0.3])
def test_bound_is_reached_by_a_perfect_tour_of_uniform_cells(alpha: float) -> None:
    """One UAV around a block of 2 x 2 cells: no team does better."""
    rates = np.full(4, alpha)
    tour = [((0, 1, 3, 2)[t % 4],) for t in range(41)]
    assert lower_bound(rates, 1, 40) == pytest.approx(average(rates, tour), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("team", [1, 3, 8])
def test_bound_is_below_random_flights(team: int, seed: int) -> None:
    grid = Grid(6, 6)
    alpha = np.random.default_rng(seed).uniform(0.001, 0.05, grid.size)
    flight = random_flight(grid, team, 50, seed).tolist()
    assert lower_bound(alpha, team, 50) < average(alpha, flight)


def test_bound_is_below_a_team_that_gives_up_the_busiest_cells() -> None:
    """Five cells fill up at once whatever is done, so the best flight leaves them and tours the ring of twenty."""
    grid, ring = Grid(6, 6), []
    ring += [(0, c) for c in range(6)] + [(r, 5) for r in range(1, 6)]
    ring += [(5, c) for c in range(4, -1, -1)] + [(r, 0) for r in range(4, 0, -1)]
    alpha = np.zeros(grid.size)
    alpha[[grid.cell(r, c) for r, c in ring]] = 0.1
    alpha[[grid.cell(2, 2), grid.cell(2, 3), grid.cell(3, 2), grid.cell(3, 3), grid.cell(1, 1)]] = 10.0
    tour = [(grid.cell(*ring[t % len(ring)]),) for t in range(201)]
    assert lower_bound(alpha, 1, 200) <= average(alpha, tour)


def test_bound_falls_with_the_team_and_is_zero_when_every_cell_has_a_uav() -> None:
    alpha = np.full(12, 0.01)
    bounds = [lower_bound(alpha, n, 30) for n in range(1, 13)]
    assert all(b < a for a, b in pairwise(bounds))
    assert bounds[-1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("cells", [1, 7, 8, 129, 322, 1000])
def test_sums_have_the_same_bits_however_many_ticks_are_reckoned_at_once(cells: int) -> None:
    """The TMC computes as many ticks as have come in; a log must not show how many those were."""
    law = UncertaintyLaw(np.random.default_rng(cells).choice([0.01, 0.2, 0.003], cells), 64)
    maps = np.random.default_rng(1).integers(0, 10, (54, cells)).astype(np.uint16)
    ticks = np.arange(10, 64)
    together = law.values(maps, ticks[:, None]).sum(axis=1).tolist()
    assert together == [float(law.values(row, t).sum()) for row, t in zip(maps, ticks.tolist(), strict=True)]
    assert together[3:5] == law.values(maps[3:5], ticks[3:5, None]).sum(axis=1).tolist()


@pytest.mark.parametrize("alpha", [[0.01], [0.01] * 3, [0.3, 0.1], [1e-9, 1e-9], [10.0, 0.02, 5.0]])
def test_a_team_that_is_on_every_cell_has_no_bound(alpha: list[float]) -> None:
    """It is exactly 0, and not what rounding leaves of it, by which anything can be divided."""
    rates = np.array(alpha)
    assert lower_bound(rates, rates.size, 20) == 0.0
    assert rates.size == 1 or lower_bound(rates, rates.size - 1, 20) > 0.0

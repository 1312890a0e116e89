"""Sec. II-A and II-B: no two UAVs in one cell, and the uncertainty of both scenarios."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tmc.kernel.uncertainty import UncertaintyLaw

Fly = Callable[..., Any]
PILOTS = ["planner:random", "planner:random-road", "planner:greedy"]


@pytest.mark.parametrize("pilot", PILOTS)
@pytest.mark.parametrize("scenario", [1, 2])
def test_eq_01_no_two_uavs_share_a_cell(pilot: str, scenario: int, fly: Fly) -> None:
    """p_i1(t) != p_i2(t) for all t, in a town full of UAVs that do not care."""
    flown = fly({"team.size": 12, "team.controller": pilot, "scenario": scenario})
    for cells in flown.cells.values():
        assert all(len(set(now)) == 12 for now in cells.tolist())


def test_sec_2a_no_uav_is_on_an_obstacle_or_moves_more_than_a_cell(fly: Fly) -> None:
    flown = fly({"team.controller": "planner:random"})
    grid, blocked = flown.world.grid, flown.world.map.blocked
    for cells in flown.cells.values():
        assert not blocked[cells].any()
        assert all(grid.chebyshev(a, b) <= 1 for a, b in zip(cells[:-1].ravel(), cells[1:].ravel(), strict=True))


def test_eq_02_uncertainty_is_one_where_an_event_is_active(fly: Fly) -> None:
    """Scenario I: every UAV's map is e_k(t), and so is what the TMC adds up."""
    flown = fly({"scenario": 1, "world.alpha": 0.1})
    world = flown.world
    assert {u for state in flown.sights.values() for u in state.u.tolist()} == {0.0, 1.0}
    assert max(flown.series("uncertainty", 1)) > 3
    assert all(x == int(x) <= world.law.cells.size for x in flown.series("uncertainty", 1))


def test_eq_03_uncertainty_of_an_unvisited_cell() -> None:
    law = UncertaintyLaw(np.array([0.01]), 1000)
    assert law.value(0, 0, 0) == 0.0
    for t in (1, 10, 69, 100, 1000):
        assert law.value(0, 0, t) == pytest.approx(1 - math.exp(-0.01 * t), abs=1e-15)


def test_eq_03_uncertainty_of_a_visited_cell_starts_again() -> None:
    law = UncertaintyLaw(np.array([0.01]), 1000)
    assert law.value(0, 500, 500) == 0.0
    assert law.value(0, 500, 730) == pytest.approx(1 - math.exp(-2.3), abs=1e-15)


def test_eq_03_is_the_chance_of_an_event_since_the_last_visit() -> None:
    """Under a Poisson distribution: 20,000 draws of the events in 30 ticks, to four deviations."""
    alpha, age, n = 0.01, 30, 20_000
    hit = (np.random.default_rng(1).poisson(alpha * age, n) > 0).mean()
    u = UncertaintyLaw(np.array([alpha]), age).value(0, 0, age)
    assert abs(hit - u) < 4 * math.sqrt(u * (1 - u) / n)


def test_eq_04_tau_is_the_last_visit_by_any_uav(fly: Fly) -> None:
    """tau_k(t) = max{tau' <= t: nu_k(tau') = 1}, in the map that the TMC sends at the end of the episode."""
    flown = fly()
    for episode, cells in flown.cells.items():
        last = next(x for _, x in flown.maps if (x.episode, x.tick) == (episode, 37)).last_visit
        for k, tau in zip(flown.world.law.cells.tolist(), last.tolist(), strict=True):
            assert tau == max(np.flatnonzero((cells == k).any(axis=1)), default=0)

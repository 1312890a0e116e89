"""The classical planners: what each may choose, from one sight."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors import planners
from actors.planners import PLANNERS, PREFIX, PlannerDecider, Sight
from tmc.kernel.config import build
from tmc.kernel.grid import STAY
from tmc.kernel.observation import Observer
from tmc.kernel.roadmap import RoadMap, load_map
from tmc.kernel.world import World

TORONTO = World(build({}), load_map("downtown-toronto"))
OBSERVER = Observer(TORONTO)


def sight_at(world: World, cell: int, peers: list[int], u: Any, draw: float, previous: int = -1) -> Sight:
    observer = OBSERVER if world is TORONTO else Observer(world)
    return Sight(
        tick=3, cell=cell, previous=cell if previous < 0 else previous, peers=peers, u=u,
        allowed=observer.allowed(cell, peers), draw=draw,
    )  # fmt: skip


@st.composite
def sights(draw: st.DrawFn) -> Sight:
    """On the built-in map, with peers around; few different values in the map, so that ties are common."""
    cell = draw(st.sampled_from(TORONTO.start_cells.tolist()))
    around = [k for k in TORONTO.grid.target_lists[cell][:STAY] if k >= 0]
    peers = draw(st.lists(st.sampled_from(around), max_size=8, unique=True))
    seed = draw(st.integers(0, 1000))
    values = draw(st.sampled_from([1, 2, 1000]))
    u = np.random.Generator(np.random.Philox(seed)).integers(0, values, TORONTO.law.cells.size) / values
    uniform = draw(st.floats(0, 1, exclude_max=True))
    return sight_at(TORONTO, cell, peers, u, uniform, draw(st.sampled_from([cell, *around])))


def value(sight: Sight, action: int) -> float:
    k = TORONTO.law.index_list[TORONTO.grid.target_lists[sight.cell][action]]
    return float(sight.u[k]) if k >= 0 else 0.0


def away(sight: Sight, action: int) -> int:
    return int(TORONTO.map.road_distance[TORONTO.grid.target_lists[sight.cell][action]])


@settings(max_examples=150, deadline=None)
@given(sight=sights())
def test_greedy_picks_the_best_of_nine_then_the_road_then_the_draw(sight: Sight) -> None:
    action = PlannerDecider(TORONTO, "greedy").choose(sight)
    best = max(value(sight, a) for a in sight.allowed)
    tied = [a for a in sight.allowed if value(sight, a) == best]
    tied = [a for a in tied if away(sight, a) == min(away(sight, b) for b in tied)]
    assert action == tied[int(sight.draw * len(tied))]


@settings(max_examples=150, deadline=None)
@given(sight=sights())
@pytest.mark.parametrize("name", ["random-road", "greedy"])
def test_what_is_known_to_be_blocked_is_never_chosen(name: str, sight: Sight) -> None:
    assert PlannerDecider(TORONTO, PREFIX + name).choose(sight) in sight.allowed


@settings(max_examples=150, deadline=None)
@given(sight=sights())
def test_random_road_stays_on_the_road_and_finds_it(sight: Sight) -> None:
    action = PlannerDecider(TORONTO, "random-road").choose(sight)
    targets, road = TORONTO.grid.target_lists[sight.cell], TORONTO.map.road
    moves = [a for a in sight.allowed if a != STAY]
    ways = [a for a in moves if road[targets[a]]]
    if ways:
        assert road[targets[action]] and action != STAY
        assert targets[action] != sight.previous or [targets[a] for a in ways] == [sight.previous]
    elif moves:
        assert away(sight, action) == min(away(sight, a) for a in moves)
    else:
        assert action == STAY


@given(draw=st.floats(0, 1, exclude_max=True))
def test_random_takes_any_of_nine_blocked_or_not(draw: float) -> None:
    sight = sight_at(TORONTO, int(TORONTO.start_cells[0]), [], np.zeros(TORONTO.law.cells.size), draw)
    assert planners.random(TORONTO, sight) == int(draw * 9)


@pytest.mark.parametrize("name", list(PLANNERS))
def test_the_draw_reaches_every_choice_equally(name: str, town: RoadMap, world_of: Callable[..., World]) -> None:
    """With nothing to choose by, all choices have the same share of [0, 1)."""
    world = world_of({}, "#####\n#####\n#####")
    u = np.zeros(world.law.cells.size)
    chosen = [
        PlannerDecider(world, name).choose(sight_at(world, 7, [], u, (i + 0.5) / 720)) for i in range(720)
    ]  # fmt: skip
    counts = [chosen.count(a) for a in range(9)]
    assert counts == ([90] * 8 + [0] if name == "random-road" else [80] * 9)


def test_greedy_prefers_the_better_cell_however_small_the_difference(world_of: Callable[..., World]) -> None:
    world = world_of({}, "###\n###\n###")
    u = np.full(9, 0.5)
    u[6] = np.nextafter(0.5, 1)
    assert {PlannerDecider(world, "greedy").choose(sight_at(world, 4, [], u, d / 10)) for d in range(10)} == {6}
    blocked = sight_at(world, 4, [6], u, 0.0)
    assert world.grid.target_lists[4][PlannerDecider(world, "greedy").choose(blocked)] != 6


def test_shut_in_by_peers_a_planner_stays(world_of: Callable[..., World]) -> None:
    world = world_of({}, "###\n###\n###")
    sight = sight_at(world, 4, [0, 1, 2, 3, 5, 6, 7, 8], np.ones(9), 0.9)
    for name in ("greedy", "random-road"):
        assert PlannerDecider(world, name).choose(sight) == STAY

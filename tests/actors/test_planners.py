"""The classical planners: what each may choose, from one state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors import planners
from actors.planners import PLANNERS, PREFIX, LocalState, PlannerController
from tmc.kernel.config import build
from tmc.kernel.grid import STAY
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.roadmap import RoadMap, load_map
from tmc.kernel.world import World

TORONTO = World(build({}), load_map("downtown-toronto"))
OBSERVER = ObservationBuilder(TORONTO)


def sight_at(world: World, cell: int, peers: list[int], u: Any, draw: float, previous: int = -1) -> LocalState:
    observer = OBSERVER if world is TORONTO else ObservationBuilder(world)
    return LocalState(
        tick=3, cell=cell, previous=cell if previous < 0 else previous, peers=peers, u=u,
        allowed=observer.allowed(cell, peers), draw=draw,
    )  # fmt: skip


@st.composite
def sights(draw: st.DrawFn) -> LocalState:
    """Return states on the built-in map, with peers around, and few different values so that ties are common."""
    cell = draw(st.sampled_from(TORONTO.start_cells.tolist()))
    around = [k for k in TORONTO.grid.target_lists[cell][:STAY] if k >= 0]
    peers = draw(st.lists(st.sampled_from(around), max_size=8, unique=True))
    seed = draw(st.integers(0, 1000))
    values = draw(st.sampled_from([1, 2, 1000]))
    u = np.random.Generator(np.random.Philox(seed)).integers(0, values, TORONTO.law.cells.size) / values
    uniform = draw(st.floats(0, 1, exclude_max=True))
    return sight_at(TORONTO, cell, peers, u, uniform, draw(st.sampled_from([cell, *around])))


def value(state: LocalState, action: int) -> float:
    k = TORONTO.law.index_list[TORONTO.grid.target_lists[state.cell][action]]
    return float(state.u[k]) if k >= 0 else 0.0


def away(state: LocalState, action: int) -> int:
    return int(TORONTO.map.road_distance[TORONTO.grid.target_lists[state.cell][action]])


@settings(max_examples=150, deadline=None)
@given(state=sights())
def test_greedy_picks_the_best_of_nine_then_the_road_then_the_draw(state: LocalState) -> None:
    action = PlannerController(TORONTO, "greedy").choose(state)
    best = max(value(state, a) for a in state.allowed)
    tied = [a for a in state.allowed if value(state, a) == best]
    tied = [a for a in tied if away(state, a) == min(away(state, b) for b in tied)]
    assert action == tied[int(state.draw * len(tied))]


@settings(max_examples=150, deadline=None)
@given(state=sights())
@pytest.mark.parametrize("name", ["random-road", "greedy"])
def test_what_is_known_to_be_blocked_is_never_chosen(name: str, state: LocalState) -> None:
    assert PlannerController(TORONTO, PREFIX + name).choose(state) in state.allowed


@settings(max_examples=150, deadline=None)
@given(state=sights())
def test_random_road_stays_on_the_road_and_finds_it(state: LocalState) -> None:
    action = PlannerController(TORONTO, "random-road").choose(state)
    targets, road = TORONTO.grid.target_lists[state.cell], TORONTO.map.road
    moves = [a for a in state.allowed if a != STAY]
    ways = [a for a in moves if road[targets[a]]]
    if ways:
        assert road[targets[action]] and action != STAY
        assert targets[action] != state.previous or [targets[a] for a in ways] == [state.previous]
    elif moves:
        assert away(state, action) == min(away(state, a) for a in moves)
    else:
        assert action == STAY


@given(draw=st.floats(0, 1, exclude_max=True))
def test_random_takes_any_of_nine_blocked_or_not(draw: float) -> None:
    state = sight_at(TORONTO, int(TORONTO.start_cells[0]), [], np.zeros(TORONTO.law.cells.size), draw)
    assert planners.random(TORONTO, state) == int(draw * 9)


@pytest.mark.parametrize("name", list(PLANNERS))
def test_the_draw_reaches_every_choice_equally(name: str, town: RoadMap, world_of: Callable[..., World]) -> None:
    """If all choices are equally good, each has the same share of [0, 1)."""
    world = world_of({}, "#####\n#####\n#####")
    u = np.zeros(world.law.cells.size)
    chosen = [
        PlannerController(world, name).choose(sight_at(world, 7, [], u, (i + 0.5) / 720)) for i in range(720)
    ]  # fmt: skip
    counts = [chosen.count(a) for a in range(9)]
    assert counts == ([90] * 8 + [0] if name == "random-road" else [80] * 9)


def test_greedy_prefers_the_better_cell_however_small_the_difference(world_of: Callable[..., World]) -> None:
    world = world_of({}, "###\n###\n###")
    u = np.full(9, 0.5)
    u[6] = np.nextafter(0.5, 1)
    assert {PlannerController(world, "greedy").choose(sight_at(world, 4, [], u, d / 10)) for d in range(10)} == {6}
    blocked = sight_at(world, 4, [6], u, 0.0)
    assert world.grid.target_lists[4][PlannerController(world, "greedy").choose(blocked)] != 6


def test_shut_in_by_peers_a_planner_stays(world_of: Callable[..., World]) -> None:
    world = world_of({}, "###\n###\n###")
    state = sight_at(world, 4, [0, 1, 2, 3, 5, 6, 7, 8], np.ones(9), 0.9)
    for name in ("greedy", "random-road"):
        assert PlannerController(world, name).choose(state) == STAY

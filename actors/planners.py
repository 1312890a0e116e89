"""Classical planners, the baselines that a learned policy must beat. Each decides by what one UAV knows, no more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.grid import N_ACTIONS, STAY
from tmc.kernel.world import World


@dataclass(frozen=True)
class LocalState:
    """What a UAV knows when it decides: its cell and the one before, the cells of sensed peers, its map `u` (R,), the
    moves that nothing known blocks, and one draw in [0, 1) of its own."""

    tick: int
    cell: int
    previous: int
    peers: list[int]
    u: NDArray[np.float64]
    allowed: list[int]
    draw: float


class Controller(Protocol):
    """A policy or a planner: chooses an action id."""

    def choose(self, state: LocalState) -> int: ...


@runtime_checkable
class QController(Controller, Protocol):
    """A policy: it also knows what actions are worth."""

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        """Q(o, a), and the largest Q(o, .) of an action that may be chosen."""
        ...


Planner = Callable[[World, LocalState], int]


def pick(choices: list[int], draw: float) -> int:
    """One of the choices, each equally likely."""
    return choices[int(draw * len(choices))]


def random(_world: World, state: LocalState) -> int:
    """Any of the nine actions, blocked or not: what exploration alone does."""
    return pick(list(range(N_ACTIONS)), state.draw)


def random_road(world: World, state: LocalState) -> int:
    """A random move along the road that does not turn back unless it must; off the road, a move nearer to it."""
    targets = world.grid.target_lists[state.cell]
    onward = [a for a in state.allowed if a != STAY and targets[a] != state.previous]
    road = [a for a in onward if world.map.road[targets[a]]]
    return _nearest_to_road(world, state, road or [a for a in state.allowed if a != STAY] or [STAY])


def greedy(world: World, state: LocalState) -> int:
    """The best of the nine cells by the UAV's own map; ties go to the cell nearest to the road, then to the draw."""
    index, targets = world.law.index_list, world.grid.target_lists[state.cell]
    u = [float(state.u[index[targets[a]]]) if index[targets[a]] >= 0 else 0.0 for a in state.allowed]
    best = max(u)
    return _nearest_to_road(world, state, [a for a, value in zip(state.allowed, u, strict=True) if value == best])


def _nearest_to_road(world: World, state: LocalState, choices: list[int]) -> int:
    distance, targets = world.map.road_distance, world.grid.target_lists[state.cell]
    away = [int(distance[targets[a]]) for a in choices]
    return pick([a for a, d in zip(choices, away, strict=True) if d == min(away)], state.draw)


PLANNERS: dict[str, Planner] = {"random": random, "random-road": random_road, "greedy": greedy}
PREFIX = "planner:"


class PlannerController:
    """A planner in a world, as a Controller."""

    def __init__(self, world: World, name: str) -> None:
        self._world, self._planner = world, PLANNERS[name.removeprefix(PREFIX)]

    def choose(self, state: LocalState) -> int:
        return self._planner(self._world, state)

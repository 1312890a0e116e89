"""Classical planners, the baselines that a learned policy must beat. Each decides only by what one UAV knows."""

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
    """What a UAV knows when it decides at `tick`.

    `cell`, `previous`: its cell at t and at t - 1. `peers`: cells of sensed peers. `u` (R,): its own uncertainty map.
    `allowed`: ids of the actions that nothing known blocks. `draw`: one uniform draw in [0, 1).
    """

    tick: int
    cell: int
    previous: int
    peers: list[int]
    u: NDArray[np.float64]
    allowed: list[int]
    draw: float


class Controller(Protocol):
    """A policy or a planner."""

    def choose(self, state: LocalState) -> int:
        """Return the id of the chosen action."""
        ...


@runtime_checkable
class QController(Controller, Protocol):
    """A policy, which also has Q values."""

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        """Return Q(o, a), and the largest Q(o, .) of an action that may be chosen."""
        ...


Planner = Callable[[World, LocalState], int]


def pick(choices: list[int], draw: float) -> int:
    """Return one of the choices, each equally likely, by a draw in [0, 1)."""
    return choices[int(draw * len(choices))]


def random(_world: World, state: LocalState) -> int:
    """Choose any of the nine actions, blocked or not, as exploration alone does."""
    return pick(list(range(N_ACTIONS)), state.draw)


def random_road(world: World, state: LocalState) -> int:
    """Choose a random move along the road that does not turn back unless it must; off the road, a move nearer to it."""
    targets = world.grid.target_lists[state.cell]
    onward = [a for a in state.allowed if a != STAY and targets[a] != state.previous]
    road = [a for a in onward if world.map.road[targets[a]]]
    return _nearest_to_road(world, state, road or [a for a in state.allowed if a != STAY] or [STAY])


def greedy(world: World, state: LocalState) -> int:
    """Choose the most uncertain of the nine cells; ties go to the cell nearest to the road, then to the draw."""
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
    """Makes a Controller of a planner in a world. `name`: with or without PREFIX."""

    def __init__(self, world: World, name: str) -> None:
        self._world, self._planner = world, PLANNERS[name.removeprefix(PREFIX)]

    def choose(self, state: LocalState) -> int:
        return self._planner(self._world, state)

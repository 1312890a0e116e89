"""The world of a mission: its map, its rates, and the random draws of each episode. Immutable, the same everywhere."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tmc.kernel.config import Config, ConfigError
from tmc.kernel.draws import Stream, distinct, uniforms
from tmc.kernel.grid import OFF_GRID
from tmc.kernel.reward import Block
from tmc.kernel.roadmap import RoadMap, load_map, map_of_run
from tmc.kernel.uncertainty import UncertaintyLaw, arrival_probability


class World:
    """The settings `config` on `road_map`, by default loaded by its name; ConfigError where the two do not fit."""

    def __init__(self, config: Config, road_map: RoadMap | None = None) -> None:
        self.config = config
        self.map = road_map or load_map(config.world.map, config.world.roads, config.world.obstacles)
        self.grid = self.map.grid
        self.law = UncertaintyLaw(self.alpha, config.training.ticks)
        self.moves = self._moves()
        """By cell and action: the cell that the UAV is on afterwards, and what blocks it, by the map alone."""
        self._check()

    @cached_property
    def alpha(self) -> NDArray[np.float64]:
        """Events per tick in each cell, 0 on blocked cells; shape (K,)."""
        world = self.config.world
        if world.rates not in self.map.rates:
            known = ", ".join(sorted(self.map.rates))
            raise ConfigError(f"world.rates = '{world.rates}' is unknown to the map {self.map.name}: choose {known}")
        alpha = np.where(self.map.road, world.alpha * self.map.rates[world.rates], world.alpha_offroad)
        return np.where(self.map.blocked, 0.0, alpha)

    @cached_property
    def start_cells(self) -> NDArray[np.int64]:
        """The cells on which a UAV may start."""
        road = self.config.world.start == "road"
        return np.flatnonzero(~self.map.blocked & (self.map.road if road else True))

    def _moves(self) -> list[list[tuple[int, Block]]]:
        blocked = self.map.blocked.tolist()

        def move(cell: int, target: int) -> tuple[int, Block]:
            if target == OFF_GRID:
                return cell, Block.GRID
            return (cell, Block.OBSTACLE) if blocked[target] else (target, Block.NONE)

        return [[move(k, target) for target in targets] for k, targets in enumerate(self.grid.target_lists)]

    def _check(self) -> None:
        size, roads = self.config.team.size, int(self.map.road.sum())
        if size > roads:
            raise ConfigError(
                f"team.size = {size} is larger than the {roads} road cells of {self.map.name}: use {roads} or fewer"
            )
        if size > self.start_cells.size:
            raise ConfigError(f"team.size = {size} is larger than the {self.start_cells.size} cells to start on")
        if self.config.replay.capacity < size:
            raise ConfigError(f"replay.capacity = {self.config.replay.capacity} is less than a tick of {size} UAVs")
        held, needed = self.config.replay.capacity // size * size, self.config.replay.learn_start
        if needed > held:
            raise ConfigError(
                f"replay.learn_start = {needed} is larger than the {held} transitions that replay.capacity holds, in "
                f"whole ticks of {size} UAVs, so learning would never start: raise capacity, or lower learn_start"
            )
        if not self.law.cells.size:
            raise ConfigError(f"no cell of {self.map.name} is monitored: every rate is 0")

    def starts(self, episode: int) -> list[int]:
        """Return the N distinct cells on which the team starts an episode (Algorithm 1)."""
        n = self.config.team.size
        u = uniforms(self.config.training.seed, Stream.STARTS, n, episode=episode)
        return distinct(u, self.start_cells, n)

    def initial_factor(self, episode: int) -> NDArray[np.float64] | None:
        """Return s_k = 1 - u_k(0), uniform in (0, 1], 1 under a UAV, shape (R,); None when the map starts visited."""
        if self.config.world.initial_map == "visited":
            return None
        u = uniforms(self.config.training.seed, Stream.AGES, self.grid.size, episode=episode)
        u[self.starts(episode)] = 0.0
        return np.asarray(1.0 - u[self.law.cells])

    @cached_property
    def _arrival(self) -> NDArray[np.float64]:
        return arrival_probability(self.alpha)

    def arrivals(self, episode: int, tick: int) -> NDArray[np.bool_]:
        """Return True for cells where an event arrives in [tick - 1, tick) (scenario I); shape (K,), bool."""
        u = uniforms(self.config.training.seed, Stream.EVENTS, self.grid.size, episode=episode, tick=tick)
        return np.asarray(u < self._arrival)

    def explorations(self, episode: int, uav: int) -> NDArray[np.float64]:
        """Return for each tick the draw against epsilon and the draw that chooses an action; shape (T_ep, 2)."""
        ticks = self.config.training.ticks
        u = uniforms(self.config.training.seed, Stream.EXPLORATION, 2 * ticks, episode=episode, uav=uav)
        return u.reshape(ticks, 2)


def world_of_run(config: Config, folder: Path) -> World:
    """Return the world of a run in `folder`, with the folder's copy of a user's map."""
    world = config.world
    return World(config, map_of_run(folder, world.map, world.roads, world.obstacles))

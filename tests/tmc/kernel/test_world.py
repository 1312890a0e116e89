"""The world of a mission: rates, starts, what chance brings at each address, and settings that do not fit the map."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tmc.kernel.config import ConfigError, build
from tmc.kernel.grid import N_ACTIONS, OFF_GRID
from tmc.kernel.reward import Block
from tmc.kernel.roadmap import MapError, load_map
from tmc.kernel.world import World

Worlds = Callable[..., World]


@pytest.fixture(scope="module")
def toronto() -> World:
    return World(build({}))


# Rates


def test_only_road_cells_are_monitored(world_of: Worlds) -> None:
    world = world_of({"world.alpha": 0.02})
    assert (world.alpha == np.where(world.map.road, 0.02, 0.0)).all()
    assert (world.law.cells == np.flatnonzero(world.map.road)).all()


def test_offroad_cells_have_their_own_rate_and_blocked_cells_none(world_of: Worlds) -> None:
    world = world_of({"world.alpha": 0.02, "world.alpha_offroad": 0.001})
    expected = np.where(world.map.road, 0.02, 0.001)
    expected[world.map.blocked] = 0.0
    assert (world.alpha == expected).all()


@pytest.mark.parametrize("rates", ["volume", "blend"])
def test_uneven_rates_keep_the_mean(rates: str, toronto: World) -> None:
    world = World(build({"world.rates": rates}))
    road = world.map.road
    assert world.alpha[road].mean() == pytest.approx(0.01)
    assert world.alpha[road].std() > 0.001
    assert (world.alpha[~road] == 0).all()
    assert (world.law.cells == toronto.law.cells).all()


def test_the_map_is_loaded_by_name_unless_it_is_given(toronto: World) -> None:
    assert toronto.map.fingerprint == load_map("downtown-toronto").fingerprint
    given = load_map("downtown-toronto", "all")
    assert World(build({}), given).map is given


def test_the_papers_world(toronto: World) -> None:
    """30 x 30 cells of 60 m (Sec. IV-A)."""
    assert (toronto.grid.rows, toronto.grid.cols, toronto.map.cell_m) == (30, 30, 60.0)


# Starts


@pytest.mark.parametrize("start", ["free", "road"])
def test_starts_are_distinct_and_allowed(start: str, world_of: Worlds) -> None:
    world = world_of({"team.size": 6, "world.start": start})
    allowed = ~world.map.blocked & (world.map.road if start == "road" else True)
    assert world.start_cells.tolist() == np.flatnonzero(allowed).tolist()
    for episode in range(1, 200):
        cells = world.starts(episode)
        assert len(set(cells)) == 6
        assert allowed[cells].all()


def test_a_memory_in_which_learning_cannot_start_is_refused(world_of: Worlds) -> None:
    """It holds whole ticks of the team: 126 transitions of 3 UAVs, where 128 are room for."""
    world_of({"team.size": 3, "replay.capacity": 128, "replay.learn_start": 126})
    with pytest.raises(ConfigError, match=r"larger than the 126 transitions that replay\.capacity holds"):
        world_of({"team.size": 3, "replay.capacity": 128, "replay.learn_start": 127})


def test_starts_differ_by_episode_and_seed_and_repeat(world_of: Worlds) -> None:
    one, other = world_of({"team.size": 6}), world_of({"team.size": 6, "training.seed": 2})
    assert one.starts(3) == one.starts(3) == world_of({"team.size": 6}).starts(3)
    assert one.starts(3) != one.starts(4)
    assert one.starts(3) != other.starts(3)


def test_every_cell_is_a_start_as_often_as_any_other(world_of: Worlds) -> None:
    world = world_of({"team.size": 1})
    n = world.start_cells.size
    counts = np.bincount([world.starts(e)[0] for e in range(1, 100 * n + 1)], minlength=world.grid.size)
    assert counts[world.map.blocked].sum() == 0
    assert np.abs(counts[world.start_cells] - 100).max() < 5 * np.sqrt(100 * (1 - 1 / n))


def test_golden_starts_of_the_papers_world(toronto: World) -> None:
    """Logs of old missions stay true: the same seed starts the same flights."""
    assert [toronto.starts(1), toronto.starts(2)] == [[133, 590, 535], [862, 219, 137]]


# Events


def test_arrivals_come_at_the_poisson_rate(toronto: World) -> None:
    """1,000 ticks of 323 cells with p = 1 - exp(-0.01): 3,214 events, give or take 4 deviations of 56; fixed seed."""
    counts = np.sum([toronto.arrivals(1, t) for t in range(1, 1001)], axis=0)
    p, road = -np.expm1(-0.01), toronto.map.road
    assert counts[~road].sum() == 0
    assert abs(counts.sum() - 1000 * 323 * p) < 4 * np.sqrt(1000 * 323 * p * (1 - p))
    assert abs(counts[road].var() / (1000 * p * (1 - p)) - 1) < 4 * np.sqrt(2 / 323), "cells are independent"


def test_arrivals_follow_the_rate_of_each_cell() -> None:
    world = World(build({"world.rates": "volume", "world.alpha": 0.05}))
    counts = np.sum([world.arrivals(2, t) for t in range(1, 2001)], axis=0)[world.map.road]
    expected = 2000 * -np.expm1(-world.alpha[world.map.road])
    assert (np.abs(counts - expected) < 5 * np.sqrt(expected)).all()


def test_arrivals_are_addressed(toronto: World) -> None:
    def at(world: World, episode: int, tick: int) -> bytes:
        return world.arrivals(episode, tick).tobytes()

    toronto.arrivals(5, 9)
    assert at(toronto, 1, 1) == at(World(build({})), 1, 1)
    assert np.flatnonzero(toronto.arrivals(1, 1)).tolist() == [11, 633, 731, 737]
    others = {at(toronto, 1, 2), at(toronto, 2, 1), at(World(build({"training.seed": 2})), 1, 1)}
    assert at(toronto, 1, 1) not in others
    assert len(others) == 3


def test_more_events_come_at_higher_rates_and_the_same_ones_too(world_of: Worlds) -> None:
    """The same draws against a higher threshold: two missions that differ in alpha share their chance."""
    few, many = world_of({"world.alpha": 0.05}), world_of({"world.alpha": 0.5})
    assert all((many.arrivals(1, t) >= few.arrivals(1, t)).all() for t in range(1, 100))


# The initial map


def test_initial_map_is_visited_by_default(world_of: Worlds) -> None:
    assert world_of().initial_factor(1) is None


def test_random_initial_map_is_uniform_and_certain_under_the_uavs() -> None:
    """s_k = 1 - u_k(0): in (0, 1], 1 under a UAV, uniform elsewhere (Fig. 4b)."""
    world = World(build({"world.initial_map": "random", "world.start": "road", "team.size": 10}))
    factors = []
    for episode in range(1, 31):
        s = world.initial_factor(episode)
        assert s is not None
        assert s.shape == world.law.cells.shape
        assert ((s > 0) & (s <= 1)).all()
        under = np.isin(world.law.cells, world.starts(episode))
        assert under.sum() == 10
        assert (s[under] == 1.0).all()
        assert world.law.values(np.zeros(s.size, np.uint16), 0, s)[under].sum() == 0.0
        factors.append(s[~under])
    all_s = np.sort(np.concatenate(factors))
    gap = np.abs(all_s - (np.arange(all_s.size) + 0.5) / all_s.size).max()
    assert gap < 1.95 / np.sqrt(all_s.size), "Kolmogorov-Smirnov, 0.1 %"


def test_random_initial_map_is_addressed_by_episode_and_seed(world_of: Worlds) -> None:
    settings = {"world.initial_map": "random"}

    def factor(episode: int, seed: int) -> bytes:
        s = world_of({**settings, "training.seed": seed}).initial_factor(episode)
        assert s is not None
        return s.tobytes()

    assert factor(1, 1) == factor(1, 1)
    assert len({factor(1, 1), factor(2, 1), factor(1, 2)}) == 3


# Exploration


def test_exploration_draws_belong_to_one_uav_of_one_episode(world_of: Worlds) -> None:
    world = world_of()
    draws = world.explorations(1, 0)
    assert draws.shape == (50, 2)
    assert (draws == world.explorations(1, 0)).all()
    for other in (world.explorations(1, 1), world.explorations(2, 0)):
        assert not np.isin(draws, other).any()


def test_exploration_draws_are_uniform(world_of: Worlds) -> None:
    draws = np.concatenate([world_of().explorations(e, u) for e in range(1, 41) for u in range(5)])
    assert np.abs(draws.mean(axis=0) - 0.5).max() < 4 / np.sqrt(12 * len(draws))
    assert abs(np.corrcoef(draws.T)[0, 1]) < 4 / np.sqrt(len(draws))


# Settings that do not fit


def test_a_team_larger_than_the_road_is_refused(world_of: Worlds) -> None:
    assert world_of({"team.size": 17}).config.team.size == 17
    with pytest.raises(
        ConfigError, match=r"team\.size = 18 is larger than the 17 road cells of raster: use 17 or fewer"
    ):
        world_of({"team.size": 18})


def test_unknown_rates_are_refused_with_those_the_map_has(world_of: Worlds) -> None:
    with pytest.raises(ConfigError, match=r"world\.rates = 'volume' is unknown to the map raster: choose uniform"):
        world_of({"world.rates": "volume"})
    with pytest.raises(ConfigError, match="choose blend, uniform, volume"):
        World(build({"world.rates": "rain"}))


def test_an_unknown_map_is_refused() -> None:
    with pytest.raises(MapError, match="no map and no file"):
        World(build({"world.map": "atlantis"}))


def test_moves_say_where_an_action_leads_and_what_blocks_it(toronto: World) -> None:
    grid, blocked = toronto.grid, toronto.map.blocked
    causes = set()
    for cell in range(grid.size):
        for action in range(N_ACTIONS):
            target = int(grid.targets[cell, action])
            after, block = toronto.moves[cell][action]
            expected = Block.GRID if target == OFF_GRID else Block.OBSTACLE if blocked[target] else Block.NONE
            assert (after, block) == (cell if expected else target, expected)
            causes.add(block)
    assert causes == {Block.NONE, Block.GRID, Block.OBSTACLE}

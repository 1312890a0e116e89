"""Sec. III-B: state, observation, actions and reward."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tmc.kernel.config import build
from tmc.kernel.grid import ACTIONS, N_ACTIONS
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import World

Fly = Callable[..., Any]


@pytest.fixture(scope="module")
def toronto() -> World:
    return World(build({}))


def test_eq_10_in_scenario_1_the_observation_is_the_state(fly: Fly) -> None:
    """[p_i, M, p_-i, U]: all of it can be read from the three channels, so the process is fully observable."""
    flown = fly({"scenario": 1, "world.alpha": 0.1})
    world, observer = flown.world, ObservationBuilder(flown.world)
    for (episode, uav, t), state in flown.sights.items():
        positions, terrain, u = observer.observe(state.cell, state.peers, state.u).reshape(3, -1)
        team = flown.cells[episode][t].tolist()
        assert np.flatnonzero(positions == 1.0).tolist() == [team[uav]]
        assert np.flatnonzero(positions == 0.5).tolist() == sorted(team[:uav] + team[uav + 1 :])
        assert (terrain == np.where(world.map.blocked, -1, world.map.road)).all()
        assert u.sum() == flown.series("uncertainty", episode)[t]


def test_eqs_11_and_12_observation_has_three_channels_of_m_by_m(toronto: World) -> None:
    """o_i = [P_i, M, U_i]; different values for the ego UAV and N_i, and for obstacles, free cells and roads."""
    observer = ObservationBuilder(toronto)
    u = np.linspace(0, 1, toronto.law.cells.size)
    observation = observer.observe(435, [436, 404], u)
    assert observation.shape == (3, 30, 30)
    positions, terrain, own_map = observation
    assert (positions[14, 15], positions[14, 16], positions[13, 14]) == (1.0, 0.5, 0.5)
    assert positions.sum() == 2.0
    assert set(np.unique(terrain)) == {-1.0, 0.0, 1.0}
    assert (terrain == 1).sum() == toronto.map.road.sum()
    assert (own_map.ravel()[toronto.law.cells] == u.astype(np.float32)).all()


def test_sec_3b_the_nine_actions() -> None:
    """North, south, west, east, northwest, northeast, southwest, southeast, or remain."""
    assert [name for name, _, _ in ACTIONS] == ["N", "S", "W", "E", "NW", "NE", "SW", "SE", "stay"]
    assert N_ACTIONS == 9


def test_sec_3b_actions_lead_to_the_neighbouring_cells(toronto: World) -> None:
    k = toronto.grid.cell(10, 10)
    assert [divmod(int(x), 30) for x in toronto.grid.targets[k]] == [
        (9, 10), (11, 10), (10, 9), (10, 11), (9, 9), (9, 11), (11, 9), (11, 11), (10, 10),
    ]  # fmt: skip


@pytest.mark.parametrize("pilot", ["planner:random", "planner:greedy"])
@pytest.mark.parametrize("scenario", [1, 2])
def test_eq_13_reward_of_every_step(pilot: str, scenario: int, fly: Fly) -> None:
    """r = r^c + r^n + lambda r^u: -20 when blocked and nothing else; +1 for a cell not visited so far; 5 u_k before
    the visit, by the true map. Recomputed from cells and blocks; the journal holds the team's mean."""
    flown = fly({"team.controller": pilot, "scenario": scenario, "world.alpha": 0.05, "team.size": 6})
    world, index = flown.world, flown.world.law.index_list
    blocks = {(r.episode, r.tick - n, r.uav): b for r in flown.records for n, b in enumerate(r.blocks[::-1].tolist())}
    assert any(blocks.values())
    for episode, cells in flown.cells.items():
        tau, active = np.zeros(world.grid.size), np.zeros(world.grid.size, bool)
        seen = [{int(k)} for k in cells[0]]
        journal = flown.series("reward", episode)
        for t in range(1, 38):
            rewards = []
            for i, k in enumerate(cells[t].tolist()):
                u = 0.0
                if index[k] >= 0:
                    u = float(active[k]) if scenario == 1 else 1 - np.exp(-0.05 * (t - tau[k]))
                rewards.append(-20.0 if blocks[episode, t, i] else (k not in seen[i]) + 5 * u)
                seen[i].add(k)
                tau[k] = t
                active[k] = False
            active |= world.arrivals(episode, t)
            assert journal[t] == pytest.approx(np.mean(rewards), abs=1e-4)


def test_eq_13_visiting_uncertain_cells_pays_what_it_takes_from_eq_06(fly: Fly) -> None:
    """The accounting identity, end to end: with every true u before a visit, eq. (6) of the flight follows."""
    flown = fly({"comms.period": 10})
    world, q, T = flown.world, np.exp(-0.01), 37
    unvisited = world.law.cells.size * sum(1 - q**t for t in range(1, T + 1))
    for episode, cells in flown.cells.items():
        tau, taken = np.zeros(world.grid.size), 0.0
        for t in range(1, T + 1):
            for k in cells[t][world.map.road[cells[t]]].tolist():
                taken += (1 - q ** (t - tau[k])) * (1 - q ** (T - t + 1)) / (1 - q)
                tau[k] = t
        assert sum(flown.series("uncertainty", episode)[1:]) == pytest.approx(unvisited - taken, abs=1e-9)

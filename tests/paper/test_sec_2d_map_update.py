"""Sec. II-D: the update of the map in scenario I, and the local and the global update in scenario II."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

Fly = Callable[..., Any]


def test_sec_2d_scenario_1_visited_cells_are_cleared_then_new_events_appear(fly: Fly) -> None:
    """e_k(t+1) = 0 for k in V^v, then 1 for k in V^n; all other cells keep theirs."""
    flown = fly({"scenario": 1, "world.alpha": 0.1})
    world = flown.world
    for episode, cells in flown.cells.items():
        e, total = np.zeros(world.grid.size, bool), flown.series("uncertainty", episode)
        for t in range(38):
            if t:
                e[cells[t]] = False
                e |= world.arrivals(episode, t)
            assert total[t] == e.sum()
            for uav in range(4):
                if t < 37:
                    assert (flown.sights[episode, uav, t].u == e[world.law.cells]).all()


@pytest.mark.parametrize("period", [1, 10, 50])
@pytest.mark.parametrize("initial", ["visited", "random"])
def test_sec_2d_local_and_global_update(period: int, initial: str, fly: Fly) -> None:
    """Between exchanges tau = t for the own cell and those of sensed UAVs; at an exchange every visit up to t."""
    settings = {"comms.period": period, "world.initial_map": initial, "team.size": 6}
    flown = fly({**settings, "team.controller": "planner:greedy"})
    world, team = flown.world, range(6)
    for episode, cells in flown.cells.items():
        tau = np.zeros((6, world.grid.size), np.uint16)
        all_visits, s = np.zeros(world.grid.size, np.uint16), world.initial_factor(episode)
        for t in range(37):
            all_visits[cells[t]] = t
            for i in team:
                near = [j for j in team if world.grid.within(cells[t, i], cells[t, j], 1.5)]
                tau[i, cells[t, near]] = t
                if t % period == 0:
                    tau[i] = np.maximum(tau[i], all_visits)
                expected = world.law.values(tau[i, world.law.cells], t, s)
                assert flown.sights[episode, i, t].u.tolist() == expected.tolist()


def test_sec_2d_staggered_exchange_never_forgets_and_never_invents_a_visit(fly: Fly) -> None:
    """A UAV knows at least its own visits, and nothing later than what was flown."""
    flown = fly({"comms.phase": "staggered", "team.size": 6})
    world = flown.world
    for episode, cells in flown.cells.items():
        truth, own = np.zeros(world.grid.size, np.uint16), np.zeros((6, world.grid.size), np.uint16)
        for t in range(37):
            truth[cells[t]] = t
            for i in range(6):
                own[i, cells[t, i]] = t
                u = flown.sights[episode, i, t].u
                assert (u >= world.law.values(truth[world.law.cells], t)).all()
                assert (u <= world.law.values(own[i, world.law.cells], t)).all()


def test_sec_2d_the_tmc_sends_the_same_map_to_all(fly: Fly) -> None:
    flown = fly()
    for episode, tick in {(x.episode, x.tick) for _, x in flown.maps}:
        sent = [x.last_visit.tobytes() for _, x in flown.maps if (x.episode, x.tick) == (episode, tick)]
        assert len(sent) == 4
        assert len(set(sent)) == 1

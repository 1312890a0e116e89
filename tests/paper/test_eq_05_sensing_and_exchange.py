"""Sec. II-C: which UAVs are in sensing range, and when a UAV and the TMC exchange what."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import pytest

Fly = Callable[..., Any]


@pytest.mark.parametrize("radius", [1.0, 1.5, 2.9])
def test_eq_05_neighbours_are_the_uavs_within_r_s(radius: float, fly: Fly) -> None:
    """N_i(t) = {i' != i: |p_i(t) - p_i'(t)| <= r_s}, and no other location is known."""
    flown = fly({"team.size": 8, "team.sensing_range": radius})
    cols, met = flown.world.grid.cols, 0
    for (episode, uav, t), state in flown.sights.items():
        team = flown.cells[episode][t].tolist()
        others = [k for i, k in enumerate(team) if i != uav]
        near = [k for k in others if math.dist(divmod(k, cols), divmod(team[uav], cols)) <= radius]
        assert state.peers == near
        met += len(near)
    assert met > 100


def test_sec_2c_in_scenario_1_every_location_is_known(fly: Fly) -> None:
    flown = fly({"scenario": 1})
    for (episode, uav, t), state in flown.sights.items():
        team = flown.cells[episode][t].tolist()
        assert state.peers == team[:uav] + team[uav + 1 :]


@pytest.mark.parametrize(("period", "phase"), [(10, "together"), (10, "staggered"), (1, "together"), (50, "together")])
def test_sec_2c_the_exchange_takes_place_every_T_u(period: int, phase: str, fly: Fly) -> None:  # noqa: N802
    """And at the end of the episode, so that no visit is lost."""
    flown = fly({"comms.period": period, "comms.phase": phase})
    ticks = defaultdict(list)
    for record in flown.records:
        if record.episode == 1:
            ticks[record.uav].append(record.tick)
    for uav, shipped in ticks.items():
        first = uav * period // 4 if phase == "staggered" else 0
        assert shipped == sorted({*range(first, 37, period), 37})
    assert len({tuple(shipped) for shipped in ticks.values()}) == (4 if phase == "staggered" else 1)


def test_sec_2c_scenario_1_is_continuous_communication(fly: Fly) -> None:
    flown = fly({"scenario": 1, "comms.period": 10})
    assert [r.tick for r in flown.records if (r.episode, r.uav) == (1, 0)] == list(range(38))


def test_sec_2c_a_record_holds_every_location_since_the_last(fly: Fly) -> None:
    """The memory of visited cells is as long as it must be: each tick is shipped once."""
    flown = fly()
    for episode in (1, 2):
        for uav in range(4):
            mine = [r for r in flown.records if (r.episode, r.uav) == (episode, uav)]
            assert [t for r in mine for t in range(r.first, r.tick + 1)] == list(range(38))
            assert all(r.cells.size == r.tick - r.first + 1 for r in mine)

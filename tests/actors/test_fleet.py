"""Whole missions in lock step: what holds for any team of planners."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World

MISSIONS = [
    (planner, size, scenario)
    for planner in ("random", "random-road", "greedy")
    for size, scenario in ((1, 2), (3, 1), (8, 2), (30, 2), (30, 1))
]


@pytest.mark.parametrize("where", ["town", "toronto"])
@pytest.mark.parametrize(("planner", "size", "scenario"), MISSIONS)
def test_the_rules_of_flight(
    flown: Callable[[World], Any], world_of: Callable[..., World], request: pytest.FixtureRequest, where: str,
    planner: str, size: int, scenario: int,
) -> None:  # fmt: skip
    """No two UAVs share a cell (eq. 1), none leaves the grid or enters an obstacle, none flies farther than a cell."""
    road_map: RoadMap = request.getfixturevalue(where)
    T = 40 if size < 30 else 15
    values = {"team.size": size, "team.controller": f"planner:{planner}", "training.ticks": T, "scenario": scenario}
    world = world_of({**values, "training.episodes": 1, "comms.phase": "staggered"}, road_map)
    mission = flown(world)
    assert mission.fleet.idle and mission.station.phase == "done"
    assert [len(track) for track in mission.tracks] == [T + 1] * size
    assert [track[0] for track in mission.tracks] == world.starts(1)
    for cells in zip(*mission.tracks, strict=True):
        assert len(set(cells)) == size
        assert all(0 <= k < road_map.grid.size and not road_map.blocked[k] for k in cells)
    for track in mission.tracks:
        assert all(road_map.grid.chebyshev(a, b) <= 1 for a, b in pairwise(track))


def test_the_same_settings_fly_the_same_mission(
    flown: Callable[[World], Any], world_of: Callable[..., World], town: RoadMap
) -> None:
    values = {"team.size": 5, "team.controller": "planner:greedy", "training.ticks": 60, "training.episodes": 1}
    first, again = (flown(world_of(values, town)).tracks for _ in range(2))
    other = flown(world_of({**values, "training.seed": 2}, town)).tracks
    assert first == again != other


def test_every_episode_is_flown(flown: Callable[[World], Any], world_of: Callable[..., World], town: RoadMap) -> None:
    values = {"team.size": 4, "team.controller": "planner:random-road", "training.ticks": 15, "training.episodes": 4}
    mission = flown(world_of(values, town))
    assert mission.station.episodes == 4
    for e in range(1, 5):
        starts = [track[(e - 1) * 16] for track in mission.tracks]
        assert starts == mission.world.starts(e)


def test_greedy_beats_random_flight(
    flown: Callable[[World], Any], world_of: Callable[..., World], toronto: RoadMap
) -> None:
    """A planner that uses its map keeps the uncertainty lower than one that does not."""
    mean = {}
    for planner in ("random", "random-road", "greedy"):
        values = {
            "team.size": 5,
            "team.controller": f"planner:{planner}",
            "training.ticks": 300,
            "training.episodes": 1,
        }
        mean[planner] = flown(world_of(values, toronto)).station.episode_uncertainty
    assert mean["greedy"] < mean["random-road"] < mean["random"]

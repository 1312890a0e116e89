"""Fixtures of the actors' tests: a small town, worlds in it, and fleets that fly whole missions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest

from actors.fleet import Fleet
from actors.pilot import Pilot
from actors.planners import PlannerController
from actors.tracks import TableTracks, TrackTable
from tmc.center.roster import uav_name
from tmc.center.station import Station
from tmc.kernel.config import build
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.roadmap import RoadMap, load_map, parse_raster
from tmc.kernel.world import World
from tmc.wire import messages as m

RASTER = """\
############
#..X.#....X#
#..X.#.....#
#....#..X..#
############
#..#...#...#
#X.#...#.X.#
#..#...#...#
############
"""


class RunData:
    """A mission of planners in lock step, with a TMC that is called directly; `tracks[i]`: cell of UAV i by tick."""

    def __init__(self, world: World) -> None:
        config = world.config
        N, who = config.team.size, config.team.controller
        self.world, self.station, self.records = world, Station(world, "run", learning=False), list[m.Record]()
        table, observer = TrackTable(N, config.training.ticks), ObservationBuilder(world)
        planner = PlannerController(world, who)
        pilots = [
            Pilot(world, i, 1, TableTracks(table, i), observer, lambda _: planner, planner) for i in range(N)
        ]  # fmt: skip
        self.fleet = Fleet(pilots, self._exchange)
        for i in range(N):
            for j, answer in self._exchange(i, m.Hello(role="uav", uav=i, incarnation=1)):
                self.fleet.deliver(j, answer)
        while self.fleet.step():
            pass
        self.tracks: list[list[int]] = [[] for _ in range(N)]
        for record in self.records:
            self.tracks[record.uav] += record.cells.tolist()

    def _exchange(self, uav: int, message: m.Message) -> list[tuple[int, m.Message]]:
        self.station.handle(uav_name(uav), message, 1.0)
        out = self.station.out.take()
        self.records += [e.values["record"] for e in out.entries if "record" in e.values]
        return [(int(name[4:]), answer) for name, answer in out.sends]


@pytest.fixture(scope="session")
def town() -> RoadMap:
    """A small map with obstacles, where UAVs meet often."""
    return parse_raster(RASTER)


@pytest.fixture(scope="session")
def toronto() -> RoadMap:
    return load_map("downtown-toronto")


@pytest.fixture(scope="session")
def world_of() -> Callable[..., World]:
    """A world with dotted keys replaced, on a map or on the text of one."""

    def make(values: Mapping[str, Any], where: RoadMap | str) -> World:
        return World(build(values), parse_raster(where) if isinstance(where, str) else where)

    return make


@pytest.fixture(scope="session")
def flown() -> Callable[[World], RunData]:
    return RunData

"""A mission flown by the real parties in one process, and everything that was said and done, for the paper's laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.fleet import Fleet
from actors.pilot import Pilot
from actors.planners import LocalState, PlannerController
from actors.tracks import TableTracks, TrackTable
from tmc.center.roster import uav_name
from tmc.center.station import Station
from tmc.kernel.config import build
from tmc.kernel.roadmap import parse_raster
from tmc.kernel.world import World
from tmc.wire import messages as m

TOWN = """\
.#..#...
####X###
.#..#..#
.#####.#
X#..####
.#..#..X
"""


@dataclass
class RunData:
    """What became of a mission; `cells[episode]`: shape (T + 1, N); `sights`: by (episode, uav, tick)."""

    world: World
    station: Station
    pilots: list[Pilot] = field(default_factory=list)
    records: list[m.Record] = field(default_factory=list)
    maps: list[tuple[int, m.Map]] = field(default_factory=list)
    entries: list[Any] = field(default_factory=list)
    sights: dict[tuple[int, int, int], LocalState] = field(default_factory=dict)

    @cached_property
    def cells(self) -> dict[int, NDArray[np.int64]]:
        config = self.world.config
        shape = (config.training.ticks + 1, config.team.size)
        flown = {e: np.full(shape, -1) for e in range(1, config.training.episodes + 1)}
        for record in self.records:
            flown[record.episode][record.first : record.tick + 1, record.uav] = record.cells
        return flown

    def of(self, topic: str, **values: Any) -> list[dict[str, Any]]:
        """The journal's entries of a topic with these values."""
        found = [e.values for e in self.entries if e.topic == topic]
        return [v for v in found if all(v[key] == value for key, value in values.items())]

    def series(self, name: str, episode: int) -> list[float]:
        """A metric of an episode, one number a tick from 0 on."""
        return [x for values in self.of("/tmc/metrics", episode=episode) for x in values[name]]


class Watched:
    """A planner whose every state is kept."""

    def __init__(self, flown: RunData, planner: str) -> None:
        self._flown, self._planner = flown, PlannerController(flown.world, planner)
        self.pilot: Pilot | None = None

    def choose(self, state: LocalState) -> int:
        assert self.pilot is not None
        self._flown.sights[self.pilot.episode, self.pilot.uav, state.tick] = state
        return self._planner.choose(state)


@pytest.fixture(scope="session")
def fly() -> Callable[..., RunData]:
    """Fly a mission on a small town; a team of pilot `policy` explores, and is greedy where it does not."""

    def make(settings: dict[str, Any] | None = None) -> RunData:
        small = {"team.size": 4, "team.controller": "planner:random-road", "training.episodes": 2, "training.ticks": 37}
        world = World(build({**small, **(settings or {})}), parse_raster(TOWN))
        config = world.config
        learned = config.team.controller == "policy"
        station = Station(world, "paper", learning=False, policy=b"a policy" if learned else None)
        flown = RunData(world, station)
        table = TrackTable(config.team.size, config.training.ticks)
        for i in range(config.team.size):
            watched = Watched(flown, "planner:greedy" if learned else config.team.controller)
            planner = None if learned else watched
            tracks = TableTracks(table, i)
            watched.pilot = Pilot(world, i, 1, tracks, station.observer, lambda _, w=watched: w, planner)
            flown.pilots.append(watched.pilot)

        def exchange(uav: int, message: m.Message) -> list[tuple[int, m.Message]]:
            if isinstance(message, m.Record):
                flown.records.append(message)
            station.handle(uav_name(uav), message, 0.0)
            out = station.out.take()
            flown.entries += out.entries
            assert not out.notes
            replies = [(int(to.removeprefix("uav-")), reply) for to, reply in out.sends]
            flown.maps += [(i, reply) for i, reply in replies if isinstance(reply, m.Map)]
            return replies

        fleet = Fleet(flown.pilots, exchange)
        for pilot in flown.pilots:
            for i, reply in exchange(pilot.uav, m.Hello(role="uav", uav=pilot.uav, incarnation=1)):
                fleet.deliver(i, reply)
        while fleet.step():
            pass
        assert station.phase == "done"
        return flown

    return make

"""`overfly bench actor`: whole steps of a UAV against textbook calls of ONNX Runtime on one image.

A step is: sense, observe, decide, move, reward, record. Both run in turns, in one process on one thread. The pilots of
a team fly the network of the settings with its initial weights. The TMC's part is not timed. Times are processor time.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import numpy as np

from actors.fleet import Fleet
from actors.pilot import Pilot
from actors.tracks import TableTracks, TrackTable
from deploy import policy_spec, settings
from deploy.bench import bounds
from deploy.bench.row import Row
from deploy.run.mission import check
from tmc.center.roster import uav_name
from tmc.center.station import Station
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import INPUT, OUTPUT
from tmc.kernel.world import World
from tmc.wire import messages as m

MIN_SHARE = 0.4
"""The least share of a whole step that the network should take."""
TEXTBOOK = f"x textbook calls/s, aim {MIN_SHARE:g}"
"""The reference of the steps per second."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument("--repeats", type=int, default=5, metavar="R", help="episodes to take medians of (default: 5)")
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Fly episodes, with one textbook call per step after each stretch; return the rows. Raises ConfigError."""
    bounds.number("--repeats", args.repeats, 1)
    values = {**policy_spec.FIXED, "training.episodes": args.repeats, **settings.chosen(args)}
    world = check(settings.config_for("paper", values))
    bounds.missions(world)
    team = Team(world, first_policy(world))
    flown = [team.fly(episode) for episode in range(1, args.repeats + 1)]
    steps, calls = (median(f[i] for f in flown) for i in (0, 1))
    share = median(call / step for step, call in flown)
    case = f"N={world.config.team.size}"
    return [
        Row("actor", f"{case} whole step", 1e6 * steps, "us", 1e6 * calls, share, "ONNX Runtime call / step"),
        Row("actor", f"{case} steps", 1 / steps, "UAV steps/s", 1 / calls, share, TEXTBOOK),
    ]


def first_policy(world: World) -> bytes:
    """Return the policy file of a learner that has not learned yet."""
    from learner.trainer import start  # noqa: PLC0415  torch only for this bench

    return start(world.config, world.grid).policy()[1]


class Team:
    """Pilots in one process, in lock step, and a TMC whose time is subtracted."""

    def __init__(self, world: World, policy: bytes) -> None:
        from actors.policy import PolicyController, open_model  # noqa: PLC0415  ONNX Runtime only for this bench

        config, observer = world.config, ObservationBuilder(world)
        self.station = Station(world, "bench", policy=policy, learning=False)
        self.controller = PolicyController(policy, config, observer)
        self._session, self._image = open_model(policy)[0], np.zeros((1, *observer.shape), np.float32)
        table = TrackTable(config.team.size, config.training.ticks)
        team = range(config.team.size)
        tracks = [TableTracks(table, i) for i in team]
        pilots = [Pilot(world, i, 1, tracks[i], observer, lambda _: self.controller) for i in team]
        self.fleet, self._elsewhere = Fleet(pilots, self._exchange), 0.0
        for i in team:
            for j, answer in self._exchange(i, m.Hello("uav", i, 1)):
                self.fleet.deliver(j, answer)

    def _exchange(self, uav: int, message: m.Message) -> list[tuple[int, m.Message]]:
        start = time.process_time()
        self.station.handle(uav_name(uav), message, 0.0)
        sends = self.station.out.take().sends
        self.station.committed()
        self._elsewhere += time.process_time() - start
        return [(int(to.removeprefix("uav-")), answer) for to, answer in sends if to.startswith("uav-")]

    def fly(self, episode: int) -> tuple[float, float]:
        """Fly the rest of an episode; return (s per whole step, s per textbook call)."""
        spent = textbook = 0.0
        before = flown = self._steps()
        while self.station.episode is not None and self.station.episode.number == episode:
            since, elsewhere = time.process_time(), self._elsewhere
            self.fleet.step()
            spent += time.process_time() - since - (self._elsewhere - elsewhere)
            steps, flown = self._steps() - flown, self._steps()
            textbook += self._calls(steps)
        return spent / (flown - before), textbook / (flown - before)

    def _steps(self) -> int:
        return sum(pilot.steps for pilot in self.fleet.pilots)

    def _calls(self, count: int) -> float:
        """Return the time (s) of `count` textbook forward passes of one image."""
        run, names, image = self._session.run, [OUTPUT], {INPUT: self._image}
        start = time.process_time()
        for _ in range(count):
            run(names, image)
        return time.process_time() - start

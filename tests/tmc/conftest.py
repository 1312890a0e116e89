"""What the TMC's tests share: whole missions without sockets, whose messages a test may interleave, lose and repeat."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from random import Random
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.airspace import Waiting
from actors.pilot import LostRecordsError, Phase, Pilot
from actors.planners import LocalState, PlannerController
from actors.radio import RadioTracks
from actors.tracks import TableTracks, TrackTable
from tmc.center.entries import JournalEntry
from tmc.center.roster import uav_name
from tmc.center.station import Station
from tmc.kernel.config import build
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import Floats, Ints, ObservationBuilder
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


class Paused(Exception):  # noqa: N818  not an error: the pilot has flown one tick and can go on
    """Lets a test interleave the pilots tick by tick."""


class Wanderer:
    """Half of the time towards the middle, where the others are too; otherwise anywhere, blocked or not."""

    def __init__(self, world: World) -> None:
        self.grid, self.masks = world.grid, world.config.exploration.mask_blocked
        self.middle = world.grid.cell(world.grid.rows // 2, world.grid.cols // 2)

    def choose(self, state: LocalState) -> int:
        if state.draw >= 0.5:
            return int((2 * state.draw - 1) * N_ACTIONS)
        targets = self.grid.target_lists[state.cell]
        inside = [a for a in range(N_ACTIONS) if targets[a] >= 0]
        return min(inside, key=lambda a: self.grid.chebyshev(targets[a], self.middle))

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        q = nine(state.tick, state.cell)
        return q[action], max(q[a] for a in state.allowed) if self.masks else max(q)


def nine(tick: int, cell: int) -> list[float]:
    """What `Wanderer` takes the nine actions to be worth; any numbers would do."""
    return [float(np.float32(3 * np.sin(0.7 * tick + 1.3 * cell + 2.1 * a))) for a in range(N_ACTIONS)]


class SpyPilot(Pilot):
    """Notes, at each tick, the observation and the actions that it may choose, and pauses after each move."""

    seen: dict[tuple[int, int, int], tuple[np.ndarray[Any, Any], list[int]]]

    def note(self) -> None:
        """Keep what the UAV acts on at t, or would at the end of an episode."""
        o = self.observer.observe(self.cell, self.peers, self.map_of(self.t))
        mask = self.config.exploration.mask_blocked
        could = self.observer.allowed(self.cell, self.peers) if mask else list(range(N_ACTIONS))
        self.seen[self.episode, self.t, self.uav] = (o, could)

    def _act(self) -> None:
        self.note()
        super()._act()

    def _move(self) -> None:
        super()._move()
        raise Paused


class Mission:
    """A station and its UAVs, and all that is on the air between them; `play` lets chance choose what happens next.

    The UAVs share a table of tracks, or, with `radio`, tell each other by beacons that the station passes on.
    """

    def __init__(
        self, values: Mapping[str, Any], road_map: RoadMap | None = None, *, learning: bool = False, radio: bool = False
    ) -> None:
        config = build({"training.episodes": 1, **values})
        self.world, self.radio = World(config, road_map), radio
        fixed = b"policy" if config.team.controller == "policy" and not learning else None
        tracks = "" if radio else "a table"
        self.station = Station(self.world, "run", learning=learning, policy=fixed, tracks=tracks)
        self.N, self.T = config.team.size, config.training.ticks
        self.observer = ObservationBuilder(self.world)
        self.table = TrackTable(self.N, self.T)
        self.seen: dict[tuple[int, int, int], tuple[np.ndarray[Any, Any], list[int]]] = {}
        self.entries: list[JournalEntry] = []
        self.safe, self.groups = 0, lambda: True
        """How many of the entries are committed; whether the group commit falls after this message."""
        self.notes: list[tuple[str, str]] = []
        self.heard: list[tuple[str, m.Message]] = []
        """What the station was told, in order."""
        self.learner: list[m.Message] = []
        self.up: list[deque[m.Message]] = [deque() for _ in range(self.N)]
        self.down: list[deque[m.Message]] = [deque() for _ in range(self.N)]
        self.home: set[int] = set()
        self.waits: dict[int, Waiting] = {}
        self.asked = self.restarts = 0
        self.incarnations = [0] * self.N
        self.pilots: list[SpyPilot] = []
        for i in range(self.N):
            self.pilots.append(self._pilot(i))
            self.up[i].append(m.Hello(role="uav", uav=i, incarnation=self.incarnations[i]))

    def _pilot(self, i: int) -> SpyPilot:
        who = self.world.config.team.controller
        planner = None if who == "policy" else PlannerController(self.world, who)
        self.incarnations[i] += 1
        tracks: TableTracks | RadioTracks = TableTracks(self.table, i)
        if self.radio:
            tracks = RadioTracks(i, self.N, self.world.grid, self.observer.sensing, self.up[i].append)
        pilot = SpyPilot(
            self.world, i, self.incarnations[i], tracks, self.observer, lambda _: Wanderer(self.world), planner
        )  # fmt: skip
        pilot.seen = self.seen
        return pilot

    def tell(self, sender: str, message: m.Message) -> list[tuple[str, m.Message]]:
        """The station takes a message; what it says to UAVs goes on the air. Returns all that it says."""
        self.heard.append((sender, message))
        self.station.handle(sender, message, 1.0)
        return self.take()

    def take(self) -> list[tuple[str, m.Message]]:
        """Put on the air and keep what the station has to say and to journal."""
        commits = self.groups()
        if commits:
            self.station.committed()
        out = self.station.out.take()
        self.entries += out.entries
        self.notes += out.notes
        self.safe = len(self.entries) if commits else self.safe
        for name, answer in out.sends:
            if name.startswith("uav-"):
                self.down[int(name[4:])].append(answer)
            elif name == "learner":
                self.learner.append(answer)
        return out.sends

    # What can happen next.

    def choices(self, stuck: set[int]) -> list[tuple[str, int]]:
        flying = (Phase.SENSE, Phase.ACT, Phase.MOVE)
        return [
            *(("up", i) for i in range(self.N) if self.up[i]),
            *(("down", i) for i in range(self.N) if self.down[i]),
            *(("fly", i) for i, p in enumerate(self.pilots) if p.phase in flying and i not in stuck),
        ]

    def happen(self, what: str, i: int) -> bool:
        """One thing happens; False when the pilot could not fly on."""
        if what == "up":
            self.tell(uav_name(i), self.up[i].popleft())
        elif what == "down":
            self._obey(i, self.down[i].popleft())
        else:
            try:
                record = self.pilots[i].advance()
            except Waiting as waiting:
                self.waits[i] = waiting
                return False
            except Paused:
                return True
            if record is not None:
                self.up[i].append(record)
        return True

    def _obey(self, i: int, message: m.Message) -> None:
        pilot, answer = self.pilots[i], None
        if isinstance(message, m.Begin):
            answer = pilot.on_begin(message)
        elif isinstance(message, m.Map):
            answer = pilot.on_map(message)
        elif isinstance(message, m.Policy):
            pilot.on_policy(message)
        elif isinstance(message, m.Lost):
            pilot.on_lost(message)
        elif isinstance(message, m.Welcome):
            self._say_again(i, message.sequence)
        elif isinstance(message, m.End):
            self.home.add(i)
        elif isinstance(message, m.Beacon) and isinstance(pilot.airspace.tracks, RadioTracks):
            pilot.airspace.tracks.on_beacon(message)
        if isinstance(message, m.Error):
            assert self.restarts and message.code == "state", message.text
            answer = m.Hello(role="uav", uav=i, incarnation=self.incarnations[i])
        if pilot.phase is Phase.ACT and pilot.t == self.T:
            pilot.note()
        if answer is not None:
            self.up[i].append(answer)

    def _say_again(self, i: int, sequence: int) -> None:
        """Resend what the TMC does not have; a process whose records are lost to both starts again."""
        try:
            self.up[i].extend(self.pilots[i].records_from(sequence))
        except LostRecordsError:
            assert self.restarts and self.incarnations[i] > 1, "acknowledged records are lost"
            self.lose(i, on_the_air=False)

    def silence(self) -> None:
        """Nothing moves: every UAV repeats itself, as its service does after a second."""
        for i, pilot in enumerate(self.pilots):
            if i in self.home:
                continue
            tracks = pilot.airspace.tracks
            if i in self.waits and isinstance(tracks, RadioTracks):
                tracks.request_track(self.waits[i].peer)
                self.asked += 1
            if pilot.phase is Phase.MAP and pilot.pending is not None:
                self.up[i].append(pilot.pending)
            elif pilot.phase is Phase.POLICY:
                self.up[i].append(m.PolicyRequest(version=pilot.wanted))
            else:
                self.up[i].append(m.Hello(role="uav", uav=i, incarnation=self.incarnations[i]))

    def lose(self, i: int, *, on_the_air: bool) -> None:
        """UAV i's process dies, with what it was about to send unless that is on the air; a new one says hello."""
        if not on_the_air:
            self.up[i].clear()
        self.down[i].clear()
        self.pilots[i] = self._pilot(i)
        self.up[i].append(m.Hello(role="uav", uav=i, incarnation=self.incarnations[i]))

    def restart(self, station: Station, entries: list[JournalEntry]) -> None:
        """The TMC is killed, and `station` goes on with these entries in its journal; what was on the air is lost."""
        self.station, self.entries, self.safe = station, entries, len(entries)
        self.restarts += 1
        for queue in (*self.up, *self.down):
            queue.clear()

    def steps(self, rng: Random | None = None, crash: float = 0.0) -> Iterator[tuple[str, int]]:
        """Let things happen until all UAVs are home, and yield after each; without `rng` in a fixed order.

        `crash` is the chance that the process of a UAV is lost when it was about to fly.
        """
        stuck: set[int] = set()
        silences = 0
        while len(self.home) < self.N:
            choices = self.choices(stuck)
            if not choices:
                silences += 1
                assert silences < 12, f"the mission hangs: {[(p.t, p.phase) for p in self.pilots]}"
                self.silence()
                stuck.clear()
                continue
            what, i = rng.choice(choices) if rng is not None else choices[0]
            if rng is not None and what == "fly" and rng.random() < crash:
                self.lose(i, on_the_air=rng.random() < 0.5)
                stuck.clear()
                continue
            if self.happen(what, i):
                stuck.clear()
                self.waits.clear()
                silences = 0 if what == "fly" else silences
                yield what, i
            else:
                stuck.add(i)

    def play(self, rng: Random | None = None, crash: float = 0.0) -> Mission:
        """All of `steps`."""
        for _ in self.steps(rng, crash):
            pass
        return self

    # What came of it.

    @property
    def records(self) -> list[m.Record]:
        """The records in the journal, in the order in which they were taken."""
        return [e.values["record"] for e in self.entries if "record" in e.values]

    def flown(self) -> dict[tuple[int, int], dict[str, list[Any]]]:
        """(episode, uav) -> the cells, actions, blocks and own rewards of its whole flight, from the journal."""
        whole: dict[tuple[int, int], dict[str, list[Any]]] = {}
        for r in self.records:
            names = ("cells", "actions", "blocks", "rewards", "seen_tick", "seen_cell")
            parts = whole.setdefault((r.episode, r.uav), {name: [] for name in names})
            for name, values in parts.items():
                values.extend(getattr(r, name).tolist())
        return whole

    def row(self, episode: int, tick: int) -> int:
        """The replay's number of a tick."""
        return (episode - 1) * (self.T + 1) + tick

    def rebuilt(self, rows: Ints, uavs: Ints) -> tuple[Floats, NDArray[np.uint8]]:
        """Images of o_i at these rows, and the actions allowed there, as the replay has them."""
        replay = self.station.replay
        views = replay.views(rows, uavs)
        return replay.observer.observe_batch(views), replay.allowed(views)

    def differences(self, keys: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
        """Of these (episode, tick, uav), those that the replay rebuilds otherwise than the UAV saw them."""
        rows = np.array([self.row(e, t) for e, t, _ in keys])
        o, allowed = self.rebuilt(rows, np.array([i for _, _, i in keys]))
        wrong = []
        for k, key in enumerate(keys):
            saw, could = self.seen[key]
            if saw.tobytes() != o[k].tobytes() or np.flatnonzero(allowed[k]).tolist() != could:
                wrong.append(key)
        return wrong


@pytest.fixture(scope="session")
def town() -> RoadMap:
    """A small map with obstacles, where UAVs meet often."""
    return parse_raster(RASTER)


@pytest.fixture(scope="session")
def toronto() -> RoadMap:
    return load_map("downtown-toronto")


@pytest.fixture(scope="session")
def worth_of() -> Callable[[int, int], list[float]]:
    """(tick, cell) -> Q of the nine actions, as the UAVs of a mission with a policy have it."""
    return nine


@pytest.fixture(scope="session")
def mission() -> Callable[..., Mission]:
    """A mission with dotted keys replaced; see `Mission`."""
    return Mission

"""The TMC's process, killed before a group commit: what UAVs act on, its next incarnation knows too."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest
import zmq

from actors.pilot import Pilot
from actors.planners import LocalState
from actors.tracks import TableTracks, TrackTable
from tmc.center.commit_gate import MAX_TICKS_UNCOMMITTED
from tmc.center.journal import journal_in
from tmc.center.recovery import recover
from tmc.center.roster import LEARNER
from tmc.center.station import Station
from tmc.kernel.config import build, flat
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import World
from tmc.record.reader import Log
from tmc.wire import messages as m
from tmc.wire import sockets

ROOT = Path(__file__).parents[3]
PATIENCE_MS = 100_000
"""Milliseconds in which the TMC must answer."""
# Nothing is committed or flushed for its age while a test lasts.
VALUES = {
    "team.size": 1, "training.ticks": 3 * MAX_TICKS_UNCOMMITTED, "training.episodes": 1, "comms.period": 10,
    "journal.commit_interval": 60.0, "journal.flush_interval": 60.0,
}  # fmt: skip

Said = TypeVar("Said", bound=m.Message)


@pytest.fixture
def tmp_path(short: Path) -> Path:
    """The sockets lie beside the log."""
    return short


class Client:
    """A client of the TMC, which takes what comes until it is what it waits for."""

    def __init__(self, context: zmq.Context[Any], endpoint: str, name: str) -> None:
        self.sock, self.heard = sockets.dealer(context, endpoint, name), list[m.Message]()

    def say(self, *messages: m.Message) -> None:
        for message in messages:
            sockets.send(self.sock, message)

    def hear(self, kind: type[Said]) -> Said:
        while self.sock.poll(PATIENCE_MS):
            message = sockets.receive_message(self.sock)
            assert message is not None and not isinstance(message, m.Error), message
            self.heard.append(message)
            if isinstance(message, kind):
                return message
        raise AssertionError(f"the TMC sent no {kind.__name__}")


class Hovers:
    """What any policy file is here."""

    def choose(self, state: LocalState) -> int:
        return N_ACTIONS - 1


class Uav:
    """A process of UAV 0: it says hello, and takes the episode up."""

    def __init__(self, client: Client, world: World, incarnation: int) -> None:
        self.client = client
        tracks = TableTracks(TrackTable(1, world.config.training.ticks), 0)
        planner = None if world.config.team.controller == "policy" else Hovers()
        self.pilot = Pilot(world, 0, incarnation, tracks, ObservationBuilder(world), lambda _: Hovers(), planner)
        client.say(m.Hello("uav", 0, incarnation))
        self.begin = client.hear(m.Begin)
        self._obey(self.pilot.on_begin(self.begin))

    def _obey(self, wish: m.Message | None) -> None:
        if wish is not None:
            self.client.say(wish)
            self.pilot.on_policy(self.client.hear(m.Policy))

    def exchange(self) -> m.Map:
        """Fly up to the next exchange; the TMC's answer."""
        while (record := self.pilot.advance()) is None:
            pass
        self.client.say(record)
        answer = self.client.hear(m.Map)
        self._obey(self.pilot.on_map(answer))
        return answer


def push(learner: Client, version: int) -> None:
    """A new policy, and the TMC has it."""
    learner.say(m.PolicyPush(version, 100 * version, 0.0, b"policy %d" % version), m.StatusRequest())
    learner.hear(m.Status)


@pytest.fixture
def world() -> World:
    return World(build(VALUES))


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Callable[[str], Client]]:
    """Connects a client by its name."""
    context: zmq.Context[Any] = zmq.Context()
    clients: list[Client] = []

    def connect(name: str) -> Client:
        clients.append(Client(context, endpoint_of(name, tmp_path), name))
        return clients[-1]

    yield connect
    context.destroy(linger=0)


def endpoint_of(name: str, folder: Path) -> str:
    """Where a client finds the TMC."""
    endpoint = f"ipc://{folder}/sync"
    return sockets.learner_endpoint(endpoint) if name == LEARNER else endpoint


@contextmanager
def killed_in_the_end(world: World, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A TMC that goes on with what is in `folder`, and is killed when the block is left."""
    config = folder / "config.json"
    config.write_text(json.dumps(flat(world.config)))
    options = ("--config", str(config), "--bind", endpoint_of("uav-000", folder), "--out", str(folder), "--resume")
    with subprocess.Popen([sys.executable, "-P", "-m", "tmc", *options], cwd=ROOT) as tmc:
        try:
            yield tmc
        finally:
            tmc.kill()


@pytest.mark.parametrize("named", ["at the begin", "at an exchange"])
def test_a_policy_is_committed_before_an_answer_names_it(
    client: Callable[[str], Client], world: World, tmp_path: Path, named: str
) -> None:
    learner = client(LEARNER)
    with killed_in_the_end(world, tmp_path):
        push(learner, 1)
        uav = Uav(client("uav-000"), world, 1)
        version, reached = uav.begin.policy, uav.begin.shipped
        if named == "at an exchange":
            push(learner, 2)
            answer = uav.exchange()
            version, reached = answer.policy, answer.tick
    left, station = journal_in(tmp_path), Station(world, "run", learning=True)
    assert left is not None
    recover(station, left, 0.0)
    assert station.roster[0].policy == version == (1 if named == "at the begin" else 2)
    assert station.policies.find(version) == (version, b"policy %d" % version)
    assert station.episode is not None and station.episode.reported[0] == reached


def test_an_exchange_that_is_repeated_names_the_same_policy(
    client: Callable[[str], Client], world: World, tmp_path: Path
) -> None:
    """The learner pushes a newer one to the new TMC, before the UAV's new process is there again."""
    with killed_in_the_end(world, tmp_path):
        push(learner := client(LEARNER), 1)
        uav = Uav(client("uav-000"), world, 1)
        lost = [uav.exchange() for _ in range(5)]
    for gone in (learner, uav.client):  # or they would come back, and be taken for their successors
        gone.sock.close(linger=0)
    with killed_in_the_end(world, tmp_path):
        push(client(LEARNER), 2)
        uav = Uav(client("uav-000"), world, 2)
        assert uav.begin.tick < lost[-1].tick, "the exchanges were committed after all"
        again = [uav.exchange() for _ in range(5)]
        assert [(a.tick, a.policy) for a in again] == [(a.tick, a.policy) for a in lost]
        while (answer := uav.exchange()).policy == 1:
            assert answer.tick <= lost[-1].tick + MAX_TICKS_UNCOMMITTED, "the newer policy is never named"
        assert answer.policy == 2


def test_answers_are_not_far_ahead_of_what_is_committed(
    client: Callable[[str], Client], world: World, tmp_path: Path
) -> None:
    with killed_in_the_end(world, tmp_path):
        push(client(LEARNER), 1)
        uav = Uav(client("uav-000"), world, 1)
        while (answer := uav.exchange()).tick < 2 * MAX_TICKS_UNCOMMITTED:
            pass
    left, station = journal_in(tmp_path), Station(world, "run", learning=True)
    assert left is not None
    recover(station, left, 0.0)
    assert (
        station.episode is not None and answer.tick - MAX_TICKS_UNCOMMITTED <= station.episode.reported[0] < answer.tick
    )


def test_an_episode_is_committed_before_the_next_one_begins(client: Callable[[str], Client], tmp_path: Path) -> None:
    """No UAV could tell a process that flew its end again where the others were."""
    short = World(build({**VALUES, "training.ticks": 20, "training.episodes": 2, "team.controller": "planner:greedy"}))
    with killed_in_the_end(short, tmp_path):
        uav = Uav(client("uav-000"), short, 1)
        while uav.exchange().tick < 20:
            pass
        assert uav.client.hear(m.Begin).episode == 2
    left, station = journal_in(tmp_path), Station(short, "run", learning=False)
    assert left is not None
    recover(station, left, 0.0)
    assert station.episodes == 1


def test_a_tmc_that_was_stopped_blames_nobody_for_the_silence(client: Callable[[str], Client], tmp_path: Path) -> None:
    """As by a suspended machine, or a commit that a slow disk holds up."""
    short = World(build({**VALUES, "comms.lost_after": 3.0, "team.controller": "planner:greedy"}))
    with killed_in_the_end(short, tmp_path) as tmc:
        uav = Uav(client("uav-000"), short, 1)
        for _ in range(2):
            tmc.send_signal(signal.SIGSTOP)
            time.sleep(3.5)
            tmc.send_signal(signal.SIGCONT)
            time.sleep(0.2)
            uav.exchange()
        assert not [said for said in uav.client.heard if isinstance(said, m.Lost)]


def test_a_loss_is_committed_before_anybody_is_told(client: Callable[[str], Client], tmp_path: Path) -> None:
    silent = World(build({**VALUES, "comms.lost_after": 1.0, "team.controller": "planner:greedy"}))
    with killed_in_the_end(silent, tmp_path):
        uav = client("uav-000")
        uav.say(m.Hello("uav", 0, 1))
        uav.hear(m.Lost)
    left = journal_in(tmp_path)
    assert left is not None
    assert [entry.message.uav for entry in Log(left).entries(("/tmc/lost",))] == [0]

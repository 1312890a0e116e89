"""The TMC's core: who may say what when, exactly once, and a lost process leaves no trace in the episode."""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest

from tmc.center.replay import Ring
from tmc.center.roster import LEARNER, Outbox, away, uav_name
from tmc.center.station import Station
from tmc.kernel.config import Config, build, flat
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World
from tmc.record.channels import uav_topic
from tmc.wire import messages as m
from tmc.wire.codec import encode

SMALL = {"team.size": 2, "training.ticks": 12, "comms.period": 4}
LEARN = {**SMALL, "dqn.batch_size": 4, "replay.learn_start": 4, "replay.error_buffer": 2, "training.episodes": 2}


@pytest.fixture
def station_of(town: RoadMap) -> Callable[..., Station]:
    """A station of a small mission of planners, or of learning UAVs."""

    def make(values: dict[str, Any] | None = None, *, learning: bool = False, **more: Any) -> Station:
        pilot = "policy" if learning or "policy" in more else "planner:greedy"
        config = build({**SMALL, "training.episodes": 1, "team.controller": pilot, **(values or {})})
        return Station(World(config, town), "run-1", learning=learning, **more)

    return make


def sent(station: Station) -> list[tuple[str, m.Message]]:
    station.committed()
    return station.out.take().sends


def frames(message: m.Message) -> list[bytes]:
    return [bytes(frame) for frame in encode(message)]


def kinds(sends: list[tuple[str, m.Message]]) -> list[tuple[str, str]]:
    return [(to, type(message).__name__) for to, message in sends]


def hello(station: Station, i: int, incarnation: int = 1) -> list[tuple[str, m.Message]]:
    station.handle(uav_name(i), m.Hello("uav", i, incarnation), 1.0)
    return sent(station)


def first_record(station: Station, i: int, incarnation: int = 1, **fields: Any) -> m.Record:
    """What UAV i ships at tick 0."""
    assert station.episode is not None
    none = np.zeros(0, "u1")
    cells = np.array([station.episode.starts[i]], "<u2")
    record = m.Record(i, incarnation, 0, 1, 0, 0, 0, 0, cells, none, none, np.zeros(0, "<f4"), m.EMPTY, m.EMPTY)
    return dataclasses.replace(record, **fields)


def next_record(station: Station, i: int, first: int, tick: int, sequence: int, incarnation: int = 1) -> m.Record:
    """UAV i stays where it is."""
    assert station.episode is not None
    n = tick - first + 1
    cells = np.full(n, station.episode.starts[i], "<u2")
    moves = tick - max(first, 1) + 1
    stay, zero = np.full(moves, 8, "u1"), np.zeros(moves, "u1")
    reward = np.zeros(moves, "<f4")
    return m.Record(i, incarnation, sequence, 1, first, tick, 0, 0, cells, stay, zero, reward, m.EMPTY, m.EMPTY)


def state(station: Station) -> bytes:
    """All that a message may not change when it is rejected; it is counted all the same."""
    out = {"out", "rejected", "world", "config", "observer", "reward", "replay", "flight", "roster"}
    parts: list[Any] = [{k: v for k, v in vars(station).items() if k not in out}]
    parts += [(member.incarnation, member.sequence, member.answer) for member in station.roster]
    parts.append({k: v.data for k, v in vars(station.replay).items() if isinstance(v, Ring)})
    if station.episode is not None:
        parts.append({k: v for k, v in vars(station.episode).items() if k not in {"world", "reward", "replay"}})
    return pickle.dumps(parts)


def rejects(station: Station, sender: str, message: m.Message, code: str, text: str) -> None:
    """The message is answered by an error to its sender, counted, noted, and changes nothing."""
    before, count = state(station), station.rejected
    station.handle(sender, message, 99.0)
    out = station.out.take()
    assert [(to, type(e).__name__, getattr(e, "code", "")) for to, e in out.sends] == [(sender, "Error", code)]
    assert text in getattr(out.sends[0][1], "text", "")
    assert station.rejected == count + 1 and not out.entries
    assert out.notes[-1][0] == "WARNING" and sender in out.notes[-1][1]
    assert state(station) == before


# Gathering.


def test_the_episode_begins_when_everybody_is_here(station_of: Callable[..., Station]) -> None:
    station = station_of()
    assert station.phase == "gathering" and station.waiting_for() == ["uav-000", "uav-001"]
    sends = hello(station, 1)
    assert kinds(sends) == [("uav-001", "Welcome")]
    assert station.waiting_for() == ["uav-000"]
    sends = hello(station, 0)
    assert kinds(sends) == [("uav-000", "Welcome"), ("uav-000", "Begin"), ("uav-001", "Begin")]
    assert station.phase == "flying" and station.waiting_for() == ["uav-000", "uav-001"]
    starts = station.world.starts(1)
    for i in range(2):
        begin = sends[1 + i][1]
        assert isinstance(begin, m.Begin)
        assert (begin.episode, begin.tick, begin.shipped, begin.sequence) == (1, 0, -1, 0)
        assert begin.track.tolist() == [starts[i]] and not begin.last_visit.any()


def test_the_welcome_holds_the_whole_mission(station_of: Callable[..., Station]) -> None:
    station = station_of(tracks="/dev/shm/x")
    welcome = hello(station, 0)[0][1]
    assert isinstance(welcome, m.Welcome)
    assert build(json.loads(welcome.config)) == station.config != Config()
    assert json.loads(welcome.config) == flat(station.config)
    assert (welcome.map, welcome.run, welcome.tracks) == (station.world.map.fingerprint, "run-1", "/dev/shm/x")


def test_a_second_hello_of_the_same_process_is_harmless(station_of: Callable[..., Station]) -> None:
    station = station_of()
    hello(station, 0)
    assert kinds(hello(station, 0)) == [("uav-000", "Welcome")]
    assert station.waiting_for() == ["uav-001"] and station.phase == "gathering"


def test_learning_uavs_wait_for_a_policy(station_of: Callable[..., Station]) -> None:
    station = station_of(learning=True)
    hello(station, 0)
    hello(station, 1)
    assert station.phase == "gathering" and station.waiting_for() == ["learner"]
    station.handle(LEARNER, m.Hello("learner", -1, 5), 1.0)
    assert kinds(sent(station)) == [("learner", "Welcome")]
    station.handle(LEARNER, m.PolicyPush(1, 0, 0.0, b"theta"), 1.0)
    sends = sent(station)
    assert kinds(sends) == [("learner", "Ack"), ("uav-000", "Begin"), ("uav-001", "Begin")]
    assert sends[1][1].policy == 1  # type: ignore[attr-defined]
    station.handle("uav-000", m.PolicyRequest(1), 1.0)
    (to, policy), *_ = sent(station)
    assert (to, policy) == ("uav-000", m.Policy(1, b"theta"))


def test_planners_do_not_wait_for_the_learner(station_of: Callable[..., Station]) -> None:
    """What it names as missing is what the mission really waits for."""
    station = station_of({"team.controller": "planner:greedy"}, learning=True)
    hello(station, 0)
    assert station.waiting_for() == ["uav-001"]
    hello(station, 1)
    assert station.phase == "flying"


def test_strangers_are_refused(station_of: Callable[..., Station]) -> None:
    station = station_of()
    rejects(station, "uav-002", m.Hello("uav", 2, 1), "refused", "UAV 2")
    rejects(station, "uav-000", m.Hello("uav", -1, 1), "refused", "UAV -1")
    rejects(station, LEARNER, m.Hello("learner", -1, 1), "refused", "learner")
    rejects(station, "observer-1", m.PolicyRequest(1), "state", "no policy 1")
    for message in (m.Ack(1), m.End("x"), m.Welcome("", "", "", "", 0), m.Error("state", "x")):
        rejects(station, "observer-1", message, "state", "not a message for the TMC")


def test_nobody_says_hello_for_another(station_of: Callable[..., Station]) -> None:
    """A process that took the wrong number must not fence the right one."""
    station = station_of()
    hello(station, 0)
    rejects(station, "uav-001", m.Hello("uav", 0, 7), "refused", "uav-001")


def test_only_the_learner_says_hello_as_the_learner(station_of: Callable[..., Station]) -> None:
    station = station_of(learning=True)
    rejects(station, "uav-001", m.Hello("learner", -1, 7), "refused", "uav-001")


# Records.


@pytest.fixture
def flying(station_of: Callable[..., Station]) -> Station:
    station = station_of()
    hello(station, 0)
    hello(station, 1)
    return station


def test_an_exchange_is_answered_when_all_records_due_are_in(flying: Station) -> None:
    flying.handle("uav-000", first_record(flying, 0), 2.0)
    out = flying.out.take()
    assert out.sends == [] and [e.topic for e in out.entries] == [uav_topic(0, "record")]
    assert flying.waiting_for() == ["uav-001"]
    flying.handle("uav-001", first_record(flying, 1), 2.0)
    out = flying.out.take()
    assert kinds(out.sends) == [("uav-000", "Map"), ("uav-001", "Map")]
    topics = [uav_topic(1, "record"), "/tmc/sync", "/tmc/last_visit", "/tmc/metrics"]
    assert [e.topic for e in out.entries] == topics
    for _, answer in out.sends:
        assert isinstance(answer, m.Map)
        assert (answer.episode, answer.tick, answer.version, answer.sequence) == (1, 0, 1, 0)


def test_a_repeat_gets_the_same_answer_and_is_not_applied_twice(flying: Station) -> None:
    records = [first_record(flying, i) for i in range(2)]
    flying.handle("uav-000", records[0], 2.0)
    sent(flying)
    before = state(flying)
    flying.handle("uav-000", records[0], 2.0)  # not answered yet: there is nothing to repeat
    assert sent(flying) == [] and state(flying) == before
    flying.handle("uav-001", records[1], 2.0)
    answers = sent(flying)
    before = state(flying)
    for i, record in enumerate(records):
        flying.handle(uav_name(i), record, 2.0)
        out = flying.out.take()
        ((to, again),) = out.sends
        assert (to, frames(again)) == (answers[i][0], frames(answers[i][1]))
        assert not out.entries and not out.notes
    assert state(flying) == before and flying.rejected == 0


def test_a_repeat_of_an_older_record_is_dropped_in_silence(flying: Station) -> None:
    for tick, first, sequence in ((0, 0, 0), (4, 1, 1)):
        for i in range(2):
            record = first_record(flying, i) if tick == 0 else next_record(flying, i, first, tick, sequence)
            flying.handle(uav_name(i), record, 2.0)
    sent(flying)
    before = state(flying)
    flying.handle("uav-000", first_record(flying, 0), 2.0)
    out = flying.out.take()
    assert (out.sends, out.entries, flying.rejected) == ([], [], 0) and state(flying) == before


def test_a_gap_is_rejected(flying: Station) -> None:
    rejects(flying, "uav-000", first_record(flying, 0, sequence=1), "state", "record 1 of uav-000 is not the next one")
    rejects(flying, "uav-000", first_record(flying, 0, episode=2), "state", "not the next one")
    flying.handle("uav-000", first_record(flying, 0), 2.0)
    sent(flying)
    rejects(flying, "uav-000", next_record(flying, 0, 5, 8, 2), "state", "record 2 of uav-000 is not the next one")
    rejects(flying, "uav-000", next_record(flying, 0, 5, 8, 1), "refused", "starts at tick 5, expected 1")


def test_a_record_before_anything_flies_is_rejected(station_of: Callable[..., Station], flying: Station) -> None:
    station = station_of()
    hello(station, 0)
    rejects(station, "uav-000", first_record(flying, 0), "state", "not the next one")


def test_a_process_that_the_tmc_does_not_know_is_not_sent_away(
    station_of: Callable[..., Station], flying: Station
) -> None:
    """A restarted TMC has forgotten all clients: "fenced" would end UAVs that only have to say hello."""
    rejects(station_of(), "uav-000", first_record(flying, 0), "state", "hello")


def test_a_malformed_record_is_rejected(flying: Station) -> None:
    jump = dataclasses.replace(first_record(flying, 0), cells=np.array([flying.episode.starts[1]], "<u2"))  # type: ignore[union-attr]
    rejects(flying, "uav-000", jump, "refused", "did not start on cell")


def test_nobody_ships_for_another(flying: Station) -> None:
    rejects(flying, "uav-001", first_record(flying, 0), "refused", "uav-001 cannot ship a record of UAV 0")
    rejects(flying, LEARNER, first_record(flying, 0), "refused", "cannot ship a record")
    stranger = first_record(flying, 0, uav=2)
    rejects(flying, "uav-002", stranger, "refused", "cannot ship a record of UAV 2")
    rejects(flying, "uav-60000", first_record(flying, 0, uav=60_000), "refused", "cannot ship a record")


def test_an_old_life_is_fenced(flying: Station) -> None:
    """A newer process flies the UAV: the older one is told to leave, and what it ships changes nothing."""
    sends = hello(flying, 0, incarnation=2)
    assert kinds(sends) == [("uav-000", "Welcome"), ("uav-000", "Begin")]
    rejects(flying, "uav-000", first_record(flying, 0, incarnation=1), "fenced", "newer process flies uav-000")
    flying.handle("uav-000", first_record(flying, 0, incarnation=2), 2.0)
    assert flying.episode is not None and flying.episode.reported == [0, -1]


def test_an_old_life_cannot_come_back(flying: Station) -> None:
    """A process that hung while its successor took over says hello when it wakes up: it must not fence the new one."""
    hello(flying, 0, incarnation=2)
    rejects(flying, "uav-000", m.Hello("uav", 0, 1), "fenced", "newer process flies uav-000")
    flying.handle("uav-000", first_record(flying, 0, incarnation=2), 2.0)
    assert flying.episode is not None and flying.episode.reported == [0, -1]


def test_a_beacon_reaches_those_it_names(flying: Station) -> None:
    beacon = m.Beacon(0, 1, 3, np.array([7], "<u2"), np.array([0, 1, 5], "<u2"))
    flying.handle("uav-000", beacon, 1.0)
    assert sent(flying) == [("uav-001", beacon)]
    rejects(flying, "uav-001", beacon, "refused", "cannot send a beacon of UAV 0")


def test_status_says_who_is_waited_for(flying: Station) -> None:
    flying.handle("observer-9", m.StatusRequest(), 1.0)
    ((to, status),) = sent(flying)
    assert isinstance(status, m.Status) and to == "observer-9"
    assert (status.phase, status.episode, status.tick, status.waiting) == ("flying", 1, 0, "uav-000, uav-001")


def test_status_of_a_large_team_still_fits(toronto: RoadMap) -> None:
    """300 names are more than the 1024 characters of the field."""
    config = build({"team.size": 300, "team.controller": "planner:random", "training.ticks": 5})
    station = Station(World(config, toronto), "run", learning=False)
    station.handle("observer-9", m.StatusRequest(), 1.0)
    ((_, status),) = sent(station)
    assert isinstance(status, m.Status) and status.waiting.startswith("uav-000")


def test_a_silent_uav_is_named_once(flying: Station) -> None:
    patience = flying.config.comms.silence_warning
    flying.handle("uav-000", first_record(flying, 0), 5.0)
    flying.out.take()
    flying.tick(1.0 + patience)
    assert flying.out.take().notes == []
    flying.tick(1.1 + patience)
    ((level, text),) = flying.out.take().notes
    assert level == "WARNING" and "uav-001" in text and "tick 0" in text and "30 s" in text
    flying.handle("uav-000", m.Alive(0, 1, 0, 1, 0), 34.0)
    flying.tick(50.0)
    assert flying.out.take().notes == []
    flying.handle("uav-000", first_record(flying, 0), 51.0)  # as its service does while it waits
    flying.handle("uav-001", first_record(flying, 1), 51.0)
    flying.out.take()
    flying.tick(52.0)
    assert flying.out.take().notes == []
    flying.handle("uav-000", next_record(flying, 0, 1, 4, 1), 70.0)
    flying.out.take()
    flying.tick(90.0)
    ((_, text),) = flying.out.take().notes  # silent again: named again
    assert "uav-001" in text and "tick 4" in text


def test_who_waits_for_a_lost_uav_is_told_again_that_it_is_lost(flying: Station) -> None:
    """The first telling may have been lost with a connection, or with a TMC that was killed."""
    assert flying.episode is not None
    flying.lose(flying.episode, 1)
    flying.out.take()
    flying.handle("uav-000", m.Alive(0, 1, 0, 1, 0), 5.0)
    ((to, lost),) = flying.out.take().sends
    assert to == "uav-000" and lost == m.Lost(1, 1, -1)
    flying.handle("uav-000", m.Alive(0, 1, 0, -1, 0), 6.0)
    assert flying.out.take().sends == []


@pytest.mark.parametrize("tracks", ["", "a table"])
def test_who_shares_no_table_is_told_where_a_lost_uav_was(station_of: Callable[..., Station], tracks: str) -> None:
    """A beacon may have been lost, and it can no longer be asked."""
    station = station_of(tracks=tracks)
    hello(station, 0)
    hello(station, 1)
    assert station.episode is not None
    for i, record in (
        (0, first_record(station, 0)),
        (1, first_record(station, 1)),
        (1, next_record(station, 1, 1, 4, 1)),
    ):
        station.handle(uav_name(i), record, 1.0)
    sent(station)
    station.lose(station.episode, 1)
    told = [message for to, message in sent(station) if to == "uav-000"]
    cells = np.full(4, station.episode.starts[1], "<u2")
    beacons = [] if tracks else [m.Beacon(1, 1, 1, cells, np.array([0], "<u2"))]
    assert [frames(x) for x in told] == [frames(x) for x in (*beacons, m.Lost(1, 1, 4))]
    again = [message for _, message in hello(station, 0, incarnation=2)]  # its next process is told before it flies on
    assert [type(x) for x in again] == [m.Welcome, *(type(x) for x in beacons), m.Begin, m.Map]


def test_a_flight_is_taken_up_by_the_map_that_its_uav_was_given(station_of: Callable[..., Station]) -> None:
    """Not by a newer one, which another UAV was given at an exchange of its own."""
    station = station_of({"comms.phase": "staggered"})
    hello(station, 0)
    hello(station, 1)
    station.handle("uav-000", first_record(station, 0), 1.0)
    station.handle("uav-001", next_record(station, 1, 0, 2, 0), 1.0)
    assert (station.version, station.episode is not None) == (2, True)
    for i, version in ((0, 1), (1, 2)):
        (taken_up,) = (x for _, x in hello(station, i, incarnation=2) if isinstance(x, m.Begin))
        assert taken_up.version == version


def test_a_lost_uav_that_is_there_after_all_is_lost_once_and_has_no_part_in_the_episode(flying: Station) -> None:
    assert flying.episode is not None
    patience = flying.config.comms.lost_after
    flying.lose(flying.episode, 1)
    flying.out.take()
    flying.handle("uav-001", m.Alive(1, 1, 0, -1, 0), 5.0)
    assert kinds(flying.out.take().sends) == [("uav-001", "Error")]
    flying.handle("uav-001", m.Hello("uav", 1, 1), 6.0)
    assert kinds(flying.out.take().sends) == [("uav-001", "Welcome")]
    flying.handle("uav-000", m.Alive(0, 1, 0, -1, 0), 6.0 + patience)
    flying.tick(7.0 + patience)
    assert flying.out.take().entries == [] and away(flying.roster) == [1]
    flying.episode = None
    flying.begin_episode([1])
    assert [to for to, message in flying.out.take().sends if isinstance(message, m.Begin)] == ["uav-000"]


def test_what_is_to_be_said_outlasts_the_writing_of_the_journal() -> None:
    out = Outbox([("uav-000", m.End("over"))], [], [("INFO", "a note")])
    assert out.take_entries().notes == [("INFO", "a note")] and out.notes == []
    assert kinds(out.take_sends()) == [("uav-000", "End")]


def test_a_uav_that_came_back_can_be_named_again(flying: Station) -> None:
    flying.tick(40.0)
    assert len(flying.out.take().notes) == 2
    flying.handle("uav-001", m.Hello("uav", 1, 2), 41.0)
    flying.handle("uav-000", m.Alive(0, 1, 0, 1, 0), 60.0)
    flying.out.take()
    flying.tick(62.0)
    assert flying.out.take().notes == []
    flying.tick(75.0)
    assert ["uav-001" in text for _, text in flying.out.take().notes] == [True]


# The learner.


class Learning:
    """A learning mission whose UAVs stay where they are; messages are only sent when a test says so."""

    def __init__(self, station: Station) -> None:
        self.station = station
        hello(station, 0)
        hello(station, 1)
        station.handle(LEARNER, m.Hello("learner", -1, 5), 1.0)
        station.handle(LEARNER, m.PolicyPush(1, 0, 0.0, b"one"), 1.0)
        self.sequence = 0
        sent(station)

    def ship(self, first: int, tick: int) -> list[tuple[str, m.Message]]:
        """Both UAVs ship ticks first..tick of the current episode."""
        assert self.station.episode is not None
        episode = self.station.episode.number
        records = [
            first_record(self.station, i, episode=episode, sequence=self.sequence)
            if tick == 0
            else dataclasses.replace(next_record(self.station, i, first, tick, self.sequence), episode=episode)
            for i in range(2)
        ]
        for i, record in enumerate(records):
            self.station.handle(uav_name(i), record, 1.0)
        self.sequence += 1
        return sent(self.station)

    def ask(self, *requests: int) -> list[tuple[str, m.Message]]:
        for request in requests:
            self.station.handle(LEARNER, m.SampleRequest(request), 1.0)
        return sent(self.station)


@pytest.fixture
def learning(station_of: Callable[..., Station]) -> Learning:
    return Learning(station_of(LEARN, learning=True))


def test_minibatches_come_as_they_are_owed(learning: Learning) -> None:
    assert learning.ask(10, 11) == []
    learning.ship(0, 0)
    assert learning.ship(1, 4)[-1][0].startswith("uav")  # learning starts here: 8 transitions are held
    sends = learning.ship(5, 8)  # and 4 ticks more: 4 minibatches are due, 2 were asked for
    batches = [x for to, x in sends if to == LEARNER]
    assert [b.request for b in batches] == [10, 11]  # type: ignore[attr-defined]
    for b in batches:
        assert isinstance(b, m.Minibatch)
        assert (b.episodes, b.ticks, b.u.shape[0], b.reward.shape) == (0, 8, 8, (4,))
    assert learning.station.rate_limiter.samples_due == 2


def test_the_limiter_holds_answers_back_and_releases_them(learning: Learning) -> None:
    learning.ship(0, 0)
    learning.ship(1, 4)
    assert learning.station.waiting_for() == ["uav-000", "uav-001"]
    assert learning.ship(5, 8) == []  # 4 due, 2 allowed: the UAVs wait for the learner
    assert learning.station.waiting_for() == ["learner"]
    assert kinds(learning.ask(1)) == [("learner", "Minibatch")]
    sends = learning.ask(2)
    assert kinds(sends) == [("learner", "Minibatch"), ("uav-000", "Map"), ("uav-001", "Map")]
    assert [x.tick for _, x in sends[1:]] == [8, 8]  # type: ignore[attr-defined]
    learning.station.handle("uav-000", next_record(learning.station, 0, 5, 8, 2), 1.0)
    assert kinds(sent(learning.station)) == [("uav-000", "Map")]  # a repeat, answered now


def test_a_repeat_of_a_held_answer_does_not_get_around_the_limiter(learning: Learning) -> None:
    learning.ship(0, 0)
    learning.ship(1, 4)
    assert learning.ship(5, 8) == []
    learning.station.handle("uav-000", next_record(learning.station, 0, 5, 8, 2), 1.0)
    assert sent(learning.station) == []


def test_the_next_episode_does_not_get_around_the_limiter(learning: Learning) -> None:
    """Its begin is held back as the last maps are, from a UAV that resends its record and from one that is back."""
    learning.ship(0, 0)
    first, T = 1, learning.station.config.training.ticks
    while first <= T:
        sends = learning.ship(first, min(first + 3, T))
        while not sends and learning.station.rate_limiter.samples_due > 2 and first + 3 < T:
            sends = learning.ask(100)
        first += 4
    episode = learning.station.episode
    assert episode is not None and episode.number == 2 and learning.station.waiting_for() == ["learner"]
    last = dataclasses.replace(next_record(learning.station, 0, first - 4, T, learning.sequence - 1), episode=1)
    learning.station.handle("uav-000", last, 1.0)
    assert sent(learning.station) == []
    learning.station.handle("uav-001", m.Hello("uav", 1, 99), 1.0)
    assert kinds(sent(learning.station)) == [("uav-001", "Welcome")]
    sends = [send for n in range(learning.station.rate_limiter.samples_due) for send in learning.ask(n)]
    assert {(to, x.episode) for to, x in sends if isinstance(x, m.Begin)} == {("uav-000", 2), ("uav-001", 2)}


def test_there_is_one_learner_and_who_it_replaced_is_told_so(learning: Learning) -> None:
    station = learning.station
    station.handle(LEARNER, m.Hello("learner", -1, 6), 1.0)
    assert kinds(sent(station)) == [("learner", "Welcome")]
    for late in (
        m.Hello("learner", -1, 5, 900),
        m.PolicyPush(7, 9, 0.0, b"late", incarnation=5),
        m.SampleRequest(3, incarnation=5),
    ):
        station.handle(LEARNER, late, 1.0)
        ((to, error),) = sent(station)
        assert to == LEARNER and isinstance(error, m.Error) and (error.code, error.incarnation) == ("fenced", 5)
    assert station.policies.newest == 1
    station.handle(LEARNER, m.PolicyPush(2, 0, 0.0, b"mine", incarnation=6), 1.0)
    assert kinds(sent(station)) == [("learner", "Ack")] and station.policies.newest == 2


def test_at_most_eight_requests_are_in_flight(learning: Learning) -> None:
    assert learning.ask(*range(8)) == []
    rejects(learning.station, LEARNER, m.SampleRequest(8), "refused", "more than 8")


def test_errors_that_cannot_be_are_refused(learning: Learning, station_of: Callable[..., Station]) -> None:
    index, errors = np.arange(4), np.ones(3, "<f4")
    on = Learning(station_of({**LEARN, "replay.priority_exponent": 0.6}, learning=True)).station
    rejects(on, LEARNER, m.SampleRequest(1, index, errors), "refused", "an error for each transition")
    rejects(
        learning.station, LEARNER, m.SampleRequest(1, index[:3], errors), "refused", "replay.priority_exponent is 0"
    )


def test_only_the_learner_learns(learning: Learning, flying: Station) -> None:
    for sender in ("uav-000", "observer-1"):
        rejects(learning.station, sender, m.SampleRequest(1), "refused", "only the learner")
        rejects(learning.station, sender, m.PolicyPush(9, 1, 0.0, b"x"), "refused", "only the learner")
    rejects(flying, LEARNER, m.SampleRequest(1), "refused", "only the learner")
    rejects(flying, LEARNER, m.PolicyPush(1, 1, 0.0, b"x"), "refused", "only the learner")


def test_a_policy_must_be_newer(learning: Learning) -> None:
    station = learning.station
    station.handle(LEARNER, m.PolicyPush(3, 100, 0.5, b"three"), 1.0)
    out = station.out.take()
    assert out.sends == [(LEARNER, m.Ack(3))]
    assert [(e.topic, e.values["version"], e.values["updates"]) for e in out.entries] == [("/learner/policy", 3, 100)]
    rejects(station, LEARNER, m.PolicyPush(3, 200, 0.5, b"x"), "refused", "policy 3 is not newer than 3")
    rejects(station, LEARNER, m.PolicyPush(2, 200, 0.5, b"x"), "refused", "policy 2 is not newer than 3")


def test_the_policy_of_an_answer_can_be_had_as_long_as_it_may_be_asked_for(learning: Learning) -> None:
    """Otherwise a newer one comes, never an older."""
    station = learning.station
    sends = learning.ship(0, 0)
    assert {x.policy for _, x in sends} == {1}  # type: ignore[attr-defined]
    for version in range(2, 40):
        station.handle(LEARNER, m.PolicyPush(version, version, 0.0, b"%d" % version), 1.0)
    sent(station)
    station.handle("uav-001", m.PolicyRequest(1), 1.0)
    station.handle("uav-001", m.PolicyRequest(17), 1.0)
    assert [x for _, x in sent(station)] == [m.Policy(1, b"one"), m.Policy(39, b"39")]
    assert len(station.policies) < 5


def test_a_learner_from_an_older_checkpoint_is_owed_what_it_lost(learning: Learning) -> None:
    """Minibatch 0 of the second incarnation is minibatch 0 of the first, drawn again."""
    learning.ship(0, 0)
    learning.ship(1, 4)
    learning.ship(5, 8)
    first = learning.ask(0, 1, 2, 3)
    station = learning.station
    assert (station.rate_limiter.samples_due, station.rate_limiter.updates) == (0, 4)
    assert learning.ask(4, 5) == []
    station.handle(LEARNER, m.Hello("learner", -1, 6, updates=1), 1.0)
    assert kinds(sent(station)) == [("learner", "Welcome")]
    assert (station.rate_limiter.samples_due, station.rate_limiter.updates) == (3, 1)
    again = learning.ask(1)
    batches = [x for to, x in first if to == LEARNER]
    assert frames(again[0][1]) == frames(batches[1])
    station.handle(LEARNER, m.Hello("learner", -1, 6, updates=0), 1.0)  # a repeat takes nothing back
    assert station.rate_limiter.updates == 2
    sent(station)


def finish(learning: Learning) -> list[tuple[str, m.Message]]:
    """Both episodes, the learner keeping up; all that was sent from the last record on."""
    sends: list[tuple[str, m.Message]] = []
    for _ in range(2):
        learning.ship(0, 0)
        for first, tick in ((1, 4), (5, 8), (9, 12)):
            sends = learning.ship(first, tick)
            while learning.station.rate_limiter.samples_due > (0 if tick < 12 else 2):
                sends += learning.ask(0)
    return sends


@pytest.mark.parametrize("in_flight", [1, 3])
def test_the_end_reaches_everybody(learning: Learning, in_flight: int) -> None:
    """With one request in episode or several, the learner learns of the end, and so do the UAVs."""
    finish(learning)
    station = learning.station
    assert station.phase == "learning" and station.episode is None
    sends = learning.ask(*range(in_flight))
    while not any(isinstance(x, m.End) for _, x in sends):
        sends += learning.ask(7)
        assert len(sends) < 20, "the end never comes"
    assert station.phase == "done"
    told = {to for to, x in sends if isinstance(x, m.End)}
    assert told == {"learner", "uav-000", "uav-001"}
    for i in range(2):
        assert kinds(hello(station, i)) == [(uav_name(i), "Welcome"), (uav_name(i), "End")]


def test_a_learner_that_comes_back_after_the_end_is_told(learning: Learning) -> None:
    """The learner lost its last updates: they are due again, and it is sent the end again once it has caught up."""
    finish(learning)
    station = learning.station
    learning.ask(0, 1, 2)
    assert station.phase == "done"
    station.handle(LEARNER, m.Hello("learner", -1, 77, updates=station.rate_limiter.updates - 2), 1.0)
    sent(station)
    assert station.phase == "learning"
    sends = learning.ask(0, 1, 2)
    assert kinds([s for s in sends if s[0] == LEARNER]) == [("learner", "Minibatch")] * 2 + [("learner", "End")]


def test_a_learner_that_did_not_hear_of_the_end_is_told_again(learning: Learning) -> None:
    """Its connection was down just then; it says hello after a second of silence."""
    finish(learning)
    station = learning.station
    learning.ask(0, 1, 2)
    assert station.phase == "done"
    station.handle(LEARNER, m.Hello("learner", -1, station.sample_queue.incarnation, station.rate_limiter.updates), 1.0)
    assert kinds(sent(station)) == [("learner", "Welcome"), ("learner", "End")]


def test_a_mission_without_a_learner_ends_with_its_last_record(mission: Callable[..., Any], town: RoadMap) -> None:
    flown = mission({**SMALL, "training.episodes": 3, "team.controller": "planner:greedy"}, town).play(Random(1))
    assert flown.home == {0, 1} and flown.station.phase == "done" and flown.station.episodes == 3
    phases = [(e.values["episode"], e.values["phase"]) for e in flown.entries if e.topic == "/tmc/episode"]
    assert phases == [(e, p) for e in (1, 2, 3) for p in ("begin", "end")]


# Everything again.


def test_the_same_messages_give_the_same_answers(mission: Callable[..., Any], town: RoadMap) -> None:
    """The core is pure: playing what it heard through another one gives the same frames and the same journal."""
    values = {"team.size": 3, "training.ticks": 30, "training.episodes": 2, "comms.phase": "staggered"}
    flown = mission(values, town).play(Random(4), crash=0.03)
    again = mission(values, town)
    for sender, message in flown.heard:
        again.tell(sender, message)
    assert [e.topic for e in again.entries] == [e.topic for e in flown.entries]
    assert pickle.dumps([e.values for e in again.entries]) == pickle.dumps([e.values for e in flown.entries])
    assert again.notes == flown.notes
    first, second = flown.station.replay.sample(0, 50), again.station.replay.sample(0, 50)
    assert pickle.dumps(first) == pickle.dumps(second)


PILOTS = {
    "greedy": {"team.controller": "planner:greedy"},
    "greedy, scenario 1": {"team.controller": "planner:greedy", "scenario": 1},
    "random road": {"team.controller": "planner:random-road", "world.initial_map": "random"},
    "epsilon-greedy": {"exploration.end": 0.3, "comms.phase": "staggered", "comms.period": 7},
}


@pytest.mark.parametrize("pilots", list(PILOTS))
@pytest.mark.parametrize("seed", [1, 2])
def test_lost_uavs_come_back_and_fly_the_same_cells(
    mission: Callable[..., Any], town: RoadMap, pilots: str, seed: int
) -> None:
    """Processes die at random ticks, with their records lost or not: the journal holds the undisturbed episode."""
    values = {"team.size": 4, "training.ticks": 40, "training.episodes": 2, **PILOTS[pilots]}
    undisturbed = mission(values, town).play()
    rough = mission(values, town).play(Random(seed), crash=0.03)
    assert sum(rough.incarnations) > 4 + 3, "no UAV was lost"
    assert rough.flown() == undisturbed.flown()
    uncertainty = [
        [e.values["uncertainty"] for e in f.entries if e.topic == "/tmc/episode"] for f in (undisturbed, rough)
    ]
    assert uncertainty[0] == uncertainty[1]
    ticks, uavs = np.repeat(np.arange(2 * 41), 4), np.tile(np.arange(4), 2 * 41)
    ours, theirs = (f.rebuilt(ticks, uavs) for f in (undisturbed, rough))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(ours, theirs, strict=True))
    assert rough.station.rejected == 0


def test_a_uav_comes_back_to_the_knowledge_that_it_had(mission: Callable[..., Any], town: RoadMap) -> None:
    """Begin at the tick of the last record: the own track, the map, and the answer if there is one."""
    flown = mission({"team.size": 2, "training.ticks": 40, "comms.period": 10}, town)
    for _ in flown.steps():
        if flown.pilots[0].t == 14:
            break
    track = [c for r in flown.records if r.uav == 0 for c in r.cells.tolist()]
    flown.station.handle("uav-000", m.Hello("uav", 0, 99), 1.0)
    sends = sent(flown.station)
    assert kinds(sends) == [("uav-000", n) for n in ("Welcome", "Begin", "Map")]
    begin = sends[1][1]
    assert isinstance(begin, m.Begin)
    assert (begin.tick, begin.shipped, begin.sequence) == (10, 10, 2)
    assert begin.track.tolist() == track[:11]
    assert sends[2][1].tick == 10  # type: ignore[attr-defined]
    others = [c for r in flown.records if r.uav == 1 for c in r.cells.tolist()][:11]
    newest = {c: t for t, pair in enumerate(zip(track, others, strict=True)) for c in pair}
    assert begin.last_visit.tolist() == [newest.get(k, 0) for k in flown.world.law.cells.tolist()]


@pytest.mark.parametrize("scenario", [1, 2])
@pytest.mark.parametrize("phase", ["together", "staggered"])
def test_uavs_with_beacons_fly_the_same_cells(
    mission: Callable[..., Any], town: RoadMap, scenario: int, phase: str
) -> None:
    """No table: positions come by beacon. Nothing is lost here, so no UAV has to ask."""
    values = {"team.size": 4, "training.ticks": 60, "training.episodes": 2, "scenario": scenario}
    values |= {"comms.phase": phase, "exploration.end": 0.3}
    flown = mission(values, town, radio=True).play(Random(7))
    assert flown.flown() == mission(values, town).play().flown()
    assert flown.asked == 0


@pytest.mark.parametrize("scenario", [1, 2])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lost_uavs_with_beacons_come_back(mission: Callable[..., Any], town: RoadMap, scenario: int, seed: int) -> None:
    """What a process knew of the others, and they had not heard of it, is lost with it; so it is asked for."""
    values = {"team.size": 3, "training.ticks": 30, "scenario": scenario}
    flown = mission(values, town, radio=True).play(Random(seed), crash=0.02)
    assert sum(flown.incarnations) > 3
    assert flown.flown() == mission(values, town).play().flown()

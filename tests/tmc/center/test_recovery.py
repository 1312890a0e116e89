"""Recovery by replay: a journal cut anywhere gives the state of the TMC that wrote it, which goes on as if nothing was.

A mission's messages are told to a station, whose entries are journalled as the TMC does it. The journal is cut after
any number of entries and played into a new station.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count, takewhile
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from tmc.__main__ import run_of
from tmc.analysis.invariants.check import check
from tmc.center import recovery
from tmc.center.commit_gate import is_binding
from tmc.center.entries import JournalEntry
from tmc.center.journal import Journal, policy_path
from tmc.center.roster import LEARNER, Outbox, uav_name
from tmc.center.station import Station
from tmc.kernel.config import ConfigError, build
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World
from tmc.record import builders
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import compact_run
from tmc.record.reader import Log
from tmc.record.writer import LogWriter
from tmc.wire import messages as m

FOLDERS = count()
QUIET = settings(
    max_examples=20, deadline=None, phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip


@dataclass
class Case:
    """A mission: its settings, whether a learner takes part, and what chance does to it."""

    values: dict[str, Any]
    learning: bool
    crash: float
    loses: int
    seed: int

    def station(self, world: World) -> Station:
        fixed = b"policy" if world.config.team.controller == "policy" and not self.learning else None
        return Station(world, "run", learning=self.learning, policy=fixed)


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Missions of both scenarios; the replay memory holds all of them, or the last episodes only."""
    learning = draw(st.booleans())
    pilots = ["policy"] if learning else ["policy", "planner:greedy", "planner:random-road"]
    ticks, size = draw(st.integers(1, 24)), draw(st.integers(1, 6))
    values = {
        "scenario": draw(st.sampled_from([1, 2, 2])),
        "team.size": size,
        "team.controller": draw(st.sampled_from(pilots)),
        "comms.period": draw(st.integers(1, 10)),
        "comms.phase": draw(st.sampled_from(["together", "staggered"])),
        "world.initial_map": draw(st.sampled_from(["visited", "random"])),
        "training.ticks": ticks,
        "training.episodes": draw(st.integers(1, 5)),
        "training.seed": draw(st.integers(0, 99)),
        "dqn.n_step": draw(st.sampled_from([1, 3])),
        "dqn.batch_size": 4,
        "replay.capacity": size * draw(st.sampled_from([1, ticks, 2 * ticks + 1, 1000])),
        "replay.learn_start": size,
        "replay.error_buffer": draw(st.sampled_from([1, 4])),
        "replay.priority_exponent": draw(st.sampled_from([0.0, 0.0, 0.6])),
    }
    loses = draw(st.sampled_from([0, 0, 1]))
    return Case(values, learning, draw(st.sampled_from([0.0, 0.02])), loses, draw(st.integers(0, 2**16)))


@dataclass
class Learner:
    """Asks for minibatches and pushes a policy after every third."""

    flown: Any
    updates: int = 0
    version: int = 0
    open: int = 0
    incarnation: int = 1

    def join(self) -> None:
        self.open = 0
        self.flown.tell(LEARNER, self.hello())
        self.push()

    def hello(self) -> m.Hello:
        return m.Hello(role="learner", uav=-1, incarnation=self.incarnation, updates=self.updates)

    def push(self) -> None:
        self.version = max(self.version, self.flown.station.policies.newest) + 1
        self.flown.tell(
            LEARNER,
            m.PolicyPush(version=self.version, updates=self.updates, loss=0.5, model=b"policy %d" % self.version),
        )

    def work(self) -> None:
        """Take what came, and ask for more."""
        for message in self.flown.learner:
            if isinstance(message, m.Minibatch):
                self.open, self.updates = self.open - 1, self.updates + 1
                if self.updates % 3 == 0:
                    self.push()
        self.flown.learner.clear()
        while self.open < 2:
            self.open += 1
            self.flown.tell(LEARNER, m.SampleRequest(request=self.updates + self.open))


@dataclass
class RunData:
    """A mission that was flown; `heard[k]` was told when `before[k]` entries had been made."""

    case: Case
    world: World
    heard: list[tuple[str, m.Message | None]]
    before: list[int]
    entries: list[JournalEntry]
    updates: list[int] = field(default_factory=list)


def fly(mission: Callable[..., Any], town: RoadMap, case: Case) -> RunData:
    """Fly a mission; `loses` UAVs are given up at some time, and their next processes wait for the next episode."""
    flown = mission(case.values, town, learning=case.learning)
    rng, learner = Random(case.seed), Learner(flown)
    noted = RunData(case, flown.world, [], [], flown.entries)
    tell = flown.tell

    def noting(sender: str, message: m.Message) -> Any:
        note(noted, flown, sender, message, learner)
        return tell(sender, message)

    flown.tell = noting
    if case.learning:
        learner.join()
        silence = flown.silence
        flown.silence = lambda: (learner.work(), silence())
    to_lose = case.loses
    for _ in flown.steps(rng, case.crash):
        episode = flown.station.episode
        if case.learning and rng.random() < 0.3:
            learner.work()
        if to_lose and episode is not None and flown.N > 1 and rng.random() < 0.03:
            to_lose -= 1
            i = rng.randrange(flown.N)
            flown.lose(i, on_the_air=False)
            note(noted, flown, uav_name(i), None, learner)
            give_up(flown.station, i)
            flown.take()
    return noted


def note(noted: RunData, flown: Any, sender: str, message: m.Message | None, learner: Learner) -> None:
    noted.heard.append((sender, message))
    noted.before.append(len(flown.entries))
    noted.updates.append(learner.updates)


def give_up(station: Station, i: int) -> None:
    """As `Station.tick` does after a long silence."""
    episode = station.episode
    assert episode is not None
    station.lose(episode, i)
    station._accept_ready(episode)
    station.finalise()


def told(station: Station, sender: str, message: m.Message | None) -> list[JournalEntry]:
    """Tell a station what another one heard; returns its entries."""
    if message is None:
        give_up(station, int(sender[4:]))
    else:
        station.handle(sender, message, 1.0)
    station.committed()
    return station.out.take().entries


def journalled(folder: Path, world: World, entries: list[JournalEntry], models: bool = True) -> Path:
    """A journal of these entries, with the policy files beside it."""
    folder.mkdir()
    journal = Journal(folder, world, "run")
    if models:
        versions = [e.values["version"] for e in entries if e.topic == "/learner/policy"]
        journal.keep_policies({v: b"policy %d" % v for v in versions})
    journal.take(Outbox(entries=entries))
    journal.writer.close()
    return folder / "tmc.mcap"


def recovered(case: Case, world: World, path: Path) -> tuple[Station, list[JournalEntry]]:
    station = case.station(world)
    return station, recovery.recover(station, path, 1.0)


def state(station: Station) -> dict[str, Any]:
    """All that must be the same; a journal knows less of incarnations and of the learner than the TMC did."""
    names = ("episodes", "version", "ticks", "steps", "blocked", "blocked_by_uav", "loss", "uncertainty",
             "episode_uncertainty", "phase")  # fmt: skip
    found: dict[str, Any] = {name: getattr(station, name) for name in names if name != "phase"}
    found |= {
        "rate_limiter": (station.rate_limiter.ticks, station.rate_limiter.origin),
        "policy": station.policies.newest,
    }
    found |= {"sequence": [member.sequence for member in station.roster]}
    found |= {"replay": station.replay.digest(), "transitions": len(station.replay)}
    if station.episode is not None:
        f = station.episode
        names = ("number", "reported", "lost", "next_exchange", "done", "version", "total_uncertainty",
                 "total_reward", "blocked", "visited", "visited_by_team", "starts")  # fmt: skip
        found |= {f"episode.{name}": getattr(f, name) for name in names}
        found["episode.maps"] = f.digest()
        arrays = (f.cells, f.actions, f.blocks, f.own_rewards, f.rewards)
        found["episode.arrays"] = [a.tobytes() for a in arrays]
    return found


def plain(entries: list[JournalEntry], learning: bool) -> list[tuple[str, dict[str, Any]]]:
    """Entries that can be compared; how far the learner was, and which policy was the last, depend on its asking."""
    drop = {"updates", "model"} if learning else set()
    return [(e.topic, {k: repr(v) for k, v in e.values.items() if k not in drop}) for e in entries]


def from_outside(entry: JournalEntry) -> bool:
    """An entry that does not follow from those before it: a kill may have made it not happen."""
    return entry.topic == "/tmc/lost" or (entry.topic == "/tmc/episode" and entry.values["phase"] == "begin")


@QUIET
@given(cases(), st.data())
def test_a_journal_cut_anywhere_gives_the_state_and_goes_on(
    mission: Callable[..., Any], town: RoadMap, tmp_path: Path, case: Case, data: st.DataObject
) -> None:
    flown = fly(mission, town, case)
    cut = data.draw(st.integers(0, len(flown.entries)))
    told_of = sum(before < cut for before in flown.before)  # the messages of which the journal tells
    reference = case.station(flown.world)
    made = [*reference.out.take().entries]
    for sender, message in flown.heard[:told_of]:
        made += told(reference, sender, message)
    assert plain(made, False) == plain(flown.entries[: len(made)], False)
    folder = tmp_path / f"{next(FOLDERS)}"
    station, missing = recovered(case, flown.world, journalled(folder, flown.world, flown.entries[:cut]))
    rest = flown.entries[cut : max(cut, len(made))]
    follows = list(takewhile(lambda e: not from_outside(e), rest))
    assert plain(missing, case.learning) == plain(follows, case.learning)
    undecided = rest[len(follows) :]
    if any(e.topic == "/tmc/lost" for e in undecided):
        return  # a UAV that was away is waited for again
    greet(station, reference, flown.updates[told_of - 1] if told_of else 0)
    later = station.out.take().entries
    assert later == [] or undecided
    assert state(station) == state(reference)
    for sender, message in flown.heard[told_of:]:
        later += told(station, sender, message)
    assert plain(missing + later, case.learning) == plain(flown.entries[cut:], case.learning)


def greet(station: Station, reference: Station, updates: int) -> None:
    """Make all UAVs that were there say hello again."""
    if reference.learning and reference.sample_queue.incarnation >= 0:
        station.handle(LEARNER, m.Hello(role="learner", uav=-1, incarnation=1, updates=updates), 1.0)
    for i, member in enumerate(reference.roster):
        if member.incarnation >= 0:
            station.handle(uav_name(i), m.Hello(role="uav", uav=i, incarnation=member.incarnation), 1.0)


# Killed in episode.


REFLOWN = Case(
    {"team.size": 2, "team.controller": "policy", "training.ticks": 3, "training.episodes": 5, "training.seed": 73,
     "comms.period": 1, "comms.phase": "staggered"},
    learning=False, crash=0.02, loses=0, seed=0,
)  # fmt: skip
"""With seed 1102 a UAV has to fly an episode's end again when the other one is in the next episode."""


@settings(QUIET, max_examples=10)
@given(cases(), st.integers(0, 2**16))
@example(REFLOWN, 1102)
def test_a_tmc_killed_in_flight_flies_the_same(
    mission: Callable[..., Any], town: RoadMap, tmp_path: Path, case: Case, seed: int
) -> None:
    """Commits fall at random, kills too, and a kill takes any number of the entries that are not committed."""
    if case.learning:
        case = replace(case, learning=False)
    undisturbed = mission(case.values, town).play()
    rough, rng = mission(case.values, town), Random(seed)

    def groups() -> bool:
        due = rough.station.phase == "done" or any(is_binding(message) for _, message in rough.station.out.sends)
        return rng.random() < 0.2 or due  # as the service does

    rough.groups = groups
    for _ in rough.steps(rng, case.crash):
        if rng.random() < 0.05:
            kept = rough.entries[: rng.randint(rough.safe, len(rough.entries))]
            folder = tmp_path / f"{next(FOLDERS)}"
            station, missing = recovered(case, rough.world, journalled(folder, rough.world, kept))
            rough.restart(station, kept + missing)
    assert rough.flown() == undisturbed.flown()
    assert told_by(rough.entries) == told_by(undisturbed.entries)
    record = {(r.uav, r.sequence) for r in rough.records}
    assert len(record) == len(rough.records) == len(undisturbed.records)


def told_by(entries: list[JournalEntry]) -> list[Any]:
    """What a mission's journal tells, however its truth was cut into messages: the digests at the ends included."""
    common = ("/tmc/sync", "/tmc/state", "/tmc/episode", "/tmc/last_visit")
    found: list[Any] = [plain([e for e in entries if e.topic == topic], True) for topic in common]
    metrics = [e.values for e in entries if e.topic == "/tmc/metrics"]
    return [*found, [(v["episode"], u) for v in metrics for u in v["uncertainty"]]]


# Episodes that are not flown again.


LONG = Case(
    {"team.size": 3, "team.controller": "policy", "training.ticks": 20, "training.episodes": 9, "comms.period": 4,
     "comms.phase": "staggered", "world.initial_map": "random", "replay.capacity": 130, "replay.learn_start": 70,
     "replay.error_buffer": 4, "dqn.batch_size": 4},
    learning=True, crash=0.01, loses=0, seed=3,
)  # fmt: skip


@pytest.mark.parametrize(("loses", "expected"), [(0, range(3, 6)), (3, range(4, 6))])
def test_of_old_episodes_only_the_sums_are_taken(
    mission: Callable[..., Any], town: RoadMap, tmp_path: Path, loses: int, expected: range
) -> None:
    """Two episodes until learning starts, and the last three, with the two that hold 43 ticks, are flown again."""
    flown = fly(mission, town, replace(LONG, loses=loses))
    end = [n for n, e in enumerate(flown.entries) if e.topic == "/tmc/state"][-2]  # the last episode has just begun
    path = journalled(tmp_path / "run", flown.world, flown.entries[: end + 20])
    log = Log(path)
    skip = recovery.skipped(log, flown.world.config)
    assert skip == expected
    whole, quick = LONG.station(flown.world), LONG.station(flown.world)
    missing = recovery.play(whole, log.raw(), path.parent, 1.0)
    assert plain(recovery.play(quick, log.raw(), path.parent, 1.0, skip), False) == plain(missing, False)
    assert state(quick) == state(whole)
    assert [(u.incarnation, u.sequence, u.former) for u in quick.roster] == [
        (u.incarnation, u.sequence, u.former) for u in whole.roster
    ]
    assert quick.rate_limiter == whole.rate_limiter
    first, second = whole.replay.sample(5, 64), quick.replay.sample(5, 64)
    assert first.views.u.tobytes() == second.views.u.tobytes()
    assert first.reward.tobytes() == second.reward.tobytes()


# Journals that cannot be played.


@pytest.fixture
def flown(mission: Callable[..., Any], town: RoadMap) -> Any:
    """Two short episodes with a fixed policy."""
    return mission({"team.size": 2, "training.ticks": 12, "training.episodes": 2, "comms.period": 4}, town).play()


def at(entries: list[JournalEntry], topic: str, number: int) -> int:
    return [n for n, e in enumerate(entries) if e.topic == topic][number]


def later_record(entries: list[JournalEntry], **changes: Any) -> list[JournalEntry]:
    """The third record of UAV 0 altered."""
    n = at(entries, "/uav/0/record", 2)
    record = replace(entries[n].values["record"], **changes)
    return [*entries[:n], JournalEntry("/uav/0/record", {"record": record}), *entries[n + 1 :]]


CONTRADICTIONS: dict[str, tuple[Callable[[list[JournalEntry]], list[JournalEntry]], str]] = {
    "a record is missing": (
        lambda es: [e for n, e in enumerate(es) if n != at(es, "/uav/1/record", 1)],
        "has record 2 of UAV 1 out of turn",
    ),
    "a record comes twice": (
        lambda es: [*es[: at(es, "/uav/1/record", 2)], es[at(es, "/uav/1/record", 1)]],
        "has record 1 of UAV 1 out of turn",
    ),
    "no such UAV": (lambda es: later_record(es, uav=7), "has record 2 of UAV 7 out of turn"),
    "of another episode": (lambda es: later_record(es, episode=2), "has a record of episode 2 out of turn"),
    "a jump": (
        lambda es: later_record(es, cells=es[at(es, "/uav/0/record", 2)].values["record"].cells[::-1].copy() * 0 + 1),
        "the journal contradicts itself, so do not resume from it: record of UAV 0",
    ),
    "an episode is missing": (
        lambda es: es[: at(es, "/tmc/episode", 0)] + es[at(es, "/tmc/episode", 2) :],
        "has episode 2 out of turn",
    ),
    "an episode begins in another": (
        lambda es: [*es[: at(es, "/uav/0/record", 2)], es[at(es, "/tmc/episode", 2)]],
        "has episode 2 out of turn",
    ),
}


@pytest.mark.parametrize("name", list(CONTRADICTIONS))
def test_a_journal_that_contradicts_itself_is_refused(flown: Any, tmp_path: Path, name: str) -> None:
    change, sentence = CONTRADICTIONS[name]
    path = journalled(tmp_path / "run", flown.world, change(flown.entries))
    station = Station(flown.world, "run", learning=False, policy=b"policy")
    with pytest.raises(RecordError, match=sentence) as error:
        recovery.recover(station, path, 1.0)
    assert str(error.value).count("\n") == 0 and not station.playing


def test_a_journal_of_another_mission_is_refused(flown: Any, tmp_path: Path) -> None:
    path = journalled(tmp_path / "run", flown.world, flown.entries)
    config = flown.world.config
    assert run_of(path.parent, config) == "run"
    with pytest.raises(ConfigError, match="holds the journal of a mission with other settings: choose another --out"):
        run_of(path.parent, build({"training.seed": 2}, config))
    assert run_of(tmp_path, config) is None


# Policy files.


@pytest.mark.parametrize("file", ["whole", "gone", "damaged", "of another policy"])
def test_policy_files(mission: Callable[..., Any], town: RoadMap, tmp_path: Path, file: str) -> None:
    """A policy whose file is not what the journal says is not given out; the learner's next one takes its place."""
    flown = fly(mission, town, replace(LONG, crash=0.0))
    cut = at(flown.entries, "/tmc/metrics", 30)
    path = journalled(tmp_path / "run", flown.world, flown.entries[:cut])
    newest = max(e.values["version"] for e in flown.entries[:cut] if e.topic == "/learner/policy")
    model = policy_path(path.parent, newest)
    if file == "gone":
        model.unlink()
    elif file != "whole":
        model.write_bytes(b"policy 1" if file == "of another policy" else model.read_bytes()[:-1])
    station, _ = recovered(LONG, flown.world, path)
    assert station.policies.newest == newest
    found = station.policies.find(newest)
    assert found == ((newest, b"policy %d" % newest) if file == "whole" else None)
    station.handle(LEARNER, m.PolicyPush(version=newest + 1, updates=9, loss=0.5, model=b"next"), 1.0)
    assert station.policies.find(newest) == (found or (newest + 1, b"next"))


@pytest.mark.parametrize("durability", ["process", "power"])
def test_a_journal_that_goes_on_leaves_only_the_policies_that_are_held(
    flown: Any, tmp_path: Path, durability: str
) -> None:
    """Those of an earlier incarnation too, and each as it is held now, whatever stands in the file of that name."""
    journalled(tmp_path / "run", flown.world, flown.entries[:3])
    for name in ("policy-3.onnx", "policy-7.onnx", "final.onnx"):
        (tmp_path / "run" / "policies").mkdir(exist_ok=True)
        (tmp_path / "run" / "policies" / name).write_bytes(b"old")
    world = World(build({"journal.durability": durability}, flown.world.config), flown.world.map)
    journal = Journal(tmp_path / "run", world, "run", resume=True)
    journal.keep_policies({7: b"seven", 8: b"eight"})
    journal.writer.close()
    files = {path.name: path.read_bytes() for path in (tmp_path / "run" / "policies").iterdir()}
    assert files == {"final.onnx": b"old", "policy-7.onnx": b"seven", "policy-8.onnx": b"eight"}


def test_a_process_that_has_flown_nothing_yet_is_missed_too(flown: Any, tmp_path: Path) -> None:
    """Its incarnation is in no record: it is given up after the same silence as the others, and not waited for for
    ever.
    """
    path = journalled(tmp_path / "run", flown.world, flown.entries[: at(flown.entries, "/tmc/episode", 0) + 1])
    station = Station(flown.world, "run", learning=False, policy=b"policy")
    recovery.recover(station, path, 100.0)
    station.handle("uav-000", m.Hello(role="uav", uav=0, incarnation=5), 150.0)
    station.tick(159.0)
    assert station.episode is not None and station.episode.lost == {}
    station.tick(161.0)
    assert station.episode.lost == {1: -1}


def test_who_missed_that_an_episode_began_is_told_again(flown: Any, tmp_path: Path) -> None:
    """Its last map and the `Begin` were lost with the old TMC, so it goes on repeating the last record before them."""
    path = journalled(tmp_path / "run", flown.world, flown.entries[: at(flown.entries, "/tmc/episode", 2) + 1])
    station = Station(flown.world, "run", learning=False, policy=b"policy")
    recovery.recover(station, path, 1.0)
    assert station.episode is not None and station.episode.number == 2
    record = [r for r in flown.records if (r.uav, r.episode) == (1, 1)][-1]
    station.handle("uav-001", record, 1.0)
    (answer,) = [x for _, x in station.out.take().sends]
    assert isinstance(answer, m.Begin) and (answer.episode, answer.shipped, answer.sequence) == (2, -1, 4)


def test_a_finished_mission_says_goodbye_to_whoever_comes(flown: Any, tmp_path: Path) -> None:
    path = journalled(tmp_path / "run", flown.world, flown.entries)
    station = Station(flown.world, "run", learning=False, policy=b"policy")
    assert recovery.recover(station, path, 1.0) == []
    assert station.phase == "done"
    station.handle("uav-001", m.Hello(role="uav", uav=1, incarnation=5), 1.0)
    assert [type(x) for to, x in station.out.take().sends] == [m.Welcome, m.End]


def test_a_file_that_holds_no_messages_is_a_fresh_start(flown: Any, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "tmc.mcap", "tmc", flown.world.config.journal, {}) as log:
        log.write("/log", builders.log_message("info", "here", "tmc", 0))
    station = Station(flown.world, "run", learning=False, policy=b"policy")
    missing = recovery.recover(station, tmp_path / "tmc.mcap", 1.0)
    assert [e.topic for e in missing] == ["/learner/policy"]
    assert station.phase == "gathering" and station.episodes == 0
    assert len(station.replay.digest()) == 32 and len(station.replay) == 0


# The state that the journal tells of.


@pytest.mark.parametrize("scenario", [1, 2])
def test_map_and_replay_from_a_sealed_log_alone_are_those_of_the_tmc(
    mission: Callable[..., Any], tmp_path: Path, scenario: int
) -> None:
    """The invariant `state` of `overfly log check`, and a digest that was changed breaks it."""
    flown = mission({"scenario": scenario, "team.size": 3, "training.ticks": 60, "training.episodes": 3,
                     "comms.phase": "staggered", "replay.capacity": 300}).play(Random(1))  # fmt: skip
    path = journalled(tmp_path / "run", flown.world, flown.entries)
    compact_run(path.parent)
    result = check(path.parent)
    assert result.good and next(row.facts for row in result.rows if row.name == "state") == 9
    told = [e.message for e in Log(path).entries(["/tmc/state"])]
    assert told[-1].replay == flown.station.replay.digest() and len({s.map for s in told}) == 3
    for name, what in (("map", "the maps differ"), ("replay", "the replay memory differs")):
        entries = list(flown.entries)
        n = at(entries, "/tmc/state", 1)
        entries[n] = JournalEntry("/tmc/state", entries[n].values | {name: told[0].map})
        row = check(journalled(tmp_path / name, flown.world, entries).parent).rows[-1]
        assert row.name == "state" and str(row.violation) == f"episode 2: {what}"

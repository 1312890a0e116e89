"""`overfly log check`: intact journals of all kinds pass; one that breaks an invariant is caught by that invariant."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.airspace import Waiting
from deploy.run.lockstep import LockStep
from tmc.analysis.invariants.check import FILE, INVARIANTS, Result, check
from tmc.center.journal import Journal
from tmc.kernel.config import JournalConfig, build, flat
from tmc.kernel.grid import STAY
from tmc.kernel.reward import Block
from tmc.kernel.world import World
from tmc.record.errors import RecordError
from tmc.record.reader import Log, decode
from tmc.record.writer import LogWriter
from tmc.wire import messages as m

Change = Callable[[str, Any], Iterator[Any]]
Fly = Callable[..., Path]
CROWD = {"team.size": 8, "training.episodes": 2, "world.start": "road", "training.seed": 1}
"""Two episodes in which UAVs meet, and block one another."""


def broken(result: Result) -> dict[str, str]:
    """The invariants that are violated, and how."""
    return {row.name: str(row.violation) for row in result.rows if row.violation}


# Intact journals.

INTACT: list[dict[str, object]] = [
    CROWD,
    CROWD | {"scenario": 1},
    CROWD | {"comms.period": 1},
    CROWD | {"comms.period": 5, "comms.phase": "staggered"},
    {"team.size": 12, "comms.period": 100, "team.sensing_range": 5.0, "world.alpha": 1.0},
    {
        "team.size": 8,
        "world.initial_map": "random",
        "world.rates": "volume",
        "reward.aligned": True,
        "comms.phase": "staggered",
    },
    CROWD | {"reward.uncertainty": "own", "reward.novelty": "team", "world.alpha_offroad": 0.02},
    CROWD | {"reward.uncertainty": "own", "reward.novelty": "team", "scenario": 1},
    {"team.size": 1, "training.ticks": 1},
]


@pytest.mark.parametrize("values", INTACT, ids=str)
def test_sound_journals_pass(fly: Fly, values: dict[str, object]) -> None:
    result = check(fly(**values))
    assert broken(result) == {}
    assert result.good and result.unfinished == 0
    scenario = values.get("scenario", 2)
    idle = {"maps", "accounting"} if scenario == 1 else {"events"}
    alone = {"sightings"} if values.get("team.size") == 1 else set()
    assert {row.name for row in result.rows if not row.facts} == idle | alone


def lose_one(folder: Path, dies: int, **values: Any) -> Path:
    """A mission in which UAV 2's process is silent from tick `dies` of episode 1 on, and back in episode 3."""
    config = build({"team.controller": "planner:greedy", "team.size": 4, "training.ticks": 60, "training.episodes": 3,
                    "comms.period": 7, "training.seed": 5, **values})  # fmt: skip
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(flat(config)))
    world = World(config)
    journal = Journal(folder, world, "lost")
    step = LockStep(world, None, journal.take)
    station, pilots = step.station, step.fleet.pilots
    away = False

    def deliver(sends: list[tuple[int, m.Message]]) -> None:
        for uav, message in sends:
            if uav != 2 or not away:
                step.fleet.deliver(uav, message)

    for pilot in pilots:
        deliver(step._exchange(pilot.uav, m.Hello(role="uav", uav=pilot.uav, incarnation=1)))
    now = 0.0
    while station.phase != "done":
        assert now < 1e4, "the mission hangs"
        moved = False
        for pilot in pilots:
            if pilot.uav == 2 and pilot.episode == 1 and pilot.t >= dies:
                away = station.episode is None or station.episode.number == 1
                if away:
                    continue
                pilot.episode, pilot.incarnation, pilot.phase = 0, 2, type(pilot.phase).IDLE
                deliver(step._exchange(2, m.Hello(role="uav", uav=2, incarnation=2)))
            before = (pilot.t, pilot.phase)
            try:
                record = pilot.advance()
            except Waiting:
                record = None
            moved |= record is not None or before != (pilot.t, pilot.phase)
            if record is not None:
                deliver(step._exchange(pilot.uav, record))
        if not moved:  # all UAVs wait: time goes by, and all but the dead one are heard
            now += 100.0
            for i, member in enumerate(station.roster):
                member.heard = member.heard if i == 2 and away else now
            station.tick(now)
            deliver(step._collect())
    journal.writer.close()
    return folder


@pytest.mark.parametrize("dies", [1, 20, 41])
@pytest.mark.parametrize(("scenario", "phase"), [(2, "together"), (2, "staggered"), (1, "together")])
def test_a_journal_with_a_lost_uav_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dies: int, scenario: int, phase: str
) -> None:
    monkeypatch.setattr("actors.pilot.MAX_TICKS_PER_ADVANCE", 1)  # it is seen in places that its records do not tell of
    folder = lose_one(tmp_path / "run", dies, scenario=scenario, **{"comms.phase": phase})
    assert [e.message.uav for e in Log(folder / "tmc.mcap").entries(["/tmc/lost"])] == [2, 2]
    result = check(folder)
    assert broken(result) == {}
    assert result.episodes == 3
    for n, make in enumerate((drop("/tmc/lost", episode=1), once("/tmc/lost", plus("tick", 1)))):
        assert "lost" in broken(check(altered(folder, tmp_path / f"altered-{n}", make())))


@pytest.mark.parametrize("share", [0.1, 0.35, 0.6, 0.9, 0.99])
@pytest.mark.parametrize("scenario", [1, 2])
def test_a_journal_that_ends_anywhere_is_checked_as_far_as_it_goes(
    fly: Fly, tmp_path: Path, scenario: int, share: float
) -> None:
    """As a kill leaves it: a beginning of the journal, its last message any."""
    whole = fly(**CROWD, scenario=scenario, **{"comms.phase": "staggered"})
    left = int(share * sum(1 for _ in Log(whole / "tmc.mcap").raw()))

    def change(_topic: str, message: Any) -> Iterator[Any]:
        nonlocal left
        left -= 1
        if left >= 0:
            yield message

    folder = altered(whole, tmp_path / "cut", change)
    (folder / "tmc.mcap").rename(folder / "tmc.mcap.active")
    result = check(folder)
    assert broken(result) == {}
    assert result.unfinished == 1


# Journals that break one invariant.


def altered(folder: Path, to: Path, change: Change) -> Path:
    """A copy of a run's journal, intact as a file; `change` gives the messages that stand for a message."""
    to.mkdir()
    shutil.copy(folder / "config.json", to)
    old = Log(folder / "tmc.mcap")
    with LogWriter(to / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for attachment in old.attachments():
            log.attach(attachment.name, attachment.media_type, attachment.data)
        for raw in old.raw():
            for message in change(raw.topic, decode(raw)):
                log.write(raw.topic, message)
    return to


def once(topic: str, alter: Callable[[Any], bool | None], **where: Any) -> Callable[[], Change]:
    """Alters the first message of a topic that `where` describes and of which `alter` does not return False."""

    def make() -> Change:
        done = False

        def change(name: str, message: Any) -> Iterator[Any]:
            nonlocal done
            fits = name.endswith(topic) and all(getattr(message, key) == value for key, value in where.items())
            if fits and not done:
                done = alter(message) is not False
            yield message

        return change

    return make


def drop(topic: str, **where: Any) -> Callable[[], Change]:
    def change(name: str, message: Any) -> Iterator[Any]:
        if not (name.endswith(topic) and all(getattr(message, key) == value for key, value in where.items())):
            yield message

    return lambda: change


def plus(field: str, value: float, at: int | None = None) -> Callable[[Any], None]:
    """Adds to a field, or to an entry of it."""

    def alter(message: Any) -> None:
        if at is None:
            setattr(message, field, getattr(message, field) + value)
        else:
            getattr(message, field)[at] += value

    return alter


def record_split() -> Change:
    """UAV 1's record of ticks 11..20 comes as two, 11..15 and 16..20; later numbers are one higher."""
    shift = 0

    def change(name: str, message: Any) -> Iterator[Any]:
        nonlocal shift
        if name != "/uav/1/record":
            yield message
            return
        message.sequence += shift
        if (message.episode, message.first, message.tick) != (1, 11, 20):
            yield message
            return
        for first, tick in ((11, 15), (16, 20)):
            part = type(message)()
            part.CopyFrom(message)
            part.first, part.tick, part.sequence = first, tick, message.sequence + shift
            for field in ("cells", "actions", "blocks", "rewards"):
                getattr(part, field)[:] = getattr(message, field)[first - 11 : tick - 10]
            seen = [(t, c) for t, c in zip(message.seen_tick, message.seen_cell, strict=True) if first <= t <= tick]
            part.seen_tick[:], part.seen_cell[:] = [t for t, _ in seen], [c for _, c in seen]
            yield part
            shift = 1

    return change


def record_twice() -> Change:
    """A record without sightings comes twice, under two numbers; later numbers are one higher."""
    shifted: dict[int, int] = {}

    def change(name: str, message: Any) -> Iterator[Any]:
        if not name.endswith("/record"):
            yield message
            return
        message.sequence += shifted.get(message.uav, 0)
        yield message
        if not shifted and message.tick == 30 and not message.seen_tick:
            shifted[message.uav] = 1
            message.sequence += 1
            yield message

    return change


def stay_instead(message: Any) -> bool:
    """A move that was flown is said to have been none."""
    for n, (action, block) in enumerate(zip(message.actions, message.blocks, strict=True)):
        if action != STAY and block == Block.NONE:
            message.actions[n] = STAY
            return True
    return False


def other_blocked_action(fly: Fly, values: dict[str, Any]) -> Change:
    """A move that a UAV blocked is said to have been another one, the way of which was free."""
    world = World(build({"team.controller": "planner:random", **values}))
    cells: dict[tuple[int, int, int], int] = {}
    for e in Log(fly(**values) / "tmc.mcap").entries():
        if e.topic.endswith("/record"):
            r = e.message
            cells |= {(r.episode, t, r.uav): cell for t, cell in enumerate(r.cells, r.first)}

    def alter(r: Any) -> bool:
        for n, block in enumerate(r.blocks):
            t = max(r.first, 1) + n
            if block != Block.UAV:
                continue
            near = {cells.get((r.episode, tick, j)) for tick in (t - 1, t) for j in range(world.config.team.size)}
            for action, target in enumerate(world.grid.target_lists[cells[r.episode, t - 1, r.uav]]):
                if action != STAY and target >= 0 and not world.map.blocked[target] and target not in near:
                    r.actions[n] = action
                    return True
        return False

    return once("/record", alter)()


def onto_another(fly: Fly, values: dict[str, Any]) -> Change:
    """At the last tick, one that stays beside another is put onto it."""
    world = World(build({"team.controller": "planner:random", **values}))
    T, last = 60, dict[int, int]()
    for e in Log(fly(**values) / "tmc.mcap").entries():
        if e.topic.endswith("/record") and e.message.episode == 2 and e.message.tick == T:
            last[e.message.uav] = e.message.cells[-1]

    def alter(r: Any) -> bool:
        if r.tick != T or r.episode != 2:
            return False
        for action, target in enumerate(world.grid.target_lists[r.cells[-2]]):
            if action != STAY and target in [cell for uav, cell in last.items() if uav != r.uav]:
                r.actions[-1], r.blocks[-1], r.cells[-1] = action, Block.NONE, target
                return True
        return False

    return once("/record", alter)()


def extra_sighting(message: Any) -> bool:
    """Of a cell that is not a road, so that the UAV's map stays as it was."""
    if message.seen_tick:
        return False
    message.seen_tick.append(message.tick)
    message.seen_cell.append(0)
    return True


def sighting_less(message: Any) -> bool:
    if not message.seen_tick:
        return False
    message.seen_tick.pop()
    message.seen_cell.pop()
    return True


def event_more(message: Any) -> None:
    message.ticks.append(message.ticks[0])
    message.cells.append(message.cells[0] + 1)


def event_less(message: Any) -> None:
    message.ticks.pop()
    message.cells.pop()


def uav_less(message: Any) -> None:
    message.uavs.pop()


def wrong_visit(message: Any) -> bool:
    data = np.frombuffer(message.data, "<u4").copy()
    at = np.flatnonzero(data)
    if at.size:
        data[at[0]] += 1
        message.data = data.tobytes()
    return bool(at.size)


def drift() -> Change:
    """Too little to be seen at a tick, but all of it in one direction."""

    def change(name: str, message: Any) -> Iterator[Any]:
        if name == "/tmc/metrics":
            message.uncertainty[:] = [u * (1 + 3e-7) for u in message.uncertainty]
        yield message

    return change


def up_and_down(message: Any) -> bool:
    if len(message.uncertainty) < 2 or not message.first:
        return False
    message.uncertainty[0] += 0.01
    message.uncertainty[1] -= 0.01
    return True


ONLY = "only"
FIRST = CROWD | {"scenario": 1}
BREAKS: list[tuple[str, dict[str, object], Callable[..., Change], str]] = [
    ("episodes", CROWD, drop("/tmc/episode", episode=2, phase="begin"), ONLY),
    ("episodes", CROWD, drop("/tmc/episode", episode=1, phase="end"), ONLY),
    ("episodes", CROWD, once("/record", plus("uav", 50), episode=2, tick=60), ""),
    ("starts", CROWD, once("/tmc/episode", plus("starts", 1, 0), phase="begin"), ONLY),
    ("starts", CROWD, once("/record", plus("cells", 1, 0), first=0), ""),
    ("sequence", CROWD, once("/record", plus("sequence", 1), tick=20), ONLY),
    ("sequence", CROWD, drop("/uav/3/record", episode=1, tick=30), ""),
    ("exchanges", CROWD, drop("/uav/3/record", episode=2, tick=60), ""),
    ("ticks", CROWD, record_twice, ONLY),
    ("ticks", CROWD, drop("/uav/3/record", episode=1, tick=20), ""),
    ("cadence", CROWD, record_split, ONLY),
    ("lost", CROWD, drop("/uav/3/record", episode=2, tick=60), ""),
    ("moves", CROWD, once("/record", stay_instead), ONLY),
    ("moves", CROWD, once("/record", plus("cells", 1, 3), tick=20), ""),
    ("blocks", CROWD, other_blocked_action, ONLY),
    ("separation", CROWD | {"team.size": 60}, onto_another, ""),
    ("sightings", CROWD, once("/record", extra_sighting), ONLY),
    ("sightings", CROWD, once("/record", sighting_less), ""),
    ("exchanges", CROWD, once("/tmc/sync", lambda s: s.uavs.reverse(), tick=30), ONLY),
    ("exchanges", CROWD, once("/tmc/sync", uav_less, tick=30), ""),
    ("exchanges", CROWD, once("/tmc/sync", uav_less, tick=60), ""),
    ("exchanges", FIRST, drop("/tmc/sync", episode=1, tick=60), ""),
    ("versions", CROWD, once("/tmc/sync", plus("version", 1), tick=20), ONLY),
    ("versions", CROWD, once("/record", plus("version", 1), tick=20), ONLY),
    ("maps", CROWD, once("/tmc/last_visit", wrong_visit), ONLY),
    ("believed", CROWD, once("/tmc/sync", plus("believed", 0.001), tick=30), ONLY),
    ("believed", FIRST, once("/tmc/sync", plus("believed", 1), tick=30), ONLY),
    ("events", FIRST, once("/tmc/events", event_more), ONLY),
    ("events", FIRST, once("/tmc/events", event_less), ONLY),
    ("uncertainty", CROWD, once("/tmc/metrics", up_and_down), ONLY),
    ("uncertainty", FIRST, once("/tmc/metrics", plus("uncertainty", 1, 0)), ONLY),
    ("accounting", CROWD, drift, ONLY),
    ("own rewards", CROWD, once("/record", plus("rewards", 0.01, 4), tick=20), ONLY),
    ("own rewards", FIRST, once("/record", plus("rewards", 0.01, 0), tick=20), ONLY),
    ("team rewards", CROWD, once("/tmc/metrics", plus("reward", 0.01, -1), episode=2), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("reward", 0.01, 5), phase="end"), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("blocked_uav", 1), phase="end"), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("blocked_grid", 1), phase="end"), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("blocked_obstacle", 1), phase="end"), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("uncertainty", 0.01), phase="end"), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("uncertainty_per_cell", 0.01), phase="end"), ONLY),
    ("sums", CROWD, once("/tmc/episode", plus("steps", 1), phase="end"), ONLY),
]  # fmt: skip


@pytest.mark.parametrize(("name", "values", "make", "only"), BREAKS, ids=[f"{b[0]}-{n}" for n, b in enumerate(BREAKS)])
def test_a_broken_invariant_is_caught(
    fly: Fly, tmp_path: Path, name: str, values: dict[str, object], make: Callable[..., Change], only: str
) -> None:
    change = make(fly, values) if make in (other_blocked_action, onto_another) else make()
    found = broken(check(altered(fly(**values), tmp_path / "altered", change)))
    assert name in found
    if only:
        assert set(found) - {"state"} == {name}, found  # a journal that is not true may well not be played


def test_every_invariant_is_broken_by_some_journal() -> None:
    assert {b[0] for b in BREAKS} == {name for name, _, _ in INVARIANTS}


def test_the_first_violation_is_named(fly: Fly, tmp_path: Path) -> None:
    folder = altered(fly(**CROWD), tmp_path / "altered", once("/uav/3/record", plus("rewards", 0.5, 4), tick=20)())
    violation = broken(check(folder))["own rewards"]
    assert violation.startswith("episode 1, tick 15, UAV 3: ") and " is recorded, its map gives " in violation
    row = next(line for line in check(folder).table() if line.startswith("own rewards"))
    assert "VIOLATED: episode 1, tick 15, UAV 3" in row
    assert "1 of 22 invariants are violated" in check(folder).summary()


@pytest.mark.parametrize(
    ("field", "value"), [("uav", 99), ("tick", 10**6), ("first", 2), ("cells", 10**6), ("actions", 9), ("blocks", 4)]
)
def test_a_record_that_makes_no_sense_is_named_and_not_followed(
    fly: Fly, tmp_path: Path, field: str, value: int
) -> None:
    def alter(r: Any) -> None:
        if field in ("cells", "actions", "blocks"):
            getattr(r, field)[0] = value
        else:
            setattr(r, field, value)

    found = broken(check(altered(fly(**CROWD), tmp_path / "altered", once("/uav/1/record", alter, tick=20)())))
    assert "episodes" in found


# The file.


def test_damage_and_gaps_are_violations(fly: Fly, tmp_path: Path) -> None:
    folder = tmp_path / "damaged"
    shutil.copytree(fly(**CROWD), folder)
    path = folder / "tmc.mcap"
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    assert set(broken(check(folder))) == {FILE}
    data = bytearray(whole)
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert FILE in broken(check(folder))


def test_a_journal_that_lacks_messages_is_caught(fly: Fly, tmp_path: Path) -> None:
    old = Log(fly(**CROWD) / "tmc.mcap")
    shutil.copy(old.path.parent / "config.json", tmp_path)
    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for raw in old.raw():
            if not (raw.topic == "/tmc/sync" and raw.sequence == 9):
                log.put(raw.topic, raw.data, raw.log_time, raw.publish_time, raw.sequence)
    found = broken(check(tmp_path))
    assert "messages are missing before number 10" in found[FILE]


def test_no_journal(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="holds no logs of a run"):
        check(tmp_path)
    LogWriter(tmp_path / "learner.mcap", "learner", JournalConfig(), {}).close()
    with pytest.raises(RecordError, match=r"holds no tmc\.mcap"):
        check(tmp_path)


def test_a_journal_without_a_flight_does_not_pass(fly: Fly, tmp_path: Path) -> None:
    folder = altered(fly(**CROWD), tmp_path / "empty", lambda _topic, _message: iter(()))
    assert broken(check(folder)) == {"episodes": "there is no episode: nothing was flown, or its records are lost"}

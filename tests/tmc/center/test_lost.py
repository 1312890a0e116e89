"""A UAV lost in episode: the others go on without it, its visits count up to its last record, and it is back later."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from actors.airspace import Waiting
from actors.planners import LocalState
from deploy.run.lockstep import LockStep
from tmc.center.entries import JournalEntry
from tmc.center.episode import NO_CELL
from tmc.center.roster import Outbox, uav_name
from tmc.kernel.config import build
from tmc.kernel.world import World
from tmc.wire import messages as m

T, N, LOST = 60, 4, 2


class Losing:
    """A mission in one process in which UAV `LOST` dies at tick `dies` of episode 1 and says hello in episode 2."""

    def __init__(self, dies: int, **values: Any) -> None:
        self.entries: list[JournalEntry] = []
        settings = {"team.controller": "planner:greedy", "team.size": N, "training.ticks": T, "training.episodes": 3,
                    "comms.period": 7, "replay.learn_start": 1, "training.seed": 5}  # fmt: skip
        self.world = World(build(settings | values))
        self.dies = dies
        self.step = LockStep(self.world, None, self.keep)
        self.seen: dict[tuple[int, int, int], np.ndarray[Any, Any]] = {}
        for pilot in self.step.fleet.pilots:
            pilot.controller = pilot._planner = Watching(self, pilot.uav, pilot._planner)

    def keep(self, outbox: Outbox) -> None:
        self.entries += outbox.entries

    def deliver(self, sends: list[tuple[int, m.Message]]) -> None:
        for uav, message in sends:
            if uav != LOST or not self.dead:
                self.step.fleet.deliver(uav, message)

    def fly(self) -> Losing:
        fleet, self.dead = self.step.fleet, False
        for pilot in fleet.pilots:
            self.deliver(self.step._exchange(pilot.uav, m.Hello(role="uav", uav=pilot.uav, incarnation=1)))
        now, stuck = 0.0, 0
        while self.step.station.phase != "done":
            moved = False
            for pilot in fleet.pilots:
                if pilot.uav == LOST and pilot.episode == 1 and pilot.t >= self.dies:
                    self.dead = True
                    if self.step.station.episode is not None and self.step.station.episode.number == 2:
                        self.dead = False
                        self.deliver(self.step._exchange(LOST, m.Hello(role="uav", uav=LOST, incarnation=2)))
                        pilot.incarnation, pilot.phase = 2, type(pilot.phase).IDLE
                        pilot.episode = 0
                    continue
                before = (pilot.t, pilot.phase)
                try:
                    record = pilot.advance()
                except Waiting:
                    record = None
                moved |= record is not None or before != (pilot.t, pilot.phase)
                if record is not None:
                    self.deliver(self.step._exchange(pilot.uav, record))
            stuck = 0 if moved else stuck + 1
            if not moved:  # all UAVs wait: time goes by, and all but the dead one are heard
                assert stuck < 5, "the mission hangs"
                now += 100.0
                for i, member in enumerate(self.step.station.roster):
                    if not (i == LOST and self.dead):
                        member.heard = now
                self.step.station.tick(now)
                self.deliver(self.step._collect())
        return self


class Watching:
    """A planner, and a memory of what the UAV saw."""

    def __init__(self, mission: Losing, uav: int, planner: Any) -> None:
        self.mission, self.uav, self.planner = mission, uav, planner

    def choose(self, state: LocalState) -> int:
        episode = self.mission.step.fleet.pilots[self.uav].episode
        image = self.mission.step.station.observer.observe(state.cell, state.peers, state.u)
        self.mission.seen[episode, state.tick, self.uav] = image
        return int(self.planner.choose(state))


@pytest.fixture(params=[(2, "together"), (2, "staggered"), (1, "together")], ids=lambda p: f"{p[0]}-{p[1]}")
def losing(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Losing]:
    """Pilots look up at every tick, so that the lost one was seen in places that its records do not tell of."""
    monkeypatch.setattr("actors.pilot.MAX_TICKS_PER_ADVANCE", 1)
    scenario, phase = request.param
    return lambda dies: Losing(dies, **{"scenario": scenario, "comms.phase": phase}).fly()


@pytest.mark.parametrize("dies", [1, 20, 41])
def test_the_others_fly_on_and_the_truth_counts_its_records_only(losing: Callable[[int], Losing], dies: int) -> None:
    mission = losing(dies)
    cells = tracks(mission.entries)
    last = max(t for e, t, i in cells if e == 1 and i == LOST) if any(i == LOST for e, _, i in cells if e == 1) else -1
    assert last < dies + 1
    for episode in (1, 2, 3):
        for i in range(N):
            ticks = [t for e, t, j in cells if (e, j) == (episode, i)]
            away = i == LOST and episode < 3
            assert len(ticks) == ((last + 1 if episode == 1 else 0) if away else T + 1)
    if mission.world.config.scenario == 2:
        check_uncertainty(mission, cells)


def tracks(entries: list[JournalEntry]) -> dict[tuple[int, int, int], int]:
    """(episode, tick, uav): cell, from the journal."""
    records = [e.values["record"] for e in entries if "record" in e.values]
    return {(r.episode, t, r.uav): int(c) for r in records for t, c in enumerate(r.cells.tolist(), r.first)}


def check_uncertainty(mission: Losing, cells: dict[tuple[int, int, int], int]) -> None:
    """A plain loop over the journal's tracks gives the uncertainty of the journal."""
    road = np.flatnonzero(mission.world.map.road).tolist()
    for entry in mission.entries:
        if entry.topic == "/tmc/metrics" and entry.values["first"] == 0:
            last = dict.fromkeys(road, 0)
        if entry.topic == "/tmc/metrics":
            for t, value in enumerate(entry.values["uncertainty"], entry.values["first"]):
                for i in range(N):
                    cell = cells.get((entry.values["episode"], t, i))
                    if cell in last:
                        last[cell] = t
                assert value == pytest.approx(sum(1 - math.exp(-0.01 * (t - tau)) for tau in last.values()), abs=1e-9)


def test_by_priorities_nothing_of_a_lost_uav_is_drawn_either(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what is left, everything is; planners tell no values, so all are as likely."""
    monkeypatch.setattr("actors.pilot.MAX_TICKS_PER_ADVANCE", 1)
    mission = Losing(20, **{"scenario": 2, "comms.phase": "staggered", "replay.priority_exponent": 0.6}).fly()
    replay = mission.step.station.replay
    place = np.arange(replay.starts_in)
    there = {(p, i) for p, i in zip(*np.nonzero(replay.cells[replay.ends[place]] != NO_CELL), strict=True)}
    drawn: set[tuple[int, int]] = set()
    for number in range(4):
        sample = replay.sample(number, 4000)
        assert (sample.weight == 1.0).all()
        drawn |= set(zip(*np.divmod(sample.index, N), strict=True))
    assert drawn == there and len(there) < place.size * N


@pytest.mark.parametrize("dies", [20, 41])
def test_what_is_learned_from_is_what_was_seen(losing: Callable[[int], Losing], dies: int) -> None:
    """Bit for bit, also around the loss; of a UAV that is gone, nothing is drawn."""
    mission = losing(dies)
    replay = mission.step.station.replay
    sample = replay.sample(3, 4000)
    assert (replay.cells[sample.row][np.arange(4000), sample.uav] != NO_CELL).all()
    episodes, ticks = replay.episode[sample.row].tolist(), replay.tick[sample.row].tolist()
    images = replay.observer.observe_batch(sample.views)
    for b, key in enumerate(zip(episodes, ticks, sample.uav.tolist(), strict=True)):
        assert (images[b] == mission.seen[key]).all(), key
    assert {e for e, t, i in zip(episodes, ticks, sample.uav, strict=True) if i == LOST} >= {1, 3}


def flown_to(tick: int, **values: Any) -> LockStep:
    """A mission in one process, at that tick of its first episode."""
    settings = {"team.controller": "planner:greedy", "team.size": N, "training.ticks": 90, "comms.period": 7}
    step = LockStep(World(build({**settings, "replay.learn_start": 1, **values})), None, lambda _: None)
    for i in range(N):
        for uav, reply in step._exchange(i, m.Hello(role="uav", uav=i, incarnation=1)):
            step.fleet.deliver(uav, reply)
    while step.fleet.pilots[0].t < tick:
        step.fleet.step()
    return step


@pytest.mark.parametrize("priority", [0.0, 0.6])
def test_nothing_is_drawn_of_ticks_in_which_nobody_is_left(priority: float) -> None:
    step = flown_to(25, **{"replay.priority_exponent": priority})
    step.station.tick(1000.0)
    assert all(member.incarnation < 0 for member in step.station.roster)
    step.station.finalise()
    replay = step.station.replay
    assert replay.rows_in == 91
    sample = replay.sample(1, 2000)
    assert replay.tick[sample.row].max() < 25 and (sample.views.cells < step.world.grid.size).all()


def test_a_zombie_is_not_listened_to_and_is_back_with_the_next_episode() -> None:
    mission = Losing(20, **{"training.episodes": 2})
    station = mission.step.station
    for i in range(N):
        mission.step._exchange(i, m.Hello(role="uav", uav=i, incarnation=1))
    station.tick(1000.0)
    assert all(member.incarnation < 0 for member in station.roster)
    record = m.Record(
        uav=0,
        incarnation=1,
        sequence=0,
        episode=1,
        first=0,
        tick=0,
        version=0,
        policy=0,
        cells=np.array([station.world.starts(1)[0]], "<u2"),
        actions=np.zeros(0, "u1"),
        blocks=np.zeros(0, "u1"),
        rewards=np.zeros(0, "<f4"),
        seen_tick=m.EMPTY,
        seen_cell=m.EMPTY,
    )
    station.out.take()
    station.handle(uav_name(0), record, 1001.0)
    assert [(to, getattr(x, "code", "")) for to, x in station.out.take().sends] == [("uav-000", "state")]


class Learning(Losing):
    """Draws from a memory that is long full whenever something comes in."""

    def __init__(self, dies: int, **values: Any) -> None:
        self.meant: dict[int, tuple[int, int, int]] = {}
        self.wrong: list[tuple[int, int, int]] = []
        self.draws = 0
        super().__init__(dies, **values)

    def keep(self, outbox: Outbox) -> None:
        super().keep(outbox)
        replay = self.step.station.replay
        if not len(replay):
            return
        self.draws += 1
        sample = replay.sample(self.draws, 32)
        images = replay.observer.observe_batch(sample.views)
        of = (replay.episode[sample.row].tolist(), replay.tick[sample.row].tolist(), sample.uav.tolist())
        for number, image, key in zip(sample.index.tolist(), images, zip(*of, strict=True), strict=False):
            if self.meant.setdefault(number, key) != key or (image != self.seen[key]).any():
                self.wrong.append(key)


@pytest.mark.parametrize("priority", [0.0, 0.6])
@pytest.mark.parametrize("phase", ["together", "staggered"])
def test_a_full_memory_draws_nothing_that_is_written_over(
    monkeypatch: pytest.MonkeyPatch, phase: str, priority: float
) -> None:
    """Each number stands for one transition, and each transition is what was seen, before and after the loss."""
    monkeypatch.setattr("actors.pilot.MAX_TICKS_PER_ADVANCE", 1)
    mission = Learning(20, **{"comms.phase": phase, "replay.priority_exponent": priority, "replay.capacity": 160}).fly()
    assert mission.draws > 50 and mission.wrong == []
    assert len(mission.step.station.replay) == 160


def test_a_full_memory_of_which_nothing_is_left_is_not_drawn_from() -> None:
    """The whole team is lost for longer than the memory reaches back: the learner waits."""
    step = flown_to(35, **{"replay.capacity": 80, "training.episodes": 1})
    replay, feed = step.station.replay, step.station.sample_queue
    step.station.rate_limiter.ratio, feed.incarnation = 1.0, 1
    assert len(replay) == 80 and feed.ask(m.SampleRequest(request=1)) is None
    step.station.tick(1000.0)
    step.station.finalise()
    assert len(replay) == 0 and step.station.rate_limiter.samples_due
    assert list(feed.serve(0, 0)) == []
    assert step.station.phase == "done"  # and no process waits for it

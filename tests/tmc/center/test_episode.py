"""An episode as the TMC keeps it, against an outside referee: plain loops and dictionaries, written from the paper."""

from __future__ import annotations

import dataclasses
import math
import pickle
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmc.center.episode import EpisodeState, Exchange, FinalTicks, RefusedError
from tmc.center.replay import Replay, Ring
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.reward import Block, RewardLaw
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World
from tmc.wire.messages import Record

MOVES = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0)]
CASES: dict[str, dict[str, Any]] = {
    "paper": {},
    "scenario 1": {"scenario": 1},
    "own": {"reward.uncertainty": "own"},
    "own, scenario 1": {"reward.uncertainty": "own", "scenario": 1},
    "own, staggered": {"reward.uncertainty": "own", "comms.phase": "staggered", "comms.period": 7},
    "team": {"reward.novelty": "team"},
    "own, team": {"reward.uncertainty": "own", "reward.novelty": "team", "world.initial_map": "random"},
    "aligned": {"reward.aligned": True, "dqn.gamma": 0.9},
    "random": {"world.initial_map": "random", "comms.phase": "staggered"},
    "everywhere": {"world.alpha": 0.05, "world.alpha_offroad": 0.002, "reward.aligned": True, "reward.weight": 2.0},
}
N, T = 5, 60


class Referee:
    """Flies nothing: takes the cells and actions of the team, and says what the paper makes of them."""

    def __init__(self, world: World, tracks: list[dict[str, list[Any]]]) -> None:
        self.config, self.grid, self.map = world.config, world.grid, world.map
        self.alpha = {k: a for k, a in enumerate(world.alpha.tolist()) if a > 0}
        self.tracks, self.world = tracks, world
        factor = world.initial_factor(1)
        left = [1.0] * len(self.alpha) if factor is None else factor.tolist()
        self.left = dict(zip(self.alpha, left, strict=True))
        self.sums: list[float] = []
        self.rewards: list[list[float]] = []
        self.events: list[tuple[int, int]] = []
        (self._limited if self.config.scenario == 2 else self._continuous)()

    def u(self, tau: dict[int, int], k: int, t: int) -> float:
        """Eq. (3); `tau` holds the cells visited so far, and cells not in it still have their initial map."""
        if k in tau:
            return 1 - math.exp(-self.alpha[k] * (t - tau[k]))
        return 1 - self.left[k] * math.exp(-self.alpha[k] * t)

    def near(self, a: int, b: int) -> bool:
        return math.dist(divmod(a, self.grid.cols), divmod(b, self.grid.cols)) <= self.config.team.sensing_range

    def _credit(self, i: int, k: int, u: float, novel: bool, blocked: bool) -> float:
        rules = self.config.reward
        if blocked:
            return rules.collision
        value = u / (1 - self.config.dqn.gamma * math.exp(-self.alpha[k])) if rules.aligned and k in self.alpha else u
        return rules.weight * value + (rules.new_cell if novel else 0.0)

    def _novel(self, i: int, k: int, been: list[set[int]]) -> bool:
        if self.config.reward.novelty == "own":
            return k not in been[i]
        return not any(k in cells for cells in been)

    def _limited(self) -> None:
        true: dict[int, int] = {}
        own: list[dict[int, int]] = [{} for _ in self.tracks]
        been: list[set[int]] = [set() for _ in self.tracks]
        shipped = [-1] * len(self.tracks)
        for t in range(T + 1):
            cells = [track["cells"][t] for track in self.tracks]
            rewards = []
            for i, k in enumerate(cells):
                known = true if self.config.reward.uncertainty == "true" else own[i]
                u = self.u(known, k, t) if k in self.alpha else 0.0
                blocked = t > 0 and self.tracks[i]["blocks"][t - 1] > 0
                rewards.append(self._credit(i, k, u, self._novel(i, k, been), blocked))
            for i, k in enumerate(cells):
                true[k] = t
                been[i].add(k)
                own[i] |= {c: t for j, c in enumerate(cells) if j == i or self.near(k, c)}
            due = [i for i in range(len(cells)) if self._due(i, t)]
            for i in due:
                shipped[i] = t
            told = self._told(shipped)
            for i in due:
                own[i] = {k: max(own[i].get(k, 0), told.get(k, 0)) for k in own[i].keys() | told.keys()}
            if t:
                self.rewards.append(rewards)
            self.sums.append(sum(self.u(true, k, t) for k in self.alpha))

    def _due(self, i: int, t: int) -> bool:
        comms = self.config.comms
        phase = 0 if comms.phase == "together" else math.floor(i * comms.period / len(self.tracks))
        return t % comms.period == phase or t == T

    def _told(self, shipped: list[int]) -> dict[int, int]:
        """The global map: the newest of all visits that were shipped."""
        told: dict[int, int] = {}
        for track, last in zip(self.tracks, shipped, strict=True):
            for t, k in enumerate(track["cells"][: last + 1]):
                told[k] = max(told.get(k, 0), t)
        return told

    def _continuous(self) -> None:
        active: set[int] = set()
        been: list[set[int]] = [set() for _ in self.tracks]
        for t in range(T + 1):
            cells = [track["cells"][t] for track in self.tracks]
            if t:
                self.rewards.append([
                    self._credit(
                        i, k, float(k in active), self._novel(i, k, been), self.tracks[i]["blocks"][t - 1] > 0
                    )
                    for i, k in enumerate(cells)
                ])  # fmt: skip
                active -= set(cells)
                arrived = set(np.flatnonzero(self.world.arrivals(1, t)).tolist())
                self.events += [(t, k) for k in sorted(arrived - active)]
                active |= arrived
            for i, k in enumerate(cells):
                been[i].add(k)
            self.sums.append(float(len(active)))

    def blocked(self) -> dict[str, int]:
        """Count blocked moves by cause: a UAV that is not where its action leads was blocked."""
        counts = dict.fromkeys(("GRID", "OBSTACLE", "UAV"), 0)
        for i, track in enumerate(self.tracks):
            for t in range(T):
                (row, col), (down, right) = divmod(track["cells"][t], self.grid.cols), MOVES[track["actions"][t]]
                row, col = row + down, col + right
                if not (0 <= row < self.grid.rows and 0 <= col < self.grid.cols):
                    counts["GRID"] += 1
                elif self.map.blocked[row * self.grid.cols + col]:
                    counts["OBSTACLE"] += 1
                elif self._holder(i, t, row * self.grid.cols + col):
                    counts["UAV"] += 1
                else:
                    assert track["cells"][t + 1] == row * self.grid.cols + col, "a free move was not made"
                    continue
                assert track["cells"][t + 1] == track["cells"][t], "a blocked UAV moved"
        return counts

    def _holder(self, i: int, t: int, target: int) -> bool:
        return any(track["cells"][t + (j < i)] == target for j, track in enumerate(self.tracks) if j != i)


@pytest.fixture(scope="module", params=list(CASES))
def case(
    request: pytest.FixtureRequest, mission: Callable[..., Any], town: RoadMap
) -> tuple[Any, EpisodeState, Referee]:
    """A mission of one episode in a random interleaving, its episode, and the referee's account of it."""
    values = {"team.size": N, "training.ticks": T, "replay.capacity": 10_000, **CASES[request.param]}
    flown = mission(values, town)
    flights = set()
    for _ in flown.steps(Random(request.param)):
        flights |= {flown.station.episode} - {None}
    (episode,), tracks = flights, flown.flown()
    return flown, episode, Referee(flown.world, [tracks[1, i] for i in range(N)])


def entries(flown: Any, topic: str, key: str) -> list[Any]:
    return [x for e in flown.entries if e.topic == topic for x in e.values[key]]


def test_uncertainty_of_every_tick(case: tuple[Any, EpisodeState, Referee]) -> None:
    flown, episode, referee = case
    assert entries(flown, "/tmc/metrics", "uncertainty") == pytest.approx(referee.sums, abs=1e-9)
    assert episode.total_uncertainty == pytest.approx(sum(referee.sums[1:]), abs=1e-7)
    assert flown.station.episode_uncertainty == pytest.approx(sum(referee.sums[1:]) / T, abs=1e-9)


def test_rewards_of_every_move(case: tuple[Any, EpisodeState, Referee]) -> None:
    flown, episode, referee = case
    given_ = flown.station.replay.rewards[np.arange(1, T + 1)]
    assert given_.ravel().tolist() == pytest.approx(np.array(referee.rewards).ravel().tolist(), rel=1e-6, abs=1e-6)
    assert not flown.station.replay.rewards[np.arange(1)].any()
    assert episode.total_reward == pytest.approx(np.array(referee.rewards).sum(axis=0).tolist(), abs=1e-4)
    mean = np.array(referee.rewards).mean(axis=1).tolist()
    assert entries(flown, "/tmc/metrics", "reward")[1:] == pytest.approx(mean, rel=1e-6, abs=1e-6)


def test_events_of_scenario_1(case: tuple[Any, EpisodeState, Referee]) -> None:
    flown, _, referee = case
    ticks, cells = entries(flown, "/tmc/events", "ticks"), entries(flown, "/tmc/events", "cells")
    assert list(zip(ticks, cells, strict=True)) == referee.events
    assert bool(referee.events) == (flown.world.config.scenario == 1)


def test_blocked_moves_by_cause(case: tuple[Any, EpisodeState, Referee]) -> None:
    flown, episode, referee = case
    counts = referee.blocked()
    assert {block.name: n for block, n in episode.blocked.items()} == counts
    assert all(counts.values()), "an episode without every kind of block shows little"
    assert flown.station.blocked == sum(counts.values())


def test_no_two_uavs_share_a_cell(case: tuple[Any, EpisodeState, Referee]) -> None:
    """Eq. (1)."""
    _, episode, _ = case
    assert all(len(set(cells)) == N for cells in episode.cells.tolist())


@pytest.mark.parametrize("initial", ["visited", "random"])
@pytest.mark.parametrize("rates", ["uniform", "volume"])
def test_the_accounting_identity(mission: Callable[..., Any], toronto: RoadMap, initial: str, rates: str) -> None:
    """sum_t u_k(t) = F_k - sum_v u_k(t_v before) (1 - q^(T - t_v + 1)) / (1 - q) over all cells (ADR 0006)."""
    T, N = 150, 4
    values = {"team.size": N, "training.ticks": T, "world.initial_map": initial, "world.rates": rates}
    flown = mission({**values, "team.controller": "planner:greedy"}, toronto).play(Random(1))
    world, tracks = flown.world, flown.flown()
    visits: dict[int, list[int]] = {}
    for t in range(1, T + 1):
        for i in range(N):
            visits.setdefault(tracks[1, i]["cells"][t], []).append(t)
    starts = {tracks[1, i]["cells"][0] for i in range(N)}
    factor = world.initial_factor(1)
    total = 0.0
    for place, k in enumerate(world.law.cells.tolist()):
        q = math.exp(-world.alpha[k])
        left = 1.0 if factor is None or k in starts else float(factor[place])
        total += sum(1 - left * q**t for t in range(1, T + 1))
        since = 0
        for t in visits.get(k, []):
            before = 1 - left * q ** (t - since)
            total -= before * (1 - q ** (T - t + 1)) / (1 - q)
            left, since = 1.0, t
    assert T * flown.station.episode_uncertainty == pytest.approx(total, abs=1e-6)


# The exchange.

STAGGERED = {"team.size": 4, "training.ticks": 33, "comms.phase": "staggered", "comms.period": 7}
EXCHANGES: dict[str, dict[str, Any]] = {
    "staggered": STAGGERED,
    "together": {**STAGGERED, "comms.phase": "together"},
    "staggered, all at T only": {**STAGGERED, "comms.period": 100},
    "scenario 1": {**STAGGERED, "scenario": 1},
}


def fresh(world: World) -> EpisodeState:
    return EpisodeState(world, RewardLaw(world.config, world.law.q), Replay(world, ObservationBuilder(world)), 1, 0)


class Shipped:
    """A world, and the records of each UAV in it; no dataclass, since hypothesis would print it all."""

    def __init__(self, world: World, queues: list[list[Record]]) -> None:
        self.world, self.queues = world, queues


@pytest.fixture(scope="module", params=list(EXCHANGES))
def shipped(request: pytest.FixtureRequest, mission: Callable[..., Any], town: RoadMap) -> Shipped:
    """Of an episode in a fixed order."""
    flown = mission(EXCHANGES[request.param], town).play()
    return Shipped(flown.world, [[r for r in flown.records if r.uav == i] for i in range(4)])


def expected_map(world: World, queues: list[list[Record]], t: int) -> list[int]:
    """The newest visit of each monitored cell among the records due by t, by plain loops."""
    newest: dict[int, int] = {}
    for queue in queues:
        for r in queue:
            if r.tick <= t:
                for tick, cell in enumerate(r.cells.tolist(), r.first):
                    newest[cell] = max(newest.get(cell, 0), tick)
    return [newest.get(k, 0) for k in world.law.cells.tolist()]


def deliver(
    world: World, queues: list[list[Record]], rng: Random
) -> tuple[dict[int, Exchange], list[FinalTicks], EpisodeState]:
    """All records in some order that real UAVs could make: none ships before it is answered."""
    episode, answers, truths = fresh(world), {}, []
    place, waiting = [0] * len(queues), [False] * len(queues)
    while not episode.over:
        i = rng.choice([i for i, queue in enumerate(queues) if place[i] < len(queue) and not waiting[i]])
        episode.accept(queues[i][place[i]])
        place[i], waiting[i] = place[i] + 1, True
        for exchange in episode.exchanges():
            answers[exchange.tick] = exchange
            for j in exchange.uavs:
                waiting[j] = False
        truths.append(episode.finalise())
    return answers, truths, episode


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_answers_and_truth_do_not_depend_on_the_order_of_arrival(shipped: Shipped, seed: int) -> None:
    world, queues = shipped.world, shipped.queues
    answers, truths, episode = deliver(world, queues, Random(seed))
    first, truths_then, then = deliver(world, queues, Random(0))
    assert list(answers) == sorted(answers) == list(first)
    for t, answer in answers.items():
        assert (answer.version, answer.uavs, answer.believed) == (first[t].version, first[t].uavs, first[t].believed)
        assert answer.last_visit.tolist() == first[t].last_visit.tolist()
        assert answer.active.tolist() == first[t].active.tolist()
        if world.config.scenario == 2:
            assert answer.last_visit.tolist() == expected_map(world, queues, t)
    for name in ("uncertainty", "reward", "events"):
        ours, theirs = ([x for truth in t for x in getattr(truth, name)] for t in (truths, truths_then))
        assert [np.asarray(x).tolist() for x in ours] == [np.asarray(x).tolist() for x in theirs]
    assert next(t.first for t in truths if t.uncertainty) == 0
    rows = np.repeat(np.arange(34), 4)
    uavs = np.tile(np.arange(4), 34)
    assert episode.replay.belief(rows, uavs).tobytes() == then.replay.belief(rows, uavs).tobytes()


# What is refused.


def changed(**fields: Any) -> Callable[[Record, EpisodeState], Record]:
    return lambda r, _: dataclasses.replace(r, **fields)


def put(name: str, place: int, value: int) -> Callable[[Record, EpisodeState], Record]:
    def make(r: Record, _: EpisodeState) -> Record:
        array = getattr(r, name).copy()
        array[place] = value
        return dataclasses.replace(r, **{name: array})

    return make


def cut(name: str) -> Callable[[Record, EpisodeState], Record]:
    return lambda r, _: dataclasses.replace(r, **{name: getattr(r, name)[:-1]})


def longer(name: str) -> Callable[[Record, EpisodeState], Record]:
    return lambda r, _: dataclasses.replace(r, **{name: np.append(getattr(r, name), getattr(r, name)[-1:])})


def seen(ticks: list[int], cells: list[int]) -> Callable[[Record, EpisodeState], Record]:
    return changed(seen_tick=np.array(ticks, "<u2"), seen_cell=np.array(cells, "<u2"))


def stayed_unblocked(r: Record, episode: EpisodeState) -> Record:
    """The action moves, nothing blocked it, and the UAV stands still."""
    cell = episode.cells[r.first - 1, r.uav]
    cells = np.full(r.cells.size, cell, "<u2")
    return dataclasses.replace(
        r, cells=cells, actions=np.full(r.actions.size, 0, "u1"), blocks=np.zeros(r.blocks.size, "u1")
    )


def moved_blocked(r: Record, episode: EpisodeState) -> Record:
    """Every move is said to be blocked, but the cells change."""
    assert len({int(episode.cells[r.first - 1, r.uav]), *r.cells.tolist()}) > 1
    return dataclasses.replace(r, blocks=np.full(r.blocks.size, Block.UAV, "u1"))


def claims(block: Block, action: Callable[[World, int], int]) -> Callable[[Record, EpisodeState], Record]:
    """The UAV stays, and names a cause that its cell and its action rule out."""

    def make(r: Record, episode: EpisodeState) -> Record:
        cell = int(episode.cells[r.first - 1, r.uav])
        size = r.actions.size
        return dataclasses.replace(
            r, cells=np.full(size, cell, "<u2"), blocks=np.full(size, block, "u1"),
            actions=np.full(size, action(episode.world, cell), "u1"),
        )  # fmt: skip

    return make


def free_move(world: World, cell: int) -> int:
    targets = world.grid.target_lists[cell]
    return next(a for a in range(8) if targets[a] >= 0 and not world.map.blocked[targets[a]])


MALFORMED: dict[str, tuple[Callable[[Record, EpisodeState], Record], str]] = {
    "a gap before it": (changed(first=15), "starts at tick 15, expected 8"),
    "an overlap": (changed(first=7), "starts at tick 7, expected 8"),
    "from the start again": (changed(first=0), "starts at tick 0, expected 8"),
    "too early": (changed(tick=13), "ends at tick 13, it is due at 14"),
    "too late": (changed(tick=21), "ends at tick 21, it is due at 14"),
    "cells missing": (cut("cells"), "do not match its ticks"),
    "cells too many": (longer("cells"), "do not match its ticks"),
    "actions missing": (cut("actions"), "do not match its ticks"),
    "actions too many": (longer("actions"), "do not match its ticks"),
    "blocks missing": (cut("blocks"), "do not match its ticks"),
    "blocks too many": (longer("blocks"), "do not match its ticks"),
    "rewards missing": (cut("rewards"), "do not match its ticks"),
    "rewards too many": (longer("rewards"), "do not match its ticks"),
    "a cell off the grid": (put("cells", 2, 108), "off the grid or on an obstacle"),
    "a cell far off the grid": (put("cells", -1, 65_535), "off the grid or on an obstacle"),
    "a cell on an obstacle": (put("cells", 3, 15), "off the grid or on an obstacle"),
    "an unknown action": (put("actions", 0, 9), "unknown action or block"),
    "an unknown block": (put("blocks", 0, 4), "unknown action or block"),
    "stays unblocked": (stayed_unblocked, "jumps"),
    "moves although blocked": (moved_blocked, "jumps"),
    "another last cell": (lambda r, f: put("cells", -1, (int(r.cells[-1]) + 30) % 12)(r, f), "jumps"),
    "a sighting before it": (seen([7], [0]), "sightings"),
    "a sighting after it": (seen([15], [0]), "sightings"),
    "a sighting without a cell": (seen([8, 9], [0]), "sightings"),
    "a sighting without a tick": (seen([8], [0, 1]), "sightings"),
    "a sighting off the grid": (seen([8], [108]), "sighting off the grid"),
    "blocked by no edge": (claims(Block.GRID, free_move), "block"),
    "blocked by no obstacle": (claims(Block.OBSTACLE, free_move), "block"),
    "blocked while it stays": (claims(Block.UAV, lambda w, c: 8), "kept it from staying"),
}


@pytest.fixture(scope="module")
def halfway(mission: Callable[..., Any], town: RoadMap) -> tuple[World, list[list[Record]]]:
    flown = mission({"team.size": 2, "training.ticks": 25, "comms.period": 7}, town).play()
    return flown.world, [[r for r in flown.records if r.uav == i] for i in range(2)]


def state(episode: EpisodeState) -> bytes:
    """Everything that an episode and its replay hold."""
    own = {k: v for k, v in vars(episode).items() if k not in {"world", "reward", "replay"}}
    memory = {k: v for k, v in vars(episode.replay).items() if k not in {"world", "observer"}}
    return pickle.dumps((own, {k: vars(v) if isinstance(v, Ring) else v for k, v in memory.items()}))


@pytest.mark.parametrize("why", list(MALFORMED))
def test_a_malformed_record_is_refused_and_changes_nothing(halfway: tuple[World, list[list[Record]]], why: str) -> None:
    world, queues = halfway
    episode = fresh(world)
    for place in range(2):
        for queue in queues:
            episode.accept(queue[place])
            list(episode.exchanges())
            episode.finalise()
    make, sentence = MALFORMED[why]
    bad, before = make(queues[1][2], episode), state(episode)
    with pytest.raises(RefusedError, match=sentence):
        episode.accept(bad)
    assert state(episode) == before
    episode.accept(queues[1][2])  # the intact one is still welcome
    assert episode.reported == [7, 14]


def test_a_flight_starts_where_it_was_told_to(halfway: tuple[World, list[list[Record]]]) -> None:
    world, queues = halfway
    episode, first = fresh(world), queues[0][0]
    other = next(c for c in world.start_cells.tolist() if c != world.starts(1)[0])
    before = state(episode)
    with pytest.raises(RefusedError, match=f"did not start on cell {world.starts(1)[0]}"):
        episode.accept(dataclasses.replace(first, cells=np.array([other], "<u2")))
    assert state(episode) == before


def test_nothing_follows_the_last_record(halfway: tuple[World, list[list[Record]]]) -> None:
    world, queues = halfway
    episode = fresh(world)
    for place in range(5):
        for queue in queues:
            episode.accept(queue[place])
            list(episode.exchanges())
    episode.finalise()
    assert episode.over and episode.done == 25
    last, before = queues[0][-1], state(episode)
    for first, tick in ((22, 25), (26, 26), (26, 28)):
        size = tick - first + 1
        cells = np.full(size, last.cells[-1], "<u2")
        stay, none = np.full(size, 8, "u1"), np.zeros(size, "u1")
        with pytest.raises(RefusedError, match="UAV 0"):
            episode.accept(
                dataclasses.replace(
                    last, first=first, tick=tick, cells=cells, actions=stay, blocks=none, rewards=np.zeros(size, "<f4")
                )
            )
    assert state(episode) == before

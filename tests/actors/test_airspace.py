"""The look-ahead airspace flies as if every UAV waited for all, in any interleaving, over table and radio."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.airspace import Airspace, Tracks, Waiting
from actors.radio import RadioTracks
from actors.tracks import TableTracks, TrackTable
from tmc.kernel.grid import N_ACTIONS, Grid
from tmc.wire.messages import Beacon

TICKS = 24


@dataclass
class Plan:
    """What all UAVs intend: the starts of each episode, and one action per tick per UAV."""

    grid: Grid
    sensing: float
    starts: list[list[int]]
    actions: list[list[list[int]]]

    @property
    def team(self) -> int:
        return len(self.starts[0])


@dataclass
class Trace:
    """What was flown: (episode, tick, uav) -> cell, cells of sensed peers, and whether the move was blocked."""

    cell: dict[tuple[int, int, int], int] = field(default_factory=dict)
    seen: dict[tuple[int, int, int], list[int]] = field(default_factory=dict)
    held: dict[tuple[int, int, int], bool] = field(default_factory=dict)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Random flights that tend to the middle, so that UAVs meet."""
    grid = Grid(draw(st.integers(2, 14)), draw(st.integers(2, 14)))
    team = draw(st.integers(1, min(6, grid.size)))
    sensing = draw(st.sampled_from([0.0, 1.0, 1.5, 2.0, 3.2, math.inf]))
    rng = Random(draw(st.integers(0, 2**32)))
    middle = draw(st.sampled_from([0.0, 0.3, 0.8]))
    starts = [rng.sample(range(grid.size), team) for _ in range(2)]
    actions = [
        [[-1 if rng.random() < middle else rng.randrange(N_ACTIONS) for _ in range(team)] for _ in range(TICKS)]
        for _ in range(2)
    ]
    return Plan(grid, sensing, starts, actions)


def target(plan: Plan, cell: int, action: int) -> int:
    """Return where an action leads: the cell itself if off the grid. -1 is the action that leads nearest the middle."""
    options = plan.grid.target_lists[cell]
    if action >= 0:
        return options[action] if options[action] >= 0 else cell
    middle = plan.grid.cell(plan.grid.rows // 2, plan.grid.cols // 2)
    return min((k for k in options if k >= 0), key=lambda k: plan.grid.chebyshev(k, middle))


def reference(plan: Plan) -> Trace:
    """Fly by brute force: every UAV waits for all others, tick by tick, in ascending id."""
    trace, cols = Trace(), plan.grid.cols
    for e, starts in enumerate(plan.starts):
        cells = list(starts)
        for t in range(TICKS + 1):
            for i, c in enumerate(cells):
                trace.cell[e, t, i] = c
                trace.seen[e, t, i] = [
                    d for j, d in enumerate(cells)
                    if j != i and math.dist(divmod(c, cols), divmod(d, cols)) <= plan.sensing + 1e-9
                ]  # fmt: skip
            if t == TICKS:
                continue
            for i in range(plan.team):
                goal = target(plan, cells[i], plan.actions[e][t][i])
                trace.held[e, t, i] = goal in cells[:i] + cells[i + 1 :]
                cells[i] = cells[i] if trace.held[e, t, i] else goal
    return trace


class Flyer:
    """One UAV of a plan: starts episodes, senses and moves, as far as its airspace lets it."""

    def __init__(self, plan: Plan, i: int, tracks: Tracks, trace: Trace) -> None:
        self.plan, self.i, self.trace = plan, i, trace
        self.airspace = Airspace(i, plan.team, plan.grid, plan.sensing, tracks)
        self.episode, self.t, self.stage = 0, 0, "begin"
        self.waits: Waiting | None = None

    @property
    def finished(self) -> bool:
        return self.episode == len(self.plan.starts)

    def step(self) -> bool:
        """Take one step; return False when it must wait for a peer."""
        self.waits = None
        try:
            getattr(self, f"_{self.stage}")()
        except Waiting as waiting:
            self.waits = waiting
            return False
        return True

    def _begin(self) -> None:
        starts = self.plan.starts[self.episode]
        self.t, self.cell, self.stage = 0, starts[self.i], "sense"
        self.airspace.start_episode(self.episode + 1, starts)
        self.airspace.tracks.publish(0, self.cell)

    def _sense(self) -> None:
        key = (self.episode, self.t, self.i)
        self.trace.seen[key] = self.airspace.sense(self.t, self.cell)
        self.trace.cell[key] = self.cell
        self.stage = "move"
        if self.t == TICKS:
            self.episode, self.stage = self.episode + 1, "begin"

    def _move(self) -> None:
        goal = target(self.plan, self.cell, self.plan.actions[self.episode][self.t][self.i])
        held = self.airspace.is_held(self.t, self.cell, goal)
        self.trace.held[self.episode, self.t, self.i] = held
        self.t, self.cell, self.stage = self.t + 1, self.cell if held else goal, "sense"
        self.airspace.tracks.publish(self.t, self.cell)


def fly(flyers: list[Flyer], rng: Random, air: Callable[[], bool], silence: Callable[[], None]) -> None:
    """Let flyers and the radio take steps in random order; call `silence` when none can. Episodes start together."""
    stuck: set[int] = set()
    quiet = 0
    while not all(f.finished for f in flyers):
        slowest = min(f.episode for f in flyers)
        able = [f for f in flyers if f.i not in stuck and not f.finished and f.episode == slowest]
        if rng.random() < 0.4 or not able:
            if air():
                stuck.clear()
                quiet = 0
                continue
            if not able:
                quiet += 1
                assert quiet < 300, "the team waits for ever"
                silence()
                continue
        flyer = rng.choice(able)
        if flyer.step():
            stuck.clear()
        else:
            stuck.add(flyer.i)


def no_delivery() -> None:
    pytest.fail("all UAVs wait for another one")


@settings(max_examples=40, deadline=None)
@given(plan=plans(), seed=st.integers(0, 2**32))
def test_over_a_table(plan: Plan, seed: int) -> None:
    trace, table = Trace(), TrackTable(plan.team, TICKS)
    flyers = [Flyer(plan, i, TableTracks(table, i), trace) for i in range(plan.team)]
    fly(flyers, Random(seed), lambda: False, no_delivery)
    assert trace == reference(plan)


class Air:
    """Queues between each two UAVs, in order; a share of the beacons is lost."""

    def __init__(self, plan: Plan, rng: Random, lost: float) -> None:
        self.rng, self.lost, self.trace = rng, lost, Trace()
        self.queues: dict[tuple[int, int], deque[Beacon]] = {}
        self.sent = 0
        self.radios = [
            RadioTracks(i, plan.team, plan.grid, plan.sensing, self.send) for i in range(plan.team)
        ]  # fmt: skip
        self.flyers = [Flyer(plan, i, radio, self.trace) for i, radio in enumerate(self.radios)]

    def send(self, beacon: Beacon) -> None:
        self.sent += 1
        for j in beacon.to.tolist():
            if self.rng.random() >= self.lost:
                self.queues.setdefault((beacon.uav, j), deque()).append(beacon)

    def deliver(self) -> bool:
        full = [key for key, queue in self.queues.items() if queue]
        if not full:
            return False
        key = self.rng.choice(full)
        self.radios[key[1]].on_beacon(self.queues[key].popleft())
        return True

    def ask(self) -> None:
        for flyer, radio in zip(self.flyers, self.radios, strict=True):
            if flyer.waits is not None:
                radio.request_track(flyer.waits.peer)


@settings(max_examples=40, deadline=None)
@given(plan=plans(), seed=st.integers(0, 2**32))
def test_over_radio_a_uav_that_waits_gets_a_beacon(plan: Plan, seed: int) -> None:
    """Beacons arrive late but in order, so no UAV ever has to request a track."""
    air = Air(plan, Random(seed), lost=0.0)
    fly(air.flyers, air.rng, air.deliver, no_delivery)
    assert air.trace == reference(plan)


@settings(max_examples=25, deadline=None)
@given(plan=plans(), seed=st.integers(0, 2**32), lost=st.sampled_from([0.05, 0.3, 0.7]))
def test_over_radio_with_lost_beacons_the_waiting_uav_requests_the_track(plan: Plan, seed: int, lost: float) -> None:
    air = Air(plan, Random(seed), lost)
    fly(air.flyers, air.rng, air.deliver, air.ask)
    assert air.trace == reference(plan)


def test_two_that_fly_towards_each_other_over_radio() -> None:
    """The first is far ahead when its beacon arrives, so its newest cell says little about where it was."""
    grid = Grid(1, 40)
    starts = [[0, 39]]
    east, west = 3, 2
    plan = Plan(grid, 1.5, starts, [[[east, west]] * TICKS])
    air = Air(plan, Random(0), lost=0.0)
    first, second = air.flyers
    first.step()
    while first.step():
        pass
    assert first.t == 19  # 39 - 2 * 19 = 1: only here can the other be next to it
    fly([first, second], air.rng, air.deliver, no_delivery)
    assert air.trace == reference(plan)


def test_far_from_each_other_no_uav_waits_and_nothing_is_sent() -> None:
    grid = Grid(30, 30)
    plan = Plan(grid, 1.5, [[0, 899]], [[[8, 8]] * TICKS])
    air = Air(plan, Random(0), lost=0.0)
    for flyer in air.flyers:
        assert all(flyer.step() for _ in range(2 + 2 * 13))
    assert air.sent == 0
    lead = air.flyers[0].airspace.lead(13)
    assert lead == 13


def test_waiting_names_the_peer_and_the_tick() -> None:
    table = TrackTable(3, 10)
    airspace = Airspace(0, 3, Grid(9, 9), 1.5, TableTracks(table, 0))
    airspace.start_episode(1, [0, 80, 2])
    with pytest.raises(Waiting, match="waiting for UAV 2 at tick 1") as waiting:
        airspace.sense(1, 1)
    assert (waiting.value.peer, waiting.value.tick) == (2, 1)


def test_to_stay_is_never_held() -> None:
    airspace = Airspace(1, 3, Grid(3, 3), 1.5, TableTracks(TrackTable(3, 10), 1))
    airspace.start_episode(1, [0, 1, 2])
    assert airspace.is_held(0, 1, 1) is False  # without waiting for a peer


def test_a_beacon_that_cannot_be_changes_nothing() -> None:
    said: list[Beacon] = []
    radio = RadioTracks(0, 2, Grid(3, 3), 1.5, said.append)
    radio.start_episode(2, [0, 8])
    none = np.zeros(0, "<u2")
    for uav, episode, cell in ((0, 2, 5), (2, 2, 5), (60_000, 2, 5), (1, 1, 5), (1, 2, 9), (1, 2, 65_535)):
        radio.on_beacon(Beacon(uav, episode, 1, np.array([cell], "<u2"), none))
        assert radio.newest(1) == (0, 8) and radio.newest(0) == (0, 0) and radio.at(1, 1) == -1
    assert said == []
    radio.on_beacon(Beacon(1, 2, 1, np.array([7, 6], "<u2"), none))
    assert radio.newest(1) == (2, 6) and [radio.at(1, t) for t in range(4)] == [8, 7, 6, -1]


def test_a_beacon_of_the_next_episode_is_kept_until_it_begins() -> None:
    radio = RadioTracks(0, 2, Grid(3, 3), 1.5, lambda _: None)
    early = Beacon(1, 1, 1, np.array([5], "<u2"), np.zeros(0, "<u2"))
    radio.on_beacon(early)
    radio.start_episode(1, [0, 8])
    assert radio.newest(1) == (1, 5)
    radio.start_episode(2, [0, 7])
    assert radio.newest(1) == (0, 7)


def test_a_lost_uav_gets_no_more_beacons() -> None:
    """Its track no longer grows, so by the rule each of this UAV's positions could matter to it."""
    said: list[Beacon] = []
    airspace = Airspace(0, 3, Grid(3, 3), 1.5, RadioTracks(0, 3, Grid(3, 3), 1.5, said.append))
    airspace.start_episode(1, [0, 2, 8])
    airspace.drop_peer(2)
    for tick, cell in enumerate([1, 4, 1, 0], 1):
        airspace.tracks.publish(tick, cell)
    assert said and all(beacon.to.tolist() == [1] for beacon in said)
    airspace.start_episode(2, [0, 2, 8])
    airspace.tracks.publish(1, 4)
    assert 2 in said[-1].to.tolist() + said[-2].to.tolist()

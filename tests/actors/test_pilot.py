"""One UAV as a core: what a tick does, in which order, and what it ships."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from actors.airspace import Waiting
from actors.pilot import Phase, Pilot
from actors.planners import Controller, LocalState
from actors.tracks import TableTracks, TrackTable
from tmc.kernel.draws import Stream, uniforms
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.policy import FlightError, PolicyError
from tmc.kernel.reward import Block
from tmc.kernel.world import World
from tmc.wire.messages import EMPTY, Begin, Map, Policy, PolicyRequest, Record

N_, S_, W_, E_, NW, NE, SW, SE, STAY = range(9)
STREET = "####"


class Script:
    """Chooses by a script, and keeps the states that it saw."""

    def __init__(self, actions: list[int]) -> None:
        self.actions, self.sights = iter(actions), list[LocalState]()

    def choose(self, state: LocalState) -> int:
        self.sights.append(state)
        return next(self.actions)


class Team:
    """Pilots with scripts, in an episode with the wanted starts; the test is the TMC, whose answers are empty."""

    def __init__(self, world: World, starts: list[int], scripts: list[list[int]]) -> None:
        self.world, self.T = world, world.config.training.ticks
        self.episode = next(e for e in range(1, 20_000) if world.starts(e) == starts)
        self.scripts = [Script(actions) for actions in scripts]
        table, observer = TrackTable(len(starts), self.T), ObservationBuilder(world)
        self.pilots = [
            Pilot(world, i, 1, TableTracks(table, i), observer, Policies(), script)
            for i, script in enumerate(self.scripts)
        ]
        for i, pilot in enumerate(self.pilots):
            pilot.on_begin(begin(world, self.episode, starts[i]))
        self.records: list[list[Record]] = [[] for _ in starts]

    def fly(self) -> Team:
        """Fly all pilots to the end of the episode."""
        for _ in range(10 * self.T):
            for pilot, records in zip(self.pilots, self.records, strict=True):
                try:
                    record = pilot.advance()
                except Waiting:
                    continue
                if record is not None:
                    records.append(record)
                    pilot.on_map(answer(self.world, record.episode, record.tick))
        assert all(pilot.phase is Phase.IDLE for pilot in self.pilots)
        return self

    def whole(self, i: int, name: str) -> list[Any]:
        return [x for record in self.records[i] for x in getattr(record, name).tolist()]


def begin(world: World, episode: int, *track: int, **fields: Any) -> Begin:
    zeros = np.zeros(world.law.cells.size, "<u2")
    values = {"shipped": -1, "sequence": 0, "version": 0, "policy": 0, "last_visit": zeros, "lost": EMPTY}
    cells = np.array(track, "<u2")
    return Begin(**{"episode": episode, "tick": len(track) - 1, "track": cells, **values, **fields})


def answer(world: World, episode: int, tick: int, **fields: Any) -> Map:
    last_visit = np.zeros(world.law.cells.size, "<u2") if world.config.scenario == 2 else EMPTY
    values = {"version": 1, "policy": 0, "sequence": 0, "acknowledged": 0, "last_visit": last_visit, "active": EMPTY}
    return Map(episode=episode, tick=tick, **{**values, **fields})


@pytest.fixture
def team(world_of: Callable[..., World]) -> Callable[..., Team]:
    """Return a maker of teams: `raster`, the starts, one list of actions per UAV, and other settings."""

    def make(raster: str, starts: list[int], scripts: list[list[int]], **values: Any) -> Team:
        settings = {"team.size": len(starts), "training.ticks": len(scripts[0]), "comms.period": 1000}
        return Team(world_of({**settings, **values}, raster), starts, scripts)

    return make


def u(age: int) -> float:
    return float(np.float32(5 * (1 - np.exp(-0.01 * age))))


def test_a_flight_resumed_at_its_end_waits_for_no_peer(world_of: Callable[..., World]) -> None:
    """The TMC has all of it, and the peers may be in the next episode already."""
    world = world_of({"team.size": 2, "training.ticks": 3, "comms.period": 1000}, STREET)
    episode = next(e for e in range(1, 1000) if world.starts(e) == [0, 1])
    pilot = Pilot(world, 0, 2, TableTracks(TrackTable(2, 3), 0), ObservationBuilder(world), Policies(), Script([]))
    pilot.on_begin(begin(world, episode, 0, 0, 0, 0, shipped=3, sequence=2))
    assert pilot.advance() is None and pilot.phase is Phase.IDLE
    pilot.on_map(answer(world, episode, 3))
    assert pilot.advance() is None and pilot.phase is Phase.IDLE
    pilot.on_begin(begin(world, episode + 1, world.starts(episode + 1)[0]))
    assert pilot.phase is Phase.SENSE


# Rewards and blocks.


def test_a_blocked_uav_stays_and_gets_the_collision_reward_only(team: Callable[..., Team]) -> None:
    """Each kind of block; the first visit of the cell behind it still counts as new afterwards."""
    flown = team("##X\n...", [1], [[N_, E_, W_, W_, STAY, E_]]).fly()
    assert flown.whole(0, "cells") == [1, 1, 1, 0, 0, 0, 1]
    assert flown.whole(0, "actions") == [N_, E_, W_, W_, STAY, E_]
    assert flown.whole(0, "blocks") == [Block.GRID, Block.OBSTACLE, 0, Block.GRID, 0, 0]
    rewards = [-20.0, -20.0, 1.0 + u(3), -20.0, u(1), u(4)]
    assert flown.whole(0, "rewards") == pytest.approx(rewards, rel=1e-6)


def test_a_blocked_uav_still_watches_the_cell_it_stays_on(team: Callable[..., Team]) -> None:
    flown = team("##", [0], [[W_, W_, STAY]]).fly()
    assert flown.whole(0, "rewards") == pytest.approx([-20.0, -20.0, u(1)], rel=1e-6)


def test_two_uavs_cannot_swap_cells(team: Callable[..., Team]) -> None:
    flown = team(STREET, [1, 2], [[E_, E_], [W_, W_]]).fly()
    for i in range(2):
        assert flown.whole(i, "cells") == [1 + i] * 3
        assert flown.whole(i, "blocks") == [Block.UAV, Block.UAV]
        assert flown.whole(i, "rewards") == [-20.0, -20.0]


def test_moves_are_made_in_ascending_id(team: Callable[..., Team]) -> None:
    """A higher id may follow a lower one into the cell it leaves; a lower one may not follow a higher one."""
    flown = team(STREET, [1, 0], [[E_, STAY], [E_, STAY]]).fly()
    assert flown.whole(1, "cells") == [0, 1, 1] and flown.whole(1, "blocks") == [0, 0]
    flown = team(STREET, [0, 1], [[E_, E_], [E_, STAY]]).fly()
    assert flown.whole(0, "cells") == [0, 0, 1] and flown.whole(0, "blocks") == [Block.UAV, 0]


def test_of_two_that_want_one_cell_the_lower_id_gets_it(team: Callable[..., Team]) -> None:
    flown = team("###", [0, 2], [[E_, STAY], [W_, STAY]]).fly()
    assert [flown.whole(i, "cells") for i in range(2)] == [[0, 1, 1], [2, 2, 2]]
    assert [flown.whole(i, "blocks") for i in range(2)] == [[0, 0], [Block.UAV, 0]]


def test_sensed_peers_are_remembered_and_shipped(team: Callable[..., Team]) -> None:
    """UAV 1 stands two cells away, then beside UAV 0, then passes on: its cells get the ticks of the sightings."""
    flown = team("#####", [0, 2], [[STAY] * 4, [W_, E_, E_, STAY]]).fly()
    assert flown.whole(1, "cells") == [2, 1, 2, 3, 3]
    assert (flown.whole(0, "seen_tick"), flown.whole(0, "seen_cell")) == ([1], [1])
    assert (flown.whole(1, "seen_tick"), flown.whole(1, "seen_cell")) == ([1], [0])
    assert flown.pilots[0].last_visit.tolist() == [4, 1, 0, 0, 0]
    assert flown.pilots[1].last_visit.tolist() == [1, 1, 2, 4, 0]
    peers = [s.peers for s in flown.scripts[0].sights]
    assert peers == [[], [1], [], []]


# Records and answers.


def test_a_record_is_due_every_period_and_at_the_end(team: Callable[..., Team]) -> None:
    flown = team(STREET, [0], [[E_, E_, W_, W_, STAY, E_, E_]], **{"comms.period": 3}).fly()
    records = flown.records[0]
    assert [(r.first, r.tick, r.sequence) for r in records] == [(0, 0, 0), (1, 3, 1), (4, 6, 2), (7, 7, 3)]
    assert [r.cells.tolist() for r in records] == [[0], [1, 2, 1], [0, 0, 1], [2]]
    assert [r.actions.size for r in records] == [0, 3, 3, 1]
    assert flown.pilots[0].steps == 7


def test_phases_are_staggered(team: Callable[..., Team]) -> None:
    values = {"comms.period": 6, "comms.phase": "staggered"}
    flown = team("#.#.#.#", [0, 4, 6], [[STAY] * 8] * 3, **values).fly()
    assert [[r.tick for r in records] for records in flown.records] == [[0, 6, 8], [2, 8], [4, 8]]


def test_the_map_is_merged_and_newer_own_knowledge_is_kept(team: Callable[..., Team]) -> None:
    """The record goes out first; then the answer's visits count where they are newer."""
    made = team("####", [0], [[E_, E_, STAY]], **{"comms.period": 2})
    pilot = made.pilots[0]
    assert pilot.advance().tick == 0  # type: ignore[union-attr]
    pilot.on_map(answer(made.world, made.episode, 0))
    record = pilot.advance()
    assert record is not None and record.tick == 2 and pilot.advance() is None
    told = answer(made.world, made.episode, 2, last_visit=np.array([1, 0, 0, 2], "<u2"), version=9)
    assert pilot.on_map(answer(made.world, made.episode, 1)) is None and pilot.phase is Phase.MAP
    assert pilot.on_map(answer(made.world, made.episode + 1, 2)) is None and pilot.phase is Phase.MAP
    pilot.on_map(told)
    assert pilot.last_visit.tolist() == [1, 1, 2, 2] and pilot.version == 9 and pilot.pending is None
    pilot.advance()
    ages = [2 - 1, 2 - 1, 0, 0]
    assert made.scripts[0].sights[-1].u.tolist() == pytest.approx([1 - np.exp(-0.01 * a) for a in ages], abs=1e-12)
    pilot.on_map(told)  # once more, late: old news
    assert pilot.phase is Phase.MAP


def test_scenario_1_knows_the_events_of_the_last_answer_only(team: Callable[..., Team]) -> None:
    made = team("####", [0], [[E_, E_, STAY]], scenario=1)
    pilot = made.pilots[0]
    for t, active in enumerate([[1, 3], [3], [], []]):
        record = pilot.advance()
        assert record is not None and record.tick == t
        pilot.on_map(answer(made.world, made.episode, t, active=np.array(active, "<u2")))
        made.records[0].append(record)
    pilot.advance()
    assert [s.u.tolist() for s in made.scripts[0].sights] == [[0, 1, 0, 1], [0, 0, 0, 1], [0, 0, 0, 0]]
    assert made.whole(0, "rewards") == [1.0 + 5.0, 1.0, 0.0]
    assert pilot.phase is Phase.IDLE


def test_a_repeated_begin_changes_nothing(team: Callable[..., Team]) -> None:
    made = team(STREET, [0], [[E_] * 5], **{"comms.period": 4})
    pilot = made.pilots[0]
    pilot.advance()
    pilot.on_map(answer(made.world, made.episode, 0))
    pilot.advance()
    assert pilot.on_begin(begin(made.world, made.episode, 0)) is None
    assert (pilot.t, pilot.phase, pilot.sequence) == (4, Phase.MAP, 2)


def test_a_flight_is_resumed_where_the_last_record_ends(team: Callable[..., Team]) -> None:
    made = team(STREET, [0], [[W_, E_, STAY, STAY]], **{"comms.period": 2, "training.ticks": 6})
    pilot = made.pilots[0]
    pilot.phase, pilot.episode = Phase.IDLE, 0  # a new process knows nothing
    known = np.array([0, 1, 2, 0], "<u2")
    begun = begin(made.world, made.episode, 0, 1, 2, shipped=2, sequence=2, version=5, last_visit=known)
    pilot.on_begin(begun)
    assert (pilot.t, pilot.cell, pilot.previous) == (2, 2, 1)
    assert pilot.advance() is None and pilot.phase is Phase.MAP  # the TMC has this tick: nothing is shipped twice
    pilot.on_map(answer(made.world, made.episode, 2))
    record = pilot.advance()
    assert record is not None
    assert (record.first, record.tick, record.sequence) == (3, 4, 2)
    assert record.cells.tolist() == [1, 2]
    assert record.rewards.tolist() == pytest.approx([u(2), u(2)], rel=1e-6)


# Policies and exploration.


class Policies:
    """Makes controllers of policy bytes, and keeps the bytes."""

    def __init__(self) -> None:
        self.made: list[bytes] = []

    def __call__(self, model: bytes) -> Controller:
        self.made.append(model)
        return Script([STAY] * 1000)


def learning(world_of: Callable[..., World], **values: Any) -> tuple[Pilot, Policies, World]:
    world = world_of({"team.size": 1, "comms.period": 10, "training.ticks": 500, **values}, "#####\n#####\n#####")
    policies = Policies()
    pilot = Pilot(world, 0, 1, TableTracks(TrackTable(1, 500), 0), ObservationBuilder(world), policies)
    return pilot, policies, world


def test_a_policy_is_fetched_at_an_exchange_and_nowhere_else(world_of: Callable[..., World]) -> None:
    pilot, policies, world = learning(world_of)
    start = world.starts(1)[0]
    assert pilot.on_begin(begin(world, 1, start, policy=3)) == PolicyRequest(version=3)
    assert pilot.advance() is None and pilot.phase is Phase.POLICY
    pilot.on_policy(Policy(version=2, model=b"two"))
    assert pilot.phase is Phase.POLICY and policies.made == []
    pilot.on_policy(Policy(version=3, model=b"three"))
    record = pilot.advance()
    assert record is not None and (record.policy, policies.made) == (3, [b"three"])
    assert pilot.on_map(answer(world, 1, 0, policy=3)) is None
    pilot.on_policy(Policy(version=4, model=b"four"))  # not requested
    record = pilot.advance()
    assert record is not None and (record.tick, record.policy, policies.made) == (10, 3, [b"three"])
    assert pilot.on_map(answer(world, 1, 10, policy=5)) == PolicyRequest(version=5)
    pilot.on_policy(Policy(version=6, model=b"six"))  # 5 was superseded
    assert (pilot.phase, pilot.policy, policies.made) == (Phase.ACT, 6, [b"three", b"six"])


@pytest.mark.parametrize("mask", [False, True])
def test_exploration_is_addressed(world_of: Callable[..., World], mask: bool) -> None:
    """Whether and how tick t of an episode explores follows from two numbers that can be drawn again."""
    values = {"exploration.start": 0.3, "exploration.end": 0.3, "exploration.mask_blocked": mask, "training.seed": 42}
    pilot, _, world = learning(world_of, **values, **{"comms.period": 1000})
    pilot.on_begin(begin(world, 7, world.starts(7)[0], policy=1))
    pilot.on_policy(Policy(version=1, model=b""))
    pilot.advance()
    pilot.on_map(answer(world, 7, 0, policy=1))
    while (record := pilot.advance()) is None:
        assert pilot.under_way  # `advance` returns now and then
    assert record.tick == 500
    draws = uniforms(42, Stream.EXPLORATION, 1000, episode=7, uav=0).reshape(500, 2).tolist()
    cells = [world.starts(7)[0], *record.cells.tolist()]
    explored = 0
    for t, (against_epsilon, which) in enumerate(draws):
        choices = [a for a in range(9) if not mask or world.grid.target_lists[cells[t]][a] >= 0]
        explores = against_epsilon < 0.3
        explored += explores
        assert record.actions[t] == (choices[int(which * len(choices))] if explores else STAY)
    assert pilot.explored == explored and 100 < explored < 200
    assert bool(record.blocks.any()) is not mask


class Worthy(Script):
    """A script with Q values: the number of the action, and 8 for the best."""

    best = 8.0

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        return float(action), self.best


def test_records_carry_q_of_each_move_where_priorities_are_on(world_of: Callable[..., World]) -> None:
    """Whether exploration chose it or not."""
    values = {"exploration.start": 0.5, "exploration.end": 0.5, "comms.period": 30, "replay.priority_exponent": 0.6}
    pilot, _, world = learning(world_of, **values)
    policy = Worthy([STAY] * 1000)
    pilot._make_controller = lambda _: policy
    pilot.on_begin(begin(world, 7, world.starts(7)[0], policy=1))
    pilot.on_policy(Policy(version=1, model=b""))
    record = pilot.advance()
    assert record is not None and record.values.size == 0  # no move yet
    pilot.on_map(answer(world, 7, 0, policy=1))
    record = pilot.advance()
    assert record is not None and record.tick == 30 and pilot.explored > 5
    told = record.values.reshape(30, 2)
    assert told[:, 0].tolist() == record.actions.tolist()
    assert set(told[:, 1].tolist()) == {policy.best}


@pytest.mark.parametrize("explores", [0.0, 1.0])
def test_a_policy_that_fails_in_flight_names_uav_tick_and_policy(
    world_of: Callable[..., World], explores: float
) -> None:
    """Also where exploration chooses and only Q of the move is computed."""
    values = {"exploration.start": explores, "exploration.end": explores, "replay.priority_exponent": 0.6}
    pilot, _, world = learning(world_of, **values)

    class Failing(Worthy):
        def choose(self, state: Any) -> int:
            return self.fail(state) or super().choose(state)

        def q_of(self, state: Any, action: int) -> tuple[float, float]:
            return (self.fail(state), 0.0)

        def fail(self, state: Any) -> int:
            if state.tick == 3:
                raise FlightError("gave values that are not finite (nan)")
            return 0

    pilot._make_controller = lambda _: Failing([STAY] * 1000)
    pilot.on_begin(begin(world, 7, world.starts(7)[0], policy=5))
    pilot.on_policy(Policy(version=5, model=b""))
    pilot.advance()
    pilot.on_map(answer(world, 7, 0, policy=5))
    where = "UAV 0 stops at tick 3 of episode 7: policy 5 gave values that are not finite"
    with pytest.raises(FlightError, match=where):
        pilot.advance()


def test_a_policy_that_cannot_fly_is_named_where_it_is_refused(world_of: Callable[..., World]) -> None:
    pilot, _, world = learning(world_of)

    def refuse(_: bytes) -> Any:
        raise PolicyError("the file is empty: copy it again")

    pilot._make_controller = refuse
    pilot.on_begin(begin(world, 7, world.starts(7)[0], policy=5))
    with pytest.raises(PolicyError, match="UAV 0 cannot fly policy 5: the file is empty"):
        pilot.on_policy(Policy(version=5, model=b""))


def test_a_planner_never_explores(team: Callable[..., Team]) -> None:
    values = {"exploration.start": 1.0, "exploration.end": 1.0}
    flown = team(STREET, [0], [[E_, W_] * 20], **values).fly()
    assert flown.whole(0, "actions") == [E_, W_] * 20 and flown.pilots[0].explored == 0

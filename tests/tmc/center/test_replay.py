"""The replay memory rebuilds what the UAVs saw from flight records, bit for bit, and keeps and draws what it should."""

from __future__ import annotations

import itertools
import math
import pickle
from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest

from tmc.center.replay import Replay
from tmc.kernel.config import build
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World

LIMITED = list(itertools.product([2], ["together", "staggered"], [1, 3, 7, 10], [1, 3, 8]))
CONTINUOUS = [(1, "together", 10, 1), (1, "together", 10, 3), (1, "staggered", 3, 8)]


@pytest.mark.parametrize(("view", "initial"), [("whole", "random"), ("ego", "visited")])
@pytest.mark.parametrize(("scenario", "phase", "period", "size"), LIMITED + CONTINUOUS)
def test_observations_are_rebuilt_bit_for_bit(
    mission: Callable[..., Any], town: RoadMap, scenario: int, phase: str, period: int, size: int, view: str,
    initial: str,
) -> None:  # fmt: skip
    """In any interleaving of the processes; epsilon-greedy flights that crowd in the middle of a small town."""
    values = {
        "scenario": scenario, "comms.phase": phase, "comms.period": period, "team.size": size,
        "observation.view": view, "observation.radius": 3, "world.initial_map": initial, "training.ticks": 47,
        "training.episodes": 2, "exploration.start": 0.5, "exploration.mask_blocked": view == "ego",
    }  # fmt: skip
    flown = mission(values, town).play(Random(f"{period} {size} {view}"))
    assert len(flown.seen) == 2 * 48 * size
    assert flown.differences(list(flown.seen)) == []


@pytest.mark.parametrize("scenario", [1, 2])
@pytest.mark.parametrize("sensing", [1.0, 3.0])
def test_observations_on_the_built_in_map(
    mission: Callable[..., Any], toronto: RoadMap, scenario: int, sensing: float
) -> None:
    values = {"scenario": scenario, "team.size": 5, "team.sensing_range": sensing, "training.ticks": 200}
    values |= {"comms.phase": "staggered", "world.rates": "volume", "exploration.mask_blocked": sensing == 3.0}
    flown = mission(values, toronto).play(Random(1))
    assert len(flown.seen) == 201 * 5
    assert flown.differences(list(flown.seen)) == []


def test_observations_of_flights_with_lost_processes(mission: Callable[..., Any], town: RoadMap) -> None:
    """A UAV that was lost and came back saw what it would have seen, and the replay rebuilds that."""
    values = {"team.size": 4, "comms.phase": "staggered", "comms.period": 7, "training.ticks": 80}
    flown = mission(values, town).play(Random(3), crash=0.03)
    assert max(flown.incarnations) > 1
    assert flown.differences(list(flown.seen)) == []


def test_the_observation_is_what_the_paper_says(mission: Callable[..., Any], town: RoadMap) -> None:
    """P, M and U of eq. (12), rebuilt, against plain loops over the tracks; phases together, so all maps are simple."""
    T, T_u, N = 40, 10, 4
    values = {"team.size": N, "comms.period": T_u, "training.ticks": T}
    flown = mission(values, town).play(Random(5))
    tracks = [flown.flown()[1, i]["cells"] for i in range(N)]
    cols = town.grid.cols

    def near(a: int, b: int) -> bool:
        return math.hypot(a // cols - b // cols, a % cols - b % cols) <= 1.5

    tau = [[0] * town.grid.size for _ in range(N)]
    for t in range(T + 1):
        cells = [track[t] for track in tracks]
        peers = [[c for j, c in enumerate(cells) if j != i and near(cells[i], c)] for i in range(N)]
        for i in range(N):
            for cell in (cells[i], *peers[i]):
                tau[i][cell] = t
        if t % T_u == 0:
            team_knows = [max(column) for column in zip(*tau, strict=True)]
            tau = [list(team_knows) for _ in range(N)]
        o, _ = flown.rebuilt(np.full(N, flown.row(1, t)), np.arange(N))
        for i in range(N):
            here, terrain, u = (plane.ravel().tolist() for plane in o[i])
            assert here == [1.0 if k == cells[i] else 0.5 if k in peers[i] else 0.0 for k in range(town.grid.size)]
            assert terrain == [-1.0 if town.blocked[k] else float(town.road[k]) for k in range(town.grid.size)]
            expected = [1 - math.exp(-0.01 * (t - tau[i][k])) if town.road[k] else 0 for k in range(town.grid.size)]
            assert expected == pytest.approx(u, abs=1e-7)


# Eviction.


def transitions(T: int, n: int, rows: int) -> list[tuple[int, int, int]]:
    """(episode, tick of the start, tick of the end) in the order in which they become complete, by a plain loop."""
    done = []
    for row in range(rows):
        episode, t = row // (T + 1) + 1, row % (T + 1)
        if t >= n:
            done.append((episode, t - n, t))
        if t == T:
            done += [(episode, start, T) for start in range(max(0, T - n + 1), T)]
    return done


def held(replay: Replay, T: int) -> set[tuple[int, int, int]]:
    """What can be drawn, found by drawing a lot."""
    s = replay.sample(0, 800)
    return {
        (e, t, i)
        for e, t, i in zip(
            replay.episode[s.row].tolist(), replay.tick[s.row].tolist(), s.uav.tolist(), strict=True
        )
    }  # fmt: skip


@pytest.mark.parametrize("phase", ["together", "staggered"])
@pytest.mark.parametrize(("scenario", "initial"), [(1, "visited"), (2, "visited"), (2, "random")])
@pytest.mark.parametrize(("n", "capacity"), [(1, 10), (1, 70), (3, 50), (40, 64)])
def test_a_full_memory_keeps_the_newest_and_every_live_map(
    mission: Callable[..., Any], town: RoadMap, scenario: int, initial: str, phase: str, n: int, capacity: int
) -> None:
    """After every record: what is held is the newest `capacity`, and all of it is still rebuilt bit for bit."""
    T, N = 23, 3
    values = {
        "scenario": scenario, "world.initial_map": initial, "comms.phase": phase, "comms.period": 10, "team.size": N,
        "training.ticks": T, "training.episodes": 6, "dqn.n_step": n, "replay.capacity": capacity,
        "replay.learn_start": 1, "observation.view": "ego", "observation.radius": 2,
    }  # fmt: skip
    flown = mission(values, town)
    replay, rng, rows, checks = flown.station.replay, Random(n), -1, 0
    for what, _ in flown.steps(rng):
        if what != "up" or replay.rows_in == rows or rng.random() < 0.7:
            continue
        rows, checks = replay.rows_in, checks + 1
        kept = transitions(T, n, rows)[-(capacity // N) :]
        assert len(replay) == N * len(kept) <= capacity
        if not kept:
            continue
        assert held(replay, T) == {(e, t, i) for e, t, _ in kept for i in range(N)}
        keys = {(e, tick, i) for e, start, end in kept for tick in (start, end) for i in range(N)}
        live = sorted(key for key in keys if key in flown.seen)  # the newest are not acted upon yet
        assert flown.differences(live) == []
    assert checks > 10 and replay.rows_in == 6 * (T + 1)


def test_the_memory_grows_with_its_capacity_and_not_with_the_mission(town: RoadMap) -> None:
    short, long = (
        Replay(
            World(build({"training.episodes": e, "replay.capacity": 3000}), town),
            ObservationBuilder(World(build({}), town)),
        )
        for e in (1, 1_000_000)
    )
    assert short.cells.data.shape == long.cells.data.shape
    assert short.frames.data.shape == long.frames.data.shape


# Sums and draws.


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("n", [1, 3, 30])
def test_n_step_sums_are_cut_short_at_the_end_of_an_episode(
    mission: Callable[..., Any], town: RoadMap, n: int, gamma: float
) -> None:
    """Against a plain loop: sum of gamma^k r over at most n ticks, and the discount of the bootstrap behind it."""
    T, N = 20, 3
    values = {"training.ticks": T, "training.episodes": 3, "team.size": N, "dqn.n_step": n, "dqn.gamma": gamma}
    values["exploration.mask_blocked"] = n == 3
    flown = mission(values, town).play(Random(n))
    replay = flown.station.replay
    s = replay.sample(3, 1500)
    images = replay.observer.observe_batch(s.views)
    drawn, actions = set(), flown.flown()
    for b in range(1500):
        row, i = int(s.row[b]), int(s.uav[b])
        episode, t = row // (T + 1) + 1, row % (T + 1)
        steps = min(n, T - t)
        total, discount = 0.0, 1.0
        for k in range(1, steps + 1):
            total += discount * float(replay.rewards[np.array(row + k)][i])
            discount *= gamma
        assert s.reward[b] == np.float32(total) and s.discount[b] == np.float32(discount)
        assert images[b].tobytes() == flown.seen[episode, t, i][0].tobytes()
        after, could = flown.seen[episode, t + steps, i]
        assert images[1500 + b].tobytes() == after.tobytes()
        assert np.flatnonzero(s.allowed[b]).tolist() == could
        assert s.action[b] == actions[episode, i]["actions"][t]
        drawn.add((episode, t, i))
    assert len(drawn) == 3 * T * N  # no transition is out of reach, the last of an episode included


@pytest.fixture(scope="module")
def filled(mission: Callable[..., Any], town: RoadMap) -> Replay:
    values = {"training.ticks": 25, "training.episodes": 2, "team.size": 4, "replay.capacity": 120}
    replay: Replay = mission({**values, "replay.learn_start": 1}, town).play(Random(2)).station.replay
    return replay


def test_a_minibatch_is_drawn_again_by_its_number(filled: Replay) -> None:
    for number in (0, 1, 2**40):
        first, again = filled.sample(number, 32), filled.sample(number, 32)
        assert pickle.dumps(first) == pickle.dumps(again)
    assert filled.sample(0, 32).row.tolist() != filled.sample(1, 32).row.tolist()


def test_every_transition_held_is_equally_likely(filled: Replay) -> None:
    """Chi-squared over the 120 transitions; fixed numbers, so this cannot fail by chance on another day."""
    counts: Counter[tuple[int, int]] = Counter()
    for number in range(40):
        s = filled.sample(number, 1500)
        counts.update(zip(s.row.tolist(), s.uav.tolist(), strict=True))
    expected = 40 * 1500 / 120
    assert len(counts) == len(filled) == 120
    chi2 = sum((c - expected) ** 2 / expected for c in counts.values())
    assert 70 < chi2 < 180  # 119 degrees of freedom: mean 119, standard deviation 15.4


def test_a_minibatch_has_the_shapes_and_types_of_the_message(filled: Replay) -> None:
    s = filled.sample(0, 7)
    v = s.views
    assert v.cells.shape == (14,) and v.peers.shape[0] == 14 and v.u.shape == (14, filled.observer.R)
    assert [x.dtype.str for x in (v.cells, v.peers, v.u)] == ["<u2", "<u2", "<f4"]
    assert s.action.shape == s.reward.shape == s.discount.shape == (7,) and s.allowed.shape == (7, 9)
    assert [x.dtype.str for x in (s.action, s.reward, s.discount, s.allowed)] == ["|u1", "<f4", "<f4", "|u1"]
    assert filled.sample(0, 1).views.u.shape == (2, filled.observer.R)


def test_a_capacity_below_the_team_is_not_exceeded_in_silence(town: RoadMap) -> None:
    """`replay.capacity` is a number of transitions: a memory that cannot hold one tick of the team must say so."""
    try:
        world = World(build({"team.size": 5, "replay.capacity": 3, "replay.learn_start": 1}), town)
    except ValueError:
        return
    replay = Replay(world, ObservationBuilder(world))
    for t in range(4):
        zeros = np.zeros((1, 5))
        arrays = (zeros.astype("u2"), zeros.astype("u1"), zeros.astype("f4"), zeros.astype(np.int64))
        replay.add_rows(1, t, *arrays, [True])
    assert len(replay) <= 3


def test_a_transition_keeps_its_number_and_no_other_ever_has_it(mission: Callable[..., Any], town: RoadMap) -> None:
    """While the memory forgets and refills: what the learner knows by number must be of the same transition."""
    values = {"training.ticks": 23, "training.episodes": 4, "team.size": 3, "replay.capacity": 40}
    flown = mission({**values, "replay.learn_start": 1}, town)
    known: dict[int, bytes] = {}
    drawn = 0
    for what, _ in flown.steps(Random(4)):
        if what == "up" and len(flown.station.replay):
            s = flown.station.replay.sample(drawn, 64)
            drawn += 64
            for b, number in enumerate(s.index.tolist()):
                pair = [b, 64 + b]
                seen = (s.views.cells[pair], s.views.u[pair], np.sort(s.views.peers[pair])[:, :1])
                whole = b"".join(x.tobytes() for x in seen) + s.allowed[b].tobytes()
                assert known.setdefault(number, whole + s.action[b].tobytes()) == whole + s.action[b].tobytes()
    assert drawn > 64 * 10 and len(known) > 3 * 40

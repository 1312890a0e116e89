"""What a UAV decides by, as a hash: it changes with all that is seen, and with nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from actors.observation_hash import Witness, digest
from actors.planners import Sight, Valued
from tmc.kernel.observation import Observer
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World
from tmc.wire.messages import EMPTY, Record


@pytest.fixture(scope="module")
def observer(world_of: Callable[..., World], town: RoadMap) -> Observer:
    return Observer(world_of({"observation.view": "ego", "observation.radius": 3}, town))


@pytest.fixture(scope="module")
def sight(world_of: Callable[..., World], town: RoadMap) -> Sight:
    roads = world_of({}, town).law.cells.size
    return Sight(7, 30, 29, [31], np.linspace(0, 0.9, roads), [0, 1, 3, 8], 0.5)


class North:
    def choose(self, sight: Sight) -> int:
        return 0

    def worth(self, sight: Sight, action: int) -> tuple[float, float]:
        return float(action), 9.0


def record(first: int, tick: int) -> Record:
    moves = tick - max(first, 1) + 1
    cells, small = np.zeros(tick - first + 1, "<u2"), np.zeros(moves, "u1")
    return Record(2, 1, 0, 1, first, tick, 0, 0, cells, small, small, np.zeros(moves, "<f4"), EMPTY, EMPTY)


def test_the_hash_is_what_the_document_says(observer: Observer, sight: Sight) -> None:
    image = observer.observe(sight.cell, sight.peers, sight.u)
    assert image.dtype == np.float32
    whole = hashlib.blake2b(image.tobytes() + bytes([0, 1, 3, 8]), digest_size=8).digest()
    assert digest(observer, sight) == int.from_bytes(whole, "little")


def test_it_changes_with_all_that_is_seen(observer: Observer, sight: Sight) -> None:
    u = sight.u.copy()
    u[np.flatnonzero(observer.observe(sight.cell, [], sight.u)[2].ravel()).size // 2] += 1e-3
    changed = [replace(sight, cell=42), replace(sight, peers=[]), replace(sight, allowed=[0, 1, 3])]
    changed += [replace(sight, u=sight.u * 0.99)]
    assert len({digest(observer, s) for s in (sight, *changed)}) == 5


def test_it_does_not_change_with_what_is_no_observation(observer: Observer, sight: Sight) -> None:
    same = [replace(sight, tick=8), replace(sight, previous=30), replace(sight, draw=0.1)]
    assert len({digest(observer, s) for s in (sight, *same)}) == 1


def test_one_hash_a_move_and_none_where_chance_chose(observer: Observer, sight: Sight) -> None:
    witness = Witness(observer)
    decider = witness.watch(North())
    for tick in (0, 1, 3):  # at tick 2 exploration chose
        assert decider.choose(replace(sight, tick=tick)) == 0
    seen = digest(observer, sight)
    said = witness.testify(record(0, 4))
    assert (said.uav, said.episode, said.first, said.tick) == (2, 1, 0, 4)
    assert said.hashes == [seen, seen, 0, seen]
    decider.choose(replace(sight, tick=4))
    assert witness.testify(record(5, 6)).hashes == [seen, 0]


def test_what_a_policy_says_of_its_moves_is_not_a_decision(observer: Observer, sight: Sight) -> None:
    witness = Witness(observer)
    watched = witness.watch(North())
    assert isinstance(watched, Valued) and watched.worth(sight, 4) == (4.0, 9.0)
    assert witness.testify(record(8, 8)).hashes == [0]

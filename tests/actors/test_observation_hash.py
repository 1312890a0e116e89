"""The hash of what a UAV decides by: it changes with all that is observed, and with nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from actors.observation_hash import ObservationHasher, digest
from actors.planners import LocalState, QController
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.roadmap import RoadMap
from tmc.kernel.world import World
from tmc.wire.messages import EMPTY, Record


@pytest.fixture(scope="module")
def observer(world_of: Callable[..., World], town: RoadMap) -> ObservationBuilder:
    return ObservationBuilder(world_of({"observation.view": "ego", "observation.radius": 3}, town))


@pytest.fixture(scope="module")
def state(world_of: Callable[..., World], town: RoadMap) -> LocalState:
    roads = world_of({}, town).law.cells.size
    return LocalState(7, 30, 29, [31], np.linspace(0, 0.9, roads), [0, 1, 3, 8], 0.5)


class North:
    def choose(self, state: LocalState) -> int:
        return 0

    def q_of(self, state: LocalState, action: int) -> tuple[float, float]:
        return float(action), 9.0


def record(first: int, tick: int) -> Record:
    moves = tick - max(first, 1) + 1
    cells, small = np.zeros(tick - first + 1, "<u2"), np.zeros(moves, "u1")
    return Record(
        uav=2,
        incarnation=1,
        sequence=0,
        episode=1,
        first=first,
        tick=tick,
        version=0,
        policy=0,
        cells=cells,
        actions=small,
        blocks=small,
        rewards=np.zeros(moves, "<f4"),
        seen_tick=EMPTY,
        seen_cell=EMPTY,
    )


def test_the_hash_is_what_the_document_says(observer: ObservationBuilder, state: LocalState) -> None:
    image = observer.observe(state.cell, state.peers, state.u)
    assert image.dtype == np.float32
    whole = hashlib.blake2b(image.tobytes() + bytes([0, 1, 3, 8]), digest_size=8).digest()
    assert digest(observer, state) == int.from_bytes(whole, "little")


def test_it_changes_with_all_that_is_seen(observer: ObservationBuilder, state: LocalState) -> None:
    u = state.u.copy()
    u[np.flatnonzero(observer.observe(state.cell, [], state.u)[2].ravel()).size // 2] += 1e-3
    changed = [replace(state, cell=42), replace(state, peers=[]), replace(state, allowed=[0, 1, 3])]
    changed += [replace(state, u=state.u * 0.99)]
    assert len({digest(observer, s) for s in (state, *changed)}) == 5


def test_it_does_not_change_with_what_is_no_observation(observer: ObservationBuilder, state: LocalState) -> None:
    same = [replace(state, tick=8), replace(state, previous=30), replace(state, draw=0.1)]
    assert len({digest(observer, s) for s in (state, *same)}) == 1


def test_one_hash_a_move_and_none_where_chance_chose(observer: ObservationBuilder, state: LocalState) -> None:
    hasher = ObservationHasher(observer)
    controller = hasher.watch(North())
    for tick in (0, 1, 3):  # at tick 2 exploration chose
        assert controller.choose(replace(state, tick=tick)) == 0
    seen = digest(observer, state)
    said = hasher.hashes_for(record(0, 4))
    assert (said.uav, said.episode, said.first, said.tick) == (2, 1, 0, 4)
    assert said.hashes == [seen, seen, 0, seen]
    controller.choose(replace(state, tick=4))
    assert hasher.hashes_for(record(5, 6)).hashes == [seen, 0]


def test_q_of_a_move_is_not_a_decision(observer: ObservationBuilder, state: LocalState) -> None:
    hasher = ObservationHasher(observer)
    watched = hasher.watch(North())
    assert isinstance(watched, QController) and watched.q_of(state, 4) == (4.0, 9.0)
    assert hasher.hashes_for(record(8, 8)).hashes == [0]

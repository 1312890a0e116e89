"""Algorithm 1, line by line, as far as UAVs and TMC go; the learner's lines stand in tests/learner."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from tmc.kernel.config import build

Fly = Callable[..., Any]


def test_line_initialize_simulator_random_distinct_positions_each_episode(fly: Fly) -> None:
    flown = fly({"training.episodes": 5, "training.ticks": 5})
    starts = [tuple(cells[0].tolist()) for cells in flown.cells.values()]
    assert len(set(starts)) == 5
    assert starts == [tuple(flown.world.starts(e)) for e in range(1, 6)]


def test_line_for_episode_every_episode_starts_with_a_visited_map(fly: Fly) -> None:
    """Nothing of the episode before is left: all of u(0) is zero."""
    flown = fly()
    for episode in (1, 2):
        assert flown.series("uncertainty", episode)[0] == 0.0
        assert all(flown.sights[episode, i, 0].u.sum() == 0.0 for i in range(4))


def test_line_while_t_below_T_ep_every_uav_moves_T_ep_times(fly: Fly) -> None:  # noqa: N802
    flown = fly()
    assert [pilot.steps for pilot in flown.pilots] == [2 * 37] * 4
    assert all((cells >= 0).all() for cells in flown.cells.values())


def test_line_take_action_epsilon_greedy(fly: Fly) -> None:
    """The share of explored actions is epsilon, to four deviations; the others are the policy's."""
    for epsilon in (0.0, 0.3, 1.0):
        settings = {"exploration.start": epsilon, "exploration.end": epsilon, "training.ticks": 300}
        flown = fly({"team.controller": "policy", "training.episodes": 1, **settings})
        steps, explored = 4 * 300, sum(pilot.explored for pilot in flown.pilots)
        assert abs(explored - epsilon * steps) <= 4 * math.sqrt(steps * epsilon * (1 - epsilon))
        assert len(flown.sights) == steps - explored


def test_line_take_action_epsilon_is_annealed_over_the_episodes(fly: Fly) -> None:
    flown = fly({"team.controller": "policy", "training.episodes": 6})
    chosen = [sum(e == episode for e, _, _ in flown.sights) for episode in range(1, 7)]
    assert chosen[0] < chosen[-1]
    assert chosen[-1] > 0.85 * 4 * 37


def test_line_explored_actions_are_uniform_over_the_nine(fly: Fly) -> None:
    settings = {"exploration.start": 1.0, "exploration.end": 1.0, "training.ticks": 500, "training.episodes": 2}
    flown = fly({"team.controller": "policy", **settings})
    actions = np.concatenate([record.actions for record in flown.records])
    expected = actions.size / 9
    assert np.abs(np.bincount(actions, minlength=9) - expected).max() < 4 * math.sqrt(expected)


def test_line_if_t_mod_T_u_send_all_experience_and_start_again(fly: Fly) -> None:  # noqa: N802
    """Every move of every UAV is in exactly one record, with its action and reward."""
    flown = fly()
    moves = [
        (r.episode, r.uav, r.tick - n)
        for r in flown.records
        for n, _ in enumerate(zip(r.actions, r.rewards, r.blocks, strict=True))
    ]
    assert len(moves) == len(set(moves)) == 2 * 4 * 37


def test_line_add_to_D_all_experience_reaches_the_replay_memory(fly: Fly) -> None:  # noqa: N802
    """The tail of the episode too, which `D_i = {}` of the literal algorithm loses."""
    assert len(fly().station.replay) == 2 * 4 * 37


def test_line_sample_a_minibatch_once_a_tick() -> None:
    assert build({}).replay.updates_per_tick == 1.0

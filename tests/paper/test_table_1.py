"""Table I, and the values of Sec. IV-A and IV-B, against the settings of a mission that names none."""

from __future__ import annotations

from typing import Any

import pytest

from tmc.kernel.config import SETTINGS, build, get
from tmc.kernel.policy import view_shape
from tmc.kernel.world import World

TABLE_I = [
    ("Adam optimizer learning rate", "dqn.learning_rate", 0.001),
    ("replay memory size", "replay.capacity", 100_000),
    ("mini-batch size b", "dqn.batch_size", 128),
    ("target network update frequency f", "dqn.target_episodes", 5),
    ("discount factor gamma", "dqn.gamma", 0.99),
    ("filter size of the convolutional layers", "network.kernel", 4),
    ("size of fully-connected layer", "network.dense", 64),
    ("number of training episodes E", "training.episodes", 500),
    ("maximum number of steps per episode T_ep", "training.ticks", 1000),
    ("epsilon-greedy, first", "exploration.start", 0.5),
    ("epsilon-greedy, last", "exploration.end", 0.05),
]
SECTION_4 = [
    ("IV-A: alpha", "world.alpha", 0.01),
    ("IV-A: uniform rates", "world.rates", "uniform"),
    ("IV-A: downtown Toronto", "world.map", "downtown-toronto"),
    ("IV-A: the main roads", "world.roads", "main"),
    ("IV-B: r_s = 1.5 d", "team.sensing_range", 1.5),
    ("IV-B: r^c", "reward.collision", -20.0),
    ("IV-B: r^n", "reward.new_cell", 1.0),
    ("IV-B: lambda", "reward.weight", 5.0),
    ("IV-C: N", "team.size", 3),
]


@pytest.mark.parametrize(("key", "value"), [row[1:] for row in TABLE_I], ids=[row[0] for row in TABLE_I])
def test_table_1_row(key: str, value: Any) -> None:
    assert get(build({}), key) == value
    assert SETTINGS[key].source == "Table I"


@pytest.mark.parametrize(("key", "value"), [row[1:] for row in SECTION_4], ids=[row[0] for row in SECTION_4])
def test_section_4_value(key: str, value: Any) -> None:
    assert get(build({}), key) == value
    assert SETTINGS[key].source.startswith("Sec. IV")


def test_table_1_is_complete() -> None:
    """No other setting claims to come from it."""
    assert {s.key for s in SETTINGS.values() if s.source == "Table I"} == {key for _, key, _ in TABLE_I}


def test_table_1_epsilon_goes_from_a_half_to_a_twentieth() -> None:
    config = build({})
    schedule = [config.epsilon(e) for e in range(1, 501)]
    assert (schedule[0], schedule[-1]) == (0.5, pytest.approx(0.05))
    assert schedule == sorted(schedule, reverse=True)


def test_section_4a_the_area_is_30_by_30_cells_of_60_m() -> None:
    world = World(build({}))
    assert (world.grid.rows, world.grid.cols, world.map.cell_m) == (30, 30, 60.0)
    assert SETTINGS["training.ticks"].unit == "ticks of 60 s"


def test_section_4b_the_input_of_the_network_is_30_by_30_by_3() -> None:
    config = build({})
    assert view_shape(config, World(config).grid) == (3, 30, 30)

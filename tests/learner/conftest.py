"""Fixtures of the learner's tests: the presets, a small mission, and minibatches from addressed draws."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from learner.batching import Batch
from learner.trainer import Trainer
from tmc.kernel.config import Config, build
from tmc.kernel.grid import N_ACTIONS, Grid
from tmc.kernel.policy import view_shape

PATROL: dict[str, Any] = {
    "observation.view": "ego",
    "observation.radius": 8,
    "observation.near": 2,
    "dqn.n_step": 3,
    "dqn.double": True,
    "dqn.loss": "huber",
    "dqn.reward_scale": 0.1,
    "dqn.gamma": 0.95,
    "dqn.target_updates": 1000,
    "dqn.target_episodes": 0,
    "exploration.mask_blocked": True,
}
SMALL: dict[str, Any] = {
    "observation.view": "ego",
    "observation.radius": 4,
    "observation.near": 1,
    "network.channels": (4, 6),
    "network.kernel": 3,
    "network.dense": 8,
}
GRID = Grid(30, 30)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Set torch to one thread, so that sums have one order and test processes do not compete for cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def paper() -> Config:
    return build({})


@pytest.fixture
def patrol() -> Config:
    return build(PATROL)


@pytest.fixture(params=["paper", "patrol"])
def preset(request: pytest.FixtureRequest) -> Config:
    return build({} if request.param == "paper" else PATROL)


@pytest.fixture
def small() -> Callable[..., Config]:
    """Return a config with a tiny network, with dotted keys replaced."""
    return lambda values=None: build({**SMALL, **(values or {})})


@pytest.fixture
def trainer_of() -> Callable[[Config], Trainer]:
    return lambda config: Trainer(config, view_shape(config, GRID), GRID)


@pytest.fixture
def minibatch_of() -> Callable[..., Batch]:
    """Return a minibatch that fits `config`; the same `number` gives the same minibatch."""

    def make(config: Config, number: int = 0, *, b: int = 6, episodes: int = 0, **fields: Any) -> Batch:
        rng = np.random.Generator(np.random.Philox(number))
        images = (b, *view_shape(config, GRID))
        allowed = (rng.random((b, N_ACTIONS)) < 0.6).astype("u1")
        allowed[:, -1] = 1
        values: dict[str, Any] = {
            "episodes": episodes,
            "observation": rng.random(images).astype("<f4"),
            "action": rng.integers(0, N_ACTIONS, b).astype("u1"),
            "reward": rng.normal(0, 5, b).astype("<f4"),
            "next_observation": rng.random(images).astype("<f4"),
            "discount": np.full(b, config.dqn.gamma**config.dqn.n_step, "<f4"),
            "allowed": allowed,
            "index": np.arange(b, dtype="<i8") + 2**20 * number,
        }
        values |= fields
        following = values.pop("next_observation")
        return Batch(**values, next_observation=lambda rows: following[rows])

    return make

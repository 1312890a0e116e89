"""The textbook loop: the update of Algorithm 1 as anybody would write it in torch, and nothing around it.

`overfly bench learner` compares the learner with it, in speed and in results: contiguous tensors, eager mode, torch's
default Adam, everything computed every time. `python -m learner.reference` runs it on one minibatch that
stays in memory.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from learner import dqn, qnet, rounding
from learner.batching import Batch
from learner.trainer import Trainer, copy_due
from tmc.kernel.config import Config, build
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.policy import view_shape
from tmc.kernel.world import World
from tmc.wire import process

WARM = 10
"""Updates before time is taken."""


class ReferenceLearner:
    """theta, theta- and Adam, from the initial weights of the settings; theta- follows as the trainer's does."""

    def __init__(self, config: Config, shape: qnet.Shape) -> None:
        self.config = config
        self.online = qnet.build(config, shape)
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        self.adam = torch.optim.Adam(self.online.parameters(), lr=config.dqn.learning_rate)
        self.updates = self.copied = 0

    def follow(self, episodes: int) -> None:
        """theta- = theta, when so many finished episodes or the updates so far make it due."""
        every = self.config.dqn.target_updates
        if copy_due(episodes, self.copied, self.config.dqn.target_episodes):
            self.copied = episodes
        elif not every or self.updates == 0 or self.updates % every:
            return
        self.target.load_state_dict(self.online.state_dict())

    def update(self, batch: Tensors) -> None:
        """One step of Adam on eq. (9)."""
        d = self.config.dqn
        with torch.no_grad():
            choice = self.online(batch.o_next) if d.double else None
            y = dqn.target(
                batch.reward * d.reward_scale, batch.discount, self.target(batch.o_next), batch.allowed, choice
            )
        loss = dqn.loss(dqn.td_error(self.online(batch.o), batch.action, y), d.loss)
        self.adam.zero_grad()
        torch.autograd.backward(loss)
        self.adam.step()
        self.updates += 1


class Tensors:
    """A minibatch as tensors."""

    def __init__(self, batch: Batch) -> None:
        self.o, self.o_next = (
            torch.tensor(batch.observation),
            torch.tensor(batch.next_observation(np.arange(len(batch.action)))),
        )
        self.action, self.allowed = torch.tensor(batch.action).long(), torch.tensor(batch.allowed)
        self.reward, self.discount = torch.tensor(batch.reward), torch.tensor(batch.discount)


def resident(config: Config, shape: qnet.Shape) -> Batch:
    """A minibatch of noise, for timing: what is in it does not change what is computed."""
    rng, b = np.random.Generator(np.random.Philox(1)), config.dqn.batch_size
    o, o_next = (rng.random((b, *shape), np.float32) for _ in range(2))
    action, reward = rng.integers(0, N_ACTIONS, b).astype("u1"), rng.random(b, np.float32)
    discount, allowed = np.full(b, config.dqn.gamma, "<f4"), np.ones((b, N_ACTIONS), "u1")
    return Batch(0, o, lambda rows: o_next[rows], action, reward, discount, allowed, np.arange(b))


def rate(config: Config, seconds: float) -> float:
    """Updates a second of the textbook loop, on as many threads as the settings say."""
    torch.set_num_threads(config.training.threads)
    shape = view_shape(config, World(config).grid)
    bare, batch = ReferenceLearner(config, shape), Tensors(resident(config, shape))
    for _ in range(WARM):
        bare.update(batch)
    start = time.perf_counter()
    while time.perf_counter() < start + seconds:
        bare.update(batch)
    return (bare.updates - WARM) / (time.perf_counter() - start)


@dataclass(frozen=True)
class Departures:
    """How far gradients of float32 are from the exact ones: the largest of all updates.

    `learner`, `textbook`: the trainer's and the textbook loop's, relative to the gradient's length. `of_bound`: the
    trainer's, in any one weight, relative to the most that rounding can do there (`learner.rounding`). Above 1, the
    trainer computes something else.
    """

    learner: float
    textbook: float
    of_bound: float


def departures(config: Config, batches: Iterable[Batch]) -> Departures:
    """Compare the trainer's gradient of each update with the exact one, and the textbook loop's with that too.

    Before each update the textbook loop gets the trainer's theta, and the exact gradient is taken there; theta- follows
    by itself. Left alone, two loops drift apart by rounding that every step enlarges, and a mistake would hide in that.
    """
    torch.set_num_threads(1)  # as `trainer.start` does
    grid = World(config).grid
    shape = view_shape(config, grid)
    trainer, bare = Trainer(config, shape, grid), ReferenceLearner(config, shape)
    found = [torch.zeros(3, dtype=torch.float64)]
    for batch in batches:
        bare.online.load_state_dict(trainer.online.state_dict())
        bare.follow(batch.episodes)
        exact, bound = rounding.gradient(config, bare.online, bare.target, batch)
        bare.update(Tensors(batch))
        trainer.update(batch)
        mine, plain = (gradient(net).double() - exact for net in (trainer.online, bare.online))
        length = exact.norm().clamp_min(torch.finfo(torch.float32).tiny)
        found.append(torch.stack((mine.norm() / length, plain.norm() / length, (mine.abs() / bound).max())))
    return Departures(*torch.stack(found).amax(0).tolist())  # NaN stays NaN


def gradient(net: qnet.QNet) -> torch.Tensor:
    """Of the last update, over all weights."""
    return torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])


def main(argv: list[str] | None = None) -> int:
    """Print the updates a second."""
    parser = argparse.ArgumentParser("learner.reference", description=__doc__, allow_abbrev=False)
    parser.add_argument("--config", type=Path, required=True, help="settings as JSON, dotted keys")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--parent", type=int, default=0, help="process to die with")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    print(rate(build(json.loads(a.config.read_text("utf-8"))), a.seconds))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The textbook loop: the update of Algorithm 1 in plain torch, without anything around it. Read this first.

It uses contiguous tensors, eager mode and torch's default Adam, and computes everything every time. `overfly bench
learner` compares the learner with it, in speed and in results. `python -m learner.reference` runs it on one minibatch
that stays in memory.
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

WARM_UP_UPDATES = 10
"""Updates before the measurement starts."""


class ReferenceLearner:
    """Holds theta, theta- and Adam, from the initial weights of the settings; theta- is copied as in the trainer."""

    def __init__(self, config: Config, shape: qnet.Shape) -> None:
        self.config = config
        self.online = qnet.build(config, shape)
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        self.adam = torch.optim.Adam(self.online.parameters(), lr=config.dqn.learning_rate)
        self.updates = self.copied = 0

    def follow(self, episodes: int) -> None:
        """Copy theta to theta-, if the number of finished episodes or of updates makes it due."""
        every = self.config.dqn.target_updates
        if copy_due(episodes, self.copied, self.config.dqn.target_episodes):
            self.copied = episodes
        elif not every or self.updates == 0 or self.updates % every:
            return
        self.target.load_state_dict(self.online.state_dict())

    def update(self, batch: Tensors) -> None:
        """Make one step of Adam on eq. (9)."""
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
    """Return a minibatch of noise, for timing: its values do not change the amount of work."""
    rng, b = np.random.Generator(np.random.Philox(1)), config.dqn.batch_size
    o, o_next = (rng.random((b, *shape), np.float32) for _ in range(2))
    action, reward = rng.integers(0, N_ACTIONS, b).astype("u1"), rng.random(b, np.float32)
    discount, allowed = np.full(b, config.dqn.gamma, "<f4"), np.ones((b, N_ACTIONS), "u1")
    return Batch(0, o, lambda rows: o_next[rows], action, reward, discount, allowed, np.arange(b))


def rate(config: Config, seconds: float) -> float:
    """Measure the updates per second of the textbook loop over `seconds`, on `training.threads` threads."""
    torch.set_num_threads(config.training.threads)
    shape = view_shape(config, World(config).grid)
    reference, batch = ReferenceLearner(config, shape), Tensors(resident(config, shape))
    for _ in range(WARM_UP_UPDATES):
        reference.update(batch)
    start = time.perf_counter()
    while time.perf_counter() < start + seconds:
        reference.update(batch)
    return (reference.updates - WARM_UP_UPDATES) / (time.perf_counter() - start)


@dataclass(frozen=True)
class Departures:
    """The largest errors, over all updates, of float32 gradients against exact ones.

    `learner`, `textbook`: of the trainer and of the textbook loop, relative to the gradient's length. `of_bound`: of
    the trainer in any one weight, relative to the bound of rounding errors there (`learner.rounding`). Above 1, the
    trainer computes something else than eq. (9).
    """

    learner: float
    textbook: float
    of_bound: float


def departures(config: Config, batches: Iterable[Batch]) -> Departures:
    """Compare the gradients of the trainer and of the textbook loop with the exact one, at each update.

    Before each update the textbook loop gets the trainer's theta, and the exact gradient is computed there; theta- is
    copied by its own schedule. Two independent loops would drift apart by rounding, and a mistake would hide in that.
    """
    torch.set_num_threads(1)  # as `trainer.start` does
    grid = World(config).grid
    shape = view_shape(config, grid)
    trainer, reference = Trainer(config, shape, grid), ReferenceLearner(config, shape)
    found = [torch.zeros(3, dtype=torch.float64)]
    for batch in batches:
        reference.online.load_state_dict(trainer.online.state_dict())
        reference.follow(batch.episodes)
        exact, bound = rounding.gradient(config, reference.online, reference.target, batch)
        reference.update(Tensors(batch))
        trainer.update(batch)
        tuned, plain = (gradient(net).double() - exact for net in (trainer.online, reference.online))
        length = exact.norm().clamp_min(torch.finfo(torch.float32).tiny)
        found.append(torch.stack((tuned.norm() / length, plain.norm() / length, (tuned.abs() / bound).max())))
    return Departures(*torch.stack(found).amax(0).tolist())  # NaN stays NaN


def gradient(net: qnet.QNet) -> torch.Tensor:
    """Return the gradient of the last update, over all weights, in one row."""
    return torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])


def main(argv: list[str] | None = None) -> int:
    """Print the updates per second."""
    parser = argparse.ArgumentParser("learner.reference", description=__doc__, allow_abbrev=False)
    parser.add_argument("--config", type=Path, required=True, help="settings as JSON, dotted keys")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    print(rate(build(json.loads(a.config.read_text("utf-8"))), a.seconds))
    return 0


if __name__ == "__main__":
    sys.exit(main())

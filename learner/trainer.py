"""The learner's core: theta, theta-, Adam, and the update of Algorithm 1. It has no sockets and no clock.

Only the initial weights are random: the same minibatches in the same order give the same weights.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner import dqn, qnet
from learner.adam import Adam
from learner.batching import Batch, TrainingError, as_channels_last, check
from learner.export import to_onnx
from learner.gradient import Gradient
from learner.qnet import QNet, Shape
from learner.target_cache import TargetValueCache
from tmc.kernel.config import Config
from tmc.kernel.grid import Grid
from tmc.kernel.observation import Floats, Ints
from tmc.kernel.policy import card_for, view_shape

NO_ERRORS = np.zeros(0, np.int64), np.zeros(0, np.float32)
"""No transitions, no errors."""
MAX_LOSS = 1e30
"""A loss or a mean of Q from here on means that the training diverges."""


@dataclass(frozen=True)
class UpdateMetrics:
    """What update number `updates` did. Means over the minibatch, in scaled reward, the network's unit.

    `loss`: eq. (9), weighted where the minibatch says so. `q_mean`: Q(o, a; theta). `target_mean`: y of eq. (8).
    `td_abs`: |Q - y|. `grad_norm`: Euclidean, over all weights.
    """

    updates: int
    loss: float
    q_mean: float
    target_mean: float
    td_abs: float
    grad_norm: float


@dataclass(frozen=True)
class State:
    """All state of a trainer, without settings. `copied`: finished episodes at the last copy that they made due."""

    tensors: dict[str, Tensor]
    updates: int
    version: int
    copied: int


class Trainer:
    """Learns Q from minibatches. Not thread-safe; runs on as many threads as torch is set to.

    Raises ConfigError for a view too small for the network, ValueError for a `shape` that the settings do not have.
    """

    def __init__(self, config: Config, shape: Shape, grid: Grid) -> None:
        if shape != view_shape(config, grid):
            raise ValueError(f"observations of shape {shape} do not fit these settings: {view_shape(config, grid)}")
        self.config, self.shape, self.grid = config, shape, grid
        self.updates = self.version = self.copied = 0
        # Channels last, the fastest layout for torch's CPU convolutions.
        self.online = channels_last(qnet.build(config, shape))
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        self.adam = Adam(self.online.parameters(), config.dqn.learning_rate)
        self._gradient = Gradient(self.online, config)
        self._cache = TargetValueCache(config.replay.capacity)
        self._td_errors = NO_ERRORS

    def update(self, batch: Batch) -> UpdateMetrics:
        """Make one step of Adam on eq. (9), and copy theta to theta- when that is due. Raises TrainingError."""
        check(batch, self.shape)
        self._follow(batch.episodes)
        values, rest = self._cached_values(batch)
        o, action = as_channels_last(batch.observation), torch.tensor(batch.action, dtype=torch.int64)
        weight = torch.tensor(batch.weight) if batch.weight.size else None
        passes = rest.size * (2 if self.config.dqn.double else 1)
        gradient, q, y, loss = self._gradient(o, action, lambda: self._target(batch, values, rest), weight, passes)
        metrics = self._step(gradient, q, loss, y)
        if self.config.replay.priority_exponent:
            self._td_errors = batch.index, (q - y).abs().numpy()
        every = self.config.dqn.target_updates
        if every and self.updates % every == 0:
            self._copy()
        return metrics

    def _cached_values(self, batch: Batch) -> tuple[Floats, Ints]:
        """Return max_a' Q(o', a'; theta-) of each transition (B,) if it is cached, and the rows where it is not."""
        values, cached = self._cache.look_up(batch.index)
        return values, np.flatnonzero(~cached)

    @torch.no_grad()
    def _target(self, batch: Batch, values: Floats, rest: Ints) -> Tensor:
        """Return y of eq. (8), (B,), with scaled rewards; `values` (B,) of o' are known except in the rows `rest`."""
        if rest.size:
            o_next, allowed = as_channels_last(batch.next_observation(rest)), torch.tensor(batch.allowed[rest])
            choice = self.online(o_next) if self.config.dqn.double else None
            values[rest] = dqn.value(self.target(o_next), allowed, choice).numpy()
            if choice is None:  # a value that theta has chosen changes with every update
                self._cache.keep(batch.index[rest], values[rest])
        reward = torch.tensor(batch.reward) * self.config.dqn.reward_scale
        return dqn.bootstrap(reward, torch.tensor(batch.discount), torch.from_numpy(values))

    def take_td_errors(self) -> tuple[NDArray[np.int64], Floats]:
        """Return, once, the numbers of the transitions of the last update and |Q - y| of each. Shapes (B,), or empty.

        They give the new priorities (Schaul et al. 2016, Algorithm 1). Empty if `replay.priority_exponent` is 0.
        """
        errors, self._td_errors = self._td_errors, NO_ERRORS
        return errors

    def forget(self) -> None:
        """Forget all target values and errors, because the numbers of transitions start again."""
        self._cache.forget()
        self._td_errors = NO_ERRORS

    def _step(self, gradient: list[Tensor], q: Tensor, loss: Tensor, y: Tensor) -> UpdateMetrics:
        """Make a step of Adam down the gradient of `loss`. `q` (B,): Q(o, a; theta). `y` (B,). Raises TrainingError."""
        for p, g in zip(self.online.parameters(), gradient, strict=True):
            p.grad = g
        means = (loss, q.mean(), y.mean(), (q - y).abs().mean(), torch.linalg.vector_norm(flat(gradient)))
        values = torch.stack(means).tolist()
        if not all(abs(value) < MAX_LOSS for value in values):  # true for NaN as well
            raise TrainingError(
                f"update {self.updates + 1} diverged (loss {values[0]:g}): lower dqn.learning_rate or dqn.reward_scale"
            )
        self.adam.step()
        self.updates += 1
        return UpdateMetrics(self.updates, *values)

    def _follow(self, episodes: int) -> None:
        """Apply Algorithm 1's "if episode mod f = 0" before the first update after that episode.

        A count that went back belongs to a new run that resumes from an old checkpoint; it counts from there.
        """
        if copy_due(episodes, self.copied, self.config.dqn.target_episodes):
            self._copy()
            self.copied = episodes
        self.copied = min(self.copied, episodes)

    def _copy(self) -> None:
        """Copy theta to theta-."""
        self.target.load_state_dict(self.online.state_dict())
        self._cache.forget()

    def policy(self) -> tuple[int, bytes]:
        """Return (version, policy file of theta); the version is higher than any before."""
        self.version += 1
        return self.version, to_onnx(self.online, card_for(self.config, self.grid, self.version, self.updates))

    def _tensors(self) -> dict[str, Tensor]:
        """Return the live tensors by name: online.*, target.*, and adam.* with Adam's step and moments by weight."""
        found = {f"online.{name}": p.detach() for name, p in self.online.named_parameters()}
        found |= {f"target.{name}": p for name, p in self.target.named_parameters()}
        for name, p in self.online.named_parameters():
            found |= {f"adam.{name}.{key}": value for key, value in self.adam.state[p].items()}
        return found

    def state(self) -> State:
        """Return a copy of all state, each tensor contiguous."""
        tensors = {k: t.clone(memory_format=torch.contiguous_format) for k, t in self._tensors().items()}
        return State(tensors, self.updates, self.version, self.copied)

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Take over the state of another trainer: the same minibatches then give the same weights.

        They are equal bit by bit if no minibatch has a transition whose value that trainer had cached; otherwise they
        are equal within rounding. Raises ValueError, and changes nothing, if the state is of another network.
        """
        tensors = self._tensors()
        if layout(tensors) != layout(state.tensors):
            raise ValueError("the state belongs to another network")
        for name, tensor in tensors.items():  # in place: the fused Adam wants moments laid out as the weights are
            tensor.copy_(state.tensors[name])
        self.updates, self.version, self.copied = state.updates, state.version, state.copied
        self.forget()


def copy_due(finished: int, copied: int, f: int) -> bool:
    """Return whether `finished` episodes have reached a multiple of f since `copied`, the count at the last copy."""
    return f > 0 and finished // f > copied // f


def start(config: Config, grid: Grid) -> Trainer:
    """Return a trainer for these settings."""
    torch.set_num_threads(1)  # `Gradient` has threads of its own
    return Trainer(config, view_shape(config, grid), grid)


def channels_last(net: QNet) -> QNet:
    """Lay out the filters of a network with the channels last; return the network."""
    for p in net.convs.parameters():
        if p.dim() == 4:
            p.data = p.data.contiguous(memory_format=torch.channels_last)
    return net


def flat(gradient: list[Tensor]) -> Tensor:
    """Return all of a gradient in one row."""
    return torch.cat([g.flatten() for g in gradient])


def layout(tensors: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor, by name."""
    return {name: tuple(t.shape) for name, t in tensors.items()}

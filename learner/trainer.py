"""The learner's core: theta, theta-, Adam, and the update of Algorithm 1. No sockets, no clock, no random draws.

The only randomness is that of the initial weights; the same minibatches in the same order give the same weights.
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
MAX_LOSS = 1e30
"""No loss and no value of Q is that large, unless the training diverges."""


@dataclass(frozen=True)
class UpdateMetrics:
    """What update number `updates` did. Means over the minibatch; values in scaled reward, as the network has them.

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
    """All of a trainer but its settings. `copied`: episodes finished at the last copy that their count made due."""

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
        # Channels last, as the convolutions of torch's CPU kernels like it.
        self.online = channels_last(qnet.build(config, shape))
        self.target = copy.deepcopy(self.online).requires_grad_(False)
        self.adam = Adam(self.online.parameters(), config.dqn.learning_rate)
        self._gradient = Gradient(self.online, config)
        self._known = TargetValueCache(config.replay.capacity)
        self._judged = NO_ERRORS

    def update(self, batch: Batch) -> UpdateMetrics:
        """One step of Adam on eq. (9), and theta- = theta when that is due. Raises TrainingError."""
        check(batch, self.shape)
        self._follow(batch.episodes)
        values, rest = self._known_values(batch)
        o, action = as_channels_last(batch.observation), torch.tensor(batch.action, dtype=torch.int64)
        weight = torch.tensor(batch.weight) if batch.weight.size else None
        passes = rest.size * (2 if self.config.dqn.double else 1)
        gradient, q, y, loss = self._gradient(o, action, lambda: self._target(batch, values, rest), weight, passes)
        metrics = self._step(gradient, q, loss, y)
        if self.config.replay.priority_exponent:
            self._judged = batch.index, (q - y).abs().numpy()
        every = self.config.dqn.target_updates
        if every and self.updates % every == 0:
            self._copy()
        return metrics

    def _known_values(self, batch: Batch) -> tuple[Floats, Ints]:
        """max_a' Q(o', a'; theta-) of each transition (B,), as far as it is known; and the rows where it is not."""
        values, known = self._known.look_up(batch.index)
        return values, np.flatnonzero(~known)

    @torch.no_grad()
    def _target(self, batch: Batch, values: Floats, rest: Ints) -> Tensor:
        """y of eq. (8), of scaled rewards, as `dqn.target`; `values` (B,) are those of o', but for the rows `rest`."""
        if rest.size:
            o_next, allowed = as_channels_last(batch.next_observation(rest)), torch.tensor(batch.allowed[rest])
            choice = self.online(o_next) if self.config.dqn.double else None
            values[rest] = dqn.value(self.target(o_next), allowed, choice).numpy()
            if choice is None:  # a value that theta has chosen changes with every update
                self._known.keep(batch.index[rest], values[rest])
        reward = torch.tensor(batch.reward) * self.config.dqn.reward_scale
        return dqn.bootstrap(reward, torch.tensor(batch.discount), torch.from_numpy(values))

    def take_td_errors(self) -> tuple[NDArray[np.int64], Floats]:
        """The transitions of the last update, by number, and |Q - y| of each; told once. Shapes (B,), or empty.

        Their new priorities (Schaul et al. 2016, Algorithm 1): nothing where `replay.priority_exponent` is 0.
        """
        judged, self._judged = self._judged, NO_ERRORS
        return judged

    def forget(self) -> None:
        """The numbers of transitions begin anew: what was known of them is of others."""
        self._known.forget()
        self._judged = NO_ERRORS

    def _step(self, gradient: list[Tensor], q: Tensor, loss: Tensor, y: Tensor) -> UpdateMetrics:
        """A step of Adam down the gradient of `loss`; `q` (B,) = Q(o, a; theta), `y` (B,)."""
        for p, g in zip(self.online.parameters(), gradient, strict=True):
            p.grad = g
        means = (loss, q.mean(), y.mean(), (q - y).abs().mean(), torch.linalg.vector_norm(flat(gradient)))
        values = torch.stack(means).tolist()
        if not all(abs(value) < MAX_LOSS for value in values):  # which is not so for NaN either
            raise TrainingError(
                f"update {self.updates + 1} diverged (loss {values[0]:g}): lower dqn.learning_rate or dqn.reward_scale"
            )
        self.adam.step()
        self.updates += 1
        return UpdateMetrics(self.updates, *values)

    def _follow(self, episodes: int) -> None:
        """Algorithm 1's "if episode mod f = 0", before the first update that comes after that episode.

        A count that went back belongs to a new run which goes on from an old checkpoint: count from there.
        """
        if copy_due(episodes, self.copied, self.config.dqn.target_episodes):
            self._copy()
            self.copied = episodes
        self.copied = min(self.copied, episodes)

    def _copy(self) -> None:
        """theta- = theta."""
        self.target.load_state_dict(self.online.state_dict())
        self._known.forget()

    def policy(self) -> tuple[int, bytes]:
        """A policy file of theta, with a version newer than any before."""
        self.version += 1
        return self.version, to_onnx(self.online, card_for(self.config, self.grid, self.version, self.updates))

    def _tensors(self) -> dict[str, Tensor]:
        """The live tensors by name: online.*, target.*, and adam.* with Adam's step and moments of each weight."""
        found = {f"online.{name}": p.detach() for name, p in self.online.named_parameters()}
        found |= {f"target.{name}": p for name, p in self.target.named_parameters()}
        for name, p in self.online.named_parameters():
            found |= {f"adam.{name}.{key}": value for key, value in self.adam.state[p].items()}
        return found

    def state(self) -> State:
        """A copy of all state, each tensor contiguous."""
        tensors = {k: t.clone(memory_format=torch.contiguous_format) for k, t in self._tensors().items()}
        return State(tensors, self.updates, self.version, self.copied)

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Become the trainer that gave `state`: the same minibatches then give the same weights.

        Bit for bit, where they hold no transition that the other trainer still knew the value of; else within rounding.

        Raises ValueError, and changes nothing, when the state is of another network.
        """
        mine = self._tensors()
        if layout(mine) != layout(state.tensors):
            raise ValueError("the state belongs to another network")
        for name, tensor in mine.items():  # in place: the fused Adam wants moments laid out as the weights are
            tensor.copy_(state.tensors[name])
        self.updates, self.version, self.copied = state.updates, state.version, state.copied
        self.forget()


def copy_due(finished: int, copied: int, f: int) -> bool:
    """True when `finished` episodes have reached a multiple of f that `copied`, the count at the last copy, had not."""
    return f > 0 and finished // f > copied // f


def start(config: Config, grid: Grid) -> Trainer:
    """A trainer on as many threads as the settings say."""
    torch.set_num_threads(1)  # `Gradient` has threads of its own
    return Trainer(config, view_shape(config, grid), grid)


def channels_last(net: QNet) -> QNet:
    """The same network, its filters laid out in memory with the channels last."""
    for p in net.convs.parameters():
        if p.dim() == 4:
            p.data = p.data.contiguous(memory_format=torch.channels_last)
    return net


def flat(gradient: list[Tensor]) -> Tensor:
    """All of a gradient in one row."""
    return torch.cat([g.flatten() for g in gradient])


def layout(tensors: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Shape by name."""
    return {name: tuple(t.shape) for name, t in tensors.items()}

"""Turns a minibatch message into a batch: checks it, and draws its observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.qnet import Shape
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import Floats, Ints, ObservationBuilder, Views
from tmc.wire.messages import Minibatch


class TrainingError(ValueError):
    """An update that cannot be made: one sentence with the fix. It leaves theta and Adam as they were."""


@dataclass(frozen=True)
class Batch:
    """A minibatch with images. `observation`: o_t (b, C, H, W). `next_observation(rows)`: o_{t+n} of these rows.

    Both may lie in memory that the next batch overwrites. The other fields are those of `Minibatch`.
    """

    episodes: int
    observation: Floats
    next_observation: Callable[[Ints], Floats]
    action: NDArray[np.uint8]
    reward: Floats
    discount: Floats
    allowed: NDArray[np.uint8]
    index: NDArray[np.int64]
    weight: Floats = field(default_factory=lambda: np.zeros(0, np.float32))


class BatchBuilder:
    """Draws the observations of minibatches into the same memory each time, channels last for the convolutions."""

    def __init__(self, observer: ObservationBuilder) -> None:
        self.observer = observer
        channels, height, width = observer.shape
        self._sides, self._channels = (height, width), channels
        self._now = self._next = np.empty((0, *observer.shape), np.float32)

    def build(self, minibatch: Minibatch) -> Batch:
        """Return the batch; the previous one must not be used any more. Raises TrainingError if it cannot be drawn."""
        views, b = self._views(minibatch), len(minibatch.action)
        if len(self._now) != b:
            self._now, self._next = self._memory(b), self._memory(b)

        def following(rows: Ints) -> Floats:
            return self.observer.observe_batch(views.rows(b + rows), self._next[: rows.size])

        now = self.observer.observe_batch(views.rows(slice(b)), self._now)
        m = minibatch
        return Batch(m.episodes, now, following, m.action, m.reward, m.discount, m.allowed, m.index, m.weight)

    def _memory(self, b: int) -> Floats:
        """Return an array of shape (b, C, H, W) whose memory is (b, H, W, C)."""
        return np.empty((b, *self._sides, self._channels), np.float32).transpose(0, 3, 1, 2)

    def _views(self, minibatch: Minibatch) -> Views:
        """Return what the 2 b observations show. Raises TrainingError for shapes or cells that do not fit."""
        m, b, K = minibatch, len(minibatch.action), self.observer.grid.size
        if not b or m.cells.shape != (2 * b,) or m.peers.shape[0] != 2 * b or m.u.shape != (2 * b, self.observer.R):
            raise TrainingError(
                f"the minibatch has maps of shape {m.u.shape}, this mission needs ({2 * b}, {self.observer.R}): "
                "start the learner with the settings of the TMC"
            )
        if int(m.cells.max()) >= K or int(m.peers.max(initial=0)) > K:
            raise TrainingError(f"the minibatch has a UAV outside the grid of {K} cells")
        return Views(m.cells, m.peers, m.u)


def as_channels_last(images: Floats) -> Tensor:
    """Return (B, C, H, W) float32, channels last; in the same memory if that is its layout already."""
    return torch.from_numpy(images).contiguous(memory_format=torch.channels_last)


def check(batch: Batch, shape: Shape) -> None:
    """Raise TrainingError unless the fields of the batch fit together and fit the network."""
    b = len(batch.action)
    if batch.observation.shape != (b, *shape) or not b:
        raise TrainingError(
            f"the minibatch has observations of shape {batch.observation.shape}, the network needs {(b, *shape)}: "
            "start the learner with the settings of the TMC"
        )
    if any(r.shape != (b,) for r in (batch.reward, batch.discount)) or batch.allowed.shape != (b, N_ACTIONS):
        raise TrainingError(f"the minibatch's fields differ in length: each must have {b} rows")
    if batch.index.shape != (b,) or int(batch.index.min()) < 0:
        raise TrainingError(f"the minibatch's transitions are not numbered: `index` must have {b} numbers from 0 on")
    if batch.weight.shape not in ((b,), (0,)):
        raise TrainingError(f"the minibatch has {batch.weight.size} weights: it must have {b}, or none")
    if int(batch.action.max()) >= N_ACTIONS:
        raise TrainingError(f"the minibatch has an action {batch.action.max()}: a UAV has {N_ACTIONS}")
    if not batch.allowed.any(axis=1).all():
        raise TrainingError("the minibatch has a state with no allowed action: staying is always allowed")

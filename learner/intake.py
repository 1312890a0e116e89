"""What the learner takes in: a minibatch off the wire, checked, as tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from learner.qnet import Shape
from tmc.kernel.grid import N_ACTIONS
from tmc.wire.messages import Array, Minibatch


class TrainingError(ValueError):
    """An update that cannot be made: one sentence with the mend. It leaves theta and Adam as they were."""


def images(observation: Array) -> Tensor:
    """(B, C, H, W) float32 as the convolutions like it; copied, since an array off the wire is read-only."""
    return torch.tensor(observation).contiguous(memory_format=torch.channels_last)


def check(minibatch: Minibatch, shape: Shape) -> None:
    """Raise TrainingError unless the fields of the minibatch fit together and fit the network."""
    b = len(minibatch.action)
    images_, rows = (b, *shape), (minibatch.reward, minibatch.discount)
    if minibatch.observation.shape != images_ or minibatch.next_observation.shape != images_ or not b:
        raise TrainingError(
            f"the minibatch has observations of shape {minibatch.observation.shape}, the network needs {images_}: "
            "start the learner with the settings of the TMC"
        )
    if any(r.shape != (b,) for r in rows) or minibatch.allowed.shape != (b, N_ACTIONS):
        raise TrainingError(f"the minibatch's fields differ in length: each must have {b} rows")
    if minibatch.index.shape != (b,) or int(minibatch.index.min()) < 0:
        raise TrainingError(f"the minibatch's transitions are not numbered: `index` must have {b} numbers from 0 on")
    if int(minibatch.action.max()) >= N_ACTIONS:
        raise TrainingError(f"the minibatch has an action {minibatch.action.max()}: a UAV has {N_ACTIONS}")
    if not minibatch.allowed.any(axis=1).all():
        raise TrainingError("the minibatch has a state with no allowed action: staying is always allowed")

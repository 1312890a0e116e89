"""The equations of deep Q-learning, eqs. (8) and (9), as pure functions of tensors.

B is the size of the minibatch; all values and rewards are in scaled reward, the unit that the network speaks.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import huber_loss


def target(reward: Tensor, discount: Tensor, q_next: Tensor, allowed: Tensor, q_choice: Tensor | None = None) -> Tensor:
    """Return y = r + gamma^n max_a' Q(o', a'; theta-), eq. (8). Shape (B,), no gradient.

    `reward` (B,): r_{t+1} + gamma r_{t+2} + ... over n ticks. `discount` (B,): gamma^n; the paper has n = 1. The other
    arguments are those of `value`.

    There is no terminal term: an episode ends by a time limit, which is not a state of the world, so y always
    bootstraps.
    """
    return bootstrap(reward, discount, value(q_next, allowed, q_choice)).detach()


def bootstrap(reward: Tensor, discount: Tensor, next_value: Tensor) -> Tensor:
    """Return y of eq. (8) for a known value of o': r + gamma^n `next_value`. All of shape (B,)."""
    return reward + discount * next_value


def value(q_next: Tensor, allowed: Tensor, q_choice: Tensor | None = None) -> Tensor:
    """Return max_a' Q(o', a'; theta-), the value of o'. Shape (B,).

    `q_next` (B, 9): Q(o_{t+n}, . ; theta-). `allowed` (B, 9): zero for the actions that the max leaves out.
    With `q_choice` (B, 9) = Q(o_{t+n}, . ; theta), a' is the best by that instead: double Q-learning, not in the paper.
    """
    return of(q_next, permitted(q_next if q_choice is None else q_choice, allowed).argmax(dim=1))


def permitted(q: Tensor, allowed: Tensor) -> Tensor:
    """Return `q` with minus infinity where `allowed` is zero, so that no maximum is there. Shape (B, 9)."""
    return q.masked_fill(allowed == 0, -torch.inf)


def of(q: Tensor, action: Tensor) -> Tensor:
    """Return Q(o, a), the value of each row's action. `q` (B, 9), `action` (B,) int64; shape (B,)."""
    return q.gather(1, action.unsqueeze(1)).squeeze(1)


def td_error(q: Tensor, action: Tensor, y: Tensor) -> Tensor:
    """Return Q(o_t, a_t; theta) - y_t, the error inside eq. (9). Shape (B,)."""
    return of(q, action) - y


def loss(td: Tensor, kind: Literal["mse", "huber"] = "mse", weight: Tensor | None = None) -> Tensor:
    """Return the mean squared error over the minibatch, eq. (9); or (ours) Huber: td^2 / 2, linear beyond |td| = 1.

    `weight` (B,): of each transition (ours, `replay.priority_exponent`). The paper has no weights: all count equally.
    """
    if weight is not None:
        each = huber_loss(td, torch.zeros_like(td), reduction="none") if kind == "huber" else td.square()
        return (weight * each).mean()
    if kind == "huber":
        return huber_loss(td, torch.zeros_like(td), delta=1.0)
    return td.square().mean()

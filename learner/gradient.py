"""The gradient of eq. (9) over a minibatch: each thread computes a share of the rows, and the results are added.

torch's own threads share each operation instead, and wait for the slowest some thirty times per update: on cores that
TMC and UAVs also need, that wait is long. Shares wait once. The other threads start with Q(o, a; theta), which needs no
targets, while the first thread computes the targets; so the first thread's share is smaller.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

import torch
from torch import Tensor

from learner import dqn
from learner.qnet import QNet
from tmc.kernel.config import Config

Share = tuple[list[Tensor], Tensor, Tensor]
"""(gradient by weight, Q(o, a; theta) of the rows, loss) of a share."""
GRADIENT_PASSES = 3.0
"""Cost of a gradient, in forward passes of as many observations."""
SHARE_STEP_ROWS = 8
"""Shares are multiples of this where possible, because torch prepares a convolution for each new number of images."""


class Gradient:
    """Computes gradients of the loss of `net` on `training.threads` threads, which end with this object."""

    def __init__(self, net: QNet, config: Config) -> None:
        self.net, self.loss, self.threads = net, config.dqn.loss, config.training.threads
        self._weights = list(net.parameters())
        self._helpers = ThreadPoolExecutor(max(1, self.threads - 1), "gradient", torch.set_num_threads, (1,))

    def __call__(
        self, o: Tensor, action: Tensor, target: Callable[[], Tensor], weight: Tensor | None = None, passes: int = 0
    ) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """Return (gradient by weight, Q(o, a; theta) (B,), y (B,), loss ()); `target` computes y.

        `weight` (B,): as in `dqn.loss`. `passes`: forward passes of an observation that `target` takes. The shares
        depend on `passes` and B alone, so the same minibatches give the same weights at any pace of the threads.
        """
        b, targets = len(action), Future[Tensor]()
        cuts = shares(b, min(self.threads, b), passes)
        of = [(o[i:j], action[i:j], targets, slice(i, j), weight, b) for i, j in pairwise(cuts)]
        waiting = [self._helpers.submit(self._share, *part) for part in of[1:]]
        try:
            targets.set_result(target())
        except BaseException as error:
            targets.set_exception(error)  # otherwise the helpers would wait for ever
            raise
        found = [self._share(*of[0])] if cuts[1] else []
        gradients, q, losses = zip(*found, *(w.result() for w in waiting), strict=True)
        total = gradients[0]
        for others in gradients[1:]:
            torch._foreach_add_(total, others)
        return total, torch.cat(q), targets.result(), torch.stack(losses).sum()

    def _share(
        self, o: Tensor, action: Tensor, targets: Future[Tensor], rows: slice, weight: Tensor | None, b: int
    ) -> Share:
        """Return the part of these transitions, the `rows` of a minibatch of `b`."""
        q, y = self.net(o), targets.result()[rows]
        td = dqn.td_error(q, action, y)
        loss = dqn.loss(td, self.loss, None if weight is None else weight[rows]) * (len(y) / b)
        gradient = torch.autograd.grad(loss, self._weights)
        return list(gradient), dqn.of(q.detach(), action), loss.detach()


def shares(b: int, threads: int, passes: int) -> list[int]:
    """Return where each thread's rows of `b` begin, and where the last one's end; `threads` is at most b.

    The first thread does `passes` forward passes before its own rows. All threads get as equal work as possible, so the
    first may get no rows at all.
    """
    if threads == 1:
        return [0, b]
    first = max(0.0, ((GRADIENT_PASSES * b + passes) / threads - passes) / GRADIENT_PASSES)
    step = SHARE_STEP_ROWS
    first = round(first / step) * step if b >= threads * step else b // threads
    return [0, *(first + (b - first) * k // (threads - 1) for k in range(threads))]

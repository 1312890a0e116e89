"""The gradient of eq. (9) over a minibatch: a share of the minibatch on each thread, and the sum of what they find.

torch's own threads share each operation instead, and all of them wait for the slowest some thirty times an update: on
cores that TMC and UAVs need as well, that wait is long. Shares meet once. Those of the other threads begin with
Q(o, a; theta), which needs no targets, while the first thread computes these; so its own share is the smaller one.
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
PASSES = 3.0
"""What a gradient costs, in forward passes of as many observations."""
STEP = 8
"""Shares are multiples of this, as far as may be: torch prepares a convolution anew for each number of images."""


class Gradient:
    """Of the loss of `net`, on `training.threads` threads; they end with this object."""

    def __init__(self, net: QNet, config: Config) -> None:
        self.net, self.loss, self.threads = net, config.dqn.loss, config.training.threads
        self._weights = list(net.parameters())
        self._helpers = ThreadPoolExecutor(max(1, self.threads - 1), "gradient", torch.set_num_threads, (1,))

    def __call__(
        self, o: Tensor, action: Tensor, target: Callable[[], Tensor], weight: Tensor | None = None, passes: int = 0
    ) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """(the gradient for each of the weights, Q(o, a; theta) (B,), y (B,), the loss ()), y being what `target` says.

        `weight` (B,): as in `dqn.loss`. `passes`: forward passes of an observation that `target` takes. The shares
        depend on that and on B alone, so the same minibatches give the same weights whatever the threads' pace.
        """
        b, targets = len(action), Future[Tensor]()
        cuts = shares(b, min(self.threads, b), passes)
        of = [(o[i:j], action[i:j], targets, slice(i, j), weight, b) for i, j in pairwise(cuts)]
        waiting = [self._helpers.submit(self._share, *part) for part in of[1:]]
        try:
            targets.set_result(target())
        except BaseException as error:
            targets.set_exception(error)  # or the helpers would wait for ever
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
        """What these transitions, the `rows` of a minibatch of `b`, have in it."""
        q, y = self.net(o), targets.result()[rows]
        td = dqn.td_error(q, action, y)
        loss = dqn.loss(td, self.loss, None if weight is None else weight[rows]) * (len(y) / b)
        gradient = torch.autograd.grad(loss, self._weights)
        return list(gradient), dqn.of(q.detach(), action), loss.detach()


def shares(b: int, threads: int, passes: int) -> list[int]:
    """Where each thread's rows of `b` begin, and the last one's end; `threads` is at most b.

    The first thread has `passes` forward passes to do before its own rows: all have as much to do, as far as that can
    be, so it may have no rows at all.
    """
    if threads == 1:
        return [0, b]
    first = max(0.0, ((PASSES * b + passes) / threads - passes) / PASSES)
    first = round(first / STEP) * STEP if b >= threads * STEP else b // threads
    return [0, *(first + (b - first) * k // (threads - 1) for k in range(threads))]

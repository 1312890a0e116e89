"""The gradient of eq. (9) over a minibatch: a share of the minibatch on each thread, and the sum of what they find.

torch's own threads share each operation instead, and all of them wait for the slowest some thirty times an update: on
cores that TMC and UAVs need as well, that wait is long. Shares meet once. They are always the same ones, so the same
minibatches give the same weights whatever the threads' pace.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from learner import dqn
from learner.qnet import QNet
from tmc.kernel.config import Config

Share = tuple[list[Tensor], Tensor, Tensor]


class Gradient:
    """Of the loss of `net`, on `training.threads` threads; they end with this object."""

    def __init__(self, net: QNet, config: Config) -> None:
        self.net, self.loss, self.threads = net, config.dqn.loss, config.training.threads
        self._weights = list(net.parameters())
        self._helpers = ThreadPoolExecutor(max(1, self.threads - 1), "gradient", torch.set_num_threads, (1,))

    def __call__(self, o: Tensor, action: Tensor, y: Tensor, weight: Tensor | None = None) -> Share:
        """(the gradient for each of the weights, Q(o, a; theta) (B,), the loss ()), against targets y (B,).

        `weight` (B,): as in `dqn.loss`.
        """
        b, n = len(y), min(self.threads, len(y))
        parts = [slice(b * k // n, b * (k + 1) // n) for k in range(n)]
        of = [(o[p], action[p], y[p], None if weight is None else weight[p], b) for p in parts]
        waiting = [self._helpers.submit(self._share, *part) for part in of[1:]]
        shares = [self._share(*of[0]), *(w.result() for w in waiting)]
        if n == 1:
            return shares[0]
        gradients, q, losses = zip(*shares, strict=True)
        total = gradients[0]
        for others in gradients[1:]:
            torch._foreach_add_(total, others)
        return total, torch.cat(q), torch.stack(losses).sum()

    def _share(self, o: Tensor, action: Tensor, y: Tensor, weight: Tensor | None, b: int) -> Share:
        """What these transitions of a minibatch of `b` have in it."""
        q = self.net(o)
        loss = dqn.loss(dqn.td_error(q, action, y), self.loss, weight) * (len(y) / b)
        gradient = torch.autograd.grad(loss, self._weights)
        return list(gradient), dqn.of(q.detach(), action), loss.detach()

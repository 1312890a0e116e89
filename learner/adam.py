"""Adam by torch's fused kernel, without the class torch.optim.Adam.

The class imports torch's compiler (torch._dynamo) when it is made: 800 modules, 70 MB, 1 to 3 s of each start.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

BETAS, EPS = (0.9, 0.999), 1e-8
"""torch's defaults."""


class Adam:
    """Updates `params` with learning rate `lr`. `state`: by weight, its `step`, `exp_avg` and `exp_avg_sq`."""

    def __init__(self, params: Iterable[nn.Parameter], lr: float) -> None:
        self.params, self.lr = [*params], lr
        moments = ("exp_avg", "exp_avg_sq")
        self.state = {p: {"step": torch.zeros(()), **{m: torch.zeros_like(p) for m in moments}} for p in self.params}

    def zero_grad(self) -> None:
        """Clear the gradients."""
        for p in self.params:
            p.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update all weights by their gradients; a weight without a gradient stays as it is."""
        moved = [(p, with_layout_of(p, p.grad), self.state[p]) for p in self.params if p.grad is not None]
        params, grads, states = ([*column] for column in zip(*moved, strict=True))
        first, second, steps = ([s[key] for s in states] for key in ("exp_avg", "exp_avg_sq", "step"))
        adam(
            params, grads, first, second, [], steps, fused=True, amsgrad=False, beta1=BETAS[0], beta2=BETAS[1],
            lr=self.lr, weight_decay=0.0, eps=EPS, maximize=False,
        )  # fmt: skip


def with_layout_of(p: Tensor, gradient: Tensor) -> Tensor:
    """Return the gradient with the memory layout of its weight.

    torch's kernel walks through the memory of both. Filters have their channels last; with a channels-first gradient,
    each weight would silently take the step of another one.
    """
    return gradient if gradient.stride() == p.stride() else torch.empty_like(p).copy_(gradient)

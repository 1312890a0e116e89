"""Adam gives what torch.optim.Adam gives, bit for bit, without its imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from learner.adam import Adam

ROOT = Path(__file__).parents[2]


def weights() -> list[nn.Parameter]:
    """Return weights like the Q-network's: filters with the channels last, a matrix, and one without a gradient."""
    draw = torch.Generator().manual_seed(1)
    filters = torch.randn(4, 3, 3, 3, generator=draw).contiguous(memory_format=torch.channels_last)
    return [nn.Parameter(p) for p in (filters, torch.randn(9, 7, generator=draw), torch.randn(5, generator=draw))]


def gradients(p: Tensor, seed: int) -> Tensor:
    """Return a gradient with the memory layout of the weight, which torch assumes."""
    return torch.empty_like(p).copy_(torch.randn(p.shape, generator=torch.Generator().manual_seed(seed)))


@pytest.mark.parametrize("layout", [torch.preserve_format, torch.contiguous_format])
def test_every_step_is_that_of_torch(layout: torch.memory_format) -> None:
    """For any memory layout of the gradients."""
    mine, theirs = weights(), weights()
    adam, reference = Adam(mine, 1e-3), torch.optim.Adam(theirs, lr=1e-3, fused=True)
    for n in range(20):
        for optimizer, params in ((adam, mine), (reference, theirs)):
            optimizer.zero_grad()
            for i, p in enumerate(params[:2]):
                assert p.grad is None
                p.grad = gradients(p, 10 * n + i).clone(
                    memory_format=layout if params is mine else torch.preserve_format
                )
            optimizer.step()
        assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))
    for a, b in zip(mine[:2], theirs[:2], strict=True):
        assert all(
            torch.equal(adam.state[a][key], reference.state[b][key]) for key in ("step", "exp_avg", "exp_avg_sq")
        )
    assert torch.equal(mine[2], weights()[2])


def test_the_compiler_is_not_imported() -> None:
    code = """
import sys, torch
from learner.adam import Adam
p = torch.nn.Parameter(torch.ones(3))
adam = Adam([p], 0.1)
p.grad = torch.ones(3)
adam.step()
print("torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"

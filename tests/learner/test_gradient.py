"""How a minibatch is shared among threads. test_trainer.py tests that the shares add up to its gradient."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from learner import qnet
from learner.gradient import GRADIENT_PASSES, SHARE_STEP_ROWS, Gradient, shares
from tmc.kernel.config import build


@given(st.integers(1, 600), st.integers(1, 16), st.integers(0, 1200))
def test_the_shares_are_all_rows_in_their_order(b: int, threads: int, passes: int) -> None:
    threads = min(threads, b)
    cuts = shares(b, threads, passes)
    assert (cuts[0], cuts[-1], len(cuts)) == (0, b, threads + 1)
    assert all(i <= j for i, j in pairwise(cuts)) and all(i < j for i, j in pairwise(cuts[1:]))


@pytest.mark.parametrize("passes", [0, 20, 128, 256])
@pytest.mark.parametrize("threads", [2, 3, 4])
def test_who_computes_the_targets_has_less_to_do_besides(threads: int, passes: int) -> None:
    cuts = shares(128, threads, passes)
    first, *others = (GRADIENT_PASSES * (j - i) for i, j in pairwise(cuts))
    assert max(others) - min(others) <= GRADIENT_PASSES
    if cuts[1]:
        assert cuts[1] % SHARE_STEP_ROWS == 0
        assert abs(first + passes - max(others)) <= GRADIENT_PASSES * SHARE_STEP_ROWS
    else:
        assert passes >= max(others) - GRADIENT_PASSES * SHARE_STEP_ROWS


@pytest.mark.parametrize("threads", [1, 2])
def test_a_mistake_in_the_targets_is_raised_and_leaves_nobody_waiting(threads: int) -> None:
    config = build({"training.threads": threads})
    gradient = Gradient(qnet.build(config, (3, 30, 30)), config)
    o, action, y = torch.rand(16, 3, 30, 30), torch.zeros(16, dtype=torch.int64), torch.rand(16)

    def mistaken() -> torch.Tensor:
        raise ValueError("no targets")

    with pytest.raises(ValueError, match="no targets"):
        gradient(o, action, mistaken)
    total, q, targets, loss = gradient(o, action, lambda: y)
    assert q.shape == (16,) and targets is y and loss.item() == pytest.approx((q - y).square().mean().item(), rel=1e-5)
    assert [g.shape for g in total] == [p.shape for p in gradient.net.parameters()]

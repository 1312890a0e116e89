"""Eqs. (12) and (13) against plain loops written from the paper."""

import numpy as np
import pytest
import torch

from learner import dqn, rounding

B = 7


@pytest.fixture
def sample():
    rng = np.random.Generator(np.random.Philox(3))
    allowed = (rng.random((B, 9)) < 0.5).astype("u1")
    allowed[:, 8] = 1
    return {
        "reward": rng.normal(0, 5, B).astype("f4"),
        "discount": (0.95 ** rng.integers(1, 4, B)).astype("f4"),
        "q_next": rng.normal(0, 2, (B, 9)).astype("f4"),
        "allowed": allowed,
        "q_choice": rng.normal(0, 2, (B, 9)).astype("f4"),
    }


def plain_target(reward, discount, q_next, allowed, q_choice=None):
    y = []
    for j in range(B):
        by = q_next[j] if q_choice is None else q_choice[j]
        best = max((a for a in range(9) if allowed[j, a]), key=lambda a: by[a])
        y.append(reward[j] + discount[j] * q_next[j, best])
    return np.array(y)


def tensors(sample):
    return {name: torch.tensor(v) for name, v in sample.items()}


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("mask", [False, True])
def test_target_is_the_plain_loop(sample, double, mask):
    if not double:
        del sample["q_choice"]
    if not mask:
        sample["allowed"][:] = 1
    y = dqn.target(**tensors(sample)).numpy()
    np.testing.assert_allclose(y, plain_target(**sample), rtol=1e-6)


def test_target_of_the_paper_by_hand():
    q_next = torch.tensor([[0.0, 3.0, -1.0, 0, 0, 0, 0, 0, 2.0]])
    one = torch.ones(1, 9, dtype=torch.uint8)
    y = dqn.target(torch.tensor([-20.0]), torch.tensor([0.99]), q_next, one)
    assert y.tolist() == pytest.approx([-20 + 0.99 * 3])


def test_a_masked_action_is_never_the_maximum_even_when_all_allowed_are_negative():
    q_next = torch.tensor([[0.0] * 8 + [-5.0]])
    allowed = torch.tensor([[0] * 8 + [1]], dtype=torch.uint8)
    assert dqn.target(torch.zeros(1), torch.ones(1), q_next, allowed).tolist() == [-5.0]


def test_double_chooses_by_one_network_and_values_by_the_other():
    q_next = torch.tensor([[1.0, 2, 3, 4, 5, 6, 7, 8, 9]])
    q_choice = -q_next
    ones = torch.ones(1, 9, dtype=torch.uint8)
    assert dqn.target(torch.zeros(1), torch.ones(1), q_next, ones, q_choice).tolist() == [1.0]


def test_the_target_carries_no_gradient(sample):
    values = tensors(sample)
    values["q_next"].requires_grad_()
    assert not dqn.target(**values).requires_grad


def test_td_error_is_q_of_the_action_minus_y():
    q = torch.arange(18.0).reshape(2, 9)
    assert dqn.td_error(q, torch.tensor([4, 0]), torch.tensor([1.0, 10.0])).tolist() == [3.0, -1.0]


def test_mse_is_the_mean_square():
    assert float(dqn.loss(torch.tensor([1.0, -3.0, 0.5]))) == pytest.approx((1 + 9 + 0.25) / 3)


def test_huber_is_half_the_square_then_linear():
    td = np.array([0.5, -1.0, 3.0, -20.0])
    plain = np.mean([e * e / 2 if abs(e) <= 1 else abs(e) - 0.5 for e in td])
    assert float(dqn.loss(torch.tensor(td), "huber")) == pytest.approx(plain)


@pytest.mark.parametrize("kind", ["mse", "huber"])
def test_a_weight_multiplies_the_loss_of_its_transition(kind):
    td, weight = [0.5, -1.0, 3.0, -20.0], [1.0, 0.25, 0.0, 0.5]
    plain = np.mean([w * float(dqn.loss(torch.tensor([e]), kind)) for e, w in zip(td, weight, strict=True)])
    assert float(dqn.loss(torch.tensor(td), kind, torch.tensor(weight))) == pytest.approx(plain)


@pytest.mark.parametrize(("kind", "b"), [("mse", 128), ("mse", 43), ("huber", 128), ("huber", 43)])
def test_weights_of_one_change_nothing(kind, b):
    """Equal except for rounding: one division, and sums of b terms that torch may add in another order."""
    td = torch.randn(b, generator=torch.Generator().manual_seed(b)) * 3
    results = []
    for weight in (None, torch.ones(b)):
        leaf = td.clone().requires_grad_()
        value = dqn.loss(leaf, kind, weight)
        value.backward()
        results.append((value.detach(), leaf.grad))
    for mine, plain in zip(*results, strict=True):
        torch.testing.assert_close(mine, plain, atol=0, rtol=2 * rounding.gamma(b))


def test_the_gradient_of_the_loss_reaches_the_action_taken_only():
    q = torch.zeros(2, 9, requires_grad=True)
    dqn.loss(dqn.td_error(q, torch.tensor([2, 5]), torch.tensor([1.0, -2.0]))).backward()
    expected = torch.zeros(2, 9)
    expected[0, 2], expected[1, 5] = -1.0, 2.0
    assert torch.equal(q.grad, expected)

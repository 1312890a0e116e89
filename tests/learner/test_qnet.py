"""The network of Fig. 2(b) and Table I."""

import numpy as np
import pytest
import torch

from learner import qnet, rounding
from tmc.kernel.config import ConfigError, build

PAPER_SHAPE = (3, 30, 30)


def plain_conv(x, weight, bias, stride):
    """Return the convolution without padding, written as its definition. x (C, H, W), weight (F, C, k, k)."""
    k = weight.shape[-1]
    rows, cols = ((n - k) // stride + 1 for n in x.shape[1:])
    y = np.empty((len(weight), rows, cols))
    for f in range(len(weight)):
        for r in range(rows):
            for c in range(cols):
                patch = x[:, r * stride : r * stride + k, c * stride : c * stride + k]
                y[f, r, c] = (patch * weight[f]).sum() + bias[f]
    return y


def plain_forward(net, o):
    """Return the values of Sec. IV-B, computed in NumPy, for one observation (C, H, W)."""
    w = {name: p.detach().numpy().astype(float) for name, p in net.named_parameters()}
    bottom, right = net.pad
    x = np.pad(o.astype(float), ((0, 0), (0, bottom), (0, right)))
    for i in range(len(net.convs)):
        x = np.maximum(plain_conv(x, w[f"convs.{i}.weight"], w[f"convs.{i}.bias"], net.stride), 0)
    x = x.ravel()
    if net.near:
        row, col = o.shape[1] // 2, o.shape[2] // 2
        reach = range(-net.near, net.near + 1)
        x = np.concatenate([x, [o[c, row + i, col + j] for c in range(len(o)) for i in reach for j in reach]])
    hidden = np.maximum(w["dense.weight"] @ x + w["dense.bias"], 0)
    return w["out.weight"] @ hidden + w["out.bias"]


def test_parameters_of_the_paper(paper):
    net = qnet.build(paper, PAPER_SHAPE)
    assert sum(p.numel() for p in net.parameters()) == 83_385
    assert [tuple(c.weight.shape) for c in net.convs] == [(16, 3, 4, 4), (32, 16, 4, 4)]
    assert net.dense.out_features == 64
    assert net.out.out_features == 9


def test_patrol_sees_the_near_cells_directly(patrol):
    net = qnet.build(patrol, (3, 17, 17))
    assert net.dense.in_features == 32 * 3 * 3 + 3 * 5 * 5


@pytest.mark.parametrize("near", [0, 1, 2])
def test_forward_is_the_plain_loop(small, near):
    net = qnet.build(small({"observation.near": near}), (3, 9, 9))
    o = np.random.Generator(np.random.Philox(1)).random((3, 3, 9, 9)).astype("f4")
    q = net(torch.tensor(o)).detach().numpy()
    assert q.shape == (3, 9)
    bound = rounding.Net(net).forward(torch.tensor(o)).error.numpy()
    assert (np.abs(q - [plain_forward(net, one) for one in o]) <= bound).all()
    assert bound.max() < 1e-4, "the bound tells nothing apart"


@pytest.mark.parametrize("height, width", [(17, 17), (30, 30), (31, 33), (12, 35), (10, 10), (21, 44)])
@pytest.mark.parametrize("kernel, stride", [(4, 2), (3, 2), (4, 1)])
def test_every_cell_of_the_view_counts(paper, height, width, kernel, stride):
    """With strides, convolutions leave out the last rows and columns: a UAV there would not observe itself."""
    config = build({"network.kernel": kernel, "network.stride": stride}, paper)
    net = qnet.build(config, (3, height, width))
    rng = torch.Generator().manual_seed(1)
    o = torch.randn(16, 3, height, width, generator=rng, requires_grad=True)
    seen = torch.autograd.grad(net(o).sum(), o)[0].abs().amax((0, 1)) > 0
    assert seen.all()


def test_the_papers_view_needs_no_padding(paper):
    assert qnet.build(paper, PAPER_SHAPE).pad == (0, 0)


def test_values_may_be_negative(paper):
    net = qnet.build(paper, PAPER_SHAPE)
    assert (net(torch.zeros(1, *PAPER_SHAPE)) < 0).any()


def test_same_seed_same_weights_other_seed_other_weights(preset):
    shape = PAPER_SHAPE if preset.observation.view == "whole" else (3, 17, 17)
    first, again = qnet.build(preset, shape), qnet.build(preset, shape)
    other = qnet.build(build({"training.seed": 2}, preset), shape)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(first.parameters(), other.parameters(), strict=True))


def test_weights_leave_the_global_generator_alone(paper):
    before = torch.get_rng_state()
    qnet.build(paper, PAPER_SHAPE)
    assert torch.equal(before, torch.get_rng_state())


def test_weights_are_uniform_up_to_one_over_root_fan_in(paper):
    dense = qnet.build(paper, PAPER_SHAPE).dense
    bound = dense.in_features**-0.5
    assert dense.weight.abs().max() <= bound
    assert dense.weight.abs().max() > 0.999 * bound
    assert dense.bias.abs().max() <= bound
    assert float(dense.weight.detach().std()) == pytest.approx(bound / 3**0.5, rel=0.01)


@pytest.mark.parametrize("side, fits", [(9, False), (10, True)])
def test_the_view_must_hold_the_convolutions(paper, side, fits):
    if fits:
        assert qnet.build(paper, (3, side, side))(torch.zeros(1, 3, side, side)).shape == (1, 9)
    else:
        with pytest.raises(ConfigError, match=r"9 x 9 cells is too small.*network.kernel = 4.*lower these"):
            qnet.build(paper, (3, side, side))


def test_the_near_cells_must_be_in_view(small):
    with pytest.raises(ConfigError, match=r"observation.near = 4 is larger than the view: choose 3 or less"):
        qnet.build(small({"observation.near": 4}), (3, 7, 7))

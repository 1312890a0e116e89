"""The Q-network Q(o, a; theta) of Fig. 2(b) and Table I: convolutions, one fully connected layer, nine values."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from tmc.kernel import draws
from tmc.kernel.config import Config, NetworkConfig
from tmc.kernel.draws import Stream
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.policy import check_view, features, padding

Shape = tuple[int, int, int]
"""(channels, height, width) of an observation, eq. (12)."""


class QNet(nn.Module):
    """Maps observations (B, C, H, W) float32 to the values of the nine actions (B, 9) float32, in scaled reward.

    Sec. IV-B: ReLU after each convolution and after the dense layer, none after the last. Views that the convolutions'
    strides do not fit are padded in the south and east (`tmc.kernel.policy.padding`). With `near` > 0 (ours, off in
    the paper's preset) the (2 near + 1)^2 cells in the middle, all channels, also go to the dense layer directly: with
    a stride, the convolutions alone would blur which of the cells next to the UAV is which.
    """

    def __init__(self, network: NetworkConfig, shape: Shape, near: int) -> None:
        super().__init__()
        channels, height, width = shape
        self.shape, self.near, self.stride = shape, near, network.stride
        filters = (channels, *network.channels)
        self.convs = nn.ModuleList(nn.Conv2d(a, b, network.kernel, network.stride) for a, b in pairwise(filters))
        rows, cols = features(network, height, width)
        self.pad = padding(network, height), padding(network, width)
        self.dense = nn.Linear(filters[-1] * rows * cols + channels * crop_size(near), network.dense)
        self.out = nn.Linear(network.dense, N_ACTIONS)

    def forward(self, o: Tensor) -> Tensor:
        bottom, right = self.pad
        x = pad(o, (0, right, 0, bottom)) if bottom or right else o
        for conv in self.convs:
            x = torch.relu_(conv(x))  # in place, because memory outside the caches costs most
        if x.requires_grad and not x.is_contiguous():
            x.register_hook(as_filters_like)  # type: ignore[no-untyped-call]
        x = x.flatten(1)
        if self.near:
            x = torch.cat((x, self.crop(o).flatten(1)), dim=1)
        values: Tensor = self.out(torch.relu(self.dense(x)))
        return values

    def crop(self, o: Tensor) -> Tensor:
        """Return the middle of the observation: (B, C, 2 near + 1, 2 near + 1)."""
        (top, bottom), (left, right) = (middle(side, self.near) for side in self.shape[1:])
        return o[:, :, top:bottom, left:right]


def as_filters_like(gradient: Tensor) -> Tensor:
    """Return the gradient with channels last; the layout that `flatten` gives it would cost 6 % of an update."""
    return gradient.contiguous(memory_format=torch.channels_last)


def middle(side: int, near: int) -> tuple[int, int]:
    """Return the first, and one past the last, of the 2 near + 1 cells in the middle of `side` cells."""
    return side // 2 - near, side // 2 + near + 1


def crop_size(near: int) -> int:
    """Return the number of cells of the crop, 0 when it is off."""
    return (2 * near + 1) ** 2 if near else 0


def build(config: Config, shape: Shape) -> QNet:
    """Return the network for observations of this shape, with the initial weights of config.training.seed.

    The same seed gives the same weights on any machine and torch version. Raises ConfigError if the view is too small.
    """
    check_view(config, shape)
    with torch.device("meta"):  # without weights, so that torch's global generator is not used
        net = QNet(config.network, shape, config.observation.near)
    net.to_empty(device="cpu")
    initialise(net, config.training.seed)
    return net


@torch.no_grad()
def initialise(net: QNet, seed: int) -> None:
    """Draw all weights uniform in +-1 / sqrt(fan in), torch's default, by addressed draws: one tick per layer."""
    for i, layer in enumerate((*net.convs, net.dense, net.out)):
        sizes = [p.numel() for p in layer.parameters()]
        u = draws.uniforms(seed, Stream.WEIGHTS, sum(sizes), tick=i)
        bound = 1.0 / math.sqrt(sizes[0] // sizes[1])  # weights per unit of the layer: the fan in
        for p, part in zip(layer.parameters(), np.split(u, [sizes[0]]), strict=True):
            p.copy_(torch.from_numpy((2.0 * part - 1.0) * bound).reshape(p.shape))

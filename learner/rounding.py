"""Bounds the rounding error of the gradient of eq. (9), beside the exact gradient. The bound holds on every processor.

Two computations that add in another order give equal float32 numbers on one processor and different ones on the next,
so a test can require neither. It can require this: in float32, for any order, number of threads and instructions, a sum
of n products departs from the exact sum by at most

    gamma(n) sum |a_i b_i|,    gamma(n) = n u / (1 - n u),    u = eps / 2 = 2^-24

(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., eq. 3.5). Every layer, forward and backward, is made
of such sums. `Ball` carries the value in float64 and the bound so far; `product` adds the bound of one more layer. So
the bound follows from eps, from the numbers of terms (weights of a filter, outputs of a layer, rows of a minibatch
times places of a filter) and from the sizes of the numbers. It is a worst case: the real error is a hundredth of it or
less. float64's own rounding is 2^-29 of the bound.

*Kinks.* Where rounding may move the input of a ReLU across zero, the gradient may have all of that unit's part or none
of it, so all of it is added to the bound. In double Q-learning rounding may choose another action, so the bound covers
the value of every action that it may choose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad
from torch.nn.grad import conv2d_input, conv2d_weight

from learner.batching import Batch
from learner.qnet import QNet
from tmc.kernel.config import Config

ELEMENTWISE_ROUNDINGS = 8
"""At least the roundings of each elementwise step: r + gamma Q, Q - y, and the loss with its weights and shares."""


def gamma(n: int) -> float:
    """Return the bound on the error of a sum of n products, relative to the sum of their sizes."""
    u = torch.finfo(torch.float32).eps / 2
    return n * u / (1 - n * u)


@dataclass(frozen=True)
class Ball:
    """The numbers within `error` of `value`, elementwise: float32 computes one of them. Both float64, of one shape."""

    value: Tensor
    error: Tensor

    def size(self) -> Tensor:
        """Return the largest absolute value in it, elementwise."""
        return self.value.abs() + self.error

    def rounded(self, n: int, sizes: Tensor) -> Ball:
        """Return the ball after n roundings of numbers that add up to `sizes`, or underflow."""
        return Ball(self.value, self.error + gamma(n) * sizes + n * torch.finfo(torch.float32).tiny)


def exact(x: Tensor) -> Ball:
    """Return the ball of numbers that are given exactly, in float32 or less."""
    return Ball(x.double(), torch.zeros(x.shape, dtype=torch.float64))


def product(f: Callable[[Tensor, Tensor], Tensor], a: Ball, b: Ball, n: int) -> Ball:
    """Return `f` of two balls; `f` is a bilinear map whose results are sums of at most n products each."""
    sizes = f(a.size(), b.size())
    return Ball(f(a.value, b.value), sizes - f(a.value.abs(), b.value.abs())).rounded(n, sizes)


class Layer:
    """z = f(x, w) + b, a convolution or a matrix, and its two derivatives."""

    def __init__(self, module: nn.Module) -> None:
        assert isinstance(module, nn.Conv2d | nn.Linear) and module.bias is not None
        self.w, self.b = exact(module.weight.detach()), exact(module.bias.detach())
        self.stride = module.stride[0] if isinstance(module, nn.Conv2d) else 0
        self.x = self.z = self.b

    def forward(self, x: Ball) -> Ball:
        """Return z; keep it and x for `backward`."""

        def f(x: Tensor, w: Tensor) -> Tensor:
            return conv2d(x, w, stride=self.stride) if self.stride else x @ w.T

        n = self.w.value[0].numel() + 1
        z, b = product(f, x, self.w, n), self.b.value.reshape(-1, *(1, 1) * (self.stride > 0))
        self.x, self.z = x, Ball(z.value + b, z.error).rounded(n, b.abs())
        return self.z

    def backward(self, d: Ball) -> list[Ball]:
        """Return the gradients for w and b, from `d`, the gradient for z."""

        def f(d: Tensor, x: Tensor) -> Tensor:
            if not self.stride:
                return d.T @ x
            found: Tensor = conv2d_weight(x, self.w.value.shape, d, self.stride)  # type: ignore[no-untyped-call]
            return found

        n, sums = d.value.numel() // len(self.b.value), (0, *(2, 3) * (self.stride > 0))
        bias = Ball(d.value.sum(sums), d.error.sum(sums)).rounded(n, d.size().sum(sums))
        return [product(f, d, self.x, n), bias]

    def inward(self, d: Ball) -> Ball:
        """Return the gradient for x, from `d`, the gradient for z."""

        def f(d: Tensor, w: Tensor) -> Tensor:
            if not self.stride:
                return d @ w
            found: Tensor = conv2d_input(self.x.value.shape, w, d, self.stride)  # type: ignore[no-untyped-call]
            return found

        return product(f, d, self.w, self.w.value[:, 0].numel())


def relu(z: Ball) -> Ball:
    """Return relu(z); it moves no two numbers farther apart, so the error stays."""
    return Ball(z.value.relu(), z.error)


def unrelu(d: Ball, z: Ball) -> Ball:
    """Return the gradient for z, from `d`, that for relu(z); where z may have either sign, all of `d` is error."""
    on, doubt = z.value > 0, z.value.abs() <= z.error
    return Ball(d.value * on, torch.where(doubt, d.size(), d.error * on))


class Net:
    """The layers of a network, with the inputs and outputs of the last forward pass."""

    def __init__(self, net: QNet) -> None:
        self.net = net
        self.convs = [Layer(conv) for conv in net.convs]
        self.dense, self.out = Layer(net.dense), Layer(net.out)

    def forward(self, o: Tensor) -> Ball:
        """Return Q(o, .), shape (B, 9)."""
        bottom, right = self.net.pad
        x = exact(pad(o, (0, right, 0, bottom)))
        for conv in self.convs:
            x = relu(conv.forward(x))
        near = exact(self.net.crop(o) if self.net.near else o[:, :0])
        both = ((x.value, near.value), (x.error, near.error))
        x = Ball(*(torch.cat([part.flatten(1) for part in parts], 1) for parts in both))
        return self.out.forward(relu(self.dense.forward(x)))

    def backward(self, d: Ball) -> list[Ball]:
        """Return the gradient for each of `parameters()`, in their order, from `d`, that for Q(o, .)."""
        inner = unrelu(self.out.inward(d), self.dense.z)
        found = [self.out.backward(d), self.dense.backward(inner)]
        into, shape = self.dense.inward(inner), self.convs[-1].z.value.shape
        d = Ball(*(part[:, : shape[1:].numel()].reshape(shape) for part in (into.value, into.error)))
        for i, conv in reversed(list(enumerate(self.convs))):
            d = unrelu(d, conv.z)
            found.append(conv.backward(d))
            d = conv.inward(d) if i else d
        return list(chain(*reversed(found)))


def best(q: Ball, allowed: Tensor, choice: Ball) -> Ball:
    """Return the value in `q` of the best action by `choice`; the error covers all that rounding may make the best.

    Shape (B,).
    """
    least = (choice.value - choice.error).masked_fill(allowed == 0, -torch.inf).amax(1, keepdim=True)
    may = (choice.value + choice.error >= least) & (allowed != 0)
    chosen = choice.value.masked_fill(allowed == 0, -torch.inf).argmax(1, keepdim=True)
    value = q.value.gather(1, chosen)
    return Ball(value.squeeze(1), ((q.value - value).abs() + q.error).masked_fill(~may, 0.0).amax(1))


def gradient(config: Config, online: QNet, target: QNet, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return (gradient of eq. (9) in theta, largest error of any float32 computation of it), all weights in one row.

    The equations are written here again, independently, so that a mistake in the learner's own shows.
    """
    d, b = config.dqn, len(batch.action)
    o, o_next = torch.tensor(batch.observation), torch.tensor(batch.next_observation(np.arange(b)))
    r, discount = (torch.tensor(x).double() for x in (batch.reward, batch.discount))
    q_next, theta = Net(target).forward(o_next), Net(online)
    v = best(q_next, torch.tensor(batch.allowed), theta.forward(o_next) if d.double else q_next)
    r = r * d.reward_scale
    y = Ball(r + discount * v.value, discount * v.error).rounded(ELEMENTWISE_ROUNDINGS, r.abs() + discount * v.size())
    q, rows, action = theta.forward(o), torch.arange(b), torch.tensor(batch.action).long()
    chosen = Ball(q.value[rows, action], q.error[rows, action])
    td = Ball(chosen.value - y.value, chosen.error + y.error)
    td = td.rounded(ELEMENTWISE_ROUNDINGS, chosen.size() + y.size())
    slope = Ball(td.value.clamp(-1, 1), td.error) if d.loss == "huber" else Ball(2 * td.value, 2 * td.error)
    weight = torch.tensor(batch.weight).double() if batch.weight.size else torch.ones(b, dtype=torch.float64)
    slope = Ball(slope.value * weight / b, slope.error * weight / b).rounded(
        ELEMENTWISE_ROUNDINGS, slope.size() * weight / b
    )
    into = exact(torch.zeros(q.value.shape))
    into.value[rows, action], into.error[rows, action] = slope.value, slope.error
    balls = theta.backward(into)
    return torch.cat([x.value.flatten() for x in balls]), torch.cat([x.error.flatten() for x in balls])

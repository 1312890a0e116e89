"""The gradient is the exact one within rounding: tested on the learner, and on learners made wrong on purpose.

The same assertion passes the first and must fail for each of the others, else it would claim nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from learner import dqn, qnet, reference, rounding
from learner import trainer as trainer_module
from learner.batching import Batch
from learner.gradient import Gradient
from learner.target_cache import TargetValueCache
from learner.trainer import Trainer
from tests.learner.claims import assert_exact_within_rounding, batches_with_repeats
from tmc.kernel.config import Config, build, flat

FOLLOWS = {"dqn.target_episodes": 0, "dqn.target_updates": 10}
Make = Callable[..., Any]


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize(
    "changes",
    [{}, {"dqn.double": True}, {"dqn.loss": "huber", "dqn.reward_scale": 0.1}, {"observation.near": 0}],
    ids=["plain", "double", "huber", "no-crop"],
)
def test_every_gradient_is_exact_within_rounding(
    small: Make, minibatch_of: Make, changes: dict[str, Any], threads: int
) -> None:
    config = small({**FOLLOWS, **changes, "training.threads": threads})
    assert_exact_within_rounding(config, batches_with_repeats(minibatch_of, config, 30))


@pytest.mark.parametrize("threads", [1, 2])
def test_so_it_is_with_the_networks_of_the_presets(preset: Config, minibatch_of: Make, threads: int) -> None:
    config = build({**flat(preset), **FOLLOWS, "dqn.target_updates": 2, "training.threads": threads})
    assert_exact_within_rounding(config, batches_with_repeats(minibatch_of, config, 5))


def stale_values(patch: pytest.MonkeyPatch) -> None:
    """Target values of the old theta- are used after the copy."""
    patch.setattr(TargetValueCache, "forget", lambda self: None)


def mixed_up_values(patch: pytest.MonkeyPatch) -> None:
    """Of two transitions that share a place, one gets the other's value."""
    look_up = TargetValueCache.look_up
    patch.setattr(
        TargetValueCache,
        "look_up",
        lambda self, index: (look_up(self, index)[0], self._number[index % len(self._number)] >= 0),
    )


def late_target(patch: pytest.MonkeyPatch) -> None:
    """theta is never copied to theta-."""
    patch.setattr(Trainer, "_copy", lambda self: None)


def lost_share(patch: pytest.MonkeyPatch) -> None:
    """The first thread's share of the gradient is not added."""
    share = Gradient._share

    def lost(self: Gradient, *args: Any) -> Any:
        gradient, q, loss = share(self, *args)
        return [g * (args[3].start > 0) for g in gradient], q, loss

    patch.setattr(Gradient, "_share", lost)


def uneven_shares(patch: pytest.MonkeyPatch) -> None:
    """Every share has the same weight, regardless of its number of rows."""
    share = Gradient._share

    def even(self: Gradient, o: Any, action: Any, targets: Any, rows: slice, weight: Any, b: int) -> Any:
        return share(self, o, action, targets, rows, weight, self.threads * len(action))

    patch.setattr(Gradient, "_share", even)


def shifted_targets(patch: pytest.MonkeyPatch) -> None:
    """Rows of a later share get the targets of the first rows."""
    share = Gradient._share

    def shifted(self: Gradient, o: Any, action: Any, targets: Any, rows: slice, *rest: Any) -> Any:
        return share(self, o, action, targets, slice(0, rows.stop - rows.start), *rest)

    patch.setattr(Gradient, "_share", shifted)


def of_targets(patch: pytest.MonkeyPatch, change: Callable[[Batch], Batch]) -> None:
    """The targets are those of another minibatch."""
    target = Trainer._target
    patch.setattr(Trainer, "_target", lambda self, batch, *rest: target(self, change(batch), *rest))


def wrong_discount(patch: pytest.MonkeyPatch) -> None:
    """gamma is 0.98901 instead of 0.99."""
    of_targets(patch, lambda batch: replace(batch, discount=batch.discount * np.float32(0.999)))


def no_mask(patch: pytest.MonkeyPatch) -> None:
    """The maximum is taken over all actions, allowed or not."""
    of_targets(patch, lambda batch: replace(batch, allowed=np.ones_like(batch.allowed)))


def plain_double(patch: pytest.MonkeyPatch) -> None:
    """theta- chooses the action where theta should."""
    value = dqn.value
    patch.setattr(dqn, "value", lambda q_next, allowed, q_choice=None: value(q_next, allowed))


def half_precision(patch: pytest.MonkeyPatch) -> None:
    """Images are rounded to half precision instead of float32."""
    as_channels_last = trainer_module.as_channels_last
    patch.setattr(trainer_module, "as_channels_last", lambda image: as_channels_last(np.float16(image).astype("<f4")))


WRONG: dict[Callable[[pytest.MonkeyPatch], None], dict[str, Any]] = {
    stale_values: {},
    mixed_up_values: {"replay.capacity": 4, "replay.learn_start": 1},
    late_target: {},
    lost_share: {"training.threads": 2},
    uneven_shares: {"training.threads": 3},
    shifted_targets: {"training.threads": 2},
    wrong_discount: {},
    no_mask: {},
    plain_double: {"dqn.double": True},
    half_precision: {},
}


@pytest.mark.parametrize(("wrong", "changes"), WRONG.items(), ids=[wrong.__name__ for wrong in WRONG])
def test_a_wrong_learner_is_distinguished_from_rounding(
    small: Make, minibatch_of: Make, monkeypatch: pytest.MonkeyPatch, wrong: Any, changes: dict[str, Any]
) -> None:
    config = small({**FOLLOWS, **changes})
    batches = list(batches_with_repeats(minibatch_of, config, 30))
    assert_exact_within_rounding(config, batches)
    wrong(monkeypatch)
    with pytest.raises(AssertionError, match="times what rounding can do"):
        assert_exact_within_rounding(config, batches)


def of_float32(net: qnet.QNet, target: qnet.QNet, config: Config, batch: Batch) -> torch.Tensor:
    """Return the gradient of eq. (9) as torch computes it, all weights in one row."""
    t = reference.Tensors(batch)
    with torch.no_grad():
        y = dqn.target(t.reward * config.dqn.reward_scale, t.discount, target(t.o_next), t.allowed)
    net.zero_grad()
    torch.autograd.backward(dqn.loss(dqn.td_error(net(t.o), t.action, y), config.dqn.loss))
    return reference.gradient(net).double()


def test_the_bound_holds_for_sums_in_any_order(small: Make, minibatch_of: Make) -> None:
    """Rows in another order, hidden units in another order: other sums, the same gradient."""
    config, batch = small(), minibatch_of(small(), b=16)
    net, target = (qnet.build(small({"training.seed": seed}), batch.observation.shape[1:]) for seed in (1, 2))
    exact, bound = rounding.gradient(config, net, target, batch)
    rng = np.random.Generator(np.random.Philox(3))
    hidden = net.dense.bias.numel()
    for _ in range(20):
        rows, units = rng.permutation(16), rng.permutation(hidden)
        o_next = batch.next_observation(rows)
        names = [name for name, value in vars(batch).items() if isinstance(value, np.ndarray) and value.size]
        again: dict[str, Any] = {name: getattr(batch, name)[rows] for name in names}
        moved = replace(batch, **again, next_observation=o_next.__getitem__)
        other = qnet.build(config, batch.observation.shape[1:])
        other.load_state_dict(net.state_dict())
        with torch.no_grad():
            other.dense.weight.copy_(net.dense.weight[units])
            other.dense.bias.copy_(net.dense.bias[units])
            other.out.weight.copy_(net.out.weight[:, units])
        found = of_float32(other, target, config, moved)
        with torch.no_grad():  # and back to the order of `net`
            parts = dict(
                zip(dict(net.named_parameters()), found.split([p.numel() for p in net.parameters()]), strict=True)
            )
            back = np.argsort(units)
            parts["dense.weight"] = parts["dense.weight"].view(hidden, -1)[back].flatten()
            parts["dense.bias"] = parts["dense.bias"][back]
            parts["out.weight"] = parts["out.weight"].view(-1, hidden)[:, back].flatten()
        assert ((torch.cat(list(parts.values())) - exact).abs() <= bound).all()


def test_the_bound_holds_where_rounding_moves_a_unit_across_zero(small: Make, minibatch_of: Make) -> None:
    """A hidden unit's input is zero except for rounding: with and without it, the gradient is within the bound."""
    config, batch = small(), minibatch_of(small(), b=1)
    net, target = (qnet.build(small({"training.seed": seed}), batch.observation.shape[1:]) for seed in (1, 2))
    seen: list[torch.Tensor] = []
    hook = net.dense.register_forward_hook(lambda module, inputs, z: seen.append(z.detach()))
    net(torch.tensor(batch.observation))
    hook.remove()
    with torch.no_grad():
        net.dense.bias -= seen[0][0]  # all inputs are zero now, within float32
    exact, bound = rounding.gradient(config, net, target, batch)
    found = []
    for step in (-1e-7, 1e-7):  # below what rounding can do to these sums
        moved = qnet.build(config, batch.observation.shape[1:])
        moved.load_state_dict(net.state_dict())
        with torch.no_grad():
            moved.dense.bias += step
        found.append(of_float32(moved, target, config, batch))
        assert ((found[-1] - exact).abs() <= bound).all()
    assert (found[0] - found[1]).norm() > 0.1 * found[1].norm(), "the units were to be off, then on"

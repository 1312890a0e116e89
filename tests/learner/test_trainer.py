"""Algorithm 1's update, its target copy, and the state that a checkpoint needs."""

import math
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch

from learner import dqn, qnet, reference, rounding
from learner.batching import TrainingError
from learner.trainer import Trainer, copy_due
from tests.learner.claims import assert_exact_within_rounding, batches_with_repeats
from tmc.kernel.config import build, flat
from tmc.kernel.grid import Grid
from tmc.kernel.policy import KEY, PolicyCard, card_for


def weights(net):
    return torch.cat([p.detach().flatten() for p in net.parameters()])


def same(a, b):
    """Return whether the two trainers have the same state, bit for bit."""
    a, b = a.state(), b.state()
    counters = (a.updates, a.version, a.copied) == (b.updates, b.version, b.copied)
    return counters and all(torch.equal(a.tensors[k], b.tensors[k]) for k in a.tensors | b.tensors)


def following(batch):
    """Return all images of o'."""
    return batch.next_observation(np.arange(len(batch.action)))


class PlainAdam:
    """Adam as published by Kingma and Ba (Algorithm 1), in float64, from the weights of `net`."""

    def __init__(self, net, lr):
        self.theta, self.lr, self.t = weights(net).double(), lr, 0
        self.m, self.v = torch.zeros_like(self.theta), torch.zeros_like(self.theta)

    def step(self, g):
        self.t += 1
        b1, b2 = 0.9, 0.999
        self.m, self.v = b1 * self.m + (1 - b1) * g, b2 * self.v + (1 - b2) * g**2
        self.theta -= self.lr * (self.m / (1 - b1**self.t)) / ((self.v / (1 - b2**self.t)).sqrt() + 1e-8)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_updates_are_plain_adam_on_the_plain_equations(preset, trainer_of, minibatch_of, threads):
    """The gradient is the exact one within rounding, and the weights are Adam's of that gradient.

    One after the other, since Adam divides by the gradient's size: of a weight whose gradient is nothing but rounding
    it makes a whole step, this way or that.
    """
    trainer = trainer_of(build({**flat(preset), "training.threads": threads}))
    adam, eps = PlainAdam(trainer.online, preset.dqn.learning_rate), torch.finfo(torch.float32).eps
    for n in range(4):
        batch = minibatch_of(preset, n)
        exact, bound = rounding.gradient(preset, trainer.online, trainer.target, batch)
        trainer.update(batch)
        found = reference.gradient(trainer.online).double()
        assert ((found - exact).abs() <= bound).all()
        adam.step(found)
    # Each step rounds the weight, and some ten numbers that are at most as large as the step.
    torch.testing.assert_close(weights(trainer.online).double(), adam.theta, atol=40 * eps * adam.lr, rtol=4 * eps)
    assert not torch.allclose(weights(trainer.online), weights(trainer.target), atol=1e-4)


def test_metrics_are_those_of_the_minibatch_before_the_step(small, trainer_of, minibatch_of):
    config = small({"dqn.reward_scale": 0.5})
    trainer, batch = trainer_of(config), minibatch_of(config)
    net = qnet.build(config, trainer.shape)
    q = net(torch.tensor(batch.observation)).detach().numpy()[np.arange(6), batch.action]
    q_next = net(torch.tensor(following(batch))).detach().numpy()
    y = 0.5 * batch.reward + 0.99 * np.where(batch.allowed, q_next, -np.inf).max(1)
    metrics = trainer.update(batch)
    assert metrics.updates == trainer.updates == 1
    assert metrics.loss == pytest.approx(np.mean((q - y) ** 2), rel=1e-5)
    assert metrics.q_mean == pytest.approx(q.mean(), rel=1e-5)
    assert metrics.target_mean == pytest.approx(y.mean(), rel=1e-5)
    assert metrics.td_abs == pytest.approx(np.abs(q - y).mean(), rel=1e-5)
    grads = torch.cat([p.grad.flatten() for p in trainer.online.parameters()])
    assert metrics.grad_norm == pytest.approx(float(grads.norm()), rel=1e-5)


def copies(trainer, minibatch_of, episodes):
    """Return the indices of the minibatches, with these episode counts, before which theta was copied to theta-."""
    found = []
    for i, n in enumerate(episodes):
        theta, before = weights(trainer.online), weights(trainer.target)
        trainer.update(minibatch_of(trainer.config, i, episodes=n))
        after = weights(trainer.target)
        if not torch.equal(before, after):
            assert torch.equal(after, theta)
            found.append(i)
    return found


def test_target_follows_exactly_every_five_episodes(small, trainer_of, minibatch_of):
    episodes = [n // 3 for n in range(51)]  # three updates per episode
    assert copies(trainer_of(small()), minibatch_of, episodes) == [15, 30, 45]


def test_target_follows_once_when_the_count_jumps_over_a_multiple(small, trainer_of, minibatch_of):
    assert copies(trainer_of(small()), minibatch_of, [0, 4, 7, 8, 9, 10, 10, 23, 24, 25]) == [2, 5, 7, 9]


def test_target_counts_afresh_when_a_new_run_starts_from_old_weights(small, trainer_of, minibatch_of):
    assert copies(trainer_of(small()), minibatch_of, [0, 12, 0, 4, 5]) == [1, 4]


def test_target_follows_every_so_many_updates(small, trainer_of, minibatch_of):
    trainer = trainer_of(small({"dqn.target_episodes": 0, "dqn.target_updates": 3}))
    for n in range(1, 8):
        trainer.update(minibatch_of(trainer.config, n, episodes=n))
        assert torch.equal(weights(trainer.online), weights(trainer.target)) == (n % 3 == 0)


def test_target_follows_by_both_rules_at_once(small, trainer_of, minibatch_of):
    trainer = trainer_of(small({"dqn.target_episodes": 5, "dqn.target_updates": 2}))
    trainer.update(minibatch_of(trainer.config, 0))
    theta = weights(trainer.online)
    trainer.update(minibatch_of(trainer.config, 1, episodes=5))
    assert trainer.state().copied == 5
    assert torch.equal(weights(trainer.target), weights(trainer.online))
    assert not torch.equal(weights(trainer.target), theta)


@pytest.mark.parametrize(
    "finished, copied, f, due",
    [(4, 0, 5, False), (5, 0, 5, True), (6, 5, 5, False), (9, 5, 5, False), (10, 5, 5, True), (7, 0, 0, False)],
)
def test_copy_due(finished, copied, f, due):
    assert copy_due(finished, copied, f) is due


def test_the_target_starts_as_theta_and_takes_no_gradient(paper, trainer_of):
    trainer = trainer_of(paper)
    assert torch.equal(weights(trainer.online), weights(trainer.target))
    assert not any(p.requires_grad for p in trainer.target.parameters())


def test_the_loss_falls_on_a_fixed_problem(small, trainer_of, minibatch_of):
    config = small({"dqn.learning_rate": 0.01})
    trainer = trainer_of(config)
    batch = minibatch_of(config, b=32, discount=np.zeros(32, "<f4"))
    losses = [trainer.update(batch).loss for _ in range(300)]
    assert losses[-1] < 0.02 * losses[0]


def test_a_constant_reward_is_worth_its_geometric_sum(small, trainer_of, minibatch_of):
    """The time limit is not a terminal state: with r = 1 and gamma = 0.5 for ever, Q is 1 / (1 - gamma) = 2."""
    config = small({"dqn.gamma": 0.5, "dqn.learning_rate": 0.003, "dqn.target_episodes": 0, "dqn.target_updates": 20})
    trainer = trainer_of(config)
    for n in range(600):
        metrics = trainer.update(minibatch_of(config, n % 8, b=32, reward=np.ones(32, "<f4")))
    assert metrics.q_mean == pytest.approx(2.0, abs=0.1)


def test_same_minibatches_same_weights(preset, trainer_of, minibatch_of):
    first, second = trainer_of(preset), trainer_of(preset)
    for n in range(3):
        assert first.update(minibatch_of(preset, n)) == second.update(minibatch_of(preset, n))
    assert same(first, second)


def test_a_loaded_state_goes_on_bit_for_bit(preset, trainer_of, minibatch_of):
    config = build({"dqn.target_episodes": 5, "dqn.target_updates": 7}, preset)
    trainer, other = trainer_of(config), trainer_of(build({"training.seed": 99}, config))
    for n in range(8):
        trainer.update(minibatch_of(config, n, episodes=n))
    trainer.policy()
    other.load(trainer.state())
    assert same(trainer, other)
    for n in range(8, 16):
        assert trainer.update(minibatch_of(config, n, episodes=n)) == other.update(minibatch_of(config, n, episodes=n))
    assert same(trainer, other)


def test_a_state_is_a_copy(small, trainer_of, minibatch_of):
    trainer = trainer_of(small())
    before = trainer.state()
    held = {k: t.clone() for k, t in before.tensors.items()}
    trainer.update(minibatch_of(trainer.config))
    assert all(torch.equal(held[k], before.tensors[k]) for k in held)
    assert all(t.is_contiguous() for t in before.tensors.values())


def test_a_state_of_another_network_is_refused(small, trainer_of):
    trainer = trainer_of(small())
    before = trainer.state()
    with pytest.raises(ValueError, match="another network"):
        trainer.load(trainer_of(small({"network.dense": 9})).state())
    assert all(torch.equal(t, before.tensors[k]) for k, t in trainer.state().tensors.items())


def test_a_read_only_minibatch_off_the_wire_is_taken(small, trainer_of, minibatch_of):
    config = small()
    batch = minibatch_of(config)
    fields = {k: v for k, v in vars(batch).items() if isinstance(v, np.ndarray) and k != "observation"}
    frozen = {k: np.frombuffer(v.tobytes(), v.dtype).reshape(v.shape) for k, v in fields.items()}
    assert not frozen["reward"].flags.writeable
    assert trainer_of(config).update(minibatch_of(config, **frozen)) == trainer_of(config).update(batch)


@pytest.mark.parametrize(
    "wrong, text",
    [
        ({"observation": np.zeros((6, 3, 8, 9), "<f4")}, r"shape \(6, 3, 8, 9\), the network needs \(6, 3, 9, 9\)"),
        ({"reward": np.zeros(5, "<f4")}, "differ in length"),
        ({"discount": np.zeros(7, "<f4")}, "differ in length"),
        ({"allowed": np.ones((6, 8), "u1")}, "differ in length"),
        ({"action": np.full(6, 9, "u1")}, "an action 9"),
        ({"allowed": np.zeros((6, 9), "u1")}, "no allowed action"),
        ({"reward": np.full(6, 3e38, "<f4")}, "diverged.*lower dqn.learning_rate"),
    ],
)
def test_a_minibatch_that_does_not_fit_changes_nothing(small, trainer_of, minibatch_of, wrong, text):
    trainer, untouched = trainer_of(small()), trainer_of(small())
    with pytest.raises(TrainingError, match=text):
        trainer.update(minibatch_of(trainer.config, **wrong))
    assert same(trainer, untouched)


def test_an_empty_minibatch_is_refused(small, trainer_of, minibatch_of):
    with pytest.raises(TrainingError):
        trainer_of(small()).update(minibatch_of(small(), b=0))


def test_a_shape_that_the_settings_do_not_have_is_refused(paper):
    with pytest.raises(ValueError, match="do not fit"):
        Trainer(paper, (3, 30, 30), Grid(20, 30))


def test_each_policy_has_a_newer_version_and_says_what_it_is(small, trainer_of, minibatch_of):
    trainer = trainer_of(small())
    trainer.update(minibatch_of(trainer.config))
    versions = [trainer.policy(), trainer.policy()]
    trainer.version = 41  # the newest that the TMC knows
    versions.append(trainer.policy())
    assert [v for v, _ in versions] == [1, 2, 42]
    session = onnxruntime.InferenceSession(versions[-1][1], providers=["CPUExecutionProvider"])
    card = PolicyCard.from_json(session.get_modelmeta().custom_metadata_map[KEY])
    assert card == card_for(trainer.config, trainer.grid, 42, 1)


def test_metrics_are_plain_floats(small, trainer_of, minibatch_of):
    metrics = trainer_of(small()).update(minibatch_of(small()))
    assert all(type(v) is float and math.isfinite(v) for k, v in vars(metrics).items() if k != "updates")


@pytest.mark.parametrize("double", [False, True])
def test_values_that_are_kept_change_nothing(small, trainer_of, minibatch_of, double):
    """The gradients equal those with every value computed every time; theta- changes in between."""
    config = small({"dqn.target_episodes": 0, "dqn.target_updates": 10, "dqn.double": double})
    assert_exact_within_rounding(config, batches_with_repeats(minibatch_of, config, 60))


def passes(trainer, batches):
    """Count the rows that the target network computes in each update."""
    rows = []
    hook = trainer.target.register_forward_pre_hook(lambda _, inputs: rows.append(len(inputs[0])))
    counts = []
    for batch in batches:
        rows.clear()
        trainer.update(batch)
        counts.append(sum(rows))
    hook.remove()
    return counts


def test_a_value_is_computed_once_until_the_target_follows(small, trainer_of, minibatch_of):
    trainer = trainer_of(small({"dqn.target_episodes": 0, "dqn.target_updates": 3}))
    batch = minibatch_of(trainer.config)
    assert passes(trainer, [batch] * 7) == [6, 0, 0, 6, 0, 0, 6]


@pytest.mark.parametrize("lose", ["forget", "load"])
def test_nothing_is_known_of_transitions_that_are_numbered_again(small, trainer_of, minibatch_of, lose):
    """Afterwards the same numbers are other transitions: the update must be that of a trainer with an empty cache."""
    trainer, fresh = trainer_of(small()), trainer_of(small())
    old, new = minibatch_of(trainer.config, 1), minibatch_of(trainer.config, 2, index=minibatch_of(small(), 1).index)
    trainer.update(old)
    fresh.load(trainer.state())
    trainer.forget() if lose == "forget" else trainer.load(fresh.state())
    assert trainer.update(new) == fresh.update(new)
    assert same(trainer, fresh)


def test_two_transitions_with_one_place_are_distinguished(small, trainer_of, minibatch_of):
    config = small({"replay.capacity": 4, "replay.learn_start": 1, "dqn.target_episodes": 1000})
    assert_exact_within_rounding(config, batches_with_repeats(minibatch_of, config, 20))


def test_transitions_without_numbers_are_refused(small, trainer_of, minibatch_of):
    trainer, untouched = trainer_of(small()), trainer_of(small())
    for index in (np.zeros(5, "<i8"), np.full(6, -1, "<i8")):
        with pytest.raises(TrainingError, match="not numbered"):
            trainer.update(minibatch_of(trainer.config, index=index))
    assert same(trainer, untouched)


# Prioritised minibatches.


@pytest.mark.parametrize("threads", [1, 3])
def test_weights_count_as_in_the_plain_equations(preset, trainer_of, minibatch_of, threads):
    """The gradient is that of the mean of weight times loss, for any number of threads."""
    config = build({**flat(preset), "replay.priority_exponent": 0.6, "training.threads": threads})
    trainer = trainer_of(config)
    weight = np.array([1.0, 0.5, 0.1, 0.9, 0.3, 0.7], "<f4")
    batch = minibatch_of(config, weight=weight)
    exact, bound = rounding.gradient(config, trainer.online, trainer.target, batch)
    uneven, _ = rounding.gradient(config, trainer.online, trainer.target, replace(batch, weight=weight[::-1].copy()))
    t, q = reference.Tensors(batch), trainer.online(torch.tensor(batch.observation)).detach()
    y = dqn.target(
        t.reward * config.dqn.reward_scale, t.discount, trainer.target(t.o_next), t.allowed
    )  # theta- is theta
    losses = [w * dqn.loss(e[None], config.dqn.loss) for w, e in zip(weight, dqn.td_error(q, t.action, y), strict=True)]
    assert trainer.update(batch).loss == pytest.approx(float(sum(losses) / 6), rel=1e-5)
    found = reference.gradient(trainer.online).double()
    assert ((found - exact).abs() <= bound).all()
    assert ((found - uneven).abs() > bound).any(), "the bound tells nothing apart"


def test_weights_of_one_count_as_none(paper, trainer_of, minibatch_of):
    plain, weighted = trainer_of(paper), trainer_of(paper)
    for number in range(3):
        batch = minibatch_of(paper, number, b=16)
        weighted.load(plain.state())
        exact, bound = rounding.gradient(paper, plain.online, plain.target, batch)
        losses = plain.update(batch).loss, weighted.update(replace(batch, weight=np.ones(16, "<f4"))).loss
        assert losses[0] == pytest.approx(losses[1], rel=1e-5)
        for trainer in (plain, weighted):
            assert ((reference.gradient(trainer.online).double() - exact).abs() <= bound).all()


def test_the_errors_of_the_last_update_are_given_once(small, trainer_of, minibatch_of):
    trainer = trainer_of(small({"replay.priority_exponent": 0.6}))
    assert [x.size for x in trainer.take_td_errors()] == [0, 0]
    batch = minibatch_of(trainer.config)
    metrics = trainer.update(batch)
    index, errors = trainer.take_td_errors()
    assert index.tolist() == batch.index.tolist() and (index.dtype, errors.dtype) == (np.int64, np.float32)
    assert errors.shape == (6,) and errors.mean() == pytest.approx(metrics.td_abs) and (errors >= 0).all()
    assert [x.size for x in trainer.take_td_errors()] == [0, 0]
    trainer.update(batch)
    trainer.forget()  # the numbers start again
    assert [x.size for x in trainer.take_td_errors()] == [0, 0]


def test_without_priorities_no_errors_are_given(small, trainer_of, minibatch_of):
    trainer = trainer_of(small())
    trainer.update(minibatch_of(trainer.config))
    assert [x.size for x in trainer.take_td_errors()] == [0, 0]


def test_weights_that_do_not_fit_are_refused(small, trainer_of, minibatch_of):
    trainer = trainer_of(small())
    with pytest.raises(TrainingError, match="5 weights: it must have 6, or none"):
        trainer.update(minibatch_of(trainer.config, weight=np.ones(5, "<f4")))

"""The reward, eq. (13): its parts, what a blocked UAV gets, and the credit aligned with the team's objective."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmc.kernel.config import build
from tmc.kernel.reward import Block, RewardLaw
from tmc.kernel.uncertainty import UncertaintyLaw

QUICK = settings(max_examples=50, deadline=None)

Q = np.exp(-np.array([0.01, 0.1, 2.0]))
U = st.floats(0.0, 1.0)
INDEX = st.integers(-1, 2)


def test_the_papers_reward() -> None:
    """r = r^c + r^n + lambda r^u with -20, +1 and 5 (Sec. IV-B)."""
    reward = RewardLaw(build({}), Q)
    assert reward(False, True, 0, 0.5) == 1 + 5 * 0.5
    assert reward(False, False, 1, 0.25) == 5 * 0.25
    assert reward(False, True, -1, 0.0) == 1.0
    assert reward(False, False, -1, 0.0) == 0.0
    assert reward(True, False, 0, 0.0) == -20.0


@QUICK
@given(st.booleans(), INDEX, U)
def test_a_blocked_uav_gets_nothing_else(novel: bool, index: int, u: float) -> None:
    assert RewardLaw(build({}), Q)(True, novel, index, u) == -20.0


@QUICK
@given(U)
def test_cells_that_are_not_monitored_earn_no_uncertainty(u: float) -> None:
    """Index -1 must not be read as the last cell."""
    assert RewardLaw(build({}), Q)(False, False, -1, u) == 0.0


@QUICK
@given(st.booleans(), st.booleans(), INDEX, U, st.floats(-100, 100), st.floats(-100, 100), st.floats(-100, 100))
def test_settings_scale_each_part(
    blocked: bool, novel: bool, index: int, u: float, collision: float, new_cell: float, weight: float
) -> None:
    config = build({"reward.collision": collision, "reward.new_cell": new_cell, "reward.weight": weight})
    earned = new_cell * novel + (weight * u if index >= 0 else 0.0)
    assert RewardLaw(config, Q)(blocked, novel, index, u) == pytest.approx(collision if blocked else earned)


@QUICK
@given(st.booleans(), U)
def test_aligned_credit_is_u_over_one_minus_gamma_q(novel: bool, u: float) -> None:
    """Every cell has a factor of its own; novelty and collisions stay as they are."""
    reward = RewardLaw(build({"reward.aligned": True, "dqn.gamma": 0.95}), Q)
    for i, q in enumerate(Q):
        assert reward(False, novel, i, u) == pytest.approx(5 * u / (1 - 0.95 * q) + novel)
    assert reward(True, novel, 0, u) == -20.0


@pytest.mark.parametrize("alpha", [0.01, 0.3])
def test_aligned_credit_is_the_discounted_sum_that_a_visit_takes_away(alpha: float) -> None:
    """sum over s of gamma^s (u without the visit - u after it), s from the visit on."""
    gamma, ticks, age = 0.9, 400, 37
    law = UncertaintyLaw(np.array([alpha]), ticks + age)
    saved = sum(gamma**s * (law.value(0, 0, age + s) - law.value(0, age, age + s)) for s in range(ticks))
    reward = RewardLaw(build({"reward.aligned": True, "dqn.gamma": gamma, "reward.weight": 1.0}), law.q)
    assert reward(False, False, 0, law.value(0, 0, age)) == pytest.approx(saved)


def test_for_uniform_rates_the_papers_reward_is_the_aligned_one_up_to_a_factor() -> None:
    q = np.full(3, np.exp(-0.01))
    plain, aligned = RewardLaw(build({}), q), RewardLaw(build({"reward.aligned": True}), q)
    ratios = {aligned(False, False, i, u) / plain(False, False, i, u) for i in range(3) for u in (0.25, 0.5, 1.0)}
    assert len(ratios) == 1


def test_reasons_of_a_blocked_move_have_their_numbers_in_the_log() -> None:
    assert {b.name: b.value for b in Block} == {"NONE": 0, "GRID": 1, "OBSTACLE": 2, "UAV": 3}
    assert not Block.NONE

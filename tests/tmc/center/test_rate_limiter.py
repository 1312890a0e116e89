"""The limiter: neither side runs away from the other, and neither waits for ever."""

from __future__ import annotations

import copy

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmc.center.rate_limiter import Limiter


def test_nothing_is_owed_before_learning_starts() -> None:
    limiter = Limiter(1.0, 10, 128)
    limiter.insert(40, 120)
    assert (limiter.owed, limiter.may_insert, limiter.origin) == (0, True, None)
    limiter.insert(3, 129)
    assert (limiter.owed, limiter.origin) == (0, 43)
    limiter.insert(4, 141)
    assert limiter.owed == 4


def test_one_minibatch_a_tick_as_in_algorithm_1() -> None:
    limiter = Limiter(1.0, 200, 1)
    limiter.insert(1, 3)
    for tick in range(1, 50):
        limiter.insert(1, 3 * tick)
        assert limiter.owed == 1
        limiter.sample()
        assert limiter.owed == 0 and limiter.updates == tick


@pytest.mark.parametrize(("ratio", "slack"), [(1.0, 5), (0.25, 8), (4.0, 2), (0.01, 1)])
def test_inserts_are_held_back_beyond_the_slack_and_no_sooner(ratio: float, slack: int) -> None:
    limiter = Limiter(ratio, slack, 1)
    limiter.insert(1, 1)
    for ahead in range(1, 300):
        limiter.insert(1, 1)
        assert limiter.owed == int(ahead * ratio + 1e-9)
        assert limiter.may_insert == (limiter.owed <= slack * ratio)
    assert not limiter.may_insert
    while not limiter.may_insert:
        limiter.sample()
    assert limiter.owed == int(slack * ratio)


def test_a_minibatch_that_is_not_owed_is_refused() -> None:
    limiter = Limiter(1.0, 5, 1)
    before = copy.copy(limiter)
    with pytest.raises(ValueError, match="no minibatch is owed"):
        limiter.sample()
    assert limiter == before


def test_without_a_learner_nothing_is_sampled_and_nothing_held_back() -> None:
    limiter = Limiter(0.0, 1, 1)
    limiter.insert(1_000_000, 1_000_000)
    assert limiter.owed == 0 and limiter.may_insert


@given(
    ratio=st.floats(0.0, 8.0), slack=st.integers(1, 50), learn_start=st.integers(1, 40),
    what=st.lists(st.tuples(st.booleans(), st.integers(1, 12)), max_size=120),
)  # fmt: skip
def test_the_two_sides_stay_together_whatever_they_do(
    ratio: float, slack: int, learn_start: int, what: list[tuple[bool, int]]
) -> None:
    """Samples never exceed what is owed; whenever one side is held back the other may go on."""
    limiter, transitions, largest = Limiter(ratio, slack, learn_start), 0, 0
    for insert, ticks in what:
        if insert and limiter.may_insert:
            transitions, largest = transitions + ticks, max(largest, ticks)
            limiter.insert(ticks, transitions)
        elif not insert and limiter.owed:
            limiter.sample()
        assert limiter.may_insert or limiter.owed > 0
        if limiter.origin is None:
            assert transitions < learn_start and limiter.updates == 0
            continue
        since = limiter.ticks - limiter.origin
        assert limiter.updates <= since * ratio
        assert limiter.owed == int(since * ratio) - limiter.updates
        assert limiter.owed <= slack * ratio + largest * ratio + 1

"""The rate_limiter: neither side runs away from the other, and neither waits for ever."""

from __future__ import annotations

import copy

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tmc.center.rate_limiter import RateLimiter


def test_nothing_is_owed_before_learning_starts() -> None:
    rate_limiter = RateLimiter(1.0, 10, 128)
    rate_limiter.insert(40, 120)
    assert (rate_limiter.samples_due, rate_limiter.can_insert, rate_limiter.origin) == (0, True, None)
    rate_limiter.insert(3, 129)
    assert (rate_limiter.samples_due, rate_limiter.origin) == (0, 43)
    rate_limiter.insert(4, 141)
    assert rate_limiter.samples_due == 4


def test_one_minibatch_a_tick_as_in_algorithm_1() -> None:
    rate_limiter = RateLimiter(1.0, 200, 1)
    rate_limiter.insert(1, 3)
    for tick in range(1, 50):
        rate_limiter.insert(1, 3 * tick)
        assert rate_limiter.samples_due == 1
        rate_limiter.sample()
        assert rate_limiter.samples_due == 0 and rate_limiter.updates == tick


@pytest.mark.parametrize(("ratio", "error_buffer"), [(1.0, 5), (0.25, 8), (4.0, 2), (0.01, 1)])
def test_inserts_are_held_back_beyond_the_slack_and_no_sooner(ratio: float, error_buffer: int) -> None:
    rate_limiter = RateLimiter(ratio, error_buffer, 1)
    rate_limiter.insert(1, 1)
    for ahead in range(1, 300):
        rate_limiter.insert(1, 1)
        assert rate_limiter.samples_due == int(ahead * ratio + 1e-9)
        assert rate_limiter.can_insert == (rate_limiter.samples_due <= error_buffer * ratio)
    assert not rate_limiter.can_insert
    while not rate_limiter.can_insert:
        rate_limiter.sample()
    assert rate_limiter.samples_due == int(error_buffer * ratio)


def test_a_minibatch_that_is_not_due_is_refused() -> None:
    rate_limiter = RateLimiter(1.0, 5, 1)
    before = copy.copy(rate_limiter)
    with pytest.raises(ValueError, match="no minibatch is due"):
        rate_limiter.sample()
    assert rate_limiter == before


def test_without_a_learner_nothing_is_sampled_and_nothing_held_back() -> None:
    rate_limiter = RateLimiter(0.0, 1, 1)
    rate_limiter.insert(1_000_000, 1_000_000)
    assert rate_limiter.samples_due == 0 and rate_limiter.can_insert


@given(
    ratio=st.floats(0.0, 8.0), error_buffer=st.integers(1, 50), learn_start=st.integers(1, 40),
    what=st.lists(st.tuples(st.booleans(), st.integers(1, 12)), max_size=120),
)  # fmt: skip
def test_the_two_sides_stay_together_whatever_they_do(
    ratio: float, error_buffer: int, learn_start: int, what: list[tuple[bool, int]]
) -> None:
    """Samples never exceed what is due; whenever one side is held back the other may go on."""
    rate_limiter, transitions, largest = RateLimiter(ratio, error_buffer, learn_start), 0, 0
    for insert, ticks in what:
        if insert and rate_limiter.can_insert:
            transitions, largest = transitions + ticks, max(largest, ticks)
            rate_limiter.insert(ticks, transitions)
        elif not insert and rate_limiter.samples_due:
            rate_limiter.sample()
        assert rate_limiter.can_insert or rate_limiter.samples_due > 0
        if rate_limiter.origin is None:
            assert transitions < learn_start and rate_limiter.updates == 0
            continue
        since = rate_limiter.ticks - rate_limiter.origin
        assert rate_limiter.updates <= since * ratio
        assert rate_limiter.samples_due == int(since * ratio) - rate_limiter.updates
        assert rate_limiter.samples_due <= error_buffer * ratio + largest * ratio + 1

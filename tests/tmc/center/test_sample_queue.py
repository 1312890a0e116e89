"""The TMC's side of the learner: requests are answered as far as minibatches are due, and never to a stranger."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest

from tmc.center.priorities import EPSILON
from tmc.center.rate_limiter import RateLimiter
from tmc.center.sample_queue import WINDOW, SampleQueue
from tmc.kernel.roadmap import RoadMap
from tmc.wire.messages import Hello, SampleRequest

VALUES = {"training.ticks": 20, "training.episodes": 1, "team.size": 3, "replay.learn_start": 1}


def feed_of(mission: Callable[..., Any], town: RoadMap, values: dict[str, Any] = VALUES) -> SampleQueue:
    """The sample_queue of a TMC that was just started and holds transitions, as after a recovery."""
    replay = mission(values, town).play(Random(1)).station.replay
    rate_limiter = RateLimiter(1.0, 5, 1)
    rate_limiter.insert(1, len(replay))
    rate_limiter.insert(10, len(replay))
    return SampleQueue(replay, rate_limiter, 4)


def test_nothing_goes_to_a_learner_that_was_not_welcomed(mission: Callable[..., Any], town: RoadMap) -> None:
    """A request that waited for a TMC to come back: the learner must first hear that the numbers may begin again."""
    sample_queue = feed_of(mission, town)
    assert sample_queue.ask(SampleRequest(1)) is None and list(sample_queue.serve(0, 0)) == []
    sample_queue.welcome(Hello("learner", -1, 9))
    assert list(sample_queue.serve(0, 0)) == []  # it asks again
    assert sample_queue.ask(SampleRequest(2)) is None
    (minibatch,) = sample_queue.serve(1, 20)
    assert (minibatch.request, minibatch.episodes, minibatch.ticks) == (2, 0, 20)
    s = sample_queue.replay.sample(0, 4)
    assert np.array_equal(minibatch.index, s.index) and np.array_equal(minibatch.u, s.views.u)
    assert minibatch.weight.size == 0  # all have the same weight


def test_only_so_many_requests_are_taken(mission: Callable[..., Any], town: RoadMap) -> None:
    sample_queue = feed_of(mission, town)
    assert [sample_queue.ask(SampleRequest(n)) is None for n in range(WINDOW + 1)] == [True] * WINDOW + [False]


def test_a_learner_that_makes_up_for_what_it_lost_hears_of_the_episodes_in_their_turn(
    mission: Callable[..., Any], town: RoadMap
) -> None:
    """Or theta- would not follow until it is done: the team waits for it, and no episode ends meanwhile."""
    sample_queue = feed_of(mission, town)
    sample_queue.rate_limiter.insert(4 * 20 - sample_queue.rate_limiter.ticks, 60)
    sample_queue.welcome(Hello("learner", -1, 9))
    told = []
    while sample_queue.rate_limiter.samples_due:
        assert sample_queue.ask(SampleRequest(len(told))) is None
        told += [minibatch.episodes for minibatch in sample_queue.serve(4, 80)]
    assert told == [tick // 20 for tick in range(2, 81)]  # learning started after the first tick


PRIORITISED = {**VALUES, "team.controller": "policy", "replay.priority_exponent": 0.5}


def request_with_errors(request: int, index: list[int], errors: list[float]) -> SampleRequest:
    return SampleRequest(request, np.array(index, "<i8"), np.array(errors, "<f4"))


def test_errors_become_priorities_once_the_learner_is_welcome(mission: Callable[..., Any], town: RoadMap) -> None:
    """Before, it may mean the transitions of a TMC that was killed."""
    sample_queue = feed_of(mission, town, PRIORITISED)
    priorities = sample_queue.replay.priorities
    assert priorities is not None
    before = priorities.mass(np.arange(60)).tolist()
    assert sample_queue.ask(request_with_errors(1, [7, 8], [25.0, 0.0])) is None
    assert priorities.mass(np.arange(60)).tolist() == before
    sample_queue.welcome(Hello("learner", -1, 9))
    assert sample_queue.ask(request_with_errors(2, [7, 8, 9999], [25.0, 0.0, 1.0])) is None  # the last one is not held
    after = priorities.mass(np.arange(60))
    assert after[[7, 8]] == pytest.approx([(25 + EPSILON) ** 0.5, EPSILON**0.5])
    assert np.delete(after, [7, 8]).tolist() == np.delete(before, [7, 8]).tolist()
    (minibatch,) = sample_queue.serve(1, 20)
    assert minibatch.weight == pytest.approx((after[minibatch.index] / after[minibatch.index].min()) ** -0.4)


@pytest.mark.parametrize(
    ("index", "errors"), [([1], []), ([1, 2], [0.5]), ([1, -2], [0.5, 0.5]), ([1, 2], [0.5, -0.5])]
)
def test_errors_that_cannot_be_change_nothing(
    mission: Callable[..., Any], town: RoadMap, index: list[int], errors: list[float]
) -> None:
    sample_queue = feed_of(mission, town, PRIORITISED)
    sample_queue.welcome(Hello("learner", -1, 9))
    assert sample_queue.replay.priorities is not None
    before = sample_queue.replay.priorities.mass(np.arange(60)).tolist()
    assert "an error for each transition" in str(sample_queue.ask(request_with_errors(1, index, errors)))
    assert sample_queue.replay.priorities.mass(np.arange(60)).tolist() == before
    assert list(sample_queue.serve(1, 20)) == []  # nor is it taken for a request


def test_errors_are_refused_where_nobody_asked_for_them(mission: Callable[..., Any], town: RoadMap) -> None:
    sample_queue = feed_of(mission, town)
    sample_queue.welcome(Hello("learner", -1, 9))
    assert "replay.priority_exponent is 0" in str(sample_queue.ask(request_with_errors(1, [1], [0.5])))

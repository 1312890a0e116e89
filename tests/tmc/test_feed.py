"""The TMC's side of the learner: requests are answered as far as minibatches are owed, and never to a stranger."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

from tmc.feed import WINDOW, Feed
from tmc.kernel.roadmap import RoadMap
from tmc.limiter import Limiter
from tmc.wire.messages import Hello

VALUES = {"training.ticks": 20, "training.episodes": 1, "team.size": 3, "replay.learn_start": 1}


def feed_of(mission: Callable[..., Any], town: RoadMap) -> Feed:
    """The feed of a TMC that was just started and holds transitions, as after a recovery."""
    replay = mission(VALUES, town).play(Random(1)).station.replay
    limiter = Limiter(1.0, 5, 1)
    limiter.insert(1, len(replay))
    limiter.insert(10, len(replay))
    return Feed(replay, limiter, 4)


def test_nothing_goes_to_a_learner_that_was_not_welcomed(mission: Callable[..., Any], town: RoadMap) -> None:
    """A request that waited for a TMC to come back: the learner must first hear that numbers may begin anew."""
    feed = feed_of(mission, town)
    assert feed.ask(1) and list(feed.serve(0, 0)) == []
    feed.welcome(Hello("learner", -1, 9))
    assert list(feed.serve(0, 0)) == []  # it asks again
    assert feed.ask(2)
    (minibatch,) = feed.serve(1, 20)
    assert (minibatch.request, minibatch.episodes, minibatch.ticks) == (2, 1, 20)
    s = feed.replay.sample(0, 4)
    assert np.array_equal(minibatch.index, s.index) and np.array_equal(minibatch.u, s.views.u)


def test_only_so_many_requests_are_taken(mission: Callable[..., Any], town: RoadMap) -> None:
    feed = feed_of(mission, town)
    assert [feed.ask(n) for n in range(WINDOW + 1)] == [True] * WINDOW + [False]

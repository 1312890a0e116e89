"""The learner's requests for minibatches, answered as far as the rate limiter allows."""

from __future__ import annotations

from collections.abc import Iterator

from tmc.center.rate_limiter import RateLimiter
from tmc.center.replay import Replay
from tmc.wire.messages import Hello, Minibatch, SampleRequest

WINDOW = 8
"""Largest number of requests in flight."""
REPLACED = ("fenced", "a newer process is the learner: leave")


class SampleQueue:
    """Hold requests in the order of their arrival.

    `incarnation`: of the learner's process, -1 before there is one; `former`: those that it replaced, which may still
    send.
    """

    def __init__(self, replay: Replay, limiter: RateLimiter, batch: int) -> None:
        self.replay, self.rate_limiter, self.batch = replay, limiter, batch
        self._T = replay.world.config.training.ticks
        self.incarnation, self.former = -1, set[int]()
        self.told_the_end = self.recovered = False
        self._requests: list[int] = []

    def welcome(self, hello: Hello) -> None:
        """Register a learner. Updates that it lost by restarting from an older checkpoint become available again."""
        self._requests.clear()  # it asks again once it is welcome
        self.told_the_end = False  # or it would not have said hello
        if hello.incarnation != self.incarnation:
            self.former |= {self.incarnation} - {-1}
            self.incarnation = hello.incarnation
            # A restarted TMC knows how far the learner was a moment ago; the learner knows how far it is now.
            known = hello.updates if self.recovered else self.rate_limiter.updates
            self.rate_limiter.updates = min(known, hello.updates)
            self.recovered = False

    def ask(self, request: SampleRequest) -> str | None:
        """Queue a request and take its errors as priorities; or return what is wrong with it, and change nothing."""
        if len(self._requests) >= WINDOW:
            return f"more than {WINDOW} minibatch requests in flight"
        index, errors, priorities = request.index, request.errors, self.replay.priorities
        if index.size != errors.size or (errors < 0.0).any() or (index < 0).any():
            return "a minibatch request has an error for each transition, and neither errors nor numbers below 0"
        if index.size and priorities is None:
            return "a minibatch request has errors, but replay.priority_exponent is 0"
        if priorities is not None and self.incarnation >= 0:  # before its Welcome, a learner may mean other transitions
            priorities.set(index, errors)
        self._requests.append(request.request)
        return None

    def serve(self, episodes: int, ticks: int) -> Iterator[Minibatch]:
        """Yield a minibatch for each request that the rate limiter lets through; none before the learner's Welcome.

        A minibatch says how many episodes were finished at its tick. theta- follows by that count, also while the
        learner repeats the updates that it lost. A restarted TMC may number its transitions differently, which the
        learner must hear first.
        """
        while self.incarnation >= 0 and self._requests and self.rate_limiter.samples_due and len(self.replay):
            s, finished = self.replay.sample(self.rate_limiter.updates, self.batch), self.rate_limiter.due // self._T
            self.rate_limiter.sample()
            yield Minibatch(
                request=self._requests.pop(0), episodes=min(finished, episodes), ticks=ticks, cells=s.views.cells,
                peers=s.views.peers, u=s.views.u, action=s.action, reward=s.reward, discount=s.discount,
                allowed=s.allowed, index=s.index, weight=s.weight,
            )  # fmt: skip

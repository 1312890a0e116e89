"""The learner's side of the TMC: its requests for minibatches, answered as far as the limiter allows."""

from __future__ import annotations

from collections.abc import Iterator

from tmc.center.rate_limiter import RateLimiter
from tmc.center.replay import Replay
from tmc.wire.messages import Hello, Minibatch, SampleRequest

WINDOW = 8
"""Most requests that may be in episode."""
REPLACED = ("fenced", "a newer process is the learner: leave")


class SampleQueue:
    """Requests in the order of their arrival.

    `incarnation`: the learner's process, -1 before there is one; `former`: those whose place it took, which may still
    speak.
    """

    def __init__(self, replay: Replay, limiter: RateLimiter, batch: int) -> None:
        self.replay, self.rate_limiter, self.batch = replay, limiter, batch
        self._T = replay.world.config.training.ticks
        self.incarnation, self.former = -1, set[int]()
        self.told_the_end = self.recovered = False
        self._requests: list[int] = []

    def welcome(self, hello: Hello) -> None:
        """A learner is here, perhaps back from an older checkpoint: what it lost since is owed to it again."""
        self._requests.clear()  # it asks again once it is welcome
        self.told_the_end = False  # or it would not have said hello
        if hello.incarnation != self.incarnation:
            self.former |= {self.incarnation} - {-1}
            self.incarnation = hello.incarnation
            # A TMC that was started again knows how far the learner was a moment ago; the learner knows how far it is.
            self.rate_limiter.updates = (
                hello.updates if self.recovered else min(self.rate_limiter.updates, hello.updates)
            )
            self.recovered = False

    def ask(self, request: SampleRequest) -> str | None:
        """Take a request and the errors that come with it; or say what is wrong with it, and change nothing."""
        if len(self._requests) >= WINDOW:
            return f"more than {WINDOW} minibatch requests in flight"
        index, errors, priorities = request.index, request.errors, self.replay.priorities
        if index.size != errors.size or (errors < 0.0).any() or (index < 0).any():
            return "a minibatch request has an error for each transition, and neither errors nor numbers below 0"
        if index.size and priorities is None:
            return "a minibatch request has errors, but replay.priority_exponent is 0"
        if (
            priorities is not None and self.incarnation >= 0
        ):  # before it is welcome, a learner may mean other transitions
            priorities.set(index, errors)
        self._requests.append(request.request)
        return None

    def serve(self, episodes: int, ticks: int) -> Iterator[Minibatch]:
        """A minibatch for each request for which one is owed; none before the learner was welcomed.

        It says how many episodes were finished at its tick: by that count theta- follows, also where the learner makes
        up for what it lost while the team waits.

        A TMC that was started again may number its transitions anew, which a learner must hear first.
        """
        while self.incarnation >= 0 and self._requests and self.rate_limiter.samples_due and len(self.replay):
            s, finished = self.replay.sample(self.rate_limiter.updates, self.batch), self.rate_limiter.due // self._T
            self.rate_limiter.sample()
            yield Minibatch(
                self._requests.pop(0), min(finished, episodes), ticks, s.views.cells, s.views.peers, s.views.u,
                s.action, s.reward, s.discount, s.allowed, s.index, s.weight,
            )  # fmt: skip

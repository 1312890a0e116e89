"""The sample-to-insert limiter: Algorithm 1 draws one minibatch a tick, so neither side may run away from the other."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class RateLimiter:
    """Counts ticks of the team (inserts) and minibatches (samples) since learning could start.

    `ratio` minibatches are owed a tick. Samples never exceed what is owed; inserts are held back while more than
    `slack * ratio` are owed and not drawn. With `ratio` 0 nothing is ever sampled and nothing held back.
    """

    ratio: float
    slack: int
    learn_start: int
    ticks: int = 0
    updates: int = 0
    origin: int | None = None

    def insert(self, ticks: int, transitions: int) -> None:
        """`ticks` more ticks were flown, and the replay now holds `transitions`."""
        self.ticks += ticks
        if self.origin is None and transitions >= self.learn_start:
            self.origin = self.ticks

    @property
    def samples_due(self) -> int:
        """Minibatches that may be drawn now."""
        if self.origin is None:
            return 0
        return max(0, int((self.ticks - self.origin) * self.ratio) - self.updates)

    @property
    def due(self) -> int:
        """The tick, counted as `ticks`, from which on the next minibatch is owed."""
        return (self.origin or 0) + math.ceil((self.updates + 1) / self.ratio)

    @property
    def can_insert(self) -> bool:
        """False while the learner is so far behind that the UAVs must wait for it."""
        return self.samples_due <= self.slack * self.ratio

    def sample(self) -> None:
        """A minibatch was drawn; asking for one that is not owed is a mistake of the caller."""
        if self.samples_due < 1:
            raise ValueError("no minibatch is owed: the learner must wait for the UAVs")
        self.updates += 1

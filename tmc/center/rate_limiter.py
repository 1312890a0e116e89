"""The sample-to-insert rate limiter: Algorithm 1 draws one minibatch per tick, so neither side may run far ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass
class RateLimiter:
    """Count ticks of the team (inserts) and minibatches (samples) since learning could start.

    `ratio` samples become due per tick. Samples never exceed those due; inserts are held back while more than
    `error_buffer * ratio` samples are due. With `ratio` 0 nothing is ever sampled and nothing is held back.
    """

    ratio: float
    error_buffer: int
    learn_start: int
    ticks: int = 0
    updates: int = 0
    origin: int | None = None

    def insert(self, ticks: int, transitions: int) -> None:
        """Note that `ticks` more ticks were flown, and that the replay now holds `transitions`."""
        self.ticks += ticks
        if self.origin is None and transitions >= self.learn_start:
            self.origin = self.ticks

    @property
    def samples_due(self) -> int:
        """Return how many minibatches may be drawn now."""
        if self.origin is None:
            return 0
        return max(0, int((self.ticks - self.origin) * self.ratio) - self.updates)

    @property
    def due(self) -> int:
        """Return the tick, counted as `ticks`, from which on the next minibatch is due."""
        return (self.origin or 0) + math.ceil((self.updates + 1) / self.ratio)

    @property
    def can_insert(self) -> bool:
        """False while the learner is so far behind that the UAVs must wait for it."""
        return self.samples_due <= self.error_buffer * self.ratio

    def sample(self) -> None:
        """Note that a minibatch was drawn. Raises ValueError if none was due: a mistake of the caller."""
        if self.samples_due < 1:
            raise ValueError("no minibatch is due: the learner must wait for the UAVs")
        self.updates += 1

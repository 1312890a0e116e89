"""The claim on the learner's results, as one assertion: each gradient is the exact one, within rounding."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from learner import reference
from learner.batching import Batch
from tmc.kernel.config import Config


def assert_exact_within_rounding(config: Config, batches: Iterable[Batch]) -> None:
    """No weight's gradient is farther from the exact one of eq. (9) than float32 can take it, in none of these updates.

    How far that is follows from float32's eps, the numbers of terms and the sizes of the numbers, and holds for sums in
    any order, on any processor and any number of threads: `learner.rounding` says how. So the statement cannot fail
    where only the machine differs. A learner that computes something else is some hundred times outside:
    test_rounding.py asks this of learners that are wrong on purpose.
    """
    found = reference.departures(config, batches)
    assert found.of_bound <= 1, f"{found.of_bound:g} times what rounding can do"


def batches_with_repeats(
    minibatch_of: Callable[..., Batch], config: Config, count: int, **fields: Any
) -> Iterator[Batch]:
    """Return minibatches in which most transitions recur, in other combinations, as from a replay memory."""
    pool, rng = minibatch_of(config, 77, b=24, **fields), np.random.Generator(np.random.Philox(5))
    names = [name for name, value in vars(pool).items() if isinstance(value, np.ndarray) and value.size]
    for number in range(count):
        rows = rng.integers(0, 24, 16)
        again = {name: getattr(pool, name)[rows] for name in names}
        yield minibatch_of(config, number, b=16, **again, next_observation=pool.next_observation(rows))

"""The result of an invariant for an episode: the number of facts compared, and the first violation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmc.analysis.invariants.episode_log import EpisodeLog


@dataclass(frozen=True)
class Violation:
    """A fact that violates an invariant. `episode`, `tick`, `uav`: its position; None where one does not apply."""

    episode: int | None
    tick: int | None
    uav: int | None
    what: str

    def __str__(self) -> str:
        where = (("episode", self.episode), ("tick", self.tick), ("UAV", self.uav))
        named = ", ".join(f"{name} {value}" for name, value in where if value is not None)
        return f"{named}: {self.what}" if named else self.what


@dataclass(frozen=True)
class InvariantResult:
    """The number of facts compared, and the first violation among them."""

    facts: int
    violation: Violation | None = None


def first_violation(e: EpisodeLog, facts: int, faults: Iterable[tuple[int | None, int | None, str]]) -> InvariantResult:
    """Return the result with the first of the faults (tick, UAV, what), by tick."""
    first = min(faults, key=lambda f: (f[0] is not None, f[0] or 0, f[1] or 0), default=None)
    return InvariantResult(facts, Violation(e.number, *first) if first else None)


def where_first(bad: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (tick, UAV) of each true entry at the first tick that has one; `bad` is by tick and UAV."""
    ticks = np.flatnonzero(bad.any(axis=1))
    return [(int(ticks[0]), int(i)) for i in np.flatnonzero(bad[ticks[0]])] if ticks.size else []


def close(a: Any, b: Any, tolerance: float) -> NDArray[np.bool_]:
    """Return where |a - b| <= tolerance * max(1, |b|); False for NaN."""
    return np.asarray(np.abs(np.subtract(a, b)) <= tolerance * np.maximum(1.0, np.abs(b)))

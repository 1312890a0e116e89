"""Refuses a bench that would never finish, or does not fit this machine; before it starts where possible.

The times are those of a machine several times as fast as any that was measured, so nothing possible is refused.
"""

from __future__ import annotations

import math
import os
import time

from tmc.kernel.config import ConfigError
from tmc.kernel.world import World

MAX_BENCH_S = 86_400.0
"""Longest time (s) of a bench: a day."""
TRAINING_TICK_S = 1e-4
"""Least time (s) of a tick with learning."""
UAV_STEP_S = 1e-5
"""Least time (s) of a UAV step."""
TRANSITION_BYTES = 45
"""Least size of a transition in the replay memory."""
PACE_WINDOW_S = 10.0
"""Time (s) after which a pace counts as measured."""


def number(option: str, value: float, least: float, each: float = 0.0) -> None:
    """Raise ConfigError unless the number of an option is at least `least`, and a day's work at `each` s per piece."""
    if not (math.isfinite(value) and value >= least):
        raise ConfigError(f"{option} must be {least:g} or more")
    if value * each > MAX_BENCH_S:
        most = MAX_BENCH_S / each
        raise ConfigError(
            f"{option} {value:,g} would take {span(value * each)} at least: choose {max(math.floor(most), 1):,} or less"
        )


def stretches(repeats: int, seconds: float, count: int) -> None:
    """Check `--repeats` and `--seconds` of a bench that measures `count` stretches per repeat. Raises ConfigError."""
    if not (math.isfinite(seconds) and seconds > 0):
        raise ConfigError("--seconds must be more than 0")
    number("--seconds", seconds, 0.0, count)
    number("--repeats", repeats, 1, count * seconds)


def missions(world: World, repeats: int = 1) -> None:
    """Raise ConfigError if a mission, flown `repeats` times, would take more than a day."""
    training = world.config.training
    steps = world.config.team.size * training.ticks * training.episodes
    taken = steps * repeats * UAV_STEP_S
    if taken > MAX_BENCH_S:
        fewer = "choose fewer --episodes, --ticks or --repeats"
        raise ConfigError(f"{steps * repeats:,} UAV steps would take {span(taken)} at least: {fewer}")


def memory(world: World) -> None:
    """Raise ConfigError if this machine cannot hold the replay memory."""
    capacity, available = world.config.replay.capacity, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if capacity * TRANSITION_BYTES > available:
        needs = f"replay.capacity = {capacity:,} takes {capacity * TRANSITION_BYTES / 1e9:,.0f} GB at least"
        has = f"this machine has {available / 1e9:,.0f} GB"
        raise ConfigError(f"{needs}, and {has}: choose less than {available // TRANSITION_BYTES:,}")


def training(world: World, updates: int) -> None:
    """Raise ConfigError if a training would not reach `updates` within a day, or never."""
    memory(world)
    replay, team = world.config.replay, world.config.team.size
    if not replay.updates_per_tick:
        raise ConfigError("replay.updates_per_tick = 0 makes no update, so there is nothing to measure: set it to 1")
    taken = (replay.learn_start / team + updates / replay.updates_per_tick) * TRAINING_TICK_S
    if taken > MAX_BENCH_S:
        fewer = "choose a smaller replay.capacity or replay.learn_start, or more replay.updates_per_tick"
        raise ConfigError(f"{updates:,} updates would take {span(taken)} at least: {fewer}")


def span(seconds: float) -> str:
    """Return a duration in words: hours, days or years."""
    days = seconds / 86_400
    if days < 2:
        return f"{seconds / 3600:,.0f} hours"
    return f"{days:,.0f} days" if days < 730 else f"{days / 365:,.0f} years"


class Pace:
    """Measures how fast something reaches its `goal`; `what` names it in errors, such as an option."""

    def __init__(self, what: str, goal: int) -> None:
        self.what, self.goal = what, goal
        self._since: tuple[float, int] | None = None

    def check(self, done: int, now: float | None = None) -> None:
        """Note how much is done. Raises ConfigError once the pace shows that the rest would take more than a day."""
        now = time.monotonic() if now is None else now
        if self._since is None:
            self._since = now, done
        taken, made = now - self._since[0], done - self._since[1]
        if taken < PACE_WINDOW_S:
            return
        left = (self.goal - done) / (made / taken) if made > 0 else math.inf
        if left > MAX_BENCH_S and made > 0:
            raise ConfigError(
                f"{self.what} {self.goal:,} would take {span(left)} at the pace here, {made / taken:,.0f} per second: "
                f"choose {math.floor(done + MAX_BENCH_S * made / taken):,} or less"
            )

"""Refuses what a bench would never finish, or this machine not hold: before it starts where that can be told.

Seconds are those of a machine several times as fast as any that was seen, so nothing that is possible is refused.
"""

from __future__ import annotations

import math
import os
import time

from tmc.kernel.config import ConfigError
from tmc.kernel.world import World

LONGEST = 86_400.0
"""Seconds that a bench may take: a day."""
TICK = 1e-4
"""Seconds of a tick in which is learned."""
STEP = 1e-5
"""Seconds of a UAV step."""
TRANSITION = 45
"""Bytes of a transition in the replay memory, at least."""
SOON = 10.0
"""Seconds after which the pace of something is known."""


def number(option: str, value: float, least: float, each: float = 0.0) -> None:
    """Check the number of an option: at least `least`, and no more than a day's work at `each` seconds a piece."""
    if not (math.isfinite(value) and value >= least):
        raise ConfigError(f"{option} must be {least:g} or more")
    if value * each > LONGEST:
        most = LONGEST / each
        raise ConfigError(
            f"{option} {value:,g} would take {span(value * each)} at least: choose {max(math.floor(most), 1):,} or less"
        )


def stretches(repeats: int, seconds: float, count: int) -> None:
    """Check `--repeats` and `--seconds` of a bench that measures `count` stretches a repeat."""
    if not (math.isfinite(seconds) and seconds > 0):
        raise ConfigError("--seconds must be more than 0")
    number("--seconds", seconds, 0.0, count)
    number("--repeats", repeats, 1, count * seconds)


def missions(world: World, repeats: int = 1) -> None:
    """Check that a mission, flown so often, comes to its end."""
    training = world.config.training
    steps = world.config.team.size * training.ticks * training.episodes
    taken = steps * repeats * STEP
    if taken > LONGEST:
        fewer = "choose fewer --episodes, --ticks or --repeats"
        raise ConfigError(f"{steps * repeats:,} UAV steps would take {span(taken)} at least: {fewer}")


def memory(world: World) -> None:
    """Check that this machine could hold the replay memory."""
    capacity, there = world.config.replay.capacity, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if capacity * TRANSITION > there:
        needs = f"replay.capacity = {capacity:,} takes {capacity * TRANSITION / 1e9:,.0f} GB at least"
        has = f"this machine has {there / 1e9:,.0f} GB"
        raise ConfigError(f"{needs}, and {has}: choose less than {there // TRANSITION:,}")


def training(world: World, updates: int) -> None:
    """Check that a training comes to so many updates."""
    memory(world)
    replay, team = world.config.replay, world.config.team.size
    if not replay.updates_per_tick:
        raise ConfigError("replay.updates_per_tick = 0 makes no update, so there is nothing to measure: set it to 1")
    taken = (replay.learn_start / team + updates / replay.updates_per_tick) * TICK
    if taken > LONGEST:
        fewer = "choose a smaller replay.capacity or replay.learn_start, or more replay.updates_per_tick"
        raise ConfigError(f"{updates:,} updates would take {span(taken)} at least: {fewer}")


def span(seconds: float) -> str:
    """In words: hours, days or years."""
    days = seconds / 86_400
    if days < 2:
        return f"{seconds / 3600:,.0f} hours"
    return f"{days:,.0f} days" if days < 730 else f"{days / 365:,.0f} years"


class Pace:
    """How fast something comes to its `goal`, which is said by `what`, such as an option."""

    def __init__(self, what: str, goal: int) -> None:
        self.what, self.goal = what, goal
        self._since: tuple[float, int] | None = None

    def check(self, done: int, now: float | None = None) -> None:
        """Take how much is done; ConfigError once it is known that the rest would take more than a day."""
        now = time.monotonic() if now is None else now
        if self._since is None:
            self._since = now, done
        taken, made = now - self._since[0], done - self._since[1]
        if taken < SOON:
            return
        left = (self.goal - done) / (made / taken) if made > 0 else math.inf
        if left > LONGEST and made > 0:
            raise ConfigError(
                f"{self.what} {self.goal:,} would take {span(left)} at the pace here, {made / taken:,.0f} a second: "
                f"choose {math.floor(done + LONGEST * made / taken):,} or less"
            )

"""Flies the same mission as processes and in lock step, and compares every fact of the two."""

from __future__ import annotations

import itertools
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.run.mission import Mission, bound_of, check, command_line
from deploy.run.progress import Progress
from tmc.kernel.config import Config, build
from tmc.kernel.world import World
from tmc.record import compare
from tmc.wire import messages as m
from tmc.wire import process

PROCESSES, LOCKSTEP = "processes", "lockstep"
"""Names of the two run folders."""
STALLS: dict[str, Any] = {"trial.stall": 0.005, "trial.stall_share": 0.02, "trial.stall_spread": 1.0}
"""Random stalls: each UAV at one tick in fifty, for up to 10 ms, in which the others fly some dozens of ticks."""


class MissionAborted(Exception):  # noqa: N818  the sentence for the user; the mission has printed the reason
    """A mission ended early."""


class NotesOnly(Progress):
    """Prints the notes of a mission, but no progress."""

    def show(self, status: m.Status) -> None: ...


@dataclass(frozen=True)
class Outcome:
    """The result of comparing two flights of one mission: facts in each, moves flown, wall time (s)."""

    facts: int
    steps: int
    seconds: float
    difference: compare.Difference | None


def combinations(
    base: Mapping[str, Any], actors: list[int], scenarios: list[int], periods: list[int], phases: list[str], seeds: int
) -> list[Config]:
    """Return the config of every combination, each exchange schedule once: scenario I and T_u = 1 have no phases."""
    found: dict[tuple[Any, ...], Config] = {}
    for n, scenario, period, phase in itertools.product(actors, scenarios, periods, phases):
        values = {"team.size": n, "scenario": scenario, "comms.period": period, "comms.phase": phase}
        config = build({**base, **values})
        schedule = (n, scenario, config.T_u, tuple(config.phase(i) for i in range(n)))
        found.setdefault(schedule, config)
    first = build(base).training.seed
    return [build({"training.seed": first + s}, config) for config in found.values() for s in range(seeds)]


def verify(config: Config, policy: bytes | None, folder: Path) -> Outcome:
    """Fly a mission both ways in `folder`, which is removed if there is no difference. Raises MissionAborted."""
    start = time.perf_counter()
    facts, reference = fly_both(config, policy, folder)
    difference = compare.first_difference(facts, reference)
    if difference is None:
        shutil.rmtree(folder)
    return Outcome(len(reference), compare.moves(reference), time.perf_counter() - start, difference)


def fly_both(config: Config, policy: bytes | None, folder: Path) -> tuple[compare.Facts, compare.Facts]:
    """Return the facts of a mission flown as processes, and of the same in lock step; the logs stay in `folder`.

    Raises MissionAborted. Removes `folder` if the user stops the mission.
    """
    world = check(build({"trial.observation_hash": True}, config), policy)
    try:
        for name in (PROCESSES, LOCKSTEP):
            fly(world, policy, folder / name, in_one_process=name == LOCKSTEP)
    except KeyboardInterrupt:
        shutil.rmtree(folder)
        raise
    return compare.facts_of(folder / PROCESSES), compare.facts_of(folder / LOCKSTEP)


def fly(world: World, policy: bytes | None, out: Path, *, in_one_process: bool) -> None:
    """Fly one mission; print only what is wrong. Raises MissionAborted, or KeyboardInterrupt if the user stops it."""
    out.mkdir(parents=True)
    progress = NotesOnly(world.config, world.law.cells.size, bound_of(world))
    code = Mission(world, out, command_line(), policy, progress).run(in_one_process=in_one_process)
    if code == process.FAILED:
        raise MissionAborted(f"a mission ended early; its logs are in {out}")
    if code != process.DONE:
        raise KeyboardInterrupt


def cost(config: Config) -> float:
    """Estimate how long a mission takes, in moves: its own, and the starts of its processes."""
    return config.team.size * (config.training.ticks * config.training.episodes + 300.0) + 500.0


def with_progress(configs: list[Config]) -> Iterator[tuple[int, Config, float]]:
    """Yield (number from 1, config, share of all work that is done before it) of every mission."""
    total, done = sum(map(cost, configs)), 0.0
    for number, config in enumerate(configs, 1):
        yield number, config, done / total
        done += cost(config)

"""`overfly bench memory`: memory of all processes of a training, by role, and of the replay memory.

Memory is proportional (PSS): a page that several processes share counts once in total. This process is the supervisor.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from deploy import settings
from deploy.bench import bounds, replay, rollout
from deploy.bench.row import Row
from deploy.run.mission import check
from tmc.center.replay import Replay
from tmc.kernel.config import ConfigError
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import World
from tmc.wire import process

LIMIT_MB = 600.0
"""Limit of three UAVs, the TMC, the learner and the processes that start them."""
MB_PER_MIB = 1024**2 / 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument("--transitions", type=int, default=6000, metavar="T",
                        help="transitions in the replay memory at the measurement (default: 6000)")  # fmt: skip
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Train until `--transitions` are stored, measure, then fill a replay memory; return one row per figure.

    Raises ConfigError.
    """
    values = {"training.episodes": 1_000_000, **settings.chosen(args)}  # it is stopped, not finished
    world = check(settings.config_for("paper", values))
    config = world.config
    bounds.training(world, 1)
    least, most = (
        max(config.replay.learn_start, config.dqn.batch_size),
        config.training.episodes * config.training.ticks,
    )
    if not least < args.transitions < most * config.team.size:
        raise ConfigError(
            f"--transitions must be more than the {least:,} before the first update, and fewer than the mission flies"
        )
    if args.transitions > config.replay.capacity:
        raise ConfigError(
            f"--transitions {args.transitions:,} is more than the replay memory holds: choose "
            f"{config.replay.capacity:,} or less, or set replay.capacity to more"
        )
    with tempfile.TemporaryDirectory(prefix="overfly-bench-") as scratch:
        memory = in_training(world, args.transitions, Path(scratch))
    return [*_rows(config.team.size, memory), full_replay(world)]


def in_training(world: World, transitions: int, out: Path) -> rollout.Memory | None:
    """Return the memory of all processes once they have flown `transitions` and learn; None if not available."""
    with rollout.started(world.config, None, out) as (supervisor, observer):
        shown_at, pace = time.monotonic(), bounds.Pace("--transitions", transitions)
        while not supervisor.watch():
            time.sleep(rollout.POLL_S)
            status = observer.ask()
            if status is None:
                continue
            flown = status.ticks * world.config.team.size
            if flown >= transitions and status.updates:
                return rollout.weigh_all(supervisor.pids())
            pace.check(flown)
            if time.monotonic() > shown_at + 5.0:
                shown_at, pace = time.monotonic(), bounds.Pace("--transitions", transitions)
                process.tell(f"{flown:,} of {transitions:,} transitions", prefix="")
    return None


def _rows(size: int, memory: rollout.Memory | None) -> Iterator[Row]:
    total = memory.total * MB_PER_MIB if memory else None
    yield Row("memory", f"N={size}", total, "MB in total", LIMIT_MB, total and total / LIMIT_MB, "of the limit")
    for role, mib in sorted(memory.roles.items()) if memory else ():
        used = mib * MB_PER_MIB
        yield Row("memory", f"N={size} {role}", used, "MB", total, total and used / total, "of the total")


def full_replay(world: World) -> Row:
    """Measure by how much this process grows when it fills a replay memory."""
    before = rollout.own()
    memory = Replay(world, ObservationBuilder(world))
    replay.fill(memory)
    after, limit = rollout.own(), replay.LIMITS["memory"]
    grown = None if before is None or after is None else (after - before) * MB_PER_MIB
    return Row("memory", f"replay, {len(memory):,} transitions", grown, "MB", limit,
               grown and grown / limit, "of the limit")  # fmt: skip

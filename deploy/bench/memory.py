"""`overfly bench memory`: what all processes of a training use together, by role, and what the replay memory takes.

Memory is proportional (PSS): a page that several processes share counts once in all. This process is the supervisor.
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

LIMIT = 600.0
"""MB that is asked of three UAVs, the TMC, the learner and whoever starts them."""
MB = 1024**2 / 1e6
"""Of a MiB."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the bench."""
    parser.add_argument("--transitions", type=int, default=6000, metavar="T",
                        help="in the replay memory when all are weighed (default: 6000)")  # fmt: skip
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Train until so many transitions are in, weigh, and fill a replay memory; one row a figure."""
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
            f"--transitions must be more than the {least:,} before the first update, and come to be flown"
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
    """The memory of all processes once they have flown so many transitions and learn from them."""
    with rollout.started(world.config, None, out) as (supervisor, observer):
        told, pace = time.monotonic(), bounds.Pace("--transitions", transitions)
        while not supervisor.watch():
            time.sleep(rollout.POLL_S)
            status = observer.ask()
            if status is None:
                continue
            flown = status.ticks * world.config.team.size
            if flown >= transitions and status.updates:
                return rollout.weigh_all(supervisor.pids())
            pace.check(flown)
            if time.monotonic() > told + 5.0:
                told, pace = time.monotonic(), bounds.Pace("--transitions", transitions)
                process.tell(f"{flown:,} of {transitions:,} transitions", prefix="")
    return None


def _rows(size: int, memory: rollout.Memory | None) -> Iterator[Row]:
    total = memory.total * MB if memory else None
    yield Row("memory", f"N={size}", total, "MB in all", LIMIT, total and total / LIMIT, "of what is asked")
    for role, used in sorted(memory.roles.items()) if memory else ():
        yield Row("memory", f"N={size} {role}", used * MB, "MB", total, total and used * MB / total, "of all")


def full_replay(world: World) -> Row:
    """By how much this process grows when it fills a replay memory."""
    before = rollout.own()
    memory = Replay(world, ObservationBuilder(world))
    replay.fill(memory)
    after, limit = rollout.own(), replay.LIMITS["memory"]
    grown = None if before is None or after is None else (after - before) * MB
    return Row("memory", f"replay, {len(memory):,} transitions", grown, "MB", limit,
               grown and grown / limit, "of what is asked")  # fmt: skip

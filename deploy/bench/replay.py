"""`overfly bench replay`: size, inserts and samples of the replay memory, on one core.

It is filled with random flights, one exchange at a time as in the TMC, until it holds `replay.capacity` transitions.
Then minibatches are sampled, and their images drawn into reused memory, as TMC and learner do together. All is measured
in one process with the TMC's environment, in which freed memory is kept. Times are processor time, so that a busy
machine changes them less.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deploy import settings
from deploy.bench import bounds
from deploy.bench.row import Row
from deploy.run import helper, plan
from deploy.run.mission import check
from tmc.center.replay import Replay, Ring
from tmc.kernel.config import build, flat
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import Floats, ObservationBuilder
from tmc.kernel.world import World
from tmc.wire import process

LIMITS = {"bytes": 100.0, "memory": 60.0, "minibatch": 1.5, "inserts": 100_000.0, "prioritised": 3.0}
"""Limits for 100,000 transitions of the paper.

`bytes`: per transition. `memory`: MB in total. `minibatch`: ms per minibatch. `inserts`: at least so many per second.
`prioritised`: ms per minibatch that is sampled by priorities and then updates them.
"""
PRIORITY_EXPONENT = 0.6
"""The exponent of priorities if the settings have 0 (Schaul et al. 2016, Table 3; Horgan et al. 2018)."""
MINIBATCH_S = 0.01
"""Assumed time (s) of a minibatch."""
WARM_UP_MINIBATCHES = 5
"""Minibatches that are not timed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument("--minibatches", type=int, default=500, metavar="M", help="minibatches to time (default: 500)")
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Fill a replay memory and sample from it, in a separate process; return one row per figure. Raises ConfigError."""
    bounds.number("--minibatches", args.minibatches, 1, MINIBATCH_S)
    world = check(settings.config_for("paper", settings.chosen(args)))
    bounds.memory(world)
    words = ("deploy.bench.replay", "--minibatches", args.minibatches)
    printed = helper.output_of(helper.start(*words, env=plan.environment("tmc", 1)), json.dumps(flat(world.config)))
    held, batch, found = (
        f"{world.config.replay.capacity:,} transitions",
        world.config.dqn.batch_size,
        json.loads(printed),
    )
    return [
        _row(held, found["bytes"], "bytes/transition", "bytes"),
        _row(f"{held} with priorities", found["bytes with priorities"], "bytes/transition", "bytes"),
        _row("process above an empty one", found["memory"], "MB", "memory"),
        _row(f"minibatch of {batch}", median(found["uniform"]), "ms", "minibatch"),
        _row(f"minibatch of {batch}, fastest", min(found["uniform"]), "ms", "minibatch"),
        _row("prioritised, with update", median(found["prioritised"]), "ms", "prioritised"),
        _row("inserts", found["inserts"], "transitions/s", "inserts"),
    ]


def weigh(values: dict[str, Any], minibatches: int) -> dict[str, Any]:
    """Return the figures, without priorities and with them. `memory`: None if the system does not report it."""
    world = World(build({**values, "replay.priority_exponent": 0.0}))
    before = _resident()
    replay = Replay(world, ObservationBuilder(world))
    inserted, spent = fill(replay)
    grown = None if before is None else (_resident() or before) - before
    found: dict[str, Any] = {"bytes": weight(replay), "memory": grown, "inserts": inserted / spent}
    found["uniform"] = drawn(replay, minibatches)
    world = World(
        build({**values, "replay.priority_exponent": values["replay.priority_exponent"] or PRIORITY_EXPONENT})
    )
    replay = Replay(world, ObservationBuilder(world))
    fill(replay)
    return {**found, "bytes with priorities": weight(replay), "prioritised": drawn(replay, minibatches)}


def weight(replay: Replay) -> float:
    """Return the bytes per transition."""
    arrays = sum(ring.data.nbytes for ring in vars(replay).values() if isinstance(ring, Ring))
    return (arrays + (replay.priorities.nbytes if replay.priorities else 0)) / len(replay)


def drawn(replay: Replay, minibatches: int) -> list[float]:
    """Return the processor time (ms) of each minibatch."""
    batch, (channels, height, width) = replay.world.config.dqn.batch_size, replay.observer.shape
    images = np.empty((2 * batch, height, width, channels), np.float32).transpose(
        0, 3, 1, 2
    )  # channels last, as in the learner
    rng = np.random.Generator(np.random.Philox(0))
    errors = (rng.exponential(size=batch).astype("f4") for _ in range(minibatches + WARM_UP_MINIBATCHES))
    return [_drawn(replay, number, images, of) for number, of in enumerate(errors)][WARM_UP_MINIBATCHES:]


def _row(case: str, value: float | None, unit: str, limit: str) -> Row:
    reference = LIMITS[limit]
    return Row("replay", case, value, unit, reference, value and value / reference, "of the limit")


def _resident() -> float | None:
    """Return the memory (MB) of this process; None if the system does not report it."""
    try:
        found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{os.getpid()}/status").read_text())
    except OSError:
        return None
    return int(found[1]) * 1024 / 1e6 if found else None


def _drawn(replay: Replay, number: int, images: Floats, errors: Floats) -> float:
    """Return the processor time (ms) of minibatch `number`; `errors` (B,): its TD errors, which set priorities."""
    start = time.process_time()
    sample = replay.sample(number, replay.world.config.dqn.batch_size)
    replay.observer.observe_batch(sample.views, images)
    if replay.priorities is not None:
        replay.priorities.set(sample.index, errors)
    return 1e3 * (time.process_time() - start)


def fill(replay: Replay) -> tuple[int, float]:
    """Insert random flights until the memory is full; return (transitions inserted, processor time in s)."""
    world, team = replay.world, replay.world.config.team.size
    full = world.config.replay.capacity // team * team
    inserted, spent, episode = 0, 0.0, 0
    while len(replay) < full:
        episode += 1
        if episode % 10 == 0:
            process.tell(f"{len(replay):,} transitions", prefix="")
        for tick, rows, frame in _exchanges(world, episode):
            start = time.process_time()
            number = replay.add_frame(tick, frame)
            base = np.full(rows[0].shape, number if tick == 0 else number - 1, np.int64)
            base[-1] = number  # at the exchange's own tick the UAVs have the new map
            replay.add_rows(episode, tick - len(base) + 1, *rows, base, [True] * len(base))
            spent += time.process_time() - start
            inserted += base.size
    return inserted, spent


Rows = tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.float32]]


def _exchanges(world: World, episode: int) -> Iterator[tuple[int, Rows, NDArray[np.generic]]]:
    """Yield the exchanges of a random episode: (tick, rows since the last exchange, map with all visits by then)."""
    T, T_u, N = world.config.training.ticks, world.config.T_u, world.config.team.size
    rng = np.random.Generator(np.random.Philox(episode))
    actions, rewards = rng.integers(0, N_ACTIONS, (T + 1, N)).astype("u1"), rng.random((T + 1, N), np.float32)
    moves = np.array([[cell for cell, _ in row] for row in world.moves])
    cells = np.empty((T + 1, N), np.int64)
    cells[0] = world.starts(episode)
    for t in range(T):
        cells[t + 1] = moves[cells[t], actions[t + 1]]
    last_visit, first = np.zeros(world.law.cells.size, "u2"), 0
    for tick in range(0, T + 1, T_u):
        rows = slice(first, tick + 1)
        k = world.law.index[cells[rows]]
        ticks = np.broadcast_to(np.arange(first, tick + 1)[:, None], k.shape)
        np.maximum.at(last_visit, k[k >= 0], ticks[k >= 0].astype("u2"))
        frame = last_visit if world.config.scenario == 2 else rng.random(last_visit.size) < 0.5
        yield tick, (cells[rows].astype("u2"), actions[rows], rewards[rows]), frame
        first = tick + 1


def main() -> int:
    """Measure in this process: settings as JSON on stdin, figures as JSON on stdout."""
    parser = argparse.ArgumentParser("deploy.bench.replay", description=__doc__, allow_abbrev=False)
    parser.add_argument("--minibatches", type=int, required=True)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    a = parser.parse_args()
    process.become_child(a.parent)
    json.dump(weigh(json.load(sys.stdin), a.minibatches), sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())

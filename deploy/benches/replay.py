"""`overfly bench replay`: what the replay memory weighs, takes in and gives out, on one core, without processes.

It is filled with flights at random, an exchange at a time as the TMC fills it, until it holds `replay.capacity`
transitions. Times are the processor's, so a busy machine changes them less.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from deploy import settings
from deploy.benches.row import Row
from deploy.mission import check
from tmc.kernel.config import ConfigError
from tmc.kernel.grid import N_ACTIONS
from tmc.kernel.observation import Observer
from tmc.kernel.world import World
from tmc.replay import Replay

LIMITS = {"bytes": 100.0, "memory": 60.0, "minibatch": 1.5, "inserts": 100_000.0}
"""What is asked of 100,000 transitions of the paper: bytes each, MB in all, ms a minibatch, and at least inserts/s."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the bench."""
    parser.add_argument("--minibatches", type=int, default=500, metavar="M", help="drawn and timed (default: 500)")
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Fill it, then draw from it; one row a figure."""
    if args.minibatches < 1:
        raise ConfigError("--minibatches must be 1 or more")
    world = check(settings.config_for("paper", settings.chosen(args)))
    before = _resident()
    replay = Replay(world, Observer(world))
    inserted, spent = fill(replay)
    grown = None if before is None else (_resident() or before) - before
    times = [_drawn(replay, number) for number in range(args.minibatches + 5)][5:]
    held = len(replay)
    arrays = sum(ring.data.nbytes for ring in vars(replay).values() if hasattr(ring, "data"))
    return [
        _row(f"{held:,} transitions", arrays / held, "bytes each", "bytes"),
        _row("process above an empty one", grown, "MB", "memory"),
        _row(f"a minibatch of {world.config.dqn.batch}", median(times), "ms", "minibatch"),
        _row("the fastest of them", min(times), "ms", "minibatch"),
        _row("inserts", inserted / spent, "transitions/s", "inserts"),
    ]


def _row(case: str, value: float | None, unit: str, limit: str) -> Row:
    asked = LIMITS[limit]
    return Row("replay", case, value, unit, asked, value and value / asked, "of what is asked")


def _resident() -> float | None:
    """MB of memory that this process uses; None where the system does not tell."""
    try:
        found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{os.getpid()}/status").read_text())
    except OSError:
        return None
    return int(found[1]) * 1024 / 1e6 if found else None


def _drawn(replay: Replay, number: int) -> float:
    """Milliseconds of the processor that minibatch `number` takes."""
    start = time.process_time()
    replay.sample(number, replay.world.config.dqn.batch)
    return 1e3 * (time.process_time() - start)


def fill(replay: Replay) -> tuple[int, float]:
    """Episodes of random moves until the memory is full: transitions put in, and the processor's seconds for that."""
    world, team = replay.world, replay.world.config.team.size
    full = world.config.replay.capacity // team * team
    inserted, spent, episode = 0, 0.0, 0
    while len(replay) < full:
        episode += 1
        if episode % 10 == 0:
            print(f"{len(replay):,} transitions", file=sys.stderr, flush=True)
        for tick, rows, frame in _exchanges(world, episode):
            start = time.process_time()
            number = replay.add_frame(tick, frame)
            base = np.full(rows[0].shape, number if tick == 0 else number - 1, np.int64)
            base[-1] = number  # what is known at the exchange's own tick is the new map
            replay.add_rows(episode, tick - len(base) + 1, *rows, base, [True] * len(base))
            spent += time.process_time() - start
            inserted += base.size
    return inserted, spent


Rows = tuple[NDArray[np.uint16], NDArray[np.uint8], NDArray[np.float32]]


def _exchanges(world: World, episode: int) -> Iterator[tuple[int, Rows, NDArray[np.generic]]]:
    """An episode as the TMC learns of it: (tick, its rows since the last exchange, the map with all visits by then)."""
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

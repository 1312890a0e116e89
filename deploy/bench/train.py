"""`overfly bench train`: ticks per second of the whole training, one minibatch per tick, against the textbook loop.

It also measures the start, and the memory of all processes together. The missions are those of `overfly bench learner`,
which explains why they represent the paper's.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from statistics import median

from deploy import settings
from deploy.bench import bounds, learner
from deploy.bench.row import Row
from deploy.commands.evaluate import team_sizes
from deploy.run.mission import check


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument("--actors", default="3,10", metavar="N[,N...]", help="default: %(default)s")
    parser.add_argument("--repeats", type=int, default=3, metavar="R", help="turns to take medians of (default: 3)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="length of each stretch (default: 10)")
    parser.add_argument(
        "--threads", type=int, default=2, metavar="N", help="threads of the learner and of the loop (default: 2)"
    )
    settings.add_options(parser, actors=False)


def measure(args: argparse.Namespace) -> list[Row]:
    """Run the textbook loop and missions of each size in turns; return one row per figure. Raises ConfigError."""
    values = {**learner.MISSION, "training.threads": args.threads, **settings.chosen(args)}
    sizes = [n for n in team_sizes(args.actors) if n is not None]
    bounds.stretches(args.repeats, args.seconds, 1 + len(sizes))
    worlds = [check(settings.config_for("paper", {**values, "team.size": n})) for n in sizes]
    for world in worlds:
        bounds.training(world, learner.warm_up(world.config))
    flown: list[list[learner.Learned]] = [[] for _ in worlds]
    textbook: list[float] = []
    with tempfile.TemporaryDirectory(prefix="overfly-bench-") as scratch:
        for _ in range(args.repeats):
            textbook.append(learner.reference_loop(worlds[0].config, args.seconds, "textbook"))
            for world, runs in zip(worlds, flown, strict=True):
                runs.append(learner.fly(world, args.seconds, Path(tempfile.mkdtemp(dir=scratch))))
            rates = ", ".join(f"N={n} {runs[-1].ticks:.1f}" for n, runs in zip(sizes, flown, strict=True))
            learner.print_progress(f"textbook loop {textbook[-1]:.1f} updates/s, ticks/s: {rates}")
    return [row for n, runs in zip(sizes, flown, strict=True) for row in _rows(n, runs, textbook)]


def _rows(size: int, runs: list[learner.Learned], textbook: list[float]) -> list[Row]:
    """Return the figures of one team size."""
    ratio = median(run.ticks / loop for run, loop in zip(runs, textbook, strict=True))
    memory = [run.memory for run in runs if run.memory is not None]
    return [
        Row(
            "train",
            f"N={size}",
            median(run.ticks for run in runs),
            "ticks/s",
            median(textbook),
            ratio,
            "x textbook loop",
        ),
        *learner.shares("train", f"N={size}", runs),
        Row("train", f"N={size} start", median(run.start for run in runs), "s to the first update"),
        Row("train", f"N={size} memory", median(memory) if memory else None, "MiB in total"),
    ]

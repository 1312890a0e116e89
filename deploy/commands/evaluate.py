"""`overfly evaluate POLICY...`: policies and planners side by side, many seeds each, in lock step."""

from __future__ import annotations

import argparse
import json
import math
import os
from dataclasses import asdict

import overfly
from deploy import extras, settings
from deploy.run.evaluation import FIRST_SEED
from tmc.kernel.config import ConfigError
from tmc.kernel.policy import FlightError
from tmc.wire import process


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "who", nargs="+", metavar="POLICY", help="policy files, run folders, planner:random, planner:random-road, ..."
    )
    parser.add_argument("--actors", default=None, metavar="N[,N...]", help="team sizes (default: the mission's)")
    parser.add_argument("--seeds", type=int, default=10, metavar="S", help="missions each (default: 10)")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="S", help="default: %(default)s")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="J", help="processes to use")
    parser.add_argument("--json", action="store_true", help="print one line of JSON a row")
    settings.add_options(parser, actors=False, refused=("--seed", "--episodes"))


def main(args: argparse.Namespace) -> int:
    """Fly them all, then print the table."""
    extras.require()
    if args.seeds < 1 or args.jobs < 1:
        raise ConfigError("--seeds and --jobs must be 1 or more")
    if args.seed is not None or args.episodes is not None:
        raise ConfigError("evaluate flies one episode a seed: choose them with --seeds and --first-seed")
    teams = [n for n in team_sizes(args.actors) if n is not None]
    try:
        table = overfly.evaluate(args.who, seeds=args.seeds, first_seed=args.first_seed, actors=teams, jobs=args.jobs,
                                 settings=settings.chosen(args))  # fmt: skip
    except FlightError as error:
        process.tell(str(error))
        return process.FAILED
    if args.json:
        for row in table.rows:
            values = asdict(row).items()  # nan is no JSON
            print(json.dumps({k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values}))
    else:
        print(table)
    return process.DONE


def team_sizes(listed: str | None) -> list[int | None]:
    """The team sizes of `--actors 1,3,10`; [None] for the mission's own."""
    try:
        return [None] if listed is None else [*dict.fromkeys(int(n) for n in listed.split(","))]
    except ValueError:
        raise ConfigError(f"--actors {listed} is not a list of numbers: write for example --actors 1,3,10") from None

"""`overfly fly POLICY`: a mission with a fixed policy or a planner in real processes; deterministic."""

from __future__ import annotations

import argparse

import overfly
from deploy import policy_spec, settings
from deploy.commands.analyze import report
from deploy.commands.run import add_mission_options
from deploy.run import mission


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "who", metavar="POLICY", help="policy file, run folder, or planner:random, planner:random-road, planner:greedy"
    )
    settings.add_options(parser, defaults=policy_spec.ONE_EPISODE)
    add_mission_options(parser)


def main(args: argparse.Namespace) -> int:
    """Fly, then say how it went. One episode unless --episodes says otherwise; the paper's settings otherwise."""
    changes, typed = settings.chosen(args), mission.command_line()
    run = overfly.fly(args.who, out=args.out, lockstep=args.lockstep, settings=changes, _command=typed)
    return report(run.folder, as_json=args.json, pictures=not args.no_pictures)

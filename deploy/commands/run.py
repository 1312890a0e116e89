"""`overfly run PRESET`: train a team."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy import mission, settings
from deploy.commands.analyze import report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("preset", help=f"one of {', '.join(settings.preset_names())}")
    settings.add_options(parser)
    add_mission_options(parser)


def add_mission_options(parser: argparse.ArgumentParser) -> None:
    """Options that `run` and `fly` share."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder; runs/<name>-<time> when left out")
    parser.add_argument("--lockstep", action="store_true", help="the same mission in one process")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def main(args: argparse.Namespace) -> int:
    """Train, then say what came of it."""
    config = settings.config_for(args.preset, settings.chosen(args))
    world = mission.check(config)
    out = mission.new_folder(args.out, args.preset)
    code = mission.Mission(world, out, mission.command_line()).run(in_one_process=args.lockstep)
    return code or report(out, as_json=args.json)

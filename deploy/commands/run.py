"""`overfly run PRESET`: train a team."""

from __future__ import annotations

import argparse
from pathlib import Path

import overfly
from deploy import settings
from deploy.commands.analyze import report
from deploy.run import mission
from tmc.kernel.config import ConfigError
from tmc.wire import process


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("preset", nargs="?", help=f"one of {', '.join(settings.preset_names())}")
    parser.add_argument("--resume", type=Path, metavar="RUN", help="go on with a run or flight that was interrupted")
    settings.add_options(parser)
    add_mission_options(parser)


def add_mission_options(parser: argparse.ArgumentParser) -> None:
    """Options that `run` and `fly` share."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder; runs/<name>-<time> when left out")
    parser.add_argument("--lockstep", action="store_true", help="the same mission in one process")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.add_argument("--no-pictures", action="store_true", help="make none (overfly analyze makes them later)")


def main(args: argparse.Namespace) -> int:
    """Train, then say what came of it."""
    if args.resume is not None:
        return resume(args)
    if args.preset is None:
        raise ConfigError(f"which preset? choose {', '.join(settings.preset_names())}, or --resume RUN")
    changes, typed = settings.chosen(args), mission.command_line()
    run = overfly.train(args.preset, out=args.out, lockstep=args.lockstep, settings=changes, _command=typed)
    return report(run.folder, as_json=args.json, pictures=not args.no_pictures)


def resume(args: argparse.Namespace) -> int:
    """Go on with a run from its journal and its checkpoint, whatever was killed."""
    if args.preset or args.out or args.lockstep or settings.chosen(args):
        raise ConfigError(
            "--resume goes on with its own settings, as processes: give it nothing but --json, --no-pictures"
        )
    over = mission.finished(args.resume)
    run = overfly.resume(args.resume, _command=mission.command_line())
    if over:
        process.tell(f"{args.resume} was flown to its end: this is its summary")
    return report(run.folder, as_json=args.json, pictures=not args.no_pictures)

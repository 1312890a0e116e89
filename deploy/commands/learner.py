"""`overfly learner`: runs the learner."""

from __future__ import annotations

import argparse
from pathlib import Path

from deploy import extras
from tmc.wire import process


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("--connect", default="tcp://127.0.0.1:5555", metavar="ENDPOINT", help="the TMC's endpoint")
    parser.add_argument("--out", type=Path, default=Path("runs/learner"), metavar="DIR",
                        help="folder for its log, checkpoints and policies")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Learn until the TMC ends the mission; return the exit code. Raises ConfigError."""
    extras.require(extras.LEARNER)
    from learner.__main__ import MISTAKES, learn  # noqa: PLC0415  torch only where there is a learner

    return process.run(lambda: learn(args.connect, args.out), MISTAKES)

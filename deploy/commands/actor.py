"""`overfly actor --id I`: one UAV alone."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from actors.__main__ import fly
from deploy import extras
from tmc.kernel.config import ConfigError

MOST = 65_536
"""UAVs that a team may have numbers for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--id", type=int, required=True, metavar="I", help="number of the UAV, from 0")
    parser.add_argument("--connect", default="tcp://127.0.0.1:5555", metavar="ENDPOINT", help="the TMC's endpoint")
    parser.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="folder for its log; runs/actor-<I>-<time> when left out"
    )


def main(args: argparse.Namespace) -> int:
    """Fly until the TMC ends the mission."""
    extras.require()
    if not 0 <= args.id < MOST:
        raise ConfigError(f"--id {args.id} is no number of a UAV: choose 0 to {MOST - 1:,}")
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    return fly(args.id, args.connect, args.out or Path("runs") / f"actor-{args.id:03d}-{stamp}")

"""`overfly actor --id I`: one UAV alone."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from actors.__main__ import fly


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "--id", type=int, required=True, choices=range(65_536), metavar="I", help="number of the UAV, from 0"
    )
    parser.add_argument("--connect", default="tcp://127.0.0.1:5555", metavar="ENDPOINT", help="the TMC's endpoint")
    parser.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="folder for its log; runs/actor-<I>-<time> when left out"
    )


def main(args: argparse.Namespace) -> int:
    """Fly until the TMC ends the mission."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    return fly(args.id, args.connect, args.out or Path("runs") / f"actor-{args.id:03d}-{stamp}")

"""`overfly actor --id I`: runs one UAV."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from actors.__main__ import fly
from deploy import extras
from tmc.kernel.config import ConfigError

MAX_UAVS = 65_536
"""Most UAVs of a team."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("--id", type=int, required=True, metavar="I", help="number of the UAV, from 0")
    parser.add_argument("--connect", default="tcp://127.0.0.1:5555", metavar="ENDPOINT", help="the TMC's endpoint")
    parser.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="folder for its log (default: runs/actor-<I>-<time>)"
    )


def main(args: argparse.Namespace) -> int:
    """Fly until the TMC ends the mission; return the exit code. Raises ConfigError."""
    extras.require()
    if not 0 <= args.id < MAX_UAVS:
        raise ConfigError(f"--id {args.id} is not the number of a UAV: choose 0 to {MAX_UAVS - 1:,}")
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    return fly(args.id, args.connect, args.out or Path("runs") / f"actor-{args.id:03d}-{stamp}")

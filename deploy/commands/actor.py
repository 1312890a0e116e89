"""`overfly actor --id I`: one UAV alone."""

from __future__ import annotations

import argparse
from pathlib import Path

from actors.__main__ import fly


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--id", type=int, required=True, metavar="I", help="number of the UAV, from 0")
    parser.add_argument("--connect", default="tcp://127.0.0.1:5555", metavar="ENDPOINT", help="the TMC's endpoint")
    parser.add_argument("--out", type=Path, default=Path("runs/actors"), metavar="DIR", help="folder for its log")


def main(args: argparse.Namespace) -> int:
    """Fly until the TMC ends the mission."""
    return fly(args.id, args.connect, args.out)

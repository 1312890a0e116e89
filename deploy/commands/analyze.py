"""`overfly analyze RUN`: a summary that fits a screen, and pictures."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def main(args: argparse.Namespace) -> int:
    """Read the log and say what it holds."""
    return report(args.run, as_json=args.json)


def report(run: Path, *, as_json: bool) -> int:
    """placeholder until analysis lands"""
    print(run)
    return 0

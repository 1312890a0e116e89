"""`overfly analyze RUN`: prints a summary that fits a screen, and draws pictures."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path

from deploy import extras
from tmc.analysis.metrics import summarize
from tmc.analysis.report import pictures as drawing
from tmc.analysis.report import text as reports
from tmc.analysis.run_data import RunData, read
from tmc.analysis.summary import Summary
from tmc.kernel.config import ConfigError
from tmc.record import disk
from tmc.record.run_folder import RunFolder
from tmc.wire import process


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.add_argument(
        "--episode", type=int, metavar="E", help="episode of the path picture (default: the last complete one)"
    )
    parser.add_argument("--no-pictures", action="store_true", help="draw no pictures")
    parser.add_argument("--baseline", action="append", default=[], metavar="NAME=VALUE",
                        help="dashed line in training curves, per road cell; may be repeated")  # fmt: skip


def main(args: argparse.Namespace) -> int:
    """Read the log, print its summary and draw its pictures; return the exit code."""
    return report(
        args.run,
        as_json=args.json,
        episode=args.episode,
        pictures=not args.no_pictures,
        baselines=baselines(args.baseline),
    )


def baselines(options: list[str]) -> dict[str, float]:
    """Return {name: uncertainty per road cell} of `NAME=VALUE` options. Raises ConfigError."""
    found = {}
    for option in options:
        name, _, value = option.rpartition("=")
        try:
            found[name] = float(value)
        except ValueError:
            name = ""
        if not name or not math.isfinite(found[name]):
            raise ConfigError(f"--baseline {option} is not NAME=VALUE: write for example greedy=0.39")
    return found


def report(
    run: Path,
    *,
    as_json: bool,
    episode: int | None = None,
    pictures: bool = True,
    baselines: Mapping[str, float] | None = None,
) -> int:
    """Print the summary, write it to RUN/summary.json, and draw RUN/report/*.png; return the exit code.

    A file that cannot be written is reported but is not a failure, since the summary is printed. Pictures come last, so
    that a failing one does not lose the result. Raises RecordError if RUN holds no flight.
    """
    flown = read(run)
    summary = summarize(flown)
    if episode is not None:
        flown.episode(episode)
    kept = _keep(RunFolder(run).summary, summary.to_json() + "\n", pictures=pictures)
    wanted = pictures and kept
    print(summary.to_json() if as_json else reports.text(summary, int(wanted), kept=kept), flush=True)
    made = _draw(flown, summary, episode, baselines or {}) if wanted else []
    if made and not as_json:
        print(reports.pictures(made))
    return 0


def _keep(path: Path, text: str, *, pictures: bool) -> bool:
    """Write the summary; return whether that succeeded. Prints a sentence on stderr if not."""
    try:
        disk.write_atomically(path, text.encode(), sync=False)
    except OSError as error:
        lost = "the summary is printed only" + (", and no pictures are made" if pictures else "")
        process.tell(f"{path} cannot be written ({error.strerror}): {lost}")
        return False
    return True


def _draw(flown: RunData, summary: Summary, episode: int | None, lines: Mapping[str, float]) -> list[Path]:
    """Draw the pictures that can be drawn; return their paths. Prints a sentence on stderr for each other one."""
    if why := extras.lacking(extras.FIGURES):
        process.tell(f"no pictures: {why}")
        return []
    return drawing.draw(flown, summary, episode, lines, process.tell, extras.broken)

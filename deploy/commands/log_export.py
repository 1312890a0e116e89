"""`overfly log merge | replay`: makes files for viewers from a run's logs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

from deploy.run.line import Line
from tmc.analysis.viewer import replay_file
from tmc.kernel.text import printable
from tmc.record.errors import RecordError
from tmc.record.merge import merge
from tmc.record.run_folder import logs_in
from tmc.wire.process import DONE, FAILED, tell

ABOUT = {
    "merge": "one MCAP file of all logs of a run, in order of time",
    "replay": "an episode as a file for viewers, on the simulated clock, with a layout",
}
PROGRESS_DELAY_S = 2.0
"""Time (s) before the first line of progress."""


def add_options(view: str, parser: argparse.ArgumentParser) -> None:
    """Add the options of one view."""
    if view == "merge":
        parser.add_argument("run", type=Path, help="run folder, or one MCAP file")
        parser.add_argument("--prefix", default="", metavar="P/", help="prefix of each topic, to distinguish two runs")
        parser.add_argument("--out", type=Path, metavar="FILE", help="(default: RUN/merged.mcap)")
        return
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--episode", type=int, default=1, metavar="E", help="from 1 (default: 1)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="(default: RUN/replay/episode-000001.mcap)")


def _merge(args: argparse.Namespace) -> int:
    files = logs_in(args.run)
    out = fresh(args.out) or next(iter(files.values())).parent / "merged.mcap"
    with Line(delay=PROGRESS_DELAY_S) as line:
        merged = merge(files, out, args.prefix, lambda done, of: line.show(f"message {done:,} of {of:,}"))
    for path in merged.open:
        tell(f"{path} is still open: its messages so far were merged")
    for damage in merged.damage:
        tell(f"the output is incomplete: {damage}")
    files_in = f"{merged.files} file" + "s" * (merged.files > 1)
    print(printable(f"{merged.path}: {merged.messages:,} messages of {files_in}, {_size(merged.path)}"))
    return FAILED if merged.damage else DONE


def _replay(args: argparse.Namespace) -> int:
    out = fresh(args.out) or replay_file.default_path(args.run, args.episode)
    with Line(delay=PROGRESS_DELAY_S) as line:
        made = replay_file.write(args.run, args.episode, out, line.show)
    flown = made.timeline
    for note in flown.notes:
        tell(note)
    if flown.damage:
        tell(f"the output is incomplete: {flown.damage}")
    elif not flown.whole:
        tell(f"episode {args.episode} was not flown to its end")
    print(printable(f"{made.path}: episode {args.episode}, ticks 0 to {flown.ticks:,}, {_size(made.path)}"))
    print(printable(f"{made.layout}: import it as the layout in Foxglove or Lichtblick"))
    return FAILED if flown.damage else DONE


def fresh(out: Path | None) -> Path | None:
    """Return the file that the user named, if any. Raises RecordError if it exists."""
    if out is not None and os.path.lexists(out):
        raise RecordError(f"{out} exists already: choose another --out, or remove it")
    return out


def _size(path: Path) -> str:
    return f"{path.stat().st_size:,} bytes"


MAINS: dict[str, Callable[[argparse.Namespace], int]] = {"merge": _merge, "replay": _replay}

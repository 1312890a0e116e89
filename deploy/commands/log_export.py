"""`overfly log merge | replay`: files made from a run's logs, for viewers."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

from deploy.progress import PLAIN_EVERY
from tmc.analysis import replayfile
from tmc.record.errors import RecordError
from tmc.record.merge import merge
from tmc.record.reader import logs_in
from tmc.wire.process import DONE, FAILED

ABOUT = {
    "merge": "one MCAP file of all logs of a run, in order of time",
    "replay": "an episode as a file for viewers, on the simulated clock, with a layout",
}
PATIENCE = 2.0
"""Seconds before the first word of progress."""


def add_options(view: str, parser: argparse.ArgumentParser) -> None:
    """Options of one view."""
    if view == "merge":
        parser.add_argument("run", type=Path, help="run folder, or one MCAP file")
        parser.add_argument("--prefix", default="", metavar="P/", help="put before each topic, to tell two runs apart")
        parser.add_argument("--out", type=Path, metavar="FILE", help="(default: RUN/merged.mcap)")
        return
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--episode", type=int, default=1, metavar="E", help="from 1 (default: 1)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="(default: RUN/replay/episode-000001.mcap)")


def _merge(args: argparse.Namespace) -> int:
    files, word = logs_in(args.run), _Progress()
    out = fresh(args.out) or next(iter(files.values())).parent / "merged.mcap"
    merged = merge(files, out, args.prefix, lambda done, of: word.say(f"message {done:,} of {of:,}"))
    word.clear()
    for path in merged.open:
        print(f"overfly: {path} is not closed: what is in it so far was merged", file=sys.stderr)
    for damage in merged.damage:
        print(f"overfly: this is not all of it: {damage}", file=sys.stderr)
    files_in = f"{merged.files} file" + "s" * (merged.files > 1)
    print(f"{merged.path}: {merged.messages:,} messages of {files_in}, {_size(merged.path)}")
    return FAILED if merged.damage else DONE


def _replay(args: argparse.Namespace) -> int:
    word = _Progress()
    out = fresh(args.out) or replayfile.default_path(args.run, args.episode)
    made = replayfile.write(args.run, args.episode, out, word.say)
    word.clear()
    flown = made.flown
    for note in flown.notes:
        print(f"overfly: {note}", file=sys.stderr)
    if flown.damage:
        print(f"overfly: this is not all of it: {flown.damage}", file=sys.stderr)
    elif not flown.whole:
        print(f"overfly: episode {args.episode} was not flown to its end", file=sys.stderr)
    print(f"{made.path}: episode {args.episode}, ticks 0 to {flown.ticks:,}, {_size(made.path)}")
    print(f"{made.layout}: import it as the layout in Foxglove or Lichtblick")
    return FAILED if flown.damage else DONE


def fresh(out: Path | None) -> Path | None:
    """The file that the user named, if any; RecordError rather than write over one."""
    if out is not None and os.path.lexists(out):
        raise RecordError(f"{out} exists already: choose another --out, or remove it")
    return out


def _size(path: Path) -> str:
    return f"{path.stat().st_size:,} bytes"


class _Progress:
    """Words on stderr: one line that is written over on a terminal, a line now and then elsewhere."""

    def __init__(self) -> None:
        self._tty, self._said = sys.stderr.isatty(), False
        self._next = time.monotonic() + PATIENCE

    def say(self, text: str) -> None:
        """Say it, when it is time to."""
        if time.monotonic() < self._next:
            return
        self._next, self._said = time.monotonic() + (0.2 if self._tty else PLAIN_EVERY), True
        line, end = (f"\r\x1b[K{text}", "") if self._tty else (text, "\n")
        print(line, end=end, file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Make room for lines that stay."""
        if self._tty and self._said:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


MAINS: dict[str, Callable[[argparse.Namespace], int]] = {"merge": _merge, "replay": _replay}

"""`overfly log check | recover | compact`: checks, repairs and compacts the logs of a run."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

from deploy.commands.log_export import fresh
from deploy.run.line import Line
from tmc.analysis.invariants import check
from tmc.kernel.text import printable
from tmc.record.errors import NoLogError, RecordError
from tmc.record.mcap.compact import compact_run
from tmc.record.mcap.recover import Recovery, recover
from tmc.record.run_folder import logs_in
from tmc.wire.process import DONE, FAILED, USAGE, tell

PROGRESS_DELAY_S = 2.0
"""Time (s) before the first line of progress."""
LOSS = 3
"""Exit code: done, but data are lost."""
ABOUT = {
    "check": "replay the TMC's journal and check every invariant of a flight",
    "recover": "make intact, finished files of cut or damaged ones",
    "compact": "rewrite a run's logs for keeping: large chunks, finished names",
}


def add_options(view: str, parser: argparse.ArgumentParser) -> None:
    """Add the options of one view."""
    if view == "recover":
        parser.add_argument("run", type=Path, metavar="RUN", help="run folder, or one MCAP file")
        where = parser.add_mutually_exclusive_group()
        where.add_argument("--out", type=Path, metavar="FILE", help="output, for one file (default: X.recovered.mcap)")
        where.add_argument("--in-place", action="store_true", help="replace the file by the intact one")
        return
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")


def _check(args: argparse.Namespace) -> int:
    start = time.monotonic()
    with Line(delay=PROGRESS_DELAY_S) as line:
        result = check.check(args.run, line.share)
    print("\n".join(map(printable, result.table())))
    print(f"\n{printable(result.summary())} in {time.monotonic() - start:.1f} s")
    return DONE if result.good else FAILED


def _recover(args: argparse.Namespace) -> int:
    if args.out is not None and os.path.isdir(args.run):  # noqa: PTH112  never raises
        raise RecordError(f"--out is for one file, and {args.run} is a folder: leave it out, or name the file")
    fresh(args.out)
    codes = {_recover_one(path, args) for path in logs_in(args.run).values()}
    if codes == {USAGE}:
        return USAGE
    return FAILED if codes & {USAGE, FAILED} else max(codes)


def _recover_one(path: Path, args: argparse.Namespace) -> int:
    try:
        with Line(delay=PROGRESS_DELAY_S) as line:
            result: Recovery = recover(path, args.out, in_place=args.in_place, show=line.share)
    except RecordError as error:
        return _failed(error)
    print("\n".join(map(printable, result.lines())))
    return DONE if result.clean else LOSS


def _failed(error: RecordError) -> int:
    """Print the error; return its exit code: a file that is not a log is a mistake in the command."""
    tell(str(error))
    return USAGE if isinstance(error, NoLogError) else FAILED


def _compact(args: argparse.Namespace) -> int:
    try:
        with Line(delay=PROGRESS_DELAY_S) as line:
            compacted = compact_run(args.run, line.share)
    except RecordError as error:
        return _failed(error)
    for file in compacted:
        torn = f"; a torn end of {file.dropped:,} bytes was dropped" if file.dropped else ""
        sizes = f"{file.before:,} bytes before, {file.after:,} after, {file.messages:,} messages"
        print(printable(f"{file.path}: {sizes}{torn}"))
    before, after = sum(f.before for f in compacted), sum(f.after for f in compacted)
    print(f"{len(compacted)} files: {before:,} bytes before, {after:,} after ({after / before:.0%})")
    return LOSS if any(file.dropped for file in compacted) else DONE


MAINS: dict[str, Callable[[argparse.Namespace], int]] = {"check": _check, "recover": _recover, "compact": _compact}

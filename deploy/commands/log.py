"""`overfly log ...`: prints the contents of a run's log, as text and CSV."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path

from deploy.commands import log_check, log_export
from tmc.kernel.text import printable
from tmc.record import queries
from tmc.record.errors import RecordError
from tmc.record.reader import Log, info
from tmc.record.run_folder import logs_in, run_files
from tmc.wire.process import DONE, FAILED, tell

JOURNAL_VIEWS = ("moves", "uncertainty", "events", "digest")
VIEWS = ("info", "cat", "moves", "uncertainty", "events", "digest")
MORE = (log_check, log_export)
"""Modules that add their own views."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    views = parser.add_subparsers(dest="view", required=True, metavar="VIEW")
    about = {
        "info": "files, topics and counts",
        "cat": "every message, one line of JSON per message",
        "moves": "CSV tick,uav,cell; tick 0 is the start",
        "uncertainty": "CSV tick,value: the sum over cells of the true map",
        "events": "CSV tick,cell: events that appeared (scenario I)",
        "digest": "the hash of all trajectories, printed as the last word",
    }
    for view in VIEWS:
        sub = views.add_parser(view, help=about[view], description=about[view])
        sub.add_argument(
            "run", type=Path, help="run folder" + (", or one MCAP file" if view in {"info", "cat"} else "")
        )
        if view in {"moves", "uncertainty", "events"}:
            sub.add_argument("--episode", type=int, default=1, metavar="E", help="from 1 (default: 1)")
        if view == "info":
            sub.add_argument("--json", action="store_true", help="print JSON")
        if view == "cat":
            sub.add_argument("--topic", action="append", metavar="TOPIC", help="only this topic; may be repeated")
    for module in MORE:
        for view, text in module.ABOUT.items():
            module.add_options(view, views.add_parser(view, help=text, description=text))


def main(args: argparse.Namespace) -> int:
    """Print one view; return exit code 1 if its log is damaged, since the view is then incomplete.

    `info` reports damage too, but returns 0. Raises RecordError.
    """
    damage = _damage(args.run) if args.view in JOURNAL_VIEWS else None
    try:
        code = _MAINS[args.view](args)
    except RecordError as error:
        raise RecordError(f"{error} ({damage})" if damage else str(error)) from None
    if damage:
        tell(f"the output is incomplete: {damage}")
    return 1 if damage else code


def _damage(run: Path) -> str | None:
    """Return how the TMC's journal is damaged, None if it is not; a journal that still grows is not damaged."""
    path = run_files(run).get("tmc")
    if path is None:
        return None
    log = Log(path)
    return None if log.still_open else log.damage


def _info(args: argparse.Namespace) -> int:
    rows = []
    for role, path in logs_in(args.run).items():
        found = info(path)
        for name, topic in found.topics.items():
            rows.append({"process": role, "topic": name, "schema": topic.schema, "messages": topic.count})
        if found.damage:
            tell(f"{path}: {found.damage}")
        if not args.json:
            print(printable(f"{role}  {path}  {found.bytes:,} bytes  {_when(found.first)} to {_when(found.last)}"))
            for name, topic in found.topics.items():
                print(printable(f"  {topic.count:>9,}  {name:<24} {topic.schema}"))
    if args.json:
        print(json.dumps(rows, indent=1))
    return 0


def _when(time_ns: int | None) -> str:
    return "-" if time_ns is None else datetime.fromtimestamp(time_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _cat(args: argparse.Namespace) -> int:
    from google.protobuf.json_format import MessageToDict  # noqa: PLC0415  slow to import, used only here

    wanted, damage = set(args.topic or ()), []
    for path in logs_in(args.run).values():
        log = Log(path)
        for entry in log.entries(args.topic):
            wanted.discard(entry.topic)
            body = MessageToDict(entry.message, preserving_proto_field_name=True)
            head = {name: getattr(entry, name) for name in ("topic", "log_time", "publish_time", "sequence")}
            print(json.dumps(head | {"message": body}))
        damage += [log.damage] if log.damage and not log.still_open else []
    for text in damage:
        tell(f"the output is incomplete: {text}")
    if wanted and not damage:
        raise RecordError(
            f"{args.run} holds nothing on {', '.join(sorted(wanted))}: `overfly log info` lists its topics"
        )
    return FAILED if damage else DONE


def _csv(header: str, rows: Iterable[tuple[object, ...]]) -> int:
    sys.stdout.write(header + "\n")
    sys.stdout.writelines(",".join(map(repr, row)) + "\n" for row in rows)
    return 0


def _digest(args: argparse.Namespace) -> int:
    episodes = queries.tracks(args.run)
    if not episodes:
        raise RecordError(f"{args.run} holds no flight record: nothing was flown")
    print(f"{len(episodes)} episode(s) {queries.digest(args.run)}")
    return 0


_MAINS: dict[str, Callable[[argparse.Namespace], int]] = {
    "info": _info,
    "cat": _cat,
    "moves": lambda a: _csv("tick,uav,cell", queries.moves(a.run, a.episode)),
    "uncertainty": lambda a: _csv("tick,value", queries.uncertainty(a.run, a.episode)),
    "events": lambda a: _csv("tick,cell", queries.events(a.run, a.episode)),
    "digest": _digest,
} | {view: main for module in MORE for view, main in module.MAINS.items()}

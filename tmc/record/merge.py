"""Merge the logs of all processes of a run into one MCAP file, in order of log time: `overfly log merge`."""

from __future__ import annotations

import heapq
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from mcap.records import Attachment, Metadata

from tmc.record.disk import open_log
from tmc.record.errors import RecordError
from tmc.record.mcap.export import Export
from tmc.record.mcap.parser import Message
from tmc.record.mcap.strict import DamageError, contents
from tmc.record.reader import Log, require_format

NAME = "overfly/merged"
"""The metadata record that only a merged file has."""
_PREFIX = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*")
_TIME = operator.attrgetter("log_time")


@dataclass(frozen=True)
class Merged:
    """The result: messages and files.

    `damage`: what is wrong with the files, one sentence each. `open`: files that were not closed, because the run is
    still going on or was killed.
    """

    path: Path
    files: int
    messages: int
    damage: tuple[str, ...]
    open: tuple[Path, ...]


@dataclass
class _Source:
    """A file to merge. `ordered`: its log times never decrease, as in every log that Overfly writes."""

    process: str
    log: Log
    attachments: list[Attachment] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    messages: int = 0
    ordered: bool = True

    def by_time(self) -> Iterable[Message]:
        """Return its intact messages by log time; messages of the same time in the order of the file."""
        return self.log.raw() if self.ordered else sorted(self.log.raw(), key=_TIME)


def merge(
    files: Mapping[str, Path], out: Path, prefix: str = "", show: Callable[[int, int], None] = lambda _done, _all: None
) -> Merged:
    """Write all intact messages of `files` ({process: log}) to `out`, by log time, then in the order of the files.

    `prefix` goes before every topic: `A` makes `/A/tmc/sync`. `show` gets the number of messages written, and of all
    messages. A damaged file is merged up to the damage. RecordError when no file can be read, or `out` not be written.
    """
    before = topic_prefix(prefix)
    sources, damage = _sources(files)
    if out.resolve() in {source.log.path.resolve() for source in sources}:
        raise RecordError(f"{out} is one of the files to merge: choose another name for the merged one")
    total, written = sum(source.messages for source in sources), 0
    with Export(out) as export:
        _carry_over(sources, export, before)
        for process, raw in _in_order(sources):
            export.put(
                before + raw.topic, raw.schema, raw.definition.data if raw.definition else b"", raw.data, raw.log_time,
                raw.publish_time, raw.sequence, process,
            )  # fmt: skip
            written += 1
            show(written, total)
    logs = [source.log for source in sources]
    still_open = {log.path for log in logs if log.still_open}
    damage += [log.damage for log in logs if log.damage and log.path not in still_open]
    return Merged(out, len(sources), written, tuple(damage), tuple(sorted(still_open)))


def topic_prefix(prefix: str) -> str:
    """Return `/A` for `A`, `A/` or `/A/`, empty for an empty prefix. RecordError for what viewers reject in a topic."""
    bare = prefix.strip("/")
    if bare and not _PREFIX.fullmatch(bare):
        raise RecordError(f"--prefix {prefix} is not part of a topic: use letters, digits, _, - and / between them")
    return f"/{bare}" if bare else ""


def _sources(files: Mapping[str, Path]) -> tuple[list[_Source], list[str]]:
    """Return the files that can be read, and a sentence on each other; RecordError when none can be read."""
    sources, unreadable = [], []
    for process, path in files.items():
        try:
            sources.append(_survey(process, path))
        except RecordError as error:  # empty, or not a log: the rest of the run can still be merged
            unreadable.append(str(error))
    if not sources:
        raise RecordError("; ".join(unreadable))
    return sources, unreadable


def _survey(process: str, path: Path) -> _Source:
    source, last = _Source(process, Log(path)), 0
    try:
        with open_log(path) as file:
            for item in contents(file):
                require_format(path, item)
                if isinstance(item, Attachment):
                    source.attachments.append(item)
                elif isinstance(item, Metadata):
                    source.metadata.append(item)
                elif item:
                    times = [last, *(raw.log_time for raw in item)]
                    source.ordered &= all(a <= b for a, b in pairwise(times))
                    source.messages, last = source.messages + len(item), times[-1]
    except DamageError:
        pass  # `Log.damage` describes it
    return source


def _carry_over(sources: list[_Source], export: Export, prefix: str) -> None:
    """Copy metadata and attachments. Attachments of one name with different data get the process before the name."""
    for source in sources:
        for record in source.metadata:
            export.add_metadata(record.name, record.metadata)
    export.add_metadata(NAME, {"files": " ".join(s.log.path.name for s in sources), "prefix": prefix})
    kept: dict[str, bytes] = {}
    for source in sources:
        for a in source.attachments:
            name = a.name if kept.setdefault(a.name, a.data) == a.data else f"{source.process}/{a.name}"
            export.attach(name, a.media_type, a.data, a.log_time, a.create_time)


def _in_order(sources: list[_Source]) -> Iterator[tuple[str, Message]]:
    def labelled(source: _Source) -> Iterator[tuple[str, Message]]:
        return ((source.process, raw) for raw in source.by_time())

    return heapq.merge(*map(labelled, sources), key=lambda pair: pair[1].log_time)

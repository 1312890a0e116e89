"""Reads logs back: finished, still written, or cut off by a crash. What is given out is intact; nothing is guessed."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Metadata

from tmc.record.channels import ACTIVE, FORMAT
from tmc.record.disk import open_log
from tmc.record.errors import NoLogError, RecordError
from tmc.record.mcap.parser import MAGIC, RECOVERED, DamageError, Raw, contents
from tmc.record.mcap.salvage import goes_on
from tmc.record.schemas import message_class

_LOG_NAME = re.compile(rf"(tmc|learner|uav-\d+)\.mcap({re.escape(ACTIVE)})?")


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A message of a log. `log_time`, `publish_time`: ns; `sequence`: a counter a topic; `message`: protobuf."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    message: Any


class Log:
    """One log file. RecordError when it is missing, empty, not MCAP, or of another format; damage is noted instead."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        _check_start(self.path)
        self._damage: DamageError | None = None
        self._read = False
        self._finished = False

    def raw(self, topics: Collection[str] | None = None) -> Iterator[Raw]:
        """All intact messages in file order, of these topics only when given, not decoded."""
        for item in self._items():
            if isinstance(item, list):
                yield from (raw for raw in item if topics is None or raw.topic in topics)

    def entries(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """All intact messages in file order, of these topics only when given."""
        for raw in self.raw(topics):
            yield LogMessage(raw.topic, raw.log_time, raw.publish_time, raw.sequence, decode(raw))

    @property
    def damage(self) -> str | None:
        """What is wrong with the file and where, or None: nothing behind that place is read.

        A file that is still written is not damaged for having no end. Reads the whole file unless that was done.
        """
        self._know()
        if self._damage is not None:
            return f"{self.path.name}: {self._damage}"
        if not self._finished and not self.path.name.endswith(ACTIVE):
            return f"{self.path.name}: it is cut, at byte {self.path.stat().st_size}"
        return None

    @property
    def cut(self) -> bool:
        """True when all that is wrong is that the file ends too early, as after a kill."""
        self._know()
        return not self._finished and (self._damage is None or self._damage.cut)

    @property
    def still_open(self) -> bool:
        """True for a file that still grows, or that a kill cut off, and is intact so far."""
        return self.path.name.endswith(ACTIVE) and self.cut

    @property
    def finished(self) -> bool:
        """True when the file was closed in order and is intact to its end."""
        self._know()
        return self._finished

    def metadata(self) -> dict[str, str]:
        """All facts in the file; where incarnations of a process differ, the last one's."""
        found: dict[str, str] = {}
        for item in self._items():
            if isinstance(item, Metadata):
                found |= item.metadata
        return found

    @property
    def lost(self) -> dict[str, str]:
        """What is missing in a file that was recovered from a damaged one (`overfly log recover`); empty otherwise.

        It stands before the first chunk, so no more than that is read.
        """
        head = takewhile(lambda item: not isinstance(item, list), self._items())
        told = [item.metadata for item in head if isinstance(item, Metadata) and item.name == RECOVERED]
        return {key: "; ".join(facts[key] for facts in told) for key in (told[0] if told else {})}

    def extras(self) -> list[Metadata | Attachment]:
        """What there is besides messages: metadata records, of each incarnation of the process, and attachments."""
        return [item for item in self._items() if isinstance(item, Metadata | Attachment)]

    def attachments(self) -> list[Attachment]:
        """The files within the file: name, media_type, data."""
        return [item for item in self.extras() if isinstance(item, Attachment)]

    def _know(self) -> None:
        if not self._read:
            for _ in self._items():
                pass

    def _items(self) -> Iterator[list[Raw] | Metadata | Attachment | None]:
        damage, finished = None, False
        try:
            with open_log(self.path) as file:
                for item in contents(file):
                    finished = item is None
                    require_format(self.path, item)
                    yield item
        except DamageError as error:
            damage = error
            if error.size and goes_on(self.path, error.at, error.size):
                damage = DamageError(error.at, "the length of a record is damaged")
        self._damage, self._finished, self._read = damage, finished, True


def require_format(path: Path, item: list[Raw] | Metadata | Attachment | None) -> None:
    """Raise RecordError if an item of a log is metadata that states another version of the log format."""
    if isinstance(item, Metadata) and item.name.startswith("overfly/"):
        found = item.metadata.get("format", FORMAT)
        if found != FORMAT and found.isdecimal():  # anything else is damage, which is noted as such
            fix = "use the version of Overfly that wrote it"
            raise RecordError(f"{path} was written in log format {found[:20]}, this version reads {FORMAT}: {fix}")


def _check_start(path: Path) -> None:
    with open_log(path) as file:
        start = file.read(len(MAGIC))
    if not start:
        raise NoLogError(f"{path} is empty: its process was killed before it wrote, so there is nothing to read")
    if not MAGIC.startswith(start):
        raise NoLogError(f"{path} is not an MCAP file: give one that ends in .mcap or .mcap{ACTIVE}")


def decode(raw: Raw) -> Any:
    """The protobuf message: of our own class where we know the schema, else of the class that the file describes."""
    try:
        return _class(raw.schema, raw.described).FromString(raw.data)
    except (DecodeError, KeyError, TypeError):
        raise RecordError(f"a message on {raw.topic} is no {raw.schema}: the log was made by something else") from None


@cache
def _class(schema: str, described: bytes) -> Any:
    try:
        return message_class(schema)
    except RecordError:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(described).file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema))


def read(path: str | os.PathLike[str], topics: Collection[str] | None = None) -> Iterator[LogMessage]:
    """All intact messages of a log in file order; `Log` also tells of damage."""
    return Log(path).entries(topics)


def run_files(folder: str | os.PathLike[str]) -> dict[str, Path]:
    """{process: its log} of a run, `tmc` and `learner` first; NoLogError when the folder holds none.

    Where both names exist, a resumed log is just taking over from the finished one, and holds all of it, unless it is
    empty.
    """
    folder = Path(folder)
    paths, why = list[Path](), "tmc.mcap and others"
    try:
        paths = sorted(p for p in folder.iterdir() if _LOG_NAME.fullmatch(p.name) and p.is_file())
    except OSError as error:
        why = str(error.strerror)
    if not paths:
        raise NoLogError(f"{folder} holds no logs of a run ({why}): give the folder of a run")
    found: dict[str, Path] = {}
    for path in paths:
        name = path.name.partition(".")[0]
        if name not in found or path.stat().st_size or not found[name].stat().st_size:
            found[name] = path
    return dict(sorted(found.items(), key=lambda item: (item[0].startswith("uav"), item[0] != "tmc", item[0])))


def logs_in(path: str | os.PathLike[str]) -> dict[str, Path]:
    """{process: its log} of the folder of a run, or of what was given as a single log."""
    path = Path(path)
    return run_files(path) if os.path.isdir(path) else {path.name.partition(".")[0]: path}  # noqa: PTH112  never raises


@dataclass(frozen=True)
class TopicInfo:
    """One topic: messages, bytes of payload before compression, and first and last log time (ns)."""

    schema: str
    count: int
    bytes: int
    first: int
    last: int


@dataclass(frozen=True)
class Info:
    """A log at a glance: `bytes` on disk; `first` and `last` log time (ns), None when it holds no message."""

    path: Path
    bytes: int
    finished: bool
    damage: str | None
    topics: Mapping[str, TopicInfo]

    @property
    def first(self) -> int | None:
        return min((t.first for t in self.topics.values()), default=None)

    @property
    def last(self) -> int | None:
        return max((t.last for t in self.topics.values()), default=None)


def info(path: str | os.PathLike[str]) -> Info:
    """Count what a log holds."""
    log = Log(path)
    topics: dict[str, TopicInfo] = {}
    for raw in log.raw():
        old = topics.get(raw.topic, TopicInfo(raw.schema, 0, 0, raw.log_time, raw.log_time))
        size = old.bytes + len(raw.data)
        topics[raw.topic] = TopicInfo(raw.schema, old.count + 1, size, old.first, max(old.last, raw.log_time))
    return Info(log.path, log.path.stat().st_size, log.finished, log.damage, dict(sorted(topics.items())))

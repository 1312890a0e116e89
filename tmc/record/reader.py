"""Read logs: finished, still written, or cut off by a crash. Only what is intact is given out; nothing is guessed."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import TypeVar, overload

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtobufMessage
from mcap.records import Attachment, Metadata

from tmc.record.channels import ACTIVE, FORMAT
from tmc.record.disk import open_log
from tmc.record.errors import NoLogError, RecordError
from tmc.record.mcap.parser import MAGIC, RECOVERED, UNKNOWN_LENGTH, Message
from tmc.record.mcap.salvage import intact_behind
from tmc.record.mcap.strict import DamageError, contents
from tmc.record.schemas import message_class

M = TypeVar("M", bound=ProtobufMessage)


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A decoded message. `log_time`, `publish_time`: ns; `sequence`: a counter per topic; `message`: protobuf."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    message: ProtobufMessage


class Log:
    """Read one log file.

    Raises RecordError when it is missing, empty, not MCAP, or of another log format; `damage` has all else.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        _check_start(self.path)
        self._damage: DamageError | None = None
        self._read = False
        self._finished = False

    def raw(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the intact messages in file order, not decoded; of these topics only, when given."""
        for item in self._items():
            if isinstance(item, list):
                yield from (raw for raw in item if topics is None or raw.topic in topics)

    def entries(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Yield the intact messages in file order, decoded; of these topics only, when given."""
        for raw in self.raw(topics):
            yield LogMessage(raw.topic, raw.log_time, raw.publish_time, raw.sequence, decode(raw))

    def messages(self, *kinds: type[M]) -> Iterator[M]:
        """Yield the intact messages of these generated classes, such as `overfly_pb2.Sync`, in file order."""
        wanted = {kind.DESCRIPTOR.full_name: kind for kind in kinds}
        for raw in self.raw():
            if raw.schema in wanted:
                yield decode(raw, wanted[raw.schema])

    @property
    def damage(self) -> str | None:
        """What is wrong with the file and where; None when nothing is. Nothing behind the damage is read.

        A file that is still written is not damaged because it has no end. Reads the whole file on first use.
        """
        self._read_once()
        if self._damage is not None:
            return f"{self.path.name}: {self._damage}"
        if not self._finished and not self.path.name.endswith(ACTIVE):
            return f"{self.path.name}: it is cut, at byte {self.path.stat().st_size}"
        return None

    @property
    def cut(self) -> bool:
        """True when all that is wrong is that the file ends too early, as after a kill."""
        self._read_once()
        return not self._finished and (self._damage is None or self._damage.cut)

    @property
    def still_open(self) -> bool:
        """True for a file that still grows, or that a kill cut off, and is intact so far."""
        return self.path.name.endswith(ACTIVE) and self.cut

    @property
    def finished(self) -> bool:
        """True when the file was closed in order and is intact to its end."""
        self._read_once()
        return self._finished

    def metadata(self) -> dict[str, str]:
        """Return all metadata; where incarnations of a process differ, those of the last one."""
        found: dict[str, str] = {}
        for item in self._items():
            if isinstance(item, Metadata):
                found |= item.metadata
        return found

    @property
    def lost(self) -> dict[str, str]:
        """What is missing in a file that was recovered from a damaged one (`overfly log recover`); empty otherwise.

        It stands before the first chunk, so nothing behind that is read.
        """
        head = takewhile(lambda item: not isinstance(item, list), self._items())
        losses = [item.metadata for item in head if isinstance(item, Metadata) and item.name == RECOVERED]
        return {key: "; ".join(facts[key] for facts in losses) for key in (losses[0] if losses else {})}

    def extras(self) -> list[Metadata | Attachment]:
        """Return what is not a message: attachments, and the metadata of each incarnation of the process."""
        return [item for item in self._items() if isinstance(item, Metadata | Attachment)]

    def attachments(self) -> list[Attachment]:
        """Return the attached files: name, media_type, data."""
        return [item for item in self.extras() if isinstance(item, Attachment)]

    def _read_once(self) -> None:
        if not self._read:
            for _ in self._items():
                pass

    def _items(self) -> Iterator[list[Message] | Metadata | Attachment | None]:
        damage, finished = None, False
        try:
            with open_log(self.path) as file:
                for item in contents(file):
                    finished = item is None
                    require_format(self.path, item)
                    yield item
        except DamageError as error:
            damage = error
            if error.size and intact_behind(self.path, error.at, error.size):
                damage = DamageError(error.at, UNKNOWN_LENGTH)
        self._damage, self._finished, self._read = damage, finished, True


def require_format(path: Path, item: list[Message] | Metadata | Attachment | None) -> None:
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


@overload
def decode(raw: Message) -> ProtobufMessage: ...
@overload
def decode(raw: Message, kind: type[M]) -> M: ...
def decode(raw: Message, kind: type[ProtobufMessage] | None = None) -> ProtobufMessage:
    """Return the protobuf message: of Overfly's class where the schema is known, else of the class in the file.

    `kind`: the generated class of the schema, where the caller knows it. RecordError when the bytes are of another.
    """
    try:
        return (kind or _class(raw.schema, raw.definition.data if raw.definition else b"")).FromString(raw.data)
    except (DecodeError, KeyError, TypeError):
        raise RecordError(
            f"a message on {raw.topic} is not an {raw.schema}: the log was made by another program"
        ) from None


@cache
def _class(schema: str, described: bytes) -> type[ProtobufMessage]:
    try:
        return message_class(schema)
    except RecordError:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(described).file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema))


def read(path: str | os.PathLike[str], topics: Collection[str] | None = None) -> Iterator[LogMessage]:
    """Yield the intact messages of a log in file order; `Log` also reports damage."""
    return Log(path).entries(topics)


@dataclass(frozen=True)
class TopicInfo:
    """One topic: messages, payload before compression in bytes, and first and last log time, ns."""

    schema: str
    count: int
    bytes: int
    first: int
    last: int


@dataclass(frozen=True)
class Info:
    """A summary of a log: `bytes` on disk; `first` and `last` log time, ns, None when it holds no message."""

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
    """Count the messages and bytes of each topic of a log."""
    log = Log(path)
    topics: dict[str, TopicInfo] = {}
    for raw in log.raw():
        old = topics.get(raw.topic, TopicInfo(raw.schema, 0, 0, raw.log_time, raw.log_time))
        size = old.bytes + len(raw.data)
        topics[raw.topic] = TopicInfo(raw.schema, old.count + 1, size, old.first, max(old.last, raw.log_time))
    return Info(log.path, log.path.stat().st_size, log.finished, log.damage, dict(sorted(topics.items())))

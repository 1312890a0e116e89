"""Finds all that is sound in an MCAP file, behind damage too: what `recover` and `seal` copy.

Only what a CRC vouches for is given out: chunks, and attachments. Where a record is not sound, the next chunk or
attachment whose CRC holds is looked for. Numbers of messages never go back, so a stretch that stands in the file twice
counts once. Metadata have no CRC of their own and are taken as they stand, where they stand in line.
"""

from __future__ import annotations

import hashlib
import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from tmc.record.errors import RecordError
from tmc.record.frames import MAGIC, RECOVERED

PROFILE = "overfly"
"""Of our files, whose messages are numbered by topic."""
CUT = "it is cut"
"""Why the end of a file is lost that a kill left behind."""
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_LARGEST = 1 << 32
"""Bytes of the largest chunk that is believed in: a damaged size must not take all memory."""
_CANDIDATE = re.compile(rb"[\x06\x09](?=.{5}\0\0\0)", re.DOTALL)
"""Opcode of a chunk or an attachment, and a length below 2^40."""
_AGO = 1 << 31
"""Half of the 32 bits in which messages are numbered: a number farther ahead than that lies behind."""
_FOOT = _HEAD.size + 20 + len(MAGIC)
_DATA_END = _HEAD.size + 4


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it stands in the file, with the channel and the schema that describe it."""

    channel: Channel
    schema: Schema | None
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class Lost:
    """A stretch of the file that nothing sound was found in: where, how long, and why."""

    at: int
    bytes: int
    why: str

    def __str__(self) -> str:
        return f"{self.bytes:,} bytes from byte {self.at:,} ({self.why})"


@dataclass
class Findings:
    """What came of reading a file to its end.

    `finished`: it was closed in order. `missing`: messages that are missing, as the numbers of others tell; `nameless`:
    sound ones whose topic nothing sound tells. `notes`: what is wrong without anything being lost.
    """

    profile: str = ""
    finished: bool = False
    messages: int = 0
    missing: int = 0
    nameless: int = 0
    lost: list[Lost] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def whole(self) -> bool:
        """Nothing is lost."""
        return not (self.lost or self.missing or self.nameless)


Item: TypeAlias = list[Message] | Metadata | Attachment


class _UnsoundError(Exception):
    """A record that is not sound: why."""


@dataclass
class _Known:
    """Schemas and channels by id, and the next number of each channel."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    next: dict[int, int] = field(default_factory=dict)

    def describe(self, opcode: int, body: bytes) -> None:
        """Take in a description; one that contradicts what is known belongs to another file."""
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        known: dict[int, Any] = self.schemas if opcode == Opcode.SCHEMA else self.channels
        record = (Schema if opcode == Opcode.SCHEMA else Channel).read(ReadDataStream(BytesIO(body)))
        if known.setdefault(record.id, record) != record:
            raise _UnsoundError("its descriptions contradict those before")


Show = Callable[[str, float], None]
"""Is told what is done, and how much of it: 0 to 1."""


def unseen(_what: str, _share: float) -> None:
    """Shows nothing."""


def salvage(path: Path, what: str = "", show: Show = unseen) -> tuple[Findings, Iterator[Item]]:
    """What is sound in a file, in its order; the findings are complete when all of it was taken.

    `what` is done with the items, which `show` is told. RecordError when the file cannot be read or is empty.
    """
    found = Findings()
    try:
        with path.open("rb") as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise RecordError(f"{path} cannot be read ({error.strerror}): check the path of the log") from None
    except ValueError:  # mmap knows no empty files
        raise RecordError(f"{path} is empty: its process was killed before it wrote, so nothing is lost") from None
    scan = _Scan(data, found, path.suffix != ".mcap", lambda share: show(f"{what} {path.name}", share))
    return found, scan.items()


class _Scan:
    """One pass over the bytes of a file; `active`: its name says that it was never finished."""

    def __init__(self, data: mmap.mmap, found: Findings, active: bool, show: Callable[[float], None]) -> None:
        self.data, self.size, self.found, self.active, self.show = data, len(data), found, active, show
        self.known = _Known()
        self.attached: set[bytes] = set()
        self.numbered, self.told = True, False
        self.data_end = -1
        self.data_end = self._summary()
        """Where the data ends, as a sound summary says; -1 without one."""

    def items(self) -> Iterator[Item]:
        """Everything sound; fills in the findings."""
        at = self._start()
        while at < self.size and not self.found.finished:
            if at == self.data_end:
                self._finish(at)
                return
            missing = self.found.missing
            try:
                end, item = self._record(at)
            except _UnsoundError as unsound:
                at = self._lose(at, str(unsound))
                continue
            if self.found.missing > missing and not self.found.lost:
                self.found.lost.append(Lost(at, 0, "messages are missing before it"))
            at = end
            self.show(at / self.size)
            if item is not None:
                yield item
        self._end(at)

    def _start(self) -> int:
        if self.data[: len(MAGIC)] == MAGIC:
            return len(MAGIC)
        why = "it does not begin as MCAP does"
        with suppress(_UnsoundError):
            if self._body(len(MAGIC))[0] == Opcode.HEADER:
                self._record(len(MAGIC))
                self.found.lost.append(Lost(0, len(MAGIC), why))
                return len(MAGIC)
        return self._lose(0, why)

    def _lose(self, at: int, why: str) -> int:
        """Note the loss from `at` to the next record that is sound, and go on there."""
        after = self._next(at + 1)
        why = "the length of a record is damaged" if why == CUT and after < self.size else why
        self.found.lost.append(Lost(at, after - at, why))
        return after

    def _next(self, at: int) -> int:
        """Where the next chunk or attachment begins that a CRC vouches for, or the data ends."""
        for match in _CANDIDATE.finditer(self.data, at):
            if self.data_end >= at and match.start() > self.data_end:
                break
            with suppress(_UnsoundError):
                self._record(match.start(), dry=True)
                return match.start()
        return self.data_end if self.data_end >= at else self.size

    def _end(self, at: int) -> None:
        if self.found.finished:
            return
        if not self.active and not self.found.lost:
            self.found.lost.append(Lost(at, 0, "it is cut, and what came behind is not known"))

    def _body(self, at: int) -> tuple[int, int, bytes]:
        """Opcode, end and body of the record at `at`."""
        if at + _HEAD.size > self.size:
            raise _UnsoundError(CUT)
        opcode, length = _HEAD.unpack_from(self.data, at)
        end = at + _HEAD.size + length
        if end > (self.data_end if at < self.data_end else self.size):
            raise _UnsoundError(CUT)
        return opcode, end, self.data[at + _HEAD.size : end]

    def _record(self, at: int, *, dry: bool = False) -> tuple[int, Item | None]:
        """End and content of a record; with `dry` it is only looked at."""
        opcode, end, body = self._body(at)
        read = _READERS.get(opcode)
        if read is None:
            raise _UnsoundError(f"a record of unknown kind {opcode}")
        try:
            return end, read(self, at, body, dry)
        except _UnsoundError:
            raise
        except Exception as error:  # garbage makes zstandard and struct raise whatever they like
            raise _UnsoundError(f"a record is not sound: {error}") from None

    def _header(self, at: int, body: bytes, _dry: bool) -> None:
        header = Header.read(ReadDataStream(BytesIO(body)))
        if at != len(MAGIC) or 8 + len(header.profile.encode()) + len(header.library.encode()) != len(body):
            raise _UnsoundError("its header is damaged")
        self.found.profile, self.numbered = header.profile, header.profile == PROFILE

    def _index(self, _at: int, body: bytes, _dry: bool) -> None:
        """An index holds no fact, but its length must be right for the record behind it to be found."""
        if len(body) < 6 or int.from_bytes(body[2:6], "little") != len(body) - 6 or (len(body) - 6) % 16:
            raise _UnsoundError("an index is damaged")

    def _metadata(self, _at: int, body: bytes, _dry: bool) -> Metadata:
        stream = ReadDataStream(BytesIO(body))
        metadata = Metadata.read(stream)
        if stream.count != len(body):
            raise _UnsoundError("metadata are damaged")
        self.told |= metadata.name == RECOVERED
        return metadata

    def _attachment(self, _at: int, body: bytes, dry: bool) -> Attachment:
        if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            raise _UnsoundError("the CRC of an attachment is wrong")
        if (digest := hashlib.sha256(body).digest()) in self.attached:
            raise _UnsoundError("an attachment was read before")
        if not dry:
            self.attached.add(digest)
        return Attachment.read(ReadDataStream(BytesIO(body)))

    def _chunk(self, _at: int, body: bytes, dry: bool) -> list[Message]:
        head = ReadDataStream(BytesIO(body))
        chunk = Chunk.read(head)
        if head.count != len(body) or chunk.uncompressed_size > _LARGEST:
            raise _UnsoundError("the size of a chunk is damaged")
        stream, size = get_chunk_data_stream(chunk)
        data = stream.read(size)
        if size != chunk.uncompressed_size or zlib.crc32(data) != chunk.uncompressed_crc:
            raise _UnsoundError("the CRC of a chunk is wrong")
        known = _Known(dict(self.known.schemas), dict(self.known.channels), dict(self.known.next))
        read = _ChunkReader(known, self.numbered, 0 if self.found.lost else None)
        messages = read.messages(data)
        if not dry:
            self.known = known
            self.found.messages += len(messages)
            self.found.missing += 0 if self.told else read.missing
            self.found.nameless += read.nameless
        return messages

    def _data_end(self, at: int, body: bytes, dry: bool) -> None:
        """The end of the data where no sound summary follows: believed in only if nothing else does."""
        if len(body) != 4 or self._next(at + 1) < self.size:
            raise _UnsoundError("it says that it ends, and goes on")
        if not dry:
            self.found.notes.append("its summary is damaged or cut")
            self._finish(at)

    def _finish(self, at: int) -> None:
        """The data ends here; their CRC also covers what has none of its own."""
        head, stated = self.data[at : at + _HEAD.size], self.data[at + _HEAD.size : at + _DATA_END]
        with memoryview(self.data) as view:
            crc = zlib.crc32(view[:at])
        if head != _HEAD.pack(Opcode.DATA_END, 4):
            self.found.notes.append("the record that ends its data is damaged")
        elif int.from_bytes(stated, "little") not in (0, crc) and not self.found.lost:
            self.found.notes.append("its header, its metadata or an index are damaged, which have no CRC of their own")
        self.found.finished = True

    def _summary(self) -> int:
        """Where the data ends, by a summary whose CRC holds; its descriptions are known from the start then."""
        foot = self.size - _FOOT
        if foot < 0 or self.data[foot : foot + _HEAD.size] != _HEAD.pack(Opcode.FOOTER, 20):
            return -1
        footer = Footer.read(ReadDataStream(BytesIO(self.data[foot + _HEAD.size : self.size - len(MAGIC)])))
        start = footer.summary_start or foot
        if not _DATA_END <= start <= foot or self.data[self.size - len(MAGIC) :] != MAGIC:
            return -1
        if zlib.crc32(self.data[start : self.size - len(MAGIC) - 4]) != footer.summary_crc:
            return -1
        at = start
        while at < foot:
            opcode, at, body = self._body(at)
            self.known.describe(opcode, body)
        return start - _DATA_END


class _ChunkReader:
    """The messages of one chunk; `numbered`: their numbers must go up, from `first` on (None: from any)."""

    def __init__(self, known: _Known, numbered: bool, first: int | None) -> None:
        self.known, self.numbered, self.first = known, numbered, first
        self.missing = self.nameless = 0

    def messages(self, data: bytes) -> list[Message]:
        at, found = 0, []
        while at < len(data):
            opcode, length = _HEAD.unpack_from(data, at)
            start, at = at + _HEAD.size, at + _HEAD.size + length
            if opcode == Opcode.MESSAGE:
                message = self._message(data, start, at)
                found += [message] if message else []
            else:
                self.known.describe(opcode, data[start:at])
        return found

    def _message(self, data: bytes, start: int, end: int) -> Message | None:
        number, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
        if self.numbered:
            first = sequence if self.first is None else self.first
            gap = (sequence - self.known.next.get(number, first)) & 0xFFFF_FFFF
            if gap >= _AGO:
                raise _UnsoundError("its messages were read before")
            self.missing += gap
            self.known.next[number] = (sequence + 1) & 0xFFFF_FFFF
        channel = self.known.channels.get(number)
        if channel is None or (channel.schema_id and channel.schema_id not in self.known.schemas):
            self.nameless += 1
            return None
        schema = self.known.schemas.get(channel.schema_id)
        return Message(channel, schema, log_time, publish_time, sequence, data[start + _MESSAGE.size : end])


_READERS: dict[int, Any] = {
    Opcode.HEADER: _Scan._header,
    Opcode.CHUNK: _Scan._chunk,
    Opcode.MESSAGE_INDEX: _Scan._index,
    Opcode.METADATA: _Scan._metadata,
    Opcode.ATTACHMENT: _Scan._attachment,
    Opcode.DATA_END: _Scan._data_end,
}
"""What stands before the summary of our files: schemas, channels and messages are always in chunks."""

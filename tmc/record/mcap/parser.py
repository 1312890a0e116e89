"""The records of an MCAP file, one after the other, each checked; reading stops at the first that is not intact.

A file is magic, records, magic; a record is an opcode (u8), a length (u64) and so many bytes. mcap's own readers take
short reads for whole ones, skip records whose opcode was damaged, and check neither the summary nor attachments.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

MAGIC = b"\x89MCAP0\r\n"
RECOVERED = "overfly/recovered"
"""Metadata of a file that was made of what was intact in another one: what is missing in it, and that this is known."""
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_DATA = frozenset((Opcode.HEADER, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA))
"""What our files hold before DataEnd: schemas, channels and messages are always in chunks."""


class DamageError(Exception):
    """The file is not intact from here on. `cut`: it just ends too early, at byte `size`, as after a kill."""

    def __init__(self, at: int, why: str, cut: bool = False, size: int = 0) -> None:
        super().__init__(f"{why}, at byte {at}")
        self.at, self.cut, self.size = at, cut, size


@dataclass(frozen=True, slots=True)
class Raw:
    """A message as it stands in the file: `data` is of the schema `schema`, described by `described` (descriptor set).

    `log_time`, `publish_time`: ns. `sequence`: a counter a topic.
    """

    topic: str
    schema: str
    described: bytes
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


def frames(file: IO[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """(offset, opcode, body) of each record up to the footer; raises DamageError.

    Returns quietly when the file ends after a whole record, as one does that is still written. What is appended
    after the call is not read.
    """
    size = os.fstat(file.fileno()).st_size
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        raise DamageError(0, "it is cut", cut=True) if MAGIC.startswith(magic) else DamageError(0, "it is not MCAP")
    at, crc, summary = len(MAGIC), zlib.crc32(magic), False
    while at < size:
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, size)
        if at + _HEAD.size + length > size:
            raise DamageError(at, "it is cut", cut=True, size=size)
        body = file.read(length)
        if opcode == Opcode.FOOTER:
            _check_end(file, at, body, zlib.crc32(body[:-4], zlib.crc32(head, crc)), summary)
            yield at, opcode, body
            return
        if opcode == Opcode.DATA_END and not summary:
            _check_crc(at, body, crc, "the data section")
            crc, summary = 0, True
        else:
            if not summary and opcode not in _DATA:
                raise DamageError(at, f"a record of unknown kind {opcode}")
            crc = zlib.crc32(body, zlib.crc32(head, crc))
        yield at, opcode, body
        at += _HEAD.size + length
    if summary:
        raise DamageError(at, "it is cut", cut=True)


def _check_end(file: IO[bytes], at: int, body: bytes, crc: int, summary: bool) -> None:
    if not summary:
        raise DamageError(at, "it ends before its data does")
    _check_crc(at, body, crc, "the summary")
    end = file.read(len(MAGIC) + 1)
    if end != MAGIC:
        cut = MAGIC.startswith(end)
        raise DamageError(at, "it is cut" if cut else "its end is not MCAP's", cut)


def _check_crc(at: int, body: bytes, crc: int, what: str) -> None:
    """Compare the CRC that the last four bytes of a body state; 0 stands for "none"."""
    stated = int.from_bytes(body[-4:], "little")
    if len(body) < 4 or stated not in (0, crc):
        raise DamageError(at, f"the CRC of {what} is wrong")


def contents(file: IO[bytes]) -> Iterator[list[Raw] | Metadata | Attachment | None]:
    """What the file holds, in its order: the messages of a chunk, metadata, an attachment; None at the footer.

    A chunk is checked as a whole before anything of it is given out. Raises DamageError.
    """
    chunks = _Chunks()
    for at, opcode, body in frames(file):
        try:
            if opcode == Opcode.CHUNK:
                yield chunks.messages(body)
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(ReadDataStream(BytesIO(body)))
                chunks.gaps |= metadata.name == RECOVERED
                yield metadata
            elif opcode == Opcode.ATTACHMENT:
                _check_crc(at, body, zlib.crc32(body[:-4]), "an attachment")
                yield Attachment.read(ReadDataStream(BytesIO(body)))
            elif opcode == Opcode.FOOTER:
                yield None
        except (GeneratorExit, DamageError):
            raise
        except Exception as error:  # garbage makes zstandard and struct raise whatever they like
            raise DamageError(at, f"a record is not intact ({error})") from None


class _Chunks:
    """What the chunks so far have told: schemas, channels, and the next sequence number of each channel.

    `gaps`: messages may be missing, but their numbers still go up.
    """

    def __init__(self) -> None:
        self.gaps = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._next: dict[int, int] = {}

    def messages(self, body: bytes) -> list[Raw]:
        """All messages of a chunk; raises anything when it is not intact, a gap in the numbers included."""
        head = ReadDataStream(BytesIO(body))
        chunk = Chunk.read(head)
        stream, size = get_chunk_data_stream(chunk)
        data, at, found = stream.read(size), 0, []
        if head.count != len(body) or zlib.crc32(data) != chunk.uncompressed_crc:  # 0 is no "none": garbage may be 0
            raise ValueError("the CRC of a chunk is wrong")
        while at < size:
            opcode, length = _HEAD.unpack_from(data, at)
            start, at = at + _HEAD.size, at + _HEAD.size + length
            if opcode == Opcode.MESSAGE:
                found.append(self._message(data, start, at))
            else:
                self._describe(opcode, data[start:at])
        return found

    def _describe(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel

    def _message(self, data: bytes, start: int, end: int) -> Raw:
        number, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
        gap = (sequence - self._next.get(number, sequence)) & 0xFFFF_FFFF
        if gap and not (self.gaps and gap < 1 << 31):
            raise ValueError(f"messages are missing before number {sequence}")
        self._next[number] = (sequence + 1) & 0xFFFF_FFFF
        channel = self._channels[number]
        schema: Any = self._schemas[channel.schema_id]
        payload = data[start + _MESSAGE.size : end]
        return Raw(channel.topic, schema.name, schema.data, log_time, publish_time, sequence, payload)

"""Parse the bytes of MCAP: the head of a record, its body, and the messages of a chunk.

This module alone knows the layout of records. Both readers use it: `strict`, which stops at the first damage, and
`salvage`, which continues behind it. A file is magic, records, magic. A record is an opcode (u8), the length of its
body (u64) and the body. mcap's own readers accept short reads, skip records whose opcode is damaged, and check neither
the summary nor attachments, so they are not used.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "overfly"
"""The profile of Overfly's files, whose messages are numbered per topic."""
RECOVERED = "overfly/recovered"
"""Name of the metadata in a recovered file: what is missing in it. Readers then accept gaps in the sequence numbers."""
CUT = "it is cut"
"""The reason for damage at the end of a file whose writer was killed."""
UNKNOWN_LENGTH = "the length of a record is damaged"
"""The reason for a record that seems to end behind records that are intact."""
RECORD_HEAD = struct.Struct("<BQ")
"""Opcode, and length of the body in bytes."""
DATA_END_BYTES = RECORD_HEAD.size + 4
FOOTER_BYTES = RECORD_HEAD.size + 20
CHUNK_LIMIT_BYTES = 1 << 32
"""Largest chunk before compression that is decompressed: a damaged size must not use up all memory."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, log time (ns), publish time (ns)."""
_SEQUENCE_MASK = (1 << 32) - 1
_SEQUENCE_HALF = 1 << 31
"""Sequence numbers wrap at 32 bits: one that lies at least this far ahead lies before the expected one."""


class BadRecordError(Exception):
    """A record is not intact. The text is the reason."""


class Message(NamedTuple):
    """A message as it stands in the file. `data` is a protobuf message of type `schema`.

    `log_time`, `publish_time`: ns. `sequence`: a counter per topic. `channel`, `definition`: the records that describe
    it; `definition` is None and `schema` empty where the channel has no schema.
    """

    topic: str
    schema: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes
    channel: Channel
    definition: Schema | None


@dataclass
class ChannelTable:
    """Schemas and channels by id, and the next sequence number of each channel."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    next: dict[int, int] = field(default_factory=dict)

    def copy(self) -> ChannelTable:
        """Return a table that can change without this one."""
        return ChannelTable(dict(self.schemas), dict(self.channels), dict(self.next))

    def add(self, opcode: int, body: bytes) -> None:
        """Add a schema or a channel; ignore other records. BadRecordError when it contradicts what the table holds."""
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        known: dict[int, Any] = self.schemas if opcode == Opcode.SCHEMA else self.channels
        record = (Schema if opcode == Opcode.SCHEMA else Channel).read(_stream(body))
        if known.setdefault(record.id, record) != record:
            raise BadRecordError("its descriptions contradict those before")


class ChunkParser:
    """Parse the messages of one chunk.

    `table`: what the chunks before it described; it is updated. `numbered`: the sequence numbers of a channel must go
    up. `first`: the number with which a channel begins; None: any. After `messages`, `missing` is the number of gaps in
    the sequence numbers in messages, `missing_before` the number after the first gap, and `nameless` the number of
    messages that are dropped because nothing describes their channel.
    """

    def __init__(self, table: ChannelTable, numbered: bool = True, first: int | None = None) -> None:
        self.table, self.numbered, self.first = table, numbered, first
        self.missing = self.nameless = 0
        self.missing_before: int | None = None

    def messages(self, body: bytes) -> list[Message]:
        """Return the messages of the body of a chunk record. BadRecordError, or any other, when it is not intact."""
        data, at, found = _decompressed(body), 0, []
        size, unpack = len(data), RECORD_HEAD.unpack_from
        while at < size:
            opcode, length = unpack(data, at)
            start, at = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
            if opcode == Opcode.MESSAGE:
                message = self._message(data, start, at)
                if message is not None:
                    found.append(message)
            else:
                self.table.add(opcode, data[start:at])
        return found

    def _message(self, data: bytes, start: int, end: int) -> Message | None:
        number, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(data, start)
        table = self.table
        if self.numbered:
            gap = (sequence - table.next.get(number, sequence if self.first is None else self.first)) & _SEQUENCE_MASK
            if gap:
                self._skip(gap, sequence)
            table.next[number] = (sequence + 1) & _SEQUENCE_MASK
        channel = table.channels.get(number)
        schema = table.schemas.get(channel.schema_id) if channel is not None else None
        if channel is None or (schema is None and channel.schema_id):
            self.nameless += 1
            return None
        payload = data[start + _MESSAGE_HEAD.size : end]
        name = "" if schema is None else schema.name
        return Message(channel.topic, name, log_time, publish_time, sequence, payload, channel, schema)

    def _skip(self, gap: int, sequence: int) -> None:
        if gap >= _SEQUENCE_HALF:
            raise BadRecordError("its messages were read before")
        self.missing += gap
        if self.missing_before is None:
            self.missing_before = sequence


def _decompressed(body: bytes) -> bytes:
    """Return the records in a chunk, checked by size and CRC. A CRC of 0 is compared too: garbage may hold a 0."""
    head = _stream(body)
    chunk = Chunk.read(head)
    if head.count != len(body) or chunk.uncompressed_size > CHUNK_LIMIT_BYTES:
        raise BadRecordError("the size of a chunk is damaged")
    stream, size = get_chunk_data_stream(chunk)
    data: bytes = stream.read(size)
    if size != chunk.uncompressed_size or zlib.crc32(data) != chunk.uncompressed_crc:
        raise BadRecordError("the CRC of a chunk is wrong")
    return data


def parse_header(body: bytes) -> Header:
    """Return the header of a file; BadRecordError unless its two texts fill the body."""
    header = Header.read(_stream(body))
    if sum(4 + len(text.encode()) for text in vars(header).values()) != len(body):
        raise BadRecordError("its header is damaged")
    return header


def parse_metadata(body: bytes) -> Metadata:
    """Return a metadata record; BadRecordError unless it fills the body."""
    stream = _stream(body)
    metadata = Metadata.read(stream)
    if stream.count != len(body):
        raise BadRecordError("metadata are damaged")
    return metadata


def parse_attachment(body: bytes) -> Attachment:
    """Return an attachment; BadRecordError when its CRC is wrong."""
    check_crc(body, zlib.crc32(body[:-4]), "an attachment", required=True)
    return Attachment.read(_stream(body))


def parse_footer(body: bytes) -> Footer:
    """Return the footer of a file."""
    return Footer.read(_stream(body))


def check_index(body: bytes) -> None:
    """Raise BadRecordError unless the length of a message index fits its entries. Its content is not used."""
    if len(body) < 6 or int.from_bytes(body[2:6], "little") != len(body) - 6 or (len(body) - 6) % 16:
        raise BadRecordError("an index is damaged")


def check_crc(body: bytes, crc: int, what: str, *, required: bool = False) -> None:
    """Raise BadRecordError unless the last four bytes of `body` state `crc`, or 0 for "none" if not `required`."""
    stated = int.from_bytes(body[-4:], "little")
    if len(body) < 4 or (stated != crc and (required or stated)):
        raise BadRecordError(f"the CRC of {what} is wrong")


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))

"""The messages of one intact chunk, by what the chunks before it have told: schemas, channels, numbers."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from tmc.record.mcap.findings import Message

HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MESSAGE = struct.Struct("<HIQQ")
_AGO = 1 << 31
"""Half of the 32 bits in which messages are numbered: a number farther ahead than that lies behind."""


class DamagedChunkError(Exception):
    """A record that is not intact: why."""


@dataclass
class ChannelTable:
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
            raise DamagedChunkError("its descriptions contradict those before")


class ChunkReader:
    """The messages of one chunk; `numbered`: their numbers must go up, from `first` on (None: from any)."""

    def __init__(self, known: ChannelTable, numbered: bool, first: int | None) -> None:
        self.known, self.numbered, self.first = known, numbered, first
        self.missing = self.nameless = 0

    def messages(self, data: bytes) -> list[Message]:
        at, found = 0, []
        while at < len(data):
            opcode, length = HEAD.unpack_from(data, at)
            start, at = at + HEAD.size, at + HEAD.size + length
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
                raise DamagedChunkError("its messages were read before")
            self.missing += gap
            self.known.next[number] = (sequence + 1) & 0xFFFF_FFFF
        channel = self.known.channels.get(number)
        if channel is None or (channel.schema_id and channel.schema_id not in self.known.schemas):
            self.nameless += 1
            return None
        schema = self.known.schemas.get(channel.schema_id)
        return Message(channel, schema, log_time, publish_time, sequence, data[start + _MESSAGE.size : end])

"""Read an MCAP file record by record, each checked. Reading stops at the first record that is not intact."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from tmc.record.mcap.parser import (
    CUT,
    MAGIC,
    RECORD_HEAD,
    RECOVERED,
    BadRecordError,
    ChannelTable,
    ChunkParser,
    Message,
    check_crc,
    parse_attachment,
    parse_metadata,
)

_DATA = frozenset((Opcode.HEADER, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA))
"""Records of Overfly's files before DataEnd: schemas, channels and messages are always in chunks."""


class DamageError(Exception):
    """The file is not intact from byte `at` on. `cut`: it only ends too early, at byte `size`, as after a kill."""

    def __init__(self, at: int, why: str, cut: bool = False, size: int = 0) -> None:
        super().__init__(f"{why}, at byte {at}")
        self.at, self.cut, self.size = at, cut, size


def records(file: IO[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """Yield (offset, opcode, body) of each record up to the footer. Raises DamageError.

    Ends without an error when the file ends after a whole record, as one does that is still written. What is appended
    after the call is not read.
    """
    size = os.fstat(file.fileno()).st_size
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        raise DamageError(0, CUT, cut=True) if MAGIC.startswith(magic) else DamageError(0, "it is not MCAP")
    at, crc, summary = len(MAGIC), zlib.crc32(magic), False
    while at < size:
        head = file.read(RECORD_HEAD.size)
        opcode, length = RECORD_HEAD.unpack(head) if len(head) == RECORD_HEAD.size else (0, size)
        if at + RECORD_HEAD.size + length > size:
            raise DamageError(at, CUT, cut=True, size=size)
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
        at += RECORD_HEAD.size + length
    if summary:
        raise DamageError(at, CUT, cut=True)


def _check_end(file: IO[bytes], at: int, body: bytes, crc: int, summary: bool) -> None:
    if not summary:
        raise DamageError(at, "it ends before its data does")
    _check_crc(at, body, crc, "the summary")
    end = file.read(len(MAGIC) + 1)
    if end != MAGIC:
        cut = MAGIC.startswith(end)
        raise DamageError(at, CUT if cut else "its end is not MCAP's", cut)


def _check_crc(at: int, body: bytes, crc: int, what: str) -> None:
    try:
        check_crc(body, crc, what)
    except BadRecordError as error:
        raise DamageError(at, str(error)) from None


def contents(file: IO[bytes]) -> Iterator[list[Message] | Metadata | Attachment | None]:
    """Yield what the file holds, in its order: the messages of a chunk, metadata, an attachment; None at the footer.

    A chunk is checked as a whole before any of its messages is given out. Raises DamageError.
    """
    table, gaps_allowed = ChannelTable(), False
    for at, opcode, body in records(file):
        try:
            if opcode == Opcode.CHUNK:
                yield _messages(table, body, gaps_allowed)
            elif opcode == Opcode.METADATA:
                metadata = parse_metadata(body)
                gaps_allowed |= metadata.name == RECOVERED
                yield metadata
            elif opcode == Opcode.ATTACHMENT:
                yield parse_attachment(body)
            elif opcode == Opcode.FOOTER:
                yield None
        except (GeneratorExit, DamageError):
            raise
        except Exception as error:  # garbage makes zstandard and struct raise many types
            raise DamageError(at, f"a record is not intact ({error})") from None


def _messages(table: ChannelTable, body: bytes, gaps_allowed: bool) -> list[Message]:
    chunk = ChunkParser(table)
    messages = chunk.messages(body)
    if chunk.missing and not gaps_allowed:
        raise BadRecordError(f"messages are missing before number {chunk.missing_before}")
    if chunk.nameless or any(message.definition is None for message in messages):
        raise BadRecordError("nothing describes the topic of a message")
    return messages

"""Find all that is intact in an MCAP file, behind damage too. `recover` and `compact` copy what it finds.

Only what a CRC confirms is given out: chunks and attachments. Where a record is not intact, the scan continues at the
next chunk or attachment whose CRC is right. Sequence numbers never go back, so a stretch that stands in the file twice
counts once. Metadata have no CRC of their own: they are taken as they stand, where the records before them are intact.
"""

from __future__ import annotations

import hashlib
import mmap
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from tmc.record.disk import open_log
from tmc.record.errors import NoLogError
from tmc.record.mcap.findings import Findings, Item, LostSpan, Show, unseen
from tmc.record.mcap.parser import (
    CUT,
    DATA_END_BYTES,
    FOOTER_BYTES,
    MAGIC,
    PROFILE,
    RECORD_HEAD,
    RECOVERED,
    UNKNOWN_LENGTH,
    BadRecordError,
    ChannelTable,
    ChunkParser,
    Message,
    check_index,
    parse_attachment,
    parse_footer,
    parse_header,
    parse_metadata,
)

_CANDIDATE = re.compile(rb"[\x06\x09](?=.{5}\0\0\0)", re.DOTALL)
"""Opcode of a chunk or an attachment, followed by a length below 2^40 bytes."""


def salvage(path: Path, what: str = "", show: Show = unseen) -> tuple[Findings, Iterator[Item]]:
    """Return the findings and an iterator over all that is intact in a file, in its order.

    The findings are complete once the iterator is exhausted. `show` gets `what`, the words for the work, and the share
    that is done. NoLogError when the file cannot be read or is empty.
    """
    found = Findings()
    try:
        with open_log(path) as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise NoLogError(f"{path} cannot be read ({error.strerror}): check the path of the log") from None
    except ValueError:  # mmap refuses empty files
        raise NoLogError(f"{path} is empty: its process was killed before it wrote; remove it") from None
    scan = _Scan(data, found, path.suffix != ".mcap", lambda share: show(f"{what} {path.name}", share))
    return found, scan.items()


def intact_behind(path: Path, at: int, size: int) -> bool:
    """True when an intact chunk or attachment stands behind byte `at` of the first `size` bytes.

    Then the record at `at`, which seems to end behind the file, has a damaged length, and the file is not cut.
    """
    with open_log(path) as file, mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as data:
        scan = _Scan(data, Findings(), True, lambda _: None)
        return scan._next_intact(at + 1) < size


class _Scan:
    """Scan the bytes of a file once. `active`: its name says that it was never finished."""

    def __init__(self, data: mmap.mmap, found: Findings, active: bool, show: Callable[[float], None]) -> None:
        self.data, self.size, self.found, self.active, self.show = data, len(data), found, active, show
        self.table = ChannelTable()
        self.attached: set[bytes] = set()
        self.numbered, self.recovered = True, False
        self.data_end = -1
        self.data_end = self._summary()
        """Offset at which the data ends, by an intact summary; -1 without one."""

    def items(self) -> Iterator[Item]:
        """Yield all that is intact, and fill in the findings."""
        at = self._start()
        while at < self.size and not self.found.finished:
            if at == self.data_end:
                self._finish(at)
                return
            missing = self.found.missing
            try:
                end, item = self._record(at)
            except BadRecordError as error:
                at = self._skip(at, str(error))
                continue
            if self.found.missing > missing and not self.found.lost:
                self.found.lost.append(LostSpan(at, 0, "messages are missing before it"))
            at = end
            self.show(at / self.size)
            if item is not None:
                yield item
        self._end(at)

    def _start(self) -> int:
        if self.data[: len(MAGIC)] == MAGIC:
            return len(MAGIC)
        why = "it does not begin as MCAP does"
        with suppress(BadRecordError):
            if self._body(len(MAGIC))[0] == Opcode.HEADER:
                self._record(len(MAGIC))
                self.found.lost.append(LostSpan(0, len(MAGIC), why))
                return len(MAGIC)
        return self._skip(0, why)

    def _skip(self, at: int, why: str) -> int:
        """Note the loss of the bytes from `at` to the next intact record; return the offset of that record."""
        after = self._next_intact(at + 1)
        why = UNKNOWN_LENGTH if why == CUT and after < self.size else why
        self.found.lost.append(LostSpan(at, after - at, why))
        return after

    def _next_intact(self, at: int) -> int:
        """Return the offset of the next chunk or attachment whose CRC is right, or of the end of the data."""
        for match in _CANDIDATE.finditer(self.data, at):
            if self.data_end >= at and match.start() > self.data_end:
                break
            with suppress(BadRecordError):
                self._record(match.start(), dry=True)
                return match.start()
        return self.data_end if self.data_end >= at else self.size

    def _end(self, at: int) -> None:
        if self.found.finished:
            return
        if not self.active and not self.found.lost:
            self.found.lost.append(LostSpan(at, 0, "it is cut: what followed is not known"))

    def _body(self, at: int) -> tuple[int, int, bytes]:
        """Return opcode, end and body of the record at `at`."""
        if at + RECORD_HEAD.size > self.size:
            raise BadRecordError(CUT)
        opcode, length = RECORD_HEAD.unpack_from(self.data, at)
        end = at + RECORD_HEAD.size + length
        if end > (self.data_end if at < self.data_end else self.size):
            raise BadRecordError(CUT)
        return opcode, end, self.data[at + RECORD_HEAD.size : end]

    def _record(self, at: int, *, dry: bool = False) -> tuple[int, Item | None]:
        """Return end and content of a record. With `dry`, check it without changing the state of the scan."""
        opcode, end, body = self._body(at)
        read = _READERS.get(opcode)
        if read is None:
            raise BadRecordError(f"a record of unknown kind {opcode}")
        try:
            return end, read(self, at, body, dry)
        except BadRecordError:
            raise
        except Exception as error:  # garbage makes zstandard and struct raise many types
            raise BadRecordError(f"a record is not intact: {error}") from None

    def _header(self, at: int, body: bytes, _dry: bool) -> None:
        header = parse_header(body)
        if at != len(MAGIC):
            raise BadRecordError("its header is damaged")
        self.found.profile, self.numbered = header.profile, header.profile == PROFILE

    def _index(self, _at: int, body: bytes, _dry: bool) -> None:
        check_index(body)

    def _metadata(self, _at: int, body: bytes, _dry: bool) -> Metadata:
        metadata = parse_metadata(body)
        self.recovered |= metadata.name == RECOVERED
        return metadata

    def _attachment(self, _at: int, body: bytes, dry: bool) -> Attachment:
        attachment = parse_attachment(body)
        if (digest := hashlib.sha256(body).digest()) in self.attached:
            raise BadRecordError("an attachment was read before")
        if not dry:
            self.attached.add(digest)
        return attachment

    def _chunk(self, _at: int, body: bytes, dry: bool) -> list[Message]:
        chunk = ChunkParser(self.table.copy(), self.numbered, 0 if self.found.lost else None)
        messages = chunk.messages(body)
        if not dry:
            self.table = chunk.table
            self.found.messages += len(messages)
            self.found.missing += 0 if self.recovered else chunk.missing
            self.found.nameless += chunk.nameless
        return messages

    def _data_end(self, at: int, body: bytes, dry: bool) -> None:
        """Accept DataEnd where no intact summary follows, but only if no intact record follows either."""
        if len(body) != 4 or self._next_intact(at + 1) < self.size:
            raise BadRecordError("it says that the data ends, and intact records follow")
        if not dry:
            self.found.notes.append("its summary is damaged or cut: it is written again")
            self._finish(at)

    def _finish(self, at: int) -> None:
        """Note that the data ends at `at`, and check their CRC, which also covers records without one of their own."""
        head, stated = self.data[at : at + RECORD_HEAD.size], self.data[at + RECORD_HEAD.size : at + DATA_END_BYTES]
        with memoryview(self.data) as view:
            crc = zlib.crc32(view[:at])
        if head != RECORD_HEAD.pack(Opcode.DATA_END, 4):
            self.found.notes.append("the record that ends its data is damaged: it is written again")
        elif int.from_bytes(stated, "little") not in (0, crc) and not self.found.lost:
            self.found.notes.append(
                "a record without a CRC of its own is damaged: an index, which is written again, or header or "
                "metadata, which are copied as they stand"
            )
        self.found.finished = True

    def _summary(self) -> int:
        """Return the offset at which the data ends, by a summary whose CRC is right, or -1; read its descriptions."""
        foot = self.size - FOOTER_BYTES - len(MAGIC)
        if foot < 0 or self.data[foot : foot + RECORD_HEAD.size] != RECORD_HEAD.pack(Opcode.FOOTER, 20):
            return -1
        footer = parse_footer(self.data[foot + RECORD_HEAD.size : self.size - len(MAGIC)])
        start = footer.summary_start or foot
        if not DATA_END_BYTES <= start <= foot or self.data[self.size - len(MAGIC) :] != MAGIC:
            return -1
        if zlib.crc32(self.data[start : self.size - len(MAGIC) - 4]) != footer.summary_crc:
            return -1
        at = start
        while at < foot:
            opcode, at, body = self._body(at)
            self.table.add(opcode, body)
        return start - DATA_END_BYTES


_READERS: dict[int, Any] = {
    Opcode.HEADER: _Scan._header,
    Opcode.CHUNK: _Scan._chunk,
    Opcode.MESSAGE_INDEX: _Scan._index,
    Opcode.METADATA: _Scan._metadata,
    Opcode.ATTACHMENT: _Scan._attachment,
    Opcode.DATA_END: _Scan._data_end,
}
"""Records of Overfly's files before the summary: schemas, channels and messages are always in chunks."""

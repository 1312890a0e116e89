"""Finds all that is intact in an MCAP file, behind damage too: what `recover` and `compact` copy.

Only what a CRC vouches for is given out: chunks, and attachments. Where a record is not intact, the next chunk or
attachment whose CRC holds is looked for. Numbers of messages never go back, so a stretch that stands in the file twice
counts once. Metadata have no CRC of their own and are taken as they stand, where they stand in line.
"""

from __future__ import annotations

import hashlib
import mmap
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, Footer, Header, Metadata
from mcap.stream_reader import get_chunk_data_stream

from tmc.record.disk import open_log
from tmc.record.errors import NoLogError
from tmc.record.mcap.chunks import HEAD, ChannelTable, ChunkReader, DamagedChunkError
from tmc.record.mcap.findings import CUT, Findings, Item, Lost, Message, Show, unseen
from tmc.record.mcap.parser import MAGIC, RECOVERED

PROFILE = "overfly"
"""Of our files, whose messages are numbered by topic."""
_LARGEST = 1 << 32
"""Bytes of the largest chunk that is believed in: a damaged size must not take all memory."""
_CANDIDATE = re.compile(rb"[\x06\x09](?=.{5}\0\0\0)", re.DOTALL)
"""Opcode of a chunk or an attachment, and a length below 2^40."""
_FOOT = HEAD.size + 20 + len(MAGIC)
_DATA_END = HEAD.size + 4


def salvage(path: Path, what: str = "", show: Show = unseen) -> tuple[Findings, Iterator[Item]]:
    """What is intact in a file, in its order; the findings are complete when all of it was taken.

    `what` is done with the items, which `show` is told. NoLogError when the file cannot be read or is empty.
    """
    found = Findings()
    try:
        with open_log(path) as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise NoLogError(f"{path} cannot be read ({error.strerror}): check the path of the log") from None
    except ValueError:  # mmap knows no empty files
        raise NoLogError(f"{path} is empty: its process was killed before it wrote; remove it") from None
    scan = _Scan(data, found, path.suffix != ".mcap", lambda share: show(f"{what} {path.name}", share))
    return found, scan.items()


def goes_on(path: Path, at: int, size: int) -> bool:
    """Whether a chunk or an attachment that a CRC vouches for stands behind byte `at` of the first `size`.

    Then a record that seems to end behind them has a damaged length: the file is not cut.
    """
    with open_log(path) as file, mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as data:
        scan = _Scan(data, Findings(), True, lambda _: None)
        return scan._next(at + 1) < size


class _Scan:
    """One pass over the bytes of a file; `active`: its name says that it was never finished."""

    def __init__(self, data: mmap.mmap, found: Findings, active: bool, show: Callable[[float], None]) -> None:
        self.data, self.size, self.found, self.active, self.show = data, len(data), found, active, show
        self.known = ChannelTable()
        self.attached: set[bytes] = set()
        self.numbered, self.told = True, False
        self.data_end = -1
        self.data_end = self._summary()
        """Where the data ends, as a intact summary says; -1 without one."""

    def items(self) -> Iterator[Item]:
        """Everything intact; fills in the findings."""
        at = self._start()
        while at < self.size and not self.found.finished:
            if at == self.data_end:
                self._finish(at)
                return
            missing = self.found.missing
            try:
                end, item = self._record(at)
            except DamagedChunkError as damaged:
                at = self._lose(at, str(damaged))
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
        with suppress(DamagedChunkError):
            if self._body(len(MAGIC))[0] == Opcode.HEADER:
                self._record(len(MAGIC))
                self.found.lost.append(Lost(0, len(MAGIC), why))
                return len(MAGIC)
        return self._lose(0, why)

    def _lose(self, at: int, why: str) -> int:
        """Note the loss from `at` to the next record that is intact, and go on there."""
        after = self._next(at + 1)
        why = "the length of a record is damaged" if why == CUT and after < self.size else why
        self.found.lost.append(Lost(at, after - at, why))
        return after

    def _next(self, at: int) -> int:
        """Where the next chunk or attachment begins that a CRC vouches for, or the data ends."""
        for match in _CANDIDATE.finditer(self.data, at):
            if self.data_end >= at and match.start() > self.data_end:
                break
            with suppress(DamagedChunkError):
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
        if at + HEAD.size > self.size:
            raise DamagedChunkError(CUT)
        opcode, length = HEAD.unpack_from(self.data, at)
        end = at + HEAD.size + length
        if end > (self.data_end if at < self.data_end else self.size):
            raise DamagedChunkError(CUT)
        return opcode, end, self.data[at + HEAD.size : end]

    def _record(self, at: int, *, dry: bool = False) -> tuple[int, Item | None]:
        """End and content of a record; with `dry` it is only looked at."""
        opcode, end, body = self._body(at)
        read = _READERS.get(opcode)
        if read is None:
            raise DamagedChunkError(f"a record of unknown kind {opcode}")
        try:
            return end, read(self, at, body, dry)
        except DamagedChunkError:
            raise
        except Exception as error:  # garbage makes zstandard and struct raise whatever they like
            raise DamagedChunkError(f"a record is not intact: {error}") from None

    def _header(self, at: int, body: bytes, _dry: bool) -> None:
        header = Header.read(ReadDataStream(BytesIO(body)))
        texts = vars(header).values()  # its profile, and the library that wrote it, each behind its length
        if at != len(MAGIC) or sum(4 + len(text.encode()) for text in texts) != len(body):
            raise DamagedChunkError("its header is damaged")
        self.found.profile, self.numbered = header.profile, header.profile == PROFILE

    def _index(self, _at: int, body: bytes, _dry: bool) -> None:
        """An index holds no fact, but its length must be right for the record behind it to be found."""
        if len(body) < 6 or int.from_bytes(body[2:6], "little") != len(body) - 6 or (len(body) - 6) % 16:
            raise DamagedChunkError("an index is damaged")

    def _metadata(self, _at: int, body: bytes, _dry: bool) -> Metadata:
        stream = ReadDataStream(BytesIO(body))
        metadata = Metadata.read(stream)
        if stream.count != len(body):
            raise DamagedChunkError("metadata are damaged")
        self.told |= metadata.name == RECOVERED
        return metadata

    def _attachment(self, _at: int, body: bytes, dry: bool) -> Attachment:
        if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            raise DamagedChunkError("the CRC of an attachment is wrong")
        if (digest := hashlib.sha256(body).digest()) in self.attached:
            raise DamagedChunkError("an attachment was read before")
        if not dry:
            self.attached.add(digest)
        return Attachment.read(ReadDataStream(BytesIO(body)))

    def _chunk(self, _at: int, body: bytes, dry: bool) -> list[Message]:
        head = ReadDataStream(BytesIO(body))
        chunk = Chunk.read(head)
        if head.count != len(body) or chunk.uncompressed_size > _LARGEST:
            raise DamagedChunkError("the size of a chunk is damaged")
        stream, size = get_chunk_data_stream(chunk)
        data = stream.read(size)
        if size != chunk.uncompressed_size or zlib.crc32(data) != chunk.uncompressed_crc:
            raise DamagedChunkError("the CRC of a chunk is wrong")
        known = ChannelTable(dict(self.known.schemas), dict(self.known.channels), dict(self.known.next))
        read = ChunkReader(known, self.numbered, 0 if self.found.lost else None)
        messages = read.messages(data)
        if not dry:
            self.known = known
            self.found.messages += len(messages)
            self.found.missing += 0 if self.told else read.missing
            self.found.nameless += read.nameless
        return messages

    def _data_end(self, at: int, body: bytes, dry: bool) -> None:
        """The end of the data where no intact summary follows: believed in only if nothing else does."""
        if len(body) != 4 or self._next(at + 1) < self.size:
            raise DamagedChunkError("it says that it ends, and goes on")
        if not dry:
            self.found.notes.append("its summary is damaged or cut, and made anew")
            self._finish(at)

    def _finish(self, at: int) -> None:
        """The data ends here; their CRC also covers what has none of its own."""
        head, stated = self.data[at : at + HEAD.size], self.data[at + HEAD.size : at + _DATA_END]
        with memoryview(self.data) as view:
            crc = zlib.crc32(view[:at])
        if head != HEAD.pack(Opcode.DATA_END, 4):
            self.found.notes.append("the record that ends its data is damaged, and made anew")
        elif int.from_bytes(stated, "little") not in (0, crc) and not self.found.lost:
            self.found.notes.append(
                "what has no CRC of its own is damaged: an index, made anew, or header or metadata, taken as found"
            )
        self.found.finished = True

    def _summary(self) -> int:
        """Where the data ends, by a summary whose CRC holds; its descriptions are known from the start then."""
        foot = self.size - _FOOT
        if foot < 0 or self.data[foot : foot + HEAD.size] != HEAD.pack(Opcode.FOOTER, 20):
            return -1
        footer = Footer.read(ReadDataStream(BytesIO(self.data[foot + HEAD.size : self.size - len(MAGIC)])))
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


_READERS: dict[int, Any] = {
    Opcode.HEADER: _Scan._header,
    Opcode.CHUNK: _Scan._chunk,
    Opcode.MESSAGE_INDEX: _Scan._index,
    Opcode.METADATA: _Scan._metadata,
    Opcode.ATTACHMENT: _Scan._attachment,
    Opcode.DATA_END: _Scan._data_end,
}
"""What stands before the summary of our files: schemas, channels and messages are always in chunks."""

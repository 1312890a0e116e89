"""Write the log of one process: one MCAP file, one writer, one thread.

The file is named `<name>.mcap.active` while it grows, and `<name>.mcap` once it is finished. A message is in the file
after `flush()`, which ends the chunk and passes it to the system. A kill -9 loses only what came after the last flush.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from google.protobuf.message import Message
from mcap.records import Attachment

from tmc.kernel.config import JournalConfig
from tmc.record import builders, channels, disk, schemas
from tmc.record.errors import RecordError
from tmc.record.mcap.parser import PROFILE, RECOVERED
from tmc.record.mcap.recover import keep_damaged
from tmc.record.mcap.writer import mcap_writer
from tmc.record.reader import Log
from tmc.record.run_folder import active_name


@dataclass(slots=True)
class _Channel:
    """A channel of this file. `sequence` is the next number, 32 bits; a gap shows that messages are missing."""

    id: int
    schema: str
    sequence: int = 0


class LogWriter:
    """Write the log of one process. A context: leaving it finishes the file.

    `path`: of the finished file. `process`: a name such as `tmc` or `uav-003`. `metadata`: facts for the readers.
    `resume`: continue the log that an earlier incarnation of the process left, finished or not, instead of refusing to.
    `clock`: the wall clock, ns. `timer`: a clock that never goes back, s. Raises RecordError when the file cannot be
    written or exists already. After a RecordError, nothing more is written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        process: str,
        journal: JournalConfig,
        metadata: Mapping[str, str],
        clock: Callable[[], int] = time.time_ns,
        *,
        resume: bool = False,
        timer: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path, self.process = Path(path), process
        self.active = active_name(self.path)
        self._journal, self._clock, self._timer = journal, clock, timer
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[str, int] = {}
        self._last, self._closed = 0, ""
        self._flushed, self._synced = timer(), False
        try:
            old = disk.previous_log(self.path, resume)
            name = self.active.with_name(self.active.name + disk.NEW_SUFFIX) if old else self.active
            with ExitStack() as locks:  # no other process may resume the old log meanwhile
                locks.enter_context(disk.open_locked(old, "rb") if old else nullcontext())
                self._file = disk.open_locked(name, "wb" if old else "xb")
                self._old = locks.pop_all()
        except OSError as error:
            raise RecordError(disk.why_unwritable(self.path, error)) from None
        self._writer = mcap_writer(self._file, journal.chunk)
        try:
            self._start(dict(metadata), old, name)
        except BaseException:
            self._give_up()
            raise

    def _start(self, metadata: dict[str, str], old: Path | None, name: Path) -> None:
        with self._guard():
            self._writer.start(profile=PROFILE)
            if old is not None:
                self._copy(old)
            # Names are unique per process, so that the files of a run can be merged.
            facts = {"format": channels.FORMAT, "process": self.process, "clock": "wall"}
            self.note(f"overfly/{self.process}", facts | metadata)
            self.flush(fsync=old is not None)
            if old is not None:
                name.replace(self.active)
                self.path.unlink(missing_ok=True)
                disk.sync_folder(self.path.parent)  # the new file keeps its name after a power cut
            self._old.close()

    def _copy(self, old: Path) -> None:
        """Copy all intact messages, attachments and metadata of `old`, with their numbers and times.

        The incomplete end that a kill leaves is dropped. After any other damage, the old file is kept as `*.damaged-1`,
        since intact chunks may follow the damage, and the new log says so.
        """
        if old.stat().st_size == 0:
            return
        log = Log(old)
        if log.lost:
            self.note(RECOVERED, log.lost)
        for extra in log.extras():
            if isinstance(extra, Attachment):
                self.attach(extra.name, extra.media_type, extra.data)
            elif extra.name != RECOVERED:
                self.note(extra.name, extra.metadata)
        for raw in log.raw():
            self.put(raw.topic, raw.data, raw.log_time, raw.publish_time, raw.sequence)
        if log.damage is not None and not log.still_open:
            kept = keep_damaged(old).name
            self.log("error", f"{log.damage}: this incarnation resumes before that; the file is kept as {kept}")

    def write(self, topic: str, message: Message, publish_time: int | None = None) -> int:
        """Write a message to a topic and return its log time, ns. Flushes when that is due.

        `message`: of the schema that the table has for the topic. `publish_time`: the sender's wall clock, ns; by
        default the log time.
        """
        channel = self._channels.get(topic) or self._register(topic)
        if message.DESCRIPTOR.full_name != channel.schema:
            raise RecordError(f"{topic} holds {channel.schema}, not {message.DESCRIPTOR.full_name}: send that one")
        now = self.now()
        sent = now if publish_time is None else publish_time
        if not 0 <= sent < 2**64:
            raise RecordError(f"publish time {sent} does not fit 64 bits: give nanoseconds of the wall clock")
        self.put(topic, message.SerializeToString(), now, sent, channel.sequence)
        self.maybe_flush()
        return now

    def put(self, topic: str, data: bytes, log_time: int, publish_time: int, sequence: int) -> None:
        """Write the bytes of a message with the given times (ns) and number: for a log that is copied."""
        channel = self._channels.get(topic) or self._register(topic)
        self._check_open()
        try:
            self._writer.add_message(channel.id, log_time, data, publish_time, sequence)
        except OSError as error:
            raise self._fail(error) from None
        channel.sequence = (sequence + 1) & 0xFFFF_FFFF
        self._last = max(self._last, log_time)

    def _register(self, topic: str) -> _Channel:
        row = channels.find(topic, self.process)
        with self._guard():
            if row.schema not in self._schemas:
                data = schemas.schema_bytes(row.schema)
                self._schemas[row.schema] = self._writer.register_schema(row.schema, "protobuf", data)
            number = self._writer.register_channel(topic, "protobuf", self._schemas[row.schema])
        self._channels[topic] = _Channel(number, row.schema)
        return self._channels[topic]

    def now(self) -> int:
        """Return the wall clock, ns, or the last log time if that is later: log times never decrease within a file."""
        self._last = max(self._last, self._clock())
        return self._last

    def log(self, level: str, text: str) -> None:
        """Write a line to the topic `/log`; `level` is one of `builders.LEVELS`."""
        self.write("/log", builders.log_message(level, text, self.process, self.now()))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file to the log, such as the config or the map."""
        now = self.now()
        with self._guard():
            self._writer.add_attachment(now, now, name, media_type, data)

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Write metadata to the log."""
        with self._guard():
            self._writer.add_metadata(name, facts)

    def flush(self, *, fsync: bool = False) -> None:
        """End the chunk and pass it to the system; with `fsync`, wait until it is on the disk (power cuts)."""
        with self._guard():
            if not os.fstat(self._file.fileno()).st_nlink:  # no process will ever read it
                raise FileNotFoundError(errno.ENOENT, "it was removed")
            self._writer.flush()
            if fsync:
                self._sync()
        self._flushed = self._timer()

    def maybe_flush(self) -> None:
        """Flush when `journal.flush_interval` has passed since the last flush: call it in every idle round."""
        if self._timer() - self._flushed >= self._journal.flush_interval:
            self.flush()

    def close(self) -> None:
        """Finish the file and give it its name. After a failure it stays `.active`, readable up to the failure."""
        if self._closed:
            return
        with self._guard():
            self._writer.finish()
            self._file.flush()
            self._sync()
            self.active.rename(self.path)
            self._file.close()  # releases the lock, under the new name
        self._closed = f"{self.path} is closed: write before close()"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _guard(self) -> Iterator[None]:
        self._check_open()
        try:
            yield
        except OSError as error:
            raise self._fail(error) from None

    def _check_open(self) -> None:
        if self._closed:
            raise RecordError(self._closed)

    def _fail(self, error: OSError) -> RecordError:
        """Write nothing more: half a chunk may be in the file, so nothing may follow it."""
        self._closed = disk.why_unwritable(self.path, error)
        self._give_up()
        return RecordError(self._closed)

    def _give_up(self) -> None:
        self._old.close()
        with suppress(OSError):
            self._file.raw.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        if not self._synced:  # once, so that the name of the file is on the disk
            disk.sync_folder(self.path.parent)
            self._synced = True

"""Writes the log of one process: one MCAP file, one writer, one thread.

The file is called `<name>.mcap.active` while it grows, and `<name>.mcap` once it is finished. A message is in the file
after `flush()`, which ends the chunk and hands it to the system: what kill -9 can take is what came after the last one.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from tmc.kernel.config import JournalConfig
from tmc.record import builders, channels, disk, schemas
from tmc.record.errors import RecordError
from tmc.record.mcap.writer import mcap_writer


@dataclass(slots=True)
class _Channel:
    """A channel of this file. `sequence` is the next number: 32 bits, and a gap shows that messages are missing."""

    id: int
    schema: str
    sequence: int = 0


class LogWriter:
    """The log of one process.

    `path` is the finished file's, `process` a name such as `tmc` or `uav-003`, `metadata` facts for the readers.
    `resume`: go on with what an earlier incarnation of the process left behind, finished or not, instead of refusing
    to. `clock` gives the wall clock in ns, `timer` a clock in s that never goes back. Raises RecordError for a file
    that cannot be written or is there already; after one, nothing more is written.
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
        self.active = self.path.with_name(self.path.name + channels.ACTIVE)
        self._journal, self._clock, self._timer = journal, clock, timer
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[str, int] = {}
        self._last, self._closed = 0, ""
        self._flushed, self._synced = timer(), False
        try:
            old = disk.left_behind(self.path, resume)
            name = self.active.with_name(self.active.name + ".new") if old else self.active
            with ExitStack() as held:  # nobody else may go on with the old one meanwhile
                held.enter_context(disk.open_held(old, "rb") if old else nullcontext())
                self._file = disk.open_held(name, "wb" if old else "xb")
                self._old = held.pop_all()
        except OSError as error:
            raise RecordError(disk.unwritable(self.path, error)) from None
        self._writer = mcap_writer(self._file, journal.chunk)
        try:
            self._start(dict(metadata), old, name)
        except BaseException:
            self._give_up()
            raise

    def _start(self, metadata: dict[str, str], old: Path | None, name: Path) -> None:
        with self._guard():
            self._writer.start(profile="overfly")
            if old is not None:
                from tmc.record import resume  # noqa: PLC0415  # a fresh start does not pay for the reader

                resume.copy(old, self)
            # Names are unique to the process, so that the files of a run can be merged.
            facts = {"format": channels.FORMAT, "process": self.process, "clock": "wall"}
            self.note(f"overfly/{self.process}", facts | metadata)
            self.flush(fsync=old is not None)
            if old is not None:
                name.replace(self.active)
                self.path.unlink(missing_ok=True)
                disk.sync_folder(self.path.parent)  # the new file goes by its name even after a power cut
            self._old.close()

    def write(self, topic: str, message: Any, publish_time: int | None = None) -> int:
        """Log a message of the schema that the table has for the topic; gives back its log time.

        `publish_time`: the sender's wall clock in ns; the log time when left out. Flushes when that is due.
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
        """Log bytes of the topic's schema with times and number as given: for a log that is copied."""
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
        """The wall clock in ns, held back where it went back: log times never decrease within a file."""
        self._last = max(self._last, self._clock())
        return self._last

    def log(self, level: str, text: str) -> None:
        """Say something on `/log`; `level` is one of `builders.LEVELS`."""
        self.write("/log", builders.log_message(level, text, self.process, self.now()))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the log, such as the config or the map."""
        now = self.now()
        with self._guard():
            self._writer.add_attachment(now, now, name, media_type, data)

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Put metadata into the log."""
        with self._guard():
            self._writer.add_metadata(name, facts)

    def flush(self, *, fsync: bool = False) -> None:
        """End the chunk and hand it to the system; with `fsync`, also wait until the disk has it (power cuts)."""
        with self._guard():
            if not os.fstat(self._file.fileno()).st_nlink:  # nobody will ever read it
                raise FileNotFoundError(errno.ENOENT, "it was removed")
            self._writer.flush()
            if fsync:
                self._sync()
        self._flushed = self._timer()

    def maybe_flush(self) -> None:
        """Flush when the configured time has passed since the last flush: call it in every idle round."""
        if self._timer() - self._flushed >= self._journal.flush_interval:
            self.flush()

    def close(self) -> None:
        """Finish the file and give it its name. A file that failed before stays `.active`, readable up to there."""
        if self._closed:
            return
        with self._guard():
            self._writer.finish()
            self._file.flush()
            self._sync()
            self.active.rename(self.path)
            self._file.close()  # and so let go of it, under its new name
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
        """Half a chunk may be in the file now, so nothing may follow it: give the file up as it is."""
        self._closed = disk.unwritable(self.path, error)
        self._give_up()
        return RecordError(self._closed)

    def _give_up(self) -> None:
        self._old.close()
        with suppress(OSError):
            self._file.raw.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        if not self._synced:  # once, so that the folder knows the file
            disk.sync_folder(self.path.parent)
            self._synced = True

"""Write a log again: beside the old one, which it replaces only once all of it is on the disk."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO

from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import Writer

from tmc.record import disk
from tmc.record.errors import RecordError
from tmc.record.mcap.findings import Item
from tmc.record.mcap.writer import mcap_writer


def write(
    path: Path, chunk_bytes: int, profile: str, items: Iterable[Item], check: Callable[[Path], None] = lambda _: None
) -> int:
    """Write `path` as a finished file of these items, in chunks of `chunk_bytes` before compression; return its size.

    An older file of that name is replaced in one step, after `check` of the new one raised nothing. RecordError when it
    cannot be written; then no part of it is left.
    """
    new = path.with_name(path.name + disk.NEW_SUFFIX)
    try:
        with disk.open_locked(new, "wb") as file:
            try:
                size = _fill(file, chunk_bytes, profile, items)
                check(new)
                new.replace(path)
            except BaseException:
                with suppress(OSError):
                    new.unlink()
                    file.raw.close()  # what is in the buffer does not matter any more
                raise
        disk.sync_folder(path.parent)
    except OSError as error:
        why = f"the disk that holds {path} is full: free some space, and try again"
        raise RecordError(why if error.errno in disk.DISK_FULL else disk.why_unwritable(path, error)) from None
    return size


def _fill(file: IO[bytes], chunk_bytes: int, profile: str, items: Iterable[Item]) -> int:
    copy = _Copy(mcap_writer(file, chunk_bytes))
    copy.writer.start(profile=profile)
    for item in items:
        copy.write(item)
    copy.writer.finish()
    file.flush()
    os.fsync(file.fileno())
    return file.tell()


class _Copy:
    """Copy items to a writer. Schemas and channels keep their order and get new numbers."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def write(self, item: Item) -> None:
        """Write the messages of a chunk, metadata, or an attachment, unchanged."""
        if isinstance(item, Metadata):
            self.writer.add_metadata(item.name, item.metadata)
        elif isinstance(item, Attachment):
            a = item
            self.writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        else:
            for m in item:
                channel = self._channels.get(m.channel.id) or self._channel(m.channel, m.definition)
                self.writer.add_message(channel, m.log_time, m.data, m.publish_time, m.sequence)

    def _channel(self, channel: Channel, schema: Schema | None) -> int:
        if schema is not None and schema.id not in self._schemas:
            self._schemas[schema.id] = self.writer.register_schema(schema.name, schema.encoding, schema.data)
        number = self.writer.register_channel(
            channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
        )
        self._channels[channel.id] = number
        return int(number)

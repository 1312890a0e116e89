"""Writes what a log holds anew: beside it, and under its name only once all of it is on the disk."""

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
    path: Path, chunk: int, profile: str, items: Iterable[Item], check: Callable[[Path], None] = lambda _: None
) -> int:
    """Make `path` a finished file of these items, in chunks of `chunk` bytes before compression; returns its size.

    An older file of that name is replaced in one step, once `check` of the new one raised nothing. RecordError when it
    cannot be written; nothing of it is left then.
    """
    new = path.with_name(path.name + ".new")
    try:
        with disk.open_held(new, "wb") as file:
            try:
                size = _fill(file, chunk, profile, items)
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
        raise RecordError(why if error.errno in disk.FULL else disk.unwritable(path, error)) from None
    return size


def _fill(file: IO[bytes], chunk: int, profile: str, items: Iterable[Item]) -> int:
    copy = _Copy(mcap_writer(file, chunk))
    copy.writer.start(profile=profile)
    for item in items:
        copy.take(item)
    copy.writer.finish()
    file.flush()
    os.fsync(file.fileno())
    return file.tell()


class _Copy:
    """Takes items into a writer. Schemas and channels keep their order, and are numbered anew."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def take(self, item: Item) -> None:
        """Write the messages of a chunk, metadata, or an attachment, as they are."""
        if isinstance(item, Metadata):
            self.writer.add_metadata(item.name, item.metadata)
        elif isinstance(item, Attachment):
            a = item
            self.writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        else:
            for m in item:
                channel = self._channels.get(m.channel.id) or self._channel(m.channel, m.schema)
                self.writer.add_message(channel, m.log_time, m.data, m.publish_time, m.sequence)

    def _channel(self, channel: Channel, schema: Schema | None) -> int:
        if schema is not None and schema.id not in self._schemas:
            self._schemas[schema.id] = self.writer.register_schema(schema.name, schema.encoding, schema.data)
        number = self.writer.register_channel(
            channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
        )
        self._channels[channel.id] = number
        return int(number)

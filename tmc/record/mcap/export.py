"""Write an MCAP file that is made from logs, such as a merged or a replay file: whole, or not at all.

It grows as `<name>.new` and takes its name when it is whole. A log of a run is never overwritten.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from google.protobuf.message import Message

from tmc.record import disk, schemas
from tmc.record.channels import ACTIVE, CHANNELS, role
from tmc.record.errors import RecordError
from tmc.record.mcap.parser import PROFILE
from tmc.record.mcap.writer import mcap_writer

CHUNK_BYTES = 2**20
"""Size of a chunk before compression."""


class Export:
    """Write the file `path`. A context: leaving it by an exception leaves no file.

    Messages must come in order of their log time. Raises RecordError when the file cannot be written, or is the name of
    a run's log.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._new = self.path.with_name(self.path.name + disk.NEW_SUFFIX)
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._channels: dict[tuple[str, str, bytes, str], int] = {}
        self._sequences: dict[str, int] = {}
        self._definitions: dict[str, bytes] = {}
        if _names_a_log(self.path):
            raise RecordError(f"{self.path} is the name of a run's log: choose another name for the file")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._new.open("wb")
        except OSError as error:
            raise self._failed(error) from None
        self._writer = mcap_writer(self._file, CHUNK_BYTES)
        with self._guard():
            self._writer.start(profile=PROFILE)

    def write(self, topic: str, message: Message, time_ns: int) -> None:
        """Write a protobuf message. Both its times are `time_ns`; it gets the topic's next number, from 0."""
        name = message.DESCRIPTOR.full_name
        number = self._sequences.get(topic, 0)
        self._sequences[topic] = number + 1
        if name not in self._definitions:
            self._definitions[name] = schemas.schema_bytes(name)
        self.put(topic, name, self._definitions[name], message.SerializeToString(), time_ns, time_ns, number)

    def put(
        self, topic: str, schema: str, definition: bytes, data: bytes, log_time: int, publish_time: int, sequence: int,
        process: str = "",
    ) -> None:  # fmt: skip
        """Write the bytes of a message as given. A topic that comes from several processes gets a channel per process.

        `definition`: the schema as MCAP stores it; see `schemas.schema_bytes`.
        """
        key = (topic, schema, definition, process)
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._register(topic, schema, definition, process)
        with self._guard():
            self._writer.add_message(channel, log_time, data, publish_time, sequence)

    def _register(self, topic: str, schema: str, definition: bytes, process: str) -> int:
        if (schema, definition) not in self._schemas:
            self._schemas[schema, definition] = self._writer.register_schema(schema, "protobuf", definition)
        facts = {"process": process} if process else {}
        return int(self._writer.register_channel(topic, "protobuf", self._schemas[schema, definition], facts))

    def attach(self, name: str, media_type: str, data: bytes, log_time: int = 0, create_time: int = 0) -> None:
        """Attach a file."""
        with self._guard():
            self._writer.add_attachment(create_time, log_time, name, media_type, data)

    def add_metadata(self, name: str, facts: Mapping[str, str]) -> None:
        """Write metadata."""
        with self._guard():
            self._writer.add_metadata(name, dict(facts))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            with suppress(OSError):  # a full disk raises again
                self._file.close()
            self._new.unlink(missing_ok=True)

    def _finish(self) -> None:
        with self._guard():
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._new.replace(self.path)

    @contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._failed(error) from None

    def _failed(self, error: OSError) -> RecordError:
        return RecordError(f"{self.path} cannot be written ({error.strerror}): choose another place with --out")


def _names_a_log(path: Path) -> bool:
    """True for `tmc.mcap`, `uav-003.mcap.active` and the like."""
    process, _, suffix = path.name.partition(".")
    return suffix in ("mcap", f"mcap{ACTIVE}") and role(process) in {channel.process for channel in CHANNELS}

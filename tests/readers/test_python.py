"""Python: pybag-sdk, which has a parser of MCAP of its own, finds every message; the files' own schemas decode them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from tests.command import PATIENCE_S
from tests.readers.conftest import Topic
from tmc.record.channels import FORMAT
from tmc.record.reader import Log

MISSING = "needs pybag-sdk: pip install '.[readers]'"


def message_class(schema: Any) -> Any:
    """The class of a schema record, from nothing but the descriptors in it."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def found(path: Path) -> dict[str, list[tuple[str, int, int, int, bytes]]]:
    """{topic: (schema, log time, publish time, sequence, message)} in file order; CRCs checked.

    The message is decoded, then encoded again in order of its fields: what its schema does not know is dropped.
    """
    factory = pytest.importorskip("pybag.mcap.record_reader", reason=MISSING).McapRecordReaderFactory
    topics: dict[str, list[tuple[str, int, int, int, bytes]]] = {}
    with factory.from_file(path, enable_crc_check=True) as reader:
        channels = reader.get_channels()
        schemas = {number: reader.get_channel_schema(number) for number in channels}
        classes = {number: message_class(schema) for number, schema in schemas.items()}
        for message in reader.get_messages(None, in_log_time_order=False):
            decoded = classes[message.channel_id].FromString(message.data)
            decoded.DiscardUnknownFields()
            topics.setdefault(channels[message.channel_id].topic, []).append(
                (
                    schemas[message.channel_id].name,
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                    decoded.SerializeToString(deterministic=True),
                )
            )
        assert {channel.topic for channel in channels.values()} == set(topics)
        assert {channel.message_encoding for channel in channels.values()} == {"protobuf"}
        assert reader.get_statistics().message_count == sum(map(len, topics.values()))
        assert reader.get_header().profile == "overfly"
        assert any(record.metadata.get("format") == FORMAT for record in reader.get_metadata())
    return topics


def attachments(path: Path) -> list[Any]:
    """The attachments, their CRCs not checked: pybag-sdk 0.13.0 leaves out the fields before the data."""
    factory = pytest.importorskip("pybag.mcap.record_reader", reason=MISSING).McapRecordReaderFactory
    with factory.from_file(path) as reader:
        return reader.get_attachments()


def assert_as_we_read_it(topics: dict[str, list[tuple[str, int, int, int, bytes]]], ours: dict[str, Topic]) -> None:
    assert sorted(topics) == sorted(ours)
    for name, topic in ours.items():
        assert topics[name] == [
            (
                topic.schema,
                entry.log_time,
                entry.publish_time,
                entry.sequence,
                entry.message.SerializeToString(deterministic=True),
            )
            for entry in topic.entries
        ]


def test_pybag_finds_every_message(logs: list[Path], ours) -> None:
    for path in logs:
        topics = found(path)
        assert_as_we_read_it(topics, ours(path))
        wanted = [(file.name, file.media_type, file.data) for file in Log(path).attachments()]
        assert sorted((file.name, file.media_type, file.data) for file in attachments(path)) == sorted(wanted)
        for messages in topics.values():
            times = [time for _, time, *_ in messages]
            assert times == sorted(times)


def test_pybag_recovers_what_a_kill_left(killed: list[Path], ours, tmp_path: Path) -> None:
    program = shutil.which("pybag", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if program is None:
        pytest.skip(MISSING)
    for path in killed:
        again = tmp_path / f"again-{path.name}"
        command = [program, "recover", path, "--output", again, "--chunk-size", "65536", "--chunk-compression", "zstd"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert done.returncode == 0, done.stderr
        assert_as_we_read_it(found(again), ours(path))

"""One truth in three places: the table of types, overfly.proto, and docs/reference/log-format.md agree."""

import re
from pathlib import Path

import pytest
from google.protobuf import descriptor_pb2

import tmc.record
from tmc.record import channels, schemas
from tmc.record.errors import RecordError

PROTO = Path(tmc.record.__file__).with_name("overfly.proto")
DOC = Path(tmc.record.__file__).parents[2] / "docs" / "reference" / "log-format.md"


def parse(text):
    """A FileDescriptorProto of the few forms that overfly.proto uses; anything else fails."""
    text = re.sub(r"//[^\n]*", "", text)
    syntax, package = re.search(r'syntax = "(\w+)";', text)[1], re.search(r"package (\w+);", text)[1]
    file = descriptor_pb2.FileDescriptorProto(name="overfly.proto", package=package, syntax=syntax)
    rest = re.sub(r'syntax = "\w+";|package \w+;', "", text)
    for name, body in re.findall(r"message (\w+) \{([^}]*)\}", rest):
        message = file.message_type.add(name=name)
        for line in filter(None, map(str.strip, body.split("\n"))):
            repeated, kind, field, number = re.fullmatch(r"(repeated )?(\w+) (\w+) = (\d+);", line).groups()
            proto = descriptor_pb2.FieldDescriptorProto
            message.field.add(
                name=field,
                number=int(number),
                type=proto.Type.Value(f"TYPE_{kind.upper()}"),
                label=proto.LABEL_REPEATED if repeated else proto.LABEL_OPTIONAL,
            )
    assert not re.sub(r"message (\w+) \{([^}]*)\}", "", rest).strip()
    return file


def test_the_proto_file_and_the_code_agree():
    assert parse(PROTO.read_text()) == schemas.file_descriptor()


def test_every_schema_of_the_table_describes_itself():
    for channel in (*channels.CHANNELS, *channels.REPLAY_CHANNELS):
        files = descriptor_pb2.FileDescriptorSet.FromString(schemas.schema_bytes(channel.schema))
        package, _, name = channel.schema.partition(".")
        assert files.file[-1].package == package
        assert name in [m.name for m in files.file[-1].message_type]
    used = {c.schema for c in (*channels.CHANNELS, *channels.REPLAY_CHANNELS)}
    assert {f"overfly.{name}" for name in schemas.TYPES} <= used


@pytest.mark.parametrize("name", ["overfly.Nothing", "foxglove.Nothing", "foxglove.os.path", "ros.Grid"])
def test_an_unknown_schema_is_named(name):
    with pytest.raises(RecordError, match=f"schema {re.escape(name)} is not known"):
        schemas.message_class(name)


def rows(text, heading):
    """The cells of the table under a heading, without backquotes."""
    section = text.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [tuple(cell.strip().replace("`", "") for cell in line.strip("|").split("|")) for line in lines[2:]]


def test_the_document_shows_the_table_of_topics():
    assert rows(DOC.read_text(), "Topics") == [(c.topic, c.schema, c.process, c.about) for c in channels.CHANNELS]


def test_the_document_shows_the_table_of_topics_of_replay_files():
    assert rows(DOC.read_text(), "Replay files") == [(c.topic, c.schema, c.about) for c in channels.REPLAY_CHANNELS]


def test_the_document_shows_the_types():
    assert dict(rows(DOC.read_text(), "Types")) == schemas.TYPES


def test_the_example_of_the_document_runs(tmp_path, monkeypatch, capsys):
    from tmc.kernel.config import JournalConfig  # noqa: PLC0415
    from tmc.record.writer import LogWriter  # noqa: PLC0415

    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        log.write("/tmc/metrics", schemas.TeamMetrics(episode=7, first=0, uncertainty=[1.5, 2.5]))
    code, _with_pandas = re.findall(r"```python\n(.*?)```", DOC.read_text(), re.S)
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert capsys.readouterr().out == "7 0 [1.5, 2.5]\n"


def test_no_two_rows_claim_a_topic_and_uav_topics_are_found():
    for channel in channels.CHANNELS:
        topic = channel.topic.replace("<id>", "12")
        assert [c for c in channels.CHANNELS if c.pattern.fullmatch(topic)] == [channel]
    assert channels.find(channels.uav_topic(12, "fix"), "uav-012").schema == "foxglove.LocationFix"

"""overfly.proto, the classes generated from it, and docs/reference/log-format.md agree."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool

from tmc.record import channels, overfly_pb2, schemas
from tmc.record.errors import RecordError

ROOT = Path(__file__).parents[3]
DOC = ROOT / "docs" / "reference" / "log-format.md"
_SPEC = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
hatch_build = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(hatch_build)


def fields_of(message):
    """The fields of a type as the document shows them; their numbers are their places."""
    assert [field.number for field in message.field] == [*range(1, len(message.field) + 1)]
    kinds = descriptor_pb2.FieldDescriptorProto
    return ", ".join(
        f"{kinds.Type.Name(field.type).removeprefix('TYPE_').lower()}{'*' * (field.label == kinds.LABEL_REPEATED)} "
        f"{field.name}"
        for field in message.field
    )


def test_the_classes_are_generated_from_the_proto_file(tmp_path):
    """A change of the .proto file in a checkout is in the classes only after `make proto`."""
    for name in map(Path, hatch_build.PROTOS):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    for path in hatch_build.generate(tmp_path):
        assert (ROOT / path).read_bytes() == (tmp_path / path).read_bytes(), f"{path} is out of date: run make proto"


def test_the_generated_code_runs_with_the_oldest_protobuf_that_is_allowed():
    """Generated code refuses a runtime that is older than its protoc: 5.29.6 is protoc 29.6."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    oldest = next(d for d in project["project"]["dependencies"] if d.startswith("protobuf>=")).partition(">=5.")[2]
    protoc = f"{hatch_build.PROTOC}=={oldest}"
    assert (
        protoc in project["build-system"]["requires"] and protoc in project["project"]["optional-dependencies"]["dev"]
    )
    assert protoc in (ROOT / "constraints.txt").read_text().split()


def test_a_users_types_of_the_same_names_do_not_collide():
    """Protobuf's pool is one for the whole process: there our file goes by its path, our types by their package."""
    file = descriptor_pb2.FileDescriptorProto(name="overfly.proto", package="mine", syntax="proto3")
    file.message_type.add(name="Sync")
    pool = descriptor_pool.Default()
    pool.AddSerializedFile(file.SerializeToString())
    assert pool.FindMessageTypeByName("overfly.Sync") is overfly_pb2.Sync.DESCRIPTOR
    assert pool.FindMessageTypeByName("mine.Sync").file.name == "overfly.proto"


def test_every_schema_of_the_table_describes_itself():
    for channel in (*channels.CHANNELS, *channels.REPLAY_CHANNELS):
        files = descriptor_pb2.FileDescriptorSet.FromString(schemas.schema_bytes(channel.schema))
        package, _, name = channel.schema.partition(".")
        assert files.file[-1].package == package
        assert name in [m.name for m in files.file[-1].message_type]
    used = {c.schema for c in (*channels.CHANNELS, *channels.REPLAY_CHANNELS)}
    assert {f"overfly.{name}" for name in overfly_pb2.DESCRIPTOR.message_types_by_name} <= used


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
    file = descriptor_pb2.FileDescriptorProto()
    overfly_pb2.DESCRIPTOR.CopyToProto(file)
    assert rows(DOC.read_text(), "Types") == [(message.name, fields_of(message)) for message in file.message_type]


def test_the_example_of_the_document_runs(tmp_path, monkeypatch, capsys):
    from tmc.kernel.config import JournalConfig  # noqa: PLC0415
    from tmc.record.writer import LogWriter  # noqa: PLC0415

    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        log.write("/tmc/metrics", overfly_pb2.TeamMetrics(episode=7, first=0, uncertainty=[1.5, 2.5]))
    code, _with_pandas = re.findall(r"```python\n(.*?)```", DOC.read_text(), re.S)
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert capsys.readouterr().out == "7 0 [1.5, 2.5]\n"


def test_no_two_rows_claim_a_topic_and_uav_topics_are_found():
    for channel in channels.CHANNELS:
        topic = channel.topic.replace("<id>", "12")
        assert [c for c in channels.CHANNELS if c.pattern.fullmatch(topic)] == [channel]
    assert channels.find(channels.uav_topic(12, "fix"), "uav-012").schema == "foxglove.LocationFix"

"""Rust: rerun-sdk reports no issue, and decodes every message of every log as Overfly's reader does."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor

from tests.command import PATIENCE_S
from tests.readers.conftest import Topic

Rerun = Callable[..., subprocess.CompletedProcess[str]]

MISSING = "needs rerun-sdk: pip install '.[readers]'"


@pytest.fixture
def rerun(tmp_path: Path) -> Rerun:
    """Run `rerun mcap ARGS`, with settings of its own in which it sends nothing anywhere."""
    program = shutil.which("rerun", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if program is None:
        pytest.skip(MISSING)
    home = tmp_path / "home"
    home.mkdir()
    env = {"HOME": str(home), "PATH": os.environ["PATH"], "NO_COLOR": "1"}

    def run(*args: object) -> subprocess.CompletedProcess[str]:
        command = [program, *map(str, args)]
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=env)

    assert run("analytics", "disable").returncode == 0
    return lambda *args: run("mcap", *args)


def checked(text: str) -> dict[str, tuple[str, str]]:
    """{topic: (status, issues)} of the table that `rerun mcap check` prints; it exits with 0 whatever it finds."""
    rows = re.findall(r"^(\S+) +\d+ +\d+ +(/\S+) +(.*)$", text, re.MULTILINE)
    return {topic: (status, issues) for status, topic, issues in rows}


def test_rerun_check_finds_nothing(rerun: Rerun, logs: list[Path], ours) -> None:
    for path in logs:
        done = rerun("check", "--full", path)
        assert done.returncode == 0 and "ERROR" not in done.stderr, done.stderr
        assert checked(done.stdout) == dict.fromkeys(ours(path), ("ok", "—"))


def test_rerun_check_finds_nothing_in_what_a_kill_left(rerun: Rerun, killed: list[Path], ours) -> None:
    for path in killed:
        done = rerun("check", "--full", "--recover", path)
        assert done.returncode == 0 and "ERROR" not in done.stderr, done.stderr
        assert checked(done.stdout) == dict.fromkeys(ours(path), ("ok", "—"))


def test_rerun_converts_every_topic(rerun: Rerun, logs: list[Path], ours, tmp_path: Path) -> None:
    """With its decoders for viewing, and without the one that keeps what it cannot decode as bytes."""
    for path in logs:
        done = rerun("convert", "--disable-raw-fallback", path, "--output", tmp_path / "out.rrd")
        assert done.returncode == 0 and "ERROR" not in done.stderr, done.stderr
        entities = set(re.findall(r"^ +(/\S+),$", done.stderr, re.MULTILINE))
        assert {name for name in entities if not name.startswith("/__mcap_")} == set(ours(path))


def test_rerun_decodes_every_message(logs: list[Path], ours) -> None:
    for path in logs:
        assert_as_we_read_it(decoded(path), ours(path))


def test_rerun_decodes_what_a_kill_left(killed: list[Path], ours) -> None:
    for path in killed:
        assert_as_we_read_it(decoded(path, recover=True), ours(path))


def decoded(path: Path, recover: bool = False) -> dict[str, list[tuple[int, str, Any]]]:
    """{topic: its messages (log time in ns, schema, fields) in file order} by the decoder for protobuf."""
    reader = pytest.importorskip("rerun.chunk", reason=MISSING).McapReader(path, decoders=["protobuf"], recover=recover)
    found: dict[str, list[tuple[int, str, Any]]] = {}
    for chunk in reader.stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            (column,) = (name for name in batch.schema.names if name.endswith(":message"))
            times = batch.column("message_log_time").cast("int64").to_pylist()
            rows = zip(times, batch.column(column).to_pylist(), strict=True)
            schema = column.removesuffix(":message")
            found.setdefault(chunk.entity_path, []).extend((time, schema, fields) for time, (fields,) in rows)
    return found


def assert_as_we_read_it(found: dict[str, list[tuple[int, str, Any]]], ours: dict[str, Topic]) -> None:
    assert sorted(found) == sorted(ours)
    for name, topic in ours.items():
        wanted = [(entry.log_time, topic.schema, fields_of(entry.message)) for entry in topic.entries]
        assert sorted(found[name], key=lambda row: row[0]) == wanted


def fields_of(message: Any) -> dict[str, Any]:
    """A message as Rerun has it: None for what is not set, and enums with name and number."""
    return {field.name: _value(message, field) for field in message.DESCRIPTOR.fields}


def _value(message: Any, field: FieldDescriptor) -> Any:
    value = getattr(message, field.name)
    if field.is_repeated:
        return [_single(item, field) for item in value] or None
    if field.has_presence and not message.HasField(field.name):
        return None
    return _single(value, field)


def _single(value: Any, field: FieldDescriptor) -> Any:
    if field.message_type is not None:
        return fields_of(value)
    if field.enum_type is not None:
        return {"name": field.enum_type.values_by_number[value].name, "value": value}
    return value

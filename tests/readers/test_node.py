"""JavaScript: @mcap/core, protobufjs and fzstd decode every message of every log, by `read.mjs`."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import json_format
from mcap.writer import Writer

from tests.command import PATIENCE_S
from tests.readers.conftest import Topic
from tmc.record import schemas

HERE = Path(__file__).parent
Read = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def node() -> Read:
    """Run `read.mjs` with these arguments."""
    program = shutil.which("node")
    if program is None or not (HERE / "node_modules").is_dir():
        pytest.skip("needs Node.js and what tests/readers/package.json names: npm ci --prefix tests/readers")

    def run(*args: object) -> subprocess.CompletedProcess[str]:
        command = [program, str(HERE / "read.mjs"), *map(str, args)]
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)

    return run


def assert_as_we_read_it(found: dict[str, dict[str, Any]], ours: dict[str, Topic]) -> None:
    """Same topics, schemas, counts and times; and the newest message of each, which came by as proto3 JSON, is ours."""
    assert sorted(found) == sorted(ours)
    for name, topic in ours.items():
        seen, newest = found[name], topic.messages[-1]
        assert (seen["schema"], seen["count"]) == (topic.schema, len(topic.entries))
        assert (int(seen["first"]), int(seen["last"])) == (topic.times[0], topic.times[-1])
        assert json_format.ParseDict(seen["newest"], type(newest)()) == newest


def test_node_decodes_every_message(node: Read, logs: list[Path], ours) -> None:
    done = node(*logs)
    assert done.returncode == 0, done.stderr
    for path, line in zip(logs, done.stdout.splitlines(), strict=True):
        assert_as_we_read_it(json.loads(line), ours(path))


def test_node_reads_what_a_kill_left(node: Read, killed: list[Path], ours) -> None:
    done = node("--cut", *killed)
    assert done.returncode == 0, done.stderr
    for path, line in zip(killed, done.stdout.splitlines(), strict=True):
        assert_as_we_read_it(json.loads(line), ours(path))
    assert "no end" in node(killed[0]).stderr


def write(path: Path, messages: Iterable[tuple[int, bytes]]) -> None:
    """A log of (log time, payload) on one topic, by the mcap package alone: it checks nothing."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("overfly.Sync", "protobuf", schemas.schema_bytes("overfly.Sync"))
        channel = writer.register_channel("/tmc/sync", "protobuf", schema)
        for time, data in messages:
            writer.add_message(channel, time, data, time)
        writer.finish()


INTACT = schemas.Sync(tick=7).SerializeToString()
WRONG = {
    "ends within a field": ([(1, INTACT), (2, INTACT[:-1])], "index out of range"),
    "field that the schema has not": ([(1, b"\x78\x01")], "not what its schema describes"),
    "times that go back": ([(5, INTACT), (4, INTACT)], "log time 4 comes after 5"),
}


@pytest.mark.parametrize("messages, sentence", WRONG.values(), ids=WRONG)
def test_node_refuses_what_is_wrong(node: Read, tmp_path: Path, messages: list[Any], sentence: str) -> None:
    write(tmp_path / "wrong.mcap", messages)
    done = node(tmp_path / "wrong.mcap")
    assert done.returncode == 1 and sentence in done.stderr and not done.stdout


def test_node_refuses_a_flipped_bit(node: Read, missions: Path, tmp_path: Path) -> None:
    data = bytearray((missions / "flown" / "tmc.mcap").read_bytes())
    data[len(data) // 3] ^= 4
    (tmp_path / "flipped.mcap").write_bytes(data)
    assert node(tmp_path / "flipped.mcap").returncode == 1

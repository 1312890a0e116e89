"""Python: pymcap-cli, whose `doctor` holds a file against every rule of the format, finds no error and every message.

It decodes no protobuf: what the messages say is for the other readers.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

Pymcap = Callable[..., subprocess.CompletedProcess[str]]
MEANT = {"METADATA_NAME_DUPLICATE", "CHUNK_COMPRESSION_INEFFICIENT"}
"""Warnings of what is as it should be: each incarnation of a process leaves its metadata, and small chunks hardly
shrink.
"""


@pytest.fixture
def pymcap(tmp_path: Path) -> Pymcap:
    """Run `pymcap-cli ARGS`, with a home of its own."""
    program = shutil.which("pymcap-cli", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if program is None:
        pytest.skip("needs pymcap-cli: pip install '.[readers]'")
    env = {"HOME": str(tmp_path), "PATH": os.environ["PATH"], "NO_COLOR": "1"}

    def run(*args: object) -> subprocess.CompletedProcess[str]:
        command = [program, *map(str, args)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=env)

    return run


def examined(pymcap: Pymcap, path: Path) -> tuple[int, list[dict[str, Any]]]:
    """The exit code of `doctor`, and a line each of what it found, the last of them with the counts."""
    done = pymcap("doctor", "--format", "jsonl", path)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def counts(pymcap: Pymcap, paths: list[Path]) -> list[dict[str, int]]:
    """{topic: messages} of each file, by its summary."""
    done = pymcap("info-json", *paths)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    files: list[Counter[str]] = []
    for file in told if len(paths) > 1 else [told]:
        files.append(Counter())
        for channel in file["channels"]:
            files[-1][channel["topic"]] += channel["message_count"]
    return [dict(topics) for topics in files]


def test_doctor_finds_no_error(pymcap: Pymcap, logs: list[Path], ours) -> None:
    for path in logs:
        code, (*findings, summary) = examined(pymcap, path)
        wrong = [f for f in findings if f["severity"] != "info" and f["code"] not in MEANT]
        assert (code, wrong, summary["complete"]) == (0, [], True)
        assert summary["messages"] == sum(len(topic.entries) for topic in ours(path).values())
    assert counts(pymcap, logs) == [{name: len(topic.entries) for name, topic in ours(path).items()} for path in logs]


def test_recover_finds_what_a_kill_left(pymcap: Pymcap, killed: list[Path], ours, tmp_path: Path) -> None:
    recovered = [tmp_path / f"again-{path.name}" for path in killed]
    for path, again in zip(killed, recovered, strict=True):
        assert pymcap("recover", path, "--output", again).returncode in (0, 3)  # 3: some of it was cut off
    wanted = [{name: len(topic.entries) for name, topic in ours(path).items()} for path in killed]
    assert counts(pymcap, recovered) == wanted


def test_doctor_would_find_the_offset_of_a_group_that_is_not_there(pymcap: Pymcap, tmp_path: Path) -> None:
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    code, findings = examined(pymcap, tmp_path / "x.mcap")
    assert code == 1 and "SUMMARY_OFFSET_WITHOUT_GROUP" in {f.get("code") for f in findings}


def test_doctor_finds_a_flipped_bit(pymcap: Pymcap, missions: Path, tmp_path: Path) -> None:
    data = bytearray((missions / "flown" / "tmc.mcap").read_bytes())
    data[len(data) // 3] ^= 4
    (tmp_path / "flipped.mcap").write_bytes(data)
    assert examined(pymcap, tmp_path / "flipped.mcap")[0] == 1

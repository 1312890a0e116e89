"""Compacting: all that a run's logs hold in larger chunks and under finished names, or the logs as they were."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tmc.kernel.config import JournalConfig
from tmc.record import schemas
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import CHUNK_BYTES, compact_run
from tmc.record.reader import Log
from tmc.record.writer import LogWriter

ZSTD = bytes.fromhex("28b52ffd")
"""How the compressed data of a chunk begin."""
Message = tuple[str, str, int, int, int, bytes]


def fill(folder: Path, process: str, rounds: int, *, close: bool = True) -> Path:
    log = LogWriter(folder / f"{process}.mcap", process, JournalConfig(flush_interval=60.0), {"run": "abc"})
    log.attach("config.json", "application/json", b"{}")
    for n in range(rounds):
        if process == "tmc":
            log.write("/tmc/sync", schemas.Sync(tick=n, uavs=range(9), believed=n / 7), publish_time=5 + n)
        log.log("info", f"round {n}")
        log.flush()
    if close:
        log.close()
        return log.path
    log._give_up()
    return log.active


def held(path: Path) -> list[Message]:
    return [(m.topic, m.schema, m.log_time, m.publish_time, m.sequence, m.data) for m in Log(path).raw()]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    fill(tmp_path, "tmc", 300)
    fill(tmp_path, "uav-000", 50, close=False)
    return tmp_path


def test_all_is_kept_and_takes_less(run: Path) -> None:
    before = {"tmc": held(run / "tmc.mcap"), "uav-000": held(run / "uav-000.mcap.active")}
    facts = Log(run / "tmc.mcap").metadata()
    compacted = compact_run(run)
    assert sorted(p.name for p in run.iterdir()) == ["tmc.mcap", "uav-000.mcap"]
    assert {name: held(run / f"{name}.mcap") for name in before} == before
    for file in compacted:
        assert file.after == file.path.stat().st_size < file.before / 2
        assert file.messages == len(held(file.path)) and file.dropped == 0
        log = Log(file.path)
        assert log.finished and log.damage is None
        assert [(a.name, a.media_type, a.data) for a in log.attachments()] == [
            ("config.json", "application/json", b"{}")
        ]
        with file.path.open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
            assert summary is not None and summary.statistics is not None
            assert summary.statistics.message_count == file.messages
            assert len(summary.chunk_indexes) == 1 and summary.chunk_indexes[0].compression == "zstd"
            assert len(summary.attachment_indexes) == len(summary.metadata_indexes) == 1
    assert Log(run / "tmc.mcap").metadata() == facts
    assert [(f.before, f.after) for f in compact_run(run)] == [(f.after, f.after) for f in compacted]


def test_large_logs_get_chunks_of_four_mebibytes(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "tmc.mcap", "tmc", JournalConfig(), {}) as log:
        for n in range(5):
            log.write("/learner/policy", schemas.Policy(version=n, model=bytes(2_000_000)))
    compact_run(tmp_path)
    with (tmp_path / "tmc.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes]
    assert len(sizes) == 2 and sizes[0] > CHUNK_BYTES


def test_a_torn_end_is_dropped_and_said(run: Path) -> None:
    path = run / "uav-000.mcap.active"
    whole = path.read_bytes()
    path.write_bytes(whole + b"\x06half a chunk")
    compacted = {file.path.name: file for file in compact_run(run)}
    assert compacted["uav-000.mcap"].dropped == len(b"\x06half a chunk")
    assert len(held(run / "uav-000.mcap")) == 50


def test_a_damaged_log_is_refused_and_nothing_is_changed(run: Path) -> None:
    path = run / "uav-000.mcap.active"
    data = bytearray(path.read_bytes())
    data[data.index(ZSTD, len(data) // 2) + 8] ^= 1  # an index or a metadata record has no CRC that would tell
    path.write_bytes(data)
    before = {p.name: p.read_bytes() for p in run.iterdir()}
    with pytest.raises(RecordError, match=r"uav-000\.mcap\.active is damaged .*`overfly log recover`"):
        compact_run(run)
    assert {p.name: p.read_bytes() for p in run.iterdir()} == before


def test_a_run_that_is_still_written_is_refused(run: Path) -> None:
    before = (run / "tmc.mcap").read_bytes()
    with (
        LogWriter(run / "uav-001.mcap", "uav-001", JournalConfig(), {}),
        pytest.raises(RecordError, match=r"uav-001\.mcap\.active is being written by another process: end that one"),
    ):
        compact_run(run)
    assert (run / "tmc.mcap").read_bytes() == before
    assert len(compact_run(run)) == 3


def test_a_full_disk_leaves_the_log_as_it_was(run: Path) -> None:
    before = {p.name: p.read_bytes() for p in run.iterdir()}
    code = f"""
import resource, signal, sys
from pathlib import Path
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import compact_run
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
try:
    compact_run(Path({str(run)!r}))
except RecordError as error:
    print(error)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "the disk that holds" in said and "is full: free some space" in said
    assert {p.name: p.read_bytes() for p in run.iterdir()} == before


def test_no_run(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="holds no logs of a run"):
        compact_run(tmp_path)

"""What every file of ours has in common: its summary names no group of records that is not there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.records import SummaryOffset
from mcap.stream_reader import StreamReader

from tmc.kernel.config import JournalConfig
from tmc.record.mcap.compact import compact_log
from tmc.record.mcap.export import Export
from tmc.record.writer import LogWriter


def logged(path: Path) -> None:
    with LogWriter(path, path.stem, JournalConfig(), {}) as log:
        log.log("info", "nothing is attached here")


def compacted(path: Path) -> None:
    logged(path)
    compact_log(path)


def exported(path: Path) -> None:
    with Export(path.with_name("x.mcap")):
        pass
    path.with_name("x.mcap").rename(path)


@pytest.mark.parametrize("make", [logged, compacted, exported])
def test_summary_offsets_lead_to_records(make: Callable[[Path], None], tmp_path: Path) -> None:
    path = tmp_path / "learner.mcap"
    make(path)
    with path.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
    there = {type(record).__name__ for record in records}
    named = {Opcode(record.group_opcode) for record in records if isinstance(record, SummaryOffset)}
    assert {opcode.name.title().replace("_", "") for opcode in named} <= there

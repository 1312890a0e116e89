"""Compares the acknowledgements that UAVs logged with the journal: no record is lost, and none is journalled twice."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from tmc.record.builders import record_digest, to_record
from tmc.record.channels import ACTIVE
from tmc.record.overfly_pb2 import Episode, FlightRecord, TeamMetrics
from tmc.record.reader import Log
from tmc.record.run_folder import RunFolder

RecordId = tuple[int, int]
"""A record: UAV and sequence."""


@dataclass(frozen=True)
class DeliveryReport:
    """Counts of the records of a mission, and of what was flown according to its journal.

    `lost`: acknowledged, but not in the journal with the same digest. `doubled`: journalled more than once.
    """

    acknowledged: int
    journalled: int
    lost: int
    doubled: int
    episodes: int
    ticks: int
    updates: int


def check_delivery(out: Path, lost_before: Collection[RecordId] = ()) -> DeliveryReport:
    """Compare the journal of a run with all acknowledgements; `lost_before`: records already found lost."""
    digests: dict[RecordId, str] = {}
    times: Counter[RecordId] = Counter()
    flown = Counter[str]()
    for entry in Log(_journal(out)).entries():
        message = entry.message
        if isinstance(message, FlightRecord):
            number = message.uav, message.sequence
            digests.setdefault(number, record_digest(to_record(message)))
            times[number] += 1
        elif isinstance(message, TeamMetrics):
            flown["ticks"] += len(message.uncertainty) - (message.first == 0)
            flown["updates"] = message.updates
        elif isinstance(message, Episode):
            flown["episodes"] += message.phase == "end"
    acks = set(_acks(out))
    lost = {number for number, digest in acks if digests.get(number) != digest} | {*lost_before}
    doubled = sum(count > 1 for count in times.values())
    acknowledged = {number for number, _ in acks}
    return DeliveryReport(
        len(acknowledged), len(times), len(lost), doubled, flown["episodes"], flown["ticks"], flown["updates"]
    )  # fmt: skip


def _journal(out: Path) -> Path:
    found = RunFolder(out).existing_journal()
    assert found is not None, f"{out} holds no journal"
    return found


def ack_files(out: Path) -> list[Path]:
    """Return the files of the UAVs' acknowledgements in a run folder."""
    return sorted(RunFolder(out).acks.glob("uav-*.txt"))


def _acks(out: Path) -> Iterable[tuple[RecordId, str]]:
    """Yield ((uav, sequence), digest) of each acknowledgement."""
    for path in ack_files(out):
        uav = int(path.stem.removeprefix("uav-"))
        for line in path.read_text("utf-8").splitlines():
            sequence, digest = line.split()
            yield (uav, int(sequence)), digest


@dataclass(frozen=True)
class Snapshot:
    """The journal as a kill of the TMC left it, and the last acknowledged record of each UAV by then.

    A record lost by a kill may be flown again, identically, so its loss shows only here.
    """

    journal: Path
    acknowledged: dict[int, int]

    @classmethod
    def capture(cls, out: Path) -> Snapshot:
        """Keep the journal under another name, because the next TMC writes a new file."""
        link = RunFolder(out).acks / f"killed-{time.monotonic_ns()}.mcap{ACTIVE}"
        os.link(_journal(out), link)
        acknowledged = {}
        for path in ack_files(out):
            lines = path.read_text("utf-8").splitlines()
            if lines:
                acknowledged[int(path.stem.removeprefix("uav-"))] = int(lines[-1].split()[0])
        return cls(link, acknowledged)

    def lost(self) -> set[RecordId]:
        """Return the acknowledged records that did not survive; delete the file."""
        counts: Counter[int] = Counter()
        for raw in Log(self.journal).raw():
            if raw.schema == "overfly.FlightRecord":
                counts[int(raw.topic.split("/")[2])] += 1  # a UAV's records are numbered from 0 without a gap
        self.journal.unlink()
        return {(uav, n) for uav, last in self.acknowledged.items() for n in range(counts[uav], last + 1)}

"""Simulates a power cut: what was not synced to the disk may be lost, from any byte on."""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

from tmc.record.channels import ACTIVE
from tmc.record.run_folder import RunFolder

UNSYNCED = (
    f"uav-*.mcap{ACTIVE}",
    f"learner.mcap{ACTIVE}",
    "*.mcap.active.new",
    "learner.run",
)
"""Files of a run that no process syncs."""


def cut_tails(out: Path, draw: Random) -> int:
    """Cut the files of a run at random, once all its processes are dead; return the bytes that the journal loses."""
    for pattern in UNSYNCED:
        for path in sorted(out.glob(pattern)):
            if draw.random() < 0.5:
                os.truncate(path, draw.randint(0, path.stat().st_size))
    journal = RunFolder(out).active_journal
    size, kept = journal.stat().st_size, synced_bytes(out, journal)
    left = draw.randint(kept, size)
    os.truncate(journal, left)
    return size - left


def synced_bytes(out: Path, journal: Path) -> int:
    """Return how many bytes of the journal are synced, by the TMC's sync log; all of a journal that was just replaced.

    Half of it if the TMC does not sync: the system writes by itself now and then.
    """
    now, sync_log = journal.stat(), RunFolder(out).acks_of("tmc")
    if not sync_log.exists():
        return now.st_size // 2
    inode, size = sync_log.read_text("utf-8").split("\n")[-2].split()
    return int(size) if int(inode) == now.st_ino else now.st_size

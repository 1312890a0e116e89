"""A simulated power cut: what no process has told the disk to keep may be gone, from any byte on."""

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
"""Files of a run that nobody waits for the disk with."""


def cut_tails(out: Path, draw: Random) -> int:
    """Cut the files of a run, all of whose processes are dead, at random; returns the bytes that the journal loses."""
    for pattern in UNSYNCED:
        for path in sorted(out.glob(pattern)):
            if draw.random() < 0.5:
                os.truncate(path, draw.randint(0, path.stat().st_size))
    journal = RunFolder(out).active_journal
    size, kept = journal.stat().st_size, synced(out, journal)
    left = draw.randint(kept, size)
    os.truncate(journal, left)
    return size - left


def synced(out: Path, journal: Path) -> int:
    """How many bytes of the journal the disk has, by what the TMC took down; all, where it was just taken over.

    Half of it where the TMC never waits for the disk: the system writes by itself now and then.
    """
    now, told = journal.stat(), RunFolder(out).acks_of("tmc")
    if not told.exists():
        return now.st_size // 2
    inode, size = told.read_text("utf-8").split("\n")[-2].split()
    return int(size) if int(inode) == now.st_ino else now.st_size

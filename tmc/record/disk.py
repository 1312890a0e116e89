"""What the writer asks of the file system, and how it speaks of its failures."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from tmc.record.channels import ACTIVE
from tmc.record.errors import RecordError


def left_behind(path: Path, resume: bool) -> Path | None:
    """The file that an earlier life left at `path`, to resume; RecordError rather than write over it."""
    if path.suffix != ".mcap":
        raise RecordError(f"{path} must end in .mcap: correct the name of the log")
    for old in (path.with_name(path.name + ACTIVE), path):
        if resume and old.is_file():
            return old
        if old.exists():
            raise RecordError(f"{old} exists already: choose a new run folder, or resume the run that is in it")
    return None


def sync_folder(folder: Path) -> None:
    """Wait until the disk knows the names in a folder."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def unwritable(path: Path, error: OSError) -> str:
    """Why a log cannot be written, and the mend."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"the disk that holds {path} is full: free some space and resume; what was flushed stays readable"
    return f"{path} cannot be written ({error.strerror}): make its folder exist and writable, or choose another one"

"""Open, lock and replace files, and say in one sentence why that failed."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import IO, Any

from tmc.kernel import files
from tmc.record.errors import NoLogError, RecordError
from tmc.record.run_folder import active_name

NEW_SUFFIX = ".new"
"""Appended to the name of a file while its replacement is written."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that holds no more."""
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF)
"""Errors of a file system without locks, or, as NFS, without locks of files opened to read. No log is locked then."""


def open_log(path: Path) -> IO[bytes]:
    """Open a log to read. NoLogError when that is not possible, or would block, as a pipe does."""
    try:
        return files.opened(path)
    except OSError as error:
        raise NoLogError(f"{path} cannot be read ({error.strerror}): give the file of a log") from None


def previous_log(path: Path, resume: bool) -> Path | None:
    """Return the file that an earlier incarnation left at `path`, to be resumed; None when there is none.

    RecordError when there is one and it must not be resumed: it would be overwritten.
    """
    if path.suffix != ".mcap":
        raise RecordError(f"{path} must end in .mcap: correct the name of the log")
    there = [old for old in (active_name(path), path) if old.exists()]
    if there and not (resume and there[0].is_file()):
        raise RecordError(f"{there[0]} exists already: choose a new run folder, or resume the run that is in it")
    # An empty file holds nothing: then the other one is what was left.
    return next((old for old in there if old.stat().st_size), there[0] if there else None)


def open_locked(path: Path, mode: str) -> Any:
    """Open a log and lock it against other writers until it is closed; RecordError when another process has it."""
    file = open_log(path) if mode == "rb" else open(path, mode, opener=_untruncated)  # noqa: SIM115  the caller closes
    try:
        _lock(file, path)
        if mode == "wb":
            file.truncate(0)
    except BaseException:
        file.close()
        raise
    return file


def _untruncated(name: str, flags: int) -> int:
    """Open without truncating a file that another process may hold, and without waiting for the reader of a pipe."""
    return os.open(name, flags & ~os.O_TRUNC | os.O_NONBLOCK, 0o666)


def _lock(file: IO[bytes], path: Path) -> None:
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RecordError(f"{path} is being written by another process: end that one first") from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    if not _is_named(file, path):
        raise RecordError(f"{path} was just taken over by another process: end that one first")


def _is_named(file: IO[bytes], path: Path) -> bool:
    """True while `path` is still the name of an open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def write_atomically(path: Path, content: bytes, *, sync: bool) -> None:
    """Write a file whole or not at all: readers find the old content or the new one. Raises OSError.

    With `sync`, return once the content and the name are on the disk, so that a power cut does not undo it.
    """
    new = path.with_name(path.name + NEW_SUFFIX)
    new.unlink(missing_ok=True)
    try:
        with new.open("xb") as file:
            file.write(content)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise
    if sync:
        sync_folder(path.parent)


def why_unwritable(path: Path, error: OSError) -> str:
    """Return why a log cannot be written, and the fix."""
    if error.errno == errno.EFBIG:
        return (
            f"{path} is as large as a file may be here: run `ulimit -f unlimited` and resume; what was flushed is kept"
        )
    if error.errno in DISK_FULL:
        return f"the disk that holds {path} is full: free some space and resume; what was flushed stays readable"
    return f"{path} cannot be written ({error.strerror}): make its folder exist and writable, or choose another one"

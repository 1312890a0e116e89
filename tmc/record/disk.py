"""What the writer asks of the file system, and how it speaks of its failures."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import IO, Any

from tmc.kernel import files
from tmc.record.channels import ACTIVE
from tmc.record.errors import NoLogError, RecordError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that holds no more."""
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EBADF)
"""Errors of a file system that knows no locks, or, as NFS, none of files opened to read: there, nothing is held."""


def open_log(path: Path) -> IO[bytes]:
    """Open a log to read. NoLogError where that is not possible, or would wait for ever as a pipe's end does."""
    try:
        return files.opened(path)
    except OSError as error:
        raise NoLogError(f"{path} cannot be read ({error.strerror}): give the file of a log") from None


def left_behind(path: Path, resume: bool) -> Path | None:
    """The file that an earlier incarnation left at `path`, to resume; RecordError rather than write over it."""
    if path.suffix != ".mcap":
        raise RecordError(f"{path} must end in .mcap: correct the name of the log")
    there = [old for old in (path.with_name(path.name + ACTIVE), path) if old.exists()]
    if there and not (resume and there[0].is_file()):
        raise RecordError(f"{there[0]} exists already: choose a new run folder, or resume the run that is in it")
    # An empty file holds nothing: what stands beside it is what was left.
    return next((old for old in there if old.stat().st_size), there[0] if there else None)


def open_held(path: Path, mode: str) -> Any:
    """Open a log and keep other writers away from it until it is closed; RecordError when one has it already."""
    file = open_log(path) if mode == "rb" else open(path, mode, opener=_whole)  # noqa: SIM115  whoever asks closes it
    try:
        _hold(file, path)
        if mode == "wb":
            file.truncate(0)
    except BaseException:
        file.close()
        raise
    return file


def _whole(name: str, flags: int) -> int:
    """Opens without cutting the file, which may be somebody else's, and without waiting for who reads a pipe."""
    return os.open(name, flags & ~os.O_TRUNC | os.O_NONBLOCK, 0o666)


def _hold(file: IO[bytes], path: Path) -> None:
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RecordError(f"{path} is being written by another process: end that one first") from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    if not _named(file, path):
        raise RecordError(f"{path} was just taken over by another process: end that one first")


def _named(file: IO[bytes], path: Path) -> bool:
    """True while `path` is still the name of an open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def sync_folder(folder: Path) -> None:
    """Wait until the disk knows the names in a folder."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def put(path: Path, content: bytes, *, sync: bool) -> None:
    """Write a file whole or not at all; with `sync`, wait until the disk has it."""
    new = path.with_suffix(".new")
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


def unwritable(path: Path, error: OSError) -> str:
    """Why a log cannot be written, and the mend."""
    if error.errno == errno.EFBIG:
        return (
            f"{path} is as large as a file may be here: run `ulimit -f unlimited` and resume; what was flushed is kept"
        )
    if error.errno in FULL:
        return f"the disk that holds {path} is full: free some space and resume; what was flushed stays readable"
    return f"{path} cannot be written ({error.strerror}): make its folder exist and writable, or choose another one"

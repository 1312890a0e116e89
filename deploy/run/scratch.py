"""The scratch folder of a mission: sockets and the track table, in memory if there is room."""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from actors.tracks import create_table, table_bytes
from tmc.kernel.config import Config, ConfigError
from tmc.kernel.text import printable
from tmc.wire.endpoints import LEARNER_SUFFIX, MAX_PATH_BYTES

NAME, HELD = "overfly-", "held"
"""Prefix of the folders' names, and the file in each that is locked while its supervisor runs."""
MEMORY = Path("/dev/shm")
"""Memory-backed, because the track table must not wait for a disk."""
ELSEWHERE = (Path("/tmp"), Path("/var/tmp"))


@dataclass(frozen=True)
class Scratch:
    """A scratch folder. `held`: the file that is locked while it is open. `tracks` exists unless `table` was False."""

    folder: Path
    held: IO[bytes]

    @property
    def endpoint(self) -> str:
        """The endpoint at which the TMC listens for UAVs."""
        return f"ipc://{self.folder}/sync"

    @property
    def tracks(self) -> Path:
        """The path of the track table."""
        return self.folder / "tracks"

    def close(self) -> None:
        """Remove the folder."""
        with suppress(OSError):
            shutil.rmtree(self.folder)
        self.held.close()


def make(config: Config, *, table: bool = True) -> Scratch:
    """Make a scratch folder with room for the table. Raises ConfigError if no place of this machine has it.

    Folders of killed supervisors are removed first, since no process locks their files any more.
    """
    team, ticks = config.team.size, config.training.ticks
    wrong = []
    for place in places():
        _remove_old(place)
        try:
            return _made(place, (team, ticks) if table else None)
        except OSError as error:
            wrong.append(f"{printable(place)}: {_reason(place, error)}")
    need = f"{table_bytes(team, ticks):,} bytes for the track table of {team} UAVs"
    raise ConfigError(
        f"no folder can be shared by the processes; needed are {need if table else 'sockets'} "
        f"({'; '.join(wrong)}): make room in one of them, or set TMPDIR to a folder that has it, with a short path"
    )


@contextmanager
def made(config: Config) -> Iterator[Scratch]:
    """Yield a scratch folder that is removed at the end of the block. Raises ConfigError."""
    scratch = make(config)
    try:
        yield scratch
    finally:
        scratch.close()


def places() -> list[Path]:
    """Return the places for scratch folders, the best first."""
    found = [MEMORY]
    with suppress(OSError):  # no folder for temporary files is writable
        found.append(Path(tempfile.gettempdir()))
    return [*dict.fromkeys([*found, *ELSEWHERE])]


def _made(place: Path, table: tuple[int, int] | None) -> Scratch:
    """Make a folder in `place`, and try all that a mission does there. Raises OSError, and leaves no folder then."""
    folder = Path(tempfile.mkdtemp(prefix=NAME, dir=place))
    try:
        held = (folder / ".new").open("wb")
        scratch = Scratch(folder, held)
        try:
            fcntl.flock(held, fcntl.LOCK_EX)
            (folder / ".new").rename(folder / HELD)
            _try_socket(scratch)
            if table is not None:
                create_table(scratch.tracks, *table)
        except BaseException:
            held.close()
            raise
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return scratch


def _try_socket(scratch: Scratch) -> None:
    path = f"{scratch.folder}/sync{LEARNER_SUFFIX}"
    if not path.isprintable():
        raise OSError(0, "its path holds a character that a socket's may not")
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        most = MAX_PATH_BYTES - len(os.fsencode(path)) + len(os.fsencode(scratch.folder.parent))
        raise OSError(0, f"its path is longer than {most} bytes, too long for sockets in it")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.bind(path)
    Path(path).unlink()


def _reason(place: Path, error: OSError) -> str:
    """Return why a place cannot be used, with its free bytes if they are known."""
    try:
        free = f", {shutil.disk_usage(place).free:,} bytes free"
    except OSError:
        free = ""
    return f"{error.strerror or error}{free}"


def _remove_old(place: Path) -> None:
    for old in place.glob(f"{NAME}*/{HELD}"):
        with suppress(OSError), old.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(old.parent)

"""The folder that a mission's processes share: their sockets, and the track table, in memory where there is room."""

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
"""How the names of these folders begin, and the file in each that is locked while its supervisor incarnations."""
MEMORY = Path("/dev/shm")
"""Memory-backed: the track table must not wait for a disk."""
ELSEWHERE = (Path("/tmp"), Path("/var/tmp"))


@dataclass(frozen=True)
class Scratch:
    """A folder of its own; `held` is locked for as long as it is open. `tracks` is there unless `table` was False."""

    folder: Path
    held: IO[bytes]

    @property
    def endpoint(self) -> str:
        """Where the TMC listens for UAVs."""
        return f"ipc://{self.folder}/sync"

    @property
    def tracks(self) -> Path:
        """The track table."""
        return self.folder / "tracks"

    def close(self) -> None:
        """Remove it."""
        with suppress(OSError):
            shutil.rmtree(self.folder)
        self.held.close()


def make(config: Config, *, table: bool = True) -> Scratch:
    """A new folder, with room for the table; raises ConfigError when no folder of this machine has it.

    The folders of supervisors that were killed are removed: no process holds their files any more.
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
    """A folder like that of a mission, removed with the block; raises ConfigError."""
    scratch = make(config)
    try:
        yield scratch
    finally:
        scratch.close()


def places() -> list[Path]:
    """Where such a folder may lie, the best first."""
    found = [MEMORY]
    with suppress(OSError):  # no folder for temporary files can be written
        found.append(Path(tempfile.gettempdir()))
    return [*dict.fromkeys([*found, *ELSEWHERE])]


def _made(place: Path, table: tuple[int, int] | None) -> Scratch:
    """A folder in `place` where all that a mission does there was tried; nothing is left of one that raises OSError."""
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
    """Why a place will not do; with the free bytes, where it can tell."""
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

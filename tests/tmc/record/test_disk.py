"""Two writers, full disks and read-only folders: one sentence, and what was there stays as it was."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tmc.kernel.config import JournalConfig
from tmc.record import schemas
from tmc.record.errors import RecordError
from tmc.record.mcap.compact import compact_run
from tmc.record.mcap.recover import recover
from tmc.record.reader import Log, read
from tmc.record.writer import LogWriter

CHILD = """
import sys, time
from tmc.kernel.config import JournalConfig
from tmc.record import schemas
from tmc.record.writer import LogWriter
log = LogWriter(sys.argv[1], "tmc", JournalConfig(flush_interval=60), {}, resume=sys.argv[2] == "resume")
log.write("/tmc/sync", schemas.Sync(tick=7))
log.flush()
print("writing", flush=True)
sys.stdin.read()
"""


NOBODY = 65_534
"""A user who owns nothing."""


def names(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


@contextmanager
def another_writer(path: Path, how: str = "fresh") -> Iterator[subprocess.Popen[str]]:
    """A process that writes the log and waits; it is killed at the end."""
    command = [sys.executable, "-c", CHILD, str(path), how]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            assert child.stdout.readline() == "writing\n"
            yield child
        finally:
            child.send_signal(signal.SIGKILL)


@pytest.mark.parametrize("how", ["fresh", "resume"])
def test_a_second_writer_is_refused_while_the_first_lives(tmp_path: Path, how: str) -> None:
    path, active = tmp_path / "tmc.mcap", tmp_path / "tmc.mcap.active"
    if how == "resume":
        LogWriter(path, "tmc", JournalConfig(), {}).close()
    with another_writer(path, how):
        whole = active.read_bytes()
        for _ in range(2):
            with pytest.raises(RecordError, match=r"tmc\.mcap\.active is being written by another process: end that"):
                LogWriter(path, "tmc", JournalConfig(), {}, resume=True)
        with pytest.raises(RecordError, match=r"tmc\.mcap\.active exists already"):
            LogWriter(path, "tmc", JournalConfig(), {})
        for refused in (lambda: recover(active), lambda: compact_run(tmp_path)):
            with pytest.raises(RecordError, match="is being written by another process"):
                refused()
        assert active.read_bytes() == whole and names(tmp_path) == ["tmc.mcap.active"]
    with LogWriter(path, "tmc", JournalConfig(), {}, resume=True) as log:  # a kill lets go of it
        log.write("/tmc/sync", schemas.Sync(tick=8))
    assert [e.message.tick for e in read(path)] == [7, 8]


def test_two_that_resume_at_once_do_not_both_get_it(tmp_path: Path) -> None:
    path = tmp_path / "tmc.mcap"
    LogWriter(path, "tmc", JournalConfig(), {}).close()
    command = [sys.executable, "-c", CHILD, str(path), "resume"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    children = [subprocess.Popen(command, text=True, **pipes) for _ in range(3)]
    said = []
    for child in children:
        assert child.stdout is not None
        said.append(child.stdout.readline())
    for child in children:
        child.kill()
        child.communicate()
    assert sorted(said) == ["", "", "writing\n"]
    assert [e.message.tick for e in Log(f"{path}.active").entries()] == [7]


@contextmanager
def unwritable(folder: Path) -> Iterator[None]:
    """The folder is read-only; root gives up its rights for a while, since it may write everywhere."""
    folder.chmod(0o555)
    root = os.geteuid() == 0
    try:
        if root:
            os.seteuid(NOBODY)
        yield
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(0o755)


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that all users may read, and new files in it: pytest's own are closed to all but its user."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        folder = Path(name) / "run"
        folder.mkdir(0o755)
        folder.chmod(0o755)
        if os.geteuid() == 0 and not another_user_may_enter(folder):
            pytest.skip(f"root cannot be another user here that may enter {folder}: choose another TMPDIR")
        before = os.umask(0o022)
        yield folder
        os.umask(before)


def another_user_may_enter(folder: Path) -> bool:
    try:
        os.seteuid(NOBODY)
    except OSError:  # this user is not one of the container's
        return False
    try:
        return os.access(folder, os.R_OK | os.X_OK, effective_ids=True)
    finally:
        os.seteuid(0)


def test_a_read_only_folder_is_said_and_keeps_its_logs(shared: Path) -> None:
    log = LogWriter(shared / "tmc.mcap", "tmc", JournalConfig(), {})
    log.write("/tmc/sync", schemas.Sync(tick=1))
    log.flush()
    log._give_up()
    whole = log.active.read_bytes()
    with unwritable(shared):
        for refused in (
            lambda: LogWriter(shared / "learner.mcap", "learner", JournalConfig(), {}),
            lambda: LogWriter(shared / "tmc.mcap", "tmc", JournalConfig(), {}, resume=True),
            lambda: recover(log.active),
            lambda: compact_run(shared),
        ):
            with pytest.raises(RecordError, match=r"cannot be written \(Permission denied\): make its folder exist"):
                refused()
        assert [e.message.tick for e in read(log.active)] == [1]
    assert names(shared) == ["tmc.mcap.active"] and log.active.read_bytes() == whole


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB, where we may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(folder)]
    may = os.geteuid() == 0 and shutil.which("mount") is not None
    if not may or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_disk_that_is_full(small_disk: Path) -> None:
    log = LogWriter(small_disk / "tmc.mcap", "tmc", JournalConfig(chunk=4096, flush_interval=60.0), {})
    with pytest.raises(RecordError, match="is full: free some space and resume; what was flushed stays readable"):
        for n in range(100_000):
            log.write("/learner/policy", schemas.Policy(version=n, model=os.urandom(1000)))
    found = [e.message.version for e in read(log.active)]
    assert found == list(range(len(found))) and len(found) > 100
    whole = log.active.read_bytes()
    with pytest.raises(RecordError, match=r"the disk that holds .* is full: free some space, and try again"):
        recover(log.active)
    assert names(small_disk) == ["tmc.mcap.active"] and log.active.read_bytes() == whole

"""Real logs for the readers: missions that ended in order, in one of which a UAV was lost, and one killed in flight."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from tests.command import PATIENCE_S, descendants, here, line_of_trial, overfly
from tmc.kernel.config import JournalConfig
from tmc.record.channels import ACTIVE
from tmc.record.errors import RecordError
from tmc.record.reader import info
from tmc.record.writer import LogWriter

FLOWN = ("fly", "planner:greedy", "--actors", "2", "--ticks", "60", "--no-pictures")
# Slow enough to be still in flight when all have written.
KILLED = ("run", "quick", "--actors", "2", "--set", "replay.learn_start=60",
          "--set", "dqn.batch_size=16", "--set", "journal.flush_interval=0.1")  # fmt: skip
LOSING = ("fly", "planner:greedy", "--actors", "2", "--ticks", "60", "--no-pictures",
          "--set", "comms.silence_warning=0.5", "--set", "comms.lost_after=1",
          "--set", "journal.flush_interval=0.1")  # fmt: skip
CHUNK = 0x06
"""The opcode of a chunk of messages."""
MADE = {
    "merged/flown.mcap": ("merge", "flown"),
    "merged/trained.mcap": ("merge", "trained", "--prefix", "A"),
    "merged/killed.mcap": ("merge", "killed"),
    "replay/flown.mcap": ("replay", "flown"),
    "replay/trained.mcap": ("replay", "trained", "--episode", "2"),
    "replay/losing.mcap": ("replay", "losing"),
}
"""Files for viewers, and what makes them."""
WRITERS = ("tmc", "learner", "uav-000", "uav-001")


def make(folder: Path, trained: Path) -> None:
    """Fly the rest: finished logs are `*/*.mcap`; `killed` and `cut` have `*.mcap.active`, as a kill leaves them."""
    shutil.copytree(trained, folder / "trained")
    done = overfly(*FLOWN, "--out", folder / "flown", cwd=folder)
    assert done.returncode == 0, done.stderr
    lose_one(folder / "losing")
    done = here(*FLOWN, "--lockstep", "--out", folder / "lockstep", cwd=folder)
    assert done.returncode == 0, done.stderr
    shutil.copytree(folder / "trained", folder / "compacted")
    done = here("log", "compact", folder / "compacted", cwd=folder)
    assert done.returncode == 0, done.stderr
    kill_in_flight(folder / "killed")
    cut(folder / "killed" / f"tmc.mcap{ACTIVE}", folder / "cut")
    for left in (folder / "killed", folder / "cut"):
        resume(left, folder / f"resumed-{left.name}")
        recover(left, folder / f"recovered-{left.name}")
    for file, (view, run, *more) in MADE.items():
        done = here("log", view, folder / run, "--out", folder / file, *more, cwd=folder)
        assert done.returncode == 0, done.stderr


def cut(log: Path, folder: Path) -> None:
    """A copy of the log as if the kill had torn the chunk that was being written.

    In the chunk itself: of one that is whole but not yet indexed, each reader makes what it likes.
    """
    folder.mkdir()
    whole = log.read_bytes()
    chunks = [(start, length) for kind, start, length in _records(whole) if kind == CHUNK]
    start, length = next((chunk for chunk in chunks if sum(chunk) > len(whole) * 3 // 4), chunks[-1])
    (folder / log.name).write_bytes(whole[: start + length // 2])


def _records(log: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, where its content starts, length) of each whole record: behind the magic, an opcode and a u64."""
    at = 8
    while at + 9 <= len(log):
        length = int.from_bytes(log[at + 1 : at + 9], "little")
        if at + 9 + length <= len(log):
            yield log[at], at + 9, length
        at += 9 + length


def resume(left: Path, folder: Path) -> None:
    """Recover logs as restarted processes do that write no more messages."""
    for active in _copies(left, folder):
        path = active.with_name(active.name.removesuffix(ACTIVE))
        LogWriter(path, path.stem, JournalConfig(), {}, resume=True).close()


def recover(left: Path, folder: Path) -> None:
    """Recover logs as a user does; exit code 3 means that data are lost."""
    _copies(left, folder)
    done = here("log", "recover", folder, "--in-place", cwd=folder)
    assert done.returncode in (0, 3), done.stderr


def _copies(left: Path, folder: Path) -> list[Path]:
    folder.mkdir()
    return [Path(shutil.copy(path, folder)) for path in sorted(left.glob(f"*{ACTIVE}"))]


def lose_one(out: Path) -> None:
    """Fly a mission in which one of two UAVs is silent for so long that the other flies on without it."""
    with subprocess.Popen([*line_of_trial(stall=0.06), *LOSING, "--out", str(out)], stdout=subprocess.DEVNULL) as run:
        _await_messages(run, [out / f"{name}.mcap{ACTIVE}" for name in ("tmc", "uav-001")])
        (silent,) = (
            p for p in descendants(run.pid) if b"actors --id 1 " in (Path("/proc") / str(p) / "cmdline").read_bytes()
        )
        os.kill(silent, signal.SIGSTOP)
        _await(run, lambda: "/tmc/lost" in info(out / f"tmc.mcap{ACTIVE}").topics)
        os.kill(silent, signal.SIGCONT)
        assert run.wait(PATIENCE_S) == 0


def kill_in_flight(out: Path) -> None:
    """Kill supervisor, TMC, learner and UAVs once each of them has a message in its log."""
    with subprocess.Popen([*line_of_trial(stall=0.01), *KILLED, "--out", str(out)], stderr=subprocess.DEVNULL) as run:
        try:
            _await_messages(run, [out / f"{name}.mcap{ACTIVE}" for name in WRITERS])
            time.sleep(0.5)
        finally:
            family = [run.pid, *descendants(run.pid)]  # the supervisor first, since it would restart the others
            for process in family:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
    assert len(family) >= 1 + len(WRITERS)
    while any(map(_alive, family)):
        time.sleep(0.02)


def _await_messages(run: subprocess.Popen[bytes], logs: list[Path]) -> None:
    _await(run, lambda: all(map(_has_messages, logs)))


def _await(run: subprocess.Popen[bytes], what: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not what():
        assert run.poll() is None and time.monotonic() < until, "it did not come to it while the mission flew"
        time.sleep(0.1)


def _has_messages(log: Path) -> bool:
    try:
        return bool(info(log).topics)
    except RecordError:  # not there yet, or empty
        return False


def _alive(process: int) -> bool:
    """A process that was killed and not yet waited for by its parent has no command line any more."""
    try:
        return bool((Path("/proc") / str(process) / "cmdline").read_bytes())
    except OSError:
        return False

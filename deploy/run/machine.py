"""Checks, before any process starts, that the system allows what a mission needs. Raises soft limits where it may.

The figures are low: with less, the mission cannot fly.
"""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from actors.planners import PREFIX
from actors.tracks import table_bytes
from tmc.kernel.config import Config, ConfigError

MIB = 2**20
CGROUPS, OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
FILES, THREADS, MEMORY, ADDRESSES, SIZE, DISK = "files", "threads", "memory", "addresses", "size", "disk"
BYTES = {MEMORY, ADDRESSES, SIZE, DISK}
LOG_BYTES, STEP_BYTES = 16_384, 3
"""Least size of the TMC's log, at its start and per UAV step; most flights leave several times as much."""
HORIZON_TICKS = 10_000_000
"""About a day of flight: later needs are not checked, since a training without an end is stopped some time."""
ROW_BYTES = 15
"""Bytes per transition of the replay memory, without the maps (`tmc.center.replay.Replay`)."""


@dataclass(frozen=True)
class Need:
    """What one limit must allow.

    `what`: its kind. `amount`: the least. `words`: a phrase with a place for the amount. `fix`: how to get more.
    """

    what: str
    amount: int
    words: str
    fix: str

    def missed(self, uavs: int, allowed: int) -> str:
        """Return the sentence for a system that allows less."""
        need, have = (_bytes(n) if self.what in BYTES else f"{n:,}" for n in (self.amount, allowed))
        team = f"{uavs:,} UAV" + ("" if uavs == 1 else "s")
        verb = "needs" if uavs == 1 else "need"
        return f"{team} {verb} at least {self.words.format(need)}, and {have} can be had: {self.fix}, or fly fewer UAVs"


def _bytes(size: int) -> str:
    return f"{size / MIB:,.0f} MiB" if size >= 10 * MIB else f"{size / 1024:,.0f} KiB"


def require(config: Config, *, learns: bool, alone: bool = False, out: Path = Path()) -> None:
    """Raise soft limits that are too low. Raises ConfigError if that does not suffice.

    `learns`: the mission has a learner. `alone`: only the TMC runs here. `out`: a folder on the disk of the run.
    """
    for need in needs(config, learns=learns, alone=alone):
        allowed = ALLOWED[need.what](need, out)
        if allowed is not None and allowed < need.amount:
            raise ConfigError(need.missed(config.team.size, allowed))


def needs(config: Config, *, learns: bool, alone: bool = False) -> Iterator[Need]:
    """Yield every need of a mission."""
    n, steps = config.team.size, config.team.size * min(config.training.ticks * config.training.episodes, HORIZON_TICKS)
    planner = config.team.controller.startswith(PREFIX)
    replay = ROW_BYTES * min(config.replay.capacity, steps) if learns else 0
    log = LOG_BYTES + STEP_BYTES * steps
    table = 0 if alone else table_bytes(n, config.training.ticks)
    files = n + 32  # one connection per UAV, and the TMC's own files
    yield Need(FILES, files, "{} open files in the TMC", f"run `ulimit -n {_round(files)}` first")
    yield Need(SIZE, max(log, table), "files of {}", "run `ulimit -f unlimited` first")
    yield Need(DISK, log, "{} of disk for their logs", "free some space, choose another --out")
    threads = 3 * n + (16 if learns else 9)
    team = (100 + (8 if planner else 15) * n + (120 if learns else 0)) * MIB
    if alone:
        most, team = 250, 40 * MIB
    else:
        yield Need(THREADS, threads, "{} processes and threads", "raise `ulimit -u` or the container's limit")
        most = 600 if learns else 250 if planner else 400
    yield Need(MEMORY, team + replay, "{} of memory", "lower replay.capacity" if replay else "use a larger machine")
    yield Need(ADDRESSES, most * MIB + replay, "{} of address space in a process", "run `ulimit -v unlimited` first")


def _round(amount: int) -> int:
    """Return a power of two with room for other files."""
    return int(max(1024, 2 ** (2 * amount - 1).bit_length()))


def _files(need: Need, _: Path) -> int | None:
    return raised(resource.RLIMIT_NOFILE, 2 * need.amount, need.amount)


def _threads(need: Need, _: Path) -> int | None:
    """Return how many more threads this user and this container may have."""
    left = [most - used for most, used in cgroup_limits("pids", "pids.max", "pids.current")]
    if os.geteuid() != 0:  # root has no limit
        used = threads_of_user()
        most = raised(resource.RLIMIT_NPROC, used + 2 * need.amount, used + need.amount)
        left += [] if most is None else [max(0, most - used)]
    return min(left, default=None)


def _memory(_: Need, __: Path) -> int | None:
    """Return the bytes of all memory of the machine, or of the container."""
    most = [limit for limit, _ in cgroup_limits("memory", "memory.max", "memory.current")]
    most += [limit for limit, _ in cgroup_limits("memory", "memory.limit_in_bytes", "memory.usage_in_bytes")]
    with suppress(OSError, ValueError):
        lines = [line.split() for line in Path("/proc/meminfo").read_text("utf-8").splitlines()]
        sizes = {line[0]: int(line[1]) * 1024 for line in lines if len(line) > 1}
        most.append(sizes["MemTotal:"] + sizes.get("SwapTotal:", 0))
    return min(most, default=None)


def _addresses(need: Need, _: Path) -> int | None:
    return raised(resource.RLIMIT_AS, resource.RLIM_INFINITY, need.amount)


def _size(need: Need, _: Path) -> int | None:
    return raised(resource.RLIMIT_FSIZE, resource.RLIM_INFINITY, need.amount)


def _disk(_: Need, out: Path) -> int | None:
    """Return the free bytes of the disk of a run folder, by the nearest folder that exists."""
    for folder in (out, *out.absolute().parents):
        with suppress(OSError):
            return shutil.disk_usage(folder).free
    return None


ALLOWED = {FILES: _files, THREADS: _threads, MEMORY: _memory, ADDRESSES: _addresses, SIZE: _size, DISK: _disk}
"""By kind: a function that returns how much the system allows, None if there is no limit."""


def raised(kind: int, wish: int, need: int) -> int | None:
    """Raise a soft limit below `need` towards `wish`; return the new limit, None if there is none."""
    soft, hard = resource.getrlimit(kind)
    if soft != resource.RLIM_INFINITY and soft < need:
        aim = hard if wish == resource.RLIM_INFINITY else wish if hard == resource.RLIM_INFINITY else min(wish, hard)
        with suppress(OSError, ValueError):
            resource.setrlimit(kind, (aim, hard))
        soft = resource.getrlimit(kind)[0]
    return None if soft == resource.RLIM_INFINITY else soft


def threads_of_user() -> int:
    """Count the threads of all processes of this user, as RLIMIT_NPROC does."""
    count = 0
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, KeyError):
            lines = (line.split() for line in (folder / "status").read_text("utf-8", "replace").splitlines())
            facts = {line[0]: line[1] for line in lines if len(line) > 1}
            count += int(facts["Threads:"]) if int(facts["Uid:"]) == os.getuid() else 0
    return count


def cgroup_limits(controller: str, limit: str, usage: str) -> Iterator[tuple[int, int]]:
    """Yield (limit, use) of the control groups of this process that have a limit, from its own upwards."""
    with suppress(OSError, ValueError):
        for line in OWN_CGROUP.read_text("utf-8").splitlines():
            _, kinds, path = line.split(":", 2)
            if kinds not in {"", controller}:
                continue
            top = CGROUPS / kinds
            own = top / path.lstrip("/")
            for folder in (own, *own.parents):
                with suppress(OSError, ValueError):
                    yield int((folder / limit).read_text("utf-8")), int((folder / usage).read_text("utf-8"))
                if folder == top:
                    break

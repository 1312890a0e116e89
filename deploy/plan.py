"""Which processes a mission has, and how each is started: one table, made once, read by the supervisor."""

from __future__ import annotations

import fcntl
import os
import shutil
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import deploy
from actors.planners import PREFIX
from tmc.kernel.config import Config

SCRATCH, HELD = "overfly-", "held"
"""How the names of the folders begin that the processes of a mission share, and the file in each."""
ROOT = Path(deploy.__file__).resolve().parent.parent
"""The folder that holds the four packages."""


@dataclass(frozen=True)
class Child:
    """One process: its name, its command, whether it may be started again, and whether its end ends the mission.

    `fork_of`: the package whose forkserver starts it; `command` then holds the arguments of `python -m PACKAGE` alone.
    """

    name: str
    command: tuple[str, ...]
    restart: bool
    leads: bool = False
    fork_of: str = ""


@dataclass(frozen=True)
class Plan:
    """The processes of a mission on this machine, and what they share.

    `preload`: what the forkserver of a package imports besides its `__main__`. `held`: a file in `scratch`, locked
    for as long as it is open.
    """

    children: tuple[Child, ...]
    endpoint: str
    tracks: Path
    scratch: Path
    preload: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    held: IO[bytes] | None = None


def make(config: Config, out: Path, *, policy: Path | None, table: bool = True) -> Plan:
    """TMC, N UAVs and, unless a fixed policy or a planner flies, the learner; sockets lie in a folder of their own.

    `table`: the UAVs share a table of tracks; otherwise they tell each other by beacon.
    """
    scratch, held = _new_scratch()
    endpoint, tracks = f"ipc://{scratch}/sync", scratch / "tracks"
    flies_fixed = policy is not None or config.team.pilot != "policy"
    tmc = [sys.executable, "-P", "-m", "tmc"]  # -P: the user's folder may hold packages of the same names
    tmc += ["--config", str(out / "config.json"), "--bind", endpoint, "--resume"]
    tmc += ["--parent", str(os.getpid()), "--out", str(out)]
    tmc += ["--tracks", str(tracks)] if table else []
    tmc += ["--policy", str(policy)] if policy else []
    children = [Child("tmc", tuple(tmc), restart=True, leads=True)]
    common = ("--connect", endpoint, "--out", str(out))
    if not flies_fixed:
        children.append(Child("learner", common, restart=True, fork_of="learner"))
    for i in range(config.team.size):
        children.append(Child(f"uav-{i:03d}", ("--id", str(i), *common), restart=True, fork_of="actors"))
    # A planner flies without ONNX Runtime, 16 MB of memory that nobody would use.
    preload = {} if config.team.pilot.startswith(PREFIX) else {"actors": ("actors.policy",)}
    return Plan(tuple(children), endpoint, tracks, scratch, preload, held)


def _new_scratch() -> tuple[Path, IO[bytes]]:
    """A folder for what the processes share, and the file in it that is held while its supervisor lives.

    The folders of supervisors that were killed are removed: nobody holds their files any more.
    """
    for old in Path(_short_folder() or tempfile.gettempdir()).glob(f"{SCRATCH}*/{HELD}"):
        with suppress(OSError), old.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(old.parent)
    scratch = Path(tempfile.mkdtemp(prefix=SCRATCH, dir=_short_folder()))
    held = (scratch / ".new").open("wb")
    fcntl.flock(held, fcntl.LOCK_EX)
    (scratch / ".new").rename(scratch / HELD)
    return scratch, held


def _short_folder() -> str | None:
    """Memory-backed where there is such a folder: the track table must not wait for a disk."""
    shm = Path("/dev/shm")
    return str(shm) if shm.is_dir() and os.access(shm, os.W_OK) else None


# TMC and learner free and take the same large blocks for every minibatch: keep them instead of returning them to the
# system (an update of the paper's network then has no page faults instead of 1,650).
KEEP_MEMORY = {"MALLOC_TRIM_THRESHOLD_": str(2**29), "MALLOC_MMAP_THRESHOLD_": str(2**29)}


def environment(name: str, threads: int) -> dict[str, str]:
    """A child's environment: it finds our packages, and does not start more threads than it is given."""
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH", "")) if p)
    counts = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    counts["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's: no use for more, and it would start them before the fork
    return os.environ | counts | {"PYTHONPATH": path} | (KEEP_MEMORY if name in ("tmc", "learner") else {})

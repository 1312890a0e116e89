"""Which processes a mission has, and how each is started: one table, made once, read by the supervisor."""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import deploy
from actors.planners import PREFIX
from tmc.kernel.config import Config

ROOT = Path(deploy.__file__).resolve().parent.parent
"""The folder that holds the four packages."""


@dataclass(frozen=True)
class Child:
    """One process: its name, its command, whether it may be started again, and whether its end ends the mission.

    `forked`: the forkserver starts it, and `command` holds the arguments of `python -m actors` alone.
    """

    name: str
    command: tuple[str, ...]
    restart: bool
    leads: bool = False
    forked: bool = False


@dataclass(frozen=True)
class Plan:
    """The processes of a mission on this machine, and what they share. `preload`: what all UAVs import."""

    children: tuple[Child, ...]
    endpoint: str
    tracks: Path
    scratch: Path
    preload: tuple[str, ...] = ()


def make(config: Config, out: Path, *, policy: Path | None, table: bool = True) -> Plan:
    """TMC, N UAVs and, unless a fixed policy or a planner flies, the learner; sockets lie in a folder of their own.

    `table`: the UAVs share a table of tracks; otherwise they tell each other by beacon.
    """
    scratch = Path(tempfile.mkdtemp(prefix="overfly-", dir=_short_folder()))
    endpoint, tracks = f"ipc://{scratch}/sync", scratch / "tracks"
    flies_fixed = policy is not None or config.team.pilot != "policy"
    common = ("--parent", str(os.getpid()), "--out", str(out))
    tmc = [*_module("tmc"), "--config", str(out / "config.json"), "--bind", endpoint, "--resume", *common]
    tmc += ["--tracks", str(tracks)] if table else []
    tmc += ["--policy", str(policy)] if policy else []
    children = [Child("tmc", tuple(tmc), restart=True, leads=True)]
    if not flies_fixed:
        children.append(Child("learner", (*_module("learner"), "--connect", endpoint, *common), restart=True))
    for i in range(config.team.size):
        command = ("--id", str(i), "--connect", endpoint, "--out", str(out))
        children.append(Child(f"uav-{i:03d}", command, restart=True, forked=True))
    # A planner flies without ONNX Runtime, 16 MB of memory that nobody would use.
    preload = () if config.team.pilot.startswith(PREFIX) else ("actors.policy",)
    return Plan(tuple(children), endpoint, tracks, scratch, preload)


def _module(name: str) -> tuple[str, ...]:
    # -P: the folder that the user stands in may hold packages of the same names.
    return (sys.executable, "-P", "-m", name)


def _short_folder() -> str | None:
    """Memory-backed where there is such a folder: the track table must not wait for a disk."""
    shm = Path("/dev/shm")
    return str(shm) if shm.is_dir() and os.access(shm, os.W_OK) else None


# The learner frees and takes the same large blocks in every update: keep them instead of returning them to the system
# (an update of the paper's network then has no page faults instead of 1,650).
KEEP_MEMORY = {"MALLOC_TRIM_THRESHOLD_": str(2**29), "MALLOC_MMAP_THRESHOLD_": str(2**29)}


def environment(name: str, threads: int) -> dict[str, str]:
    """A child's environment: it finds our packages, and does not start more threads than it is given."""
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH", "")) if p)
    counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    return os.environ | counts | {"PYTHONPATH": path} | (KEEP_MEMORY if name == "learner" else {})

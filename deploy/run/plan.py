"""Lists the processes of a mission, and how each is started: one table, made once, read by the supervisor."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import deploy
from actors.planners import PREFIX
from deploy.run import machine, scratch
from tmc.kernel.config import Config
from tmc.record.run_folder import RunFolder

ROOT = Path(deploy.__file__).resolve().parent.parent
"""The folder that holds overfly.py and the four packages."""


@dataclass(frozen=True)
class Child:
    """One process. `restart`: it may be restarted. `leads`: its end ends the mission.

    `fork_of`: the package whose forkserver starts it; `command` then holds only the arguments of `python -m PACKAGE`.
    """

    name: str
    command: tuple[str, ...]
    restart: bool
    leads: bool = False
    fork_of: str = ""


@dataclass(frozen=True)
class Plan:
    """The processes of a mission on this machine, and what they share.

    `preload`: by package, the modules that its forkserver imports besides its `__main__`. `held`: a file in `scratch`
    that is locked while it is open.
    """

    children: tuple[Child, ...]
    endpoint: str
    tracks: Path
    scratch: Path
    preload: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    held: IO[bytes] | None = None


def make(config: Config, out: Path, *, policy: Path | None, table: bool = True) -> Plan:
    """Plan the TMC, N UAVs and, unless a fixed policy or a planner flies, the learner, with sockets in a new folder.

    `table`: the UAVs share a track table; otherwise they send beacons. Paths are absolute, and one word with their
    option, since a name may start with a dash. Raises ConfigError if this machine lacks what the mission needs.
    """
    learns = policy is None and config.team.controller == "policy"
    machine.require(config, learns=learns, out=out)
    out, shared = out.absolute(), scratch.make(config, table=table)
    tmc = [sys.executable, "-P", "-m", "tmc"]  # -P: the user's folder may hold packages of the same names
    tmc += [f"--config={RunFolder(out).config}", "--bind", shared.endpoint, "--resume"]
    tmc += ["--parent", str(os.getpid()), f"--out={out}"]
    tmc += [f"--tracks={shared.tracks}"] if table else []
    tmc += [f"--policy={policy.absolute()}"] if policy else []
    children = [Child("tmc", tuple(tmc), restart=True, leads=True)]
    common = ("--connect", shared.endpoint, f"--out={out}")
    if learns:
        children.append(Child("learner", common, restart=True, fork_of="learner"))
    for i in range(config.team.size):
        children.append(Child(f"uav-{i:03d}", ("--id", str(i), *common), restart=True, fork_of="actors"))
    # A planner flies without ONNX Runtime, which would take 16 MB.
    preload = {} if config.team.controller.startswith(PREFIX) else {"actors": ("actors.policy",)}
    return Plan(tuple(children), shared.endpoint, shared.tracks, shared.folder, preload, shared.held)


def check_machine(config: Config, *, learns: bool, out: Path | None) -> None:
    """Raise ConfigError if this machine lacks what a mission needs, before any file is written."""
    machine.require(config, learns=learns, out=out or Path())
    with scratch.made(config):
        pass


# TMC and learner free and allocate the same large blocks for every minibatch. Keep them instead of returning them to
# the system: an update of the paper's network then has no page faults instead of 1,650.
KEEP_MEMORY = {"MALLOC_TRIM_THRESHOLD_": str(2**29), "MALLOC_MMAP_THRESHOLD_": str(2**29)}


def environment(name: str, threads: int) -> dict[str, str]:
    """Return a child's environment: it finds Overfly's packages, and starts no more than `threads` threads."""
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH", "")) if p)
    counts = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    counts["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's: it needs no more, and would start them before the fork
    return os.environ | counts | {"PYTHONPATH": path} | (KEEP_MEMORY if name in ("tmc", "learner") else {})

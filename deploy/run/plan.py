"""Which processes a mission has, and how each is started: one table, made once, read by the supervisor."""

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

ROOT = Path(deploy.__file__).resolve().parent.parent
"""The folder that holds overfly.py and the four packages."""


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

    `table`: the UAVs share a table of tracks; otherwise they tell each other by beacon. Paths are handed on whole, and
    as one word with their option, since a name may begin with a dash. Raises ConfigError where this machine lacks what
    the mission needs.
    """
    learns = policy is None and config.team.controller == "policy"
    machine.require(config, learns=learns, out=out)
    out, shared = out.absolute(), scratch.make(config, table=table)
    tmc = [sys.executable, "-P", "-m", "tmc"]  # -P: the user's folder may hold packages of the same names
    tmc += [f"--config={out / 'config.json'}", "--bind", shared.endpoint, "--resume"]
    tmc += ["--parent", str(os.getpid()), f"--out={out}"]
    tmc += [f"--tracks={shared.tracks}"] if table else []
    tmc += [f"--policy={policy.absolute()}"] if policy else []
    children = [Child("tmc", tuple(tmc), restart=True, leads=True)]
    common = ("--connect", shared.endpoint, f"--out={out}")
    if learns:
        children.append(Child("learner", common, restart=True, fork_of="learner"))
    for i in range(config.team.size):
        children.append(Child(f"uav-{i:03d}", ("--id", str(i), *common), restart=True, fork_of="actors"))
    # A planner flies without ONNX Runtime, 16 MB of memory that nobody would use.
    preload = {} if config.team.controller.startswith(PREFIX) else {"actors": ("actors.policy",)}
    return Plan(tuple(children), shared.endpoint, shared.tracks, shared.folder, preload, shared.held)


def check_machine(config: Config, *, learns: bool, out: Path | None) -> None:
    """Raise ConfigError where this machine lacks what a mission needs, before anything of it is written."""
    machine.require(config, learns=learns, out=out or Path())
    with scratch.made(config):
        pass


# TMC and learner free and take the same large blocks for every minibatch: keep them instead of returning them to the
# system (an update of the paper's network then has no page faults instead of 1,650).
KEEP_MEMORY = {"MALLOC_TRIM_THRESHOLD_": str(2**29), "MALLOC_MMAP_THRESHOLD_": str(2**29)}


def environment(name: str, threads: int) -> dict[str, str]:
    """A child's environment: it finds our packages, and does not start more threads than it is given."""
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH", "")) if p)
    counts = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    counts["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's: no use for more, and it would start them before the fork
    return os.environ | counts | {"PYTHONPATH": path} | (KEEP_MEMORY if name in ("tmc", "learner") else {})

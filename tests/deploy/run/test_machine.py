"""Limits of the system are raised where possible, and otherwise named before any process starts."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deploy.run import lockstep, machine
from deploy.run.progress import Progress
from tests.command import LINE
from tmc.center.replay import Replay
from tmc.kernel.config import ConfigError, build
from tmc.kernel.observation import ObservationBuilder
from tmc.kernel.world import World

TEAM = build({"team.size": 30, "team.controller": "planner:greedy"})


def limited(limit: str, *words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a shell that has set a limit with `ulimit`."""
    line = ["sh", "-c", f'ulimit {limit} && exec "$@"', "sh", *map(str, words)]
    return subprocess.run(line, cwd=cwd, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    ("limit", "words", "sentence"),
    [
        ("-n 32", ("fly", "planner:greedy", "--actors", 30, "--out", "R"),
         "30 UAVs need at least 62 open files in the TMC, and 32 can be had: run `ulimit -n 1024` first"),
        ("-n 256", ("tmc", "--actors", 300, "--bind", "ipc://sync", "--out", "R"),
         "300 UAVs need at least 332 open files in the TMC, and 256 can be had: run `ulimit -n 1024` first"),
        ("-f 16", ("fly", "planner:greedy", "--actors", 2, "--out", "R"), "run `ulimit -f unlimited` first"),
    ],
)  # fmt: skip
def test_a_limit_that_is_too_low_is_named_before_anything_starts(
    limit: str, words: tuple[object, ...], sentence: str, tmp_path: Path
) -> None:
    done = limited(limit, *LINE, *words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not [*tmp_path.iterdir()]


def test_a_soft_limit_is_raised(tmp_path: Path) -> None:
    """UAVs, learner and TMC inherit it."""
    words = ("fly", "planner:greedy", "--actors", 3, "--ticks", 20, "--no-pictures", "--out", "R")
    done = limited("-Sn 24", *LINE, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert set(json.loads((tmp_path / "R" / "run.json").read_text())["exit_codes"].values()) == {0}


def test_limits_are_raised_no_further_than_they_may() -> None:
    code = """
import resource
from deploy.run.machine import raised
kind, hard = resource.RLIMIT_NOFILE, 100
resource.setrlimit(kind, (50, hard))
print(raised(kind, 80, 40), raised(kind, 80, 60), raised(kind, 200, 90), resource.getrlimit(kind) == (100, 100))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["50", "80", "100", "True"]


def test_the_limits_of_a_container_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of its own group and of the groups above it, in both versions of control groups."""
    for folder, name, value in (
        ("pids/pod/own", "pids.max", "max"), ("pids/pod", "pids.max", "200"), ("pids/pod", "pids.current", "150"),
        ("memory/pod/own", "memory.limit_in_bytes", str(50 * machine.MIB)),
        ("memory/pod/own", "memory.usage_in_bytes", "1"),
    ):  # fmt: skip
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / name).write_text(value + "\n")
    own = tmp_path / "own"
    own.write_text("9:pids:/pod/own\n4:memory:/pod/own\n1:name=systemd:/\n")
    monkeypatch.setattr(machine, "CGROUPS", tmp_path)
    monkeypatch.setattr(machine, "OWN_CGROUP", own)
    monkeypatch.setattr(machine.os, "geteuid", lambda: 0)
    assert [*machine.cgroup_limits("pids", "pids.max", "pids.current")] == [(200, 150)]
    with pytest.raises(ConfigError, match="need at least 99 processes and threads, and 50 can be had: raise"):
        machine.require(TEAM, learns=False, out=tmp_path)
    with pytest.raises(ConfigError, match=r"1 UAV needs at least .* of memory, and 50 MiB can be had"):
        machine.require(build({"team.size": 1}), learns=True, out=tmp_path)

    (tmp_path / "pod").mkdir()
    (tmp_path / "pod" / "pids.max").write_text("70\n")
    (tmp_path / "pod" / "pids.current").write_text("1\n")
    own.write_text("0::/pod\n")
    assert [*machine.cgroup_limits("pids", "pids.max", "pids.current")] == [(70, 1)]


def test_the_threads_that_a_user_has_already_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "OWN_CGROUP", tmp_path / "none")
    monkeypatch.setattr(machine.os, "geteuid", lambda: 1000)
    assert machine.threads_of_user() >= 1
    monkeypatch.setattr(machine, "threads_of_user", lambda: 950)
    monkeypatch.setattr(machine.resource, "getrlimit", lambda kind: (1000, 1000))
    need = next(n for n in machine.needs(TEAM, learns=False) if n.what == machine.THREADS)
    assert machine.ALLOWED[machine.THREADS](need, tmp_path) == 50


def test_the_needed_memory_is_less_than_the_replay_memory_takes() -> None:
    """So a mission that could fly is not refused."""
    config = build({"team.size": 3, "replay.capacity": 30_000, "replay.learn_start": 128})
    world = World(config)
    replay = Replay(world, ObservationBuilder(world))
    rings = [value.data for value in vars(replay).values() if isinstance(getattr(value, "data", None), np.ndarray)]
    assert sum(ring.nbytes for ring in rings) >= machine.ROW_BYTES * 30_000


@pytest.mark.parametrize("period", [1, 500])
def test_the_needed_disk_space_is_less_than_a_flight_leaves(period: int, tmp_path: Path) -> None:
    values = {"team.controller": "planner:random-road", "team.size": 5, "training.ticks": 2000, "training.episodes": 1}
    config = build({**values, "comms.period": period, "journal.commit_interval": 5.0, "journal.flush_interval": 5.0})
    lockstep.run(World(config), tmp_path, None, Progress(config, 1, 0.0))
    need = next(n for n in machine.needs(config, learns=False, alone=True) if n.what == machine.DISK)
    assert need.amount <= (tmp_path / "tmc.mcap").stat().st_size


def test_a_training_without_an_end_needs_the_space_of_a_day() -> None:
    endless, day = build({"training.episodes": 10_000_000}), build({"training.episodes": 10_000})
    assert [*machine.needs(endless, learns=True)] == [*machine.needs(day, learns=True)]


def test_no_limit_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.resource, "getrlimit", lambda kind: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    monkeypatch.setattr(machine, "OWN_CGROUP", tmp_path / "none")
    machine.require(TEAM, learns=False, out=tmp_path / "to" / "be" / "made")

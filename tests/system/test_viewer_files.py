"""Files for viewers, made from the logs of real processes: the same flight gives the same bytes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from tests.command import LINE, PATIENCE_S
from tmc.record.reader import Log, info
from tmc.record.run_folder import run_files

Overfly = Callable[..., subprocess.CompletedProcess[str]]
FLY = ("fly", "planner:greedy", "--actors", 2, "--ticks", 60, "--seed", 5, "--set", "comms.phase=staggered",
       "--no-pictures")  # fmt: skip


def test_a_team_of_processes_and_lock_step_give_the_same_replay_file(
    overfly: Overfly, here: Overfly, tmp_path: Path
) -> None:  # fmt: skip
    for name, fly, how in (("P", overfly, ()), ("L", here, ("--lockstep",))):
        flown = fly(*FLY, *how, "--out", name)
        assert flown.returncode == 0, flown.stderr
        made = here("log", "replay", name)
        assert made.returncode == 0, made.stderr
    for suffix in (".mcap", ".layout.json"):
        ours, theirs = (tmp_path / name / "replay" / f"episode-000001{suffix}" for name in ("P", "L"))
        assert ours.read_bytes() == theirs.read_bytes()
    merged = here("log", "merge", "P", "--prefix", "P/")
    assert merged.returncode == 0, merged.stderr
    assert set(run_files(tmp_path / "P")) == {"tmc", "uav-000", "uav-001"}  # a derived file does not count as a log
    times = [raw.log_time for raw in Log(tmp_path / "P" / "merged.mcap").raw()]
    assert all(a <= b for a, b in pairwise(times))
    sources: Counter[str] = Counter()
    for path in run_files(tmp_path / "P").values():
        sources.update({f"/P{topic}": found.count for topic, found in info(path).topics.items()})
    assert {topic: found.count for topic, found in info(tmp_path / "P" / "merged.mcap").topics.items()} == sources


def test_what_a_killed_mission_leaves_can_be_merged_and_replayed(here: Overfly, tmp_path: Path) -> None:
    command = [*LINE, "fly", "planner:greedy", "--actors", "2", "--out", "K",
               "--set", "journal.flush_interval=0.1", "--ticks", "60000"]  # fmt: skip
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as mission:
        log, end = tmp_path / "K" / "tmc.mcap.active", time.monotonic() + PATIENCE_S
        while not (log.is_file() and log.stat().st_size > 30_000) and time.monotonic() < end:
            time.sleep(0.05)
        os.kill(mission.pid, signal.SIGKILL)  # its children end with it
    made = here("log", "replay", "K")
    assert made.returncode == 0, made.stderr
    assert "was not flown to its end" in made.stderr
    replayed = Log(tmp_path / "K" / "replay" / "episode-000001.mcap")
    ticks = int(replayed.metadata()["ticks"])
    assert 50 < ticks < 60_000 and replayed.finished
    assert info(replayed.path).topics["/uav/1/belief"].count == ticks + 1
    merged = here("log", "merge", "K")
    assert merged.returncode == 0 and "tmc.mcap.active is still open" in merged.stderr
    intact = sum(t.count for path in run_files(tmp_path / "K").values() for t in info(path).topics.values())
    assert intact == sum(t.count for t in info(tmp_path / "K" / "merged.mcap").topics.values()) > 100


@pytest.mark.parametrize("view", ["merge", "replay"])
def test_help_says_what_it_makes(here: Overfly, view: str) -> None:
    said = here("log", view, "--help")
    assert said.returncode == 0 and "(default: RUN/" in said.stdout

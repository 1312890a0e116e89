"""Small runs of `overfly verify chaos`: no kill loses a record, unless the TMC acknowledges too early."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Overfly = Callable[..., subprocess.CompletedProcess[str]]
SHORT = ("--actors", "3", "--ticks", "400", "--json")
LIGHT = ("--actors", "2", "--ticks", "200", "--set", "dqn.batch_size=8", "--set", "replay.learn_start=16", "--json")


def schedule(overfly: Overfly, *options: str, code: int = 0) -> dict[str, Any]:
    """Run a trial; return its row. Its stderr must hold progress only."""
    done = overfly("verify", "chaos", *options)
    assert done.returncode == code, done.stdout + done.stderr
    assert done.stderr and all(line.startswith(("kill ", "mission-")) for line in done.stderr.splitlines())
    row: dict[str, Any] = json.loads(done.stdout)
    return row


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kills", "episodes", "options"),
    [(8, 4, ()), (3, 2, ("--scenario", "1")), (3, 2, ("--set", "comms.phase=staggered"))],
    ids=str,
)
def test_missions_under_faults_fly_what_lock_step_flies(
    overfly: Overfly, tmp_path: Path, kills: int, episodes: int, options: tuple[str, ...]
) -> None:
    row = schedule(overfly, "--mode", "fly", "--kills", str(kills), "--episodes", str(episodes), *SHORT, *options)
    assert row["violations"] == [] and row["folder"] == ""
    assert sum(row["kills"].values()) == kills and row["recovered"] == row["kills"]
    assert row["lost"] == row["doubled"] == 0 and row["acknowledged"] > 100
    assert row["episodes"] == episodes * row["missions"] and row["ticks"] == 400 * row["episodes"]
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_training_under_faults_resumes(overfly: Overfly) -> None:
    row = schedule(overfly, "--kills", "5", "--fault-seed", "20", *LIGHT)
    assert (
        row["violations"] == [] and set(row["kills"]) == {"tmc", "learner", "uav"} and row["recovered"] == row["kills"]
    )
    assert row["lost"] == row["doubled"] == 0 and row["updates"] > 0 and row["acknowledged"] > 0


@pytest.mark.slow
def test_power_cuts_take_nothing_that_was_acknowledged(overfly: Overfly) -> None:
    row = schedule(overfly, "--mode", "fly", "--power", "--kills", "5", "--fault-seed", "2", "--episodes", "4", *SHORT)
    assert row["violations"] == [] and row["kills"]["power"] >= 1 and row["recovered"] == row["kills"]
    assert row["lost"] == row["doubled"] == 0 and row["acknowledged"] > 100


@pytest.mark.slow
def test_power_cuts_take_what_was_acknowledged_without_the_disk(overfly: Overfly, tmp_path: Path) -> None:
    """The counter-check: a journal that only survives the end of its process."""
    options = (
        "--mode",
        "fly",
        "--power",
        "--set",
        "journal.durability=process",
        "--kills",
        "4",
        "--fault-seed",
        "2",
        *SHORT,
    )
    row = schedule(overfly, *options, "--episodes", "2", "--keep", str(tmp_path / "kept"), code=1)
    assert row["lost"] > 0 and row["bytes_cut"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("options", [("--mode", "fly", "--episodes", "2", *SHORT), LIGHT], ids=["fly", "train"])
def test_losses_are_seen_when_there_are_some(overfly: Overfly, tmp_path: Path, options: tuple[str, ...]) -> None:
    """The counter-check. The kept files show it too: the last commit is older than the last acknowledgement."""
    row = schedule(overfly, "--ack-early", "--kills", "12", *options, "--keep", str(tmp_path / "kept"), code=1)
    assert row["lost"] > 0 and any("were acknowledged and are lost" in violation for violation in row["violations"])
    assert row["folder"] == str(tmp_path / "kept") and "did not survive" in (tmp_path / "kept/history.txt").read_text()

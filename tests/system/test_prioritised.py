"""A training with `replay.priority_exponent`, as processes and in lock step: its log holds all but the TD errors."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deploy import settings
from deploy.run.lockstep import LockStep
from learner.trainer import start
from tmc.analysis.invariants.check import check
from tmc.center import recovery
from tmc.center.journal import Journal
from tmc.center.station import Station
from tmc.kernel.world import World
from tmc.record.reader import Log

SMALL = {
    "training.ticks": 60,
    "training.episodes": 3,
    "replay.learn_start": 60,
    "dqn.batch_size": 16,
    "replay.priority_exponent": 0.6,
}


def test_it_trains_as_processes_and_its_log_is_sound(
    overfly: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    out = tmp_path / "R"
    changes = [word for key, value in SMALL.items() for word in ("--set", f"{key}={value}")]
    done = overfly("run", "quick", *changes, "--no-pictures", "--out", out)
    assert done.returncode == 0, done.stderr
    assert check(out).good
    records = [e.message for e in Log(out / "tmc.mcap").entries() if e.topic.endswith("/record")]
    assert len(records) == 3 * 3 * 7 and all(len(r.values) == 2 * len(r.actions) for r in records)
    assert any(r.values for r in records)
    for name in ("tmc", "learner"):  # neither refused a message of the other
        said = [e.message.message for e in Log(out / f"{name}.mcap").entries(["/log"])]
        assert not [text for text in said if "rejected" in text or "error from the TMC" in text]


def test_the_learner_changes_priorities_and_the_journal_has_the_first_ones(tmp_path: Path) -> None:
    world = World(settings.config_for("quick", SMALL))
    journal = Journal(tmp_path, world, "run")
    flown = LockStep(world, None, journal.take, start(world.config, world.grid))
    flown.run()
    journal.writer.close()
    again = Station(world, "run", learning=True)
    recovery.recover(again, tmp_path / "tmc.mcap", 0.0)
    assert again.replay.digest() == flown.station.replay.digest()
    mine, first = flown.station.replay.priorities, again.replay.priorities
    assert mine is not None and first is not None and mine.added == first.added == 3 * 60 * 3
    numbers = np.arange(mine.added)
    changed = mine.mass(numbers) != first.mass(numbers)
    # A transition that was drawn has an error; some 150 minibatches of 16 were, so that few of 540 were never drawn.
    assert 300 < changed.sum() < mine.added
    assert len(np.unique(first.mass(numbers))) > 400

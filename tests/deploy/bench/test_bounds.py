"""A bench that would never end, or that the machine cannot hold, is refused before it starts."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from deploy.bench import bounds, cores, replay
from tests.command import here
from tmc.kernel.config import ConfigError, build
from tmc.kernel.world import World

ENDLESS = [
    ("memory --transitions 999999999", "--transitions 999,999,999 is more than the replay memory holds"),
    ("memory --set replay.updates_per_tick=0", "replay.updates_per_tick = 0 makes no update"),
    ("replay --minibatches 999999999999", "--minibatches 1e+12 would take"),
    ("learner --steps 999999999999", "--steps 1e+12 would take"),
    ("learner --seconds inf", "--seconds must be more than 0"),
    ("learner --seconds 1e300", "--seconds 1e+300 would take"),
    ("learner --seconds 1000 --repeats 1000", "--repeats 1,000 would take 35 days at least: choose 28 or less"),
    ("learner --set replay.updates_per_tick=1e-9 --set replay.learn_start=1", "updates would take"),
    ("train --repeats 999999999", "--repeats 1e+09 would take"),
    ("journal --seconds 1e9", "--seconds 1e+09 would take"),
    ("journal --pace inf", "--pace must be 0 or more"),
    ("journal --episodes 9999999 --ticks 60000", "UAV steps would take"),
    ("rollout --repeats 999999999", "--repeats 1e+09 would take"),
    ("rollout --ticks 60000 --episodes 9999999", "UAV steps would take"),
    ("startup --repeats 999999999", "--repeats 1e+09 would take"),
    ("startup --warm 999999999", "--warm 1e+09 would take"),
    ("actor --repeats 9999999", "UAV steps would take"),
]


@pytest.fixture(autouse=True)
def cores_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their worth takes a second of each call."""
    monkeypatch.setattr(cores, "worth", lambda: None)


@pytest.mark.parametrize(("line", "sentence"), ENDLESS, ids=[line for line, _ in ENDLESS])
def test_an_endless_bench_is_refused(line: str, sentence: str, tmp_path: Path) -> None:
    done = here("bench", *line.split(), cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert sentence in done.stderr and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("bench", ["memory --transitions 200", "replay", "learner", "train"])
def test_a_memory_that_the_machine_cannot_hold_is_refused(
    bench: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = {"SC_PHYS_PAGES": 1000, "SC_PAGE_SIZE": 1000}
    monkeypatch.setattr(bounds.os, "sysconf", lambda name: pages[name])
    done = here("bench", *bench.split(), "--set", "replay.capacity=100000", cwd=tmp_path)
    assert done.returncode == 2 and "this machine has 0 GB: choose less than 22,222" in done.stderr


def test_a_machine_holds_the_memory_of_the_paper() -> None:
    bounds.memory(World(build({})))


def test_a_pace_that_would_take_days_is_said_once_it_is_known() -> None:
    pace = bounds.Pace("--transitions", 10**9)
    pace.check(0, now=5.0)
    pace.check(100, now=14.0)  # too early to tell
    with pytest.raises(
        ConfigError, match=r"^--transitions 1,000,000,000 would take 3 years at the pace here, 10 per second"
    ):
        pace.check(100, now=15.0)
    pace = bounds.Pace("--transitions", 10**6)
    pace.check(0, now=0.0)
    pace.check(0, now=20.0)  # perhaps it only starts
    pace.check(1000, now=21.0)


def test_a_process_that_fails_while_it_is_measured_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the system takes its memory away."""
    monkeypatch.setattr(replay, "measure", lambda _: subprocess.run(["sh", "-c", "kill -9 $$"], check=True))
    done = here("bench", "replay", cwd=tmp_path)
    assert done.returncode == 1 and done.stderr == "overfly: a process that was measured was ended by SIGKILL\n"

"""Unusual names, folders that are removed, and clocks that jump, with real processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import LINE, here
from tmc.record.writer import LogWriter

PATIENCE_S = 100
FLY = ("fly", "planner:greedy", "--actors", "2", "--ticks", "40", "--no-pictures")
NAMES = {
    "a dash": b"-run1", "an option": b"--json", "a space and a letter": "my rün".encode(), "no UTF-8": b"caf\xe9\xff",
    "an escape sequence": b"\x1b[31mred\x1b[0m", "a newline": b"one\ntwo", "a mark of direction": "\u202eabc".encode(),
    "an equals sign": b"a=b", "markup": b"$\\frac$_{x}", "a quote": b"it's",
}  # fmt: skip


def overfly(cwd: Path, *args: object, timeout: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    line = [*LINE, *args]
    return subprocess.run(
        list(map(os.fsencode, map(str, line))), cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False
    )


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_run_folder_may_be_called_anything(name: bytes, tmp_path: Path) -> None:
    """A mission is flown in it, resumed, analyzed and checked; its name in messages cannot move the cursor."""
    out = os.fsdecode(name)
    try:
        (tmp_path / out).mkdir()
    except OSError:
        pytest.skip("no such name can be given here")
    flown = overfly(tmp_path, *FLY, f"--out={out}")
    assert flown.returncode == 0, flown.stderr
    assert set(json.loads((tmp_path / out / "run.json").read_text())["exit_codes"].values()) == {0}
    for command in (("analyze", "--no-pictures"), ("log", "check"), ("log", "info"), ("log", "compact")):
        done = here(*command, "--", out, cwd=tmp_path)
        assert done.returncode == 0, (command, done.stderr)
        flown.stdout += done.stdout + done.stderr
    assert all(line.isprintable() for line in flown.stdout.splitlines())
    assert "Traceback" not in flown.stdout + flown.stderr


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_map_may_be_called_anything(name: bytes, tmp_path: Path) -> None:
    try:
        (tmp_path / os.fsdecode(name)).write_text("######\n#.##.#\n######\n")
    except OSError:
        pytest.skip("no such name can be given here")
    flown = here(*FLY, "--lockstep", f"--map={os.fsdecode(name)}", "--out", "R", cwd=tmp_path)
    assert flown.returncode == 0, flown.stderr
    assert all(line.isprintable() for line in flown.stdout.splitlines())
    words = ("evaluate", "planner:greedy", "--ticks", "20", "--seeds", "1", "--jobs", "1")
    done = here(*words, f"--map={os.fsdecode(name)}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert all(line.isprintable() for line in (done.stdout + done.stderr).splitlines())


@pytest.mark.parametrize(
    "words",
    [
        ("fly", "--", "-p.onnx"), ("run", "--", "-quick"), ("analyze", "--", "-run"), ("fly", "\x1b[2J"),
        ("run", "one\ntwo"), ("actor", "--id", "-1"), ("run", "quick", "--episode", "2"),
        ("bench", "actor", "--repeat", "1"), ("evaluate", "planner:greedy", "--act", "2"),
        ("log", "moves", "R", "--ep", "1"), ("verify", "exactness", "--seed", "3"), ("map", "show", "--road", "all"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_printable_sentence(words: tuple[str, ...], tmp_path: Path) -> None:
    done = here(*words, cwd=tmp_path)
    assert done.returncode == 2
    [sentence] = done.stderr.splitlines()
    assert sentence.startswith("overfly:") and sentence.isprintable()


def flies(out: Path) -> bool:
    return (out / "tmc.mcap.active").exists() and (out / "tmc.mcap.active").stat().st_size > 20_000


def until(what: Callable[[], object], run: subprocess.Popen[str]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not what():
        assert run.poll() is None and time.monotonic() < give_up
        time.sleep(0.02)


@pytest.mark.parametrize(("moved", "lockstep"), [(False, False), (True, False), (False, True)])
def test_a_run_folder_that_goes_away_ends_the_mission(moved: bool, lockstep: bool, tmp_path: Path) -> None:
    """In one process a moved folder is noticed only at the end; until then nothing is lost."""
    line = [*LINE, "fly", "planner:greedy", "--actors", "2", "--ticks", "60000", "--out", "R"]
    line += ["--lockstep"] if lockstep else []
    with subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        until(lambda: flies(tmp_path / "R"), run)
        os.rename(tmp_path / "R", tmp_path / "M")  # noqa: PTH104
        if not moved:
            shutil.rmtree(tmp_path / "M")
        began = time.monotonic()
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1, errors
    assert time.monotonic() - began < 60
    assert errors.splitlines()[-1] == (
        "overfly: the run folder R was removed or moved while the mission was flown: fly it again"
    )  # fmt: skip
    assert "Traceback" not in errors


def test_a_tmc_by_hand_leaves_no_socket_and_notices_that_its_folder_is_gone(tmp_path: Path) -> None:
    line = [*LINE, "tmc", "quick", "--actors", "2", "--bind", "ipc://sync", "--out", "R"]
    for gone in (False, True):
        with subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
            until((tmp_path / "sync.learner").exists, run)
            if gone:
                shutil.rmtree(tmp_path / "R")
            else:
                run.send_signal(signal.SIGTERM)
            _, errors = run.communicate(timeout=PATIENCE_S)
        assert run.returncode == (2 if gone else 143), errors
        assert ("it was removed" in errors) == gone
        assert not (tmp_path / "sync").exists() and not (tmp_path / "sync.learner").exists()
        shutil.rmtree(tmp_path / "R", ignore_errors=True)


def test_a_wall_clock_that_jumps_does_not_lengthen_a_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock jumps by a day, forward and back, at every message."""
    day, now = 86_400 * 10**9, LogWriter.now
    jumps = iter(range(1, 10**9))
    monkeypatch.setattr(LogWriter, "now", lambda self: now(self) + next(jumps) % 2 * day)
    began = time.monotonic()
    done = here("fly", "planner:greedy", "--lockstep", "--ticks", "200", "--no-pictures", "--out", "R", cwd=tmp_path)
    took = time.monotonic() - began
    assert done.returncode == 0, done.stderr
    pace = json.loads((tmp_path / "R" / "summary.json").read_text())["pace"]
    assert 0 < pace["seconds"] <= took
    assert pace["ticks_per_second"] >= 200 / took
    assert 0 <= json.loads((tmp_path / "R" / "run.json").read_text())["seconds"] <= took + 0.1  # in tenths

"""A mission killed as a whole: its logs are checked, recovered and compacted, and nothing that was flushed is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from tests.command import PATIENCE_S
from tmc.record.reader import Log


def test_a_mission_that_was_killed_is_checked_recovered_and_sealed(here, running, tmp_path: Path) -> None:
    out = tmp_path / "R"
    command = [sys.executable, "-P", "-m", "deploy.cli", "fly", "planner:greedy", "--actors", "3", "--ticks", "60000"]
    with subprocess.Popen([*command, "--out", str(out)], cwd=tmp_path, stderr=subprocess.DEVNULL) as run:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until and not flying(out / "tmc.mcap.active"):
            time.sleep(0.1)
        refused = here("log", "compact", out)
        assert refused.returncode == 1 and "is being written by another process" in refused.stderr
        assert run.poll() is None, "the mission was over before it could be killed"
        for pid in [run.pid, *running(str(out))]:
            kill(pid)
    until = time.monotonic() + PATIENCE_S
    while running(str(out)) and time.monotonic() < until:
        time.sleep(0.05)
    logs = {path.name: held(path) for path in out.glob("*.active")}
    assert set(logs) == {"tmc.mcap.active", *(f"uav-00{i}.mcap.active" for i in range(3))}
    checked = here("log", "check", out)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert "1 episode (1 not finished)" in checked.stdout and "the file was not closed" in checked.stdout
    digest = here("log", "digest", out).stdout
    assert here("log", "recover", out).returncode in (0, 3)
    for name, messages in logs.items():
        log = Log(out / name.replace(".mcap.active", ".recovered.mcap"))
        assert log.finished and sum(1 for _ in log.raw()) == messages
        log.path.unlink()
    compacted = here("log", "compact", out)
    assert compacted.returncode in (0, 3), compacted.stderr
    assert not list(out.glob("*.active"))
    assert {f"{p.name}.active": held(p) for p in out.glob("*.mcap")} == logs
    assert here("log", "check", out).returncode == 0
    assert here("log", "digest", out).stdout == digest


def held(path: Path) -> int:
    """Return the number of messages in a log."""
    return sum(1 for _ in Log(path).raw())


def flying(path: Path) -> bool:
    """Return whether the TMC has logged flight records."""
    return path.is_file() and path.stat().st_size > 30_000


def kill(pid: int) -> None:
    with suppress(ProcessLookupError):  # it died with its parent
        os.kill(pid, signal.SIGKILL)

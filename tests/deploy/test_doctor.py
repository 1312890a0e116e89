"""`overfly doctor` tries what missions do, and names what is wrong with the machine in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.commands import doctor
from deploy.run import machine, scratch
from tests.command import here


@pytest.fixture
def healthy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip checks that take long, or that this machine may fail."""
    for check in ("disk", "processes", "logs", "shared folder", "sockets", "limits", "map"):
        monkeypatch.delitem(doctor.CHECKS, check)
    monkeypatch.setattr(doctor.extras, "packages", tuple)


def look_at(monkeypatch: pytest.MonkeyPatch, *checks: str) -> None:
    known = {"shared folder": doctor._shared_folder, "sockets": doctor._sockets, "processes": doctor._processes,
             "logs": doctor._log, "limits": doctor._limits}  # fmt: skip
    for check in checks:
        monkeypatch.setitem(doctor.CHECKS, check, known[check])


def test_what_missions_do_works_here_and_leaves_nothing(
    healthy: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look_at(monkeypatch, "shared folder", "sockets", "processes", "logs", "limits")
    done = here("doctor", cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert done.stdout.splitlines()[-1] == "all is well"
    assert not [*tmp_path.iterdir()]


def test_where_no_folder_can_be_shared_it_says_so(
    healthy: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look_at(monkeypatch, "shared folder", "sockets", "processes")
    monkeypatch.setattr(scratch, "places", lambda: [tmp_path / "nowhere"])
    done = here("doctor", cwd=tmp_path)
    assert done.returncode == 1
    bad = [line for line in done.stdout.splitlines() if line.startswith("  BAD")]
    assert len(bad) == 3
    assert all(f"{tmp_path / 'nowhere'}: No such file or directory" in line for line in bad)


def test_a_limit_that_is_too_low_is_named(healthy: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    look_at(monkeypatch, "limits")
    monkeypatch.setitem(machine.ALLOWED, machine.FILES, lambda *_: 16)
    done = here("doctor", cwd=tmp_path)
    assert done.returncode == 1
    assert "BAD   limits: 3 UAVs need at least 35 open files in the TMC, and 16 can be had" in done.stdout


def test_a_folder_for_runs_that_is_a_file_is_named(
    healthy: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look_at(monkeypatch, "logs")
    (tmp_path / "runs").write_text("a file")
    done = here("doctor", cwd=tmp_path)
    assert done.returncode == 1
    assert "BAD   logs:" in done.stdout and "runs" in done.stdout

"""A file that is not a log: each command that reads logs refuses it in a sentence, at once, with exit code 2."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.command import here, overfly

OF_A_FILE = (("info",), ("cat",), ("merge",), ("recover",), ("recover", "--in-place"))
OF_A_RUN = (("moves",), ("uncertainty",), ("events",), ("digest",), ("check",), ("compact",), ("replay",))


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        os.chdir(path.parent)  # the name of a socket has 107 bytes at most
        bound.bind(path.name)


NO_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "gone": (lambda path: None, "No such file or directory"),
    "gone with its folder": (lambda path: path.parent.rmdir(), "No such file or directory"),
    "a pipe": (os.mkfifo, "is a pipe): give the file of a log"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "is a device): give the file of a log"),
    "a terminal": (lambda path: path.symlink_to(os.ttyname(os.openpty()[1])), "is a device): give the file of a log"),
    "a socket": (a_socket, "is a socket): give the file of a log"),
    "a loop of links": (lambda path: path.symlink_to(path), "cannot be read (Too many levels of symbolic links)"),
    "empty": (Path.touch, "is empty: "),
    "text": (lambda path: path.write_text("hello, world, this is not a log"), "MCAP file"),
    "a folder without logs": (Path.mkdir, "holds no logs of a run (tmc.mcap and others)"),
    "a folder with a pipe": (lambda path: (path.mkdir(), os.mkfifo(path / "tmc.mcap")), "holds no logs of a run"),
}


@pytest.mark.parametrize("view", OF_A_FILE + OF_A_RUN, ids=" ".join)
@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_log(kind: str, view: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make, sentence = NO_FILES[kind]
    path = tmp_path / "in" / "tmc.mcap"
    path.parent.mkdir()
    make(path)
    before = sorted(tmp_path.rglob("*"))
    done = here("log", *view, path, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("overfly: ") and done.stderr.count("\n") == 1
    assert sentence in done.stderr or (view in OF_A_RUN and "holds no logs of a run (" in done.stderr)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("command", [("analyze",), ("run", "--resume"), ("tmc", "--resume"), ("evaluate",), ("fly",)])
@pytest.mark.parametrize("make", [lambda path: None, Path.mkdir, os.mkfifo], ids=["gone", "empty", "pipe"])
def test_what_is_no_run(command: tuple[str, ...], make: Callable[[Path], object], tmp_path: Path) -> None:
    make(tmp_path / "R")
    done = overfly(*command, tmp_path / "R", cwd=tmp_path, timeout=60)
    assert done.returncode == 2 and done.stderr.startswith("overfly: ") and done.stderr.count("\n") == 1


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    for view in OF_A_FILE + OF_A_RUN:
        done = here("log", *view, "x" * 300, cwd=tmp_path)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1) and "File name too long" in done.stderr


def test_recover_of_a_run_goes_on_behind_a_log_that_is_none(tmp_path: Path) -> None:
    run = tmp_path / "R"
    flown = here("fly", "planner:greedy", "--lockstep", "--no-pictures", "--ticks", "20", "--out", run, cwd=tmp_path)
    assert flown.returncode == 0
    (run / "learner.mcap.active").touch()
    done = here("log", "recover", run, cwd=tmp_path)
    assert done.returncode == 1  # in part, so it is not a mistake in the command
    assert "learner.mcap.active is empty" in done.stderr and "tmc.mcap: intact and finished" in done.stdout


@pytest.mark.parametrize("view", ["merge", "recover", "replay"])
def test_a_file_that_is_there_is_never_written_over(view: str, tmp_path: Path) -> None:
    there = tmp_path / "there.mcap"
    there.symlink_to("nowhere")
    run = tmp_path / "tmc.mcap"
    run.touch()
    done = here("log", view, run, "--out", there, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1) and "exists already: choose another" in done.stderr

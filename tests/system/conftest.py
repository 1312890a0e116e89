"""Fixtures for tests that start the command as a user does: real processes, real sockets, real files."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import command
from tests.command import PATIENCE_S

Overfly = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def overfly(tmp_path: Path) -> Overfly:
    """Run `overfly ARGS` in an empty folder; nothing is asserted here."""
    return lambda *args, **timeout: command.overfly(*args, cwd=tmp_path, **timeout)


@pytest.fixture
def here(tmp_path: Path) -> Overfly:
    """Run `overfly ARGS` in this process, for commands that start no process."""
    return lambda *args: command.here(*args, cwd=tmp_path)


def processes_of(marker: str) -> list[int]:
    """Return the processes whose command line names `marker`."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            try:
                line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if marker in line:
                found.append(int(folder.name))
    return found


@pytest.fixture
def running() -> Callable[[str], list[int]]:
    """Return a function that returns the ids of the processes whose command line names a text."""
    return processes_of


@pytest.fixture(autouse=True)
def no_process_left(tmp_path: Path) -> Iterator[None]:
    """Assert that every process with the test's folder in its command line has ended with the test."""
    yield
    until = time.monotonic() + PATIENCE_S
    while (left := processes_of(str(tmp_path))) and time.monotonic() < until:
        time.sleep(0.05)
    assert left == []

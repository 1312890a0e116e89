"""Fixtures for tests that start the command as a user does: real processes, real sockets, real files."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

Overfly = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def overfly(tmp_path: Path) -> Overfly:
    """Run `overfly ARGS` in an empty folder; nothing is asserted here."""

    def run(*args: object, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-P", "-m", "deploy.cli", *map(str, args)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=timeout, check=False)

    return run


def processes_of(marker: str) -> list[int]:
    """Processes whose command line names `marker`."""
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
    """The ids of the processes whose command line names a text."""
    return processes_of


@pytest.fixture(autouse=True)
def no_process_left(tmp_path: Path) -> Iterator[None]:
    """Whatever a test started with its folder in the command line is gone when it ends."""
    yield
    assert processes_of(str(tmp_path)) == []

"""Starts helper processes that compute something and print it, and reports how one failed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping

from tmc.wire import process
from tmc.wire.process import FailedError


def start(module: str, *words: object, env: Mapping[str, str]) -> subprocess.Popen[str]:
    """Start `python -P -m MODULE WORDS --parent PID`, which imports nothing from the current folder.

    It has its own session, so Ctrl-C in the terminal goes to its parent, which ends it.
    """
    line = [sys.executable, "-P", "-m", module, *map(str, words), "--parent", str(os.getpid())]
    return subprocess.Popen(
        line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env, start_new_session=True,
        encoding="utf-8",
    )  # fmt: skip


def output_of(helper: subprocess.Popen[str], given: str = "") -> str:
    """Send `given` to its stdin, wait for its end, and return what it printed. Raises FailedError if it failed."""
    try:
        printed, _ = helper.communicate(given)
    finally:
        helper.kill()
        helper.wait()
    if helper.returncode:
        raise FailedError(f"a process of the bench {process.how_it_ended(helper.returncode)}")
    return printed

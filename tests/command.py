"""The command as tests give it: to a process of its own, as a user does, or here, which saves the start of a Python."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from pathlib import Path

from deploy.cli import main

PATIENCE_S = 150.0
"""Seconds after which a test stops waiting. What comes ends the wait at once, so only what never comes takes so long;
on a machine that does other work as well, all takes several times as long as on a quiet one."""
LINE = (sys.executable, "-P", "-m", "deploy.cli")
"""How `overfly` is started, whatever lies in the folder that it is started in."""


def overfly(
    *args: object, cwd: Path, timeout: float = PATIENCE_S, line: tuple[str, ...] = LINE
) -> subprocess.CompletedProcess[str]:
    """`overfly ARGS` in a process of its own, started by `line`."""
    line = (*line, *map(str, args))
    return subprocess.run(line, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False)


def line_of_trial(**trial: object) -> tuple[str, ...]:
    """How `overfly` is started with settings `trial.*`, given without their group: `stall=0.01`."""
    return (sys.executable, "-P", str(Path(__file__).with_name("trial.py")), json.dumps(trial))


def descendants(process: int) -> list[int]:
    """The ids of all that a process has started, and they in turn."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = stat.read_text().rpartition(")")[2].split()[1]
            children.setdefault(int(parent), []).append(int(stat.parent.name))
    found = [process]
    for known in found:
        found += children.get(known, [])
    return found[1:]


def here(*args: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """`overfly ARGS` in this process: for what starts no process, or is not about them."""
    line, out, err = [*map(str, args)], io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(line)
        except SystemExit as left:  # argparse
            code = left.code if isinstance(left.code, int) else 1
    return subprocess.CompletedProcess(line, code, out.getvalue(), err.getvalue())

"""`overfly bench startup`: how long a user waits for a start.

It measures the first update of `overfly run quick`, the first message of a UAV started by hand, `--help`, and the
imports of each role. Each is a separate process, started as a user starts it. One start of each comes before and does
not count, so that Python's files are in the system's cache: the bench measures a start, not the disk.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import zmq

from deploy import settings
from deploy.bench import bounds
from deploy.bench.row import Row
from deploy.run.mission import check
from deploy.run.plan import ROOT
from deploy.run.supervisor import MissionFailed
from tmc.record import reader
from tmc.record.errors import RecordError
from tmc.record.overfly_pb2 import LearnerMetrics
from tmc.wire import messages, process, sockets
from tmc.wire.codec import decode

LIMITS = {"run": 5.0, "actor": 0.6}
"""Limits (s) of a start with warm caches: to the first update of three UAVs, and to a UAV's first message."""
ROLES = ("tmc", "actors", "learner")
"""The modules of the roles: `python -m ROLE` imports `ROLE.__main__` and what it needs."""
TURN_S = 2.0
"""Least time (s) of all starts of a turn."""
START_TIMEOUT_S = 120.0
"""Time (s) after which a start has failed."""
POLL_S = 0.05
"""Interval (s) at which the learner's log is read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the bench."""
    parser.add_argument("--repeats", type=int, default=5, metavar="R", help="turns to take medians of (default: 5)")
    parser.add_argument("--warm", type=int, default=1, metavar="W", help="warm-up turns that do not count (default: 1)")
    settings.add_options(parser)


def measure(args: argparse.Namespace) -> list[Row]:
    """Time every start in turns; return one row per figure. Raises ConfigError, MissionFailed."""
    bounds.number("--repeats", args.repeats, 1, TURN_S)
    bounds.number("--warm", args.warm, 0, TURN_S)
    changes = [word for key, value in settings.chosen(args).items() for word in ("--set", f"{key}={value}")]
    size = check(settings.config_for("quick", settings.chosen(args))).config.team.size
    starts: dict[str, Callable[[Path], float]] = {
        "run": lambda out: first_update(out, changes),
        "actor": first_message,
        "python": lambda _: finished("-c", "pass"),
        "help": lambda _: finished("-m", "deploy.cli", "--help"),
        **{role: partial(imported, role) for role in ROLES},
    }
    taken: dict[str, list[float]] = {name: [] for name in starts}
    with tempfile.TemporaryDirectory(prefix="overfly-") as scratch:
        for repeat in range(1 - args.warm, args.repeats + 1):
            for name, start in starts.items():
                seconds = start(Path(tempfile.mkdtemp(dir=scratch)))
                taken[name] += [seconds] if repeat > 0 else []
            _print_progress(f"turn {repeat} of {args.repeats}" if repeat > 0 else "warm-up turn")
    return list(_rows(size, taken))


def _rows(size: int, taken: dict[str, list[float]]) -> Iterator[Row]:
    middle = {name: median(seconds) for name, seconds in taken.items()}
    for name, case in (("run", f"run quick, N={size}"), ("actor", "actor alone")):
        limit, unit = LIMITS[name], "s to the first update" if name == "run" else "s to its first message"
        yield Row("startup", case, middle[name], unit, limit, middle[name] / limit, "of the limit")
    for name in ("help", *ROLES):
        ratio = median(a / b for a, b in zip(taken[name], taken["python"], strict=True))
        case, unit = ("--help", "s") if name == "help" else (f"import {name}", "s, whole process")
        yield Row("startup", case, middle[name], unit, middle["python"], ratio, "x an empty Python")


def _print_progress(text: str) -> None:
    process.tell(text, prefix="")


def command(*words: object) -> list[str]:
    """Return a command line of Python that imports nothing from the current folder."""
    return [sys.executable, "-P", *map(str, words)]


def environment() -> dict[str, str]:
    """Return this process's environment, with Overfly's packages on the path."""
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH", "")) if p)
    return os.environ | {"PYTHONPATH": path}


def imported(role: str, _: Path) -> float:
    """Return the time (s) of a process that imports what a role needs, and ends."""
    return finished("-c", f"import {role}.__main__")


def finished(*words: str) -> float:
    """Return the time (s) from the start of a process to its end."""
    start = time.monotonic()
    subprocess.run(command(*words), env=environment(), stdout=subprocess.DEVNULL, check=True, timeout=START_TIMEOUT_S)
    return time.monotonic() - start


@contextmanager
def running(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run `overfly WORDS`; interrupt it at the end of the block."""
    line = command("-m", "deploy.cli", *words)
    with subprocess.Popen(line, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as started:
        try:
            yield started
        finally:
            started.send_signal(signal.SIGINT)
            started.communicate()


def first_update(out: Path, changes: list[str]) -> float:
    """Return the time (s) from the start of `overfly run quick` to its first update, by the learner's log.

    Raises MissionFailed.
    """
    start = time.monotonic()
    with running("run", "quick", *changes, "--out", out) as run:
        while (at := _first_update(out / "learner.mcap.active")) is None:
            if run.poll() is not None or time.monotonic() - start > START_TIMEOUT_S:
                raise MissionFailed(f"overfly run quick made no update in {START_TIMEOUT_S:g} s")
            time.sleep(POLL_S)
        return (
            time.monotonic() - (time.time_ns() - at) / 1e9 - start
        )  # the wall clock is used for the last moments only


def _first_update(log: Path) -> int | None:
    """Return when (ns, wall clock) the learner logged its first metrics, after its first update; None: not yet."""
    try:
        first = next((raw for raw in reader.Log(log).raw() if raw.topic == "/learner/metrics"), None)
    except RecordError:  # not there yet, or still empty
        return None
    if first is None:
        return None
    assert reader.decode(first, LearnerMetrics).updates == 1
    return first.log_time


def first_message(out: Path) -> float:
    """Return the time (s) from the start of `overfly actor` to its Hello at this process. Raises MissionFailed."""
    endpoint = f"tcp://127.0.0.1:{sockets.free_port()}"  # the name of a folder may be too long for a socket
    context: zmq.Context[Any] = zmq.Context()
    try:
        tmc = sockets.router(context, endpoint)
        start = time.monotonic()
        with running("actor", "--id", 0, "--connect", endpoint, "--out", out / "U"):
            if not tmc.poll(int(START_TIMEOUT_S * 1000)):
                raise MissionFailed(f"a UAV sent nothing for {START_TIMEOUT_S:g} s")
            seconds = time.monotonic() - start
            frames = sockets.receive(tmc) or []
    finally:
        context.destroy(linger=0)
    assert isinstance(decode(frames[1:]), messages.Hello)
    return seconds

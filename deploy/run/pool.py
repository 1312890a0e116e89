"""Calls a function for many arguments in worker processes, each `python -P -m deploy.run.pool`.

The workers of concurrent.futures import from the current folder and get the terminal's Ctrl-C, and that pool does not
report how a worker was killed.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from deploy.run.plan import environment
from deploy.run.suspension import Suspension
from tmc.wire import process
from tmc.wire.process import FailedError

A = TypeVar("A")
R = TypeVar("R")
POLL_S = 0.2
"""Interval (s) at which a waiting pool checks for Ctrl-Z."""


class Worker:
    """One process. `item`: the index of the argument that it works on; -1 without one."""

    def __init__(self) -> None:
        ours, its = socket.socketpair()
        self.connection, self.item = Connection(ours.detach()), -1
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed with the worker
        line = [sys.executable, "-P", "-m", "deploy.run.pool", f"--pipe={its.fileno()}", f"--parent={os.getpid()}"]
        with its:
            self.process = subprocess.Popen(
                line, stdin=subprocess.DEVNULL, stdout=self._errors, stderr=self._errors, env=environment("worker", 1),
                pass_fds=[its.fileno()], start_new_session=True,
            )  # fmt: skip

    def submit(self, number: int, function: Callable[[Any], Any], argument: Any) -> None:
        """Let the process call `function(argument)`. Raises FailedError if it has ended."""
        self.item = number
        try:
            self.connection.send((function, argument))
        except OSError:
            raise FailedError(self._how_it_ended()) from None

    def outcome(self) -> tuple[bool, Any]:
        """Return (True, result) or (False, exception). Raises FailedError if the process has ended."""
        try:
            succeeded, value = self.connection.recv()
        except (EOFError, OSError):
            raise FailedError(self._how_it_ended()) from None
        return succeeded, value

    def _how_it_ended(self) -> str:
        how = process.how_it_ended(self.process.wait())
        self._errors.seek(0)
        reason = process.last_error(self._errors.read().decode(errors="replace"))
        return f"a worker process {how}: {reason or 'memory may have run out, so try again with fewer --jobs'}"

    def close(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.wait()
        self.connection.close()
        self._errors.close()


def call_each(function: Callable[[A], R], arguments: Sequence[A], jobs: int) -> Iterator[R]:
    """Yield `function(a)` for each argument in order, computed on `jobs` processes.

    Raises what the function raises, in order, and FailedError, which says how, if a process ends early.
    """
    workers: list[Worker] = []
    suspension = Suspension(lambda: [worker.process.pid for worker in workers])
    waiting, outcomes = iter(enumerate(arguments)), dict[int, tuple[bool, Any]]()
    try:
        workers += [Worker() for _ in range(min(jobs, len(arguments)))]
        idle, busy = [*workers], dict[Any, Worker]()
        for number in range(len(arguments)):
            while number not in outcomes:
                suspension.suspend_if_asked()
                while idle and (item := next(waiting, None)) is not None:
                    worker = idle.pop()
                    worker.submit(item[0], function, item[1])
                    busy[worker.connection] = worker
                for connection in wait([*busy], POLL_S):
                    worker = busy.pop(connection)
                    outcomes[worker.item] = worker.outcome()
                    idle.append(worker)
            succeeded, value = outcomes.pop(number)
            if not succeeded:
                raise value
            yield value
    finally:
        suspension.close()
        for worker in workers:
            worker.close()


def main(argv: list[str] | None = None) -> int:
    """Serve one pool until it closes its side; return the exit code."""
    parser = argparse.ArgumentParser("deploy.run.pool", description=__doc__, allow_abbrev=False)
    parser.add_argument("--pipe", type=int, required=True, help="descriptor of the socket to the pool")
    parser.add_argument("--parent", type=int, required=True, help="end with this process")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    return process.run_child(lambda: serve(Connection(a.pipe)), ())


def serve(connection: Connection) -> int:
    """Call each (function, argument) received, and send back what it returns or raises."""
    with suppress(EOFError, ConnectionError):
        while True:
            function, argument = connection.recv()
            try:
                outcome = (True, function(argument))
            except Exception as error:
                error.add_note("".join(traceback.format_tb(error.__traceback__)))
                outcome = (False, error)
            connection.send(outcome)
    return process.DONE


if __name__ == "__main__":
    sys.exit(main())

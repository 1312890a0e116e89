"""`python -m deploy.run.forkserver --of PACKAGE`: forks the processes of one package, UAVs or the learner.

It imports the package's `__main__` once, before any thread or ZeroMQ context exists. So the processes share the memory
of what they import, and a restarted one does not import it again.

Orders are lines of JSON on stdin: `{"start": NAME, "argv": [...], "log": PATH}`, or `{"signal": NUMBER, "name": NAME}`.
Reports are lines of JSON on stdout: `{"name": NAME, "pid": PID}` when a process has started, and
`{"name": NAME, "code": CODE}`, negative for a signal, when it has ended. The processes end with the forkserver, and the
forkserver ends with its supervisor.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import importlib
import json
import os
import select
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from setproctitle import setproctitle

from deploy import extras
from tmc.kernel.text import printable
from tmc.wire import process
from tmc.wire.options import Options

TITLE = "overfly"
"""First word of a process's title; the name of its package and its arguments follow."""

Main = Callable[[list[str]], int]
"""What a process runs with its arguments; returns the exit code."""


class ForkServer:
    """Forks processes that run `main` of `package` by order of the supervisor, and reaps them."""

    def __init__(self, package: str, main: Main) -> None:
        self._package, self._main = package, main
        self._pids: dict[str, int] = {}
        self._names: dict[int, str] = {}
        self._ended, wake = os.pipe()
        for end in (self._ended, wake):
            os.set_blocking(end, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        self._ends = (self._ended, wake)

    def serve(self) -> None:
        """Run the main loop until the supervisor closes its side."""
        rest = b""
        while True:
            ready, _, _ = select.select([0, self._ended], [], [])
            if self._ended in ready:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._ended, 4096)
                self._reap()
            if 0 in ready:
                data = os.read(0, 65_536)
                if not data:
                    return
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    self._execute(json.loads(line))

    def _execute(self, order: dict[str, Any]) -> None:
        if "start" in order:
            self._fork(order["start"], order["argv"], order["log"])
        elif order["name"] in self._pids:  # not reaped, so the id is still its own
            os.kill(self._pids[order["name"]], order["signal"])

    def _fork(self, name: str, argv: list[str], log: str) -> None:
        server = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            self._refuse(name, log, f"the system has no room for another process ({error.strerror}): raise ulimit -u")
            return
        if pid == 0:
            run_forked(self._package, self._main, server, self._ends, argv, log)
        self._pids[name], self._names[pid] = pid, name
        _send_report({"name": name, "pid": pid})

    @staticmethod
    def _refuse(name: str, log: str, text: str) -> None:
        """Report a process that could not be started, with the reason as its output."""
        with contextlib.suppress(OSError), Path(log).open("a", encoding="utf-8") as output:
            output.write(f"{process.ERROR}{text}\n")
        _send_report({"name": name, "code": process.FAILED})

    def _reap(self) -> None:
        while self._names:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            name = self._names.pop(pid)
            del self._pids[name]
            _send_report({"name": name, "code": os.waitstatus_to_exitcode(status)})


def _send_report(report: dict[str, Any]) -> None:
    data = json.dumps(report).encode() + b"\n"
    while data:
        data = data[os.write(1, data) :]


def run_forked(package: str, main: Main, server: int, ends: tuple[int, int], argv: list[str], log: str) -> NoReturn:
    """Run `main(argv)` in a forked process that has nothing of the server but its memory; never returns."""
    code = process.FAILED
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setsid()  # Ctrl-C in the terminal is for the supervisor, which ends all in order
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        for old, new in ((os.open(os.devnull, os.O_RDONLY), 0), (output, 1), (output, 2)):
            os.dup2(old, new)
        for end in (*ends, output):
            os.close(end)
        set_title(package, argv)
        process.die_with_parent(server)
        code = main(argv)
    except SystemExit as left:  # argparse
        code = left.code if isinstance(left.code, int) else process.FAILED
    except BaseException as error:  # the traceback goes to the log, and no exception may reach the server's loop
        traceback.print_exc()
        process.tell(f"{type(error).__name__}: {error}")
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        os._exit(code)


def set_title(package: str, argv: Sequence[str]) -> None:
    """Set the command line that `ps` and /proc show, which a fork takes over from the server.

    It is cut where it is longer than the server's own command line and environment together: the system has no more
    memory for it.
    """
    setproctitle(printable(" ".join((TITLE, package, *argv))))


def _restart_without_preload(a: argparse.Namespace) -> None:
    """Start the server again without preloaded modules, because one started a thread, which a fork would not have.

    The process id, the pipes and the orders in them stay. If the package itself starts threads, there is nothing to
    leave out, and the processes are forked without those threads.
    """
    process.note(f"{process.threads()} threads run after importing {', '.join([a.of, *a.preload])}")
    if a.preload:
        process.note("each process imports for itself what would have been preloaded")
        line = [sys.executable, "-P", "-m", "deploy.run.forkserver", f"--of={a.of}", f"--out={a.out}"]
        os.execv(sys.executable, [*line, f"--parent={a.parent}"])


def _program(package: str, preload: Sequence[str]) -> Main:
    """Import and return what the processes run; if that fails, each process prints a sentence and is not restarted."""
    try:
        run: Main = importlib.import_module(f"{package}.__main__").main
        for module in preload:
            importlib.import_module(module)
    except Exception as error:
        sentence = extras.broken(error)
        if not sentence:
            raise
        return lambda _: process.run(partial(_refuse, sentence), (RuntimeError,))
    return run


def _refuse(sentence: str) -> int:
    raise RuntimeError(sentence)


def main(argv: list[str] | None = None) -> int:
    """Import the package, freeze its objects, and serve until the supervisor closes stdin; return the exit code."""
    parser = Options("deploy.run.forkserver", description=__doc__)
    parser.add_argument("--of", required=True, metavar="PACKAGE", help="whose __main__ the processes run")
    parser.add_argument("--preload", action="append", default=[], metavar="MODULE", help="what all of them will need")
    parser.add_argument("--out", default="", help="the run's folder, to be found by")
    parser.add_argument("--parent", type=int, default=0, help="process to die with")
    a = parser.parse_args(argv)
    process.become_child(a.parent)
    run = _program(a.of, a.preload)
    if process.threads() > 1:
        _restart_without_preload(a)
    gc.collect()
    gc.freeze()  # objects from before the fork are never collected, so a collection does not copy their pages
    with contextlib.suppress(BrokenPipeError):
        ForkServer(a.of, run).serve()
    return process.DONE


if __name__ == "__main__":
    sys.exit(main())

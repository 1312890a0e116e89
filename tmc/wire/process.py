"""Start and end a process: streams, signals, the parent's death, and exit codes."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

from tmc.kernel.errors import OverflyError
from tmc.kernel.text import printable

DONE, FAILED, USAGE, FENCED, STOPPED = 0, 1, 2, 75, 143
"""Exit codes: success; failure; a user's mistake; replaced by a newer process of the same name; ended by a signal."""

ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that end a process in order."""
ERROR, NOTE = "overfly: ", "overfly: note: "
"""Prefixes of lines on stderr: of an error, and of a note."""
REPEAT_S = 5.0
"""Interval at which a waiting process reports for what it waits."""

_PR_SET_PDEATHSIG, _PR_GET_CHILD_SUBREAPER = 1, 37


class FailedError(OverflyError):
    """The work failed though the command was right. The text is one sentence for the user; exit code 1."""


def tell(text: str, prefix: str = ERROR) -> None:
    """Print a line on stderr. Never raises: a stderr that cannot be written must not end the process."""
    with suppress(OSError, ValueError):
        print(f"{prefix}{printable(text)}", file=sys.stderr, flush=True)


def note(text: str) -> None:
    """Print a line on stderr that is not an error."""
    tell(text, NOTE)


class Reminder:
    """Tell every `REPEAT_S` seconds that the work of a process does not advance."""

    def __init__(self) -> None:
        self._since, self._at = time.monotonic(), None
        self.asked = False
        """True while a question to another process, about the cause of the waiting, is unanswered."""

    def due(self, at: Any = None) -> bool:
        """Return True once every `REPEAT_S` seconds while `at`, the progress of the work, does not change."""
        now = time.monotonic()
        if at != self._at:
            self._since, self._at, self.asked = now, at, False
        due = now - self._since >= REPEAT_S
        if due:
            self._since = now
        return due


def standard_streams() -> None:
    """Make stdin, stdout and stderr usable, whatever the parent did to them.

    A closed one is opened on /dev/null; otherwise the next opened file would get its number. A character that the
    locale's encoding lacks is written as an escape sequence instead of raising UnicodeEncodeError.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDONLY if number == 0 else os.O_WRONLY)  # gets the lowest free number
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:  # Python found it closed
            stream = open(number, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  open as long as the process
            setattr(sys, name, stream)
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def inherited_signals() -> None:
    """Adopt or reset the signal state that the parent left.

    Kept: ignored HUP and INT (nohup, a background job of a script), and ignored TERM in this process. Its children get
    TERM back, since their supervisor ends them with it. Reset: blocked signals, and CHLD, without which the end of a
    child is not noticed.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    if signal.getsignal(signal.SIGTERM) is signal.SIG_IGN:
        signal.signal(signal.SIGTERM, _ignore)  # unlike SIG_IGN, a handler does not outlive an exec


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """Do nothing."""


def handle(number: int, handler: Callable[[int, FrameType | None], Any] | signal.Handlers) -> None:
    """Install a signal handler, unless the parent made the process ignore the signal."""
    if signal.getsignal(number) not in {signal.SIG_IGN, _ignore}:
        signal.signal(number, handler)


class Stop:
    """True after SIGTERM, SIGINT or SIGHUP. A second signal ends the process at once."""

    def __init__(self) -> None:
        self.asked, self.code = False, STOPPED
        """True when the process must stop; its exit code then, 128 + the signal's number."""
        for number in ENDING:
            handle(number, self._note)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.asked:
            os._exit(128 + number)
        self.asked, self.code = True, 128 + number

    def __call__(self) -> bool:
        return self.asked


def become_child(parent: int) -> None:
    """Prepare a child process: its streams, its signals, and its end with the end of its parent.

    `parent`: process id, 0 for a process that was started by hand.
    """
    standard_streams()
    inherited_signals()
    die_with_parent(parent)


def die_with_parent(parent: int) -> None:
    """Ask Linux to send SIGKILL when the parent ends; exit if it has ended already. `parent` 0: do nothing."""
    if not parent:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(FAILED)


def run(main: Callable[[], int], mistakes: tuple[type[Exception], ...]) -> int:
    """Run `main` and return its exit code. A mistake or failure is one sentence on stderr and exit code 2 or 1."""
    try:
        return main()
    except FailedError as error:
        tell(str(error))
        return FAILED
    except mistakes as error:
        tell(str(error))
        return USAGE


def run_child(main: Callable[[], int], mistakes: tuple[type[Exception], ...]) -> int:
    """Run `main` as `run` does, in a process whose supervisor reads its output.

    An unexpected error prints its traceback, and as the last line the sentence that the supervisor repeats.
    """
    try:
        return run(main, mistakes)
    except Exception as error:
        traceback.print_exc()
        tell(f"{type(error).__name__}: {error}")
        return FAILED


def how_it_ended(code: int) -> str:
    """Return how a process ended, by its exit code, or minus the number of the signal that killed it."""
    if code >= 0:
        return f"ended with exit code {code}"
    return f"was killed by {signal.Signals(-code).name}"


def last_error(output: str) -> str:
    """Return the last error that a process printed, without prefix; empty when its last line is not such an error."""
    lines = [line for line in output.strip().splitlines() if not line.startswith(NOTE)]
    return printable(lines[-1].removeprefix(ERROR)) if lines and lines[-1].startswith(ERROR) else ""


def adopts_orphans() -> bool:
    """Return True when orphans become children of this process: as process 1 of a container, or as a subreaper."""
    if os.getpid() == 1:
        return True
    flag = ctypes.c_int(0)
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_GET_CHILD_SUBREAPER, ctypes.byref(flag))
    return bool(flag.value)


def threads() -> int:
    """Return the number of threads of this process, with those of libraries where the system reports them."""
    try:
        return sum(1 for _ in Path("/proc/self/task").iterdir())
    except OSError:
        return threading.active_count()

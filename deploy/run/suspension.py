"""Ctrl-Z: stops the processes of a mission with the command that supervises them, and continues them with it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from types import FrameType

from tmc.wire import process


class Suspension:
    """Takes note of SIGTSTP, which a terminal sends for Ctrl-Z; respected where the parent has it ignored.

    Does nothing outside of the main thread, which alone may set signal handlers, and where the handler was not set by
    Python, so that it could not be put back.

    `pids`: the processes to stop and to let go on, in the order in which they go on.
    """

    def __init__(self, pids: Callable[[], Iterable[int]]) -> None:
        self._pids, self._asked = pids, False
        self._before = signal.getsignal(signal.SIGTSTP)
        self._active = threading.current_thread() is threading.main_thread() and self._before is not None
        if self._active:
            process.handle(signal.SIGTSTP, self._note)

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self._asked = True

    def suspend_if_asked(self) -> None:
        """Stop all processes and this one, if Ctrl-Z was pressed; return when the shell continues this process."""
        if not self._asked:
            return
        self._asked = False
        pids = [*self._pids()]
        _send(reversed(pids), signal.SIGSTOP)
        try:
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTSTP)  # the system ignores it if no shell could continue this process
            signal.signal(signal.SIGTSTP, self._note)
        finally:
            _send(pids, signal.SIGCONT)

    def close(self) -> None:
        """Leave the signal as it was found."""
        if self._active:
            signal.signal(signal.SIGTSTP, self._before)


def _send(pids: Iterable[int], number: signal.Signals) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)

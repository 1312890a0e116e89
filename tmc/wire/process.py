"""What every process does around its main loop: note signals, die with its parent, end with a code that tells."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

DONE, FAILED, USAGE, FENCED, STOPPED = 0, 1, 2, 75, 143
"""Exit codes: all well; failed; a user's mistake; replaced by a newer process of the same name; ended by a signal."""

_PR_SET_PDEATHSIG = 1


class Stop:
    """True once SIGTERM or SIGINT came; a second signal ends the process at once."""

    def __init__(self) -> None:
        self.asked, self.code = False, STOPPED
        """Whether to stop, and the exit code of a process that did: 128 + the signal's number."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._note)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.asked:
            os._exit(128 + number)
        self.asked, self.code = True, 128 + number

    def __call__(self) -> bool:
        return self.asked


def die_with_parent(parent: int) -> None:
    """Ask Linux to send SIGKILL when the parent dies; leaves at once if it is dead already. 0: nothing to do."""
    if not parent:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(FAILED)


def run(main: Callable[[], int], mistakes: tuple[type[Exception], ...]) -> int:
    """Run `main`; a user's mistake becomes one sentence on stderr and exit code 2, never a traceback."""
    try:
        return main()
    except mistakes as error:
        print(f"overfly: {error}", file=sys.stderr)
        return USAGE

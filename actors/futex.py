"""Sleep until a word of shared memory changes, and wake the processes that sleep on it: Linux's futex through libc.

Without a futex, `wait` returns after a millisecond and `wake` does nothing.
"""

from __future__ import annotations

import ctypes
import platform
import sys
import time

_NUMBERS = {"x86_64": 202, "aarch64": 98}
"""Number of the system call, by machine."""
_NUMBER = _NUMBERS.get(platform.machine(), 0) if sys.platform == "linux" and sys.maxsize > 2**32 else 0
_WAIT, _WAKE, _ALL_WAITERS = 0, 1, 2**31 - 1
_POLL_S = 1e-3
"""Longest sleep (s) without a futex."""
_libc = ctypes.CDLL(None) if _NUMBER else None


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def wait(address: int, value: int, seconds: float) -> None:
    """Sleep while the 32-bit word at `address` is `value`, until a wake, a signal or `seconds` have passed.

    May return early for no reason, so the caller must check the word again. Source: futex(2).
    """
    if _libc is None:
        time.sleep(min(seconds, _POLL_S))
        return
    length = _Timespec(int(seconds), int(seconds % 1 * 1e9))
    _libc.syscall(
        ctypes.c_long(_NUMBER), ctypes.c_void_p(address), ctypes.c_int(_WAIT), ctypes.c_uint32(value),
        ctypes.byref(length), None, ctypes.c_int(0),
    )  # fmt: skip


def wake(address: int) -> None:
    """Wake all sleepers on the word at `address`, in any process that has it mapped."""
    if _libc is not None:
        _libc.syscall(
            ctypes.c_long(_NUMBER), ctypes.c_void_p(address), ctypes.c_int(_WAKE), ctypes.c_int(_ALL_WAITERS),
            None, None, ctypes.c_int(0),
        )  # fmt: skip

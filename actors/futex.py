"""Sleep until a word of shared memory changes, and wake whoever sleeps there: Linux's futex, by way of libc.

Where there is none, a sleeper looks again after a moment, and nobody need wake it.
"""

from __future__ import annotations

import ctypes
import platform
import sys
import time

_NUMBERS = {"x86_64": 202, "aarch64": 98}
"""The system call's number, by machine."""
_NUMBER = _NUMBERS.get(platform.machine(), 0) if sys.platform == "linux" and sys.maxsize > 2**32 else 0
_WAIT, _WAKE, _EVERYBODY = 0, 1, 2**31 - 1
_MOMENT = 1e-3
"""Seconds between two looks where there is no futex."""
_libc = ctypes.CDLL(None) if _NUMBER else None


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def wait(address: int, value: int, seconds: float) -> None:
    """Sleep while the 32-bit word at `address` is `value`, until a wake, a signal or so many seconds have passed.

    May return for no reason at all, so look again.
    """
    if _libc is None:
        time.sleep(min(seconds, _MOMENT))
        return
    length = _Timespec(int(seconds), int(seconds % 1 * 1e9))
    _libc.syscall(
        ctypes.c_long(_NUMBER), ctypes.c_void_p(address), ctypes.c_int(_WAIT), ctypes.c_uint32(value),
        ctypes.byref(length), None, ctypes.c_int(0),
    )  # fmt: skip


def wake(address: int) -> None:
    """Wake all who sleep on the word at `address`, in any process that has it mapped."""
    if _libc is not None:
        _libc.syscall(
            ctypes.c_long(_NUMBER), ctypes.c_void_p(address), ctypes.c_int(_WAKE), ctypes.c_int(_EVERYBODY),
            None, None, ctypes.c_int(0),
        )  # fmt: skip

"""Ends the process by a deadline, whatever its threads are stuck in."""

from __future__ import annotations

import ctypes
import sys

_CLOCK_MONOTONIC = 1
_SIGEV_THREAD = 2


class _Event(ctypes.Structure):
    """struct sigevent of Linux with glibc, 64 bytes; for SIGEV_THREAD `function` is called with `value`."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("rest", ctypes.c_char * 32),
    )


class _Times(ctypes.Structure):
    """struct itimerspec: interval and first expiry, s and ns each."""

    _fields_ = tuple((name, ctypes.c_long) for name in ("interval_s", "interval_ns", "first_s", "first_ns"))


def leave_within(seconds: float, code: int) -> None:
    """End the process with this exit code after so many seconds if it is still there; cannot be taken back.

    The timer calls _exit in a thread of the C library: a thread of Python's would wait for the interpreter's lock, held
    by the one that is stuck.  Where the C library has no such timer nothing happens.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    library = ctypes.CDLL(None)
    try:
        create, start, function = library.timer_create, library.timer_settime, library._exit
    except AttributeError:
        return
    event = _Event(value=code, notify=_SIGEV_THREAD, function=ctypes.cast(function, ctypes.c_void_p).value)
    timer = ctypes.c_void_p()
    times = _Times(first_s=int(seconds), first_ns=int(seconds % 1.0 * 1e9))
    if create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        start(timer, 0, ctypes.byref(times), None)

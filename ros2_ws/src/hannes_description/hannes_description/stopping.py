"""How a command ends: SIGTERM as Ctrl-C, with what it has started stopped, and nothing said after its last line."""

from __future__ import annotations

import atexit
import functools
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Terminated(KeyboardInterrupt):
    """SIGTERM came: what is being done ends as on Ctrl-C."""


@contextmanager
def terminable() -> Iterator[threading.Event]:
    """SIGTERM raises Terminated in this block, once, and sets the event; a second one is ignored while things end."""
    came = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield came
        return

    def end(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        came.set()
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield came
    finally:
        if signal.getsignal(signal.SIGTERM) is end:
            signal.signal(signal.SIGTERM, before)


FEEDER_S = 2.0
"""How long the end of a process waits for a thread that fed its workers, in seconds; it takes milliseconds."""


@functools.cache
def end_after_feeders() -> None:
    """Let this process end after the threads that fed joblib's workers have let go of their semaphores.

    They are daemon threads which nobody joins: one that is cut off between the removal of a semaphore's name and its
    sign-off leaves a warning of a leak on the terminal, long after the command's last line.
    """
    atexit.register(_join_feeders)


def _join_feeders() -> None:
    for thread in threading.enumerate():
        if thread.name == "QueueFeederThread":
            thread.join(FEEDER_S)

"""SIGTERM ends a command as Ctrl-C does: what it has started is stopped, and one line is said."""

from __future__ import annotations

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

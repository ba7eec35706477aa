"""A real-time loop in a thread of its own, with absolute deadlines.

An rclpy timer skips ticks that it missed without a word; this loop counts them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from time import monotonic, sleep


class RealtimeLoop:
    """Calls `step(now, elapsed)` at k x period.

    step    now: s of the monotonic clock; elapsed: how many periods have passed since the last call (1 unless late)
    missed  periods in which `step` was not called
    error   what `step` raised; the loop has ended then
    """

    def __init__(self, period: float, step: Callable[[float, int], None]) -> None:
        self._period, self._step = period, step
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="realtime", daemon=True)
        self.missed = 0
        self.error: BaseException | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the loop and wait for the call in progress."""
        self._stop.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout=2.0)

    def _run(self) -> None:
        start, done = monotonic(), 0
        try:
            while not self._stop.is_set():
                wait = start + (done + 1) * self._period - monotonic()
                if wait > 0.0:
                    sleep(wait)
                now = monotonic()
                due = int((now - start) / self._period)
                elapsed = max(due - done, 1)
                self.missed += elapsed - 1
                done += elapsed
                self._step(now, elapsed)
        except BaseException as error:  # handed to the node, which ends with it
            self.error = error

"""What stands between a command from the graph and the motor: finite, within limits, recent."""

from __future__ import annotations

import math
import threading


class CommandGate:
    """Lets a voltage through only if it is finite and recent, and clamps it.

    limit    V, the command is clamped to [-limit, limit]
    timeout  s after the last command, by the caller's clock, from which the output is 0 V
    rejected, clamped, timeouts  counts
    age_at_zero  s between the last command and the 0 V of the latest timeout; None before the first
    Commands may arrive in another thread than the one that asks for the voltage.
    """

    def __init__(self, limit: float, timeout: float) -> None:
        self._limit, self._timeout = limit, timeout
        self._lock = threading.Lock()
        self._voltage = 0.0
        self._last: float | None = None
        self.timed_out = False
        self.age_at_zero: float | None = None
        self.rejected = self.clamped = self.timeouts = 0

    @property
    def last_command(self) -> float | None:
        """Time (s) of the last command, rejected ones included; None if there was none."""
        return self._last

    def command(self, voltage: float, now: float) -> float:
        """A command (V) arrived at `now` (s); returns what the motor gets. What is not finite gives 0 V."""
        with self._lock:
            self._last, self.timed_out = now, False
            self._voltage = min(max(voltage, -self._limit), self._limit) if math.isfinite(voltage) else 0.0
            if not math.isfinite(voltage):
                self.rejected += 1
            elif self._voltage != voltage:
                self.clamped += 1
            return self._voltage

    def voltage(self, now: float) -> float:
        """What the motor gets at `now` (s): the last command, or 0 V once it is as old as the timeout."""
        with self._lock:
            if self._last is not None and not self.timed_out and now - self._last >= self._timeout:
                self.timed_out = True
                self.timeouts += 1
                self.age_at_zero = now - self._last
                self._voltage = 0.0
            return self._voltage

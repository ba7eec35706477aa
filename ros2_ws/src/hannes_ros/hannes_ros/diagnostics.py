"""Health of a node on /diagnostics, once a second of wall time.

`Health` only counts; it has no clock and no ROS. `Diagnostics` publishes it with a steady timer, so that it also works
while simulated time stands still.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from .topics import diagnostics_publisher

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)

MISSED_WARN, MISSED_ERROR = 0.01, 0.1
"""Share of missed cycles from which a node warns, and from which it reports an error."""

SILENT_S = 1.0
"""s of wall time without a message after which an input that was there counts as stopped: 100 samples of the slowest
EMG, and more than a busy machine keeps a node waiting. A reference that stands still is published all the same."""


def silence(heard: Mapping[str, float]) -> str | None:
    """Which inputs have stopped, and for how long; None if none has.

    heard  topic -> time of its latest message, s of `time.monotonic`
    """
    now = monotonic()
    stopped = [f"{topic} for {now - at:.1f} s" for topic, at in heard.items() if now - at > SILENT_S]
    return f"no {', no '.join(stopped)}" if stopped else None


class Health:
    """Counters of a node: cycles done and missed, last input, and named events (timeouts, rejected messages)."""

    def __init__(self, *events: str) -> None:
        self.cycles = 0
        self.missed = 0
        self.last_input: float | None = None
        self.counts: dict[str, int] = dict.fromkeys(events, 0)

    def count(self, event: str, by: int = 1) -> None:
        """An event of that name happened."""
        self.counts[event] = self.counts.get(event, 0) + by


class Rate:
    """Cycles a second between two looks at a counter."""

    def __init__(self, now: float) -> None:
        self._then, self._cycles = now, 0

    def update(self, now: float, cycles: int) -> float:
        """Rate (1/s) since the last update."""
        elapsed = max(now - self._then, 1e-9)
        rate = (cycles - self._cycles) / elapsed
        self._then, self._cycles = now, cycles
        return rate


def missed_level(done: int, missed: int) -> bytes:
    """Level of a loop that did and missed so many cycles lately."""
    share = missed / max(1, done + missed)
    return ERROR if share > MISSED_ERROR else WARN if share > MISSED_WARN else OK


class Diagnostics:
    """Publishes the health of one node.

    state   called for each report: (level, message, further values); may set `health.missed`
    A loop that missed more cycles than MISSED_WARN or MISSED_ERROR since the last report raises the level.
    """

    def __init__(
        self,
        node: Node,
        health: Health,
        state: Callable[[], tuple[bytes, str, Mapping[str, object]]],
        period: float = 1.0,
    ) -> None:
        self._node, self._health, self._state = node, health, state
        self._publisher = diagnostics_publisher(node)
        self._rate = Rate(monotonic())
        self._before = (0, 0)
        self._timer = node.create_timer(period, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Report now."""
        now, health = monotonic(), self._health
        level, message, values = self._state()
        (done, missed), self._before = self._before, (health.cycles, health.missed)
        done, missed = health.cycles - done, health.missed - missed
        if missed_level(done, missed) > level:
            level, message = (
                missed_level(done, missed),
                f"{message}; missed {missed} of {done + missed} cycles",
            )
        age = "" if health.last_input is None else f"{now - health.last_input:.3f}"
        pairs: dict[str, object] = {
            "rate_hz": f"{self._rate.update(now, health.cycles):.1f}",
            "cycles": health.cycles,
            "missed_cycles": health.missed,
            "input_age_s": age,
            **health.counts,
            **values,
        }
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=message,
            hardware_id="hannes",
            values=[KeyValue(key=key, value=str(value)) for key, value in pairs.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)

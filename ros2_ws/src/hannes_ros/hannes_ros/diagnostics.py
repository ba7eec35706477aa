"""Health of a node on /diagnostics, once a second of wall time.

`Health` only counts, and holds the `Faults` of the inputs; it has no clock and no ROS. `Diagnostics` publishes it with
a steady timer, so that it also works while simulated time stands still.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from threading import Lock
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


SAY_AGAIN_S = 5.0
"""s of wall time between two lines of log about the same fault."""


class Faults:
    """What is wrong with a node's inputs: by name a level and a sentence; for any thread.

    A fault stands from `bad` to `good`, and in one report at least, so that a short one is seen too.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._standing: dict[str, tuple[bytes, str]] = {}
        self._new: set[str] = set()
        self._over: set[str] = set()
        self._said: dict[str, float] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._standing

    def bad(self, name: str, level: bytes, text: str) -> None:
        """That input was bad just now."""
        with self._lock:
            self._standing[name] = level, text
            self._new.add(name)
            self._over.discard(name)

    def good(self, name: str) -> None:
        """That input is good (again)."""
        if name not in self._standing:
            return
        with self._lock:
            if name in self._new:
                self._over.add(name)
            else:
                self._standing.pop(name, None)

    def report(self, now: float) -> list[tuple[bytes, str, bool]]:
        """(level, sentence, whether it is due in the log) of those that stand or were not reported yet."""
        with self._lock:
            due = {name for name in self._new if now - self._said.get(name, -SAY_AGAIN_S) >= SAY_AGAIN_S}
            self._said.update(dict.fromkeys(due, now))
            report = [(*fault, name in due) for name, fault in self._standing.items()]
            for name in self._over:
                del self._standing[name]
            self._new.clear()
            self._over.clear()
        return report


class Health:
    """Counters of a node: cycles done and missed, last input, named events (timeouts, rejected messages); faults."""

    def __init__(self, *events: str) -> None:
        self.cycles = 0
        self.missed = 0
        self.last_input: float | None = None
        self.counts: dict[str, int] = dict.fromkeys(events, 0)
        self.faults = Faults()

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


GAP_S = 0.2
"""s without a message after which a rate is counted anew: who was away for so long was silent, not slow."""


class Arrivals:
    """Rate of the messages of a topic by the times of their arrival, whenever it is looked at."""

    def __init__(self) -> None:
        self._first: float | None = None
        self._last = 0.0
        self._count = 0

    def came(self, now: float) -> None:
        """A message came at `now` (s, monotonic)."""
        if self._first is None or now - self._last > GAP_S:
            self._first, self._count = now, 0  # silence is no slow rate
        else:
            self._count += 1
        self._last = now

    def rate(self) -> float | None:
        """Rate (1/s) since the last look; None where too few came."""
        if self._first is None or not self._count:
            self._first = None
            return None
        rate = self._count / max(self._last - self._first, 1e-9)
        self._first, self._count = self._last, 0
        return rate


def missed_level(done: int, missed: int) -> bytes:
    """Level of a loop that did and missed so many cycles lately."""
    share = missed / max(1, done + missed)
    return ERROR if share > MISSED_ERROR else WARN if share > MISSED_WARN else OK


class Diagnostics:
    """Publishes the health of one node.

    state   called for each report: (level, message, further values); may set `health.missed`
    Faults of the inputs join the message, raise the level, and go to the log.
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
        for grade, text, due in health.faults.report(now):
            message = text if level == OK else f"{message}; {text}"
            level = max(level, grade)
            if due:
                self._log(grade, text)
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

    def _log(self, level: bytes, text: str) -> None:
        # two calls: rclpy takes one severity only from each line of code
        if level >= ERROR:
            self._node.get_logger().error(text)
        else:
            self._node.get_logger().warning(text)

"""Recording without ROS: when a message counts, what was lost, and when the bag is handed over.

With the computer's clock a message's log time is when it was received. With simulated time that would be
wrong by as much as the recorder lags behind, and in lock-step, where thousands of ticks pass in a second, by
many ticks; and the Float64 topics carry no stamp of their own. What orders the messages of all publishers on
one host is the time at which each was sent (the middleware's source timestamp). So a message counts at the
simulated time that held when it was sent: that of the latest /clock sent no later. In lock-step, where each tick
begins with /clock and is complete before the next begins, every message so gets exactly the time of its tick. That
/clock may come after the message, if it was lost and sent again; what was given out without it is counted.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from .cdr import stamp_at
from .reading import MISPLACED
from .writing import BagWriter

_CLOCKS_KEPT = 100_000
"""How far back, in /clock messages, a late message can still be placed."""


@dataclass(frozen=True)
class Received:
    """One serialised message and its times, ns: sent (by the publisher's clock), received by the middleware, and taken
    from it, which a recorder that was held up does late."""

    topic: str
    data: bytes
    sent_ns: int
    received_ns: int
    taken_ns: int


@dataclass
class SimulatedTimes:
    """Gives messages the simulated time that held when they were sent.

    clock_topic  topic of simulated time
    hold_ns      a message waits for the /clock after it at most this long (by `taken_ns`); it bounds what a
                 kill can take, but for what comes before the first /clock, which waits for it
    misplaced    messages that were given out before a /clock came that had been sent before them: they count too early
    ticks        messages of /clock so far
    went_back    how often it was earlier than the one before: another run has begun, or a player loops
    """

    clock_topic: str
    hold_ns: int = 120_000_000
    misplaced: int = 0
    ticks: int = 0
    went_back: int = 0
    _guessed: deque[int] = field(default_factory=lambda: deque(maxlen=_CLOCKS_KEPT))
    _waiting: list[Received] = field(default_factory=list)
    _sent: list[int] = field(default_factory=list)
    _values: list[int] = field(default_factory=list)

    def add(self, message: Received) -> None:
        """A message came in."""
        self._waiting.append(message)
        if message.topic == self.clock_topic:
            self.heard(message.data, message.sent_ns)

    def heard(self, clock: bytes, sent_ns: int) -> None:
        """A message of /clock came in, which alone is not to be recorded."""
        value = stamp_at(clock)
        if value is None:
            return
        place = bisect_right(self._sent, sent_ns)
        self._sent.insert(place, sent_ns)
        self._values.insert(place, value)
        self.ticks += 1
        if place == len(self._sent) - 1:  # of one that overtook another, nothing is known yet
            self.went_back += place > 0 and value < self._values[place - 1]
            self.misplaced += sum(sent >= sent_ns for sent in self._guessed)
            self._guessed.clear()
        if len(self._sent) > 2 * _CLOCKS_KEPT:
            del self._sent[:_CLOCKS_KEPT], self._values[:_CLOCKS_KEPT]

    @property
    def latest(self) -> int | None:
        """The latest simulated time, ns; None before the first /clock."""
        return self._values[-1] if self._values else None

    @property
    def waiting(self) -> int:
        return len(self._waiting)

    def release(self, now_ns: int, *, everything: bool = False) -> list[tuple[Received, int]]:
        """Messages whose time is known, with it (ns), in the order in which they were sent.

        now_ns      what was taken more than `hold_ns` before is given out with the latest time known
        everything  at the end of the recording
        """
        if not self._sent and not everything:
            return []
        latest, deadline = self._sent[-1] if self._sent else 0, now_ns - self.hold_ns
        ready: list[Received] = []
        waiting: list[Received] = []
        for message in self._waiting:
            known = everything or message.sent_ns <= latest
            given_up = not known and message.taken_ns <= deadline
            (ready if known or given_up else waiting).append(message)
            if given_up:
                self._guessed.append(message.sent_ns)
        self._waiting = waiting
        ready.sort(key=lambda message: (message.sent_ns, message.topic != self.clock_topic))
        return [(message, self._time_of(message)) for message in ready]

    def _time_of(self, message: Received) -> int:
        if not self._sent:
            return message.received_ns
        return self._values[max(0, bisect_right(self._sent, message.sent_ns) - 1)]


@dataclass
class LossCounter:
    """Messages of a topic that were sent but never arrived, by the publisher's numbers.

    Only for topics with one publisher: where a number comes again or goes back there are several, whose numbers cannot
    be told apart, and nothing is said.
    """

    last: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    shared: set[str] = field(default_factory=set)

    def saw(self, topic: str, number: int | None) -> None:
        """A message with this publication number (1, 2, ...) came in."""
        if number is None or topic in self.shared:
            return
        before = self.last.get(topic)
        self.last[topic] = number
        if before is not None and number <= before:
            self.shared.add(topic)
            self.lost.pop(topic, None)
        elif before is not None and number > before + 1:
            self.lost[topic] = self.lost.get(topic, 0) + number - before - 1


class Recorder:
    """Puts received messages into a bag.

    writer     where to
    simulated  None: log time = receive time
    """

    def __init__(self, writer: BagWriter, simulated: SimulatedTimes | None = None) -> None:
        self.writer = writer
        self.simulated = simulated
        self.losses = LossCounter()

    def take(self, topic: str, data: bytes, info: Mapping[str, Any], now_ns: int) -> None:
        """A message came in, with the middleware's information on it (rclpy's message info), at `now_ns`."""
        received = info.get("received_timestamp") or now_ns
        sent = info.get("source_timestamp") or received
        self.losses.saw(topic, info.get("publication_sequence_number"))
        if self.simulated is None:
            self.writer.write(topic, data, received, sent)
        else:
            self.simulated.add(Received(topic, data, sent, received, now_ns))

    @property
    def misplaced(self) -> int:
        """Messages whose log time is too early, because /clock came later than they were held for."""
        return 0 if self.simulated is None else self.simulated.misplaced

    def hand_over(self, now_ns: int) -> None:
        """Give everything whose time is known to the operating system; what came in up to now_ns was taken."""
        self._write(now_ns, everything=False)
        self.writer.flush()

    def use_receive_times(self, now_ns: int) -> None:
        """There is no simulated time after all: what waits, and what comes, counts when it was received."""
        if self.simulated is not None:
            self._write(now_ns, everything=True, received=True)
            self.simulated = None

    def close(self, now_ns: int, more_metadata: Mapping[str, Any] | None = None) -> None:
        """Write what is left and close the bag; losses and wrong times are kept in its metadata, and what is given."""
        self._write(now_ns, everything=True)
        lost = {topic: count for topic, count in sorted(self.losses.lost.items()) if count}
        entries = {"lost_messages": lost, MISPLACED: self.misplaced}
        self.writer.close(
            {name: entry for name, entry in entries.items() if entry} | dict(more_metadata or {})
        )

    def _write(self, now_ns: int, *, everything: bool, received: bool = False) -> None:
        if self.simulated is not None:
            for message, log_ns in self.simulated.release(now_ns, everything=everything):
                if received:
                    self.writer.write(message.topic, message.data, message.received_ns, message.sent_ns)
                else:
                    self.writer.write(message.topic, message.data, max(0, log_ns))

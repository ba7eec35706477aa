"""Lock-step: the simulator waits for the command of each tick, so a run is deterministic and as fast as the machine.

One tick: hand_sim publishes reading k (motor/state stamped k x period, motor/current); emg_source publishes the samples
with time <= t_k; emg_reference answers with reference k; motor_controller answers with voltage k; hand_sim advances.
Only motor/state has a stamp, so the rest is matched by order: every topic is reliable and keeps the order of its
writer, and each node answers each motor/state with exactly one message. The n-th reading, the n-th current and the
n-th reference that a node receives therefore belong together (`TickJoin`).

Who comes late has not seen all of them. While hand_sim stands still and a newcomer is there, it repeats the reading
(`StallWatch`), and emg_reference repeats its answer. Repeated messages break the pairing by order, so a node that
starts, or sees a stamp again, pairs the newest of each topic, once none has come for SETTLE_S; then by order again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

_GIGA = 1_000_000_000

SETTLE_S = 0.05
"""s of wall time without a message after which all repetitions of a tick have arrived."""


def stamp_of_tick(tick: int, period_ns: int) -> int:
    """Stamp of a tick, ns."""
    return tick * period_ns


def samples_until(stamp_ns: int, rate: int) -> int:
    """How many samples of a signal at `rate` Hz (integer), sampled at j / rate from 0 on, have a time <= the stamp."""
    return stamp_ns * rate // _GIGA + 1


class TickJoin:
    """Joins the messages of one tick from several topics by their order.

    slots  number of topics; slot 0 is the one with the stamp
    Until `synchronise` is called (at the first answer) each slot keeps only its newest message, because a newcomer
    may have missed older ones; from then on the n-th message of each slot belongs to the n-th of the others.
    """

    def __init__(self, slots: int) -> None:
        self._slots = slots
        self._queues: list[deque[Any]] = []
        self.reset()

    def reset(self) -> None:
        """Forget everything; pair the newest again."""
        self._queues = [deque(maxlen=1) for _ in range(self._slots)]

    @property
    def synchronised(self) -> bool:
        """Whether messages are paired by order, not the newest of each."""
        return self._queues[0].maxlen is None

    def rejoin(self) -> None:
        """Messages were repeated: keep the newest of each, and pair the newest until `synchronise`."""
        self._queues = [deque(queue, maxlen=1) for queue in self._queues]

    def synchronise(self) -> None:
        """From here on pair strictly by order."""
        if not self.synchronised:
            self._queues = [deque(queue) for queue in self._queues]

    def put(self, slot: int, item: Any) -> None:
        """A message of that slot."""
        self._queues[slot].append(item)

    def take(self) -> list[Any] | None:
        """One message of each slot, or None while one is missing."""
        if all(self._queues):
            return [queue.popleft() for queue in self._queues]
        return None

    def missing(self) -> list[int]:
        """Slots without a message, while another slot has one."""
        return [slot for slot, queue in enumerate(self._queues) if not queue]


class Peers:
    """Which peers a node needs before it may answer, and whether they are all there.

    needed  description of the peer -> (how many are matched now, how many are needed)
    Once complete it stays complete: a peer that dies later is the watch's business.
    """

    def __init__(self, needed: dict[str, tuple[Callable[[], int], int]]) -> None:
        self._needed = needed
        self.complete = False

    def missing(self) -> list[str]:
        """Descriptions of those that are not there yet; empty from the first time that all are there."""
        if self.complete:
            return []
        absent = [name for name, (count, needed) in self._needed.items() if count() < needed]
        self.complete = not absent
        return absent


class StallWatch:
    """Notices, in wall time, that a tick is not answered, and when a reading must be repeated to a newcomer.

    timeout  s after which a tick counts as stalled
    repeat   s between repetitions while a newcomer has not led to an answer
    """

    def __init__(self, timeout: float, repeat: float = 0.5) -> None:
        self._timeout, self._repeat = timeout, repeat
        self._since = 0.0
        self._newcomer = False
        self._repeated = 0.0
        self.stalled = False
        self.stalls = 0

    def published(self, now: float) -> None:
        """A new tick was published at `now` (s, monotonic)."""
        self._since = self._repeated = now
        # After a stall the newcomer may still be out of step: it keeps its right to repetitions for one more tick.
        self._newcomer = self._newcomer and self.stalled
        self.stalled = False

    def newcomer(self) -> None:
        """A new subscriber of a part of the reading was matched."""
        self._newcomer = True

    def check(self, now: float) -> bool:
        """Whether the reading is to be repeated now; updates `stalled` and `stalls`."""
        if now - self._since < self._timeout:
            return False
        if not self.stalled:
            self.stalled = True
            self.stalls += 1
        if self._newcomer and now - self._repeated >= self._repeat:
            self._repeated = now
            return True
        return False

    def waiting(self, now: float) -> float:
        """Seconds since the tick was published."""
        return now - self._since

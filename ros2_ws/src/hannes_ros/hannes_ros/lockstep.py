"""Lock-step: the simulator waits for the command of each tick, so a run is deterministic and as fast as the machine.

One tick: hand_sim publishes reading k (motor/state stamped k x period, motor/current); emg_source publishes the samples
with time <= t_k; emg_reference answers with reference k; motor_controller answers with voltage k; hand_sim advances.
Only motor/state has a stamp, so the rest is matched by order: every topic is reliable and keeps the order of its
writer, and each node answers each motor/state with exactly one message. The n-th reading, the n-th current and the
n-th reference that a node receives therefore belong together (`TickJoin`).

Who comes late has not seen all of them. While hand_sim stands still and a newcomer is there, it repeats the reading
(`StallWatch`), and emg_reference repeats its answer. Repeated messages break the pairing by order, so a node that
starts, or sees a stamp again, pairs the newest of each topic, once none has come for SETTLE_S; then by order again.

No message can be ahead of the tick that is being answered: the next reading comes after its command. What is left over
from a tick, and is no repetition, is therefore of another source, and from there on each message of its topic meets the
tick after its own. `Probe` looks for that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher

_GIGA = 1_000_000_000

SETTLE_S = 0.05
"""s of wall time without a message after which all repetitions of a tick have arrived."""


TOGETHER = 250
"""Ticks after which hand_sim looks whether all who listen have what it sent."""

UNHEARD_S = 0.1
"""s of wall time that it waits for that: a listener that was killed stays matched for a while."""


def stamp_of_tick(tick: int, period_ns: int) -> int:
    """Stamp of a tick, ns."""
    return tick * period_ns


def samples_until(stamp_ns: int, rate: int) -> int:
    """How many samples of a signal at `rate` Hz (integer), sampled at j / rate from 0 on, have a time <= the stamp."""
    return stamp_ns * rate // _GIGA + 1


class Pace:
    """Keeps lock-step from outrunning who listens without answering, such as a recorder.

    Each node answers each tick, so those of the loop cannot fall behind; but a publisher keeps a limited number of
    messages, and what a slow listener has not got by then is lost.  So all wait until it has caught up, which it says
    at the next heartbeat of the middleware (0.02 s with this project's profile), or for UNHEARD_S: one that was stopped
    loses messages all the same.

    outputs  the first one is that which all of the loop hear
    """

    def __init__(self, *outputs: Publisher) -> None:
        self._outputs = outputs

    def after(self, tick: int) -> None:
        """Called after each tick was published.

        Each TOGETHER ticks it returns when all listeners have got what was sent, or after UNHEARD_S for each output.
        A controller alone needs no such wait.
        """
        if tick % TOGETHER == 0 and self._outputs[0].get_subscription_count() > 1:
            for output in self._outputs:
                output.wait_for_all_acked(Duration(seconds=UNHEARD_S))


class Probe:
    """Says when a tick is held for HOLD_S before it is answered, so that a message too many shows.

    On a running graph it does not show: the tick that meets the message too many is answered at once, and each later
    message meets the tick after its own. While a tick is held, its own message comes too, and is left over.
    A tick is held when a second source comes or one goes, and each REPEAT_S while there are several.

    several  whether an input has several publishers
    """

    HOLD_S = 0.02
    REPEAT_S = 1.0

    def __init__(self, several: Callable[[], bool]) -> None:
        self._several = several
        self._since: float | None = None
        self._asked = 0.0
        self.due = False

    def on_match(self, status: Any) -> None:
        """A publisher of an input was found or lost."""
        self.due = self.due or status.current_count > 1 or status.current_count_change < 0

    @property
    def held(self) -> bool:
        """Whether a tick is held."""
        return self._since is not None

    def holds(self) -> bool:
        """A tick is complete: whether its answer has to wait for `over`."""
        if self._since is None and self.due:
            self.due, self._since = False, monotonic()
        return self.held

    def over(self) -> bool:
        """Called often: whether a held tick is to be looked at, and answered, now."""
        now = monotonic()
        if self._since is not None:
            if now - self._since < self.HOLD_S:
                return False
            self._since = None
            return True
        if now - self._asked >= self.REPEAT_S:
            self._asked = now
            self.due = self.due or self._several()
        return False


class TickJoin:
    """Joins the messages of one tick from several topics by their order.

    slots    number of topics; slot 0 is the one with the stamp
    longest  so many messages a slot may hold, or be ahead of another while the newest are paired
    surplus  a slot that held more; None if there is none
    Until `synchronise` is called (at the first answer) each slot keeps only its newest message, because a newcomer
    may have missed older ones; from then on the n-th message of each slot belongs to the n-th of the others.
    """

    def __init__(self, slots: int, longest: int = 200) -> None:
        self._slots, self._longest = slots, longest
        self._queues: list[deque[Any]] = []
        self._came: list[int] = []
        self.surplus: int | None = None
        self.reset()

    def reset(self) -> None:
        """Forget everything; pair the newest again."""
        self._begin([deque(maxlen=1) for _ in range(self._slots)])

    def _begin(self, queues: list[deque[Any]]) -> None:
        self._queues, self._came, self.surplus = queues, [0] * self._slots, None

    @property
    def synchronised(self) -> bool:
        """Whether messages are paired by order, not the newest of each."""
        return self._queues[0].maxlen is None

    def rejoin(self) -> None:
        """Messages were repeated: keep the newest of each, and pair the newest until `synchronise`."""
        self._begin([deque(queue, maxlen=1) for queue in self._queues])

    def synchronise(self) -> None:
        """From here on pair strictly by order."""
        if not self.synchronised:
            self._begin([deque(queue) for queue in self._queues])

    def put(self, slot: int, item: Any) -> None:
        """A message of that slot."""
        self._queues[slot].append(item)
        self._came[slot] += 1
        others = 0 if self.synchronised else min(self._came)
        if self._came[slot] - others > self._longest:
            self.surplus = slot

    @property
    def complete(self) -> bool:
        """Whether there is a message of each slot."""
        return all(self._queues)

    @property
    def left_over(self) -> int | None:
        """A slot with more messages than the complete tick needs."""
        return next((slot for slot, queue in enumerate(self._queues) if len(queue) > 1), None)

    def take(self) -> list[Any] | None:
        """One message of each slot, or None while one is missing."""
        if not self.complete:
            return None
        tick = [queue.popleft() for queue in self._queues]
        self._came = [len(queue) for queue in self._queues]
        return tick

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

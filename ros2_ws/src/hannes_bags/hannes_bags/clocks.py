"""Bringing log times and header stamps onto one clock.

A bag knows two times of a message: the log time, at which the recorder received it, and, for some types, the
header stamp, at which it was measured. Messages without a header (the Float64 topics) have only the log time.
If the recorder ran on the computer's clock while the stamps are simulated time (or another computer's clock),
the two do not compare: the log times are then carried over onto the clock of the stamps.

- same      the stamps are up to 20 ms before the log times: log times are used as they are.
- offset    the two run at one rate with a constant difference, and what was logged before it was measured was
            measured on another clock: the median difference is subtracted.
- warped    they run at different rates (a simulation faster or slower than real time): log times are
            interpolated between the pairs (log time, stamp) of the stamped topic. A header-less message then
            lies between the stamped messages around it, so its time is right to one period of that topic and
            no better.
- log       nothing is stamped: everything is on the recorder's clock.

A recorder that follows a slow /clock (`ros2 bag play --clock` has 40 Hz) gives one log time to all messages between two
of its ticks: those are spread over the tick in their order first (`spread`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]
Kind = Literal["log", "same", "offset", "warped"]

SAME_NS = 20_000_000
_EARLIEST_NS = -2_000_000
_STEADY_NS = 50_000_000


@dataclass(frozen=True)
class ClockRelation:
    """How log times are carried onto the clock of the stamps.

    kind       see the module's text
    offset_ns  median of log time - stamp
    topic      the stamped topic that decided it; "" if none
    log_ns, stamp_ns   (m,) increasing pairs, used if warped
    """

    kind: Kind
    offset_ns: int = 0
    topic: str = ""
    log_ns: IntArray | None = None
    stamp_ns: IntArray | None = None

    def apply(self, log_ns: IntArray) -> IntArray:
        """Log times (n,) ns on the clock of the stamps, ns."""
        if self.kind == "offset":
            return log_ns - self.offset_ns
        if self.kind != "warped" or self.log_ns is None or self.stamp_ns is None:
            return log_ns
        log0, stamp0 = int(self.log_ns[0]), int(self.stamp_ns[0])
        # Differences are small enough to be exact in double precision; absolute ns since 1970 are not.
        mapped = np.interp(
            (log_ns - log0).astype(np.float64),
            (self.log_ns - log0).astype(np.float64),
            (self.stamp_ns - stamp0).astype(np.float64),
        )
        return np.rint(mapped).astype(np.int64) + stamp0

    def sentence(self) -> str:
        """What was done, for the recording's warnings; "" if nothing had to be done."""
        if self.kind == "offset":
            return (
                f"The stamps of {self.topic} and the recorder's times are on different clocks, "
                f"{self.offset_ns * 1e-9:.3f} s apart at the median: the times of messages without a header were "
                "shifted by that much."
            )
        if self.kind == "warped":
            return (
                f"The stamps of {self.topic} and the recorder's times are on different clocks that run at different "
                "rates (simulated time against the computer's): messages without a header were placed between the "
                f"stamped messages around them, which is right to one period of {self.topic}. Record with simulated "
                "time (use_sim_time) to avoid it."
            )
        return ""


def spread(log_ns: IntArray) -> tuple[IntArray, int]:
    """Log times (n,) of one topic that come in steps, with the messages of a step spread over it, and the step in ns.

    As they are, with a step of 0, where most messages have a time of their own.  A message was logged at or after its
    time and before the next one; after a pause its step is one as usual.
    """
    if log_ns.size < 2 or np.median(np.abs(np.diff(log_ns))) > 0:
        return log_ns, 0
    begins = np.flatnonzero(np.concatenate([[True], np.diff(log_ns) != 0]))
    counts = np.diff(np.append(begins, log_ns.size))
    gaps = np.diff(log_ns[begins])
    if not (gaps > 0).any():
        return log_ns, 0
    step = int(np.median(gaps[gaps > 0]))
    room = np.append(np.clip(gaps, 0, step), step)
    number = np.arange(log_ns.size) - np.repeat(begins, counts)
    return log_ns + number * np.repeat(room, counts) // np.repeat(counts, counts), step


def relate(topic: str, stamp_ns: IntArray, log_ns: IntArray) -> ClockRelation:
    """Decide how the log times of a bag compare with the stamps (n,) of one of its topics."""
    difference = log_ns - stamp_ns
    offset = int(np.median(difference))
    if _EARLIEST_NS <= offset < SAME_NS:
        return ClockRelation("same", offset, topic)
    if np.quantile(np.abs(difference - offset), 0.95) < _STEADY_NS:
        return ClockRelation("offset", offset, topic)
    order = np.argsort(log_ns, kind="stable")
    log, stamp = log_ns[order], np.maximum.accumulate(stamp_ns[order])
    keep = np.concatenate([[True], np.diff(log) > 0])
    return ClockRelation("warped", offset, topic, log[keep], stamp[keep])

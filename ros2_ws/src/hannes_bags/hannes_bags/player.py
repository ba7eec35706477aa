"""Playing without ROS: which message is due when.

A bag is read once into memory, in the order of its log times. `Schedule` says which messages are due at a
given time; who calls it decides how time passes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from hannes_description.errors import HannesError

from . import cdr
from .mcap_file import Limits
from .storage import BagMessages, TopicEntry, locate

CLOCK_TOPIC = "/clock"
DIAGNOSTICS_TOPIC = "/diagnostics"


@dataclass(frozen=True)
class Playlist:
    """The messages of a bag in the order of their log times.

    topics   what is played, by name
    log_ns   (n,) never decreasing
    entries  n pairs (topic, CDR bytes)
    """

    topics: tuple[TopicEntry, ...]
    log_ns: npt.NDArray[np.int64]
    entries: tuple[tuple[str, bytes], ...]

    @property
    def duration(self) -> float:
        """s"""
        return float(self.log_ns[-1] - self.log_ns[0]) * 1e-9

    def without(self, names: Collection[str]) -> Playlist:
        """The same less some topics; it begins when it did."""
        kept = [k for k, (topic, _) in enumerate(self.entries) if topic not in names]
        return Playlist(
            tuple(entry for entry in self.topics if entry.name not in names),
            self.log_ns[kept],
            tuple(self.entries[k] for k in kept),
        )

    def ticks(self) -> Iterator[tuple[int, tuple[tuple[str, bytes], ...]]]:
        """(log time ns, messages) for each distinct log time."""
        starts = np.flatnonzero(np.concatenate([[True], np.diff(self.log_ns) > 0]))
        ends = [*starts[1:].tolist(), len(self.entries)]
        for start, end in zip(starts.tolist(), ends, strict=True):
            yield int(self.log_ns[start]), self.entries[start:end]


def load_playlist(
    path: str | Path,
    *,
    topics: Collection[str] = (),
    start: float = 0.0,
    clock: bool = False,
    limits: Limits | None = None,
) -> Playlist:
    """Read what is to be played.

    topics  names of the topics to play; if empty, all but /diagnostics, which would tell of nodes that run now;
            /clock is among them only where it is named and `clock`: else the player makes it itself
    start   s to skip at the beginning
    Raises HannesError: unreadable bag, unknown topic, nothing left to play.
    """
    messages = BagMessages(locate(path), limits or Limits())
    times: list[int] = []
    entries: list[tuple[str, bytes]] = []
    for topic, logged, data in messages:
        if topic == CLOCK_TOPIC and not (clock and topic in topics):
            continue
        if topic in topics if topics else topic != DIAGNOSTICS_TOPIC:
            times.append(logged)
            entries.append((topic, bytes(data)))
    missing = sorted(set(topics) - set(messages.types) - (set() if clock else {CLOCK_TOPIC}))
    if missing:
        raise HannesError(
            f"The bag {path} has no topic {', '.join(missing)}. It has: {', '.join(sorted(messages.types))}."
        )
    if not times:
        raise HannesError(f"The bag {path} holds no message to play.")
    log_ns: npt.NDArray[np.int64] = np.array(times, dtype=np.int64)
    order = np.argsort(log_ns, kind="stable")
    order = order[log_ns[order] >= log_ns[order[0]] + round(start * 1e9)]
    if not order.size:
        raise HannesError(
            f"The bag {path} lasts {(log_ns.max() - log_ns.min()) * 1e-9:.3f} s; nothing is left after {start} s."
        )
    played = {topic for topic, _ in entries}
    return Playlist(
        tuple(entry for entry in messages.entries() if entry.name in played),
        log_ns[order],
        tuple(entries[k] for k in order),
    )


class Schedule:
    """Walks a playlist in played time.

    rate  played seconds in a second; with 0 every message is due at once
    loop  begin again at the end; simulated time then goes on growing by the playlist's length and one period
    """

    def __init__(self, playlist: Playlist, rate: float = 1.0, *, loop: bool = False) -> None:
        if not rate >= 0.0 or rate == float("inf"):
            raise HannesError(
                f"The rate of playing is {rate}; it must be a number >= 0 (0: as fast as possible)."
            )
        self._playlist = playlist
        self._rate = rate
        self._loop = loop
        self._ticks = playlist.ticks()
        self._next = next(self._ticks, None)
        self._shift = 0
        self._stamped = _stamped(playlist) if loop else frozenset()
        self.round = 0
        self.first_ns = int(playlist.log_ns[0])
        gaps = np.diff(np.unique(playlist.log_ns))
        self._length = (
            int(playlist.log_ns[-1]) - self.first_ns + (int(np.median(gaps)) if gaps.size else 1_000_000)
        )

    @property
    def done(self) -> bool:
        return self._next is None

    def time_at(self, elapsed: float) -> int:
        """Simulated time (ns) after `elapsed` s of playing."""
        return self.first_ns + round(elapsed * self._rate * 1e9)

    def due(self, elapsed: float, at_most: int = 1000) -> list[tuple[int, tuple[tuple[str, bytes], ...]]]:
        """The ticks (simulated time ns, messages) that are due after `elapsed` s, at most so many at once."""
        now = self._due_until(elapsed)
        ticks: list[tuple[int, tuple[tuple[str, bytes], ...]]] = []
        while self._next is not None and len(ticks) < at_most:
            log_ns, messages = self._next
            if log_ns + self._shift > now:
                break
            ticks.append((log_ns + self._shift, self._restamped(messages)))
            self._next = next(self._ticks, None)
            if self._next is None and self._loop:
                self.round += 1
                self._shift += self._length
                self._ticks = self._playlist.ticks()
                self._next = next(self._ticks, None)
        return ticks

    def is_due(self, elapsed: float) -> bool:
        """Whether a tick is due after `elapsed` s."""
        return self._next is not None and self._next[0] + self._shift <= self._due_until(elapsed)

    def _due_until(self, elapsed: float) -> float:
        return math.inf if self._rate == 0.0 else self.time_at(elapsed)

    def _restamped(self, messages: tuple[tuple[str, bytes], ...]) -> tuple[tuple[str, bytes], ...]:
        """From the second round on, the stamps go on growing with the clock."""
        if not self._shift:
            return messages
        return tuple(
            (topic, cdr.shift_stamp(data, self._shift) if topic in self._stamped else data)
            for topic, data in messages
        )


def _stamped(playlist: Playlist) -> frozenset[str]:
    """Topics whose messages are stamped: at least one of them, as the first tick of a lock-step has the stamp 0."""
    types = cdr.stamped_types()
    may_be = {entry.name for entry in playlist.topics if entry.type in types}
    return frozenset(topic for topic, data in playlist.entries if topic in may_be and cdr.stamp_at(data))

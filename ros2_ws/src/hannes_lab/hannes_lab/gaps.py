"""Stretches of a recording without samples: which are bridged, which hide something, and what is said of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Span = tuple[float, float]

LONGEST_GAP = 5.0
LEAST_GAP = 0.05
"""Steps of a signal without a sample that are bridged by interpolation, and s that are in any case."""

SHORT = 2.5
"""Steps of a signal without a sample from which it is said to miss some in a closure that is unlike the others."""

MOVES = 0.04
"""A reference moves where it goes beyond this part of its span: noise crosses the limit of rest many times while it
leaves."""

FOLLOWED = 0.25
"""Part of the reference's span that an encoder goes over in a gap of it where there was something to follow."""

MOST_GUESSED = 0.5
"""Part of the closures up to which those whose reference is guessed are left out: a reference that is logged only when
it jumps is guessed in all of them."""

MOST_TOLD = 4
"""Gaps that are told one by one."""

LOST = 0.08
BY_CHANCE = 0.3
"""Part of a signal's messages from which on it is said that they are lost, and part of the steps of three and more that
losses by chance make of it: a logger that asks at a rate of its own leaves out one at a time, in turn."""

WHOLE = 0.2
IN_STEP = 0.95
"""Part of its usual step by which a step may miss a whole number of them, and part of the steps that must be such: else
a signal is logged irregularly, and nothing is lost."""


def misses_samples(time: Array, start: float, stop: float) -> bool:
    """True where a signal has no sample for longer than it usually has, though not so long as to be a gap."""
    steps = np.diff(time[(time >= start) & (time <= stop)])
    return bool(steps.size) and float(steps.max()) > SHORT * float(np.median(np.diff(time)))


def has_gap(time: Array, start: float, stop: float) -> bool:
    """True where a signal has no sample for longer than a few of its steps, and long enough to hide something.

    A gap may begin before the stretch or end after it: what lies within counts.
    """
    if np.count_nonzero((time >= start) & (time <= stop)) < 2:
        return True
    first = max(0, int(np.searchsorted(time, start, side="right")) - 1)
    after = int(np.searchsorted(time, stop)) + 1
    return float(np.diff(np.clip(time[first:after], start, stop)).max()) > _longest_step(time)


def _longest_step(time: Array) -> float:
    """Longest time between two samples that is bridged, s."""
    return max(LONGEST_GAP * float(np.median(np.diff(time))), LEAST_GAP)


def widest_gap(times: Mapping[str, Array]) -> str:
    """Which signal has no sample for the longest, and where, as the end of a sentence."""
    name, k, seconds = max(
        ((n, int(np.argmax(np.diff(t))), float(np.diff(t).max())) for n, t in times.items() if t.size > 1),
        key=lambda gap: gap[2],
        default=("", 0, 0.0),
    )
    return f"; '{name}' has none for {seconds:.3g} s after {times[name][k]:.6g} s" if name else ""


def _gaps(time: Array) -> list[Span]:
    """Begin and end [s] of every gap that is not bridged."""
    if time.size < 3:
        return []
    return [(float(time[k]), float(time[k + 1])) for k in np.flatnonzero(np.diff(time) > _longest_step(time))]


def split_gaps(time: Array, samples: Mapping[str, tuple[Array, Array]]) -> tuple[list[Span], list[Span]]:
    """Gaps of the reference in which every signal has one too, and the others."""
    of_signals = [_gaps(t) for t, _ in samples.values()]
    silent: list[Span] = []
    alone: list[Span] = []
    for a, b in _gaps(time):
        both = all(any(c < b and a < d for c, d in gaps) for gaps in of_signals)
        (silent if both else alone).append((a, b))
    return silent, alone


def guessed(
    gaps: Sequence[Span], reference: tuple[Array, Array], encoder: tuple[Array, Array] | None
) -> list[Span]:
    """The gaps of the reference alone in which it moves; one that stands, and the hand with it, may be logged only when
    it changes."""
    time, values = reference
    span = float(np.ptp(values))

    def moves(a: float, b: float) -> bool:
        if abs(float(np.diff(np.interp([a, b], time, values))[0])) > MOVES * span:
            return True
        done = encoder[1][(encoder[0] > a) & (encoder[0] < b)] if encoder is not None else np.zeros(0)
        return bool(done.size) and float(np.ptp(done)) > FOLLOWED * span

    return [gap for gap in gaps if moves(*gap)]


def within(gaps: Sequence[Span], start: float, stop: float) -> list[Span]:
    """What lies of gaps within a stretch."""
    return [(max(a, start), min(b, stop)) for a, b in gaps if a < stop and start < b]


def said_of_gaps(silent: Sequence[Span], guesses: Sequence[Span]) -> list[str]:
    """Notes on gaps of the reference: those in which every signal has one too, and those in which it is guessed."""
    notes = []
    for gaps, begin, end in (
        (silent, "nothing was recorded from", "what was there is not known"),
        (guesses, "reference_position has no sample from", "it is guessed there"),
    ):
        if gaps:
            told = ", ".join(f"{a:.2f} to {b:.2f} s" for a, b in gaps[:MOST_TOLD])
            more = f" and in {len(gaps) - MOST_TOLD} more places" if len(gaps) > MOST_TOLD else ""
            notes.append(f"{begin} {told}{more}: {end}")
    return notes


def lost_part(time: Array) -> float:
    """Part of a signal's messages that are lost: its steps are whole numbers of the usual one, some two or more.

    0 where it is logged irregularly, where next to nothing is lost, and for what is a gap.
    """
    steps = np.diff(time)
    steps = steps[steps <= _longest_step(time)] if steps.size > 2 else steps[:0]
    if not steps.size:
        return 0.0
    taken = steps / float(np.quantile(steps, 0.2, method="nearest"))
    whole = np.maximum(np.round(taken), 1.0)
    if np.mean(np.abs(taken - whole) <= WHOLE) < IN_STEP:
        return 0.0
    lost = float(np.sum(whole - 1.0))
    part = lost / (lost + steps.size)
    in_turn = np.mean(whole >= 3.0) < BY_CHANCE * part**2
    return 0.0 if part < LOST or in_turn else part


def said_of_losses(times: Mapping[str, Array]) -> list[str]:
    """A note on the signals of which messages are lost."""
    parts = {name: lost_part(time) for name, time in times.items()}
    told = ", ".join(f"{100.0 * part:.0f} % of {name}" for name, part in parts.items() if part)
    return [
        f"messages seem to be lost: {told} (steps of two and more of the usual one); what is between is interpolated: "
        "record on the machine that publishes them, or reliably"
    ] * bool(told)

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

MOST_TOLD = 4
"""Gaps that are told one by one."""

LOST = 0.08
"""Part of a signal's messages from which on it is said that they are lost."""

WHOLE = 0.2
IN_STEP = 0.95
"""Part of its usual step by which a step may miss a whole number of them, and part of the steps that must be such: else
a signal is logged irregularly, and nothing is lost."""

ONE_STEP = (0.15, 0.02)
TWO_STEPS = (0.25, 0.01)
GAPS = (3.0, 3.0)
"""How far parts of steps may be from those that losses by chance make, as parts of these and beyond that: the steps of
one, of two, and the number of gaps.  What a logger leaves out that asks at a rate of its own, rounds its stamps, sends
in bursts or only what changes is distributed otherwise."""

FEWEST_STEPS = 50
"""Steps of a signal below which nothing is said of losses."""

REGULARLY = 3
"""Equal neighbours from which on a reference was logged while it stood, and not only where it changes."""


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


def _moves(
    gap: Span, part: float, reference: tuple[Array, Array], encoder: tuple[Array, Array] | None
) -> bool:
    """Whether over a gap the reference changes by a part of its span, or the encoder by FOLLOWED of it within."""
    (time, values), (a, b) = reference, gap
    span = float(np.ptp(values))
    if abs(float(np.diff(np.interp([a, b], time, values))[0])) > part * span:
        return True
    done = encoder[1][(encoder[0] > a) & (encoder[0] < b)] if encoder is not None else np.zeros(0)
    return bool(done.size) and float(np.ptp(done)) > FOLLOWED * span


def guessed(
    gaps: Sequence[Span], reference: tuple[Array, Array], encoder: tuple[Array, Array] | None
) -> list[Span]:
    """The gaps of the reference alone in which it moves; one that stands, and the hand with it, may be logged only when
    it changes."""
    return [gap for gap in gaps if _moves(gap, MOVES, reference, encoder)]


def without_guessed(
    spans: Sequence[Span],
    gaps: Sequence[Span],
    reference: tuple[Array, Array],
    encoder: tuple[Array, Array] | None,
) -> list[Span]:
    """The closures without those of which gaps hide much of the reference; all, if it is logged only where it changes
    or hidden in each."""
    if np.count_nonzero(np.diff(reference[1]) == 0.0) < REGULARLY:
        return list(spans)
    known = [
        (start, stop)
        for start, stop in spans
        if not any(
            _moves((max(a, start), min(b, stop)), FOLLOWED, reference, encoder)
            for a, b in gaps
            if a < stop and start < b
        )
    ]
    return known or list(spans)


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
    """Part of a signal's messages that are lost by chance: its steps are whole numbers of the usual one, and with a
    part p lost 1 - p of them are one, p (1 - p) two, and at most p^4 more than is bridged (LONGEST_GAP).

    0 where they are not.
    """
    time = np.unique(time)
    steps = np.diff(time)
    if steps.size < FEWEST_STEPS:
        return 0.0
    short = steps[steps <= _longest_step(time)]
    taken = short / float(np.quantile(short, 0.2, method="nearest"))
    whole = np.maximum(np.round(taken), 1.0)
    if np.mean(np.abs(taken - whole) <= WHOLE) < IN_STEP:
        return 0.0
    lost = float(np.sum(whole - 1.0))
    part = lost / (lost + short.size)

    def differ(found: float, expected: float, of: float, limits: tuple[float, float]) -> bool:
        return abs(found - expected) > limits[0] * of + limits[1]

    one, two = (float(np.mean(whole == count)) for count in (1.0, 2.0))
    twice, gaps = part * (1.0 - part), steps.size * part ** (LONGEST_GAP - 1.0)
    by_chance = not (
        differ(one, 1.0 - part, part, ONE_STEP)
        or differ(two, twice, twice, TWO_STEPS)
        or steps.size - short.size > GAPS[0] * gaps + GAPS[1]
    )
    return part if by_chance and part >= LOST else 0.0


def said_of_losses(times: Mapping[str, Array]) -> list[str]:
    """A note on the signals of which messages are lost."""
    parts = {name: lost_part(time) for name, time in times.items()}
    told = ", ".join(f"{100.0 * part:.0f} % of {name}" for name, part in parts.items() if part)
    return [
        f"messages seem to be lost: {told} (steps of two and more of the usual one); what is between is interpolated: "
        "record on the machine that publishes them, or reliably"
    ] * bool(told)

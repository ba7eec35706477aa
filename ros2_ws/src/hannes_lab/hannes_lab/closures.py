"""The closures of a reference: where each begins and ends, and which of them repeat one condition.

A closure is a stretch in which the reference leaves its rest value and comes back, or a move between two stands.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .gaps import MOVES
from .reference import RESTS, rest_value, true_runs
from .trials import Closure

Array = NDArray[np.float64]

ALIKE = 0.1
"""Closures of which the moving parts differ in length by less than this part are taken to leave their rest alike."""

LEFT = 1e-3
"""It leaves from where it was last within this part of its span, or its own noise, of where it rests."""

SAME_KIND = 0.03
"""Part of the smaller span within which the references of closures of one condition are alike."""

USUAL = 0.8
"""Part of its condition's usual length that a closure has at least; of less it was cut off."""

PART = 0.3
"""The same of less than which it is not known what it was part of: it is a condition of its own."""

MIDDLES = 30
"""Closures of which one is looked for that most others are like; of more, some at even distances."""

MOVING = 2.0
DIGIT = 0.25
"""A move between two stands is so many times faster than they are somewhere; and speeds are taken over so many samples
that one last digit of the reference makes this part of a stand's limit: written with few digits it moves in steps."""

STILL = 1e-6
"""Part of a stand's limit up to which a speed is what rounding errors make of standing."""


def find_closures(reference: Array, period: float, *, lead: float = 0.03) -> list[tuple[float, float]]:
    """Start and stop [s] of every stretch from one departure of the reference to the next.

    A closure starts `lead` seconds before the reference leaves its rest, which is seen where it has moved by 2 % of its
    span, and lasts until the next one starts (the rest after it belongs to it: the hand is still opening), at most as
    long again as its moving part.
    A stretch in which the recording begins or ends while the reference moves is given with its end at its start: it is
    no closure.
    """
    span = float(np.ptp(reference))
    if span <= 0.0:
        return []
    away = np.abs(reference - rest_value(reference))
    runs = [
        (first, last)
        for first, last in true_runs(away > RESTS * span)
        if last - first >= 3 and away[first : last + 1].max() > MOVES * span
    ]
    begins = [0, *(last for _, last in runs)]
    rests = [away[begin : first + 1] for begin, (first, _) in zip(begins, runs, strict=False)]
    level = _rest_level(rests, span)
    end = (reference.size - 1) * period
    since = np.array([_since(rest, level) for rest in rests])
    lengths = np.array([last - first for first, last in runs])
    # Of closures that last alike together: noise moves the one much, and the crossing of 2 % hardly.
    alike = [np.abs(lengths - length) <= ALIKE * length for length in lengths]
    starts = [
        (first - float(np.median(since[own]))) * period - lead
        for (first, _), own in zip(runs, alike, strict=True)
    ]
    out = []
    for k, (first, last) in enumerate(runs):
        seen, gone = first * period, last * period
        if seen <= 0.0 or gone >= end:
            out.append((starts[k], starts[k]))
            continue
        until = starts[k + 1] if k + 1 < len(runs) else end
        out.append((starts[k], min(until, gone + (gone - seen))))
    return out


def _rest_level(rests: Sequence[Array], span: float) -> float:
    """How far from its rest value a reference may be that rests, by the stretches in which it does.

    One level for all: closures that repeat each other begin at the same place.
    """
    if not rests:
        return 0.0
    low, middle = np.quantile(np.concatenate(rests), (0.1, 0.5))
    return float(low + max(LEFT * span, 3.0 * (middle - low)))


def _since(rest: Array, level: float) -> int:
    """Ticks from where a reference, so far from its rest value (n,), was last within a level to the last one.

    A soft start is seen late, and what precedes it would count as the end of the closure before: of all but the last.
    """
    within = np.flatnonzero(rest <= max(level, float(rest.min())))
    return rest.size - 1 - int(within[-1])


def find_moves(reference: Array, period: float, *, slow: float = 0.1) -> list[tuple[float, float]]:
    """Start and stop [s] of every stretch between two moments at which the reference (nearly) stands.

    A stand is a run whose speed is below `slow` times the greatest speed, and between two of them it goes twice as fast
    at least.  A move begins where its stand does; after a longer stand than the shortest one it begins that much before
    the reference sets off, so that moves which repeat each other begin alike.  For machines that move on from place to
    place instead of coming back to rest; stretches cut off at the ends are left out.
    """
    speed = _speed(reference, period, slow)
    limit = slow * float(speed.max())
    stands: list[tuple[int, int]] = []
    for first, last in true_runs(speed < limit):
        if stands and speed[stands[-1][1] : first].max() < MOVING * limit:
            first = stands.pop()[0]
        stands.append((first, last))
    still = [_stillest(speed[first : last + 1], first, STILL * limit) for first, last in stands]
    if len(still) < 2:
        return []
    # The last stand begins no move, and may be of any length.
    shortest = min(last - first for first, last in still[:-1])
    begins = [last - shortest for _, last in still]
    # What of a stand belongs to the move before it; after the last move there may be more.
    after = [last - shortest - first for first, last in still[1:-1]] or [0]
    begins[-1] = min(begins[-1], still[-1][0] + round(float(np.median(after))))
    return [(a * period, b * period) for a, b in itertools.pairwise(begins) if b - a >= 3]


def _speed(reference: Array, period: float, slow: float) -> Array:
    """Speed (n,) of a reference, over as many samples as one written with few digits needs."""
    steps = np.abs(np.diff(reference))
    greatest = float(np.abs(np.gradient(reference, period)).max())
    digit = float(steps[steps > 0.0].min()) if steps.any() else 0.0
    half = max(1, math.ceil(digit / (DIGIT * slow * greatest * period) / 2)) if greatest > 0.0 else 1
    index = np.arange(reference.size)
    before, after = np.maximum(index - half, 0), np.minimum(index + half, reference.size - 1)
    return np.asarray(np.abs(reference[after] - reference[before]) / ((after - before) * period))


def _stillest(speed: Array, offset: int, nearly: float) -> tuple[int, int]:
    """First and last index of the longest run of a stand (n,) in which the reference does not move at all.

    Of a turn without a rest, its slowest moment.

    nearly  speed that rounding errors may make of standing
    """
    longest = max(true_runs(speed <= speed.min() + nearly), key=lambda run: run[1] - run[0])
    return longest[0] + offset, longest[1] + offset


def group_closures(
    reference: Array, period: float, spans: Iterable[tuple[float, float]], name: str, step: float = 0.0
) -> list[Closure]:
    """Closures of which the reference is within 3 % (of the smaller one's span) of the one that most of them are like
    share a condition.

    What was broken off belongs to a condition that it is like as far as it goes.

    step  s between two samples of the logged reference: closures may begin anywhere between two
    Cut-off closures (less than 80 % of the usual length of their condition) are dropped.
    """
    spans = list(spans)
    shapes = [
        reference[np.clip(np.arange(round(start / period), round(stop / period) + 1), 0, reference.size - 1)]
        for start, stop in spans
    ]
    kinds = _kinds(shapes, step / period)
    out = []
    for index, members in enumerate(kinds):
        own = [spans[k] for k in members]
        usual = float(np.median([b - a for a, b in own]))
        label = name if len(kinds) == 1 else f"{name}.{index + 1}"
        out += [Closure(a, min(b, a + usual), label) for a, b in own if b - a >= USUAL * usual]
    return sorted(out, key=lambda closure: closure.start)


def _kinds(shapes: Sequence[Array], ticks: float) -> list[list[int]]:
    """Numbers of the references (n,) of closures that are the same, by kind, each kind in order of its first one.

    ticks  between two samples of the logged reference
    """
    slopes = [_change(shape, ticks) for shape in shapes]
    heights = [float(np.ptp(shape)) or 1.0 for shape in shapes]
    sizes = np.array([shape.size for shape in shapes])

    def apart(k: int, m: int) -> float:
        """Largest difference as far as both go, in what it may be; infinite beyond."""
        one, other, n = shapes[k], shapes[m], min(sizes[k], sizes[m])
        most = SAME_KIND * min(heights[k], heights[m]) + max(slopes[k], slopes[m]) + 1e-9
        few = max(1, n // 50)  # most that differ do so in a few samples already
        for some in (slice(0, n, few), slice(0, n)):
            largest = float(np.max(np.abs(one[some] - other[some])))
            if not largest <= most:
                return math.inf
        return largest / most

    @cache
    def away(k: int) -> Array:
        """How far all are from one, of those that last about as long."""
        near = np.minimum(sizes, sizes[k]) >= USUAL * np.maximum(sizes, sizes[k])
        return np.array([apart(k, m) if near[m] else math.inf for m in range(len(shapes))])

    def rank(k: int) -> tuple[int, float]:
        """How many of those that are left are like one, most first, and how much."""
        own = away(k)[left]
        like = own < math.inf
        return -int(like.sum()), float(own[like].sum())

    left = np.arange(len(shapes))
    kinds = []
    while left.size:
        some = left[np.unique(np.linspace(0, left.size - 1, min(left.size, MIDDLES)).astype(int))]
        middle = int(min(some, key=rank))
        own = away(middle)[left] < math.inf
        own |= left == middle
        kinds.append((middle, left[own].tolist()))
        left = left[~own]
    out: list[tuple[int, list[int]]] = []
    for middle, members in sorted(kinds, key=lambda kind: -sizes[kind[0]]):
        parted = [
            own
            for where, own in out
            if sizes[middle] >= PART * sizes[where] and apart(middle, where) < math.inf
        ]
        if parted:
            parted[0].extend(members)
        else:
            out.append((middle, members))
    return sorted(sorted(members) for _, members in out)


def _change(shape: Array, ticks: float) -> float:
    """Greatest change of a reference over this many ticks (rounded up)."""
    lag = math.ceil(ticks)
    return float(np.max(np.abs(shape[lag:] - shape[:-lag]))) if 0 < lag < shape.size else 0.0

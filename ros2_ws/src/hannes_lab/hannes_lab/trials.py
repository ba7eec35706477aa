"""From recordings to trials: the reference on the control grid, the closures, and which of them repeat one condition.

Nothing here knows that the machine is a hand: a closure is a stretch in which the reference leaves its rest value and
comes back; another machine's adapter may give its own stretches.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from hannes_bags.recording import Recording
from hannes_description.errors import HannesError
from numpy.typing import NDArray

from .described import STRANGE_HOLD_RATE, ZERO_ORDER_HOLD_RATE, control_period, hold_rate
from .gaps import MOVES, has_gap, said_of_gaps, split_gaps, widest_gap
from .units import in_si

Array = NDArray[np.float64]

SIGNALS = ("encoder_position", "motor_current", "motor_voltage", "grip_force")
"""Signals that are compared, in this order, as far as a recording has them."""

UNITS = {
    "encoder_position": "rad",
    "motor_current": "A",
    "motor_voltage": "V",
    "grip_force": "N",
    "motor_effort": "N.m",
}
"""Units of the signals; a trial may name others."""

_NEGATIVE = 0.005
"""Part of the samples below nought, beyond noise, that a rectified current does not have."""

RESTS = 0.02
HELD = 0.05
"""A reference rests within this part of its span from its rest value, which it has for so large a part of the time."""

ALIKE = 0.1
"""Closures of which the moving parts differ in length by less than this part are taken to leave their rest alike."""

LEFT = 1e-3
"""It leaves from where it was last within this part of its span, or its own noise, of where it rests."""

HOLDS = 0.5
"""s for which the last value of a reference holds at least, where its source ended."""

CUT = 0.1
"""s at the end of a recording of which it is said that they are left out."""

SAME_KIND = 0.03
"""Part of the smaller span within which the references of closures of one condition are alike."""

USUAL = 0.8
"""Part of its condition's usual length that a closure has at least; of less it was cut off."""

PART = 0.3
"""The same of less than which it is not known what it was part of: it is a condition of its own."""

MIDDLES = 30
"""Closures of which one is looked for that most others are like; of more, some at even distances."""

SAME = 5e-4
"""Mean difference of the references of two closures, in their span, up to which one repeats the other: a reference that
was logged by messages may be seen a control period earlier or later from closure to closure."""

EXACTLY = 1e-9
"""The same where a reference is known tick by tick: rounding errors.  Laps that begin a part of a period later differ
by more, and are not to be copied from one another as they are."""

MOST_SHIFT = 15
"""Ticks by which a closure may begin earlier or later than where its reference was seen to move."""

PHASES = 60
"""Places at which closures are compared with one another."""

MOVING = 2.0
DIGIT = 0.25
"""A move between two stands is so many times faster than they are somewhere; and speeds are taken over so many samples
that one last digit of the reference makes this part of a stand's limit: written with few digits it moves in steps."""

STILL = 1e-6
"""Part of a stand's limit up to which a speed is what rounding errors make of standing."""

ALIGNED = 3.0
"""Control periods by which closures of one condition may begin apart in their reference; see `Trial.aligned`."""

EARLY = 0.1
"""s that a closure may begin before its recording: the reference stands there."""


class NoClosure(HannesError):
    """A recording without a whole closure."""


@dataclass(frozen=True)
class Closure:
    """One repetition: start and stop [s] in the trial's time, its condition, and its number in its own recording."""

    start: float
    stop: float
    condition: str
    number: int = 0


@dataclass(frozen=True)
class Part:
    """One of the recordings that a trial is joined of: its name, file and hash, and where it begins [s]."""

    name: str
    source: str
    sha256: str
    begin: float


class OfAll(str):
    """A note on the recordings as a set, which the first of them carries: it is said without a recording's name."""


@dataclass(frozen=True)
class Trial:
    """One recording, ready to be replayed; or a few that repeat one condition, one after the other.

    reference  (n,) on the control grid: reference[k] acts from k x period on
    signals    name -> (time (m,) s, values (m,))
    options    what the plant must know of this recording (object, sensors, plant); the rig's adapter reads it
    units      units of signals whose unit is not that of UNITS; of another machine's reference by "reference"
    parts      the recordings that it is joined of; empty if it is one
    fresh      each part, or the recording beside others that it is joined to, begins as the first does, whatever came
               before; else one goes on where another ended
    """

    name: str
    period: float
    reference: Array
    signals: Mapping[str, tuple[Array, Array]]
    closures: tuple[Closure, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    sha256: str = ""
    notes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    parts: tuple[Part, ...] = ()
    fresh: bool = False

    def __post_init__(self) -> None:
        shape = np.shape(self.reference)
        if len(shape) != 1:
            raise HannesError(
                f"Trial '{self.name}': the reference has the shape {shape}; it must be one row of numbers, one for "
                "each control period."
            )
        if shape[0] < 2:
            raise HannesError(f"Trial '{self.name}': the reference is too short to be replayed.")
        if not self.closures:
            raise NoClosure(
                f"Trial '{self.name}': no closure was found: the reference never leaves its rest value "
                "and comes back. Record at least one whole closure."
            )

    @cached_property
    def span(self) -> float:
        """How far the reference goes, in its unit."""
        return float(np.ptp(self.reference))

    def unit(self, signal: str) -> str:
        return self.units.get(signal, UNITS.get(signal, ""))

    def part_of(self, closure: Closure) -> int:
        """Number of the part that a closure is of, which its middle tells: it may begin a moment before; 0 of none."""
        middle = 0.5 * (closure.start + closure.stop)
        return max(0, sum(part.begin <= middle for part in self.parts) - 1)

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions, in the order of their first closure."""
        return tuple(dict.fromkeys(closure.condition for closure in self.closures))

    def of(self, condition: str) -> tuple[Closure, ...]:
        return tuple(closure for closure in self.closures if closure.condition == condition)

    @cached_property
    def numbers(self) -> dict[str, list[int]]:
        """Numbers of the closures of each condition."""
        out: dict[str, list[int]] = {}
        for k, closure in enumerate(self.closures):
            out.setdefault(closure.condition, []).append(k)
        return out

    @property
    def anew(self) -> bool:
        """True where parts begin as the first one does; a recording alone begins but once."""
        return self.fresh and len(self.parts) > 1

    @property
    def anew_at(self) -> list[int]:
        """Control ticks, after the first, at which it begins anew."""
        return [round(part.begin / self.period) for part in self.parts[1:]] if self.anew else []

    @property
    def repeats(self) -> tuple[int, ...]:
        """For each closure the number of the one that it repeats, for a machine without memory.

        In one recording that is the second of its condition: the first one may be the first after the start.
        """
        if not self.anew:
            own = [self.numbers[closure.condition] for closure in self.closures]
            return tuple(k if k == numbers[0] else numbers[1] for k, numbers in enumerate(own))
        # The first recording has the most closures; outliers may be missing.
        until = self.parts[1].begin
        base = {c.number: k for k, c in enumerate(self.closures) if 0.5 * (c.start + c.stop) < until}
        return tuple(base.get(c.number, k) for k, c in enumerate(self.closures))

    @cached_property
    def apart(self) -> float:
        """Largest mean difference between the references of a closure and of the one that it repeats, in its span.

        Infinite where one is not as long as the other; a few ticks may be missing of the rest at the end.
        """
        most = 0.0
        for closure, number in zip(self.closures, self.repeats, strict=True):
            like = self.closures[number]
            if closure is like:
                continue
            n = round(min(c.stop - c.start for c in (like, closure)) / self.period)
            a = round(like.start / self.period)
            k = self.same_place(closure, like)
            skip = max(0, -a, -k)  # a closure may begin a moment before the recording
            shape, other = self.reference[a + skip : a + n], self.reference[k + skip : k + n]
            if other.size < shape.size - MOST_SHIFT:
                return math.inf
            span = float(np.ptp(shape)) or 1.0
            # A fresh reference sample may fall one tick earlier or later from closure to closure.
            most = max(most, float(np.mean(np.abs(other - shape[: other.size]))) / span)
        return most

    @cached_property
    def in_turn(self) -> bool:
        """Whether before each closure the same condition stands as before the one that it repeats."""
        before = [None, *(c.condition for c in self.closures)]
        return self.anew or all(before[k] == before[like] for k, like in enumerate(self.repeats) if k != like)

    def same_place(self, closure: Closure, like: Closure) -> int:
        """Tick at which the reference of a closure begins to be that of another one.

        Where the logged reference is coarse, a closure's start is known to one of its steps; the whole curve says more.
        """
        a, k = round(like.start / self.period), round(closure.start / self.period)
        skip = max(0, -a)
        n = round((like.stop - like.start) / self.period) - skip
        shape = self.reference[a + skip : a + skip + n]

        def apart(at: int) -> float:
            other = self.reference[at : at + n]
            return float(np.mean(np.abs(other - shape[: other.size]))) if at >= 0 and other.size else math.inf

        k += skip
        if apart(k) == 0.0:
            return k - skip
        return min(range(k - MOST_SHIFT, k + MOST_SHIFT + 1), key=lambda at: (apart(at), abs(at - k))) - skip

    def aligned(self) -> Trial:
        """The same, where each closure begins at the moment of its reference at which the first of its condition does.

        Laps that do not last a whole number of control periods, or moves that were found in a reference with rounding
        errors, begin up to a few periods earlier or later; at speed that is a distance, and no scatter of the machine.
        Only what is a shift in time is taken away: one by up to ALIGNED periods that makes at least half of the
        references' difference.
        """
        ticks = np.arange(self.reference.size) * self.period
        slope = np.gradient(self.reference, self.period)
        closures = list(self.closures)
        for own in self.numbers.values():
            first = closures[own[0]]
            for k in own[1:]:
                one = closures[k]
                # Ends are left out: there the reference stands, or is that of the next move.
                phase = np.arange(0.0, min(c.stop - c.start for c in (first, one)), self.period)[1:-1]
                shape = np.interp(first.start + phase, ticks, self.reference)
                before, late = np.interp(one.start + phase, ticks, self.reference) - shape, 0.0
                for _ in range(3):
                    at = one.start + late + phase
                    rise = np.interp(at, ticks, slope)
                    gain = float(rise @ rise)
                    left = np.interp(at, ticks, self.reference) - shape
                    late -= float(rise @ left) / gain if gain > 0.0 else 0.0
                left = np.interp(one.start + late + phase, ticks, self.reference) - shape
                if abs(late) <= ALIGNED * self.period and np.abs(left).sum() <= 0.5 * np.abs(before).sum():
                    closures[k] = replace(one, start=one.start + late, stop=one.stop + late)
        return self if closures == list(self.closures) else replace(self, closures=tuple(closures))

    def mean_closure(self, signal: str, phase: Array) -> Array:
        """Mean of a signal over the closures of the first condition at these times (p,) since their start [s]."""
        time, values = self.signals[signal]
        curves = [np.interp(c.start + phase, time, values) for c in self.of(self.conditions[0])]
        return np.asarray(np.mean(curves, axis=0))

    def only(self, closures: Sequence[Closure]) -> Trial:
        """The same recording with a part of its closures."""
        return replace(self, closures=tuple(closures))


OR_ELSE = "(if that is wrong: `hannes describe BAG --say reference_held=true`, or false)"


def reference_on_grid(
    time: Array, values: Array, period: float, duration: float, hold_rate: float = ZERO_ORDER_HOLD_RATE
) -> tuple[Array, str | None]:
    """The reference [n] on the control grid, and a note where it had to be guessed between samples.

    Fast logs are held from message to message, as the controller does.  Slow logs are interpolated by a monotone cubic;
    where the reference leaves or reaches its rest value between two samples, the moving part is extrapolated to it.
    Of messages that came at one instant the last one holds.
    """
    later = np.append(np.diff(time) > 0.0, True)
    time, values = time[later], values[later]
    grid = np.arange(max(2, math.floor(duration / period + 1e-6) + 1)) * period
    steps = np.diff(time) if time.size > 1 else np.array([period])
    step = float(np.median(steps))
    # Stamps in whole milliseconds: at 60 Hz the median step is 17 ms.
    rate = 1.0 / float(steps[steps < 1.5 * step].mean())
    said = f"the reference is logged at {rate:.0f} Hz; "
    if time.size < 4 or 1.0 / step >= hold_rate:
        index = np.clip(np.searchsorted(time, grid + 1e-7, side="right") - 1, 0, time.size - 1)
        slow = time.size >= 4 and 1.0 / step < STRANGE_HOLD_RATE
        return values[index], said + "each message is held until the next" if slow else None
    from scipy.interpolate import PchipInterpolator

    out = np.interp(grid, time, values)
    rest = _rest_value(values)
    span = float(np.ptp(values)) or 1.0
    moving = np.abs(values - rest) > 1e-9 * span
    for first, last in _runs(moving):
        t, v = time[first : last + 1], values[first : last + 1]
        if t.size < 4:
            continue
        curve = PchipInterpolator(t, v, extrapolate=True)
        left, right = t[0], t[-1]
        if first > 0:
            slope = (v[1] - v[0]) / (t[1] - t[0])
            left = (
                max(time[first - 1], t[0] - (v[0] - rest) / slope)
                if slope * (v[0] - rest) > 0
                else time[first - 1]
            )
        if last < time.size - 1:
            slope = (v[-1] - v[-2]) / (t[-1] - t[-2])
            right = (
                min(time[last + 1], t[-1] + (v[-1] - rest) / -slope)
                if slope * (v[-1] - rest) < 0
                else time[last + 1]
            )
        inside = (grid >= t[0]) & (grid <= t[-1])
        out[inside] = curve(grid[inside])
        if first > 0:
            edge = (grid > time[first - 1]) & (grid < t[0])
            out[edge] = np.interp(grid[edge], [left, t[0]], [rest, v[0]])
        if last < time.size - 1:
            edge = (grid > t[-1]) & (grid < time[last + 1])
            out[edge] = np.interp(grid[edge], [t[-1], right], [v[-1], rest])
    return out, said + "between samples it is interpolated"


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _rest_value(values: Array) -> float:
    """The value at which the reference rests: the one at which it begins and ends, else the most frequent one.

    A grip may be held for longer than the hand rests.  The minimum of a reference that never rests.
    """
    rounded, counts = np.unique(np.round(values, 6), return_counts=True)
    near = RESTS * float(np.ptp(values))
    at_ends = np.abs(rounded - values[0]) <= near
    if abs(values[-1] - values[0]) <= near and counts[at_ends].max() >= HELD * values.size:
        return float(rounded[at_ends][np.argmax(counts[at_ends])])
    return float(rounded[np.argmax(counts)]) if counts.max() >= HELD * values.size else float(values.min())


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
    away = np.abs(reference - _rest_value(reference))
    runs = [
        (first, last)
        for first, last in _runs(away > RESTS * span)
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
    for first, last in _runs(speed < limit):
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
    longest = max(_runs(speed <= speed.min() + nearly), key=lambda run: run[1] - run[0])
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


def make_trial(
    recording: Recording,
    *,
    name: str | None = None,
    signals: Sequence[str] = SIGNALS,
    scale: Mapping[str, float] | None = None,
) -> Trial:
    """A trial from a recording; the condition's name and options come from its metadata where it has them.

    scale   factors to SI by signal name, where the recording is in other units
    Raises HannesError where the recording has no reference or none of the signals.
    """
    (converted,) = in_si([compared(recording, signals)], scale or {})
    return trial_of(converted, name=name)


def compared(recording: Recording, signals: Sequence[str] = SIGNALS) -> Recording:
    """The recording with nothing but its reference and what is compared of it."""
    if "reference_position" not in recording:
        raise HannesError(
            f"{recording.source} has no reference_position: it is needed, for the model replays it. "
            + recording.elsewhere()
        )
    present = [s for s in signals if s in recording.channels]
    if "motor_current" not in present and "motor_effort" in recording.channels:
        present.append("motor_effort")
    if not present:
        raise HannesError(
            f"{recording.source}: none of the signals {', '.join(signals)} is recorded; nothing can be "
            f"compared. {recording.elsewhere()}"
        )
    return replace(recording, channels={s: recording[s] for s in ("reference_position", *present)})


def trial_of(recording: Recording, *, name: str | None = None) -> Trial:
    """The trial of a recording in SI with nothing but what is compared."""
    notes = list(recording.warnings)
    meta = recording.metadata
    period = control_period(meta, recording.source)
    name = name or str(meta.get("condition") or stem_of(recording.source))
    channel = recording["reference_position"]
    _check_overlap(recording)
    origin = float(channel.time[0])
    origin = math.floor(origin / period + 1e-6) * period
    samples = {
        s: (np.asarray(c.time) - origin, np.asarray(c.values, dtype=float))
        for s, c in recording.channels.items()
    }
    logged = samples.pop("reference_position")
    whole_length = recording.end - origin
    duration = min(whole_length, _known_until(*logged))
    if whole_length - duration > CUT:
        notes.append(
            f"the reference ends {whole_length - duration:.1f} s before the recording does, away from its rest: what "
            "comes after is left out"
        )
    reference, note = reference_on_grid(*logged, period, duration, hold_rate(meta, recording.source))
    if note:
        notes.append(note if "reference_held" in meta else f"{note} {OR_ELSE}")
    begin = max(float(t[0]) for t, _ in samples.values())
    end = min(float(t[-1]) for t, _ in samples.values())
    spans = find_closures(reference, period)
    inside = [(a, min(b, end)) for a, b in spans if a >= begin - EARLY and min(b, end) > a]
    silent, alone = split_gaps(logged[0], samples)
    notes += said_of_gaps(silent, alone, logged, samples.get("encoder_position"))
    # A closure that seems to begin where the silence ends began in it.
    whole = [
        span
        for span in inside
        if not any(has_gap(time, *span) for time, _ in samples.values())
        and not any(a < span[0] <= b for a, b in silent)
    ]
    if inside and not whole:
        widest = widest_gap(
            {"reference_position": logged[0], **{s: time for s, (time, _) in samples.items()}}
        )
        raise NoClosure(f"Trial '{name}': samples are missing in each of its closures{widest}.")
    if len(whole) < len(inside):
        notes.append(left_out(len(inside) - len(whole)))
    closures = group_closures(reference, period, whole, name, channel.period)
    cut = len(spans) - len(closures) - (len(inside) - len(whole))
    if cut:
        notes.append(f"{cut} of {in_words(len(spans))} {'is' if cut == 1 else 'are'} cut off and left out")
    kinds = Counter(closure.condition for closure in closures)
    if len(kinds) > 1:
        told = ", ".join(f"{kind} ({in_words(count)})" for kind, count in kinds.items())
        notes.append(
            f"the references of its closures differ by more than {100 * SAME_KIND:.0f} % of their span, so they are "
            f"{len(kinds)} conditions: {told} (another amplitude, hold or rest, or one that was broken off); --object "
            "NAME=soft says what was grasped in one of them"
        )
    options = {key: meta[key] for key in ("object", "sensors", "plant") if key in meta}
    if "sensors" in options and "motor_current" in samples:
        options["sensors"], said = _as_it_is(options["sensors"], samples["motor_current"][1])
        notes += said
    return Trial(
        name,
        period,
        reference,
        samples,
        tuple(closures),
        options,
        recording.source,
        recording.sha256,
        tuple(notes),
    )


def _known_until(time: Array, values: Array) -> float:
    """Until when [s] a reference (n,) is known that was logged at these times (n,).

    Its last value holds on.  Where it is away from rest its source has ended in the midst of a closure, and where it
    stood then is no rest: it holds for as long as one did before, or HOLDS.
    """
    near = RESTS * float(np.ptp(values))
    if min(abs(values[-1] - rest) for rest in (values[0], _rest_value(values))) <= near:
        return math.inf
    return float(time[-1]) + max(HOLDS, float(np.diff(time).max(initial=0.0)))


def _as_it_is(sensors: Any, current: Array) -> tuple[Any, list[str]]:
    """What a recording says of its loggers, less that a current is rectified which goes below nought."""
    if not (isinstance(sensors, Mapping) and sensors.get("current_rectified")):
        return sensors, []
    noise = sensors.get("current_noise", 0.0)
    least = 0.02 * float(np.ptp(current)) + 5.0 * (noise if isinstance(noise, int | float) else 0.0)
    if np.mean(current < -least) < _NEGATIVE:
        return sensors, []
    return {**sensors, "current_rectified": False}, [
        f"motor_current goes to {current.min():.3g} A, though the recording's `sensors` say that it is rectified: "
        'taken as signed; write "current_rectified": false there (`hannes describe`)'
    ]


def _check_overlap(recording: Recording) -> None:
    """Refuse a signal that was recorded at another time than the reference: nothing of it can be compared."""
    reference = recording["reference_position"].time
    for name, channel in recording.channels.items():
        if channel.time[0] > reference[-1] or channel.time[-1] < reference[0]:
            raise NoClosure(
                f"{recording.source}: {name} was recorded from {channel.time[0]:.1f} to {channel.time[-1]:.1f} s, but "
                f"reference_position from {reference[0]:.1f} to {reference[-1]:.1f} s: they do not overlap in time. "
                f"Record them together and by one clock, or leave the signal out with --topic {name}=."
            )


def in_words(count: int) -> str:
    """How many closures there are."""
    return f"{count} closure{'s' * (count != 1)}"


def left_out(count: int) -> str:
    """The note about closures with a gap in a signal."""
    return f"{in_words(count)} in which samples are missing {'is' if count == 1 else 'are'} left out"


def curves_of(closures: Sequence[Closure], time: Array, values: Array) -> Array:
    """A signal over each closure, at PHASES places of the shortest one: (closures, PHASES)."""
    length = min(c.stop - c.start for c in closures)
    phase = np.linspace(0.02 * length, 0.95 * length, PHASES)
    return np.array([np.interp(c.start + phase, time, values) for c in closures])


def stem_of(source: str) -> str:
    """The name of a bag or file without its ending."""
    from pathlib import Path

    path = Path(source)
    return (path.stem if path.suffix else path.name) or "recording"


def unique_names(trials: Sequence[Trial], *, conditions: bool = True) -> list[Trial]:
    """Trials with names of their own, by which plants and parameters are kept; their conditions with them, if asked."""
    given = {trial.name for trial in trials}
    taken: set[str] = set()
    out = []
    for trial in trials:
        name = trial.name
        if name in taken:
            name = next(new for k in itertools.count(2) if (new := f"{trial.name}#{k}") not in taken | given)
            closures = trial.closures
            if conditions:
                closures = tuple(
                    replace(c, condition=_renamed(c.condition, trial.name, name)) for c in closures
                )
            trial = replace(trial, name=name, closures=closures)
        taken.add(name)
        out.append(trial)
    return out


def _renamed(condition: str, old: str, new: str) -> str:
    """The name of a condition of a trial of a new name: it changes with it where it is the trial's, or begins so."""
    named_after = condition == old or condition.startswith(f"{old}.")
    return new + condition.removeprefix(old) if named_after else condition

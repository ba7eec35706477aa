"""Trials: a reference on the control grid, the closures in it, and which of them repeat one condition.

Nothing here knows that the machine is a hand: a closure is a stretch of the reference; `closures` finds those that
leave a rest value and come back, and another machine's adapter may give its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from numpy.typing import NDArray

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


def __getattr__(name: str) -> Any:
    """`find_moves`, for the adapters that were written when it stood here."""
    if name == "find_moves":
        from .closures import find_moves

        return find_moves
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""What the residual depends on: position, velocity, direction, load, time, friction or inertia by position, or one
frequency."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .features import Features

Array = NDArray[np.float64]

VARIABLES = ("position", "velocity", "direction", "load", "time")
FREQUENCY = "frequency"
BRAKING = "friction_by_position"
"""What acts against the motion, by where: its mean over both directions is nothing."""

INERTIA = "inertia_by_position"
"""What goes with the acceleration, by where: of an inertia that depends on the position."""

BINS = 10
OF_PLACE = {"position": 4, BRAKING: 2}
"""Times as many bins: what acts at a place does so on a small part of the way."""

PLACES = (*OF_PLACE, INERTIA)
"""Variables of which it counts what is alike in all passes of a place."""

BAND = 1.15
"""A frequency is a band from so many times lower to so many times higher."""

CYCLES = 2.0
"""Least number of cycles in the shortest closure: what is slower is no oscillation, but its form."""

OTHER_SPEED = 1.25
"""Times that one condition goes faster than another at least; where no position is logged, that a closure lasts
longer."""

FINE = 4
"""Points of a spectrum for each that the closure's length tells apart."""

FEWEST = 16
"""Points of a closure from which there is a spectrum."""

ROUNDING = 1e-12
"""Part of a residual's square below which it does not vary."""

WORTH_SAYING = {FREQUENCY: 0.2, BRAKING: 0.2, "position": 0.4, INERTIA: 0.35}
"""Share from which it is said in words; much goes with the position in part."""

SHOWN = 0.2
"""Share of a place from which it is told that less of it is alike in all passes."""

TREND = 0.85
"""Correlation of a curve with the place from which it is told as what grows or falls along the whole way."""

OTHER_WAY = 0.01
"""Part of the samples that move the other way, below which there is one direction only."""

ABOVE = 2.0
"""Times that a mean residual's square must exceed what the closures' scatter makes of it, to show a frequency."""
AT_REST = 1e-3
"""Part of the largest speed below which there is no direction."""


@dataclass(frozen=True)
class Dependence:
    """Residual of one signal against one variable.

    share    part of the variance of the closures' mean residual that the curve explains (adjusted R2), 0..1; an offset
             that is the same everywhere depends on nothing
    centres  (b,) of the variable, in `unit`; curve (b,) mean residual, in the signal's unit; of a frequency amplitudes,
             of inertia by position for an acceleration of 1
    unit     of the variable; of time and direction none
    at       where it oscillates in all conditions, or where what acts at a place is largest; in `unit`
    repeated  of a place: part of the variance that is alike in all passes of it, either way (of inertia, and in all
             conditions); what is passed once only goes with the place whatever the cause
    """

    variable: str
    signal: str
    share: float
    centres: tuple[float, ...]
    curve: tuple[float, ...]
    unit: str = ""
    at: float | None = None
    repeated: float = 0.0

    @property
    def telling(self) -> float:
        """The share, or what is alike in all passes of a place where little is: an error that grows along a way which
        is passed once goes with the place, too, and says nothing of it."""
        return self.repeated if self._passed_once else self.share

    @property
    def _passed_once(self) -> bool:
        return self.variable in PLACES and self.share >= SHOWN > self.repeated

    @property
    def said(self) -> str:
        """The variable and its share, in words."""
        where = "" if self.at is None or self.share == 0.0 else f" ({self.at:.2g} {self.unit})"
        share = f"{100 * self.share:.0f} %"
        if self._passed_once:
            share += f" ({100 * self.repeated:.0f} % alike in all passes)"
        return f"{self.variable.replace('_', ' ')}{where} {share}"

    def to_dict(self) -> dict[str, Any]:
        where = {} if self.at is None else {"at": self.at}
        if self.variable in PLACES:
            where["repeated"] = self.repeated
        return where | {
            "variable": self.variable,
            "unit": self.unit,
            "signal": self.signal,
            "share": self.share,
            "centres": list(self.centres),
            "curve": list(self.curve),
        }


def residual_dependences(
    features: Features, predicted: list[Array], drive: Sequence[str]
) -> tuple[Dependence, ...]:
    """What the residual of the drive's signal depends on, or of the first signal where none is recorded.

    Without an encoder on load, time and frequency only; without a drive's signal not on the load, which that tells.

    drive   the signals that show force or torque, see Rig
    """
    residuals: dict[str, list[Array]] = {}
    states: dict[str, list[Array]] = {"position": [], "velocity": [], "direction": [], "load": []}
    for block, closures in zip(features.blocks, predicted, strict=True):
        residuals.setdefault(block.signal, []).append(block.measured - closures)
    signal = next((s for s in drive if s in residuals), next(iter(residuals)))
    by = {(b.trial, b.condition, b.signal): (b, c) for b, c in zip(features.blocks, predicted, strict=True)}
    places = [(b.trial, b.condition) for b in features.blocks if b.signal == signal]
    for trial, condition in places:
        target, load = by[(trial, condition, signal)]
        if signal in drive:
            states["load"].append(load)
        place = by.get((trial, condition, "encoder_position"))
        if place is not None:
            position = np.interp(target.phase, place[0].phase, place[1].mean(axis=0))
            velocity = np.gradient(position, target.phase)
            for name, values in (("position", position), ("velocity", velocity), ("direction", velocity)):
                states[name].append(np.tile(values, (target.n, 1)))
    # Of a set in which the encoder is not logged everywhere, what depends on it is not known.
    known = {name: values for name, values in states.items() if len(values) == len(places)}
    phases = [b.phase for b in features.blocks if b.signal == signal]
    steps = [float(phase[1] - phase[0]) for phase in phases]
    of_signal = {b.signal: b.unit for b in features.blocks}
    place_unit = of_signal.get("encoder_position", "")
    speed_unit = f"{place_unit}/s" if place_unit else ""
    units = {
        "position": place_unit,
        BRAKING: place_unit,
        INERTIA: place_unit,
        "velocity": speed_unit,
        "load": of_signal[signal],
    }
    speeds = [float(np.abs(values).mean()) for values in known.get("velocity", ())]
    found = [
        *_dependences(residuals, known, signal, steps, units),
        *_oscillation(signal, residuals[signal], steps, speeds),
    ]
    return tuple(sorted(found, key=lambda d: -d.telling))


def pointed_at(found: Sequence[Dependence], drive: Sequence[str]) -> str:
    """A sentence where a residual goes with one frequency, or with a place, as with nothing else; or empty.

    drive   the signals that show force or torque, see Rig

    A place counts by what is alike in all passes of it.  Where the way ends the machine turns, and all that has to do
    with starts and stops is largest there.
    """
    for first in sorted(found, key=lambda d: -d.share):
        worth = first.repeated if first.variable in PLACES else first.share
        if first.at is None or worth < WORTH_SAYING[first.variable]:
            return ""
        what = f"{100 * worth:.0f} % of what is left of {first.signal}"
        where = f"{first.at:.2g} {first.unit}"
        if first.variable == FREQUENCY:
            return (
                f"{what} oscillates at {where} in all conditions, at whatever speed: something swings that the model "
                "takes for rigid (a shaft, a belt, a mount, what hangs); examples/effects/elastic_load.py is an effect "
                "for it"
            )
        if first.variable == INERTIA:
            return (
                f"{what} goes with the acceleration by where it is: an inertia that depends on the position (a "
                "crank, a linkage); examples/effects/position_inertia.py is an effect for it"
            )
        if first.variable == BRAKING and abs(trend := _trend(first)) >= TREND:
            # What brakes asks more of the drive; a position that it holds back falls behind.
            more, grows = ("more", "grows") if (trend > 0.0) == (first.signal in drive) else ("less", "falls")
            return (
                f"{what} acts against the motion, either way, the {more} the larger the position is: friction that "
                f"{grows} along the way (a wire that climbs its drum, a guide that tightens, a seal); an effect that "
                "adds to y[FRICTION] by x[Q] all the way, as examples/effects/local_friction.py does at one place"
            )
        if first.at in (first.centres[0], first.centres[-1]):
            continue
        if first.variable == "position":
            return (
                f"{what} goes with the position, whichever way, most near {where}: a detent, a "
                "magnet, a spring or a cam acts there, or a ripple of another form; examples/effects/local_torque.py "
                "is an effect for it"
            )
        return (
            f"{what} acts along or against the motion by where it is, either way, most at {where}: something rubs or "
            "is lubricated there; examples/effects/local_friction.py is an effect for it"
        )
    return ""


def _trend(found: Dependence) -> float:
    """Correlation of the curve with the place, but for its ends, where the machine turns; 0 of too few places."""
    places, curve = np.array(found.centres[1:-1]), np.array(found.curve[1:-1])
    if places.size < BINS or np.ptp(curve) <= ROUNDING * np.abs(curve).max() or np.ptp(places) == 0.0:
        return 0.0
    return float(np.corrcoef(places, curve)[0, 1])


@dataclass(frozen=True)
class _Spectrum:
    """Of the mean residual of a condition: frequency (m,) [Hz], power (m,) of sum 1, and its variance."""

    frequency: Array
    power: Array
    variance: float

    def within(self, low: float, high: float) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = (self.frequency >= low) & (self.frequency <= high)
        return inside

    def share(self, low: float, high: float) -> float:
        return float(self.power[self.within(low, high)].sum())

    def stands_out(self, f: float) -> float:
        """Share of the band of a frequency without what noise of all frequencies has there."""
        by_chance = f * (BAND - 1.0 / BAND) / float(self.frequency[-1])
        return (self.share(f / BAND, f * BAND) - by_chance) / (1.0 - by_chance)

    def middle(self, f: float) -> float:
        """Of the band of a frequency, by power: where its share is largest is known badly."""
        own = self.within(f / BAND, f * BAND)
        return float(self.frequency[own] @ self.power[own] / max(self.power[own].sum(), 1e-300))


def _spectrum(closures: Array, step: float) -> _Spectrum | None:
    """Of closures' (n, p) mean residual at phases that are `step` s apart; None where it shows no more than scatter."""
    n, p = closures.shape
    mean = closures.mean(axis=0)
    noise = closures.var(axis=0, ddof=1).mean() / n if n > 1 else 0.0
    if p < FEWEST or mean.var() <= max(ABOVE * noise, ROUNDING * float(np.mean(mean**2))):
        return None
    power = np.abs(np.fft.rfft((mean - mean.mean()) * np.hanning(p), FINE * p)) ** 2
    frequency: Array = np.asarray(np.fft.rfftfreq(FINE * p, step), dtype=np.float64)
    return _Spectrum(frequency, power / power.sum(), float(mean.var()))


def _oscillation(
    signal: str, residuals: Sequence[Array], steps: Sequence[float], speeds: Sequence[float] = ()
) -> list[Dependence]:
    """What of a residual oscillates at one frequency whatever the condition: what swings does so at its own.

    residuals  per condition block (n, p); steps  s between two phases of each; speeds  of each, where they are known
    The share is the least of all conditions that show more than scatter.  A ripple along the way has another frequency
    at each speed: conditions of one speed cannot tell.
    """
    found = [(_spectrum(r, step), r.shape[1] * step) for r, step in zip(residuals, steps, strict=True)]
    spectra = [s for s, _ in found if s is not None]
    lengths = [length for s, length in found if s is not None]
    of_all = speeds or [length for _, length in found]
    paces = [pace for (s, _), pace in zip(found, of_all, strict=True) if s is not None]
    if not spectra or max(paces) < OTHER_SPEED * min(paces):
        return []
    lowest = BAND * CYCLES / min(lengths)
    highest = min(float(s.frequency[-1]) for s in spectra) / BAND
    if highest <= BAND * lowest:
        return []
    tried = np.geomspace(lowest, highest, 120)
    least = [min(s.stands_out(f) for s in spectra) for f in tried]
    best = int(np.argmax(least))
    edges = np.geomspace(lowest / BAND, highest * BAND, 2 * BINS + 1)
    return [
        Dependence(
            FREQUENCY,
            signal,
            share=float(np.clip(least[best], 0.0, 1.0)),
            centres=tuple(float(v) for v in np.sqrt(edges[1:] * edges[:-1])),
            curve=tuple(
                float(np.mean([np.sqrt(2.0 * s.share(a, b) * s.variance) for s in spectra]))
                for a, b in itertools.pairwise(edges)
            ),
            unit="Hz",
            at=float(np.median([s.middle(tried[best]) for s in spectra])),
        )
    ]


def _dependences(
    residuals: Mapping[str, list[Array]],
    states: Mapping[str, list[Array]],
    signal: str,
    steps: Sequence[float],
    units: Mapping[str, str] = MappingProxyType({}),
) -> tuple[Dependence, ...]:
    """Shares of one signal's residual, by variable.

    residuals  signal -> per condition block (n, p) measured - model
    states     variable -> per condition block (n, p)
    steps      s between two phases of each block; units of the variables
    """
    r = np.concatenate([a.mean(axis=0) for a in residuals[signal]])
    out = []
    for variable in VARIABLES:
        if variable == "time":
            values = np.concatenate(
                [np.repeat(np.linspace(0.0, 1.0, a.shape[0]), a.shape[1]) for a in residuals[signal]]
            )
            target = np.concatenate([a.ravel() for a in residuals[signal]])
        elif variable not in states or (variable == "direction" and _one_way(states[variable])):
            continue
        else:
            values = np.concatenate([a.mean(axis=0) for a in states[variable]])
            target = r
        one = _dependence(variable, signal, values, target)
        out.append(_with_place(one, float(np.mean(one.curve or 0.0))) if variable == "position" else one)
    if "position" in states and "velocity" in states:
        position, velocity = (
            np.concatenate([a.mean(axis=0) for a in states[name]]) for name in ("position", "velocity")
        )
        # Of few samples between two turns no acceleration is known.
        acceleration = np.concatenate(
            [np.gradient(a.mean(axis=0), step) for a, step in zip(states["velocity"], steps, strict=True)]
        )
        way = _direction(velocity)
        condition = np.repeat(np.arange(len(steps)), [a.shape[1] for a in states["velocity"]])
        away = r - r.mean()
        out += [
            _with_place(_dependence(variable, signal, position, away, times))
            for variable, times in ((BRAKING, way), (INERTIA, acceleration))
        ]
        # What is the same all the way, one way or the other, is friction.
        level = sum(away[way == one].mean() * (way == one) for one in (-1.0, 1.0) if (way == one).any())
        passes: dict[str, tuple[Array, Array | float, Array]] = {
            "position": (away - level, 1.0, way),
            BRAKING: (away - level, way, way),
            INERTIA: (away, acceleration, way + 4.0 * condition),
        }
        for k, found in enumerate(out):
            if found.variable in passes:
                rest, times, group = passes[found.variable]
                share = _repeated(_bins(found.variable, position), rest, times, group, way != 0.0)
                out[k] = replace(found, repeated=share * float(rest @ rest) / max(float(away @ away), 1e-300))
    return tuple(replace(found, unit=units.get(found.variable, "")) for found in out)


def _with_place(found: Dependence, level: float = 0.0) -> Dependence:
    """The same with where its curve is farthest from a level."""
    if not found.curve:
        return found
    return replace(found, at=found.centres[int(np.argmax(np.abs(np.subtract(found.curve, level))))])


def _one_way(velocities: Sequence[Array]) -> bool:
    """Whether nothing moves the other way: what differs between moving and standing is no matter of direction."""
    way = _direction(np.concatenate([a.mean(axis=0) for a in velocities]))
    return min(float(np.mean(way == one)) for one in (-1.0, 1.0)) < OTHER_WAY


def _direction(velocity: Array) -> Array:
    """1, -1, or 0 at rest."""
    way: Array = np.sign(velocity) * (np.abs(velocity) > AT_REST * np.abs(velocity).max(initial=0.0))
    return way


def _bins(variable: str, x: Array) -> NDArray[np.int64]:
    """The bin (n,) of each value of a variable, as many in one as in another; all 0 where there is but one."""
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, BINS * OF_PLACE.get(variable, 1) + 1)))
    if edges.size < 3:
        return np.zeros(x.size, dtype=np.int64)
    return np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)


def _repeated(
    index: NDArray[np.int64], y: Array, times: Array | float, group: Array, moving: NDArray[np.bool_]
) -> float:
    """Part of the square of a residual y (n,) that times (n,) c(bin) is in all groups alike.

    In each bin the component of variance that its groups have in common (Fisher 1925): their common curve's square,
    less what groups of which each has a curve of its own would lend it.  Where it stands, and in bins that one group
    passes alone, nothing repeats.
    """
    factor = np.broadcast_to(times, y.shape)
    common = 0.0
    for k in np.unique(index[moving]):
        inside = moving & (index == k)
        weights, products = [], []
        for one in np.unique(group[inside]):
            own = inside & (group == one)
            weights.append(float(factor[own] @ factor[own]))
            products.append(float(factor[own] @ y[own]))
        w, p = np.array(weights), np.array(products)
        p, w = p[w > ROUNDING * w.sum()], w[w > ROUNDING * w.sum()]
        if w.size > 1:
            together, each = float(p.sum() ** 2 / w.sum()), float(np.sum(p**2 / w))
            common += together - (each - together) / (w.size - 1)
    total = float(y @ y)
    return max(0.0, common / total) if total > 0.0 else 0.0


def _dependence(variable: str, signal: str, x: Array, y: Array, times: Array | float = 1.0) -> Dependence:
    """Of a residual y (n,) against a variable x (n,): the curve c(x) that is nearest in y = times (n,) c(x)."""
    if variable == "direction":
        labels = _direction(x)
        groups = np.unique(labels)
        index: NDArray[np.int64] = np.searchsorted(groups, labels)
    else:
        index = _bins(variable, x)
        if not index.any():
            return Dependence(variable, signal, 0.0, (), ())
        groups = np.arange(int(index.max()) + 1, dtype=np.float64)
    factor = np.broadcast_to(times, y.shape)
    centres, curve, inside = [], [], 0.0
    for k in range(groups.size):
        own = index == k
        if not own.any():
            continue
        weight = float((factor[own] ** 2).sum())
        height = float((factor[own] * y[own]).sum()) / weight if weight > 0.0 else 0.0
        centres.append(float(x[own].mean()))
        curve.append(height)
        inside += float(((y[own] - factor[own] * height) ** 2).sum())
    total, level = float(((y - y.mean()) ** 2).sum()), float((y**2).sum())
    k, n = len(centres), y.size
    # Of an offset alone rounding is left.
    share = 1.0 - (inside / max(n - k, 1)) / (total / (n - 1)) if total > ROUNDING * level else 0.0
    return Dependence(variable, signal, float(np.clip(share, 0.0, 1.0)), tuple(centres), tuple(curve))

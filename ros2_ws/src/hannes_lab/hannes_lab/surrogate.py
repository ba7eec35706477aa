"""A slow plant seen through a fast one, so that a search of thousands of simulations needs only a few slow ones.

    signal(z) = fast(z) + [slow(a) - fast(a)] + sum_j [dslow/dz_j - dfast/dz_j] (z_j - a_j)

At the anchor a this is the slow plant exactly.  Its slopes are the slow plant's too for every coordinate whose
difference of slopes was taken (space mapping that is consistent to first order: Alexandrov, Lewis 2001; Bandler et al.
2004); for the others the fast plant's count.  A fit moves the anchor to where it ends and goes on until it stays
there, so that what is reported at the end was simulated on the slow plant.  Each move teaches the slopes: they are
changed as little as agrees with the slow plant at both ends of the move (Broyden 1965).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType
from numpy.typing import NDArray

from .executor import own
from .features import Block, check_simulated, compact_end, has_memory
from .problem import Coordinate
from .rig import Nuisance, PlantRig, Rig
from .trials import Trial

Array = NDArray[np.float64]
Anchor = tuple[Any, ...]
Key = tuple[Any, ...]
Wanted = tuple[Mapping[str, float], Trial, Array]
"""A simulation: parameters, trial and reference."""

FAST_PLANT = "reduced"
SLOW_PLANTS = ("mujoco",)
"""Plants of which a whole diagnosis would take longer than a coffee."""

KEPT = 64
"""Corrections that are kept: one per anchor, trial and length."""


class AnchoredRig:
    """A rig whose slow plant is replaced by the fast one, a correction taken at an anchor, and slopes.

    exact   the rig itself
    threads  of which slow simulations that are needed together are divided; a copy in another process has one
    """

    def __init__(
        self,
        exact: PlantRig,
        model: Model,
        values: Mapping[str, float],
        slopes: Mapping[str, _Slope] | None = None,
        corrections: dict[Key, Array] | None = None,
        threads: int = 1,
        ends: Mapping[str, int | None] | None = None,
    ) -> None:
        self.exact = exact
        self.threads = threads
        # A plant must not be stepped by two threads: each has its own.
        self._exacts = [exact]
        self._ends = ends or {trial.name: compact_end(trial) for trial in exact.trials}
        self.trials = exact.trials
        self.floor, self.finest, self.coarse = exact.floor, exact.finest, exact.coarse
        self.points, self.same, self.pooled = exact.points, exact.same, exact.pooled
        self.approximate, self.foreign = True, exact.foreign
        self.drive_signals, self.without = exact.drive_signals, exact.without
        self.phases, self.figures, self.experiments = exact.phases, exact.figures, exact.experiments
        self.machine = exact.machine
        self._model, self._values = model, dict(values)
        self._anchor: Anchor = (model.sha256, *sorted(self._values.items()))
        self._slopes = dict(slopes or {})
        self._corrections: dict[Key, Array] = corrections if corrections is not None else {}

    def __reduce__(self) -> tuple[Any, ...]:
        kept = self._slopes, self._corrections, 1, self._ends
        return AnchoredRig, (self.exact, self._model, self._values, *kept)

    def identity(self) -> tuple[Any, ...]:
        """See PlantRig."""
        return ("anchored", self.exact, self._model, self._values, self._slopes)

    def anchored(self, model: Model, values: Mapping[str, float]) -> AnchoredRig:
        """The same with another anchor; slopes change little along the way and stay."""
        return self._like(model, values, self._slopes)

    def sloped(self, coordinates: Sequence[Coordinate]) -> AnchoredRig:
        """The same with the slow plant's slopes at the anchor for these coordinates."""
        slopes = dict(zip((c.name for c in coordinates), self._new_slopes(coordinates), strict=True))
        return self._like(self._model, self._values, {**self._slopes, **slopes})

    def taught(self, before: AnchoredRig, weights: Mapping[str, float]) -> AnchoredRig:
        """The same with slopes that agree with the anchor before too: what they miss between the two is given to them.

        weights  share of a coordinate by name, per squared distance in z: those that move the data most miss most
        """
        moved = {
            name: slope.away(self._values[name], before._values)
            for name, slope in self._slopes.items()
            if weights.get(name)
        }
        signals = {name: dict(slope.signals) for name, slope in self._slopes.items()}
        for trial in self.trials:
            own = [name for name in moved if trial.name in signals[name]]
            whole = sum(weights[name] * moved[name] ** 2 for name in own)
            if whole > 0.0:
                n = signals[own[0]][trial.name].shape[1]
                missed = self._correction(trial, trial.reference, n)
                missed = missed - before._correction(trial, trial.reference, n)
                for name in own:
                    missed = missed - moved[name] * signals[name][trial.name]
                for name in own:
                    share = weights[name] * moved[name] / whole
                    signals[name][trial.name] = signals[name][trial.name] + share * missed
        slopes = {name: _Slope(slope.coordinate, signals[name]) for name, slope in self._slopes.items()}
        return self._like(self._model, self._values, slopes)

    def with_slopes_of(self, other: AnchoredRig) -> AnchoredRig:
        """The same with the slopes of another."""
        return self._like(self._model, self._values, other._slopes)

    def _like(self, model: Model, values: Mapping[str, float], slopes: Mapping[str, _Slope]) -> AnchoredRig:
        made = AnchoredRig(self.exact, model, values, slopes, self._corrections, self.threads, self._ends)
        made._exacts = self._exacts
        return made

    @property
    def slopes(self) -> frozenset[str]:
        """Names of the coordinates whose slopes are the slow plant's."""
        return frozenset(self._slopes)

    def nuisances(self, model: Model) -> Sequence[Nuisance]:
        """See Rig."""
        return self.exact.nuisances(model)

    def own_error(self, blocks: Sequence[Block], model: Model) -> Array:
        """See Rig."""
        return self.exact.own_error(blocks, model)

    def effect(self, kind: EffectType) -> EffectType:
        """See Rig."""
        return self.exact.effect(kind)

    def simulate(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> dict[str, Array]:
        """See Rig; only the signals that were recorded."""
        fast = self._fast(model, values, trial, reference)
        size = fast.shape[1]
        total = fast + self._correction(trial, reference, size)
        for name, slope in self._slopes.items():
            if name in values and trial.name in slope.signals:
                away = slope.away(values[name], self._values)
                if away != 0.0:
                    total += away * slope.on(trial, size)
        return dict(zip(trial.signals, total, strict=True))

    def _fast(self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array) -> Array:
        run = self.exact.simulate(model.with_plant(FAST_PLANT), values, trial, reference)
        check_simulated(run, tuple(trial.signals), trial, reference.size, self.exact)
        return np.array([run[name] for name in trial.signals])

    def _slow(self, wanted: Sequence[Wanted]) -> list[Array]:
        """Signals (k, ticks) of the slow plant for each (values, trial, reference)."""
        threads = min(self.threads, len(wanted))
        while len(self._exacts) < threads:
            self._exacts.append(own(self.exact))

        def part(number: int) -> list[Array]:
            out = []
            for values, trial, reference in wanted[number::threads]:
                run = self._exacts[number].simulate(self._model, values, trial, reference)
                out.append(np.array([run[name] for name in trial.signals]))
            return out

        if threads < 2:
            return part(0) if wanted else []
        with ThreadPoolExecutor(threads) as pool:
            parts = list(pool.map(part, range(threads)))
        return [parts[k % threads][k // threads] for k in range(len(wanted))]

    def _differences(self, wanted: Sequence[Wanted]) -> list[Array]:
        """Slow - fast (signals, ticks) for each; the whole trial only where both plants gave it."""
        out = []
        for (values, trial, reference), slow in zip(wanted, self._slow(wanted), strict=True):
            fast = self._fast(self._model, values, trial, reference)
            ticks = min(slow.shape[1], fast.shape[1])
            out.append(slow[:, :ticks] - fast[:, :ticks])
        return out

    def _correction(self, trial: Trial, reference: Array, size: int) -> Array:
        reference = self._shortest(trial, reference)
        key = (self._anchor, trial.name, reference.size)
        if key not in self._corrections:
            self._learn(trial, reference)
        return of_length(self._corrections[key], trial, size)

    def _shortest(self, trial: Trial, reference: Array) -> Array:
        whole = has_memory(self._model) and not trial.anew
        return reference if whole else reference[: self._ends[trial.name]]

    def _learn(self, trial: Trial, reference: Array) -> None:
        """Take the correction of a trial, and those of the others: they are wanted next."""
        others = [t for t in self.trials if t.name != trial.name]
        ends = [(other, self._shortest(other, other.reference)) for other in others]
        # The one that is wanted now comes last: what is too much to keep makes way from the oldest on.
        wanted = [
            (self._values, one, ticks)
            for one, ticks in [*ends, (trial, reference)]
            if (self._anchor, one.name, ticks.size) not in self._corrections
        ]
        for (_, one, ticks), found in zip(wanted, self._differences(wanted), strict=True):
            while len(self._corrections) >= KEPT:
                del self._corrections[next(iter(self._corrections))]
            self._corrections[self._anchor, one.name, ticks.size] = found

    def _new_slopes(self, coordinates: Sequence[Coordinate]) -> list[_Slope]:
        wanted: list[Wanted] = []
        whose: list[tuple[int, float]] = []
        for number, c in enumerate(coordinates):
            _, _, where = c.name.partition("@")
            here = c.z(self._values[c.name]) if c.name in self._values else 0.0
            step = c.inside_step(here)
            moved = {**self._values, c.name: c.value(here + step)}
            for trial in self.trials:
                if where in ("", trial.name):
                    wanted.append((moved, trial, trial.reference[: self._ends[trial.name]]))
                    whose.append((number, step))
        signals: list[dict[str, Array]] = [{} for _ in coordinates]
        for (_, trial, reference), change, (number, step) in zip(
            wanted, self._differences(wanted), whose, strict=True
        ):
            n = reference.size
            signals[number][trial.name] = (change[:, :n] - self._correction(trial, reference, n)) / step
        return [_Slope(c, by_trial) for c, by_trial in zip(coordinates, signals, strict=True)]


class _Slope:
    """Slow - fast derivative of the signals (signals, ticks) by one coordinate, per trial."""

    def __init__(self, coordinate: Coordinate, signals: Mapping[str, Array]) -> None:
        self.coordinate, self.signals = coordinate, signals

    def identity(self) -> tuple[Any, ...]:
        """See PlantRig."""
        return (self.coordinate, self.signals)

    def away(self, value: float, anchor: Mapping[str, float]) -> float:
        """Distance of a value from the anchor, in z."""
        c = self.coordinate
        return c.z(value) - (c.z(anchor[c.name]) if c.name in anchor else 0.0)

    def on(self, trial: Trial, size: int) -> Array:
        """The derivative for a simulation of `size` ticks: later closures repeat earlier ones."""
        return of_length(self.signals[trial.name], trial, size)


def of_length(known: Array, trial: Trial, size: int) -> Array:
    """Signals (k, size) of a simulation from its begin (k, ticks), which holds all closures that others repeat."""
    if known.shape[1] >= size:
        return known[:, :size]
    index = np.arange(size)
    starts = [round(c.start / trial.period) for c in trial.closures]
    for closure, start, stop, like in zip(
        trial.closures, starts, [*starts[1:], size], trial.repeats, strict=True
    ):
        if stop > known.shape[1]:
            shift = starts[like] - trial.same_place(closure, trial.closures[like])
            index[max(start, 0) : stop] = shift + np.arange(max(start, 0), stop)
    return known[:, np.clip(index, 0, known.shape[1] - 1)]


def rig_for(rig: Rig, model: Model, coordinates: Sequence[Coordinate], threads: int = 1) -> Rig:
    """The rig to search with: the rig itself, or anchored at the nominal values where the model's plant is slow.

    The slow plant's slopes are taken there along the coordinates that are known well: near to their nominal values is
    where the truth is expected.  Across a wide prior a slope at its middle would lead astray.
    """
    if model.plant in SLOW_PLANTS and isinstance(rig, PlantRig):
        return AnchoredRig(rig, model, {}, threads=threads).sloped([c for c in coordinates if not c.wide])
    return rig


def exact_rig(rig: Rig) -> Rig:
    """The rig that simulates the model's own plant."""
    return rig.exact if isinstance(rig, AnchoredRig) else rig


def anchored_at(rig: Rig, model: Model, values: Mapping[str, float]) -> Rig:
    """The rig with its anchor moved, where it has one."""
    return rig.anchored(model, values) if isinstance(rig, AnchoredRig) else rig

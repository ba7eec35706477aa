"""A slow plant seen through a fast one, so that a search of thousands of simulations needs only a few slow ones.

    signal(z) = fast(z) + [slow(a) - fast(a)] + sum_j [dslow/dz_j - dfast/dz_j] (z_j - a_j)

At the anchor a this is the slow plant exactly.  Its slopes are the slow plant's too for every coordinate whose
difference of slopes was taken (space mapping that is consistent to first order: Alexandrov, Lewis 2001; Bandler et al.
2004); for the others the fast plant's count.  A fit moves the anchor to where it ends and goes on until it stays
there, so that what is reported at the end was simulated on the slow plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType
from numpy.typing import NDArray

from .features import Block, compact_end, has_memory
from .problem import Coordinate
from .rig import Nuisance, PlantRig, Rig
from .trials import Trial

Array = NDArray[np.float64]
Anchor = tuple[Any, ...]
Key = tuple[Any, ...]

FAST_PLANT = "reduced"
SLOW_PLANTS = ("mujoco",)
"""Plants of which a whole diagnosis would take longer than a coffee."""

KNOWN_WELL = Nuisance.step
"""Step of finite differences, in standard deviations, of a parameter whose prior is narrow; smaller is a wide one."""

KEPT = 64
"""Corrections that are kept: one per anchor, trial and length."""


class AnchoredRig:
    """A rig whose slow plant is replaced by the fast one, a correction taken at an anchor, and slopes.

    exact   the rig itself
    """

    def __init__(
        self,
        exact: PlantRig,
        model: Model,
        values: Mapping[str, float],
        slopes: Mapping[str, _Slope] | None = None,
        corrections: dict[Key, Array] | None = None,
    ) -> None:
        self.exact = exact
        self.trials = exact.trials
        self.floor, self.points, self.pooled = exact.floor, exact.points, exact.pooled
        self.drive_signals, self.without = exact.drive_signals, exact.without
        self.phases, self.figures, self.experiments = exact.phases, exact.figures, exact.experiments
        self._model, self._values = model, dict(values)
        self._anchor: Anchor = (model.sha256, *sorted(self._values.items()))
        self._slopes = dict(slopes or {})
        self._corrections: dict[Key, Array] = corrections if corrections is not None else {}

    def __reduce__(self) -> tuple[Any, ...]:
        return AnchoredRig, (self.exact, self._model, self._values, self._slopes, self._corrections)

    def identity(self) -> tuple[Any, ...]:
        """See PlantRig."""
        return ("anchored", self.exact, self._model, self._values, self._slopes)

    def anchored(self, model: Model, values: Mapping[str, float]) -> AnchoredRig:
        """The same with another anchor; slopes change little along the way and stay."""
        return AnchoredRig(self.exact, model, values, self._slopes, self._corrections)

    def sloped(self, coordinates: Sequence[Coordinate]) -> AnchoredRig:
        """The same with the slow plant's slopes at the anchor for these coordinates."""
        slopes = dict(self._slopes)
        for c in coordinates:
            slopes[c.name] = self._slope(c)
        return AnchoredRig(self.exact, self._model, self._values, slopes, self._corrections)

    @property
    def slopes(self) -> frozenset[str]:
        """Names of the coordinates whose slopes are the slow plant's."""
        return frozenset(self._slopes)

    def nuisances(self, model: Model) -> Sequence[Nuisance]:
        """See Rig."""
        return self.exact.nuisances(model)

    def own_error(self, block: Block, model: Model) -> Array:
        """See Rig."""
        return self.exact.own_error(block, model)

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
        return np.array([run[name] for name in trial.signals])

    def _slow(self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array) -> Array:
        run = self.exact.simulate(model, values, trial, reference)
        return np.array([run[name] for name in trial.signals])

    def _difference(self, values: Mapping[str, float], trial: Trial, reference: Array) -> Array:
        """Slow - fast (signals, ticks); the whole trial only where both plants gave it."""
        slow = self._slow(self._model, values, trial, reference)
        fast = self._fast(self._model, values, trial, reference)
        ticks = min(slow.shape[1], fast.shape[1])
        return slow[:, :ticks] - fast[:, :ticks]

    def _correction(self, trial: Trial, reference: Array, size: int) -> Array:
        if not has_memory(self._model):
            reference = reference[: compact_end(trial)]
        key = (self._anchor, trial.name, reference.size)
        if key not in self._corrections:
            while len(self._corrections) >= KEPT:
                del self._corrections[next(iter(self._corrections))]
            self._corrections[key] = self._difference(self._values, trial, reference)
        return repeated(self._corrections[key], trial, size)

    def _slope(self, c: Coordinate) -> _Slope:
        _, _, where = c.name.partition("@")
        here = c.z(self._values[c.name]) if c.name in self._values else 0.0
        step = c.inside_step(here)
        moved = {**self._values, c.name: c.value(here + step)}
        signals = {}
        for trial in self.trials:
            if where in ("", trial.name):
                reference = trial.reference[: compact_end(trial)]
                change = self._difference(moved, trial, reference)
                change = change[:, : reference.size] - self._correction(trial, reference, reference.size)
                signals[trial.name] = change / step
        return _Slope(c, signals)


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
        """The derivative for a simulation of `size` ticks: later closures repeat the second."""
        return repeated(self.signals[trial.name], trial, size)


def repeated(known: Array, trial: Trial, size: int) -> Array:
    """Signals (k, size) of a simulation from one of the first two closures (k, ticks): the others repeat the second."""
    if known.shape[1] >= size:
        return known[:, :size]
    index = np.arange(size)
    starts = [round(c.start / trial.period) for c in trial.closures]
    if len(starts) > 2:
        late = index[known.shape[1] :] - starts[1]
        index[known.shape[1] :] = starts[1] + late % round(float(np.median(np.diff(starts))))
    return known[:, np.minimum(index, known.shape[1] - 1)]


def rig_for(rig: Rig, model: Model, coordinates: Sequence[Coordinate]) -> Rig:
    """The rig to search with: the rig itself, or anchored at the nominal values where the model's plant is slow.

    The slow plant's slopes are taken there along the coordinates that are known well: near to their nominal values is
    where the truth is expected.  Across a wide prior a slope at its middle would lead astray.
    """
    if model.plant in SLOW_PLANTS and isinstance(rig, PlantRig):
        return AnchoredRig(rig, model, {}).sloped([c for c in coordinates if c.step >= KNOWN_WELL])
    return rig


def exact_rig(rig: Rig) -> Rig:
    """The rig that simulates the model's own plant."""
    return rig.exact if isinstance(rig, AnchoredRig) else rig


def anchored_at(rig: Rig, model: Model, values: Mapping[str, float]) -> Rig:
    """The rig with its anchor moved, where it has one."""
    return rig.anchored(model, values) if isinstance(rig, AnchoredRig) else rig

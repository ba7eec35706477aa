"""The statistical problem: whitened residuals between a model and a data set, with what repeats tell about the noise.

The mean of n closures is uncertain by the noise of the sensors and by the scatter from closure to closure.  The scatter
moves whole curves, not single samples: it is expressed in the simulator's own parameters (friction, object place,
encoder zero ...), whose sensitivities are known, so that 13 closures are enough to estimate it.

    C_c = (diag(v) + J_c S J_c^T) / n        per recording and condition c; v smoothed sample variance,
                                             S = diag(scatter variances)

Where the model's form is not exactly that of the machine (a real hand, another simulator) its own error is added, which
does not average out over the closures: a smooth random curve of the width `rig.own_error` (Kennedy, O'Hagan 2001, with
a fixed width).

Whitened residual: L_c^{-1} (measured - predicted), C_c = L_c L_c^T.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_sim.effect import EffectType
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from .features import Block, Features, alike
from .rig import STEP, WIDE_STEP, Nuisance, Rig

Array = NDArray[np.float64]
Part = tuple[NDArray[np.int64], Array]
"""Rows of the features, and a Cholesky factor of a covariance of them."""

CHANCE = 2.0
"""Standard deviations above its mean that noise may make the sum of squares of a signal without being an error."""

FAILED = 1e3
WORSE = 10.0
"""Whitened residual of a simulation that diverged: a large finite penalty, at least FAILED and so many times the
largest of a machine that stands still.  Where a machine repeats well, an honest error may be more than FAILED."""

AT_END = 1e-3
"""Part of a parameter's range within which it is at the end of it: a fit stops short of its bounds."""

SMALLEST_STRENGTH = 0.02
"""In typical values: an effect weaker than this is stepped as if it were this strong, well above the roughness of a
simulation with dry friction."""


@dataclass(frozen=True)
class Coordinate:
    """One dimension of the search: maps z to a parameter's value.

    prior    True for a parameter with a standard normal prior on z: a nuisance, or a `form`
    scale    value = offset + scale z, or offset exp(scale z) if log
    part     True for a part of a whole
    form     True for a shape of an effect of which a usual value is known
    wide     True for a nuisance parameter whose prior tells next to nothing
    below    scale of z below 0 if it is another, or, if log, value = offset (1 + below z) there; 0: as above it
    """

    name: str
    offset: float
    scale: float
    log: bool
    lower: float
    upper: float
    prior: bool
    step: float
    unit: str = ""
    part: bool = False
    form: bool = False
    wide: bool = False
    below: float = 0.0

    @property
    def nuisance(self) -> bool:
        """True for a parameter of the machine or of a recording, not of an effect."""
        return self.prior and not self.form

    def scale_at(self, z: float) -> float:
        """What a unit of z is at z: of the value, or of its logarithm."""
        return self.below if self.below and z < 0.0 else self.scale

    def value(self, z: float) -> float:
        if not self.log:
            raw = self.offset + self.scale_at(z) * z
        elif self.below and z < 0.0:
            raw = self.offset * (1.0 + self.below * z)
        else:
            # A step of the search may go to where no number is; the bounds bring it back.
            raw = self.offset * math.exp(min(self.scale * z, 700.0))
        return min(max(raw, self.lower), self.upper)

    def z(self, value: float) -> float:
        away = value - self.offset
        if not self.log:
            return away / self.scale_at(away)
        if self.below and away < 0.0:
            return away / self.offset / self.below
        return float(np.log(value / self.offset)) / self.scale

    def inside_step(self, z: float, wanted: float | None = None) -> float:
        """Step of a finite difference at z that stays inside the bounds; of the usual length, or as wanted."""
        low, high = self.bounds
        usual = self.step if self.prior or self.log else self.step * max(abs(z), SMALLEST_STRENGTH)
        step = usual if wanted is None else wanted
        if z + step > high:
            step = -step
        if z + step < low:
            step = 0.5 * (high - z) if high - z > z - low else 0.5 * (low - z)
        return step

    @property
    def bounds(self) -> tuple[float, float]:
        low = (
            -np.inf
            if not np.isfinite(self.lower) or (self.log and self.lower <= 0.0 and not self.below)
            else self.z(self.lower)
        )
        high = np.inf if not np.isfinite(self.upper) else self.z(self.upper)
        return low, high

    def at_end(self, z: float, near: float | None = None) -> bool:
        """True close to an end of the range, other than where an effect is switched off or a part is all of it.

        near  how close; AT_END of a finite range if None
        """
        low, high = self.bounds
        if near is None:
            near = AT_END * (high - low) if np.isfinite(high - low) else -1.0
        return not self.part and any(
            abs(z - end) <= near for end in (low, high) if end != 0.0 and np.isfinite(end)
        )


def values_at(coordinates: Sequence[Coordinate], z: Array) -> dict[str, float]:
    """Values by name of a point z (k,), in their units."""
    return {c.name: c.value(float(v)) for c, v in zip(coordinates, z, strict=True)}


def nuisance_coordinate(nuisance: Nuisance) -> Coordinate:
    """z in standard deviations of the prior."""
    usual = WIDE_STEP if nuisance.wide else STEP
    return Coordinate(
        nuisance.name,
        nuisance.mean,
        nuisance.sd,
        nuisance.log,
        nuisance.lower,
        nuisance.upper,
        True,
        usual if nuisance.step is None else nuisance.step,
        nuisance.unit,
        wide=nuisance.wide,
        below=nuisance.below,
    )


def effect_coordinates(effect: EffectType) -> list[Coordinate]:
    """z in units of the typical value, or of what is usual about it; other positive shapes on a logarithmic scale."""
    out = []
    for p in effect.parameters:
        if p.sd:
            name, step = f"{effect.name}.{p.name}", STEP
            out.append(
                Coordinate(
                    name, p.typical, p.sd, False, p.lower, p.upper, True, step, p.unit, p.part, form=True
                )
            )
        elif p.vanishing is None and p.lower > 0.0:
            # The last of many waves moves far when the period changes a little.
            step = 1e-4 if p.period else 0.03
            out.append(
                Coordinate(
                    f"{effect.name}.{p.name}", p.typical, 1.0, True, p.lower, p.upper, False, step, p.unit
                )
            )
        else:
            away = p.vanishing or 0.0
            scale = abs(p.typical - away) or (0.25 if p.part else 0.05) * (p.upper - p.lower)
            name = f"{effect.name}.{p.name}"
            out.append(Coordinate(name, away, scale, False, p.lower, p.upper, False, 0.03, p.unit, p.part))
    return out


def vanishing_entry(
    effect: EffectType, source: str | None, shape: Mapping[str, float] | None = None
) -> EffectEntry:
    """The effect switched off, in a model in which its parameters can then be moved."""
    values = {
        p.name: p.vanishing if p.vanishing is not None else (shape or {}).get(p.name, p.typical)
        for p in effect.parameters
    }
    return effect.entry(values, source=source)


@dataclass
class Counts:
    """Simulations of the whole data set so far, and those that diverged."""

    simulations: int = 0
    failures: int = 0


@dataclass
class Problem:
    """Data, noise and rig of one data set; counts its simulations.

    whitener    per recording and condition, rows of the features and the Cholesky factor of their covariance; every
                feature has its place in one of them
    deviations  per block (m, p), scatter of the m closures that start alike: what the model does not predict of their
                differences
    discrepancy  rows of the features and the Cholesky factor of the covariance of the model's own error, if it has one
    held        parameters that have these values whatever else is tried
    """

    rig: Rig
    features: Features
    whitener: tuple[Part, ...]
    deviations: tuple[Array, ...]
    counts: Counts = field(default_factory=Counts)
    discrepancy: tuple[Part, ...] = ()
    held: Mapping[str, float] = field(default_factory=dict)
    _measured: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._measured = self.features.measured

    @property
    def simulations(self) -> int:
        return self.counts.simulations

    @property
    def failures(self) -> int:
        return self.counts.failures

    @property
    def of_others(self) -> bool:
        """Whether the recordings are of a machine that no model has the form of."""
        return self.rig.foreign or bool(self.discrepancy)

    @cached_property
    def failed(self) -> float:
        """The whitened residual of a simulation that diverged; see WORSE."""
        return max(FAILED, WORSE * float(np.abs(self.whiten(self._measured)).max(initial=0.0)))

    def with_rig(self, rig: Rig) -> Problem:
        """The same data and noise seen with another rig; the counts go on together."""
        return self if rig is self.rig else replace(self, rig=rig)

    def whiten(self, difference: Array) -> Array:
        """L^{-1} difference, for a vector (size,) or columns (size, k)."""
        out = np.empty_like(difference)
        for rows, lower in self.whitener:
            # scipy.linalg.solve_triangular is this, and takes several times as long to look at what it was given.
            out[rows] = dtrtrs(lower.T, difference[rows], lower=0, trans=1)[0]
        return out

    def own_errors(self, residual: Array) -> list[tuple[Block, float]]:
        """Blocks for which the model has an error of its own, and how large their error is in its standard deviations.

        residual    whitened (size,)
        The root mean square over the phases, each weighted by the precision that is expected of the model there,
        without what noise and scatter of the closures add to it by chance.
        """
        raw = np.empty_like(residual)
        for rows, lower in self.whitener:
            raw[rows] = lower @ residual[rows]
        return [
            (block, math.sqrt(max(float(weight @ raw[where] ** 2) - by_chance, 0.0)))
            for block, where, weight, by_chance in self._judged
        ]

    @cached_property
    def _judged(self) -> list[tuple[Block, slice, Array, float]]:
        """Per block with an error of the model's own: where its mean closure stands, the weights (p,) of its squares,
        and what noise and scatter make of their sum: the mean, and CHANCE standard deviations of Gaussian noise.
        """
        own = np.zeros(self.features.size)
        of = {int(rows[0]): lower @ lower.T for rows, lower in self.discrepancy if rows.size}
        covariances: dict[int, tuple[int, Array]] = {}
        for rows, lower in self.whitener:
            first = int(rows[0])
            if first in of:
                own[rows] = of[first].diagonal()
                covariance = lower @ lower.T - of[first]
                covariances |= {int(row): (k, covariance) for k, row in enumerate(rows)}
        out = []
        for block, both in zip(self.features.blocks, self.features.slices, strict=True):
            where = slice(both.start, both.start + block.phase.size)
            if own[where].any():
                precision = 1.0 / own[where]
                weight = precision**2 / precision.sum()
                k, covariance = covariances[where.start]
                part = covariance[k : k + block.phase.size, k : k + block.phase.size]
                mean = float(weight @ part.diagonal())
                spread = math.sqrt(2.0 * float(weight @ part**2 @ weight))
                out.append((block, where, weight, mean + CHANCE * spread))
        return out

    def residual(self, model: Model, values: Mapping[str, float]) -> Array:
        """Whitened (measured - predicted), (size,); `failed` in each where the simulation diverges."""
        self.counts.simulations += 1
        try:
            predicted = self.features.predict(self.rig, model, {**self.held, **values})
        except PlantDiverged:
            self.counts.failures += 1
            return np.full(self._measured.size, self.failed)
        return self.whiten(self._measured - predicted)


def build_problem(
    rig: Rig,
    features: Features,
    model: Model,
    nuisances: Sequence[Nuisance],
    values: Mapping[str, float],
    counts: Counts | None = None,
) -> Problem:
    """Estimate noise and scatter from the repeats, with sensitivities taken at `values` of `model`.

    Where a condition has a single closure its scatter is that of the priors (closure_sd), and its sample variance is
    taken from the roughness of the curve.
    """
    features = features.compacted(rig, model, values)
    base = features.closures(rig, model, values)
    # What the model says of the differences between closures (a motor that heats up) is no scatter, and what it gets
    # wrong of the first, which starts from another state, is none either; where that is hardly seen, it stays scatter.
    rest = [b.measured - predicted for b, predicted in zip(features.blocks, base, strict=True)]
    if not rig.approximate:
        rest = [alike(e) for e in rest]
    deviations = [e - e.mean(axis=0) for e in rest]
    variances = []
    for block, e in zip(features.blocks, deviations, strict=True):
        span = float(np.ptp(block.measured)) or 1.0
        floor = (rig.floor * span) ** 2
        variances.append(sample_variance(block.measured, e) + floor)
    if rig.pooled:
        variances = _pooled(features, variances)
    columns: list[list[Array]] = []
    scatter_names = [n for n in nuisances if n.closure_sd > 0.0 and not rig.pooled]
    for nuisance in scatter_names:
        c = nuisance_coordinate(nuisance)
        here = c.z(values.get(nuisance.name, nuisance.mean))
        for step in (c.step, -c.step):
            try:
                moved = features.closures(rig, model, {**values, nuisance.name: c.value(here + step)})
            except PlantDiverged:
                continue
            # sensitivity to one standard deviation of the closure-to-closure scatter
            factor = nuisance.closure_sd / c.scale_at(here) / step
            columns.append([(m - b).mean(axis=0) * factor for m, b in zip(moved, base, strict=True)])
            break

    whitener: list[Part] = []
    discrepancy: list[Part] = []
    for trial, condition in dict.fromkeys((block.trial, block.condition) for block in features.blocks):
        own = [k for k, b in enumerate(features.blocks) if (b.trial, b.condition) == (trial, condition)]
        jacobian = (
            np.column_stack([np.concatenate([column[k] for k in own]) for column in columns])
            if columns
            else np.zeros((sum(variances[k].size for k in own), 0))
        )
        single = _covariance_of_one(features, own, variances, deviations, jacobian)
        form = rig.own_error([features.blocks[k] for k in own], model)
        for part in _parts(features, own):
            covariance = single[part.ix] / np.maximum.outer(part.count, part.count)
            own_error = np.outer(part.share, part.share) * form[part.ix]
            if own_error.any():
                covariance = covariance + own_error
                discrepancy.append((part.rows, _factor(own_error, condition)))
            whitener.append((part.rows, _factor(covariance, condition)))
    covered = np.sort(np.concatenate([rows for rows, _ in whitener]))
    assert np.array_equal(covered, np.arange(features.size)), "the whitener must cover each feature once"
    return Problem(rig, features, tuple(whitener), tuple(deviations), counts or Counts(), tuple(discrepancy))


def _factor(covariance: Array, condition: str) -> Array:
    """Cholesky factor; HannesError where a signal is known without any error."""
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise HannesError(
            f"A signal of condition '{condition}' neither scatters nor moves, so that nothing can be weighed against "
            "it: was it measured? Name the signals that were with --signal, or leave the recording out."
        ) from None


def _covariance_of_one(
    features: Features,
    own: Sequence[int],
    variances: Sequence[Array],
    deviations: Sequence[Array],
    jacobian: Array,
) -> Array:
    """Covariance of one closure over the phases of the blocks `own` of one recording and condition, one after another.

    jacobian   (phases, k) sensitivities to the scatter
    Where signals cover different numbers of closures, those that cover the most tell the scatter.
    """
    v = np.concatenate([variances[k] for k in own])
    power = np.ones(jacobian.shape[1])
    most = max(features.blocks[k].n for k in own)
    if most >= 3 and jacobian.shape[1]:
        full = [k for k in own if features.blocks[k].n == most]
        told = np.concatenate([np.full(variances[k].size, features.blocks[k].n == most) for k in own])
        e = np.concatenate([deviations[k] for k in full], axis=1)
        power, v[told] = _estimate_scatter(e, jacobian[told], v[told])
    return np.asarray(np.diag(v) + (jacobian * power) @ jacobian.T)


def _pooled(features: Features, variances: Sequence[Array]) -> list[Array]:
    """The same variance for all samples of a signal; where phases lie closer together, a sample counts less."""
    steps = [float(block.phase[1] - block.phase[0]) for block in features.blocks]
    out = []
    for block, v, step in zip(features.blocks, variances, steps, strict=True):
        own = [k for k, other in enumerate(features.blocks) if other.signal == block.signal]
        seconds = np.array([steps[k] * variances[k].size for k in own])
        mean = float(seconds @ [variances[k].mean() for k in own] / seconds.sum())
        out.append(np.full(v.size, mean * float(np.mean([steps[k] for k in own])) / step))
    return out


@dataclass(frozen=True)
class _Rows:
    """Mean or drift of blocks that belong together.

    rows    (p,) of the features
    ix      where they are among the phases of those blocks, as np.ix_ gives it
    count   (p,) what divides the covariance of one closure: of two rows the larger one, as if the closures that the one
            signal covers were among those of the other
    share   (p,) part of the model's own error that they have
    """

    rows: NDArray[np.int64]
    ix: tuple[NDArray[np.int64], ...]
    count: Array
    share: Array


def _parts(features: Features, own: Sequence[int]) -> list[_Rows]:
    """Mean and drift of the blocks of one recording and condition.

    In the drift an error of the first closure alone counts; the form of the model is the same for the others.  Where
    all begin anew there is no such first.
    """
    blocks = [features.blocks[k] for k in own]
    anew = features.trials[blocks[0].trial].anew
    begins = np.cumsum([0, *(b.phase.size for b in blocks)])
    out = []
    for drift in (False, True):
        rows, places, counts = [], [], []
        for k, block, begin in zip(own, blocks, begins[:-1], strict=True):
            if drift and block.size == block.phase.size:
                continue
            ramp = np.linspace(-0.5, 0.5, block.n)
            start = features.slices[k].start + (block.phase.size if drift else 0)
            rows.append(np.arange(start, start + block.phase.size))
            places.append(np.arange(begin, begin + block.phase.size))
            counts.append(np.full(block.phase.size, float(ramp @ ramp) if drift else float(block.n)))
        if rows:
            count, at = np.concatenate(counts), np.concatenate(places)
            share = np.ones(count.size) if not drift else np.zeros(count.size) if anew else 0.5 / count
            out.append(_Rows(np.concatenate(rows), np.ix_(at, at), count, share))
    return out


def _smooth(values: Array, width: int = 9) -> Array:
    """Moving average with shrinking windows at the ends."""
    width = min(width, values.size)
    kernel = np.ones(width)
    norm: Array = np.convolve(np.ones(values.size), kernel, mode="same")
    out: Array = np.convolve(values, kernel, mode="same") / norm
    return out


def sample_variance(measured: Array, deviations: Array) -> Array:
    """Variance of one sample along the phase (p,), smoothed."""
    n = measured.shape[0]
    if n >= 3:
        return _smooth((deviations**2).sum(axis=0) / (deviations.shape[0] - 1))
    # One or two closures: the second difference of a smooth curve is mostly noise (variance factor 6).
    second = np.diff(measured.mean(axis=0), 2)
    robust = (np.median(np.abs(second)) / 0.6745) ** 2 / 6.0 * n
    return np.full(measured.shape[1], robust)


def _estimate_scatter(deviations: Array, jacobian: Array, variance: Array) -> tuple[Array, Array]:
    """Power of each scatter direction, relative to its prior, and the sample variance (p,) that it leaves.

    Each closure's deviation (n, p) is explained by ridge regression on the sensitivities; the mean square of the
    coefficients, shrunk towards the prior (1) with the weight of three closures, is the power.
    """
    n = deviations.shape[0]
    weighted = jacobian / variance[:, None]
    gram = jacobian.T @ weighted + np.eye(jacobian.shape[1])
    coefficients = np.linalg.solve(gram, weighted.T @ deviations.T)
    spread = np.diag(np.linalg.inv(gram))
    power = (coefficients**2).sum(axis=1) / (n - 1) + spread
    power = (power * (n - 1) + 3.0) / (n + 2.0)
    rest = deviations - (jacobian @ coefficients).T
    left = _smooth((rest**2).sum(axis=0) / (n - 1))
    return power, np.clip(left, 0.05 * variance, variance)

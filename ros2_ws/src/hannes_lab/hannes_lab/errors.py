"""Errors between model and measurement in units that people know: SI, and multiples of the repeatability."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hannes_description.model import Model
from numpy.typing import NDArray
from scipy.special import fdtri

from .features import Block, Features
from .fit import fit
from .problem import Coordinate, Problem
from .surrogate import anchored_at

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SignalError:
    """Error of one signal in one condition.

    rmse           root mean square of measured - model over closures and phases, in unit
    repeatability  root mean square of the closures around their own mean (n - 1 in the denominator), in unit
    ratio          rmse / repeatability: 1 is as good as the machine repeats itself
    """

    condition: str
    signal: str
    unit: str
    rmse: float
    repeatability: float
    ratio: float

    def to_dict(self) -> dict[str, Any]:
        return self.__dict__.copy()


def repeatability(block: Block) -> float:
    """Root mean square scatter of the closures of a block, in its unit; NaN for a single closure.

    The first of four or more closures is left out: it starts from another state than the others.
    Closures that are the same bit for bit have Block.floor.
    """
    closures = block.alike
    if closures.shape[0] < 2:
        return float("nan")
    e = closures - closures.mean(axis=0)
    return max(float(np.sqrt((e**2).sum(axis=0).mean() / (closures.shape[0] - 1))), block.floor)


def signal_errors(
    features: Features, closures: Sequence[Array], floor: Sequence[float] | None = None
) -> tuple[SignalError, ...]:
    """Errors of predicted closures, one per block.

    `floor` replaces the repeatability (held-out parts are too small).
    """
    out = []
    for k, (block, predicted) in enumerate(zip(features.blocks, closures, strict=True)):
        rmse = float(np.sqrt(((block.measured - predicted) ** 2).mean()))
        repeat = repeatability(block) if floor is None else floor[k]
        out.append(
            SignalError(
                block.condition,
                block.signal,
                block.unit,
                rmse,
                repeat,
                rmse / repeat if repeat > 0 else float("nan"),
            )
        )
    return tuple(out)


def overall(errors: Sequence[SignalError]) -> float:
    """One number: root mean square of the ratios over all signals and conditions; NaN ratios are left out."""
    ratios = np.array([e.ratio for e in errors if np.isfinite(e.ratio)])
    return float(np.sqrt((ratios**2).mean())) if ratios.size else float("nan")


def pooled_repeatability(features: Features) -> dict[str, float]:
    """Repeatability of each signal over all conditions, weighted by their duration, in its unit; 0 if unknown."""
    out: dict[str, float] = {}
    for signal in dict.fromkeys(b.signal for b in features.blocks):
        own = [b for b in features.blocks if b.signal == signal and b.n > 1]
        seconds = np.array([b.phase[-1] - b.phase[0] for b in own])
        power = np.array([repeatability(b) ** 2 for b in own])
        out[signal] = float(np.sqrt(seconds @ power / seconds.sum())) if own else 0.0
    return out


def apart_alone(features: Features, closures: Sequence[Array], most: float) -> tuple[SignalError, ...]:
    """Errors of predicted closures, one per block, of what was recorded once and is off by more than others repeat.

    Against the repeatability of the signal over the conditions that were repeated: those of more than `most` times it,
    where the mean errors of all that were recorded once are more than means of repeats scatter (F test, 5 % a signal).
    A bias is what a root mean square of noisy samples hides.
    """
    out: list[SignalError] = []
    for signal, one in pooled_repeatability(features).items():
        own = [k for k, block in enumerate(features.blocks) if block.signal == signal]
        repeats = [b.alike.mean(axis=1) for b in (features.blocks[k] for k in own) if b.n > 1]
        alone = [k for k in own if features.blocks[k].n == 1]
        freedom = sum(m.size - 1 for m in repeats)
        if not alone or freedom == 0 or one == 0.0:
            continue
        left = {k: features.blocks[k].measured - closures[k] for k in alone}
        # A mean of so many samples is known no better than by their own noise.
        noise = one**2 / min(features.blocks[k].phase.size for k in alone)
        scatter = max(sum(float(((m - m.mean()) ** 2).sum()) for m in repeats) / freedom, noise)
        bias = float(np.mean([left[k].mean() ** 2 for k in alone]))
        if bias <= fdtri(len(alone), freedom, 0.95) * scatter:
            continue
        for k in alone:
            block, rmse = features.blocks[k], float(np.sqrt((left[k] ** 2).mean()))
            if rmse > most * one:
                out.append(SignalError(block.condition, signal, block.unit, rmse, one, rmse / one))
    return tuple(out)


def per_signal(features: Features, errors: Iterable[Sequence[SignalError]]) -> dict[str, float]:
    """Root mean square error of each signal over the conditions, weighted by their duration, in the signal's unit."""
    duration = {(b.condition, b.signal): float(b.phase[-1] - b.phase[0]) for b in features.blocks}
    total: dict[str, float] = {}
    weight: dict[str, float] = {}
    for e in (e for own in errors for e in own):
        seconds = duration[(e.condition, e.signal)]
        total[e.signal] = total.get(e.signal, 0.0) + seconds * e.rmse**2
        weight[e.signal] = weight.get(e.signal, 0.0) + seconds
    return {signal: float(np.sqrt(total[signal] / weight[signal])) for signal in total}


def condition_error(
    features: Features,
    errors: Iterable[Sequence[SignalError]],
    units: Mapping[str, float] | None = None,
) -> float:
    """Errors on held-out conditions as one number: root mean square over signals, in multiples of the repeatability.

    Errors of a signal are averaged over the conditions first, in its unit: a condition that happens to repeat well does
    not count more.

    units   errors by signal, of which they are multiples instead
    """
    error = per_signal(features, errors)
    one = pooled_repeatability(features) if units is None else units
    ratios = [error[s] / one[s] for s in error if one.get(s, 0.0) > 0.0]
    return float(np.sqrt(np.mean(np.square(ratios)))) if ratios else float("nan")


def split_closures(features: Features) -> tuple[Features, Features]:
    """Training and held-out closures: every second closure of each block is held out."""

    def part(first: int) -> Features:
        blocks = []
        for block in features.blocks:
            pick = slice(first, None, 2) if block.n > 1 else slice(None)

            def cut(index: tuple[Any, ...] | None, chosen: slice = pick) -> Any:
                return None if index is None else tuple(a[chosen] for a in index)

            blocks.append(
                replace(
                    block,
                    measured=block.measured[pick],
                    full=cut(block.full),
                    compact=cut(block.compact),
                    beside=None if block.beside is None else block.beside[pick],
                )
            )
        return replace(features, blocks=tuple(blocks), slices=())

    return part(0), part(1)


def held_out_closures(
    problem_of: Any, features: Features, model: Model, coordinates: Sequence[Coordinate], start: Array
) -> tuple[float, float]:
    """(training, held-out) overall error after a refit on the training closures only.

    problem_of   builds a Problem from Features (noise and scatter are estimated on the training closures alone)
    """
    train, test = split_closures(features)
    problem: Problem = problem_of(train)
    found = fit(problem, model, coordinates, start, evaluations=6)
    rig = anchored_at(problem.rig, model, found.values)
    floor = [repeatability(block) for block in features.blocks]
    inside = signal_errors(train, train.closures(rig, model, found.values), floor)
    outside = signal_errors(test, test.closures(rig, model, found.values), floor)
    return overall(inside), overall(outside)


def held_out_condition_errors(
    problem: Problem,
    model: Model,
    coordinates: Sequence[Coordinate],
    start: Array,
    known: Mapping[str, Array] | None = None,
) -> dict[str, tuple[SignalError, ...]]:
    """Errors on each condition when it took no part in the fit; see held_out_conditions."""
    found = held_out_conditions(problem, model, coordinates, start, known)
    return {condition: errors for condition, (errors, _) in found.items()}


def held_out_conditions(
    problem: Problem,
    model: Model,
    coordinates: Sequence[Coordinate],
    start: Array,
    known: Mapping[str, Array] | None = None,
) -> dict[str, tuple[tuple[SignalError, ...], dict[str, float]]]:
    """Errors on each condition when it took no part in the fit, and where that fit ended (z by name).

    Parameters of a recording (its object, its own encoder zero: `name@recording`) cannot be known from the others:
    where no condition is left of it, they are fitted on the held-out one with everything else kept.

    known   derivatives (size,) by coordinate name that are taken as constant
    """
    features = problem.features
    out: dict[str, tuple[tuple[SignalError, ...], dict[str, float]]] = {}
    if len(features.conditions) < 2:
        return out
    for condition in features.conditions:
        rows = features.rows(condition)
        found = fit(problem, model, coordinates, start, rows=~rows, known=known, evaluations=6)
        seen = {b.trial for b in features.blocks if b.condition != condition}
        alone = {trial.name for k, trial in enumerate(features.trials) if k not in seen}
        own = [c for c in coordinates if c.name.partition("@")[2] in alone]
        values = found.values
        if own:
            held = {n: v for n, v in values.items() if n not in {c.name for c in own}}
            local = replace(problem, held=held)
            values = {**values, **fit(local, model, own, {}, rows=rows, evaluations=6).values}
        rig = anchored_at(problem.rig, model, values)
        errors = signal_errors(features, features.closures(rig, model, values))
        told = {c.name: float(z) for c, z in zip(coordinates, found.z, strict=True) if c not in own}
        out[condition] = tuple(e for e in errors if e.condition == condition), told
    return out

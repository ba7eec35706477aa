"""95 % intervals of fitted parameters, and how much wider they are than the curvature of the cost says.

The curvature takes what is left for noise that is independent from sample to sample, but for the scatter of which
tolerances speak.  On a machine of others it is not.  A friction that is another in each lap moves whole curves: how far
the closures' own scatter moves the parameters is read off the closures (`sway`).  A law of another form pulls a fit in
each condition elsewhere: how far the parameters move when a condition is left out, against how far they should by the
curvature, says by how much (`strain`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, stdtrit

from .chance import Chance
from .features import Features
from .fit import Fit, prior_weights
from .problem import Problem

NORMAL = 1.96
"""Standard deviations from the middle to the end of a 95 % interval, where the standard deviation is known."""

LEAST_MOVE = 0.1
"""Part of a parameter's variance by which it may move at least when a condition is left out that hardly tells it."""

BORROWED = 3.0
"""Degrees of freedom of a recording's scatter that the others' stand for, at most as many as they have."""

LeftOut = Mapping[str, Mapping[str, float]]
"""Condition -> parameter -> z of a fit without that condition."""


def strain(features: Features, found: Fit, limits: Chance, left_out: LeftOut) -> dict[str, float]:
    """How many times farther each parameter moves when a condition is left out than by the curvature; at least 1.

    Of an efficient estimate the variance of its move is that without the condition less that with it (Hausman 1978,
    Specification tests in econometrics).  Root mean square over the conditions; 1 where none could be left out.
    """
    inflate = _inflation(found, limits)
    whole = np.diag(found.covariance(inflate))
    squares: dict[str, list[float]] = {}
    for condition, moved in left_out.items():
        rows = ~features.rows(condition)
        part = np.diag(replace(found, jacobian=found.jacobian[rows]).covariance(inflate))
        for c, z, variance, without in zip(found.coordinates, found.z, whole, part, strict=True):
            if c.name in moved:
                expected = max(without - variance, LEAST_MOVE * variance)
                squares.setdefault(c.name, []).append((moved[c.name] - float(z)) ** 2 / expected)
    return {name: max(1.0, float(np.sqrt(np.mean(own)))) for name, own in squares.items()}


def sway(problem: Problem, found: Fit, limits: Chance | None = None) -> dict[str, float]:
    """How many times farther the closures' own scatter moves each parameter than by the curvature; at least 1.

    With limits the curvature is that of `intervals_of`, flatter by as much as the misfit is larger than by chance:
    scatter makes the misfit too, and counts once.

    Each closure's deviation from the mean moves the estimate by what it makes of the mean; the squares of those moves
    add up to the estimate's covariance, whatever the noise's correlation along a closure and between signals (the
    sandwich estimator of Huber 1967, with closures as its clusters: Liang, Zeger 1986, Longitudinal data analysis using
    generalized linear models).  Closures of one number in one recording are taken for one lap, which has the same
    scatter in all its conditions.  That few laps know a variance badly is in it: quantiles of Student's t, with degrees
    of freedom after Satterthwaite 1946.  Each recording's variance is moderated by what all recordings have, in
    multiples of what the curvature says of it, with the weight of BORROWED degrees of freedom (Smyth 2004, Linear
    models and empirical Bayes methods): two repeats of one move know nearly nothing of it alone.  What was not repeated
    has the noise that the problem gives it.
    """
    inverse, size = found.covariance(), problem.features.size
    laps: dict[int, dict[int, NDArray[np.float64]]] = {}
    counts: dict[int, int] = {}
    once: NDArray[np.bool_] = np.zeros(size, dtype=bool)
    for block, rows, deviations in zip(
        problem.features.blocks, problem.features.slices, problem.deviations, strict=True
    ):
        n, m = block.n, deviations.shape[0]
        if m < 2:
            once[rows] = True
            continue
        counts[block.trial] = max(counts.get(block.trial, 0), m)
        for k in range(m):
            one = np.zeros((n, deviations.shape[1]))
            one[n - m + k] = deviations[k] * np.sqrt(n / (m - 1.0))
            lap = laps.setdefault(block.trial, {}).setdefault(n - m + k, np.zeros(size))
            lap[rows] += block.combine(one)
    if not laps:
        return {}
    known = np.diag(prior_weights(found.coordinates)) + found.jacobian[once].T @ found.jacobian[once]
    for own, lower in problem.discrepancy:
        columns = np.zeros((size, own.size))
        columns[own] = lower
        moved = found.jacobian.T @ problem.whiten(columns)
        known += moved @ moved.T
    freedoms = np.array([counts[trial] - 1.0 for trial in laps])[:, None]
    parts, expected = np.zeros((2, len(laps), len(found.coordinates)))
    for k, (trial, own_laps) in enumerate(laps.items()):
        moved = inverse @ found.jacobian.T @ problem.whiten(np.stack(list(own_laps.values()), axis=1))
        parts[k] = (moved**2).sum(axis=1)
        seen = problem.features.rows_of(trial) & ~once
        expected[k] = ((inverse @ found.jacobian[seen].T) ** 2).sum(axis=1)
    ratio = (freedoms * parts).sum(axis=0) / np.maximum((freedoms * expected).sum(axis=0), 1e-300)
    borrowed = np.minimum(BORROWED, freedoms.sum() - freedoms)
    parts = (borrowed * ratio * expected + freedoms * parts) / (borrowed + freedoms)
    variance = np.diag(inverse @ known @ inverse) + parts.sum(axis=0)
    by_freedom = (parts**2 / (freedoms + borrowed)).sum(axis=0)
    # What is borrowed was found from the same closures: all of them together tell no more than they are.
    by_freedom = np.maximum(by_freedom, parts.sum(axis=0) ** 2 / freedoms.sum())
    freedom = variance**2 / np.maximum(by_freedom, np.maximum(1e-12 * variance**2, 1e-300))
    # What moves nothing has no width of either kind.
    without = np.diag(inverse if limits is None else found.covariance(_inflation(found, limits)))
    ratios = np.sqrt(variance / np.where(without <= 0.0, 1.0, without)) * stdtrit(freedom, 0.975) / NORMAL
    return {c.name: max(1.0, float(r)) for c, r in zip(found.coordinates, ratios, strict=True)}


def wider(*reasons: Mapping[str, float]) -> dict[str, float]:
    """By how much intervals are wider, by name: of several reasons the largest."""
    return {name: max(r.get(name, 1.0) for r in reasons) for name in {n for r in reasons for n in r}}


def may_vanish(found: Fit, limits: Chance, wider: Mapping[str, float], names: Sequence[str]) -> bool:
    """Whether the 95 % region of some strengths together holds the point at which all of them vanish (z = 0).

    Two that act alike may each be nought by its own interval while both cannot.
    """
    own = [k for k, c in enumerate(found.coordinates) if c.name in names]
    width = np.array([wider.get(found.coordinates[k].name, 1.0) for k in own])
    covariance = found.covariance(_inflation(found, limits))[np.ix_(own, own)] * np.outer(width, width)
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    at = found.z[own] / size
    return bool(
        at @ np.linalg.pinv(covariance / np.outer(size, size), hermitian=True) @ at <= chdtri(len(own), 0.05)
    )


def intervals_of(
    found: Fit, limits: Chance, wider: Mapping[str, float] | None = None
) -> dict[str, tuple[float, float]]:
    """95 % intervals by name, from the curvature of the cost, inside the parameter's bounds.

    Wider by as much as the misfit is larger than chance makes it, and by `wider` times (strain, sway), or by what the
    misfit's jumps say if that is more.
    """
    out, rough = {}, grain_widens(found, limits)
    for c, z, s in zip(found.coordinates, found.z, found.sd(_inflation(found, limits)), strict=True):
        half = NORMAL * float(s) * max((wider or {}).get(c.name, 1.0), rough)
        ends = sorted((c.value(float(z) - half), c.value(float(z) + half)))
        out[c.name] = (ends[0], ends[1])
    return out


def grain_widens(found: Fit, limits: Chance) -> float:
    """How many times wider all intervals are for the misfit's jumps (Fit.grain).

    A fit may end wherever the parabola beneath them has risen by two of their standard deviations beyond the NORMAL^2
    that end an interval.
    """
    return float(np.sqrt(1.0 + 2.0 * found.grain / (NORMAL**2 * _inflation(found, limits))))


def _inflation(found: Fit, limits: Chance) -> float:
    return max(1.0, found.cost / limits.median)

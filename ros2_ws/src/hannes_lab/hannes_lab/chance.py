"""What chance reaches: misfit and best gain of data in which nothing is missing, from the repeats themselves.

Wild bootstrap over closures: the deviations of the closures from their mean, with random signs, averaged, are one draw
of the noise of the mean (Liu 1988, Mammen 1993); for a first closure, which starts from another state, stands another
one.  It keeps all correlation along the closure and between signals,
and it assumes no distribution.  With too few closures to resample, draws come from the estimated covariance instead.
Where closures drift from the first to the last, that is taken out of what an effect may gain by chance: one that
explains how a drift goes does not do so by chance.  It stays in what a complete model may leave: where there is no
effect for it, it is scatter, and is said (prepare.drifts).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .drift import drift_of, steadied
from .fit import Fit
from .problem import Problem

Array = NDArray[np.float64]

MIN_CLOSURES = 5
"""Fewer closures cannot be resampled: their signs span too few draws."""


OWN_ERROR_CAUTION = 2.0
"""Where the model has an error of its own, of which only a width is assumed, an effect must gain so many times more."""


@dataclass(frozen=True)
class Chance:
    """Quantiles under "nothing is missing".

    misfit      critical value of the fitted cost of a complete model
    gain        critical value of the best gain of any effect of the catalogue
    draws       number of draws; resampled: from the closures (True) or from the covariance (False)
    """

    misfit: float
    gain: float
    median: float
    draws: int
    resampled: bool


def noise_draws(problem: Problem, draws: int, rng: np.random.Generator) -> tuple[Array, bool]:
    """Whitened noise of the features (size, draws)."""
    blocks = problem.features.blocks
    resampled = all(block.n >= MIN_CLOSURES for block in blocks)
    if not resampled:
        return rng.standard_normal((problem.features.size, draws)), False
    raw = np.empty((problem.features.size, draws))
    drawn: dict[tuple[int, str, int], tuple[Array, Array]] = {}
    for block, rows, deviation in zip(blocks, problem.features.slices, problem.deviations, strict=True):
        n, m = block.n, deviation.shape[0]
        closures = (block.trial, block.condition, n)
        if closures not in drawn:
            # A first closure that starts from another state scatters like any other.
            which = np.tile(np.arange(n) - (n - m), (draws, 1))
            which[:, : n - m] = rng.integers(m, size=(draws, n - m))
            drawn[closures] = which, rng.choice([-1.0, 1.0], size=(draws, n))
        which, signs = drawn[closures]
        scale = np.sqrt(m / (m - 1.0))
        for k in range(draws):
            raw[rows, k] = block.combine(signs[k][:, None] * deviation[which[k]]) * scale
        if known_to := block.known_to * np.sqrt(n):
            for k in range(draws):
                raw[rows, k] += block.combine(known_to * rng.standard_normal((n, block.phase.size)))
    for own, lower in problem.discrepancy:
        raw[own] += lower @ rng.standard_normal((own.size, draws))
    return problem.whiten(raw), True


def without_drift(problem: Problem) -> Problem:
    """The problem with what drifts taken out of the scatter; the same where nothing drifts."""
    blocks = problem.features.blocks
    drifting = {(block.trial, block.condition) for block in blocks if drift_of(block)}
    if not drifting:
        return problem
    pairs = zip(blocks, problem.deviations, strict=True)
    return replace(
        problem, deviations=tuple(steadied(d) if (b.trial, b.condition) in drifting else d for b, d in pairs)
    )


def chance(
    problem: Problem,
    null: Fit,
    signatures: Mapping[str, Sequence[Array]],
    *,
    draws: int = 400,
    level: float = 0.98,
    seed: int = 0,
) -> Chance:
    """Critical values at the given level, in the linear approximation around a fit.

    signatures   per effect, derivatives (size, k) at vanishing strength for each start of its shape parameters
    """
    noise, resampled = noise_draws(problem, draws, np.random.default_rng(seed))
    prior = np.array([1.0 if c.prior else 1e-6 for c in null.coordinates])
    jacobian = np.vstack([null.jacobian, np.diag(np.sqrt(prior))])
    basis, _ = np.linalg.qr(jacobian)

    def left_of(drawn: Array) -> Array:
        padded = np.vstack([drawn, np.zeros((prior.size, draws))])
        rest: Array = padded - basis @ (basis.T @ padded)
        return rest

    left = left_of(noise)
    misfit = (left**2).sum(axis=0)
    if resampled and (steady := without_drift(problem)) is not problem:
        # The same signs: nothing else differs.
        left = left_of(noise_draws(steady, draws, np.random.default_rng(seed))[0])
    gains = np.zeros(draws)
    for shapes in signatures.values():
        for signature in shapes:
            d = np.vstack([signature, np.zeros((prior.size, signature.shape[1]))])
            d = d - basis @ (basis.T @ d)
            keep = np.linalg.norm(d, axis=0) > 1e-9
            if keep.any():
                q, _ = np.linalg.qr(d[:, keep])
                gains = np.maximum(gains, ((q.T @ left) ** 2).sum(axis=0))
    return Chance(
        float(np.quantile(misfit, level)),
        float(np.quantile(gains, level)) * (OWN_ERROR_CAUTION if problem.discrepancy else 1.0),
        float(np.median(misfit)),
        draws,
        resampled,
    )

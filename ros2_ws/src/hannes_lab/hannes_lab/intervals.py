"""95 % intervals of fitted parameters, and how much wider they are than the curvature of the cost says.

The curvature takes what is left for noise that is independent from sample to sample.  On a machine of others it is not:
a friction that wanders, or a law of another form, pulls a fit in each condition elsewhere.  How far the parameters move
when a condition is left out, against how far they should by the curvature, says by how much.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .chance import Chance
from .features import Features
from .fit import Fit

LEAST_MOVE = 0.1
"""Part of a parameter's variance by which it may move at least when a condition is left out that hardly tells it."""

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


def intervals_of(
    found: Fit, limits: Chance, wider: Mapping[str, float] | None = None
) -> dict[str, tuple[float, float]]:
    """95 % intervals by name, from the curvature of the cost, inside the parameter's bounds.

    Wider by as much as the misfit is larger than chance makes it, and by `wider` times (strain).
    """
    out = {}
    for c, z, s in zip(found.coordinates, found.z, found.sd(_inflation(found, limits)), strict=True):
        half = 1.96 * float(s) * (wider or {}).get(c.name, 1.0)
        ends = sorted((c.value(float(z) - half), c.value(float(z) + half)))
        out[c.name] = (ends[0], ends[1])
    return out


def _inflation(found: Fit, limits: Chance) -> float:
    return max(1.0, found.cost / limits.median)

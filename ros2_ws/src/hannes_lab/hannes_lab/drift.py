"""Closures that change steadily from the first to the last: scatter comes by chance from one to the next, drift not."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from .features import Block

Array = NDArray[np.float64]

DRIFT = 1e-4
"""Chance of a trend below which closures are said to drift."""


def drift_of(block: Block) -> float:
    """Part of the scatter of a block's closures that drifts from the first to the last; 0 where chance may do it.

    Mann-Kendall test (Mann 1945, Kendall 1975) of the closures along their first principal component.  Fewer than ten
    cannot show it.
    """
    if block.n < 3:
        return 0.0
    rising, variance, share = _trend(block.measured)
    return share if _by_chance(rising, variance) < DRIFT else 0.0


def drift_together(curves: Sequence[Array]) -> float:
    """Part of the scatter of several conditions' closures, each (n, p), that drifts alike; 0 where chance may do it.

    The same test of all at once (Hirsch 1982): few closures of each show together what none shows alone.
    """
    found = [_trend(own) for own in curves if own.shape[0] > 2]
    rising, variance = sum(one[0] for one in found), sum(one[1] for one in found)
    if not found or _by_chance(rising, variance) >= DRIFT:
        return 0.0
    return float(np.mean([one[2] for one in found]))


def _trend(curves: Array) -> tuple[int, float, float]:
    """Kendall's sum of n closures (n, p) along their first principal component, its variance by chance, and the part
    of their scatter in that component; positive where they grow in the sense of their mean."""
    n, mean = curves.shape[0], curves.mean(axis=0)
    scores, sizes, along = np.linalg.svd(curves - mean, full_matrices=False)
    sense = 1.0 if along[0] @ (mean - mean[0]) >= 0.0 else -1.0
    rising = int(np.sign(scores[None, :, 0] - scores[:, None, 0])[np.triu_indices(n, 1)].sum() * sense)
    whole = float(np.linalg.norm(sizes))
    share = float((sizes[0] / whole) ** 2) if whole > 0.0 else 0.0
    return rising, n * (n - 1) * (2 * n + 5) / 18.0, share


def _by_chance(rising: int, variance: float) -> float:
    return 2.0 * float(ndtr((1 - abs(rising)) / math.sqrt(variance)))


def steadied(deviations: Array) -> Array:
    """Deviations (m, p) of m closures from their mean without a parabola over their number, scaled to the same freedom.

    What warms up or runs in does so ever more slowly; a straight line leaves too much of it.
    """
    m = deviations.shape[0]
    number = np.linspace(-1.0, 1.0, m)
    trend, _ = np.linalg.qr(np.stack([np.ones(m), number, number**2], axis=1))
    rest: Array = deviations - trend @ (trend.T @ deviations)
    return rest * math.sqrt((m - 1.0) / (m - 3.0))

"""Closures that change steadily from the first to the last: scatter comes by chance from one to the next, drift not."""

from __future__ import annotations

import math

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
    n = block.n
    if n < 3:
        return 0.0
    away = block.measured - block.measured.mean(axis=0)
    scores, sizes, _ = np.linalg.svd(away, full_matrices=False)
    rising = int(np.sign(scores[None, :, 0] - scores[:, None, 0])[np.triu_indices(n, 1)].sum())
    sd = math.sqrt(n * (n - 1) * (2 * n + 5) / 18.0)
    if 2.0 * ndtr((1 - abs(rising)) / sd) >= DRIFT:
        return 0.0
    return float((sizes[0] / np.linalg.norm(sizes)) ** 2)


def steadied(deviations: Array) -> Array:
    """Deviations (m, p) of m closures from their mean without a parabola over their number, scaled to the same freedom.

    What warms up or runs in does so ever more slowly; a straight line leaves too much of it.
    """
    m = deviations.shape[0]
    number = np.linspace(-1.0, 1.0, m)
    trend, _ = np.linalg.qr(np.stack([np.ones(m), number, number**2], axis=1))
    rest: Array = deviations - trend @ (trend.T @ deviations)
    return rest * math.sqrt((m - 1.0) / (m - 3.0))

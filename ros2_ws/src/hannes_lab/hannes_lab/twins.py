"""Effects that do the same as a nominal parameter which a fit takes far off: these data cannot tell them apart.

A dry friction k V / R, for instance, is what a brush drop V is while the current has one sign.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from .problem import Coordinate
from .search import Candidate, Search

Array = NDArray[np.float64]

SAME = 0.98
"""Cosine between what a parameter moves in the whitened data and what an effect can, from which both are the same."""


def twins(search: Search, best: Candidate, far: Sequence[Coordinate]) -> dict[str, tuple[str, ...]]:
    """For each parameter that is far off, the effects that do the same, nearest first; none for those without any.

    In the direction in which the parameter went, and with strengths that the effect may have.
    """
    if not far:
        return {}
    signatures = search.signatures(best)
    z = dict(zip(best.fit.coordinates, best.fit.z, strict=True))
    column = {c: best.fit.jacobian[:, j] for j, c in enumerate(best.fit.coordinates)}
    out = {}
    for c in far:
        moved = float(np.sign(z[c])) * column[c]
        near = {
            name: max((imitation(search, name, moved, derivative) for derivative in shapes), default=0.0)
            for name, shapes in signatures.items()
        }
        same = sorted((name for name, cosine in near.items() if cosine >= SAME), key=lambda n: -near[n])
        if same:
            out[c.name] = tuple(same)
    return out


def imitation(search: Search, name: str, moved: Array, derivative: Array) -> float:
    """Cosine (0..1) between a direction (size,) and the nearest that an effect's strengths (size, k) can move.

    A strength that cannot be less than none only adds.
    """
    size = float(np.linalg.norm(moved))
    if size == 0.0 or not np.isfinite(derivative).all():
        return 0.0
    columns = []
    parameters = search.effect(name).parameters
    strengths = [(p, p.vanishing) for p in parameters if p.vanishing is not None]
    for (p, none), along in zip(strengths, derivative.T, strict=True):
        columns += [along] if p.upper > none else []
        columns += [-along] if p.lower < none else []
    lengths = [float(np.linalg.norm(column)) for column in columns]
    units = [c / length for c, length in zip(columns, lengths, strict=True) if length > 0.0]
    if not units:
        return 0.0
    left = nnls(np.column_stack(units), moved / size)[1]
    return float(np.sqrt(max(0.0, 1.0 - left**2)))

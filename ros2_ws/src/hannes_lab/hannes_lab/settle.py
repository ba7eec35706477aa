"""A fit that was made on a slow plant seen through a fast one, carried on to the slow plant itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .fit import Fit, fit, prior_weights, spread
from .problem import Problem
from .rig import Rig
from .surrogate import AnchoredRig, anchored_at

MOVES = 6
"""How often the anchor moves at most."""

SETTLED = 1.0
"""The anchor stays where a further move lowers the cost by less than this, or by less than LITTLE of it."""

LITTLE = 0.002


def seen_from(problem: Problem, found: Fit) -> Problem:
    """The problem as seen from a fit: a slow plant's anchor is there."""
    return problem.with_rig(anchored_at(problem.rig, found.model, found.values))


def at_anchor(problem: Problem, found: Fit, rows: NDArray[np.bool_] | None) -> tuple[Problem, Fit]:
    """The problem with its anchor at a fit, and the fit with the residual that the slow plant has there."""
    problem = seen_from(problem, found)
    residual = problem.residual(found.model, found.values)
    used = residual if rows is None else residual[rows]
    prior = prior_weights(found.coordinates)
    cost = float(used @ used + (prior * found.z) @ (prior * found.z))
    return problem, replace(found, residual=residual, cost=cost)


def settle(
    problem: Problem,
    found: Fit,
    rows: NDArray[np.bool_] | None = None,
    *,
    moves: int = MOVES,
    renew: bool = True,
) -> tuple[Problem, Fit]:
    """Fit, move the anchor to where the fit ends, and again until it stays there.

    Where the plant is fast already, nothing happens.  The returned problem is anchored at the returned fit.

    renew   take all slopes of the slow plant afresh, once, where a move does not lead down
    """
    if not isinstance(problem.rig, AnchoredRig):
        return problem, found
    problem, best = at_anchor(problem, found, rows)
    problem = _sloped(problem, best, anew=False)
    renewed = not renew
    for _ in range(moves):
        new = fit(
            problem, best.model, best.coordinates, best.z, rows=rows, steps=spread(best), evaluations=15
        )
        least = max(SETTLED, LITTLE * best.cost)
        if best.cost - new.cost < least:
            break
        there, new = at_anchor(problem, new, rows)
        gain = best.cost - new.cost
        if gain > 0.0:
            problem, best = there, new
        if gain < least:
            if renewed:
                break
            problem, renewed = _sloped(problem, best, anew=True), True
    return problem, best


def slopes_at(rig: Rig, found: Fit) -> Rig:
    """The rig as it is close to a fit: a slow plant's anchor is there, with its slopes along the effects."""
    rig = anchored_at(rig, found.model, found.values)
    if not isinstance(rig, AnchoredRig):
        return rig
    return rig.sloped([c for c in found.coordinates if not c.prior])


def _sloped(problem: Problem, found: Fit, anew: bool) -> Problem:
    rig = problem.rig
    assert isinstance(rig, AnchoredRig)
    todo = [c for c in found.coordinates if anew or not c.prior or c.name not in rig.slopes]
    problem.counts.simulations += len(todo)
    return problem.with_rig(rig.sloped(todo))

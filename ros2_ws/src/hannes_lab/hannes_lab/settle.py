"""A fit that was made on a slow plant seen through a fast one, carried on to the slow plant itself."""

from __future__ import annotations

from dataclasses import replace

from hannes_sim.plant import PlantDiverged

from .fit import Fit, fit, prior_weights, spread
from .problem import Problem
from .rig import Rig
from .surrogate import AnchoredRig, anchored_at

MOVES = 12
"""How often the anchor moves, or a fit is carried on, at most."""

SETTLED = 1.0
LITTLE = 0.005
"""The anchor stays where a further move lowers the cost by less than SETTLED, or by less than this part of what noise
does not explain; so does a fit that is carried on."""


def least_gain(found: Fit) -> float:
    """By how much a further move of a fit must lower its cost."""
    return max(SETTLED, LITTLE * (found.cost - found.residual.size))


def seen_from(problem: Problem, found: Fit) -> Problem:
    """The problem as seen from a fit: a slow plant's anchor is there."""
    return problem.with_rig(anchored_at(problem.rig, found.model, found.values))


def at_anchor(problem: Problem, found: Fit) -> tuple[Problem, Fit]:
    """The problem with its anchor at a fit, and the fit with the residual that the slow plant has there."""
    problem = seen_from(problem, found)
    residual = problem.residual(found.model, found.values)
    prior = prior_weights(found.coordinates)
    cost = float(residual @ residual + (prior * found.z) @ (prior * found.z))
    return problem, replace(found, residual=residual, cost=cost)


def settle(
    problem: Problem,
    found: Fit,
    *,
    moves: int = MOVES,
    afresh: bool = False,
) -> tuple[Problem, Fit]:
    """Fit, move the anchor to where the fit ends, and again until it stays there.

    Where the plant is fast already, nothing happens.  The returned problem is anchored at the returned fit.

    afresh  take all slopes of the slow plant where the fit is; otherwise only those that were not taken elsewhere
    """
    if not isinstance(problem.rig, AnchoredRig):
        return problem, found
    problem, best = at_anchor(problem, found)
    problem = _sloped(problem, best, afresh)
    astray = not afresh
    for _ in range(moves):
        new = fit(problem, best.model, best.coordinates, best.z, steps=spread(best), evaluations=15)
        least = least_gain(best)
        if best.cost - new.cost < least:
            break
        failures = problem.failures
        there, new = at_anchor(problem, new)
        if problem.failures > failures:
            break
        there = _taught(there, problem, new)
        gain = best.cost - new.cost
        if gain > 0.0:
            problem, best = there, new
        else:
            problem = problem.with_rig(_anchored(problem).with_slopes_of(_anchored(there)))
        if gain < least and astray:
            break
        astray = gain < least
    return problem, best


def slopes_at(rig: Rig, found: Fit) -> Rig:
    """The rig as it is close to a fit: a slow plant's anchor is there, with its slopes along the effects."""
    rig = anchored_at(rig, found.model, found.values)
    if not isinstance(rig, AnchoredRig):
        return rig
    return rig.sloped([c for c in found.coordinates if not c.prior])


def _sloped(problem: Problem, found: Fit, afresh: bool) -> Problem:
    """The problem with the slow plant's slopes at its anchor; as it was where the slow plant diverges beside it."""
    rig = _anchored(problem)
    todo = [c for c in found.coordinates if afresh or c.name not in rig.slopes]
    problem.counts.simulations += len(todo)
    try:
        return problem.with_rig(rig.sloped(todo))
    except PlantDiverged:
        problem.counts.failures += 1
        return problem


def _taught(there: Problem, before: Problem, found: Fit) -> Problem:
    """The problem at its new anchor, with what the move from the one before says of the slopes."""
    squares = (found.jacobian**2).sum(axis=0)
    weights = {c.name: float(w) for c, w in zip(found.coordinates, squares, strict=True)}
    return there.with_rig(_anchored(there).taught(_anchored(before), weights))


def _anchored(problem: Problem) -> AnchoredRig:
    assert isinstance(problem.rig, AnchoredRig)
    return problem.rig

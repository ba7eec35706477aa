"""Many small effects, one after another: the way to a model of a real machine.

Real residuals are correlated along the motion and never become noise, so that a test against chance does not stop.
Here each round adds the effect with the least error on conditions that took no part in its fit, and the search stops
when the next one would lower that error by less than a given part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .errors import held_out_conditions
from .search import Candidate, Search

JUDGED = 3
"""Candidates of each round (the best fits) whose error on held-out conditions is found."""

ALIKE = 0.02
"""Candidates whose held-out error is this close to the best, as a part of it, tie with it."""


@dataclass(frozen=True)
class Grown:
    """The effects in the order in which they joined.

    first    the first round's candidates, best fit first
    errors   held-out error of the nominal and after each effect, in multiples of the repeatability
    rivals   candidates of the last accepted round that tie with it
    notes    close calls of earlier rounds, and what the next effect would have gained
    """

    best: Candidate
    first: tuple[Candidate, ...]
    errors: tuple[float, ...]
    rivals: tuple[Candidate, ...]
    notes: tuple[str, ...]


def held_out_error(search: Search, candidate: Candidate) -> float:
    """Root mean square over conditions of the error on each when it took no part in the fit.

    The derivatives of the fit to all conditions serve for all refits: leaving one out moves the optimum little.
    """
    fit = candidate.fit
    known = {c.name: fit.jacobian[:, j] for j, c in enumerate(fit.coordinates)}
    errors = held_out_conditions(search.problem, fit.model, fit.coordinates, fit.z, known=known)
    return float(np.sqrt(np.mean([e**2 for e in errors.values()]))) if errors else float("nan")


def grow(search: Search, null: Candidate, max_effects: int, gain: float) -> Grown:
    """Add effects until the held-out error falls by less than `gain` (a part, such as 0.05) or none is left."""
    best = null
    first: tuple[Candidate, ...] = ()
    errors = [held_out_error(search, null)]
    rivals: tuple[Candidate, ...] = ()
    notes: list[str] = []
    for size in range(1, max_effects + 1):
        round_ = search.extend([best], list(search.sources), f"effect {size}")
        if not round_:
            break
        first = first or tuple(round_)
        judged = round_[:JUDGED]
        held = search.each(_held_in_worker, [(c,) for c in judged], f"effect {size}: held-out conditions")
        order = np.argsort(held)
        winner = int(order[0])
        name = judged[winner].names[-1]
        if not held[winner] <= (1.0 - gain) * errors[-1]:
            notes.append(
                f"the next effect, {name}, would lower the held-out error from {errors[-1]:.2f} to "
                f"{held[winner]:.2f}, which is less than {100 * gain:.0f} %: the search stops here"
            )
            break
        if rivals:
            notes.append(_close_call(best, rivals))
        best = judged[winner]
        errors.append(float(held[winner]))
        rivals = tuple(judged[int(k)] for k in order[1:] if held[int(k)] <= (1.0 + ALIKE) * held[winner])
    return Grown(best, first, tuple(errors), rivals, tuple(notes))


def _close_call(best: Candidate, rivals: Sequence[Candidate]) -> str:
    names = " or ".join(c.names[-1] for c in rivals)
    return f"when {best.names[-1]} joined, {names} would have been as good within {100 * ALIKE:.0f} %"


def _held_in_worker(search: Search, candidate: Candidate) -> float:
    return held_out_error(search, candidate)

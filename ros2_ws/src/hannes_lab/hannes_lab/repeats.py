"""Closures that repeat each other need not all be simulated: how many are, and what the others are copied from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from hannes_sim.ports import R_Q, R_QL
from hannes_sim.rollout import Rollout
from numpy.typing import NDArray

from .trials import SAME, Trial

Array = NDArray[np.float64]

FEW = 4
"""Closures that are simulated where the second does not end as the first did; all, if the last two of these do not."""

WORTH = 0.7
"""Part of a recording below which its first FEW closures are worth being simulated alone."""

MARGIN = 60
"""Ticks beyond the end of a closure: a logger shows its last ones later."""


def end_of(trial: Trial, count: int) -> int:
    """Ticks up to the end of the first `count` closures."""
    return min(trial.reference.size, round(trial.closures[count - 1].stop / trial.period) + MARGIN)


def came_back(run: Rollout, trial: Trial, most: float) -> bool:
    """Whether the last closure of a run ends where the one before did, on both sides of the wire: then all repeat it.

    A hand whose joints stick stays where they stop, a little further with each closure, which the encoder hardly shows.

    most  part of the reference's span by which its ends may differ
    """
    ends = [round(closure.stop / trial.period) for closure in trial.closures]
    ends = [end for end in ends if end < run.raw.shape[0]]
    if len(ends) < 2:
        return True
    here, there = run.raw[ends[-1], [R_Q, R_QL]], run.raw[ends[-2], [R_Q, R_QL]]
    return bool(np.abs(here - there).max() <= most * trial.span)


def few_will_do(trial: Trial) -> bool:
    """Whether FEW closures are many fewer than there are, and the others have the same reference."""
    return (
        len(trial.closures) > FEW
        and end_of(trial, FEW) < WORTH * trial.reference.size
        and trial.apart <= SAME
    )


def repeated(signals: Mapping[str, Array], trial: Trial) -> dict[str, Array]:
    """Signals of the whole trial from those of its first FEW closures, the last of which the later ones repeat."""
    like = trial.closures[FEW - 1]
    begin = round(like.start / trial.period)
    places = [
        (round(c.start / trial.period), trial.same_place(c, like) - begin) for c in trial.closures[FEW:]
    ]
    out = {}
    for name, values in signals.items():
        whole = np.full(trial.reference.size, values[-1])
        whole[: values.size] = values
        for start, shift in places:
            one = values[start - shift :][: whole.size - start]
            whole[start : start + one.size] = one
        out[name] = whole
    return out

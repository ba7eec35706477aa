"""Closures that repeat each other need not all be simulated: how many are, and what the others are copied from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from hannes_sim.ports import R_Q, R_QL
from hannes_sim.rollout import Rollout
from numpy.typing import NDArray

from .trials import Trial

Array = NDArray[np.float64]

FEW = 4
"""Closures of each condition that are simulated where the second does not end as the first did; all, if the last two of
these do not."""

WORTH = 0.7
"""Part of a recording below which its first closures, FEW of each condition, are worth being simulated alone."""

MARGIN = 60
"""Ticks beyond the end of a closure: a logger shows its last ones later."""


def end_of(trial: Trial, count: int) -> int:
    """Ticks up to the end of the first `count` closures."""
    return min(trial.reference.size, round(trial.closures[count - 1].stop / trial.period) + MARGIN)


def came_back(run: Rollout, trial: Trial, most: float) -> bool:
    """Whether in each condition the last closure of a run ends where the one before did, on both sides of the wire.

    Then all repeat it.  A hand whose joints stick stays where they stop, a little further with each closure, which the
    encoder hardly shows.

    most  part of the reference's span by which its ends may differ
    """
    ends = [[round(trial.closures[k].stop / trial.period) for k in own] for own in trial.numbers.values()]
    within = [[end for end in own if end < run.raw.shape[0]] for own in ends]
    pairs = [own[-2:] for own in within if len(own) > 1]
    moved = [np.abs(run.raw[there, [R_Q, R_QL]] - run.raw[here, [R_Q, R_QL]]).max() for there, here in pairs]
    return bool(max(moved, default=0.0) <= most * trial.span)


def few(trial: Trial) -> int:
    """How many closures of a trial it takes to have FEW of each condition, or all where there are fewer."""
    return 1 + max(k for own in trial.numbers.values() for k in own[:FEW])


def few_will_do(trial: Trial, same: float) -> bool:
    """Whether that is much less than the whole, and the others have the same reference, in the same order.

    same  see Rig
    """
    count = few(trial)
    return (
        count < len(trial.closures)
        and end_of(trial, count) < WORTH * trial.reference.size
        and trial.apart <= same
        and trial.in_turn
    )


def repeated(signals: Mapping[str, Array], trial: Trial) -> dict[str, Array]:
    """Signals of the whole trial from those of its few first closures: later ones repeat the last of theirs."""
    first = few(trial)
    places = []
    for own in trial.numbers.values():
        like = trial.closures[[k for k in own if k < first][-1]]
        begin = round(like.start / trial.period)
        later = [trial.closures[k] for k in own if k >= first]
        places += [(round(c.start / trial.period), trial.same_place(c, like) - begin) for c in later]
    out = {}
    for name, values in signals.items():
        whole = np.full(trial.reference.size, values[-1])
        whole[: values.size] = values
        for start, shift in sorted(places):
            one = values[start - shift :][: whole.size - start]
            whole[start : start + one.size] = one
        out[name] = whole
    return out

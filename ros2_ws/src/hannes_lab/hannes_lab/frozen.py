"""Closures in which a signal stands still though the reference moves, and though it moves in others like them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .reference import true_runs
from .report_text import listed
from .trials import Closure, Trial, in_words

Array = NDArray[np.float64]

FROZEN = 0.9
MORE = 0.4
"""Part of its reference's way for which a signal that is frozen repeats one number at least, and by how much that is
more than in the closure in which it stands least.  At an object, at the limit of the supply, or with coarse steps at
one speed, a signal may stand for a while; one that freezes on the way out does for the whole way back."""

FEW = 5
"""Samples of which one number may be repeated for all else."""


def without_frozen(trial: Trial) -> Trial:
    """Leave out closures in which a sensor repeats one number while in others of the condition it moves.

    One that never moves is left out as a signal before (units.py), or is refused.
    """
    gone: set[int] = set()
    notes: list[str] = []
    for name, (time, values) in trial.signals.items():
        if not _stands_long(values):
            continue
        mine: list[int] = []
        for numbers in trial.numbers.values():
            still = [_still_way(trial, trial.closures[k], time, values) for k in numbers]
            least = max(FROZEN, min(still) + MORE)
            mine += [k for k, way in zip(numbers, still, strict=True) if way > least]
        if mine:
            first = trial.closures[mine[0]]
            seen = values[(time >= first.start) & (time <= first.stop)]
            at = [f"{max(trial.closures[k].start, 0.0):.1f} s" for k in mine]
            notes.append(
                f"{name} stands still, at {seen[-1]:.4g} {trial.unit(name)}, in {in_words(len(mine))} (starting at "
                f"{listed(at)}) though the reference moves: a sensor or logger that has frozen; left out"
            )
            gone.update(mine)
    if not gone:
        return trial
    kept = [closure for k, closure in enumerate(trial.closures) if k not in gone]
    return replace(trial, closures=tuple(kept), notes=(*trial.notes, *notes))


def _stands_long(values: Array) -> bool:
    """Whether any number is repeated so often, one after the other, that it is worth looking."""
    return bool(values.size > FEW and (values[FEW:] == values[:-FEW]).any())


def _still_way(trial: Trial, closure: Closure, time: Array, values: Array) -> float:
    """Part of the reference's way in a closure over which a signal repeats one number at most."""

    def way(start: float, stop: float) -> float:
        first, last = math.ceil(max(start, 0.0) / trial.period), math.floor(stop / trial.period)
        seen = trial.reference[first : last + 1]
        return float(np.ptp(seen)) if seen.size else 0.0

    inside = (time >= closure.start) & (time <= closure.stop)
    t, whole = time[inside], way(closure.start, closure.stop)
    if whole <= 0.0:
        return 0.0
    # A run of steps without a change is one sample longer than it has steps.
    runs = [(a, b + 1) for a, b in true_runs(np.diff(values[inside]) == 0.0) if b + 1 - a >= FEW]
    return max((way(float(t[a]), float(t[b])) for a, b in runs), default=0.0) / whole

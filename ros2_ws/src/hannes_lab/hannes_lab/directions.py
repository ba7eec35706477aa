"""Which way a machine goes in each of its conditions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from .trials import Trial, curves_of

ONE_WAY = 0.8
"""Part of its range that a machine is away at the end of a condition from where it began, if that goes one way."""

BACK = 0.02
"""Part of its range by which a machine that never turns back may come back: an encoder's noise, a loop that settles."""


def ways(trials: Sequence[Trial]) -> dict[str, float]:
    """1 or -1 for each condition that ends far from where it began, 0 for one that comes back."""
    out = {}
    for condition, curve in _curves(trials):
        net = float(curve[-1] - curve[0])
        out[condition] = float(np.sign(net)) if abs(net) > ONE_WAY * float(np.ptp(curve)) else 0.0
    return out


def never_turns(trials: Sequence[Trial]) -> bool:
    """Whether all conditions go the same way and none ever comes back: then nothing tells one direction's friction."""
    found = set(ways(trials).values())
    if len(found) != 1 or 0.0 in found:
        return False
    (way,) = found
    for _, curve in _curves(trials):
        ahead = curve * way
        if float((np.maximum.accumulate(ahead) - ahead).max()) > BACK * float(np.ptp(curve)):
            return False
    return True


def _curves(trials: Sequence[Trial]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """The place in the median closure of each condition; of a machine without an encoder, its reference."""
    for trial in trials:
        own = np.arange(trial.reference.size, dtype=np.float64) * trial.period, trial.reference
        time, place = trial.signals.get("encoder_position", own)
        for condition in trial.conditions:
            yield condition, np.median(curves_of(trial.of(condition), time, place), axis=0)

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
    return {condition: _way(curve) for condition, curve in _curves(trials)}


def never_turns(trials: Sequence[Trial]) -> bool:
    """Whether all conditions go the same way and none ever comes back: then nothing tells one direction's friction."""
    curves = [curve for _, curve in _curves(trials)]
    found = {_way(curve) for curve in curves}
    return len(found) == 1 and 0.0 not in found and all(_comes_back(curve) <= BACK for curve in curves)


def _way(curve: NDArray[np.float64]) -> float:
    net = float(curve[-1] - curve[0])
    return float(np.sign(net)) if abs(net) > ONE_WAY * float(np.ptp(curve)) else 0.0


def _comes_back(curve: NDArray[np.float64]) -> float:
    """How far a curve comes back from the farthest that it had been on its way to its end, as a part of its range."""
    ahead = curve * np.sign(curve[-1] - curve[0])
    return float((np.maximum.accumulate(ahead) - ahead).max()) / float(np.ptp(curve))


def _curves(trials: Sequence[Trial]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """The place in the median closure of each condition; of a machine without an encoder, its reference."""
    for trial in trials:
        own = np.arange(trial.reference.size, dtype=np.float64) * trial.period, trial.reference
        time, place = trial.signals.get("encoder_position", own)
        for condition in trial.conditions:
            yield condition, np.median(curves_of(trial.of(condition), time, place), axis=0)

"""Signals of one recorder by different clocks: one that is late by much more than any hand makes it is moved, and said.

A message without a header counts at its recording, one with a header at its stamp; a driver that buffers, or another
computer's clock, makes one signal of a recording late.  The nominal hand tells when each should come: whatever it lacks
bends a signal, but hardly moves it.  Over recordings of hands of nine simulators with hidden effects the encoder came
30 ms off at most, and no other signal fitted twice as well elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from hannes_description.model import Model
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from .features import build_features
from .hand import MOVED, HandRig, is_described
from .surrogate import FAST_PLANT, SLOW_PLANTS
from .trials import Trial

Array = NDArray[np.float64]

LATE = 0.06
"""s from which a signal is by another clock."""

HALVES = 0.5
"""What it has in common with the nominal hand's must miss at most this part of what it misses where it is."""

FARTHEST = 0.5
STEP = 0.005
"""s; the largest lag that is looked for, but for a quarter of a closure, and the grid."""


@dataclass(frozen=True)
class Lag:
    """By how much a signal is later than the nominal hand's, s, and whether that is another clock."""

    seconds: float
    clear: bool


def lags(trials: Sequence[Trial], model: Model) -> dict[str, Lag]:
    """The lag of each signal by name, over all recordings; nothing where the nominal hand cannot be simulated."""
    rig, names = HandRig(trials), dict.fromkeys(name for trial in trials for name in trial.signals)
    features = build_features(trials, list(names), rig.points, rig.finest)
    try:
        fast = model.with_plant(FAST_PLANT) if model.plant in SLOW_PLANTS else model
        predicted = features.closures(rig, fast, {})
    except PlantDiverged:
        return {}
    out = {}
    for name in names:
        pairs = [
            (block.phase, block.measured.mean(axis=0), closures.mean(axis=0))
            for block, closures in zip(features.blocks, predicted, strict=True)
            if block.signal == name
        ]
        if pairs:
            out[name] = _lag(pairs)
    return out


def _lag(pairs: Sequence[tuple[Array, Array, Array]]) -> Lag:
    """The lag of a signal, from phase (p,), measured (p,) and predicted (p,) mean closure of each condition."""
    most = min(FARTHEST, 0.25 * min(float(phase[-1] - phase[0]) for phase, _, _ in pairs))
    steps = np.arange(-round(most / STEP), round(most / STEP) + 1) * STEP
    missed = np.mean([[_missed(*pair, late) for late in steps] for pair in pairs], axis=0)
    best = int(np.argmin(missed))
    clear = abs(steps[best]) >= LATE and missed[best] <= HALVES * missed[steps.size // 2]
    return Lag(float(steps[best]), bool(clear and 0 < best < steps.size - 1))


def _missed(phase: Array, measured: Array, predicted: Array, late: float) -> float:
    """Part of the variance of a measured curve that the predicted one, later by so many s, does not explain."""
    at = phase - late
    inside = (at >= phase[0]) & (at <= phase[-1])
    x, y = np.interp(at[inside], phase, predicted), measured[inside]
    x, y = x - x.mean(), y - y.mean()
    both = float(np.linalg.norm(x) * np.linalg.norm(y))
    return 1.0 - max(float(x @ y) / both, 0.0) ** 2 if both > 0.0 else 1.0


def with_one_clock(trials: Sequence[Trial], model: Model) -> list[Trial]:
    """The recordings of one recorder with the signals of another clock moved to that of the others.

    How far is known to a few ms, so the rest is fitted (HandRig.nuisances).  Where all signals are late, it is the
    reference that is early: of recordings that do not describe themselves its clock is fitted anyway.
    """
    found = lags(trials, model)
    late = {name: lag.seconds for name, lag in found.items() if lag.clear}
    alone = len(late) == len(found) and not all(map(is_described, trials))
    if not late or alone:
        return list(trials)
    out = []
    for trial in trials:
        own = {name: seconds for name, seconds in late.items() if name in trial.signals}
        signals = {
            name: (time - own.get(name, 0.0), values) for name, (time, values) in trial.signals.items()
        }
        notes = [
            f"{name} is {abs(seconds):.2g} s {'later' if seconds > 0.0 else 'earlier'} than the reference and the "
            "model say: it is by another clock, and was moved back (the rest is fitted)"
            for name, seconds in own.items()
        ]
        options = {**trial.options, MOVED: sorted(own)} if own else trial.options
        out.append(replace(trial, signals=signals, options=options, notes=(*trial.notes, *notes)))
    return out

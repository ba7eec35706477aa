"""Signals of one recorder by different clocks: one that is late by much more than any hand makes it is moved, and said.

A message without a header counts at its recording, one with a header at its stamp; a driver that buffers, or another
computer's clock, makes one signal of a recording late.  The nominal hand tells when each should come: whatever it lacks
bends a signal, but hardly moves it.  Over recordings of hands of nine simulators with hidden effects the encoder came
30 ms off at most, and no other signal fitted twice as well elsewhere.

Where the voltage is recorded too, the winding tells the time of current and encoder to a few ms, whatever the hand
does: u = R i + k w + c + d sign(w).  No effect of the catalogue moves them so that this fits twice as well elsewhere
(`tests/lab/test_lags.py`); a command that is late makes both late alike, which is no clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from hannes_description.model import Model
from hannes_sim.measurement import goes_below_nought
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from .features import build_features
from .hand import MOVED, HandRig, is_described
from .surrogate import FAST_PLANT, SLOW_PLANTS
from .trials import Trial
from .units import CURRENT, ENCODER

Array = NDArray[np.float64]

LATE = 0.06
"""s from which a signal is by another clock."""

HALVES = 0.5
"""What it has in common with the nominal hand's must miss at most this part of what it misses where it is."""

VOLTAGE = "motor_voltage"

LATE_TO_VOLTAGE = 0.015
"""s from which a current or an encoder is by another clock than the voltage."""

SMOOTHED = 0.04
"""s over which voltage, current and encoder are averaged to be compared, or twice their sampling."""

ROUNDS = 4
"""Searches for the lag of current and encoder in turn."""

FAR_TO_VOLTAGE = 0.1
"""s; the largest lag to the voltage that is looked for."""

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


def lags_to_voltage(trials: Sequence[Trial]) -> dict[str, float]:
    """How much later than the voltage current and encoder are, s, where that is clear; over all recordings.

    Where both are late together it is the command that is, or the voltage's clock: they are left as they are.
    """
    missed = [_electrical(t) for t in trials if {VOLTAGE, CURRENT, ENCODER} <= set(t.signals)]
    if not missed:
        return {}

    def mean(encoder: float, current: float) -> float:
        return float(np.mean([one(encoder, current) for one in missed]))

    steps = np.arange(-round(FAR_TO_VOLTAGE / STEP), round(FAR_TO_VOLTAGE / STEP) + 1) * STEP
    encoder = current = 0.0
    for _ in range(ROUNDS):
        before = encoder, current
        current = float(steps[np.argmin([mean(encoder, late) for late in steps])])
        encoder = float(steps[np.argmin([mean(late, current) for late in steps])])
        if before == (encoder, current):
            break
    best = mean(encoder, current)
    together = min(mean(late, late) for late in steps)
    if best > HALVES * together:
        return {}
    found = {ENCODER: (encoder, mean(0.0, current)), CURRENT: (current, mean(encoder, 0.0))}
    return {
        name: late
        for name, (late, without) in found.items()
        if LATE_TO_VOLTAGE <= abs(late) < steps[-1] and best <= HALVES * without
    }


def _electrical(trial: Trial) -> Callable[[float, float], float]:
    """The part of the voltage's variance that encoder and current do not explain if they are later by so many s."""
    (tu, u), (ti, i), (te, position) = (trial.signals[name] for name in (VOLTAGE, CURRENT, ENCODER))
    start = max(trial.closures[0].start, tu[0], ti[0] + FAR_TO_VOLTAGE, te[0] + FAR_TO_VOLTAGE)
    stop = min(trial.closures[-1].stop, tu[-1], ti[-1] - FAR_TO_VOLTAGE, te[-1] - FAR_TO_VOLTAGE)
    time = np.arange(start, stop, STEP)
    longer = np.arange(start - FAR_TO_VOLTAGE - STEP, stop + FAR_TO_VOLTAGE + 2.0 * STEP, STEP)
    sampling = max(float(np.median(np.diff(t))) for t in (tu, ti, te))
    width = round(max(SMOOTHED, 2.0 * sampling) / STEP) | 1
    if time.size <= 4 * width:
        return lambda *_: 1.0
    inner = slice(width, -width)

    def smooth(values: Array) -> Array:
        return np.convolve(values, np.full(width, 1.0 / width), "same")

    def later(values: Array, late: float) -> Array:
        return np.interp(time + late, longer, values)

    volts = smooth(np.interp(time, tu, u))
    amperes = np.interp(longer, ti, i)
    speed = np.gradient(smooth(np.interp(longer, te, position)), STEP)
    sign = np.ones(volts.size) if goes_below_nought(i) else np.sign(volts)
    variance = float(np.var(volts[inner]))

    def missed(encoder: float, current: float) -> float:
        turns = smooth(later(speed, encoder))
        terms = (smooth(sign * later(amperes, current)), turns, np.ones(turns.size), np.sign(turns))
        columns = np.stack(terms, axis=1)[inner]
        left = volts[inner] - columns @ np.linalg.lstsq(columns, volts[inner], rcond=None)[0]
        return float(np.mean(left**2)) / variance if variance > 0.0 else 1.0

    return missed


def with_one_clock(trials: Sequence[Trial], model: Model) -> list[Trial]:
    """The recordings of one recorder with the signals of another clock moved to that of the others.

    How far is known to a few ms, so the rest is fitted (HandRig.nuisances).  Where all signals are late, it is the
    reference that is early: of recordings that do not describe themselves its clock is fitted anyway.
    """
    trials = moved_back(trials, lags_to_voltage(trials), "what the winding makes of the voltage says")
    found = lags(trials, model)
    late = {name: lag.seconds for name, lag in found.items() if lag.clear}
    alone = len(late) == len(found) and not all(map(is_described, trials))
    return trials if alone else moved_back(trials, late, "the reference and the model say")


def moved_back(trials: Sequence[Trial], late: Mapping[str, float], against: str) -> list[Trial]:
    """The recordings with the signals that are later by so many s moved back, and a note on each."""
    out = []
    for trial in trials:
        own = {name: seconds for name, seconds in late.items() if name in trial.signals}
        signals = {
            name: (time - own.get(name, 0.0), values) for name, (time, values) in trial.signals.items()
        }
        notes = [
            f"{name} is {abs(seconds):.2g} s {'later' if seconds > 0.0 else 'earlier'} than {against}: it is by "
            "another clock, and was moved back (the rest is fitted)"
            for name, seconds in own.items()
        ]
        already = trial.options.get(MOVED, ())
        options = {**trial.options, MOVED: sorted({*already, *own})} if own else trial.options
        out.append(
            replace(trial, signals=signals, options=options, notes=(*trial.notes, *notes)) if own else trial
        )
    return out

"""Periods in the position at which a residual repeats: where the search for ripple starts.

The residual of a ripple is a line in its spectrum over position.  Least-squares periodogram (Lomb 1976, Scargle 1982)
of the mean residual of every condition and signal, added up; a line counts where it stands out of its surroundings.
"""

from __future__ import annotations

import numpy as np
from hannes_sim.plant import PlantDiverged
from hannes_sim.ports import R_Q
from numpy.typing import NDArray
from scipy.special import gammainccinv, gammaincinv

from .features import Features
from .fit import Fit
from .problem import Problem
from .rig import PlantRig

Array = NDArray[np.float64]

CHANCE = 1e-3
"""Chance that a line stands out in a residual without one."""

SURROUNDINGS = 300
"""Frequencies on each side of a line with which it is compared."""


WAVES = tuple(0.5 * k for k in range(1, 81))
"""Waves within the travel of the position whose ripple is simulated: a sampled, rectified, averaged signal of a plant
with friction and a controller around it shows few of them as lines."""


MOVES = 0.1
"""Part of its greatest speed, and of the farthest way, from which a machine counts as moving."""

TURN_WAVES = range(1, 81)
"""Waves within a turn whose ripple is simulated: whole ones, for else turns would not repeat."""

JUMP = 0.3
"""A reference that is wrapped jumps by this part of its travel and more within a tick, ..."""

ALIKE = 0.02
"""... each time by whole turns, as nearly as this part of one, ..."""

FARTHER = 1.5
"""... and the machine goes so many times as far as its reference does."""


def resolved(features: Features) -> float:
    """Shortest period [unit of the position] of which a recording has two samples a wave where it goes at its middle
    speed, in the condition that goes slowest; 0 where no position is recorded.

    Of what passes faster a simulation that is sampled alike makes any slow curve (an alias), and so does a model that
    is wrong otherwise.  Samples are those of the fastest signal, for a ripple shows in the drive.  Lines of a spectrum
    have a limit of their own, by the places at which the residual is known (position_periods).
    """
    out: list[tuple[float, float]] = []
    for trial in features.trials:
        steps = [np.diff(time) for time, _ in trial.signals.values()]
        step = min((float(np.median(d[d > 0.0])) for d in steps if (d > 0.0).any()), default=0.0)
        if "encoder_position" not in trial.signals or not step:
            continue
        time, place = trial.signals["encoder_position"]
        for condition in trial.conditions:
            curves = [np.interp(np.arange(c.start, c.stop, step), time, place) for c in trial.of(condition)]
            way = np.abs(np.concatenate([np.diff(curve) for curve in curves]))
            moving = way[way > MOVES * float(way.max(initial=0.0))]
            if moving.size:
                out.append((max(float(np.ptp(curve)) for curve in curves), 2.0 * float(np.median(moving))))
    farthest = max((travel for travel, _ in out), default=0.0)
    # What is held still moves by its noise alone.
    return min((shortest for travel, shortest in out if travel > MOVES * farthest), default=0.0)


def whole_periods(features: Features, lower: float, upper: float) -> tuple[float, ...]:
    """Periods between lower and upper [unit of the position] of which WAVES are within the travel, longest first."""
    travel = [b.measured for b in features.blocks if b.signal == "encoder_position"]
    if not travel:
        return ()
    total = max(float(x.max()) for x in travel) - min(float(x.min()) for x in travel)
    return tuple(total / waves for waves in WAVES if lower <= total / waves <= upper)


def periods_of_a_turn(problem: Problem, fit: Fit, lower: float, upper: float) -> tuple[float, ...]:
    """Periods between lower and upper [unit of the position] of which whole ones are in a turn, if it turns on.

    Its way is so long that a period which is off by a percent is out of step; others than these would not repeat.
    """
    whole = turn(problem, fit)
    return tuple(whole / waves for waves in TURN_WAVES if lower <= whole / waves <= upper)


def turn(problem: Problem, fit: Fit) -> float:
    """By how much the reference of a machine that turns on is wrapped [unit of the position]; 0 where none is.

    The reference is known tick by tick, so its jumps tell it exactly; the machine goes on where they are no steps.
    """
    rig = problem.rig
    if not isinstance(rig, PlantRig):
        return 0.0
    for trial in problem.features.trials:
        wrapped = _jumps(trial.reference)
        if not wrapped or trial.anew:
            continue
        try:
            way = rig.run(fit.model, fit.values, trial, trial.reference).raw[:, R_Q]
        except PlantDiverged:
            continue
        if np.ptp(way) > FARTHER * np.ptp(trial.reference):
            return wrapped
    return 0.0


def _jumps(reference: Array) -> float:
    """Of which size all jumps of a reference (n,) are, or whole multiples; 0 if it has less than two, or others."""
    steps, span = np.diff(reference), float(np.ptp(reference))
    at = np.flatnonzero(np.abs(steps) > JUMP * span)
    at = at[at > 0]
    if span <= 0.0 or at.size < 2:
        return 0.0
    # without the way of that tick, which is about that of the tick before
    jumps = np.abs(steps[at] - np.where(np.isin(at - 1, at), 0.0, steps[at - 1]))
    unit = float(jumps.min())
    times = np.round(jumps / unit)
    return float(np.median(jumps / times)) if np.all(np.abs(jumps - times * unit) < ALIKE * unit) else 0.0


def position_periods(
    problem: Problem, fit: Fit, lower: float, upper: float, keep: int = 2
) -> tuple[float, ...]:
    """Up to `keep` periods between lower and upper [unit of the position] that stand out, strongest first.

    Empty where no position is recorded or nothing stands out.
    """
    features = problem.features
    predicted = features.closures(problem.rig, fit.model, fit.values)
    places = {(b.trial, b.condition): b for b in features.blocks if b.signal == "encoder_position"}
    curves: list[tuple[Array, Array]] = []
    spans: dict[tuple[int, str], float] = {}
    # A force shows the ripple itself; the position shows its double integral, in which slow errors hide it.
    drive = [
        signal for signal in problem.rig.drive_signals if any(b.signal == signal for b in features.blocks)
    ]
    for block, model in zip(features.blocks, predicted, strict=True):
        where = block.trial, block.condition
        if where in places and (not drive or block.signal == drive[0]):
            place = places[where]
            x = np.interp(block.phase, place.phase, place.measured.mean(axis=0))
            curves.append((x, (block.measured - model).mean(axis=0)))
            spans[where] = float(np.ptp(x))
    if not curves:
        return ()
    total = max(float(x.max()) for x, _ in curves) - min(float(x.min()) for x, _ in curves)
    steps = [float(np.quantile(np.abs(np.diff(x)), 0.9)) for x, _ in curves]
    if total <= 0.0 or min(steps) <= 0.0:
        return ()
    lower = max(lower, 2.2 * min(steps))
    upper = min(upper, total)
    if lower >= upper:
        return ()
    frequency = np.arange(1.0 / upper, 1.0 / lower, 0.2 / total)
    power = np.zeros(frequency.size)
    for (x, r), step in zip(curves, steps, strict=True):
        # Long moves resolve a line, short ones smear it.
        power += float(np.ptp(x)) * _periodogram(x, r, frequency) * (frequency < 1.0 / (2.2 * step))
    # The powers of white noise in n conditions are exponentials; their sum is a gamma variable.
    n = sum(spans.values()) ** 2 / sum(s * s for s in spans.values())
    stands_out = float(gammainccinv(n, CHANCE / frequency.size) / gammaincinv(n, 0.5))
    ratio = np.array(
        [
            power[k] / max(float(np.median(power[max(0, k - SURROUNDINGS) : k + SURROUNDINGS + 1])), 1e-300)
            for k in range(power.size)
        ]
    )
    out: list[float] = []
    for k in np.argsort(-ratio):
        if ratio[k] < stands_out or len(out) == keep:
            break
        if all(abs(frequency[k] - 1.0 / period) > 3.0 / total for period in out):
            out.append(float(1.0 / frequency[k]))
    return tuple(out)


def _periodogram(x: Array, r: Array, frequency: Array) -> Array:
    """Part of the residual's variance (m,) that a sine and a cosine of each frequency explain, after a cubic in x."""
    u = (x - x.mean()) / (float(np.ptp(x)) or 1.0)
    trend = np.polynomial.polynomial.polyvander(u, 3)
    basis, _ = np.linalg.qr(trend)
    rest = r - basis @ (basis.T @ r)
    energy = float(rest @ rest)
    if energy <= 0.0:
        return np.zeros(frequency.size)
    angle = 2.0 * np.pi * np.outer(frequency, x)
    c, s = np.cos(angle), np.sin(angle)
    c -= (c @ basis) @ basis.T
    s -= (s @ basis) @ basis.T
    cc, ss, cs = (c * c).sum(axis=1), (s * s).sum(axis=1), (c * s).sum(axis=1)
    cr, sr = c @ rest, s @ rest
    determinant = np.maximum(cc * ss - cs * cs, 1e-9 * cc * ss + 1e-300)
    out: Array = (ss * cr * cr - 2.0 * cs * cr * sr + cc * sr * sr) / determinant / energy
    return out

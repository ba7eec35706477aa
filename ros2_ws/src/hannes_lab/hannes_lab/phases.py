"""Phases of a closure, and the figures by which the thesis judges one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .trials import Closure, Trial

Array = NDArray[np.float64]

PHASES = ("void", "grasp", "hold", "opening", "rest")
"""void: closing without contact.

Grasp: closing in contact; hold: the reference stands away from rest; opening; rest.
"""

TRANSIENT = 0.15
"""s after the start that the thesis' averages leave out (X18: the start-up transient of the current)."""


STANDS = 1e-6
"""Part of the whole reference's span that one which stands goes over at most."""


def phase_of(
    trial: Trial, closure: Closure, phase: Array, contact: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """Index into PHASES for every instant `phase` (p,) [s since the closure's start].

    From the reference alone: rising, standing or falling; `contact` (p,) of bool tells grasp from void (None: no
    object).
    """
    time = np.arange(trial.reference.size) * trial.period
    at = closure.start + phase
    half = max(5.0 * trial.period, 0.02)
    reference = np.interp(at, time, trial.reference)
    last = trial.parts[1].begin - trial.period if trial.anew else np.inf  # beyond stands another recording
    after, before = np.minimum(at + half, last), at - half
    slope = (np.interp(after, time, trial.reference) - np.interp(before, time, trial.reference)) / (
        2.0 * half
    )
    inside = (time >= closure.start) & (time <= closure.stop)
    low, high = float(trial.reference[inside].min()), float(trial.reference[inside].max())
    span = max(high - low, 1e-12)
    steepest = float(np.abs(slope).max()) or 1.0
    out = np.full(phase.size, PHASES.index("rest"))
    # A reference that stands all through is at rest where the others are lowest too; one that never moves is held.
    whole = float(np.ptp(trial.reference))
    if high - low <= STANDS * whole:
        low = float(trial.reference.min())
    away = (reference - low > 0.02 * span) | (whole == 0.0)
    moving = np.abs(slope) > 0.02 * steepest
    out[away & ~moving] = PHASES.index("hold")
    out[moving & (slope > 0)] = PHASES.index("void")
    out[moving & (slope < 0)] = PHASES.index("opening")
    if contact is not None:
        out[(out == PHASES.index("void")) & contact] = PHASES.index("grasp")
    return out


METRICS = {
    "closure_time": "s",
    "average_closing_current": "A",
    "slope_closing_current": "A/s",
    "maximum_current": "A",
    "average_opening_current": "A",
    "slope_opening_current": "A/s",
    "maximum_grip_force": "N",
}
"""The thesis' figures (R05, R07-R13) and their units."""


def metrics(
    phase: Array,
    labels: NDArray[np.int64],
    position: Array | None,
    current: Array | None,
    force: Array | None,
) -> dict[str, float]:
    """Figures of one closure (p,); NaN where a signal or a phase is not there.

    closure_time             from the start until the encoder has made 95 % of its travel
    average_closing_current  mean |i| of the void phase after the start-up transient (R07, R08)
    slope_closing_current    slope of |i| between 10 and 90 % of its rise in the grasp (R09); in void closures NaN
    maximum_current          largest |i| after the transient (R10)
    average_opening_current  mean |i| of the opening after the current has fallen (R11)
    slope_opening_current    slope of |i| between 90 and 10 % of its fall (R12)
    maximum_grip_force       R13; in void closures NaN
    """
    out = dict.fromkeys(METRICS, float("nan"))
    if position is not None:
        travel = position - position[0]
        top = float(travel.max())
        if top > 0.0:
            k = int(np.argmax(travel >= 0.95 * top))
            out["closure_time"] = float(
                np.interp(0.95 * top, travel[max(k - 1, 0) : k + 1], phase[max(k - 1, 0) : k + 1])
            )
    if current is not None:
        i = np.abs(current)
        settled = phase >= TRANSIENT
        void = settled & (labels == PHASES.index("void"))
        grasp = labels == PHASES.index("grasp")
        opening = labels == PHASES.index("opening")
        if void.any():
            out["average_closing_current"] = float(i[void].mean())
        if settled.any():
            out["maximum_current"] = float(i[settled].max())
        if grasp.sum() >= 3:
            out["slope_closing_current"] = _slope(phase, i, np.flatnonzero(grasp), rising=True)
        if opening.sum() >= 4:
            index = np.flatnonzero(opening)
            low = index[int(np.argmin(i[index]))]
            tail = index[index >= low]
            out["average_opening_current"] = float(i[tail].mean())
            if grasp.any():
                peak = int(
                    np.argmax(np.where(grasp | opening | (labels == PHASES.index("hold")), i, -np.inf))
                )
                out["slope_opening_current"] = _slope(phase, i, np.arange(peak, low + 1), rising=False)
    if force is not None and (labels == PHASES.index("grasp")).any():
        out["maximum_grip_force"] = float(force.max())
    return out


def _slope(phase: Array, i: Array, index: NDArray[np.int64], *, rising: bool) -> float:
    """Least-squares slope between 10 and 90 % of a rise or fall; NaN if fewer than two samples lie there."""
    if index.size < 2:
        return float("nan")
    values = i[index]
    if rising:
        values = values[: int(np.argmax(values)) + 1]
    low, high = float(values.min()), float(values.max())
    part = index[: values.size]
    inside = (values >= low + 0.1 * (high - low)) & (values <= low + 0.9 * (high - low))
    if inside.sum() < 2:
        return float("nan")
    return float(np.polyfit(phase[part[inside]], values[inside], 1)[0])

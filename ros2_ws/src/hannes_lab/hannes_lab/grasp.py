"""Was something grasped, and about how stiff and where?  Read from the closures where nobody said so.

While closing, an object adds a force that grows from one position on; no closure on nothing shows it there.  Where a
dynamometer shows it, that is all there is to be seen; where it shows nothing it may be elsewhere.  Otherwise the drive
current against position, without that part of it which accelerates the nominal hand, is compared with that of the
other recordings of the set, or, where none of them comes so far, with the nominal hand's.  A glove or a tight spring is
there in all recordings, and is no object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from hannes_description.model import Model
from hannes_sim.objects import GraspObject
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from .hand import HandRig, sensors_of
from .surrogate import FAST_PLANT
from .trials import Trial

Array = NDArray[np.float64]

FREE_TRAVEL = 0.2
"""Part of the way in which the motor starts up: its current says nothing of an object."""

EXCESS = (1.3, 0.05)
EXCESS_OVER_NOMINAL = 2.0
"""An object is seen where the current exceeds this multiple of what moves the free hand at the same place, by this much
(A).  The nominal hand's current is less to be trusted than that of another recording of the same hand."""

LEAST_FORCE, OVER_NOISE = 0.5, 8.0
"""N, and multiples of how much it varies before anything is touched, by which a recorded grip force rises where
there is an object."""

TOUCHES = 0.05
"""Part of the way before which nothing is touched."""

LEAST_FREE = 0.8
"""Part of the nominal hand's current that a free hand takes at least, whatever another recording shows that brakes."""

RIPPLE_OVER = 0.1
"""Part of the way over which the current's own trend is taken: what comes and goes within it is a ripple, no object."""

STEP = 2.5e-3
"""s between the points of the mean closing."""

SMOOTH, SAMPLES = 0.05, 8
"""s, and samples at least, over which its current and its acceleration are taken."""

STANDS = 1e-3
"""Part of the way that counts as one place."""

STIFFER = 3.0
"""An object is stiffer than this multiple of the hand's own springs."""

PRESSED = 5.0
"""Multiples of the seen excess that an object may take where the closing ends, by its stiffness and its depth there.

It takes about what is seen (2.1 at most in recordings of grasps).  A spike of a loop that a busy machine disturbed
rises as if a rigid object stood there, and the hand goes on (12 to 23)."""

PLACES = 200
"""How many places along the way a curve is looked at for its ripple."""

RISE = (0.3, 0.8)
"""Parts of the excess between which its slope is taken."""


def with_seen_objects(trials: Sequence[Trial], model: Model) -> list[Trial]:
    """The trials, with an object of roughly seen stiffness and place where nobody said what was grasped.

    A kind that was named (soft, rigid) without a description of the recording says that there is an object, not how
    stiff this one is: it gets the seen values too, where it is seen and the nominal hand comes nearer with them.
    """
    curves = [closing_curve(trial, model) for trial in trials]
    out = []
    for k, trial in enumerate(trials):
        given = trial.options.get("object")
        if "object" in trial.options and (not isinstance(given, str) or "sensors" in trial.options):
            out.append(trial)
            continue
        seen = _felt(trial, model) or _seen(
            curves[k], [c for j, c in enumerate(curves) if j != k], _nominal(model)
        )
        if given == "none":
            if seen is not None:
                note = (
                    "nothing was grasped, as was said, though the closures look as if something was, from "
                    f"{seen[1]:.1f} rad on: leave --object {trial.name}=none out if so"
                )
                trial = replace(trial, notes=(*trial.notes, note))
            out.append(trial)
            continue
        if seen is None:
            note = (
                "no grasp is seen in the closures, so there was none; say --object CONDITION=soft (or rigid) if there "
                "was one after all"
            )
            out.append(trial if given else replace(trial, notes=(*trial.notes, note)))
            continue
        stiffness, place = seen
        travel, opening = (model.parameters.value(f"hand.{n}") for n in ("fingertip_travel", "opening"))
        grasp = GraspObject(size=max(opening - place * travel, 1e-3), stiffness=stiffness / travel**2)
        if given and _error(trial, model) <= _error(_with_object(trial, grasp), model):
            out.append(trial)
            continue
        what = (
            "its stiffness and place are"
            if given
            else "that something was grasped, its stiffness and place are"
        )
        note = (
            f"{what} read from the closures (about {grasp.stiffness:.2g} N/m with the wire, from {place:.1f} rad on) "
            "and fitted" + ("" if given else f"; say --object {trial.name}=none if nothing was")
        )
        out.append(replace(_with_object(trial, grasp), notes=(*trial.notes, note)))
    return out


def _with_object(trial: Trial, grasp: GraspObject) -> Trial:
    return replace(trial, options={**trial.options, "object": grasp.to_dict(), "object_seen": True})


def _error(trial: Trial, model: Model) -> float:
    """By how much the nominal hand, in its fast plant, misses the first closure: sum over the signals, in spans."""
    first = trial.closures[0]
    reference = trial.reference[: round(first.stop / trial.period)]
    try:
        run = HandRig([trial]).simulate(model.with_plant(FAST_PLANT), {}, trial, reference)
    except PlantDiverged:
        return math.inf
    total = 0.0
    for name, (time, values) in trial.signals.items():
        inside = (time >= first.start) & (time < first.stop)
        ticks = np.clip(np.floor(time[inside] / trial.period + 1e-4).astype(int), 0, reference.size - 1)
        e = values[inside] - run[name][ticks]
        total += float(np.sqrt(np.mean(e**2))) / (float(np.ptp(values[inside])) or 1.0)
    return total


class Curve(NamedTuple):
    """Encoder position (p,) rad, increasing, and current (p,) A of a mean closing.

    current  without what drives the hand on; and without what brakes it where the logger tells its sign
    most     without what brakes it in any case: as if an object did
    """

    position: Array
    current: Array
    most: Array


def closing_curve(trial: Trial, model: Model) -> Curve | None:
    """The curve of the mean closing; None without an encoder, or where it is logged too slowly to show one.

    The current is that which a hand without inertia and viscous friction would have taken.  Where none is recorded,
    that which the nominal controller would ask for if the hand stood still.  A logger that rectifies loses its sign:
    where the hand brakes, an object or its motor may brake it.
    """
    if not _followed(trial):
        return None
    closures = trial.of(trial.conditions[0])
    phase = _phase(trial)
    position = trial.mean_closure("encoder_position", phase)
    if "motor_current" in trial.signals:
        span = _span(trial)
        logged = trial.mean_closure("motor_current", phase)
        current, most = (
            _still(phase, position, logged, span, model, braked=braked)
            for braked in (not sensors_of(trial)["rectified"], True)
        )
    else:
        kp, kd = (model.parameters.value(f"control.{n}") for n in ("kp", "damping"))
        ticks = np.arange(trial.reference.size) * trial.period
        reference = np.mean([np.interp(c.start + phase, ticks, trial.reference) for c in closures], axis=0)
        current = most = np.convolve(
            kp * (reference - position) - kd * np.gradient(position, phase), np.ones(9) / 9.0, "same"
        )
    top = int(np.argmax(position))
    rising = np.flatnonzero(position[: top + 1] > FREE_TRAVEL * position[top])
    if rising.size < 8:
        return None
    way = slice(rising[0], top + 1)
    return _advancing(np.maximum.accumulate(position[way]), current[way], most[way])


def _phase(trial: Trial) -> Array:
    """Points (p,) in time of the mean closing, s."""
    length = min(c.stop - c.start for c in trial.of(trial.conditions[0]))
    return np.linspace(0.0, length, max(round(length / STEP), 400))


def _span(trial: Trial) -> float:
    """s over which its curves are smoothed."""
    return max(SMOOTH, SAMPLES * float(np.median(np.diff(trial.signals["encoder_position"][0]))))


def _followed(trial: Trial) -> bool:
    """Whether an encoder is logged, often enough that a closure is longer than what its curves are smoothed over."""
    if "encoder_position" not in trial.signals:
        return False
    phase = _phase(trial)
    return _window(phase, _span(trial)) <= phase.size


def _window(phase: Array, span: float) -> int:
    """That span as an odd number of points."""
    return 2 * max(round(0.5 * span / float(phase[1] - phase[0])), 2) + 1


def _felt(trial: Trial, model: Model) -> tuple[float, float] | None:
    """Stiffness at the pulley (N.m/rad) and place (rad) of an object whose force was recorded; None if none is felt."""
    if "grip_force" not in trial.signals or not _followed(trial):
        return None
    phase = _phase(trial)
    position = trial.mean_closure("encoder_position", phase)
    force = _savgol(trial.mean_closure("grip_force", phase), _window(phase, _span(trial)), 1)
    top = int(np.argmax(position))
    still = position[: top + 1] < TOUCHES * position[top]
    if still.sum() < 4:
        return None
    zero, noise = float(np.median(force[: top + 1][still])), float(np.std(force[: top + 1][still]))
    peak = int(np.argmax(force[: top + 1]))
    if force[peak] - zero < max(LEAST_FORCE, OVER_NOISE * noise) or not still[0]:
        return None
    q, rise = np.maximum.accumulate(position[: peak + 1]), force[: peak + 1] - zero
    (start, low), (stop, high) = (_last_rise(q, rise, part * float(rise[-1])) for part in RISE)
    slope = max(high - low, 1e-6) / max(stop - start, 1e-3)
    place = start - low / slope
    if place < TOUCHES * position[top]:
        return None  # what rises with the position from its beginning on is the hand's own, or crosstalk
    stiffness = slope * model.parameters.value("hand.fingertip_travel")
    return float(np.clip(stiffness, 1e-3, 5.0)), place


def _still(time: Array, position: Array, current: Array, span: float, model: Model, *, braked: bool) -> Array:
    """The current (p,) A without what accelerates the nominal hand and what its viscous friction takes.

    span    s over which the motion is smoothed (Savitzky-Golay filter of the third order)
    braked  the current is also without what brakes the hand
    """
    value = model.parameters.value
    step, window = float(time[1] - time[0]), _window(time, span)
    velocity, acceleration = (_savgol(position, window, 3, deriv=k, delta=step) for k in (1, 2))
    inertia = value("motor.armature") * value("gear.ratio") ** 2 + value("hand.inertia")
    torque = inertia * acceleration + value("friction.viscous") * velocity
    if not braked:
        torque = np.maximum(torque, 0.0)
    return np.asarray(_savgol(current, window, 3) - torque / _nominal(model)[2])


def _savgol(values: Array, window: int, order: int, **options: Any) -> Array:
    from scipy.signal import savgol_filter  # a third of the time in which the lab is imported

    return np.asarray(savgol_filter(values, window, order, **options))


def _advancing(position: Array, *currents: Array) -> Curve:
    """A curve of places (p,) that do not go back, each with its largest current: what made the hand go on from there.

    Where friction holds it, the current may be anything below that: a user who relaxes and pulls again moves nothing.
    """
    step = max(STANDS * float(position[-1] - position[0]), 1e-12)
    first = np.unique((position - position[0]) // step, return_index=True)[1]
    return Curve(position[first], *(np.maximum.reduceat(current, first) for current in currents))


def _nominal(model: Model) -> tuple[float, float, float]:
    """Torque of the free hand when closing slowly: at rest (N.m), per rad; and torque per ampere, at the pulley."""
    value = model.parameters.value
    still = value("friction.coulomb") + value("hand.coulomb") + value("hand.preload")
    per_ampere = value("motor.kt") * value("gear.ratio") * value("gear.efficiency")
    return still, value("hand.stiffness"), per_ampere


def _seen(
    own: Curve | None,
    others: Sequence[Curve | None],
    nominal: tuple[float, float, float],
) -> tuple[float, float] | None:
    """Stiffness at the pulley (N.m/rad) and place (rad) of what a closing curve shows more than the others."""
    if own is None:
        return None
    q, sure, current = own
    still, rate, per_ampere = nominal
    free = (still + rate * q) / per_ampere
    peak = int(np.argmax(current))
    factor, base = EXCESS_OVER_NOMINAL, free
    for other in others:
        if other is None or other.position[-1] < q[peak]:
            continue
        # Where it brakes before it arrives, its current says less than what moves the hand.
        there = np.maximum(np.interp(q, other.position, other.most), np.median(other.most))
        if factor > EXCESS[0] or there[peak] < base[peak]:
            factor, base = EXCESS[0], there
    least = max(base[peak], LEAST_FREE * free[peak])
    if base is free and sure[peak] < factor * least + EXCESS[1]:
        return None
    ripple = _ripple(q[: peak + 1], current[: peak + 1])
    if current[peak] - ripple < factor * least + EXCESS[1]:
        return None
    excess = (current - base)[: peak + 1]
    # From the peak backwards: what a quick start takes more than a slow one is no object.
    (start, low), (stop, high) = (_last_rise(q, excess, part * float(excess[-1])) for part in RISE)
    slope = max(high - low, 1e-6) / max(stop - start, 1e-3)
    place = start - low / slope
    if slope * (q[-1] - place) > PRESSED * float(excess.max()):
        return None  # the hand went on to where such an object would have taken many times the current
    sure_of = slope * max(1.0 - ripple / max(high - low, 1e-6), 0.0)
    if sure_of * per_ampere < STIFFER * rate or place < FREE_TRAVEL * q[-1]:
        return None
    return float(np.clip(slope * per_ampere, 1e-3, 5.0)), max(place, 0.0)


def _ripple(q: Array, current: Array) -> float:
    """Amplitude of what comes and goes with the position.

    Half of the places decide, so that a rise at the end does not: of a sine's absolute values the median is 0.71 of its
    amplitude.
    """
    width = round(0.5 * RIPPLE_OVER * PLACES)
    even = np.interp(np.linspace(q[0], q[-1], PLACES), q, current)
    trend = np.convolve(even, np.full(2 * width + 1, 1.0 / (2 * width + 1)), mode="valid")
    return math.sqrt(2.0) * float(np.median(np.abs(even[width:-width] - trend)))


def _last_rise(q: Array, excess: Array, level: float) -> tuple[float, float]:
    """Where a curve last rises through a level, and its value there; its beginning if it is above from the start."""
    below = np.flatnonzero(excess < level)
    if not below.size:
        return float(q[0]), float(excess[0])
    k = int(below[-1])
    part = (level - excess[k]) / (excess[k + 1] - excess[k])
    return float(q[k] + part * (q[k + 1] - q[k])), level

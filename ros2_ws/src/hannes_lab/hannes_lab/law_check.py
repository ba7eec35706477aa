"""Does the control law of an adapter give the recorded command, when it is fed with what was recorded?

A law of another form, a gain in another unit or a command that stands a row too late spoil every simulation in closed
loop, and look there like friction and inertia.  Where reference, position and command are logged at every tick the law
can be asked alone, without a plant.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import call_own
from hannes_sim.plant import PlantDiverged
from hannes_sim.raised import watched
from hannes_sim.rollout import Controller
from numpy.typing import NDArray

from .clock import moving_mean
from .own_law import replay
from .rig import PlantRig
from .trials import Trial

Array = NDArray[np.float64]

OFF = 0.3
"""Standard deviation of what the law's answer differs by from the recorded command, in that of the command, from which
it is said; both are means over SMOOTHED ticks, for a law that differentiates answers to the noise of the log."""

SMOOTHED = 9
LONGEST = 60000
"""Ticks that are looked at."""

FEWEST = 200
"""Ticks of a simulation that shows which signal is which."""

EVERY_TICK = 1.01
"""Periods between two samples at most, in the median."""

SHIFTS = (0, 1, -1)
"""Ticks by which a log may show a command later, or earlier, than it acted."""

NEARER = 0.5
"""Part of the difference without a shift that is left with one that is believed."""


def law_notes(rig: PlantRig, model: Model) -> list[str]:
    """A sentence where the law does not give the recorded command, from the trial in which it is farthest off."""
    found = [off for trial in rig.trials if (off := _off(rig, model, trial)) is not None]
    if not found:
        return []
    worst = max(found)
    if worst.part > OFF:
        return [
            f"fed with the recorded reference and position alone, the control law gives a {worst.signal} that differs "
            f"from the recorded one by {100.0 * worst.part:.0f} % of its standard deviation ({worst.trial}): are its "
            "form, its gains and their units those of this machine, and is the recorded position what it reads?"
        ]
    if worst.shift and all(one.shift == worst.shift for one in found):
        row = "before" if worst.shift > 0 else "after"
        return [
            f"the recorded {worst.signal} is what the control law gives for the row {row} it: where the log is late, "
            "stamp it with the time of that row; where the command itself acts as late as it is logged, that is "
            "command_delay"
        ]
    return []


class _Off(NamedTuple):
    """How far a law is off: part of the command's standard deviation, at which shift, of which signal and trial."""

    part: float
    shift: int
    signal: str
    trial: str


def _off(rig: PlantRig, model: Model, trial: Trial) -> _Off | None:
    """How far the law's answers are off in a trial; None where it cannot be asked."""
    rig.law_used = None
    named = _named(rig, model, trial)
    command, position = named.get("motor_voltage"), named.get("encoder_position")
    stretches = _stretches(trial)
    if command is None or position is None or command == position or not stretches:
        return None
    # A rig's own `run` may give each recording gains of its own.
    law = rig.law_used if rig.law_used is not None else rig.controller(model, trial.period)
    current = named.get("motor_current")
    answers = [_answers(law, trial, own, position, current) for own in stretches]
    if current is None:
        others = [_answers(law, trial, own, position, current, 1.0) for own in stretches]
        if not all(np.array_equal(a, b) for a, b in zip(answers, others, strict=True)):
            return None  # it reads a current that nobody recorded
    measured = [_on_ticks(trial, command, own) for own in stretches]
    size = float(np.std(np.concatenate([_smooth(m) for m in measured])))
    if size == 0.0 or not all(np.isfinite(a).all() for a in answers):
        return None
    pairs = list(zip(answers, measured, strict=True))
    parts = {
        shift: float(np.std(np.concatenate([_difference(*pair, shift) for pair in pairs]))) / size
        for shift in SHIFTS
    }
    best = min(SHIFTS, key=parts.__getitem__)
    shift = best if parts[best] < NEARER * parts[0] else 0
    return _Off(parts[shift], shift, command, trial.name)


def _named(rig: PlantRig, model: Model, trial: Trial) -> dict[str, str]:
    """Signals that are logged at every tick as the simulation has them, by what they are there."""
    first = max(FEWEST, round(trial.closures[0].stop / trial.period))
    try:
        run = rig.run(model, {}, trial, trial.reference[:first])
    except PlantDiverged:
        return {}
    told = call_own(f"{type(rig).__name__}.logged, trial '{trial.name}',", rig.logged, run, trial)
    if not isinstance(told, Mapping):
        return {}  # which is said where signals are simulated
    return {
        what: name
        for what in ("motor_voltage", "encoder_position", "motor_current")
        for name, values in told.items()
        if name in trial.signals
        and np.array_equal(values, getattr(run, what))
        and trial.signals[name][0].size > 1
        and np.median(np.diff(trial.signals[name][0])) <= EVERY_TICK * trial.period
    }


def _stretches(trial: Trial) -> list[slice]:
    """Ticks over which the law goes on by itself: the parts of a trial that begin anew, or all of it."""
    edges = [0, *trial.anew_at, trial.reference.size]
    out = [slice(a, min(b, LONGEST)) for a, b in itertools.pairwise(edges) if a + FEWEST < LONGEST]
    return [own for own in out if own.stop - own.start > 2 * SMOOTHED]


def _on_ticks(trial: Trial, signal: str, own: slice) -> Array:
    time, values = trial.signals[signal]
    out: Array = np.interp(np.arange(own.start, own.stop) * trial.period, time, values)
    return out


def _answers(
    law: Controller, trial: Trial, own: slice, position: str, current: str | None, instead: float = 0.0
) -> Array:
    """Commands of the law along a stretch; instead: the current where none is recorded."""
    law.reset()
    place = _on_ticks(trial, position, own)
    velocity = np.diff(place, prepend=place[0]) / law.period
    amperes = _on_ticks(trial, current, own) if current else np.full(place.size, instead)
    with watched():
        return replay(law, np.column_stack([trial.reference[own], place, velocity, amperes]))


def _difference(answers: Array, measured: Array, shift: int) -> Array:
    """What a command that is logged `shift` ticks after its answer differs by from it."""
    n = answers.size - abs(shift)
    a, m = max(-shift, 0), max(shift, 0)
    return _smooth(measured[m : m + n] - answers[a : a + n])


def _smooth(values: Array) -> Array:
    return moving_mean(values, SMOOTHED)[SMOOTHED - 1 :]

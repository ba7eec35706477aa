"""Does the control law of an adapter give the recorded command, when it is fed with what was recorded?

A law of another form, a gain in another unit or a command that stands a row too late spoil every simulation in closed
loop, and look there like friction and inertia.  Where reference, position and command are logged at every tick the law
can be asked alone, without a plant.
"""

from __future__ import annotations

import numpy as np
from hannes_description.model import Model
from hannes_sim.plant import PlantDiverged
from hannes_sim.raised import watched
from hannes_sim.rollout import Controller, Rollout
from numpy.typing import NDArray

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

EVERY_TICK = 1.01
"""Periods between two samples at most, in the median."""

SHIFTS = (0, 1, -1)
"""Ticks by which a log may show a command later, or earlier, than it acted."""


def law_notes(rig: PlantRig, model: Model) -> list[str]:
    """A sentence where the law does not give the recorded command, from the trial in which it is farthest off."""
    found = [off for trial in rig.trials if (off := _off(rig, model, trial)) is not None]
    if not found:
        return []
    part, shift, signal, name = max(found)
    if part > OFF:
        return [
            f"fed with the recorded reference and position alone, the control law gives a {signal} that differs from "
            f"the recorded one by {100.0 * part:.0f} % of its standard deviation ({name}): are its form, its gains and "
            "their units those of this machine, and is the recorded position what it reads?"
        ]
    if shift and all(one[1] == shift for one in found):
        row = "before" if shift > 0 else "after"
        return [
            f"the recorded {signal} is what the control law gives for the row {row} it: a log often holds the command "
            "of another tick than the position beside it; stamp it with the time from which it acts"
        ]
    return []


def _off(rig: PlantRig, model: Model, trial: Trial) -> tuple[float, int, str, str] | None:
    """How far the law's answer is off, at which shift, of which signal and trial; None where it cannot be asked."""
    reference = trial.reference[:LONGEST]
    try:
        run = rig.run(model, {}, trial, reference)
    except PlantDiverged:
        return None
    told = rig.logged(run, trial)

    def recorded(as_simulated: Array) -> tuple[str, Array] | None:
        """Name and values on the ticks of the signal that is logged as the simulation has it."""
        for name, values in told.items():
            if name in trial.signals and np.array_equal(values, as_simulated):
                time, measured = trial.signals[name]
                if time.size > 1 and np.median(np.diff(time)) <= EVERY_TICK * trial.period:
                    return name, np.interp(run.time, time, measured)
        return None

    command, position = recorded(run.motor_voltage), recorded(run.encoder_position)
    if command is None or position is None or np.array_equal(run.motor_voltage, run.encoder_position):
        return None
    law = rig.controller(model, trial.period)
    current = recorded(run.motor_current)
    answers = _answers(law, run, position[1], current[1] if current else np.zeros(run.time.size))
    if current is None and not np.array_equal(
        answers, _answers(law, run, position[1], np.ones(run.time.size))
    ):
        return None  # it reads a current that nobody recorded
    name, measured = command
    size = float(np.std(_smooth(measured)))
    if size == 0.0 or not np.isfinite(answers).all():
        return None
    parts = [(_difference(answers, measured, shift) / size, shift) for shift in SHIFTS]
    best = min(parts, key=lambda one: (one[0], abs(one[1])))
    plain = parts[0]
    return (*(best if best[0] < 0.5 * plain[0] else plain), name, trial.name)


def _answers(law: Controller, run: Rollout, position: Array, current: Array) -> Array:
    law.reset()
    velocity = np.diff(position, prepend=position[0]) / law.period
    given = np.column_stack([run.reference_position, position, velocity, current])
    with watched():
        return replay(law, given)


def _difference(answers: Array, measured: Array, shift: int) -> float:
    """Standard deviation of the difference where the command is logged `shift` ticks after its answer."""
    n = answers.size - abs(shift)
    a = answers[max(-shift, 0) : max(-shift, 0) + n]
    m = measured[max(shift, 0) : max(shift, 0) + n]
    return float(np.std(_smooth(m - a)))


def _smooth(values: Array) -> Array:
    out: Array = np.convolve(values, np.full(SMOOTHED, 1.0 / SMOOTHED), mode="valid")
    return out

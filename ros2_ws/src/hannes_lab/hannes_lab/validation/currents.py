"""R05 to R13: closure time, currents and force of the bench test (thesis P16, P17) on the void hand and two objects.

The thesis does not define its figures.  Here, on the log of one closure (|i| at 30 Hz, averaged over a sample, X17):

    plateau          mean |i| of the void closure from 0.4 s to 1.0 s, the top of the reference
    average closing  mean |i| from 0.2 s (X18: the start-up transient) to the last sample below 0.3 A (P19: void)
    slope closing    steepest rise of |i| over 0.1 s (three sampling periods) from there on
    maximum          largest |i| of the grasp
    slope opening    steepest fall of |i| over 0.1 s between the top of the reference and the least |i|
    average opening  mean |i| from 0.1 s after the least |i| to the end of the reference's fall
    closure time     constant motor current of R07 from rest: time for the 40000 counts of P17

A steepest slope and not one over the whole rise: the sample rows of P23 give 6.9 A/s at 0.3 A, which is R09, and
the whole rise up to R10 takes until the top of the reference.  The closure time is not one of the bench test: its
reference alone takes 1 s to its top, so that a fraction of a second without friction (R06) could not come from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from hannes_control.double_pid import DoublePID, DoublePIDParameters
from hannes_control.reference import FULL_CLOSURE, half_sine
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.factory import make_plant
from hannes_sim.measurement import logger
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL, GraspObject
from hannes_sim.rollout import Rollout, rollout
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIOD, TOP, END = 4.0, 1.0, 2.0
"""s: period of the reference (X01), its top, and the end of its fall."""

SLOPE_WINDOW = 0.1
MASK = 0.2
"""s: start-up transient that is left out (X18: 0.15 to 0.2)."""
VOID_CURRENT = 0.3
"""A; a sample below is void (P19)."""
LOG_WINDOW = 1.0 / 30.0
PLATEAU_CURRENT = 0.25
"""A; R07, and the constant current of the closure-time test."""

OBJECTS: Mapping[str, GraspObject | None] = {"void": None, "rigid": RIGID_DYNAMOMETER, "soft": SOFT_BALL}


@dataclass(frozen=True)
class Closure:
    """One logged closure: time [s] since its start, |i| [A] as logged, encoder [rad], reference [rad], force [N]."""

    time: Array
    current: Array
    encoder: Array
    reference: Array
    force: Array
    signed: Array


def object_for(model: Model, kind: str) -> GraspObject | None:
    """The object of a column, with the calibrated size and stiffness from the model's provenance where it has them."""
    if kind not in OBJECTS:
        raise HannesError(f"Unknown column '{kind}'; valid are {', '.join(OBJECTS)}.")
    grasp = OBJECTS[kind]
    given = model.provenance.get("objects", {}).get(kind, {})
    if grasp is None or not given:
        return grasp
    return GraspObject.from_dict({**grasp.to_dict(), **given})


def simulate(model: Model, grasp: GraspObject | None, *, dt: float = 0.25e-3) -> Closure:
    """The second of two closures, as logged (without noise, on the control grid)."""
    plant = make_plant(model, grasp, dt=dt)
    controller = DoublePID.of_model(model.parameters)
    # rest 2 s after the fall belongs to each period; the last one is not needed
    reference = half_sine(2, period=PERIOD)[: round((PERIOD + END + 0.3) / controller.period)]
    return logged(rollout(plant, controller, reference, joints=False), controller.period)


def logged(run: Rollout, period: float, start: float = PERIOD) -> Closure:
    """The closure that starts at `start`, through the logger."""
    first = round(start / period)
    current = logger(run.motor_current, period, rectified=True, window=LOG_WINDOW)
    part = slice(first, None)
    return Closure(
        run.time[part] - run.time[first],
        current[part],
        run.encoder_position[part],
        run.reference_position[part],
        run.grip_force[part],
        run.motor_current[part],
    )


def figures(closure: Closure, window: float = SLOPE_WINDOW) -> dict[str, float]:
    """The figures of the module's docstring that this closure has; NaN where a phase is missing."""
    t, i = closure.time, closure.current
    out = {"plateau": float(i[(t >= 0.4) & (t <= TOP)].mean())}
    rise = t <= TOP + 0.2
    top = int(np.argmax(np.where(rise & (t >= MASK), i, -np.inf)))
    below = np.flatnonzero((i[: top + 1] < VOID_CURRENT) & (t[: top + 1] >= MASK))
    # the last void sample before the grasp; a closure that never exceeds the threshold is void to the top
    gripped = bool(i[top] >= VOID_CURRENT and below.size)
    void_end = float(t[below[-1]]) if gripped else TOP
    out["void_end"] = void_end
    out["average_closing"] = float(i[(t >= MASK) & (t <= max(void_end, MASK + 0.02))].mean())
    fall = (t >= TOP) & (t <= END - 0.1)
    least = float(t[fall][np.argmin(i[fall])])
    out["least"] = least
    back = (t >= least + 0.1) & (t <= END)
    out["average_opening"] = float(i[back].mean()) if back.any() else math.nan
    if gripped:
        after = (t >= void_end - 0.1) & rise
        out["maximum"] = float(i[top])
        out["slope_closing"] = float(slopes(t[after], i[after], window).max())
    falling = (t >= TOP - window) & (t <= least)
    out["slope_opening"] = float(slopes(t[falling], i[falling], window).min())
    out["force"] = float(closure.force.max())
    return out


def slopes(time: Array, values: Array, window: float = SLOPE_WINDOW) -> Array:
    """Least-squares slope in every window of `window` s (m,); empty windows give one slope over all."""
    n = min(max(2, round(window / float(time[1] - time[0])) + 1), time.size)
    x = np.arange(n) * float(time[1] - time[0])
    weight = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    out: Array = np.convolve(values, weight[::-1], mode="valid")
    return out


def closure_time(
    model: Model,
    current: float = PLATEAU_CURRENT,
    *,
    dt: float = 0.25e-3,
    limit: float = 4.0,
    extrapolate: bool = False,
) -> float:
    """s until the encoder has made 40000 counts with a constant motor current from rest.

    A hand that does not within `limit` gives NaN, or with `extrapolate` the limit lengthened by what is missing, which
    leads a search back to hands that close.
    """
    plant = make_plant(model, None, dt=dt)
    gains = replace(
        DoublePIDParameters.from_parameters(model.parameters),
        kp=1.0,
        damping=0.0,
        current_limit=current,
        saver_time=1e3,
    )
    run = rollout(plant, DoublePID(gains), np.full(round(limit / 1e-3), 1e3), joints=False)
    q = run.encoder_position
    if q.max() < FULL_CLOSURE:
        return limit * (2.0 - float(q.max()) / FULL_CLOSURE) if extrapolate else math.nan
    k = int(np.argmax(q >= FULL_CLOSURE))
    return float(np.interp(FULL_CLOSURE, q[k - 1 : k + 1], run.time[k - 1 : k + 1]))


def frictionless(model: Model) -> Model:
    """The model without any dry or viscous friction (R06)."""
    names = (
        "friction.coulomb",
        "friction.viscous",
        "joints.friction_tension",
        "joints.damping_tension",
        "carts.friction",
        "carts.damping",
        "hand.coulomb",
        "hand.viscous",
    )
    kept = tuple(e for e in model.effects if not e.name.endswith("friction"))
    return replace(model.with_values(dict.fromkeys(names, 0.0)), effects=kept)


def mean_and_sd(values: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation of the finite values."""
    a = np.array([v for v in values if math.isfinite(v)])
    return (float(a.mean()), float(a.std(ddof=1)) if a.size > 1 else 0.0) if a.size else (math.nan, math.nan)

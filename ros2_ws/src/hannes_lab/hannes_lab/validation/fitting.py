"""The validation's own calibration: a call of the calibration of hannes_lab on the thesis' figures.

Targets: the void phases and the rigid column (R05, R07 to R13).  The five preloads are not free: they follow from the
analytic forces of R04 and one lever.  The soft column takes no part.

What R12 takes, the fall of the current at the rigid object, is tried with several laws (`LAWS`), each with one free
number; the soft column, which none of them has seen, is the test.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import load_effect
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL
from scipy.optimize import minimize_scalar

from ..identify import Calibration
from ..problem import Coordinate
from ..search import Progress
from . import least_force
from .currents import closure_time, figures, simulate
from .targets import Target, TargetProblem, calibrate_targets

REAL = {
    "rigid": {
        "average_closing": 0.236,
        "slope_closing": 7.17,
        "maximum": 2.59,
        "average_opening": 0.167,
        "slope_opening": -11.1,
    },
    "soft": {
        "average_closing": 0.254,
        "slope_closing": 1.04,
        "maximum": 0.577,
        "average_opening": 0.169,
        "slope_opening": -2.11,
    },
}
THESIS = {
    "rigid": {
        "average_closing": 0.241,
        "slope_closing": 6.56,
        "maximum": 2.50,
        "average_opening": 0.158,
        "slope_opening": -6.9,
    },
    "soft": {
        "average_closing": 0.236,
        "slope_closing": 1.14,
        "maximum": 0.668,
        "average_opening": 0.158,
        "slope_opening": -1.84,
    },
}
EFFECT = "load_dependent_friction"
BINDING = f"{Path(__file__).with_name('binding.py')}:Binding"
SAVER_TIME = "control.saver_time"

TARGETS = (
    Target("closure_time", "R05", 1.189, 0.003, "s"),
    Target("plateau", "R07", 0.25, 0.01, "A"),
    Target("average_closing", "R08", 0.236, 0.005, "A"),
    Target("slope_closing", "R09", 7.17, 0.2, "A/s"),
    Target("maximum", "R10", 2.59, 0.03, "A"),
    Target("average_opening", "R11", 0.167, 0.005, "A"),
    Target("slope_opening", "R12", -11.1, 0.4, "A/s"),
    Target("force", "R13", 92.3, 1.5, "N"),
)
"""The thesis' measurements on the real hand; the standard deviations are how well each figure is defined."""

MOTORS: Mapping[str, Mapping[str, float]] = {
    "2642W012CR": {
        "motor.resistance": 1.49,
        "motor.inductance": 137e-6,
        "motor.kt": 0.01745,
        "motor.armature": 1.1e-6,
        "friction.coulomb": 0.0255,
        "gear.efficiency": 0.7,
    },
    "2342S012CR": {
        "motor.resistance": 1.9,
        "motor.inductance": 68e-6,
        "motor.kt": 0.0134,
        "motor.armature": 5.8e-7,
        "friction.coulomb": 0.0168,
        "gear.efficiency": 0.88,
    },
}
"""Two motors that fit the currents alike (thesis section 4): winding, rotor, dry friction from the no-load current."""

LEVER = "least_force.lever"

_PRIORS: Mapping[str, float] = {
    "friction.coulomb": 0.5,
    "friction.viscous": 1.0,
    "control.kp": 0.5,
    "control.damping": 0.5,
    "gear.efficiency": 0.2,
    "wires.master_stiffness": 1.5,
}
"""Free parameters of the model with the prior standard deviation of their logarithm."""

_START: Mapping[str, float] = {
    "friction.coulomb": 0.02,
    "friction.viscous": 0.0012,
    "control.kp": 0.9,
    "control.damping": 0.03,
    "gear.efficiency": 0.95,
    "wires.master_stiffness": 1e4,
    f"{EFFECT}.coefficient": 0.75,
    LEVER: 0.17,
}
"""Where the first search starts; the others start at random points around it."""

_START_2342: Mapping[str, float] = {
    "friction.coulomb": 0.012,
    "friction.viscous": 0.0010,
    "control.damping": 0.025,
    f"{EFFECT}.coefficient": 0.45,
}
"""The same for the other motor, where it differs: less torque per ampere, a lighter rotor."""


@dataclass(frozen=True)
class Law:
    """One law that R12 is tried with.

    text    what it says, for the page
    free    its free number (name, prior mean, prior sd of the logarithm, bounds, unit), None without one
    effect  source of its effect (a catalogue name or path.py:Class), None without one
    fixed   parameters that it sets
    start   where its first search starts, where that differs
    """

    text: str
    free: tuple[str, float, float, float, float, str] | None
    effect: str | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)


_WEAK: Mapping[str, float] = {
    "friction.coulomb": 0.008,
    "friction.viscous": 0.0012,
    "control.kp": 1.15,
    "control.damping": 0.06,
    "gear.efficiency": 0.57,
    "wires.master_stiffness": 8500.0,
    "least_force.lever": 0.19,
}

LAWS: Mapping[str, Law] = {
    "proportional": Law(
        "friction in proportion to the load (capstan)",
        (f"{EFFECT}.coefficient", 0.3, 1.0, 0.01, 1.0, "1"),
        EFFECT,
    ),
    "none": Law("nothing; R12 takes no part in the fit", None, start=_WEAK),
    "squared": Law(
        "friction with the square of the load (binding)",
        ("binding.coefficient", 1.0, 1.0, 0.01, 20.0, "1/(N.m)"),
        BINDING,
        start={
            "friction.coulomb": 0.018,
            "friction.viscous": 0.0018,
            "control.kp": 1.0,
            "least_force.lever": 0.25,
            "binding.coefficient": 1.7,
        },
    ),
    "saver": Law(
        "the battery saver (P12), threshold 1 A, its time free",
        (SAVER_TIME, 1.0, 0.5, 0.1, 5.0, "s"),
        fixed={"control.saver_current": 1.0},
        start={**_WEAK, SAVER_TIME: 0.86},
    ),
}
"""Laws by name; the shipped hand has the first."""


def coordinates(model: Model, law: str = "proportional") -> list[Coordinate]:
    """What is free: six parameters, the law's own number, and the lever of R04."""
    out = [
        Coordinate(
            name,
            model.parameters.value(name),
            sd,
            True,
            model.parameters[name].lower,
            model.parameters[name].upper,
            True,
            0.02 / sd,
            model.parameters[name].unit,
        )
        for name, sd in _PRIORS.items()
    ]
    own = LAWS[law].free
    if own is not None:
        name, mean, sd, lower, upper, unit = own
        out.append(Coordinate(name, mean, sd, True, lower, upper, True, 0.02, unit))
    out.append(Coordinate(LEVER, 0.24, 0.4, True, 0.05, 1.0, True, 0.05, "1"))
    return out


def base_model(motor: str = "2642W012CR", law: str = "proportional") -> Model:
    """The nominal hand on the multi-body plant with a named motor and the law that R12 is tried with."""
    if motor not in MOTORS:
        raise HannesError(f"Unknown motor '{motor}'; valid are {', '.join(MOTORS)}.")
    if law not in LAWS:
        raise HannesError(f"Unknown law '{law}'; valid are {', '.join(LAWS)}.")
    model = Model.load("nominal_mujoco")
    if motor != "2642W012CR":
        model = model.with_values(MOTORS[motor], status="datasheet", source=f"FAULHABER {motor}, scaled")
    chosen = LAWS[law]
    if chosen.fixed:
        model = model.with_values(chosen.fixed)
    if chosen.effect is None or chosen.free is None:
        return model
    return model.with_effect(
        load_effect(chosen.effect).entry({"coefficient": chosen.free[1]}, source=_source(chosen))
    )


def _source(law: Law) -> str | None:
    """The source that an effect's entry names: none for one of the catalogue."""
    return law.effect if law.effect and ":" in law.effect else None


def applied(model: Model, values: Mapping[str, float], law: str = "proportional") -> Model:
    """The model with calibrated values: parameters, the effect, and the preloads that follow from the lever."""
    lever = values.get(LEVER, least_force.LEVER)
    own = {n: v for n, v in values.items() if n in model.parameters}
    out = model.with_values(own)
    chosen = LAWS[law]
    if chosen.effect is not None and chosen.free is not None and chosen.free[0] in values:
        entry = load_effect(chosen.effect).entry(
            {"coefficient": values[chosen.free[0]]}, source=_source(chosen)
        )
        out = out.with_effect(entry)
    return out.with_values(least_force.preloads_for(out, least_force.ANALYTIC, lever))


def predict(model: Model, values: Mapping[str, float], law: str = "proportional") -> Mapping[str, float]:
    """The targets' figures: closure-time test, void closure and rigid closure."""
    hand = applied(model, values, law)
    found = figures(simulate(hand, RIGID_DYNAMOMETER))
    void = figures(simulate(hand, None))
    return {
        **found,
        "plateau": void["plateau"],
        "closure_time": closure_time(hand, limit=2.5, extrapolate=True),
    }


def targets_of(law: str) -> tuple[Target, ...]:
    """The figures that a law is fitted to."""
    return TARGETS if LAWS[law].free is not None else tuple(t for t in TARGETS if t.row != "R12")


def calibrate_thesis(
    *,
    motor: str = "2642W012CR",
    law: str = "proportional",
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 10,
    cache: Path | None = None,
    progress: Progress | None = None,
    first: Mapping[str, float] | None = None,
) -> Calibration:
    """Calibrate the hand on TARGETS; the model in the result is complete, with objects and lever in its provenance."""
    base = base_model(motor, law)
    free = coordinates(base, law)
    start = dict(first or {**_START, **LAWS[law].start})
    if motor != "2642W012CR" and first is None:
        start |= _START_2342
    begin = {c.name: c.z(start[c.name]) for c in free if c.name in start}
    problem = TargetProblem(targets_of(law), partial(predict, law=law), f"bench test 4 {law}")
    found = calibrate_targets(
        problem,
        base,
        free,
        starts=starts,
        seed=seed,
        evaluations=evaluations,
        cache=cache,
        first=begin,
        progress=progress,
    )
    return replace(found, model=_finished(found, base, motor))


SOFT_FITTED = ("slope_closing", "maximum")
"""Figures of the soft column that its one free number, the stiffness of the object, is chosen by."""


def fit_soft_stiffness(model: Model) -> float:
    """N/m of the soft ball: least largest error in SOFT_FITTED, each in units of the thesis' own error there."""

    def cost(log_stiffness: float) -> float:
        found = figures(simulate(model, replace(SOFT_BALL, stiffness=math.exp(log_stiffness))))
        return max(
            abs((found.get(n, 0.0) - REAL["soft"][n]) / (THESIS["soft"][n] - REAL["soft"][n]))
            for n in SOFT_FITTED
        )

    found = minimize_scalar(
        cost, bounds=(math.log(100.0), math.log(1500.0)), method="bounded", options={"xatol": 0.01}
    )
    return float(math.exp(found.x))


def _finished(found: Calibration, base: Model, motor: str) -> Model:
    values = found.best.values
    hand = found.model.with_values(
        least_force.preloads_for(found.model, least_force.ANALYTIC, values[LEVER]),
        status="identified",
        source=f"solved from R04 (analytic) with the force at {values[LEVER]:.4f} of the distance to the tip pad",
    )
    rows = list(dict.fromkeys(t.row for t in TARGETS))
    provenance: dict[str, Any] = {
        "command": "hannes validate --calibrate" + (f" --motor {motor}" if motor != "2642W012CR" else ""),
        "fitted_to": [*rows, "R04 (analytic forces)"],
        "motor": motor,
        "lever": float(values[LEVER]),
        "free_parameters": len(found.parameters),
        "targets": len(TARGETS),
        "nominal_sha256": base.sha256,
        "cost": float(found.costs[0]),
        "starts": len(found.costs),
        "agree": found.agree,
        "costs": [float(f"{c:.5g}") for c in found.costs],
        "intervals_95": {p.name: [float(f"{p.low:.5g}"), float(f"{p.high:.5g}")] for p in found.parameters},
        "warnings": list(found.warnings),
    }
    hand = replace(hand, provenance=provenance)
    provenance["objects"] = {"soft": {"stiffness": float(fit_soft_stiffness(hand))}}
    name = "thesis_hand" if motor == "2642W012CR" else f"thesis_hand_{motor[:4]}"
    return replace(hand, name=name, provenance=provenance)

"""The validation's own calibration: a call of the calibration of hannes_lab on the thesis' figures.

Targets: the void phases and the rigid column (R05, R07 to R13).  The five preloads are not free: they follow from the
analytic forces of R04 and one lever.  The soft column takes no part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import load_effect
from hannes_sim.objects import RIGID_DYNAMOMETER

from ..calibrate import Calibration, Progress, Target, TargetProblem, calibrate_targets
from ..problem import Coordinate
from . import least_force
from .columns import fit_soft_stiffness
from .currents import closure_time, figures, simulate

EFFECT = "load_dependent_friction"

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


def coordinates(model: Model) -> list[Coordinate]:
    """What is free: six parameters, the capstan friction, and the lever of R04."""
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
    out.append(Coordinate(f"{EFFECT}.coefficient", 0.3, 1.0, True, 0.01, 1.0, True, 0.02, "1"))
    out.append(Coordinate(LEVER, 0.24, 0.4, True, 0.05, 1.0, True, 0.05, "1"))
    return out


def base_model(motor: str = "2642W012CR") -> Model:
    """The nominal hand on the multi-body plant with a named motor and the capstan friction that R12 asks for."""
    if motor not in MOTORS:
        raise HannesError(f"Unknown motor '{motor}'; valid are {', '.join(MOTORS)}.")
    model = Model.load("nominal_mujoco")
    if motor != "2642W012CR":
        model = model.with_values(MOTORS[motor], status="datasheet", source=f"FAULHABER {motor}, scaled")
    return model.with_effect(load_effect(EFFECT).entry({"coefficient": 0.3}))


def applied(model: Model, values: Mapping[str, float]) -> Model:
    """The model with calibrated values: parameters, the effect, and the preloads that follow from the lever."""
    lever = values.get(LEVER, least_force.LEVER)
    own = {n: v for n, v in values.items() if n in model.parameters}
    out = model.with_values(own)
    name = f"{EFFECT}.coefficient"
    if name in values:
        out = out.with_effect(load_effect(EFFECT).entry({"coefficient": values[name]}))
    return out.with_values(least_force.preloads_for(out, least_force.ANALYTIC, lever))


def predict(model: Model, values: Mapping[str, float]) -> Mapping[str, float]:
    """The targets' figures: closure-time test, void closure and rigid closure."""
    hand = applied(model, values)
    found = figures(simulate(hand, RIGID_DYNAMOMETER))
    void = figures(simulate(hand, None))
    return {
        **found,
        "plateau": void["plateau"],
        "closure_time": closure_time(hand, limit=2.5, extrapolate=True),
    }


def calibrate_thesis(
    *,
    motor: str = "2642W012CR",
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 12,
    cache: Path | None = None,
    progress: Progress | None = None,
    first: Mapping[str, float] | None = None,
) -> Calibration:
    """Calibrate the hand on TARGETS; the model in the result is complete, with objects and lever in its provenance."""
    base = base_model(motor)
    free = coordinates(base)
    begin = {c.name: c.z((first or _START)[c.name]) for c in free if c.name in (first or _START)}
    if motor != "2642W012CR" and first is None:
        for c in free:
            if c.name in _START_2342:
                begin[c.name] = c.z(_START_2342[c.name])
    problem = TargetProblem(TARGETS, predict, "bench test 4")
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
        "intervals_95": {p.name: [float(f"{p.low:.5g}"), float(f"{p.high:.5g}")] for p in found.parameters},
        "warnings": list(found.warnings),
    }
    hand = replace(hand, provenance=provenance)
    provenance["objects"] = {"soft": {"stiffness": float(fit_soft_stiffness(hand))}}
    name = "thesis_hand" if motor == "2642W012CR" else f"thesis_hand_{motor[:4]}"
    return replace(hand, name=name, provenance=provenance)

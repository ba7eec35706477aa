"""Calibration: named parameters of a model identified from recordings; the method is in identify.py."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import numpy as np
from hannes_description.errors import HannesError
from numpy.typing import NDArray

from .cache import code_hash, content_hash
from .errors import held_out_closures, overall, signal_errors
from .features import data_used
from .fit import Fit, fit
from .hand import HandRig
from .identify import (
    Calibration,
    agreeing,
    calibrated_model,
    free_coordinates,
    identify,
    search,
    sensitivities,
    warnings_of,
)
from .prepare import Prepared
from .problem import Coordinate, Problem, build_problem, nuisance_coordinate
from .provenance import made_from
from .remembered import Remembered
from .search import Progress

Array = NDArray[np.float64]

GAINS = tuple(f"control.{name}" for name in ("kp", "damping", "current_kp", "current_ki"))
"""Gains of the double PID that may be free: a rollout can change them."""

LARGE_MISFIT = 3.0
"""Multiple of the repeatability above which the model, whatever its parameters, does not explain the recordings."""

EXPLAINS = 0.3
"""Share of the misfit that a held parameter must explain to be named."""


def calibrate(
    prepared: Prepared,
    free: Sequence[str],
    *,
    sds: Mapping[str, float] | None = None,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 15,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate named parameters on recordings.

    Beside them, what belongs to the recording alone (place and stiffness of its object, zeros of its encoder; clock,
    logger and gains where it does not describe them) is fitted with its own prior.  The noise is estimated anew where
    the searches end, and the best of them goes on from there.  Held-out error: every second closure takes no part in a
    further fit.
    Raises HannesError for a name that the plant cannot change.
    """
    model = prepared.model
    _check_names(prepared, free)
    coordinates = free_coordinates(model, free, sds)
    bench = [n for n in prepared.nuisances if _of_the_recording(n.name) and n.name not in free]
    coordinates += [nuisance_coordinate(n) for n in bench]
    own = {c.name for c in coordinates}
    held = [nuisance_coordinate(n) for n in prepared.nuisances if n.name not in own]
    used = data_used(prepared.features)
    # A slow plant may have been prepared through a fast one, which lacks the parameters of the mechanics.
    exact = prepared.problem.with_rig(prepared.rig)
    remembered = Remembered(exact, _key(exact), cache, progress)
    remembered.total = (starts + 1) * evaluations * (len(coordinates) + 1)

    def announce(k: int, n: int) -> None:
        remembered.text = f"start {k + 1} of {n}"

    found = search(
        remembered, model, coordinates, starts=starts, seed=seed, evaluations=evaluations, announce=announce
    )
    costs = tuple(f.cost for f in found)
    problem = build_problem(prepared.rig, prepared.features, model, prepared.nuisances, found[0].values)
    again = Remembered(problem, _key(problem), cache, progress)
    again.done, again.total, again.text = remembered.done, remembered.total, "noise estimated anew"
    best = fit(cast(Problem, again), model, coordinates, found[0].z, evaluations=evaluations, exact=True)
    again.text = "tolerances of what is held"
    by_held = sensitivities(again, best, held)
    parameters = identify(best, free, held, by_held)
    features = prepared.features
    before = overall(signal_errors(features, features.closures(prepared.rig, model, {})))
    after = overall(signal_errors(features, features.closures(prepared.rig, model, best.values)))
    errors = {"before": before, "after": after}
    if any(b.n > 1 for b in features.blocks):
        if progress is not None:
            progress(again.done, max(again.total, again.done), "held-out closures")

        def problem_of(train: Any) -> Any:
            return build_problem(prepared.rig, train, model, prepared.nuisances, best.values)

        errors["train"], errors["held_out"] = held_out_closures(
            problem_of, features, model, coordinates, best.z
        )
    if progress is not None:
        progress(again.total, again.total, "done")
    bags = ", ".join(str(d["name"]) for d in used)
    made = made_from(
        calibrated_model(model, parameters, f"calibrated on {bags}"),
        model,
        features,
        free=list(free),
        intervals_95={p.name: [float(f"{p.low:.5g}"), float(f"{p.high:.5g}")] for p in parameters},
        errors={k: round(v, 4) for k, v in errors.items() if math.isfinite(v)},
        recordings={n: float(f"{v:.6g}") for n, v in best.values.items() if n not in free},
    )
    notes = warnings_of(parameters, len(free), features.size)
    notes += _notes_of_errors(errors, explaining(best, held, by_held))
    notes += [
        f"{n} is marked as fixed in the parameter file ({model.parameters[n].source}); it is free because you named it."
        for n in free
        if n in model.parameters and model.parameters[n].fixed
    ]
    if held:
        notes.append(
            f"The intervals hold the tolerances (population.yaml) of {', '.join(c.name for c in held)}; "
            "everything else that is not free is taken as exact."
        )
    if starts > 1 and agreeing(costs) == 1:
        notes.append("Only one start reached the best point; try more --starts.")
    return Calibration(
        made,
        parameters,
        costs,
        agreeing(costs),
        errors,
        (*notes, *prepared.notes),
        again.done - remembered.hits - again.hits,
        remembered.hits + again.hits,
        best,
    )


def _of_the_recording(name: str) -> bool:
    """A nuisance parameter that says nothing of the hand."""
    return "@" in name or name.startswith(("log.", "control.", "encoder."))


def _key(problem: Problem) -> str:
    """What the residuals depend on beside the model and the parameters' values."""
    whitening = hashlib.sha256(
        b"".join(np.ascontiguousarray(lower).tobytes() for _, lower in problem.whitener)
    )
    return code_hash() + content_hash(problem.features.trials) + whitening.hexdigest()


def explaining(best: Fit, held: Sequence[Coordinate], by_held: Array) -> list[str]:
    """Held parameters of which one alone, within its tolerance, would take away EXPLAINS of the misfit; best first."""
    # What the free parameters cannot do as well: the part of H that their derivatives do not span.
    rest = by_held - best.jacobian @ (best.covariance() @ (best.jacobian.T @ by_held))
    gain = (rest.T @ best.residual) ** 2 / (1.0 + (rest**2).sum(axis=0)) / max(best.misfit, 1e-300)
    return [held[k].name for k in np.argsort(-gain) if gain[k] > EXPLAINS]


def _notes_of_errors(errors: Mapping[str, float], held: Sequence[str]) -> list[str]:
    """Whether the calibrated model explains the recordings, and whether it says the same of other closures.

    held  held parameters that would explain much of the misfit
    """
    before, after, train, held_out = (
        errors.get(k, math.nan) for k in ("before", "after", "train", "held_out")
    )
    out = []
    if after > before:
        out.append(
            f"The calibrated model is further off ({after:.2f} times the repeatability) than the given one "
            f"({before:.2f}): do not use it. Something else must be free, or is missing (`hannes diagnose`)."
        )
    if not math.isfinite(after):
        out.append(
            "No condition was repeated: there is no repeatability and no held-out closure to judge the model by."
        )
    elif after > LARGE_MISFIT:
        rest = (
            f"{' or '.join(held[:2])}, which is held, would explain much of it: free it too."
            if held
            else "Run `hannes diagnose`, or free what else is uncertain."
        )
        out.append(
            f"The calibrated model misses the recordings by {after:.1f} times their repeatability: it lacks "
            f"something, the values make up for it, and the intervals may be too narrow. {rest}"
        )
    if held_out > 1.5 * train + 0.5:
        out.append(
            f"Held-out closures are missed by {held_out:.2f}, the others by {train:.2f} times the repeatability: "
            "too many parameters for these closures."
        )
    return out


def _check_names(prepared: Prepared, free: Sequence[str]) -> None:
    if not isinstance(prepared.rig, HandRig):
        return
    settable: set[str] = set()
    for trial in prepared.rig.trials:
        plant, _, _ = prepared.rig._plant(prepared.model, trial)
        settable |= set(plant.names)
    if prepared.model.controller == "double_pid":
        settable |= set(GAINS)
    known = settable & prepared.model.names
    unknown = [n for n in free if n not in known]
    if unknown:
        close = [m for n in unknown for m in get_close_matches(n, sorted(known), 2)]
        hint = f" Did you mean {' or '.join(dict.fromkeys(close))}?" if close else ""
        valid = sorted(n for n in known if not n.startswith(("geometry.", "inertia.")))
        raise HannesError(
            f"--free {', '.join(unknown)}: not a parameter that the plant '{prepared.model.plant}' can "
            f"change.{hint} Valid are {', '.join(valid)}."
        )

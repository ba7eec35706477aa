"""How the error on closures that took no part in the fit falls, effect by effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .diagnosis import Fall
from .errors import (
    condition_error,
    held_out_closures,
    held_out_conditions,
    overall,
    per_signal,
    signal_errors,
)
from .features import Features
from .prepare import Prepared
from .problem import Problem, build_problem
from .rig import Rig
from .search import Candidate, Search, key_of
from .settle import slopes_at
from .surrogate import exact_rig

WITHOUT_EFFECT = 2
"""Steps of an error that falls before the first effect: the nominal model as given, and fitted."""

NOMINAL_FITTED = WITHOUT_EFFECT - 1
"""Number of the step that is the fitted nominal model."""

NO_REPEATS = "No condition was repeated: there is no repeatability to hold the error against."


def error_falls(
    prepared: Prepared,
    search: Search,
    best: Candidate,
    *,
    first: Search | None = None,
    in_order: bool = False,
) -> tuple[Fall, ...]:
    """Nominal as given, nominal fitted, then the effects one after another in the order that helps most.

    first      the search with the noise as the nominal model shows it: the nominal is fitted with that, whatever was
               looked for and found.  A wrong model is fitted differently with other weights.  None: `search`
    in_order   take the effects in the order in which they stand
    """
    features = prepared.features
    nominal = signal_errors(features, features.closures(prepared.rig, prepared.model, {}))
    falls = [
        Fall(
            "nominal, as given",
            overall(nominal),
            overall(nominal),
            {c: overall([e for e in nominal if e.condition == c]) for c in features.conditions},
            nominal,
            per_signal(features, [nominal]),
            condition_error(features, [nominal]),
        )
    ]
    steps: list[tuple[str, Candidate]] = []
    chain: tuple[str, ...] = ()
    left = list(best.names)
    while left:
        options = [
            search.found.get(key_of((*chain, name))) or search.add(search.fit_of(chain), name)
            for name in (left[:1] if in_order else left)
        ]
        pick = min(range(len(options)), key=lambda k: options[k].penalised)
        chain = (*chain, left[pick])
        steps.append((left.pop(pick), options[pick]))
    first = first or search
    base = first.null()
    held = [first.once(_fall_in_worker, base, base.fit.values, text="held-out error of the nominal")]
    held += search.each(_fall_in_worker, [(c, best.fit.values) for _, c in steps], "held-out error")
    for label, found in zip(("nominal, fitted", *(name for name, _ in steps)), held, strict=True):
        falls.append(Fall(label, *found))
    return tuple(falls)


def _fall_in_worker(search: Search, candidate: Candidate, values: Mapping[str, float]) -> tuple[Any, ...]:
    """What a Fall holds of one fitted set; the noise is estimated at `values`."""
    f = candidate.fit
    features = search.problem.features
    problem = search.problem.with_rig(slopes_at(search.problem.rig, f))
    build = _problem_builder(search, problem.rig, values)
    train, test = held_out_closures(build, features, f.model, f.coordinates, f.z)
    left_out = held_out_conditions(problem, f.model, f.coordinates, f.z)
    held = {condition: errors for condition, (errors, _) in left_out.items()}
    by_condition = {condition: overall(own) for condition, own in held.items()}
    errors = signal_errors(features, features.closures(exact_rig(problem.rig), f.model, f.values))
    of_all = condition_error(features, held.values())
    signals = per_signal(features, held.values())
    moved = {condition: z for condition, (_, z) in left_out.items()}
    return train, test, by_condition, errors, signals, of_all, moved


def _problem_builder(search: Search, rig: Rig, values: Mapping[str, float]) -> Any:
    """A function from Features to a Problem with noise estimated on those features."""

    def build(features: Features) -> Problem:
        nuisances = search.nuisances
        values_there = {n.name: values.get(n.name, n.mean) for n in nuisances}
        return build_problem(rig, features, search.model, nuisances, values_there)

    return build


def worth_showing(
    search: Search, best: Candidate, falls: tuple[Fall, ...]
) -> tuple[Candidate, tuple[Fall, ...]]:
    """The effects up to that with which what was left out is foretold best: what follows only fits better."""
    errors = left_out_errors(falls)[NOMINAL_FITTED:]
    if not np.isfinite(errors).any():
        return best, falls
    keep = NOMINAL_FITTED + int(np.nanargmin(errors))
    names = tuple(fall.added for fall in falls[WITHOUT_EFFECT : keep + 1])
    if len(names) == len(best.names):
        return best, falls
    return search.fit_of(names), falls[: keep + 1]


FORETOLD = 0.25
"""Part of the mean square error on closures or on conditions that were left out, by which one is clearly less than
another: what an effect must remove where the rest explains all and no model has the machine's form.  A wrong one bends
the fit to its own data."""


def clearly_less(error: float, other: float) -> bool:
    """Whether an error on what was left out is less than another by FORETOLD at least."""
    return error**2 <= (1.0 - FORETOLD) * other**2


def left_out_errors(falls: Sequence[Fall]) -> list[float]:
    """Error on held-out closures of each step; where none was repeated, on held-out conditions (relative_errors)."""
    errors = [fall.held_out for fall in falls]
    return errors if np.isfinite(errors[1:]).any() else relative_errors(falls)


def deciding_errors(falls: Sequence[Fall]) -> list[float]:
    """Error on held-out conditions of each step, in multiples of the repeatability, or of the fitted nominal's."""
    errors = [fall.held_out_conditions for fall in falls]
    return errors if np.isfinite(errors[1:]).any() else relative_errors(falls)


def relative_errors(falls: Sequence[Fall]) -> list[float]:
    """Error on held-out conditions in multiples of the fitted nominal model's, root mean square over signals.

    It needs no repeatability; NaN where no condition could be held out.
    """
    return _relative([fall.held_out_signals for fall in falls])


def _relative(steps: Sequence[Mapping[str, float]]) -> list[float]:
    """Errors by signal of each step over those of the fitted nominal model, root mean square; NaN of none."""
    base = steps[NOMINAL_FITTED]
    out = []
    for errors in steps:
        ratios = [errors.get(s, np.nan) / error for s, error in base.items() if error > 0.0]
        out.append(float(np.sqrt(np.mean(np.square(ratios)))) if ratios else float("nan"))
    return out


def before(errors: Sequence[float]) -> int:
    """Number of the step from which errors fall: the nominal model as given or fitted, whichever is nearer.

    A fit weighs what is known of the model's own error, and tolerances, which errors do not: it may raise them.
    """
    first = np.asarray(errors[:WITHOUT_EFFECT], dtype=np.float64)
    return int(np.nanargmin(first)) if np.isfinite(first).any() else NOMINAL_FITTED


def step_name(number: int, added: str) -> str:
    """A step of the fall as tables and pages name it: what was added has a plus."""
    return added if number < WITHOUT_EFFECT else f"+ {added}"


def fall_sentence(falls: Sequence[Fall], by_conditions: bool = False) -> str:
    """How the error on held-out closures falls, or that it does not; in the signals' units where nothing was repeated.

    Where no effect was added, what it is.  by_conditions: that on held-out conditions decided, and comes first.
    """
    if (
        by_conditions
        and np.isfinite([f.held_out_conditions for f in (*falls[:WITHOUT_EFFECT], falls[-1])]).all()
    ):
        return _by_conditions(falls)
    first, after = falls[before([fall.held_out for fall in falls])], falls[-1].held_out
    nominal = first.held_out
    if not np.isfinite([nominal, after]).all():
        return f"{NO_REPEATS} {_in_units(falls)}".rstrip()
    if len(falls) == WITHOUT_EFFECT:
        given = f" ({nominal:.2f} as it was given)" if nominal < after else ""
        return f"The error on held-out closures is {after:.2f} times the repeatability{given}."
    verb = "falls" if after <= nominal else "rises"
    begin = _begin(first, nominal, falls[NOMINAL_FITTED].held_out, after)
    said = f"The error on held-out closures {verb} from {begin} to {after:.2f} times the repeatability"
    if after <= nominal:
        return f"{said}."
    old, new = first.by_condition, falls[-1].by_condition
    each = [f"'{name}' from {old[name]:.2f} to {error:.2f}" for name, error in new.items() if name in old]
    return f"{said} (conditions left out: {', '.join(each)})." if each else f"{said}."


def _by_conditions(falls: Sequence[Fall]) -> str:
    """The same of conditions that were left out of the fit as a whole, with what the closures say beside it."""
    what = "The error on conditions that were left out of the fit"
    first, last = falls[before([fall.held_out_conditions for fall in falls])], falls[-1]
    nominal, after = first.held_out_conditions, last.held_out_conditions
    if len(falls) == WITHOUT_EFFECT:
        closures = f" ({last.held_out:.2f} on held-out closures)" if np.isfinite(last.held_out) else ""
        return f"{what} is {after:.2f} times the repeatability{closures}."
    closures = (
        f" (on held-out closures from {first.held_out:.2f} to {last.held_out:.2f})"
        if np.isfinite([first.held_out, last.held_out]).all()
        else ""
    )
    verb = "falls" if after <= nominal else "rises"
    begin = _begin(first, nominal, falls[NOMINAL_FITTED].held_out_conditions, after)
    return f"{what} {verb} from {begin} to {after:.2f} times the repeatability{closures}."


def _begin(first: Fall, error: float, fitted: float, after: float) -> str:
    """Whence an error falls or rises; where it rises from the model as given, with that of its fit, which is farther
    off still: the effects were added to that."""
    return f"{error:.2f} ({first.added}{f'; {fitted:.2f} as fitted' if error < after < fitted else ''})"


def errors_in_units(falls: Sequence[Mapping[str, Any]]) -> tuple[bool, list[dict[str, float]]]:
    """Whether conditions could be left out of the fit, and each step's error by signal, in the signal's unit.

    On conditions that were left out; where there is but one, on those of the fit, root mean square over conditions.
    falls   as Fall.to_dict gives them
    """
    if falls[-1].get("held_out_signals"):
        return True, [dict(fall.get("held_out_signals") or {}) for fall in falls]
    return False, fit_in_units(falls)


def fit_in_units(falls: Sequence[Mapping[str, Any]]) -> list[dict[str, float]]:
    """Each step's error of the fit by signal, in its unit: root mean square over conditions."""
    out = []
    for fall in falls:
        squares: dict[str, list[float]] = {}
        for e in fall.get("signals", ()):
            if e.get("rmse") is not None:
                squares.setdefault(str(e.get("signal")), []).append(e["rmse"] ** 2)
        out.append({s: float(np.sqrt(np.mean(own))) for s, own in squares.items()})
    return out


def before_in_units(steps: Sequence[Mapping[str, float]]) -> int:
    """The same of errors by signal, each in its unit (errors_in_units): by their ratios to the fitted nominal's."""
    return before(_relative(steps))


def _in_units(falls: Sequence[Fall]) -> str:
    """How the error of each signal changes from the nominal model to the last step."""
    held, steps = errors_in_units([fall.to_dict() for fall in falls])
    units = {e.signal: e.unit for e in falls[-1].signals}
    first = before_in_units(steps) if len(falls) > WITHOUT_EFFECT else NOMINAL_FITTED
    old, new = steps[first], steps[-1]
    each = [
        f"{name} "
        + (f"{new[name]:.3g}" if len(falls) == WITHOUT_EFFECT else f"from {old[name]:.3g} to {new[name]:.3g}")
        # a number without a dimension has no unit to name
        + (f" {units[name]}" if units.get(name, "1") != "1" else "")
        for name in new
        if name in old
    ]
    where = (
        "on conditions that were left out of the fit" if held else "of the fit, for nothing could be held out"
    )
    return f"Error {where}: {', '.join(each)}." if each else ""

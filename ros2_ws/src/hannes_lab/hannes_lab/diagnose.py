"""Which physical effect does the model lack?  Nothing, named effects, or something unknown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_sim.effect import catalogue, effect_source, is_own_effect, load_effect
from numpy.typing import NDArray

from .adequacy import in_the_law, is_adequate, leads_back, led_off
from .chance import Chance, chance
from .choose import (
    EACH_TAKES,
    Choice,
    choose,
    choose_greedily,
    cut_to,
    judged_by_conditions,
    must_be_held_out,
    needed_gain,
    tied_sets,
    with_unnamed,
)
from .conclusion import Conclusion
from .delays import in_time
from .depends import pointed_at, residual_dependences
from .diagnosis import Diagnosis, Fall, FoundEffect, ParameterEstimate
from .errors import SignalError
from .executor import Executor
from .experiments import separating_experiments
from .falls import (
    NOMINAL_FITTED,
    WITHOUT_EFFECT,
    before,
    clearly_less,
    deciding_errors,
    error_falls,
    left_out_errors,
    worth_showing,
)
from .features import data_used
from .fit import Fit, nuisance_table
from .greedy import OF_NOMINAL
from .intervals import intervals_of, may_vanish, strain, sway, wider
from .limits import MAX_EFFECTS, MAX_GREEDY
from .prepare import Prepared
from .provenance import falls_made, made_from
from .screen import usable_effects
from .search import FAR, PENALTY, Candidate, Progress, Search, silent
from .wording import (
    bent_sentence,
    condition_apart,
    idle_sentence,
    jumps,
    law_sentence,
    lead,
    led_back_sentence,
    notes,
    other_clock,
    phase_moves,
    worse_fitted,
)

Array = NDArray[np.float64]

FITTED = "fitted by hannes"
"""Source of the nominal parameters in a model that was fitted, with effects or without."""

FEW_CONDITIONS = 3
"""Of so many one that is left out opens most intervals."""

RISES = 0.01
"""Part by which the error on conditions that were left out rises where it does: where two fits end differs by less."""

NEEDED = 2.0
"""So many times the error with an effect, or what chance makes of it, without it on closures and on conditions that
were left out: then it is named also where its intervals hold nought."""


def effect_sources(
    extra: Sequence[str] = (), *, only: Sequence[str] | None = None, model: Model | None = None
) -> dict[str, str]:
    """Effects to consider by name: the catalogue (or `only`) and the user's own, without those the model has.

    Two different effects of one name are a HannesError: results could not say which one they mean.
    """
    own = {load_effect(given).name for given in extra} - catalogue().keys()
    names = [name for name in only if name not in own] if only is not None else list(catalogue())
    out: dict[str, str] = {}
    for given in (*names, *extra):
        kind = load_effect(given)
        name = kind.name
        if load_effect(out.setdefault(name, given)) is not kind:
            first = out[name] if is_own_effect(out[name]) else f"the catalogue's {name}"
            raise HannesError(
                f"Two effects are named '{name}': {first} and {given}. Give yours a name of its own, or leave the "
                'other one out (--only, on the page "Diagnose with these only", names the effects that take part).'
            )
    have = {effect.name for effect in model.effects} if model is not None else set()
    return {name: given for name, given in out.items() if name not in have}


def diagnose(
    prepared: Prepared,
    sources: Mapping[str, str],
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    progress: Progress = silent,
    max_effects: int | None = None,
    greedy: bool | None = None,
) -> Diagnosis:
    """Search the catalogue; see the module docstrings of search, chance and problem for the method.

    executor  where the work is done, and where its results are kept; `jobs` processes if None
    max_effects  effects that are named at most; MAX_EFFECTS, or MAX_GREEDY, if None
    greedy   add effects one after another as long as the error on held-out conditions falls (greedy.py), instead of
             looking for the smallest set that explains all; None: where no model has the machine's form
             (Rig.foreign), and there are two conditions or more
    """
    greedy, max_effects = _how(prepared, greedy, max_effects)
    prepared, search, only = _opened(prepared, sources, executor or Executor(jobs), progress)
    given = prepared
    prepared, search = in_time(given, search)
    moved = None if prepared is given else prepared
    answer = _answer(prepared, search, max_effects, greedy)
    told, intervals = _concluded(answer, only, greedy)
    choice, best, falls, unknown = answer.choice, told.best, told.falls, told.verdict == "unknown"
    search, limits = choice.search, choice.limits
    prepared = replace(prepared, problem=search.problem)
    depends_on = residual_dependences(
        prepared.features,
        prepared.features.closures(prepared.rig, best.fit.model, best.fit.values),
        prepared.rig.drive_signals,
    )
    pointer = pointed_at(depends_on, prepared.rig.drive_signals) if unknown else ""
    tied = told.tied
    experiments = separating_experiments(prepared, [search.fit_of(n) for n in tied]) if len(tied) > 1 else ()
    return Diagnosis(
        verdict=told.verdict,
        summary=told.summary,
        effects=told.effects,
        tied=tied,
        experiments=experiments,
        falls=falls,
        ranking=choice.ranking,
        depends_on=depends_on,
        chance=limits,
        costs={
            "nominal_fitted": answer.null.fit.cost,
            "critical_nominal": answer.first.misfit,
            "final": best.fit.cost,
            "critical": limits.misfit,
        },
        nuisances=nuisance_table(best.fit, intervals),
        notes=(
            *((pointer,) if pointer else ()),
            *told.lost,
            *(_needed_although(told) if greedy else ()),
            *prepared.notes,
            *choice.notes,
            *((choice.left,) if choice.left and not unknown else ()),
            *notes(search, best, told.verdict, told.effects, experiments, greedy, told.clock),
            *(lead(choice, falls) if told.verdict == "effects" else ()),
            *(() if unknown else condition_apart(falls)),
            *worse_fitted(falls),
            *jumps(best.fit, limits),
        ),
        simulations=prepared.problem.simulations,
        data=data_used(prepared.features),
        given=prepared.model,
        model=fitted_model(prepared, search, best, intervals, falls),
        values=best.fit.values,
        nominal=answer.null.fit.values,
        unknown_kind=told.kind,
        greedy=greedy,
        moved=moved,
    )


def _how(prepared: Prepared, greedy: bool | None, max_effects: int | None) -> tuple[bool, int]:
    """Whether effects are added one after another, and how many at most; see `diagnose`."""
    if greedy is None:
        greedy = prepared.rig.foreign and len(prepared.features.conditions) > 1
    if greedy:
        must_be_held_out(prepared.features)
    if max_effects is None:
        max_effects = MAX_GREEDY if greedy else MAX_EFFECTS
    return greedy, max_effects


def _opened(
    prepared: Prepared, sources: Mapping[str, str], executor: Executor, progress: Progress
) -> tuple[Prepared, Search, tuple[str, ...]]:
    """The search among the effects that can be tried, and their names where they are not the whole catalogue."""
    if not sources:
        raise HannesError(
            "There is no effect to look for: those that were named are in the model already, or none was named."
        )
    whole = set(catalogue()) <= {*sources, *(effect.name for effect in prepared.model.effects)}
    only = () if whole else tuple(sources)
    usable = usable_effects(prepared, sources)
    prepared = replace(prepared, notes=(*prepared.notes, *usable.notes))
    search = Search(
        prepared.problem,
        prepared.model,
        prepared.nuisances,
        usable.sources,
        executor=executor,
        progress=progress,
    )
    return prepared, search, only


def _concluded(
    answer: _Answer, only: tuple[str, ...], greedy: bool
) -> tuple[Conclusion, dict[str, tuple[float, float]]]:
    """The verdict of an answer, its set as it is shown, and the 95 % intervals."""
    choice, falls, search = answer.choice, answer.falls, answer.choice.search
    best, limits = choice.best, choice.limits
    if not answer.holds:
        best, falls = worth_showing(search, best, falls)
    verdict = "unknown" if not answer.holds else "effects" if best.names else "nothing"
    tied = tied_sets(choice) if verdict == "effects" else ()
    best = search.with_spread(best)
    intervals = spans_of(search, best, limits, falls)
    told = Conclusion(
        choice,
        best,
        verdict,
        effects=found_effects(search, best, intervals, falls),
        tied=tied,
        falls=falls,
        bent=answer.bent,
        only=only,
        greedy=greedy,
        clock=other_clock(search.problem, best.fit) if greedy or verdict == "unknown" else None,
    )
    return told, intervals


def _needed_although(told: Conclusion) -> tuple[str, ...]:
    """A sentence on an effect that is named though it may be nought by its intervals."""
    if told.verdict != "effects" or not _may_be_nought(told.search, told.best, told.limits, told.falls):
        return ()
    few = len(told.search.problem.features.conditions) <= FEW_CONDITIONS
    return (_needed_sentence(told.best.names[-1], told.falls, few),)


@dataclass(frozen=True)
class _Answer:
    """What a search came to.

    null   the nominal model, fitted; first  what chance reaches there
    bent   why what chance explains is no answer, if it is none
    holds  whether the choice is an answer
    """

    null: Candidate
    first: Chance
    choice: Choice
    falls: tuple[Fall, ...]
    bent: str
    holds: bool


def _answer(prepared: Prepared, search: Search, max_effects: int, greedy: bool) -> _Answer:
    """Choose the effects, hold out closures and conditions, and take back what that does not bear out."""
    null = search.null()
    limits = chance(search.problem, null.fit, search.signatures(null))
    choice = (choose_greedily if greedy else choose)(search, null, limits, max_effects)

    def falls_of(choice: Choice, first: Search) -> tuple[Fall, ...]:
        there = replace(prepared, problem=choice.search.problem)
        return error_falls(there, choice.search, choice.best, first=first, in_order=greedy)

    falls = falls_of(choice, search)
    if greedy:
        choice, falls = _borne_out(choice, null, falls)
    holds, bent = choice.adequate or choice.enough, ""
    if holds and not greedy:
        if (fewer := without_law(choice)) is not choice:
            effect, how = in_the_law(choice.search, choice.best)
            with_it, choice, falls = falls[-1], fewer, falls_of(fewer, search)
            other = _behind_the_law(search, null, limits, max_effects, effect)
            if other is not None:
                behind = falls_of(other, search)
                if _foretells((*falls, with_it, behind[-1])):
                    choice, falls = other, behind
            said = law_sentence(effect, how, with_it.held_out, min(fall.held_out for fall in falls))
            choice = with_unnamed(choice, said)
        choice, falls = without_idle(choice, falls)
        first, instead = _named_instead(choice, search)
        if instead is not choice:
            choice, null, falls = instead, first.null(), falls_of(instead, first)
        bent = bent_sentence(choice, falls)
    return _Answer(null, limits, choice, falls, bent, holds and not bent)


def _behind_the_law(
    search: Search, null: Candidate, limits: Chance, max_effects: int, law: str
) -> Choice | None:
    """What is chosen without an effect that is no more than another machine's law, if a single one gains enough.

    The law is in every recording, may gain more than what is hidden beside it, and takes its place.
    """
    bare = Choice(search, null, limits, is_adequate(search, null, limits), ())
    singles = [c for key, c in search.found.items() if len(key) == 1 and law not in key]
    if not any(
        null.penalised + PENALTY - c.penalised >= needed_gain(bare, null, c, first=True) for c in singles
    ):
        return None
    other = choose(search, null, limits, max_effects, (law,))
    return other if other.adequate and other.best.names else None


def _borne_out(choice: Choice, null: Candidate, falls: tuple[Fall, ...]) -> tuple[Choice, tuple[Fall, ...]]:
    """A greedy choice without the effects at its end that are none, and then judged again.

    What joined as one of a pair must take its part by itself once the other has gone.  The error falls from that of the
    nominal model as it was given, where its fit foretells worse.
    """
    search, limits, notes = choice.search, choice.limits, choice.notes
    best = search.with_spread(choice.best)
    alone, taken_back = False, tuple[str, ...]()
    while best.names and (why := _idle_at_the_end(search, best, limits, falls, alone)):
        notes += (f"{best.names[-1]} joined too, but {why}: it is left out",)
        taken_back += best.names[-1:]
        falls, alone = falls[:-1], True
        best = search.with_spread(search.fit_of(best.names[:-1]))
    deciding = deciding_errors(falls)
    first = before(deciding)
    if not alone and (first == NOMINAL_FITTED or not best.names):
        return choice, falls
    if alone:
        choice = replace(choice, best=best, rivals=(), notes=notes, taken_back=taken_back)
    return judged_by_conditions(choice, null, deciding[first], deciding[-1]), falls


def _idle_at_the_end(
    search: Search, found: Candidate, limits: Chance, falls: Sequence[Fall], alone: bool
) -> str:
    """Why the last effect that was added greedily is none; empty if it is one.

    alone   what joined after it, maybe as one of a pair, has gone
    """
    needed = search.problem.features.repeated and _is_needed(falls)
    if not needed and _may_be_nought(search, found, limits, falls):
        return f"by its 95 % intervals its strength may be nought{phase_moves(search, found, falls[-1])}"
    before, after = falls[-2].held_out, falls[-1].held_out
    features = search.problem.features
    more = sum(features.closures_of.values()) - len(features.conditions)
    # An error over so many closures beyond the first of each condition is known to about this part of it.
    if after > before * (1.0 + (0.5 / more if more > 1 else 0.0)):
        return f"the error on held-out closures rises with it from {before:.3g} to {after:.3g} times the repeatability"
    if len(found.names) > 1 and (why := led_off(search.fit_of(found.names[:-1]), found, found.names[-1:])):
        return why
    before, after = deciding_errors(falls)[-2:]
    unit = " times the repeatability" if search.problem.features.repeated else OF_NOMINAL
    if after > (1.0 + RISES) * before:
        return f"the error on held-out conditions rises with it from {before:.3g} to {after:.3g}{unit}"
    if alone and after**2 > (1.0 - EACH_TAKES) * before**2:
        return (
            f"the error on held-out conditions changes with it from {before:.3g} to {after:.3g}{unit} only; its mean "
            f"square must fall by {100 * EACH_TAKES:.0f} %"
        )
    return ""


def _is_needed(falls: Sequence[Fall]) -> bool:
    """Whether without the last effect all that was left out is foretold so much worse that intervals do not matter.

    They are wide where a condition is left out of two or three, since one alone does not tell a friction from a torque
    constant, whatever there is.
    """
    measures = (left_out_errors(falls), [f.held_out_conditions for f in falls])
    return all(e[-2] >= NEEDED * max(e[-1], 1.0) for e in measures)


def _needed_sentence(name: str, falls: Sequence[Fall], few: bool) -> str:
    """Why an effect is named of which the intervals hold nought."""
    left_out, conditions = left_out_errors(falls)[-2:], [f.held_out_conditions for f in falls[-2:]]
    hardly = ", since few conditions hardly tell it" if few else ""
    more = ": record more conditions" if few else ""
    return (
        f"{name}: its 95 % intervals hold nought{hardly}; it is named because without it the error is "
        f"{left_out[0]:.3g} instead of {left_out[1]:.3g} on closures and {conditions[0]:.3g} instead of "
        f"{conditions[1]:.3g} on conditions that were left out{more}"
    )


def _may_be_nought(search: Search, found: Candidate, limits: Chance, falls: Sequence[Fall]) -> bool:
    """Whether all strengths of the last effect may be nought together, by 95 %."""
    strengths = search.strengths(found.names[-1])
    return may_vanish(found.fit, limits, _widened(search, found, limits, falls), strengths)


def _named_instead(choice: Choice, search: Search) -> tuple[Search, Choice]:
    """Name the effect that is the same thing as a parameter of the recordings which is far off in all that have it.

    Where little is known of a recording, a parameter of its own takes the effect over (the damping of an object that
    nobody described), and its prior charges less than an effect must gain.  So the parameter is put back to its nominal
    value, the effect in its place, and that is the answer where it explains all for less.  An effect adds to the
    nominal value: only what is far above it counts.  With the choice comes the search in which the nominal is fitted.
    """
    best = choice.best
    found: dict[str, list[tuple[float, float]]] = {}
    for c, z in zip(best.fit.coordinates, best.fit.z, strict=True):
        effect = next((n.effect for n in search.nuisances if n.name == c.name), "")
        if effect in search.sources and effect not in best.names:
            found.setdefault(effect, []).append((float(z), c.value(float(z)) - c.value(0.0)))
    same = {effect: values for effect, values in found.items() if min(z for z, _ in values) > FAR}
    if not (same and choice.adequate):
        return search, choice
    other = search.with_nuisances([n for n in search.nuisances if n.effect not in same])
    names = (*best.names, *same)
    if is_adequate(other, other.from_point(best.names, best.fit.point), choice.limits):
        return search, choice
    _, coordinates = other.with_effects(names)
    start = dict(best.fit.point)
    for effect, values in same.items():
        first = next(p.name for p in search.effect(effect).parameters if p.vanishing is not None)
        own = next(c for c in coordinates if c.name == f"{effect}.{first}")
        start[own.name] = own.z(own.offset + float(np.mean([value for _, value in values])))
    instead = other.from_point(names, {c.name: start.get(c.name, 0.0) for c in coordinates})
    if instead.penalised > best.penalised:
        return search, choice
    other.null()  # from there the new search's nominal is fitted
    new, again = other.fitted_afresh(instead)
    limits = chance(new.problem, again.fit, new.signatures(again))
    if not is_adequate(new, again, limits):
        return search, choice
    held = ", ".join(n.name for n in search.nuisances if n.effect in same)
    note = (
        f"{held} would do the same, far outside what is usual (misfit, with what priors and parameters charge, "
        f"{best.penalised:.0f} instead of {instead.penalised:.0f}): held at the nominal value here"
    )
    made = replace(
        choice, search=new, best=again, limits=limits, rivals=(), notes=(*choice.notes, note), idle=""
    )
    return other, made


def without_law(choice: Choice) -> Choice:
    """Without an effect that is no more than how another machine's law sets in, where the others explain all too."""
    effect, _ = in_the_law(choice.search, choice.best)
    if not effect:
        return choice
    rest = tuple(name for name in choice.best.names if name != effect)
    (part,) = choice.search.without(choice.best, [rest])
    return cut_to(choice, part) if is_adequate(choice.search, part, choice.limits) else choice


def without_idle(choice: Choice, falls: tuple[Fall, ...]) -> tuple[Choice, tuple[Fall, ...]]:
    """Without the effects that foretell no better what took no part in the fit, where those before them explain all.

    Only where the recordings are of another machine than the simulator's: there a better fit alone is no reason for an
    effect, since the form of the model is wrong anyway.  What leads a parameter back into its tolerance stays: the one
    does what the other did, and foretells the same.
    """
    keep = len(falls) - WITHOUT_EFFECT
    while keep and not _foretells(falls[: keep + WITHOUT_EFFECT]):
        keep -= 1
    if keep == len(choice.best.names) or not choice.search.problem.of_others:
        return choice, falls
    part = choice.search.fit_of([fall.added for fall in falls[WITHOUT_EFFECT : keep + WITHOUT_EFFECT]])
    if not is_adequate(choice.search, part, choice.limits):
        return choice, falls
    if leads_back(part, choice.best):
        return replace(choice, notes=(*choice.notes, led_back_sentence(choice.best, part))), falls
    fewer = falls[: keep + WITHOUT_EFFECT]
    idle = idle_sentence(choice.best, part, falls[-1], fewer[-1])
    return with_unnamed(cut_to(choice, part), idle), fewer


def _foretells(falls: Sequence[Fall]) -> bool:
    """Whether the last of the sets has clearly less error than each before on closures or conditions left out.

    On either: what a condition has of its own, like an object, cannot be foretold from the others.  The nominal model
    as it was given is one of those before: its fit weighs what a model of its form may be off, and may raise the error.
    """
    measures = (left_out_errors(falls), [f.held_out_conditions for f in falls])
    known = [errors for errors in measures if np.isfinite(errors[1:]).all()]
    return not known or any(clearly_less(e[-1], float(np.nanmin(e[:-1]))) for e in known)


def spans_of(
    search: Search, best: Candidate, limits: Chance, falls: Sequence[Fall]
) -> dict[str, tuple[float, float]]:
    """95 % intervals of a fitted set, see _widened."""
    return intervals_of(best.fit, limits, _widened(search, best, limits, falls))


def _widened(search: Search, best: Candidate, limits: Chance, falls: Sequence[Fall]) -> dict[str, float]:
    """By how much intervals are wider: by the closures' scatter; on a machine of others by its conditions, too."""
    problem = search.problem
    reasons = [sway(problem, best.fit, limits)]
    if problem.of_others:
        reasons.append(strain(problem.features, best.fit, limits, falls[-1].left_out))
    return wider(*reasons)


def fitted_model(
    prepared: Prepared,
    search: Search,
    best: Candidate,
    intervals: Mapping[str, tuple[float, float]],
    falls: Sequence[Fall],
) -> Model:
    """The model with fitted nuisance parameters and effects, as it goes into a file, with what it was made from."""
    model = prepared.model
    values, names = best.fit.values, model.names
    known = {n: v for n, v in values.items() if "@" not in n and n in names}
    out = model.with_values(known, status="identified", source=FITTED)
    for name in best.names:
        out = out.with_effect(_entry(search, name, values))
    spans = {
        n: [float(f"{end:.5g}") for end in intervals[n]] for n in values if n.split(".")[0] in best.names
    }
    provenance = {**model.provenance, "intervals_95": spans} if spans else model.provenance
    out = replace(out, plant=model.plant, provenance=provenance)
    others = {n: float(f"{v:.6g}") for n, v in values.items() if n not in out.names}
    return made_from(out, model, prepared.features, falls=falls_made(falls), recordings=others)


def _entry(search: Search, name: str, values: Mapping[str, float]) -> EffectEntry:
    kind = search.effect(name)
    own = {p.name: values[f"{name}.{p.name}"] for p in kind.parameters}
    source = effect_source(search.sources[name])
    return kind.entry(own, source=source, status="identified", where=FITTED)


def found_effects(
    search: Search, best: Candidate, intervals: Mapping[str, tuple[float, float]], falls: Sequence[Fall]
) -> tuple[FoundEffect, ...]:
    """The effects of a fitted set with parameters, intervals and the reason."""
    at_end = {c.name for c in best.fit.at_end}
    return tuple(_found(search, best.fit, name, intervals, at_end, falls) for name in best.names)


SEEN = 0.95
"""Part of an error, root mean square, that an effect must leave at most for a sentence to say what it explains."""


def _found(
    search: Search,
    best: Fit,
    name: str,
    intervals: Mapping[str, tuple[float, float]],
    at_end: Set[str],
    falls: Sequence[Fall],
) -> FoundEffect:
    kind = search.effect(name)
    parameters = {}
    for p in kind.parameters:
        value = best.values[f"{name}.{p.name}"]
        low, high = intervals[f"{name}.{p.name}"]
        ends = f"{name}.{p.name}" in at_end
        told = high - low < 0.8 * (p.upper - p.lower)
        parameters[p.name] = ParameterEstimate(value, low, high, p.unit, told and not ends, ends)
    step = next((k for k, f in enumerate(falls) if f.added == name), len(falls) - 1)
    pairs = zip(falls[step - 1].signals, falls[step].signals, strict=True)
    b, s = min(pairs, key=lambda pair: _change(*pair))
    missed = (
        f"Without it the model misses {s.signal} in '{s.condition}' by {_missed(b)}, with it by {_missed(s)}."
        if s.rmse < SEEN * b.rmse
        else "No signal of any condition is missed by much less with it than without."
    )
    why = f"{missed} What it looks like: {kind.looks_like}." if kind.looks_like else missed
    return FoundEffect(name, kind.title, effect_source(search.sources[name]), parameters, why)


def _change(before: SignalError, after: SignalError) -> tuple[float, float]:
    """By how much an error changed, in multiples of the repeatability and, where that is not known, as a part."""
    change = after.ratio - before.ratio
    return (change if math.isfinite(change) else 0.0, after.rmse / max(before.rmse, 1e-300))


def _missed(error: SignalError) -> str:
    """An error in its unit and, where there are repeats, in multiples of the repeatability."""
    ratio = f" ({error.ratio:.2f} times the repeatability)" if math.isfinite(error.ratio) else ""
    return f"{error.rmse:.3g} {error.unit}{ratio}"

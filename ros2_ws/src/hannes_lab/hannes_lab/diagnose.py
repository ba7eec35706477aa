"""Which physical effect does the model lack?  Nothing, named effects, or something unknown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_sim.effect import catalogue, effect_source, load_effect
from numpy.typing import NDArray

from .chance import Chance, chance
from .depends import Dependence, residual_dependences
from .errors import (
    SignalError,
    condition_error,
    held_out_closures,
    held_out_condition_errors,
    overall,
    per_signal,
    signal_errors,
)
from .executor import Executor
from .experiments import VISIBLE, Experiment, separating_experiments
from .features import Features, data_used
from .fit import Fit
from .greedy import grow
from .prepare import Prepared
from .problem import Coordinate, Problem, build_problem
from .rig import Rig
from .screen import usable_effects
from .search import HOPELESS, PENALTY, Candidate, Progress, Search, silent
from .settle import slopes_at
from .surrogate import exact_rig

Array = NDArray[np.float64]

ADEQUATE = 1.25
"""A set of effects is adequate if its cost is at most this multiple of what chance reaches: room for the linear
approximation behind the critical value.  Where the model has an error of its own, whose width has room enough, 1."""

WORTHWHILE = 0.05
"""A further effect must remove at least this part of the cost, or of the mean square error on held-out conditions."""

OWN_ERROR_PART = 0.12
"""The same where the model has an error of its own, also within chance: its width is assumed, and it is not noise.
There a second effect must remove FURTHER times as much."""

OWN_ERROR_MOST = 2.4
"""Standard deviations of the model's own error that the error of one signal of one condition may reach as a root mean
square.  A large error in few is lost in the sum over all: then what is left is not the model's form, but something
that is missing."""

TIE = 6.0
"""Sets whose penalised costs differ by less cannot be told apart: a likelihood ratio of e^3 = 20.  The best is the
wrong one beyond it in 0.7 % at worst, of sets that are as far apart as that (normal tail at the root of 6)."""

OWN_ERROR_TIE = 12.0
"""The same where the model has an error of its own."""

RIVAL = 2.0
"""Sets whose cost is at most so many times that of the best are judged beside it with the noise found at it."""

FURTHER = 1.5
"""Where all is explained within chance, a further effect must gain so many times what chance gains."""

FAR = 3.0
IMPLAUSIBLE = 8.0
"""Standard deviations of its prior at which a nominal parameter is called far off, and beyond which no set of effects
that needs it there is adequate: an effect may fit well whose only merit is that it replaces what the model had."""

FITTED = "fitted by hannes"
"""Source of the nominal parameters in a model that was fitted, with effects or without."""

HALF = 0.5
"""Effects that were added one after another are the answer where the error on held-out conditions, above the
repeatability, falls to this part; where more is left, what is missing is something else."""

NO_REPEATS = "There is one closure of each condition only: nothing could be held out, and the repeatability is a guess."

ANY_DIFFERENCE = (
    "a difference of any size counts here that chance does not explain; no simple model of a real machine is that "
    "exact: --greedy adds effects for as long as the error on conditions that were left out of the fit falls"
)

MANY_FAILURES = 0.05
"""Part of the simulations that did not stay finite from which on their parameters are worth a look."""

MAX_EFFECTS = 3

WIDE = (4, 3)
"""How many of the best singles and pairs are extended by every further effect."""

LEFT_MOST = 0.5
FAR_OFF = 3.0
"""Where the best pair leaves more than this part of what the best single effect left above chance, and still so many
times what chance reaches, triples are not tried: of three effects of the catalogue the second one found explains more
than the third will."""


@dataclass(frozen=True)
class ParameterEstimate:
    """Value and 95 % interval.

    Identified is False where the value lies on its bound or the interval spans the range.
    """

    value: float
    low: float
    high: float
    unit: str
    identified: bool

    def to_dict(self) -> dict[str, Any]:
        return self.__dict__.copy()


@dataclass(frozen=True)
class FoundEffect:
    """An effect of the verdict, with its parameters."""

    name: str
    title: str
    source: str | None
    parameters: Mapping[str, ParameterEstimate]
    why: str

    def to_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "title": self.title,
            "source": self.source,
            "why": self.why,
            "parameters": {n: p.to_dict() for n, p in self.parameters.items()},
        }


@dataclass(frozen=True)
class Fall:
    """One step of the error's fall, in multiples of the repeatability.

    train, held_out   fitted on every second closure, judged on the others
    by_condition      error on each condition when it took no part in the fit
    held_out_conditions  one number for them all (errors.condition_error); with `--greedy` it decides
    held_out_signals  the same per signal, root mean square over the conditions in the signal's unit
    """

    added: str
    train: float
    held_out: float
    by_condition: Mapping[str, float]
    signals: tuple[SignalError, ...]
    held_out_signals: Mapping[str, float] = field(default_factory=dict)
    held_out_conditions: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        return {
            "added": self.added,
            "train": self.train,
            "held_out": self.held_out,
            "by_condition": dict(self.by_condition),
            "signals": [s.to_dict() for s in self.signals],
            "held_out_signals": dict(self.held_out_signals),
            "held_out_conditions": self.held_out_conditions,
        }


@dataclass(frozen=True)
class Rank:
    """One row of the ranking: the cost of the model with this effect (set) added, after a full refit."""

    names: tuple[str, ...]
    cost: float
    explained: float

    def to_dict(self) -> dict[str, Any]:
        return {"names": list(self.names), "cost": self.cost, "explained": self.explained}


@dataclass(frozen=True)
class Diagnosis:
    """The answer; `to_dict` is what --json, the report and the page show."""

    verdict: str
    summary: str
    effects: tuple[FoundEffect, ...]
    tied: tuple[tuple[str, ...], ...]
    experiments: tuple[Experiment, ...]
    falls: tuple[Fall, ...]
    ranking: tuple[Rank, ...]
    depends_on: tuple[Dependence, ...]
    chance: Chance
    costs: Mapping[str, float]
    nuisances: Mapping[str, Mapping[str, Any]]
    notes: tuple[str, ...]
    simulations: int
    data: tuple[Mapping[str, Any], ...]
    model: Model
    values: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        falls = self.falls
        return {
            "verdict": self.verdict,
            "summary": self.summary,
            "effects": [e.to_dict() for e in self.effects],
            "tied": [list(names) for names in self.tied],
            "experiments": [e.to_dict() for e in self.experiments],
            "error": {
                "nominal": falls[0].held_out,
                "final": falls[-1].held_out,
                "repeatability": 1.0,
                "held_out": True,
                "unit": "multiples of the repeatability between closures",
            },
            "falls": [f.to_dict() for f in falls],
            "ranking": [r.to_dict() for r in self.ranking],
            "depends_on": {d.variable: d.to_dict() for d in self.depends_on},
            "chance": self.chance.__dict__.copy(),
            "costs": dict(self.costs),
            "nuisances": {n: dict(v) for n, v in self.nuisances.items()},
            "notes": list(self.notes),
            "simulations": self.simulations,
            "data": [dict(d) for d in self.data],
            "model": {"name": self.model.name, "sha256": self.model.sha256},
        }


def effect_sources(
    extra: Sequence[str] = (), *, only: Sequence[str] | None = None, model: Model | None = None
) -> dict[str, str]:
    """Effects to consider by name: the catalogue (or `only`) and the user's own, without those the model has.

    Two different effects of one name are a HannesError: results could not say which one they mean.
    """
    names = list(only) if only is not None else list(catalogue())
    out: dict[str, str] = {}
    for given in (*names, *extra):
        kind = load_effect(given)
        name = kind.name
        if load_effect(out.setdefault(name, given)) is not kind:
            first = out[name] if ":" in out[name] else f"the catalogue's {name}"
            raise HannesError(
                f"Two effects are named '{name}': {first} and {given}. Give yours a name of its own, or leave the "
                "other one out (--only names the effects that take part)."
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
    max_effects: int = MAX_EFFECTS,
    greedy: bool = False,
) -> Diagnosis:
    """Search the catalogue; see the module docstrings of search, chance and problem for the method.

    executor  where the work is done, and where its results are kept; `jobs` processes if None
    greedy   add effects one after another as long as the error on held-out conditions falls (greedy.py), instead of
             looking for the smallest set that explains all
    """
    if not sources:
        raise HannesError(
            "There is no effect to look for: those that were named are in the model already, or none was named."
        )
    usable = usable_effects(prepared, sources)
    sources = usable.sources
    prepared = replace(prepared, notes=(*prepared.notes, *usable.notes))
    search = Search(
        prepared.problem,
        prepared.model,
        prepared.nuisances,
        sources,
        executor=executor or Executor(jobs),
        progress=progress,
    )
    null = search.null()
    limits = chance(search.problem, null.fit, search.signatures(null))
    choose = _grow if greedy else _choose
    choice = choose(search, null, limits, max_effects)
    search, best, limits, adequate, ranking = (
        choice.search,
        choice.best,
        choice.limits,
        choice.adequate,
        choice.ranking,
    )
    prepared = replace(prepared, problem=search.problem)
    nothing = not best.names and adequate
    verdict = "nothing" if nothing else "effects" if adequate or choice.enough else "unknown"
    tied = _ties(choice) if verdict == "effects" else ()
    falls = error_falls(prepared, search, best, in_order=greedy)
    if verdict == "unknown":
        best, falls = _worth_showing(search, best, falls)
    best = search.with_spread(best)
    effects = found_effects(search, best, limits, falls)
    experiments = (
        separating_experiments(prepared, search, [search.found[tuple(sorted(n))] for n in tied])
        if len(tied) > 1
        else ()
    )
    return Diagnosis(
        verdict=verdict,
        summary=_summary(search, verdict, effects, tied, falls, limits, best, _nearest(choice)),
        effects=effects,
        tied=tied,
        experiments=experiments,
        falls=falls,
        ranking=ranking,
        depends_on=residual_dependences(
            prepared.features, prepared.features.closures(prepared.rig, best.fit.model, best.fit.values)
        ),
        chance=limits,
        costs={"nominal_fitted": null.fit.cost, "final": best.fit.cost, "critical": limits.misfit},
        nuisances=_nuisance_table(best.fit, limits),
        notes=(
            *prepared.notes,
            *choice.notes,
            *_any_difference(search, verdict, greedy),
            *_inseparable(search, experiments),
            *_end_notes(best),
            *_undescribed(best),
            *_identifiability_notes(best),
            *_failed(search.problem),
        ),
        simulations=prepared.problem.simulations,
        data=data_used(prepared.features),
        model=fitted_model(prepared.model, search, best, limits),
        values=best.fit.values,
    )


@dataclass(frozen=True)
class _Choice:
    """The set that was chosen, the search (with its noise) in which it was judged, and its rivals of the same size.

    enough   it removes most of the error on held-out conditions, though chance does not explain the rest
    """

    search: Search
    best: Candidate
    limits: Chance
    adequate: bool
    ranking: tuple[Rank, ...]
    rivals: tuple[Candidate, ...] = ()
    notes: tuple[str, ...] = ()
    enough: bool = False


def _grow(search: Search, null: Candidate, limits: Chance, max_effects: int) -> _Choice:
    """Effects one after another while the mean square error on held-out conditions falls by at least WORTHWHILE."""
    if len(search.problem.features.conditions) < 2:
        raise HannesError(
            "--greedy judges by conditions that took no part in the fit, and there is one condition only: record "
            "another speed or load, or leave --greedy out."
        )
    grown = grow(search, null, max_effects, WORTHWHILE)
    adequate = _adequate(search, grown.best, limits)
    ranking = tuple(Rank(c.names, c.penalised, _share(null, c, limits.median)) for c in grown.first)
    notes = list(grown.notes)
    first, last = grown.errors[0], grown.errors[-1]
    enough = bool(grown.best.names) and last - 1.0 <= HALF * (first - 1.0)
    if enough and not adequate:
        notes.append(
            f"the {_short_of(search, grown.best, limits)}: something smaller is left that the "
            "catalogue does not explain"
        )
    elif grown.best.names and not adequate:
        notes.append(
            f"what was added lowers the error on held-out conditions from {first:.3g} to {last:.3g} times the "
            "repeatability; less than half would be an answer"
        )
    return _Choice(search, grown.best, limits, adequate, ranking, grown.rivals, tuple(notes), enough)


def _choose(search: Search, null: Candidate, limits: Chance, max_effects: int) -> _Choice:
    """Smallest adequate set of effects.

    Sets of one, two and three effects in turn; each round extends the best of the round before by every effect, so that
    two effects of which neither is best alone are found too.  After each round noise, scatter and critical values are
    estimated afresh at the best point: those of a wrong model are wrong.  Where the misfit is within chance already,
    only sets that are as good as the best within chance are extended.
    """
    choice = _Choice(search, null, limits, _adequate(search, null, limits), ())
    front, far = [null], list[Candidate]()
    texts = ("one effect", "two effects", "three effects")
    for size in range(1, max_effects + 1):
        enough = _adequate(choice.search, choice.best, choice.limits, room=1.0)
        if enough and size > 1:
            room = choice.limits.misfit - choice.limits.median
            front = [c for c in front if c.penalised <= front[0].penalised + room]
        elif size > 1:
            front += choice.search.refitted(far)
        needed = _needed(choice, choice.best, first=size == 1)
        worth = choice.best.penalised - 0.5 * needed
        round_ = _extended(choice.search, front, texts[size - 1], worth)
        if not round_:
            break
        if size == 1 and _hard(choice, round_[0]):
            again = search.thoroughly().extend(front, list(search.sources), "one effect, thoroughly", worth)
            round_ = _best_of(round_, again)
        if enough and round_[0].penalised < worth and set(choice.best.names) < set(round_[0].names):
            # The set without it may find its way further down from there; what is left is the gain.
            choice = replace(choice, best=choice.search.without(round_[0], choice.best.names))
        # What chance gains was found for effects of one free strength; further parameters pay their penalty.
        gain = choice.best.penalised + PENALTY - round_[0].penalised
        # Within chance there is nothing to explain, unless an effect gains more than chance does.
        whole = min(round_[0].fit.cost, limits.median) if gain >= needed else limits.median
        ranking = choice.ranking or tuple(Rank(c.names, c.penalised, _share(null, c, whole)) for c in round_)
        if gain < needed:
            choice = replace(choice, ranking=ranking)
            break
        new = choice.search.renewed(round_[0])
        wide = [
            c
            for c in round_[: WIDE[min(size - 1, len(WIDE) - 1)]]
            if c.penalised <= HOPELESS * round_[0].penalised
        ]
        rivals = [c for c in wide if c.penalised <= RIVAL * round_[0].penalised]
        near = sorted(new.refitted(rivals), key=lambda c: c.penalised)
        # On a slow plant the refit was one with all derivatives afresh.
        best = near[0] if new.slow else new.polish(near[0])
        limits_new = chance(new.problem, best.fit, new.signatures(best))
        close = tuple(c for c in near[1:] if c.penalised <= best.penalised + _tie(new))
        adequate = _adequate(new, best, limits_new)
        left = 1.0 - _share(choice.best, round_[0], choice.limits.median)
        choice = _Choice(new, best, limits_new, adequate, ranking, close)
        if 1 < size < max_effects and left > LEFT_MOST and best.fit.cost > FAR_OFF * limits_new.misfit:
            choice = replace(choice, notes=(_ended_early(size, left, best, limits_new),))
            break
        front, far = [best, *near[1:]], [c for c in wide if c not in rivals]
    return _pruned(choice)


def _hard(choice: _Choice, first: Candidate) -> bool:
    """Whether effects must be tried thoroughly: the model as it is went far off, and no effect explains enough.

    Where the model has an error of its own, much is explained by what is wrong: then always, unless nothing is missing.
    """
    if choice.search.slow or not choice.best.pulled or choice.adequate:
        return False
    return bool(choice.search.problem.discrepancy) or not _adequate(choice.search, first, choice.limits)


def _ended_early(size: int, left: float, best: Candidate, limits: Chance) -> str:
    return (
        f"the best {size} effects leave {100 * left:.0f} % of the misfit that {size - 1} left, and "
        f"{best.fit.cost / limits.misfit:.0f} times what chance reaches: sets of more effects were not tried"
    )


def _adequate(search: Search, candidate: Candidate, limits: Chance, room: float = ADEQUATE) -> bool:
    """Whether chance, with the model's own error if it has one, explains what a set leaves."""
    if _apart(search, candidate) or _implausible(candidate):
        return False
    if search.problem.discrepancy:
        return candidate.fit.cost <= limits.misfit and _worst(search, candidate)[1] <= OWN_ERROR_MOST
    return candidate.fit.cost <= limits.misfit * room


def _worst(search: Search, candidate: Candidate) -> tuple[str, float]:
    """Where the error is largest in standard deviations of the model's own error; 0 if it has none."""
    errors = search.problem.own_errors(candidate.fit.residual)
    block, error = max(errors, key=lambda item: item[1], default=(None, 0.0))
    return (f"{block.signal} of '{block.condition}'" if block else "", error)


def _apart(search: Search, candidate: Candidate) -> str:
    """The parameter of single recordings that differs more between them than it may, in words; empty if none does."""
    families: dict[str, list[tuple[float, float]]] = {}
    for nuisance in search.nuisances:
        family, of_one, _ = nuisance.name.partition("@")
        z = candidate.fit.z_of(nuisance.name)
        if of_one and z is not None:
            families.setdefault(family, []).append((z, nuisance.apart))
    for family, own in families.items():
        mean = sum(z for z, _ in own) / len(own)
        farthest = max(abs(z - mean) for z, _ in own)
        if any(abs(z - mean) > most for z, most in own):
            return f"{family} differs between recordings of one machine by {farthest:.0f} times its tolerance"
    return ""


def _implausible(candidate: Candidate) -> str:
    """The well-known parameter that is farther off than IMPLAUSIBLE, in words; empty if none is."""
    far = [
        (abs(float(z)), c)
        for c, z in zip(candidate.fit.coordinates, candidate.fit.z, strict=True)
        if c.prior and not c.wide and c.name in candidate.fit.model.parameters
    ]
    off, c = max(far, key=lambda item: item[0], default=(0.0, None))
    if c is None or off <= IMPLAUSIBLE:
        return ""
    return (
        f"{c.name} would be {candidate.fit.values[c.name]:.3g} {c.unit} instead of {c.value(0.0):.3g}, {off:.0f} times "
        "its tolerance off: if the nominal model is not that of this machine, calibrate it first"
    )


def _tie(search: Search) -> float:
    return OWN_ERROR_TIE if search.problem.discrepancy else TIE


def _needed(choice: _Choice, base: Candidate, *, first: bool = False) -> float:
    """By how much a further effect must lower the penalised cost of a base; `first`: it is the first of the search."""
    limits = choice.limits
    enough = _adequate(choice.search, base, limits, room=1.0)
    part = OWN_ERROR_PART if choice.search.problem.discrepancy else 0.0 if enough else WORTHWHILE
    return max(limits.gain, part * base.fit.cost) * (FURTHER if enough and not first else 1.0)


def _pruned(choice: _Choice) -> _Choice:
    """Without what a later effect made superfluous: sets grow one by one, and an early one may be a stopgap."""
    while choice.adequate and len(choice.best.names) > 1:
        best = choice.best
        parts = [
            choice.search.without(best, tuple(n for n in best.names if n != name)) for name in best.names
        ]
        part = min(parts, key=lambda c: c.penalised)
        gain = part.penalised + PENALTY - best.penalised
        if gain >= _needed(choice, part) or not _adequate(choice.search, part, choice.limits):
            break
        alike = [
            c
            for names, c in choice.search.found.items()
            if len(names) == len(part.names)
            and set(names) != set(part.names)
            and c.penalised <= part.penalised + _tie(choice.search)
            and _adequate(choice.search, c, choice.limits)
        ]
        choice = replace(choice, best=part, rivals=tuple(alike))
    return choice


def _extended(search: Search, front: Sequence[Candidate], text: str, worth: float) -> list[Candidate]:
    """The front with one further effect each, best first.

    Where the best set holds a smaller one that was not extended, that is extended too: the other effect of a pair may
    be the right one though it was not among the best alone.
    """
    names = list(search.sources)
    round_ = search.extend(front, names, text, worth)
    extended = {frozenset(c.names) for c in front}
    while round_ and round_[0].penalised < worth and len(round_[0].names) > 1:
        parts = [frozenset(n for n in round_[0].names if n != one) for one in round_[0].names]
        left = [p for p in parts if p not in extended]
        if not left:
            break
        bases = [search.fitted(tuple(sorted(p))) for p in left]
        extended |= set(left)
        better = search.extend(bases, names, f"{text}, exchanged", round_[0].penalised)
        round_ = _best_of(round_, better)
    return round_


def _best_of(some: Sequence[Candidate], others: Sequence[Candidate]) -> list[Candidate]:
    """Each set once, as it was fitted best; best first."""
    sets = {frozenset(c.names): c for c in sorted((*some, *others), key=lambda c: -c.penalised)}
    return sorted(sets.values(), key=lambda c: c.penalised)


def _worth_showing(
    search: Search, best: Candidate, falls: tuple[Fall, ...]
) -> tuple[Candidate, tuple[Fall, ...]]:
    """Where something unknown is left, only those effects that lower the error on held-out closures are shown."""
    errors = [fall.held_out for fall in falls[1:]]
    if not np.isfinite(errors).any():
        return best, falls
    keep = 1 + int(np.nanargmin(errors))
    names = tuple(fall.added for fall in falls[2 : keep + 1])
    if len(names) == len(best.names):
        return best, falls
    return search.found[tuple(sorted(names))], falls[: keep + 1]


def _share(base: Candidate, candidate: Candidate, least: float) -> float:
    """Part of the base's misfit above a complete model's that the candidate removes, 0..1."""
    excess = base.fit.cost - least
    return float(np.clip((base.fit.cost - candidate.fit.cost) / excess, 0.0, 1.0)) if excess > 0 else 0.0


def _ties(choice: _Choice) -> tuple[tuple[str, ...], ...]:
    """Sets of the same size that fit as well as the best, within what chance can gain; the best comes first."""
    return (choice.best.names, *(c.names for c in sorted(choice.rivals, key=lambda c: c.penalised)))


def fitted_model(model: Model, search: Search, best: Candidate, limits: Chance) -> Model:
    """The model with fitted nuisance parameters and effects, as it goes into a file."""
    values = best.fit.values
    known = {n: v for n, v in values.items() if "@" not in n and n in model.parameters}
    out = model.with_values(known, status="identified", source=FITTED)
    intervals = intervals_of(best.fit, limits)
    for name in best.names:
        out = out.with_effect(_entry(search, name, values, intervals))
    return replace(out, plant=model.plant)


def _entry(
    search: Search, name: str, values: Mapping[str, float], intervals: Mapping[str, tuple[float, float]]
) -> EffectEntry:
    kind = search.effect(name)
    own = {p.name: values[f"{name}.{p.name}"] for p in kind.parameters}
    spans = {p.name: intervals[f"{name}.{p.name}"] for p in kind.parameters}
    return kind.entry(
        own,
        source=effect_source(kind, search.sources[name]),
        status="identified",
        where="fitted by hannes; bounds are the 95 % interval",
        intervals=spans,
    )


def intervals_of(found: Fit, limits: Chance) -> dict[str, tuple[float, float]]:
    """95 % intervals by name, from the curvature of the cost, inside the parameter's bounds.

    Wider by as much as the misfit is larger than chance makes it.
    """
    inflate = max(1.0, found.cost / limits.median)
    out = {}
    for c, z, s in zip(found.coordinates, found.z, found.sd(inflate), strict=True):
        ends = sorted((c.value(float(z - 1.96 * s)), c.value(float(z + 1.96 * s))))
        out[c.name] = (ends[0], ends[1])
    return out


def _found(search: Search, best: Candidate, name: str, limits: Chance, falls: Sequence[Fall]) -> FoundEffect:
    kind = search.effect(name)
    intervals = intervals_of(best.fit, limits)
    at_end = {c.name for c in _at_end(best.fit)}
    parameters = {}
    for p in kind.parameters:
        value = best.fit.values[f"{name}.{p.name}"]
        low, high = intervals[f"{name}.{p.name}"]
        span = p.upper - p.lower
        parameters[p.name] = ParameterEstimate(
            value, low, high, p.unit, f"{name}.{p.name}" not in at_end and high - low < 0.8 * span
        )
    step = next((k for k, f in enumerate(falls) if f.added == name), len(falls) - 1)
    pairs = zip(falls[step - 1].signals, falls[step].signals, strict=True)
    b, s = min(pairs, key=lambda pair: _change(*pair))
    why = (
        f"Without it the model misses {s.signal} in '{s.condition}' by {_missed(b)}, with it by {_missed(s)}. What it "
        f"looks like: {kind.looks_like}."
    )
    return FoundEffect(name, kind.title, effect_source(kind, search.sources[name]), parameters, why)


def _change(before: SignalError, after: SignalError) -> tuple[float, float]:
    """By how much an error changed, in multiples of the repeatability and, where that is not known, as a part."""
    change = after.ratio - before.ratio
    return (change if math.isfinite(change) else 0.0, after.rmse / max(before.rmse, 1e-300))


def _missed(error: SignalError) -> str:
    """An error in its unit and, where there are repeats, in multiples of the repeatability."""
    ratio = f" ({error.ratio:.2f} times the repeatability)" if math.isfinite(error.ratio) else ""
    return f"{error.rmse:.3g} {error.unit}{ratio}"


def found_effects(
    search: Search, best: Candidate, limits: Chance, falls: Sequence[Fall]
) -> tuple[FoundEffect, ...]:
    """The effects of a fitted set with parameters, intervals and the reason."""
    return tuple(_found(search, best, name, limits, falls) for name in best.names)


def _problem_builder(search: Search, rig: Rig, values: Mapping[str, float]) -> Any:
    """A function from Features to a Problem with noise estimated on those features."""

    def build(features: Features) -> Problem:
        nuisances = search.nuisances
        values_there = {n.name: values.get(n.name, n.mean) for n in nuisances}
        return build_problem(rig, features, search.model, nuisances, values_there)

    return build


def error_falls(
    prepared: Prepared, search: Search, best: Candidate, *, in_order: bool = False
) -> tuple[Fall, ...]:
    """Nominal as given, nominal fitted, then the effects one after another in the order that helps most.

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
    steps: list[tuple[str, Candidate]] = [("nominal, fitted", search.null())]
    chain: tuple[str, ...] = ()
    left = list(best.names)
    while left:
        options = [
            search.found.get(tuple(sorted((*chain, name))))
            or search.add(search.found[tuple(sorted(chain))], name)
            for name in (left[:1] if in_order else left)
        ]
        pick = min(range(len(options)), key=lambda k: options[k].penalised)
        chain = (*chain, left[pick])
        steps.append((left.pop(pick), options[pick]))
    held = search.each(_fall_in_worker, [(c, best.fit.values) for _, c in steps], "held-out error")
    for (label, _), found in zip(steps, held, strict=True):
        falls.append(Fall(label, *found))
    return tuple(falls)


def _fall_in_worker(search: Search, candidate: Candidate, values: Mapping[str, float]) -> tuple[Any, ...]:
    """What a Fall holds of one fitted set; the noise is estimated at `values`."""
    f = candidate.fit
    features = search.problem.features
    problem = search.problem.with_rig(slopes_at(search.problem.rig, f))
    build = _problem_builder(search, problem.rig, values)
    train, test = held_out_closures(build, features, f.model, f.coordinates, f.z)
    held = held_out_condition_errors(problem, f.model, f.coordinates, f.z)
    by_condition = {condition: overall(own) for condition, own in held.items()}
    errors = signal_errors(features, features.closures(exact_rig(problem.rig), f.model, f.values))
    of_all = condition_error(features, held.values())
    return train, test, by_condition, errors, per_signal(features, held.values()), of_all


def _nuisance_table(found: Fit, limits: Chance) -> dict[str, dict[str, Any]]:
    intervals = intervals_of(found, limits)
    return {
        c.name: {
            "value": c.value(float(z)),
            "nominal": c.value(0.0),
            "prior_sds": float(z),
            "low": intervals[c.name][0],
            "high": intervals[c.name][1],
            "unit": c.unit,
        }
        for c, z in zip(found.coordinates, found.z, strict=True)
        if c.prior
    }


def _failed(problem: Problem) -> list[str]:
    """How many simulations did not stay finite, and whether that matters; a fit takes them for very bad."""
    if not problem.failures:
        return []
    few = problem.failures < MANY_FAILURES * problem.simulations
    meaning = (
        "harmless: values that the search tried and left"
        if few
        else f"above {100 * MANY_FAILURES:.0f} % the search may have missed the best values: look at the model's "
        "parameters and at effects of your own"
    )
    return [
        f"{problem.failures} of {problem.simulations} simulations did not stay finite and counted as very bad fits "
        f"({meaning})"
    ]


def _any_difference(search: Search, verdict: str, greedy: bool) -> list[str]:
    """What else can be tried where chance does not explain what is left, and the model may be off by nothing."""
    problem = search.problem
    may = verdict == "unknown" and not greedy and not problem.discrepancy
    return [ANY_DIFFERENCE] if may and len(problem.features.conditions) > 1 else []


def _inseparable(search: Search, experiments: Sequence[Experiment]) -> list[str]:
    """What shows each of the tied effects, where no experiment that was considered tells them apart."""
    if not experiments or experiments[0].distance >= VISIBLE:
        return []
    names = dict.fromkeys(name for tied in experiments[0].separates for name in tied)
    shown = "; ".join(f"{name} by: {search.effect(name).told_by or '(not said)'}" for name in names)
    return [
        f"no further recording that was considered tells {', '.join(' + '.join(t) for t in experiments[0].separates)} "
        f"apart (they differ by {experiments[0].distance:.1f} standard deviations of the noise at most); what shows "
        f"each: {shown}"
    ]


def _at_end(found: Fit) -> list[Coordinate]:
    """The effects' parameters that would go beyond their range."""
    return [c for c, z in zip(found.coordinates, found.z, strict=True) if not c.prior and c.at_end(float(z))]


def _end_notes(best: Candidate) -> list[str]:
    return [
        f"{c.name} lies at the end of its range ({c.lower:g} to {c.upper:g} {c.unit}): the true value may lie beyond "
        "it, or it is another effect of a similar form"
        for c in _at_end(best.fit)
    ]


def _undescribed(best: Candidate) -> list[str]:
    """What the recordings do not say of the machine as a whole, as it was fitted."""
    fitted = [
        f"{c.name} {c.value(float(z)):.3g} {c.unit}".rstrip()
        for c, z in zip(best.fit.coordinates, best.fit.z, strict=True)
        if c.wide and "@" not in c.name
    ]
    return [f"the recordings do not tell these, so they were fitted: {', '.join(fitted)}"] if fitted else []


def _identifiability_notes(best: Candidate) -> list[str]:
    """What this data cannot tell: pairs of effect and nuisance parameters that move the data alike."""
    sd = best.fit.sd()
    correlation = best.fit.covariance() / np.outer(sd, sd)
    notes = []
    for i, a in enumerate(best.fit.coordinates):
        for j in range(i):
            b = best.fit.coordinates[j]
            if not (a.prior and b.prior) and abs(correlation[i, j]) > 0.97:
                notes.append(
                    f"{a.name} and {b.name} cannot be told apart well with these data "
                    f"(correlation {correlation[i, j]:+.3f})"
                )
    return notes


def _moved_far(best: Candidate) -> str:
    """A sentence on nominal parameters far from their values: this machine's, or an effect of the same form."""
    far = [
        f"{c.name} {c.value(float(z)):.3g} {c.unit} instead of {c.value(0.0):.3g}"
        for c, z in zip(best.fit.coordinates, best.fit.z, strict=True)
        if c.prior and abs(z) > FAR
    ]
    if not far:
        return ""
    return (
        f" But it takes {', '.join(far)}, far outside the tolerance: is the nominal model that of this machine, or is "
        "there an effect of the same form?"
    )


def _nearest(choice: _Choice) -> str:
    """A sentence on the effect that would gain most where nothing is missing, and on what it would have to gain."""
    if choice.best.names or not choice.ranking:
        return ""
    first = choice.ranking[0]
    gain = choice.best.penalised + PENALTY - first.cost
    asked = _needed(choice, choice.best, first=True)
    return (
        f" The effect that comes nearest is {' + '.join(first.names)}: it lowers the misfit by {max(gain, 0.0):.0f}, "
        f"and {asked:.0f} are asked for."
    )


def fall_sentence(falls: Sequence[Fall]) -> str:
    """How the error on held-out closures falls; says so where there is one closure only."""
    before, after = falls[1].held_out, falls[-1].held_out
    if not np.isfinite([before, after]).all():
        return NO_REPEATS
    return (
        f"The error on held-out closures falls from {before:.2f} (nominal, fitted) to {after:.2f} times the "
        "repeatability."
    )


def _summary(
    search: Search,
    verdict: str,
    effects: Sequence[FoundEffect],
    tied: Sequence[Sequence[str]],
    falls: Sequence[Fall],
    limits: Chance,
    best: Candidate,
    nearest: str,
) -> str:
    fall = fall_sentence(falls)
    far = _moved_far(best)
    if verdict == "nothing":
        return (
            f"Nothing is missing: with its own parameters fitted, the model's misfit {best.fit.cost:.0f} is below what "
            f"chance reaches ({limits.misfit:.0f}), and no effect of the catalogue gains more than chance would. "
            + (
                f"The error on held-out closures is {falls[-1].held_out:.2f} times the repeatability."
                if np.isfinite(falls[-1].held_out)
                else NO_REPEATS
            )
            + (far and far + nearest)
        )
    names = " and ".join(e.title for e in effects)
    if verdict == "effects":
        tie = ""
        if len(tied) > 1:
            others = "; ".join(" + ".join(names_) for names_ in tied[1:])
            tie = f" With these data it ties with: {others}."
        return f"Missing: {names}. {fall}{tie}{far}"
    part = f" The catalogue comes nearest with {names}, which is not enough." if names else ""
    why = _short_of(search, best, limits)
    return f"Something is missing that is not in the catalogue: the best model's {why}.{part} {fall}"


def _short_of(search: Search, best: Candidate, limits: Chance) -> str:
    """In what a set that is not adequate falls short."""
    if best.fit.cost > limits.misfit:
        return f"misfit {best.fit.cost:.0f} stays above what chance reaches ({limits.misfit:.0f})"
    if off := _apart(search, best) or _implausible(best):
        return off
    where, error = _worst(search, best)
    return f"error in {where} is {error:.1f} times as large as a model of this form is allowed to be off"

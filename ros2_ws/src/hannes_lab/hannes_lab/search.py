"""Which effects explain the data: scan, refit in closed loop, and compare with what chance reaches."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType, is_own_effect, load_effect
from numpy.typing import NDArray

from .cache import Codec, NotPlain, Store, code_hash, content_hash
from .errors import SignalError
from .executor import Executor, Held, own
from .fit import Fit, finite_differences, fit, spread
from .problem import (
    Coordinate,
    Counts,
    Problem,
    build_problem,
    effect_coordinates,
    nuisance_coordinate,
    values_at,
    vanishing_entry,
)
from .rig import Nuisance
from .scan import Scan, Scored, farthest, point_key, shapes_of, tried_periods
from .secants import grain_of, over_its_spread
from .settle import MOVES, at_anchor, least_gain, seen_from, settle, slopes_at
from .surrogate import AnchoredRig, anchored_at

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
Names = tuple[str, ...]
_Approached = tuple[Any, str, list[Any], list[Fit]]


def key_of(names: Iterable[str]) -> Names:
    """Names of effects as the key of their set, whatever the order in which they were found."""
    return tuple(sorted(names))


@dataclass(frozen=True)
class Candidate:
    """A set of effects with its fit; penalised = cost + PENALTY per effect parameter."""

    names: Names
    fit: Fit
    penalised: float

    @property
    def key(self) -> Names:
        """The key of its set of effects."""
        return key_of(self.names)

    @property
    def pulled(self) -> bool:
        """True where a nuisance parameter is far from its nominal value."""
        return farthest(self.fit) > PULLED

    @property
    def far_off(self) -> bool:
        """True where a verdict warns that a parameter is far outside its tolerance."""
        return farthest(self.fit) > FAR


REFIT = 8
"""Extensions of a round that are fitted in closed loop to the end."""

BACK = 3
"""Extensions beside those of a base that is far off which are carried on because they leave no parameter far off."""

SHORT = 4
MIDDLE = 5
LONG = 10
WHOLE = 25
"""Length of a fit in closed loop (see fit): where more than REFIT extensions are to be told apart, without known
derivatives and with them, of the others, and of the model as it is."""

ROUGH = 0.01
"""Part of its cost by which an approach must be lowered to go on; the best of them are fitted to the end."""

AFRESH = 2
"""Starts of an effect that a thorough search follows."""

STARTS = 4
APART = 1.5
"""Further starts of the fit of the model as it is, and how far off, in standard deviations of the priors, where these
are wide: the misfit of a closed loop whose gains, wire and object are not known has several minima."""

MINIMA = 2
DISTINCT = 3.0
"""How many of its other minima extensions of the model as it is are tried from too, and from how many standard
deviations on two ends of a fit are not the same: an effect may be in reach from one of them only."""

RIVAL_START = 2.0
"""A second start of a fit is carried on if it costs less than so many times what the first reached; so is, on a slow
plant, another set."""

HOPELESS = 10.0
"""Sets whose cost is so many times that of the best are not followed; on a slow plant, by the scan already."""

REMOVED = 0.3
"""An approach that removes this part of its base's cost is never called hopeless: the way on may be long."""

ALIKE = 0.5
"""Part of the gain of an approach that led to a set which explains all; approaches of less are not carried on."""

FAR = 3.0
"""Standard deviations of its prior at which a parameter of the nominal model is called far off."""

PULLED = 4.0
"""Where a nuisance parameter of a base is so many standard deviations off, all extensions of it are approached: it may
have taken over an effect, which a scan does not see."""

GROWN = 1.5
"""A parameter is led back (`_led_back`) from PULLED on; one that nobody described and that only grows from nothing,
from here on."""

STEPS = (2.0, 0.5)
"""Other lengths of the steps of a refit's derivatives, in multiples of the usual ones."""

POLISH = 3
"""Extensions of a round that are refitted with all derivatives afresh."""

PENALTY = 4.0
"""Cost of one parameter (Akaike's 2 doubled, since shape parameters are searched over several starts)."""


def silent(done: int, total: int, text: str) -> None:
    """No progress shown."""


@dataclass
class Search:
    """Fits of effect sets on one problem; each set is fitted once.

    sources     effect name -> what load_effect takes (catalogue name or path.py:Class)
    before      the model as it is, fitted with the noise that was estimated before; where its fit starts from
    thorough    a first effect is approached from the nominal values afresh
    """

    problem: Problem
    model: Model
    nuisances: Sequence[Nuisance]
    sources: Mapping[str, str]
    executor: Executor = field(default_factory=Executor)
    progress: Progress = silent
    before: Candidate | None = None
    thorough: bool = False
    found: dict[Names, Candidate] = field(default_factory=dict)
    _nominal: dict[bytes, Fit] = field(default_factory=dict)
    _minima: dict[bytes, tuple[Fit, ...]] = field(default_factory=dict)
    _scans: dict[tuple[bytes, str], list[Scored]] = field(default_factory=dict)
    _key: str = ""

    def __post_init__(self) -> None:
        self.coordinates = tuple(nuisance_coordinate(n) for n in self.nuisances)
        self.scan = Scan(self.problem, self._nominal, self._minima)

    @property
    def slow(self) -> bool:
        """True where a slow plant is seen through a fast one."""
        return isinstance(self.problem.rig, AnchoredRig)

    # -- pieces -------------------------------------------------------------------------------------------------
    def effect(self, name: str) -> EffectType:
        return self.problem.rig.effect(load_effect(self.sources[name]))

    def own(self, name: str) -> bool:
        """Whether an effect is the user's, and not of the catalogue."""
        return is_own_effect(self.sources[name])

    def strengths(self, name: str) -> list[str]:
        """The full names of an effect's parameters that switch it off where they vanish."""
        return [f"{name}.{p.name}" for p in self.effect(name).parameters if p.vanishing is not None]

    def null(self) -> Candidate:
        """The model as it is, with its nuisance parameters fitted."""
        if () not in self.found:
            begun = self._begun()
            best = self.once(Search._ended, begun[0], text="nominal: fit")
            self.found[()] = Candidate((), best, best.cost)
            if not self.slow:
                self._minima[point_key(best)] = other_minima(best, begun[1:])
        return self.found[()]

    def _begun(self) -> list[Fit]:
        """The fit of the model as it is with the noise that was estimated before, or those from several starts."""
        if self.before is not None:
            return [self.before.fit]
        starts = wide_starts(self.coordinates)
        found = self.each(Search.begun_at, [(start,) for start in starts], "nominal: fit")
        return sorted(found, key=lambda f: f.cost)

    def begun_at(self, start: Mapping[str, float]) -> Fit:
        """The model as it is, fitted from one point (z by name)."""
        return fit(self.problem, self.model, self.coordinates, start, evaluations=WHOLE)

    def _ended(self, found: Fit) -> Fit:
        """A fit, perhaps of another problem (other noise), carried on until it stays."""
        if self.slow:
            return self._again(found, WHOLE)
        found = at_anchor(self.problem, found)[1]
        for _ in range(MOVES):
            new = self._again(found, WHOLE)
            gain = found.cost - new.cost
            if gain > 0.0:
                found = new
            if gain < least_gain(found):
                break
        return self._led_back(found)

    def with_effects(self, names: Names) -> tuple[Model, tuple[Coordinate, ...]]:
        """The model with the effects switched off but movable, and the coordinates to move."""
        model, coordinates = self.model, list(self.coordinates)
        for name in names:
            kind = self.effect(name)
            source = self.sources[name] if self.own(name) else None
            model = model.with_effect(vanishing_entry(kind, source))
            coordinates += effect_coordinates(kind)
        return model, tuple(coordinates)

    def add(self, base: Candidate, name: str) -> Candidate:
        """Fit the base set plus one effect, from the best points of the scan."""
        found: Candidate = self.once(Search._add, base, name, text=f"fit with {name}")
        return self.keep(found)

    def _add(self, base: Candidate, name: str) -> Candidate:
        starts = [start for _, start in self._scanned(base, name)]
        return self._settled(base, name, starts, self._approaches(base, name, starts))

    def _scanned(self, base: Candidate, name: str) -> list[Scored]:
        return self.scan.starts(self.effect(name), base.fit, *self.with_effects((*base.names, name)))

    def _at_nominal(self, base: Candidate) -> Fit:
        return self.scan.at_nominal(base.fit)

    def _approaches(
        self,
        base: Candidate,
        name: str,
        starts: Sequence[Mapping[str, float]],
        worth: float = np.inf,
        short: bool = False,
    ) -> list[Fit]:
        """Fits of the base set plus one effect from each start, best first; a slow plant runs at their ends only.

        worth   penalised cost below which the set is of interest
        short   a few steps only, with all derivatives of the base known
        """
        if self.thorough and not base.names:
            return self._afresh(base, name, starts)
        model, coordinates = self.with_effects((*base.names, name))
        worth -= _penalty(coordinates)
        found = []
        for start in starts:
            near = self.scan.nearer(start, base.fit)
            at = self.scan.true_start(base.fit, model, coordinates, start)
            if self.slow:
                one = fit(
                    self._seen_from_start(model, coordinates, at, near),
                    model,
                    coordinates,
                    at,
                    evaluations=15,
                )
                # Costs that were seen from different places cannot be compared before the anchor is there.
                found.append(at_anchor(self.problem, one)[1])
                continue
            ways = [(near, at)]
            if near is not base.fit:
                # Where the effect makes the hand stick, the linear moves of the scan lead astray, and so may either
                # point's derivatives.
                ways += [(base.fit, at), (near, _still(coordinates, at, near))]
            for point, begin in ways:
                found.append(
                    fit(
                        self.problem,
                        model,
                        coordinates,
                        begin,
                        known=_derivatives(point, [c for c in point.coordinates if short or c.prior]),
                        evaluations=SHORT if short else LONG,
                        little=ROUGH,
                        worth=worth,
                    )
                )
        return sorted(found, key=lambda f: f.cost)

    def _afresh(self, base: Candidate, name: str, starts: Sequence[Mapping[str, float]]) -> list[Fit]:
        """Fits of the model as it is plus one effect from its nominal values, best first.

        Where nuisance parameters have taken over the effect, the way back is long and bends, and what straight lines
        promise says little: all derivatives are found there, and no fit ends early.
        """
        model, coordinates = self.with_effects((name,))
        nominal = self.scan.at_nominal(base.fit)
        near = [start for start in starts if self.scan.nearer(start, base.fit) is nominal] or starts
        found = [
            fit(
                self.problem,
                model,
                coordinates,
                _still(coordinates, start, nominal),
                evaluations=MIDDLE,
                little=ROUGH,
            )
            for start in near[:AFRESH]
        ]
        return sorted(found, key=lambda f: f.cost)

    def _seen_from_start(
        self, model: Model, coordinates: Sequence[Coordinate], at: Mapping[str, float], near: Fit
    ) -> Problem:
        """The problem seen from where a fit starts, or from the fit near it where the slow plant diverges at the start.

        Seen from elsewhere, a strong effect fits where the slow plant says nothing of the kind.
        """
        values = {c.name: c.value(at.get(c.name, 0.0)) for c in coordinates}
        there = self.problem.with_rig(anchored_at(self.problem.rig, model, values))
        failures = there.failures
        there.residual(model, values)
        return there if there.failures == failures else seen_from(self.problem, near)

    def _settled(
        self,
        base: Candidate,
        name: str,
        starts: Sequence[Mapping[str, float]],
        approaches: Sequence[Fit],
        worth: float = np.inf,
        short: bool = False,
        whole: bool = True,
    ) -> Candidate:
        """The best that the approaches lead to: the first, and others that cost about as little.

        whole   on a slow plant, carry them on to the end
        """
        first = best = self._carried_on(approaches[0], worth, short, whole)
        for other in approaches[1:]:
            if other.cost <= RIVAL_START * (approaches[0] if short else best).cost:
                best = min(best, self._carried_on(other, worth, short, whole=False), key=lambda f: f.cost)
        if whole and best is not first:
            best = min(best, self._carried_on(best, worth), key=lambda f: f.cost)
        if best.cost > base.fit.cost:
            # The set contains the base: the search was led astray, and starts again from where the base is.
            at = {**starts[0], **base.fit.point, **dict.fromkeys(self.strengths(name), 0.0)}
            again = fit(
                seen_from(self.problem, base.fit),
                best.model,
                best.coordinates,
                at,
                known={} if self.slow else _derivatives(base.fit),
                evaluations=LONG,
                worth=worth - _penalty(best.coordinates),
            )
            best = min(best, self._carried_on(again, worth, whole=whole), key=lambda f: f.cost)
        return _candidate((*base.names, name), best)

    def _carried_on(self, found: Fit, worth: float, short: bool = False, whole: bool = True) -> Fit:
        """An approach carried on: a short one to its end; on a slow plant to its end (whole) or in a few moves."""
        if short and found.complete:
            return fit(
                self.problem,
                found.model,
                found.coordinates,
                found.z,
                known=_derivatives(found, [c for c in found.coordinates if c.prior]),
                evaluations=LONG,
                worth=worth - _penalty(found.coordinates),
            )
        if whole:
            return settle(self.problem, found, afresh=True)[1]
        return settle(self.problem, found, moves=2)[1]

    def keep(self, candidate: Candidate) -> Candidate:
        """The candidate, which is what is known of its set from now on, unless a better fit is known."""
        known = self.found.get(candidate.key)
        if candidate.fit.complete and (known is None or candidate.penalised <= known.penalised):
            self.found[candidate.key] = candidate
        return candidate

    def thoroughly(self) -> Search:
        """The same search, with what was found, for a first effect that is hard to reach."""
        return replace(self, thorough=True, _key="")

    def polish(self, candidate: Candidate, evaluations: int = 15) -> Candidate:
        """Refit from the candidate's point with all derivatives taken afresh."""
        found: Candidate = self.once(Search._polish, candidate, evaluations, text="polish")
        return self.keep(found)

    def _polish(self, candidate: Candidate, evaluations: int = 15) -> Candidate:
        new = self._led_back(self._again(candidate.fit, evaluations))
        if new.cost < candidate.fit.cost:
            cost = candidate.penalised - candidate.fit.cost + new.cost
            candidate = Candidate(candidate.names, new, cost)
        return candidate

    def _again(self, old: Fit, evaluations: int) -> Fit:
        """A fit from where another ended; on a slow plant with its slopes there, as those of elsewhere mislead.

        Dry friction makes the misfit rough: a fit stays where derivatives over steps of one length promise nothing, and
        goes on with those over longer or shorter ones.
        """
        if self.slow:
            return settle(self.problem, old, afresh=True)[1]
        found = self._over_steps(old, evaluations, 1.0)
        for length in STEPS:
            found = min(found, self._over_steps(found, evaluations, length), key=lambda f: f.cost)
        return found

    def _over_steps(self, old: Fit, evaluations: int, length: float) -> Fit:
        """A fit from where another ended, its first derivatives over so many times the usual steps."""
        return fit(
            self.problem,
            old.model,
            old.coordinates,
            old.z,
            steps={name: length * step for name, step in spread(old).items()},
            evaluations=evaluations,
        )

    def _led_back(self, found: Fit) -> Fit:
        """A fit with parameters that are far off held at their nominal values and all else fitted again, where that
        costs less; a slow plant's stays as it is.  Those of a recording alone may lie across the way too.

        Those that only grow from nothing are tried from nearer on: a hand that rests off its stop may look like one
        that rests on it.  Parameters that only act together (an efficiency, and the mass and friction that it drives)
        are told by their priors alone.  While much is unexplained, a fit stays where that of a worse model had gone:
        what is bent or rough in the derivatives makes the valley look like a slope.  With one of them held there is no
        valley.
        """
        tried: set[str] = set()
        while not self.slow:
            far = [c for c, off in found.off if off > (GROWN if grows(c) else PULLED)]
            held = next((c for c in far if c.name not in tried), None)
            if held is None:
                break
            tried.add(held.name)
            others = [c for c in found.coordinates if c is not held]
            problem = replace(self.problem, held={held.name: held.value(0.0)})
            rest = fit(problem, found.model, others, found.point, evaluations=LONG)
            if rest.cost < found.cost:
                whole = {**rest.point, held.name: 0.0}
                again = fit(self.problem, found.model, found.coordinates, whole, evaluations=SHORT)
                found = min(found, again, key=lambda f: f.cost)
        return found

    def with_spread(self, candidate: Candidate) -> Candidate:
        """The candidate with the derivatives from which its intervals are made."""
        found: Candidate = self.once(Search._with_spread, candidate, text="intervals")
        return self.keep(found)

    def _with_spread(self, candidate: Candidate) -> Candidate:
        problem = self.problem.with_rig(slopes_at(self.problem.rig, candidate.fit))
        found = over_its_spread(problem, candidate.fit)
        return replace(candidate, fit=found if self.slow else replace(found, grain=grain_of(problem, found)))

    def renewed(self, best: Candidate) -> Search:
        """The same search with noise and scatter estimated at another point: sensitivities there are the true ones."""
        rig = seen_from(self.problem, best.fit).rig
        problem = build_problem(
            rig, self.problem.features, best.fit.model, self.nuisances, best.fit.values, self.problem.counts
        )
        return self._emptied(problem=problem, before=self.found.get((), self.before))

    def fitted_afresh(self, best: Candidate) -> tuple[Search, Candidate]:
        """The search with noise and scatter estimated at a candidate, and the candidate fitted to the end in it."""
        new = self.renewed(best)
        (again,) = new.refitted([best])
        return new, new.polish(again)

    def with_nuisances(self, nuisances: Sequence[Nuisance]) -> Search:
        """The same search with other nuisance parameters; nothing that was found holds for it."""
        return self.on(self.problem, nuisances)

    def on(self, problem: Problem, nuisances: Sequence[Nuisance]) -> Search:
        """The same search on another problem; nothing that was found holds for it."""
        return self._emptied(problem=problem, nuisances=nuisances, before=None)

    def _emptied(self, **changes: Any) -> Search:
        return replace(self, found={}, _nominal={}, _minima={}, _scans={}, _key="", **changes)

    def from_point(self, names: Names, start: Mapping[str, float]) -> Candidate:
        """Fit a set of effects from one point (z by name)."""
        model, coordinates = self.with_effects(names)
        found = fit(self.problem, model, coordinates, start, evaluations=WHOLE)
        return self.keep(_candidate(names, found))

    def _refit(self, candidate: Candidate, evaluations: int = 8) -> Candidate:
        """A candidate of another problem (other noise), fitted in this one from its point."""
        return _candidate(candidate.names, self._led_back(self._again(candidate.fit, evaluations)))

    def without(self, larger: Candidate, parts: Sequence[Names]) -> list[Candidate]:
        """Parts of a set, each fitted again from where the larger one ended, or its known fit if that costs less."""
        todo = [(Candidate(names, self._part(larger.fit, names), np.inf), 15) for names in parts]
        again = self.each(Search._refit, todo, "without it")
        return [self._better_known(one) for one in again]

    def _better_known(self, candidate: Candidate) -> Candidate:
        known = self.found.get(candidate.key)
        return known if known is not None and known.fit.cost <= candidate.fit.cost else self.keep(candidate)

    def _part(self, larger: Fit, names: Names) -> Fit:
        """Where a fit of a larger set ended, without the other effects."""
        model, coordinates = self.with_effects(names)
        index = [[c.name for c in larger.coordinates].index(c.name) for c in coordinates]
        z, jacobian = larger.z[index], larger.jacobian[:, index]
        return replace(larger, model=model, coordinates=coordinates, z=z, jacobian=jacobian)

    def fit_of(self, names: Sequence[str]) -> Candidate:
        """The fit of a set that was found; the model as it is is fitted if it was not yet."""
        return self.found[key_of(names)] if names else self.null()

    def fitted(self, names: Names) -> Candidate:
        """The fit of a set: the known one, or one effect after the other."""
        found = self.null()
        for k, name in enumerate(names):
            known = self.found.get(key_of(names[: k + 1]))
            if known is None:
                known = self.add(found, name)
                # On a slow plant it was carried to its end.
                known = known if self.slow else self.polish(known)
            found = known
        return found

    def refitted(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Candidates of another problem, each fitted in this one unless it was already."""
        todo = [c for c in candidates if self.found.get(c.key) is not c]
        done = iter(self.each(Search._refit, [(c, 8) for c in todo], "noise afresh: refit"))
        return [self.keep(next(done) if c in todo else c) for c in candidates]

    # -- rounds -------------------------------------------------------------------------------------------------
    def extend(
        self, bases: Sequence[Candidate], names: Sequence[str], text: str, worth: float = np.inf
    ) -> list[Candidate]:
        """The bases with one further effect each, sorted by penalised cost.

        All extensions are scanned; the most promising are refitted in closed loop, the POLISH best of them with all
        derivatives taken afresh, as far as their penalised cost is below `worth`; all of them where their base was led
        astray and that leads to none that is, or to one that is as far off: they may be on a bent way.
        """
        todo: dict[Names, tuple[Candidate, str]] = {}
        for base in bases:
            for name in names:
                if name not in base.names:
                    todo.setdefault(key_of((*base.names, name)), (base, name))
        points = self.each(Search._at_nominal, [(base,) for base in bases], f"{text}: nominal values")
        self._nominal.clear()
        self._nominal.update((point_key(base.fit), point) for base, point in zip(bases, points, strict=True))
        # A thorough search scans the same places.
        keys = [(point_key(base.fit), name) for base, name in todo.values()]
        new = [item for item, key in zip(todo.values(), keys, strict=True) if key not in self._scans]
        for (base, name), scan in zip(new, self.each(Search._scanned, new, f"{text}: scan"), strict=True):
            self._scans[point_key(base.fit), name] = scan
        scans = [self._scans[key] for key in keys]
        order = sorted(zip(todo.values(), scans, strict=True), key=lambda item: item[1][0][0])
        least = order[0][1][0][0] if order else np.inf
        chosen = [
            (base, name, [s for _, s in starts])
            for k, ((base, name), starts) in enumerate(order)
            if self._worth_an_approach(k, base, starts[0][0], least, worth)
        ]
        ended, others = self._refits(chosen, text, worth)
        fitted = [self.keep(c) for c in (*ended, *others)]
        best = [self.found.get(c.key, c) for c in fitted]
        # What was known before was polished where that was worth it.
        done = {c.key for c, known in zip(fitted, best, strict=True) if c is not known}
        done |= {c.key for c in ended}
        ranked = sorted(best, key=lambda c: c.penalised)
        most = self._rivals(ranked, worth)
        worthy = [c for c in ranked[:POLISH] if c.penalised < most and c.key not in done]
        ranked = self.polished(ranked, worthy, text)
        if not self.slow and ranked and (ranked[0].far_off or ranked[0].penalised >= worth):
            done |= {c.key for c in worthy}
            astray = {c.key for c in ranked if c.key not in done and self._led_astray(todo[c.key][0])}
            bent = [c for c in ranked[:REFIT] if c.far_off and c.key in astray]
            back = [c for c in ranked if not c.far_off and c.key in astray][:BACK]
            ranked = self.polished(ranked, [*bent, *back], text)
        return ranked

    def _rivals(self, ranked: Sequence[Candidate], worth: float) -> float:
        """Penalised cost below which one of the ranked extensions may come to rival the best by polishing.

        On a slow plant polishing is long, and the best are polished already.  Where the best explains all without
        taking a machine far off, what costs HOPELESS times as much can no longer tie with it.
        """
        if not ranked:
            return worth
        best = ranked[0]
        if self.slow:
            return min(worth, RIVAL_START * best.penalised)
        return min(worth, HOPELESS * best.penalised) if _explains_all(self.problem, best) else worth

    def _led_astray(self, base: Candidate) -> bool:
        """True where a base leaves little and is far off: what it takes over fits nearly as well as an effect would."""
        return base.far_off and base.fit.cost <= self.problem.features.size

    def polished(self, ranked: Sequence[Candidate], some: Sequence[Candidate], text: str) -> list[Candidate]:
        """The candidates, of which some are fitted with all derivatives afresh; sorted by penalised cost."""
        polished = self.each(Search._polish, [(c,) for c in some], f"{text}: polish")
        better = {c.names: self.keep(c) for c in polished}
        return sorted((better.get(c.names, c) for c in ranked), key=lambda c: c.penalised)

    def _refits(
        self, chosen: Sequence[tuple[Candidate, str, list[Any]]], text: str, worth: float
    ) -> tuple[list[Candidate], list[Candidate]]:
        """Fits in closed loop: all are approached, and those that this does not leave hopeless are carried on.

        Those of a slow plant that were carried to the end, and the others.
        """
        short = not self.slow and len(chosen) > REFIT
        found = self.each(Search._approaches, [(*item, worth, short) for item in chosen], f"{text}: approach")
        items = [(*item, fits) for item, fits in zip(chosen, found, strict=True)]
        items.sort(key=lambda item: item[3][0].cost)
        if not self.slow:
            # What leaves a base that is far off for a machine within its tolerances is dearer until it has arrived.
            back = [k for k, item in enumerate(items) if item[0].far_off and farthest(item[3][0]) <= FAR]
            carried = {*range(len(items[:REFIT])), *[k for k in back if k >= REFIT][:BACK]}
            done = self.each(
                Search._settled, [(*items[k], worth, short) for k in sorted(carried)], f"{text}: refit"
            )
            rest = [item for k, item in enumerate(items) if k not in carried]
            ended = [_candidate((*b.names, n), replace(fits[0], complete=False)) for b, n, _, fits in rest]
            return [], [*done, *ended]
        # A further effect that gains nothing where its fit ends is near to where it would settle.
        items = [
            item
            for item in items
            if not item[0].names or _candidate(item[0].names, item[3][0]).penalised < item[0].penalised
        ]
        # The best goes first, to the end: what it reaches tells which others are hopeless.  From a base that is far off
        # the way is long, and where it has gone two moves says little: there two more go to the end.
        ended = self._to_the_end(items[:1], text, worth)
        rest = self._followed(items, ended, items[1:])
        further = list(itertools.takewhile(_from_far_off, rest[: POLISH - 1]))
        ended += self._to_the_end(further, text, worth)
        rest = self._followed(items, ended, rest[len(further) :])
        return ended, self.each(
            Search._settled, [(*item, worth, False, False) for item in rest], f"{text}: refit"
        )

    def _to_the_end(self, items: Sequence[_Approached], text: str, worth: float) -> list[Candidate]:
        return self.each(Search._settled, [(*item, worth) for item in items], f"{text}: refit")

    def _followed(
        self, items: Sequence[_Approached], ended: Sequence[Candidate], rest: Sequence[_Approached]
    ) -> list[_Approached]:
        """Which other approaches to a slow plant are carried on, by what those reached that were carried to the end."""
        if not ended:
            return []
        best = min(ended, key=lambda c: c.fit.cost)
        least = best.fit.cost
        led = next(item for item in items if key_of((*item[0].names, item[1])) == best.key)
        # Where it explains all, others can only tie with it: they move the data alike, and so do their approaches.  Not
        # where it takes a machine far off for that.
        asked = ALIKE * _gain(led) if _explains_all(self.problem, best) else -np.inf
        return [
            item
            for item in rest
            if _gain(item) >= asked
            and item[3][0].cost <= max(HOPELESS * least, (1.0 - REMOVED) * item[0].fit.cost)
        ]

    def _worth_an_approach(
        self, rank: int, base: Candidate, scanned: float, least: float, worth: float
    ) -> bool:
        """Whether an extension is fitted: by its rank in the scan and, on a slow plant, by what the scan says of it.

        Of a base that is far off a scan says little.
        """
        if not self.slow:
            return rank < REFIT or (base.pulled if base.names else base.far_off)
        promising = base.pulled or (scanned < worth and scanned <= HOPELESS * least)
        return (rank < REFIT and promising) or (rank == 0 and not base.names)

    def each(self, function: Callable[..., Any], items: Sequence[tuple[Any, ...]], text: str) -> list[Any]:
        """function(search, *item) for every item, wherever the executor works; the same results everywhere.

        What is in the executor's store is taken from there, with the simulations that it took; each result goes there
        as soon as it is made.
        """
        store = self.executor.store
        keys = self._keys(function, items) if store else {}
        out: list[Any] = [None] * len(items)
        missing = []
        for k in range(len(items)):
            kept = self._stored(store, keys[k]) if store and k in keys else None
            if kept is None:
                missing.append(k)
            else:
                out[k], simulations, failures = kept
                self._count(simulations, failures)
        done = len(items) - len(missing)
        for k, made in self._made(function, items, missing):
            out[k] = made[0]
            if store and k in keys:
                with suppress(NotPlain):
                    store.write(keys[k], self._codec.pack(made))
            done += 1
            self.progress(done, len(items), text)
        return out

    def once(self, function: Callable[..., Any], *item: Any, text: str) -> Any:
        """One item in this process; from the store if it is there."""
        return self.each(function, [item], text)[0]

    def _made(
        self, function: Callable[..., Any], items: Sequence[tuple[Any, ...]], missing: Sequence[int]
    ) -> Iterator[tuple[int, tuple[Any, int, int]]]:
        """The missing items' numbers, each with its result and the simulations and failures that it took."""
        if self.executor.serial or len(missing) < 2:
            bare = replace(self, executor=Executor(), progress=silent)
            for k in missing:
                before = self.problem.simulations, self.problem.failures
                result = function(bare._knowing(items[k]), *items[k])
                yield k, (result, self.problem.simulations - before[0], self.problem.failures - before[1])
            return
        work = [(function, items[k]) for k in missing]
        key = f"{next(_runs)} {id(self)} {os.getpid()} {time.time_ns()}"
        for number, made in self.executor.run(
            _work, (*self._shared, dict(self.sources), self._nominal, self._minima), key, work
        ):
            self._count(*made[1:])
            yield missing[number], made

    def _count(self, simulations: int, failures: int) -> None:
        self.problem.counts.simulations += simulations
        self.problem.counts.failures += failures

    @property
    def _shared(self) -> tuple[Any, ...]:
        """What the result of every item depends on, beside its effects and the other minima of the model as it is."""
        return (self.problem, self.model, tuple(self.nuisances), self.thorough)

    def _sources_of(self, item: tuple[Any, ...]) -> dict[str, str]:
        """Of the effects that an item names: what else is looked for changes no result of it."""
        sets = (part.names if isinstance(part, Candidate) else (part,) for part in item)
        names = {name for some in sets for name in some if isinstance(name, str)}
        return {name: self.sources[name] for name in sorted(names & self.sources.keys())}

    def _knowing(self, item: tuple[Any, ...]) -> Search:
        """This search for one item: it knows the effects that the item's key holds, and nothing that was found."""
        return replace(self, sources=self._sources_of(item), found={}, before=None, _scans={})

    @property
    def _codec(self) -> Codec:
        return Codec(self.with_effects, (Candidate, SignalError))

    def _keys(self, function: Callable[..., Any], items: Sequence[tuple[Any, ...]]) -> dict[int, str]:
        """Hash of all that an item's result depends on; none for items of which that cannot be told."""
        out = {}
        with suppress(NotPlain):
            self._key = self._key or content_hash(code_hash(), *self._shared)
            minima = content_hash([(k.hex(), fits) for k, fits in sorted(self._minima.items())])
            for k, item in enumerate(items):
                sources, called = self._sources_of(item), (function.__module__, function.__qualname__)
                out[k] = content_hash(self._key, minima, *called, sources, item)
        return out

    def _stored(self, store: Store, key: str) -> Any | None:
        content = store.read(key)
        try:
            return None if content is None else self._codec.unpack(content)
        except (KeyError, TypeError, ValueError):
            return None

    def signatures(self, base: Candidate) -> dict[str, list[Array]]:
        """Whitened derivative of each effect at vanishing strength, per shape start; for what chance reaches."""
        names = [name for name in self.sources if name not in base.names]
        found = self.each(Search._signature, [(base, name) for name in names], "what chance reaches")
        return dict(zip(names, found, strict=True))

    def _signature(self, base: Candidate, name: str) -> list[Array]:
        here = base.fit.values
        kind = self.effect(name)
        model, coordinates = self.with_effects((*base.names, name))
        own = [c for c in coordinates if c.name.startswith(f"{name}.")]
        strengths = [c for c, p in zip(own, kind.parameters, strict=True) if p.vanishing is not None]
        out = []
        # Every other period: those between are no further chances.
        for shape in shapes_of(kind, tried_periods(kind, self.problem, base.fit, 2)):
            z = np.array([shape.get(c.name, c.z(here.get(c.name, c.offset))) for c in coordinates])
            values = values_at(coordinates, z)
            r = self.problem.residual(model, values)
            columns = [coordinates.index(c) for c in strengths]
            out.append(finite_differences(self.problem, model, coordinates, z, r, columns))
        return out


_runs = itertools.count()
_held = Held()


def _work(
    shared: tuple[Any, ...], key: str, function: Callable[..., Any], item: tuple[Any, ...]
) -> tuple[Any, int, int]:
    """One item in a worker, which keeps the search for the next ones: (result, simulations, failures)."""

    def build() -> Search:
        problem, model, nuisances, thorough, sources, points, minima = shared
        problem = replace(problem, rig=own(problem.rig), counts=Counts())
        return Search(
            problem,
            model,
            nuisances,
            sources,
            thorough=thorough,
            _nominal=dict(points),
            _minima=dict(minima),
        )

    search = _held.get(key, build)
    counts = search.problem.counts
    counts.simulations = counts.failures = 0
    result = function(search._knowing(item), *item)
    return result, counts.simulations, counts.failures


def _from_far_off(item: _Approached) -> bool:
    """True of an approach from a set of effects that is far off."""
    return bool(item[0].names) and item[0].pulled


def _explains_all(problem: Problem, best: Candidate) -> bool:
    """True of a set that leaves no more than noise, without taking a machine far off for that."""
    return best.fit.cost <= problem.features.size and not best.far_off


def _gain(item: _Approached) -> float:
    """By how much an approach lowered its base's cost."""
    base, _, _, fits = item
    return base.fit.cost - fits[0].cost


def _candidate(names: Names, found: Fit) -> Candidate:
    """A fitted set with what its free parameters cost."""
    return Candidate(names, found, found.cost + _penalty(found.coordinates))


def _still(coordinates: Sequence[Coordinate], start: Mapping[str, float], place: Fit) -> dict[str, float]:
    """A start with the nuisance parameters where a place has them."""
    return {c.name: (place.point if c.prior else start).get(c.name, 0.0) for c in coordinates}


def _penalty(coordinates: Sequence[Coordinate]) -> float:
    return PENALTY * sum(not c.prior for c in coordinates)


def _derivatives(found: Fit, of: Sequence[Coordinate] | None = None) -> dict[str, Array]:
    """Derivatives (size,) at a fit by coordinate name; of all its coordinates if not of some."""
    return {c.name: found.jacobian[:, j] for j, c in enumerate(found.coordinates) if of is None or c in of}


def grows(c: Coordinate) -> bool:
    """True for a parameter that nobody described and that only grows from nothing."""
    return c.wide and c.bounds[0] == 0.0


def wide_starts(coordinates: Sequence[Coordinate]) -> list[dict[str, float]]:
    """Where fits of the model as it is start: the nominal values, and others if some priors are wide.

    One that can only grow from its nominal value starts away from it too, with all else nominal: near its bound the
    misfit may say that it should shrink.
    """
    wide = [c.name for c in coordinates if c.wide]
    grown = [{c.name: 1.0} for c in coordinates if grows(c)]
    others = np.random.default_rng(0).uniform(-APART, APART, (STARTS if wide else 0, len(wide)))
    return [{}, *grown, *(dict(zip(wide, (float(z) for z in row), strict=True)) for row in others)]


def other_minima(best: Fit, others: Sequence[Fit]) -> tuple[Fit, ...]:
    """Those of the others, best first, that cost about as little and are elsewhere than the best and one another."""
    out: list[Fit] = []
    for one in others:
        apart = [float(np.linalg.norm(one.z - known.z)) for known in (best, *out)]
        if one.cost <= RIVAL_START * best.cost and min(apart) > DISTINCT and len(out) < MINIMA:
            out.append(one)
    return tuple(out)

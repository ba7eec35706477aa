"""Where the fit of one further effect starts: its strengths and shapes are tried with all else compensated linearly."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectParameter, EffectType
from numpy.typing import NDArray

from .fit import Fit, finite_differences, linear_minimum, prior_weights
from .problem import Coordinate, Problem, effect_coordinates
from .settle import seen_from
from .spectrum import periods_of_a_turn, position_periods, resolved, whole_periods
from .surrogate import AnchoredRig

Array = NDArray[np.float64]
Point = dict[str, float]
"""Whitened coordinates by name."""

Scored = tuple[float, Point]
"""Cost of a point after the linear best move of all else, and the point with that move."""

STRENGTHS = (0.01, 0.1, 1.0, 4.0, 16.0)
"""Strengths of the scan, in typical values; both signs where the bounds allow.  Each point is followed to where the
straight line through it and the point without the effect says that the best strength is."""

FOLLOW = 3
"""Points of a scan that are followed."""

FOLLOWED = (0.05, 20.0)
"""How far, in strengths of the point itself, it is followed at most."""

FINE = tuple(0.5 * 1.2**k for k in range(16))
STRAY = 2.0
"""Strengths that are scanned too where the others leave so many times more squares than there are samples: a hand that
sticks fits in a narrow range of strengths only, which lies anywhere between theirs."""

PITS = 8
RIPPLES = 2
"""Of the periods at which a ripple promises more than at those beside it, so many are simulated, and so many are where
fits start, from each place; all of them if the base is off: a ripple that did that is not linear, and looks like one of
a wave more or less within the travel."""

NEAR = 2.0
"""A base whose nuisance parameters are all within so many standard deviations is scanned from where it is alone."""

SMALL = 0.05
SAME = 0.02
"""Where so small a part of what a parameter is off, as a strength of an effect, changes the same but for this part, the
two are taken to be one thing."""

REACH = 8.0
"""Standard deviations to which a scan moves a nuisance parameter, unless the base is farther off already."""


@dataclass
class Scan:
    """Scans on one problem.

    nominal bases with their nuisance parameters at the nominal values, as far as they are known
    minima  of a base that has several, the others
    """

    problem: Problem
    nominal: dict[bytes, Fit] = field(default_factory=dict)
    minima: dict[bytes, tuple[Fit, ...]] = field(default_factory=dict)

    def at_nominal(self, base: Fit) -> Fit:
        """The base's effects with the nuisance parameters back at their nominal values.

        A fit without the true effect may have driven a nuisance parameter far off; the truth is near the prior's mean.
        """
        key = point_key(base)
        if key not in self.nominal:
            z = np.where(prior_weights(base.coordinates) > 0.0, 0.0, base.z)
            there = replace(base, z=z)
            problem = seen_from(self.problem, there)
            r = problem.residual(base.model, there.values)
            jacobian = finite_differences(problem, base.model, base.coordinates, z, r, range(z.size))
            self.nominal[key] = replace(
                there, cost=float(r @ r), residual=r, jacobian=jacobian, complete=True
            )
        return self.nominal[key]

    def starts(
        self, kind: EffectType, base: Fit, model: Model, coordinates: Sequence[Coordinate]
    ) -> list[Scored]:
        """Best starting points of an effect on top of a fit: from the base and its other minima, and from its nominal
        values if it is off.

        kind                what is added; `model` and `coordinates` are those of the base with it
        """
        places = [base, *self.minima.get(point_key(base), ())]
        off = farthest(base) > NEAR
        if off:
            places.append(self.at_nominal(base))
        best: list[Scored] = []
        all_pits = off and not isinstance(self.problem.rig, AnchoredRig)
        lines = spectral_periods(kind, seen_from(self.problem, base), base)
        shapes = shapes_of(kind, (*lines, *tried_periods(kind, self.problem, base)))
        period = period_of(kind)
        for place in places:
            scan = _Place(self, kind, place, model, coordinates)
            if period:
                best += scan.rippled(shapes)[: PITS if all_pits else RIPPLES]
            else:
                every = scan.scored(shapes, _strengths(kind), last=place is places[-1])
                best.append(min(every, key=lambda item: item[0]))
        best.sort(key=lambda item: item[0])
        return _distinct(best, f"{kind.name}.{period.name}")[:PITS] if period else best

    def nearer(self, start: Mapping[str, float], base: Fit) -> Fit:
        """Where a fit from a start looks from: the base, another minimum of it, or its nominal nuisance parameters,
        whichever is nearest.

        A slow plant is anchored there; on a fast one the derivatives by the nuisance parameters are tried from there
        too, since those of a base that a strong effect drove far off lead nowhere.
        """
        prior = prior_weights(base.coordinates) > 0.0
        z = np.array([start.get(c.name, 0.0) for c in base.coordinates if c.prior])
        places = (base, *self.minima.get(point_key(base), ()), self.at_nominal(base))
        return min(places, key=lambda place: float(np.linalg.norm(z - place.z[prior])))

    def true_start(
        self, base: Fit, model: Model, coordinates: Sequence[Coordinate], start: Mapping[str, float]
    ) -> Mapping[str, float]:
        """The start as the scan gave it, or with the base left where it is: whichever costs less in closed loop.

        The scan moves the base linearly; where effects of the base are far from linear, that leads astray.
        """
        if all(c.prior for c in base.coordinates):
            return start
        kept = {**start, **base.point}
        problem = seen_from(self.problem, base)
        return min((start, kept), key=lambda one: _cost(problem, model, coordinates, one))


def _cost(
    problem: Problem, model: Model, coordinates: Sequence[Coordinate], start: Mapping[str, float]
) -> float:
    """Cost of a point (z by name, 0 where it names none) in closed loop: its misfit and what the priors charge."""
    r = problem.residual(model, {c.name: c.value(start.get(c.name, 0.0)) for c in coordinates})
    return float(r @ r) + sum(start.get(c.name, 0.0) ** 2 for c in coordinates if c.prior)


class _Place:
    """The scan of one effect from one place."""

    def __init__(
        self, scan: Scan, kind: EffectType, place: Fit, model: Model, coordinates: Sequence[Coordinate]
    ) -> None:
        self.place, self.model, self.coordinates = place, model, coordinates
        self.own = {c.name: c for c in effect_coordinates(kind)}
        self.here, self.problem = place.point, seen_from(scan.problem, place)

    def scored(
        self, shapes: Sequence[Point], strengths: Mapping[str, Sequence[float]], *, last: bool
    ) -> Iterator[Scored]:
        """All points of the scan; finely around the best one where that is a stray, if this is the last place."""
        scores, follow = [], []
        swaps = [swap for name in strengths for swap in self.swapped(shapes[0], name)]
        for shape in shapes:
            for name, z in ((name, z) for name, points in strengths.items() for z in points):
                start = {**shape, name: z}
                residual = self.at(start)
                scores.append(self.score(start, residual))
                if z == 0.0:
                    continue
                cost, best = self.followed((residual - self.place.residual) / z)
                low, high = self.own[name].bounds
                if FOLLOWED[0] < best / z < FOLLOWED[1] and low <= best <= high:
                    follow.append((cost, {**start, name: best}))
        scores += [self.score(start) for _, start in sorted(follow, key=lambda item: item[0])[:FOLLOW]]
        yield from (*scores, *swaps)
        if len(strengths) > 1:
            # The halves of a difference are right together only.
            yield from (self.score(self.joint(shape)) for shape in shapes)
            return
        left, lowest = min(scores, key=lambda item: item[0])
        if last and left > STRAY * self.place.residual.size:
            (name,) = strengths
            sign, (low, high) = math.copysign(1.0, lowest[name]), self.own[name].bounds
            shape = {parameter: lowest[parameter] for parameter in self.own}
            for z in (sign * size for size in FINE if low <= sign * size <= high):
                yield self.score({**shape, name: z})

    def rippled(self, shapes: Sequence[Point]) -> list[Scored]:
        """The PITS best shapes of an effect with a period by what all strengths gain together, and what they cost."""
        steps: dict[str, float] = {}
        promised = [self.jointly(shape, steps) for shape in shapes]
        costs = np.array([np.inf, *(cost for cost, _ in promised), np.inf])
        pits = np.flatnonzero((costs[1:-1] <= costs[:-2]) & (costs[1:-1] <= costs[2:]))
        least = sorted((promised[k] for k in pits), key=lambda item: item[0])[:PITS]
        return sorted((self.score(start) for _, start in least), key=lambda item: item[0])

    def at(self, start: Mapping[str, float]) -> Array:
        z = {**self.here, **start}
        return self.problem.residual(
            self.model, {c.name: c.value(z.get(c.name, 0.0)) for c in self.coordinates}
        )

    def score(self, start: Mapping[str, float], residual: Array | None = None) -> Scored:
        """Cost of a start after the linear best move of the place's coordinates."""
        residual = self.at(start) if residual is None else residual
        place = self.place
        cost, z = linear_minimum(place.jacobian, residual, place.z, prior_weights(place.coordinates))
        bounds = np.array([c.bounds for c in place.coordinates]).reshape(-1, 2)
        for k, c in enumerate(place.coordinates):
            if c.prior:
                reach = max(REACH, abs(float(place.z[k])))
                bounds[k] = max(-reach, bounds[k, 0]), min(reach, bounds[k, 1])
        moved = np.clip(z, bounds[:, 0], bounds[:, 1])
        return cost, {**replace(place, z=moved).point, **start}

    def swapped(self, shape: Point, name: str) -> list[Scored]:
        """Starts with the strength in the place of a parameter that is off and the same thing, that one at its nominal.

        Then the misfit stays, and what the prior charged is gained.  A scan does not see it where a large strength does
        something else (the hand sticks) until the parameter has gone back.  The same thing has the same unit, and as
        much of either changes the same.
        """
        place, own = self.place, self.own[name]
        out = []
        for c, z in zip(place.coordinates, place.z, strict=True):
            more = c.value(float(z)) - c.value(0.0)
            if not (c.nuisance and c.unit == own.unit and abs(z) > NEAR and own.lower <= more <= own.upper):
                continue
            here, step = c.value(float(z)), SMALL * more
            if here + step <= max(c.lower, 0.0 if c.log else -math.inf):
                step = -step
            theirs = self.at({**shape, c.name: c.z(here + step)}) - place.residual
            ours = self.at({**shape, name: own.z(own.value(0.0) + step)}) - place.residual
            apart, size = float(np.linalg.norm(ours - theirs)), float(np.linalg.norm(theirs))
            if size == 0.0 or apart > SAME * size:
                continue
            start = {**self.here, **shape, c.name: 0.0, name: own.z(own.value(0.0) + more)}
            out.append((_cost(self.problem, self.model, self.coordinates, start), start))
        return out

    def followed(self, derivative: Array) -> tuple[float, float]:
        """Least cost along one more direction, with the place's coordinates compensating, and how far along it."""
        place = self.place
        cost, z = linear_minimum(
            np.column_stack([place.jacobian, derivative]),
            place.residual,
            np.append(place.z, 0.0),
            np.append(prior_weights(place.coordinates), 0.0),
        )
        return cost, float(z[-1])

    def joint(self, shape: Point) -> Point:
        """All strengths of the effect by one Gauss-Newton step from nought, together with the place's coordinates."""
        return self.jointly(shape, {})[1]

    def jointly(self, shape: Point, steps: dict[str, float]) -> Scored:
        """The same with the cost that the step promises; `steps` of the derivatives by name, which grow as needed."""
        place = self.place
        strengths = [k for k, c in enumerate(self.coordinates) if c.name in self.own and c.name not in shape]
        z = np.array([{**self.here, **shape}.get(c.name, 0.0) for c in self.coordinates])
        added = finite_differences(
            self.problem, self.model, self.coordinates, z, place.residual, strengths, steps
        )
        none = np.zeros(len(strengths))
        cost, moved = linear_minimum(
            np.column_stack([place.jacobian, added]),
            place.residual,
            np.append(place.z, none),
            np.append(prior_weights(place.coordinates), none),
        )
        out = dict(shape)
        for k, s in zip(strengths, moved[place.z.size :], strict=True):
            low, high = self.coordinates[k].bounds
            out[self.coordinates[k].name] = float(np.clip(s, low, high))
        return cost, out


def _distinct(scored: Sequence[Scored], shape: str) -> list[Scored]:
    """Of the points with the same value of a shape only the first one."""
    firsts: dict[float, Scored] = {}
    for cost, point in scored:
        firsts.setdefault(point[shape], (cost, point))
    return list(firsts.values())


def period_of(kind: EffectType) -> EffectParameter | None:
    """The parameter of an effect that is a period in the position, if it has one."""
    return next((p for p in kind.parameters if p.period), None)


def tried_periods(kind: EffectType, problem: Problem, base: Fit, every: int = 1) -> tuple[float, ...]:
    """Periods of an effect's ripple that are tried whatever the residual looks like; none for other effects.

    every   of how many neighbours within the travel one is taken
    """
    p = period_of(kind)
    if p is None:
        return ()
    # Where the model has the machine's form, what is sampled too slowly is simulated so, too.
    lower = max(p.lower, resolved(problem.features)) if problem.rig.foreign else p.lower
    along = whole_periods(problem.features, lower, p.upper)[every - 1 :: every]
    return (*along, *periods_of_a_turn(problem, base, lower, p.upper))


def spectral_periods(kind: EffectType, problem: Problem, base: Fit) -> tuple[float, ...]:
    """Periods of an effect's ripple at which the residual has a line; none for other effects."""
    p = period_of(kind)
    return position_periods(problem, base, p.lower, p.upper) if p else ()


def shapes_of(kind: EffectType, periods: Sequence[float] = ()) -> list[Point]:
    """All combinations of an effect's shapes, with these periods besides its own; neighbours differ in the period."""
    of = {c.name: c for c in effect_coordinates(kind)}
    choices = {}
    for p in sorted(kind.parameters, key=lambda p: p.period):
        if p.vanishing is None:
            own = p.starts or (p.typical,)
            values = sorted({*own, *periods}) if p.period else own
            name = f"{kind.name}.{p.name}"
            choices[name] = [of[name].z(v) for v in values]
    return [dict(zip(choices, shape, strict=True)) for shape in itertools.product(*choices.values())]


def _strengths(kind: EffectType) -> dict[str, list[float]]:
    """Strengths of the scan by parameter."""
    out = {}
    for c, p in zip(effect_coordinates(kind), kind.parameters, strict=True):
        if p.vanishing is not None:
            low, high = c.bounds
            points = [c.z(v) for v in p.starts] or [z for s in STRENGTHS for z in (s, -s)]
            out[c.name] = [z for z in points if low <= z <= high]
    return out


def farthest(found: Fit) -> float:
    """How many standard deviations the nuisance parameters are from their nominal values at most."""
    return found.off[0][1] if found.off else 0.0


def point_key(base: Fit) -> bytes:
    """What tells one fitted set of effects at one place from another."""
    return repr([c.name for c in base.coordinates]).encode() + base.z.tobytes()

"""Maximum a posteriori fit of nuisance and effect parameters in closed loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hannes_description.model import Model
from numpy.typing import NDArray
from scipy.optimize import least_squares

from .forces import Forces, scaling
from .problem import Coordinate, Problem, values_at

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SINGULAR = 1e-12
"""Least eigenvalue of the curvature, scaled to a diagonal of one, that is told from rounding."""


NOTHING = 1e-6
"""Change of the whitened residual for a tolerance of a parameter below which that moves nothing."""


@dataclass(frozen=True)
class Fit:
    """A fitted point.

    z           (k,) coordinates; values: by name in their units
    cost        sum of squares of whitened residual and prior
    residual    (size,) whitened residual of all features, also of those that were held out
    jacobian    (size, k) derivative of the residual by z
    complete    False where the search ended early since nothing of worth was in reach
    grain       standard deviation of what the misfit jumps by from place to place beside the point (grain_of); 0 where
                nobody looked
    """

    model: Model
    coordinates: tuple[Coordinate, ...]
    z: Array
    cost: float
    residual: Array
    jacobian: Array
    complete: bool = True
    grain: float = 0.0

    @property
    def values(self) -> dict[str, float]:
        return values_at(self.coordinates, self.z)

    @property
    def point(self) -> dict[str, float]:
        """z by name."""
        return {c.name: float(z) for c, z in zip(self.coordinates, self.z, strict=True)}

    @property
    def misfit(self) -> float:
        """Sum of squares of the whitened residual alone."""
        return float(self.residual @ self.residual)

    def z_of(self, name: str) -> float | None:
        for c, z in zip(self.coordinates, self.z, strict=True):
            if c.name == name:
                return float(z)
        return None

    @property
    def off(self) -> list[tuple[Coordinate, float]]:
        """Nuisance parameters with how many standard deviations of their priors they are off, farthest first."""
        off = [(c, abs(float(z))) for c, z in zip(self.coordinates, self.z, strict=True) if c.nuisance]
        return sorted(off, key=lambda item: -item[1])

    @property
    def unmoved(self) -> list[str]:
        """Nuisance parameters that move the data by nothing: their tolerance holds them at the nominal value."""
        sizes = np.linalg.norm(self.jacobian, axis=0)
        return [
            c.name for c, size in zip(self.coordinates, sizes, strict=True) if c.nuisance and size < NOTHING
        ]

    @property
    def at_end(self) -> list[Coordinate]:
        """The effects' parameters that would go beyond their range."""
        return [
            c for c, z in zip(self.coordinates, self.z, strict=True) if not c.prior and c.at_end(float(z))
        ]

    def covariance(self, inflate: float = 1.0) -> Array:
        """Covariance (k, k) of z from the curvature at the optimum, with the priors.

        What moves nothing, and what only moves with another, has a very large variance.

        inflate  factor by which the data's noise is larger than the whitening says; tolerances are what they are
        """
        unit, sizes, along = self.principal_axes()
        scaled = np.outer(unit, unit)
        inverse = (along / np.maximum(sizes, SINGULAR)) @ along.T
        if inflate != 1.0:
            # Of the point that was fitted with the data's weight as whitened, under noise that is larger.
            inverse = inverse @ (self._curvature(inflate) / scaled) @ inverse
        return np.asarray(inverse / scaled, dtype=np.float64)

    def principal_axes(self) -> tuple[Array, Array, Array]:
        """Those of the curvature with the priors, each coordinate z scaled by its unit (k,): their sizes (k,), SINGULAR
        or less where nothing is told, and the axes as columns (k, k).

        Columns differ by many orders of magnitude: scaled to one another first, none is lost to rounding.
        """
        curvature = self._curvature()
        unit = np.sqrt(np.diag(curvature))
        sizes, along = np.linalg.eigh(curvature / np.outer(unit, unit))
        return unit, sizes, along

    def _curvature(self, inflate: float = 1.0) -> Array:
        """(k, k) of data (so many times) and priors."""
        priors = np.diag(np.maximum(prior_weights(self.coordinates), 1e-6))
        return np.asarray(inflate * (self.jacobian.T @ self.jacobian) + priors, dtype=np.float64)

    def sd(self, inflate: float = 1.0) -> Array:
        """Standard deviations (k,) of z, see covariance."""
        return np.sqrt(np.diag(self.covariance(inflate)))


def prior_weights(coordinates: Sequence[Coordinate]) -> Array:
    """(k,) 1 for each coordinate with a prior, 0 for the free ones."""
    return np.array([1.0 if c.prior else 0.0 for c in coordinates])


ROUGHNESS = 20.0
"""Least change of the whitened prediction (root of the sum of squares) by which a derivative along a strength is taken.
A simulation with dry friction is rough: a change by next to nothing already moves the prediction by about 1."""

INSTEAD = (-1.0, 0.125, -0.125)
"""Steps of a derivative, as parts of the usual one, that are tried one after another where the simulation diverges."""

WIDEST = 1.0
WIDEST_LOG = 10.0
"""Longest step of a derivative: along a strength in typical values, and for the logarithm of a shape in usual steps."""


def longest_step(c: Coordinate, z: float) -> float:
    """Longest step along a coordinate of which a secant may still be a derivative."""
    if c.prior:
        return 1.0
    return WIDEST_LOG * abs(c.inside_step(z)) if c.log else WIDEST


def smooth_step(c: Coordinate, z: float, derivative: Array) -> float:
    """Step along a coordinate with this derivative, long enough for the simulation's roughness if it is a strength."""
    usual = abs(c.inside_step(z))
    if c.prior or c.log:
        return usual
    return max(usual, min(ROUGHNESS / max(float(np.linalg.norm(derivative)), 1e-12), WIDEST))


def finite_differences(
    problem: Problem,
    model: Model,
    coordinates: Sequence[Coordinate],
    z: Array,
    residual: Array,
    columns: Sequence[int],
    steps: dict[str, float] | None = None,
) -> Array:
    """Derivatives (size, len(columns)) of the whitened residual, one simulation each; steps stay inside the bounds.

    steps   step by coordinate name, the coordinate's own if it is not there; a longer one is put in where the change
            was too small for the simulation's roughness
    Where a simulation diverges, the other direction is tried, then shorter steps; what diverges all around has a
    derivative of zero.
    """
    out = np.empty((residual.size, len(columns)))
    steps = {} if steps is None else steps
    values = values_at(coordinates, z)

    def derivative(c: Coordinate, here: float) -> tuple[Array, float]:
        whole, (low, high) = c.inside_step(here, steps.get(c.name)), c.bounds
        for step in (whole, *(part * whole for part in INSTEAD)):
            if low <= here + step <= high:
                failures = problem.failures
                moved = problem.residual(model, {**values, c.name: c.value(here + step)})
                if problem.failures == failures:
                    return (moved - residual) / step, abs(step)
        return np.zeros(residual.size), np.inf

    for k, j in enumerate(columns):
        c, here = coordinates[j], float(z[j])
        out[:, k], step = derivative(c, here)
        longer = smooth_step(c, here, out[:, k])
        if longer > 2.0 * step:
            failures, short = problem.failures, out[:, k].copy()
            steps[c.name] = longer
            out[:, k], _ = derivative(c, here)
            if problem.failures > failures:
                steps[c.name], out[:, k] = step, short
    return out


def spread(found: Fit) -> dict[str, float]:
    """Step of the derivative by each coordinate: its standard deviation, but at least the usual step.

    In the derivative by a small step, the simulation's roughness looks like a difference between parameters that act
    alike (a glove's stiffness and the hand's own): fits stop half way along the valley between them, and intervals come
    out too narrow.
    """
    out = {}
    for j, (c, z, sd) in enumerate(zip(found.coordinates, found.z, found.sd(), strict=True)):
        least = smooth_step(c, float(z), found.jacobian[:, j])
        out[c.name] = max(min(float(sd), longest_step(c, float(z))), least)
    return out


KEPT = 0.6
MISSED = 0.02
"""Derivatives are taken anew after a step that lowered the cost by less than this part of what they promised, or that
missed the residual that they promised by this part of its squares: far from the end, what was learned in one place
leads astray in the next."""

TAUGHT = 0.5
"""Part of what a step missed that the derivatives learn: some of it is roughness, and bends."""

LEAST_GAIN = 0.1
LITTLE_GAIN = 1e-3
"""By how much a fit must lower its cost after its derivatives were found, or it ends: a small part of the likelihood's
own width, or this part of what noise does not explain."""

PATIENCE = 3.0
"""A search that is not worth it ends where so many more falls like the last one, of what it promises, would not do."""


OFF_BOUND = 0.02
"""Standard deviations from its bound at which a nuisance parameter starts: on the bound the first dozen steps would all
be cut short by it."""


FACTOR_PARTS = (1.0, 0.5, 0.25)
"""Of the way to the factor on all forces that the priors like best: what is held fixed may tell a little of it."""

UNSEEN = 1e-3
"""Where only a part of the features takes part in a fit: weight with which a strength or a shape without a prior is
drawn to where it vanishes, or is typical.  Else what that part does not show of it would stay at the start, which may
have been fitted to the rest."""


class Derivatives:
    """Derivatives (size, k) of the whitened residual along the way of a fit.

    By finite differences where the fit starts, and again after a step that led elsewhere than they promised.  Between,
    each step s, which changed the residual by d, teaches them half of what they missed (Broyden 1965, in the metric of
    the data): J += (d - J s) (J s)^T J / (2 |J s|^2).  What moves the data alike is changed alike, and what moves
    nothing together still does.

    known   derivatives by coordinate name with which to begin; these are only taught
    steps   of the finite differences, by coordinate name
    cost    of a whitened residual (size,) at a point z (k,)
    use     (size,) features that take part: what the others show teaches nothing
    most    derivatives that are taken by finite differences at most, but for the first ones
    taken   how many were
    fresh   True where none was taught since
    """

    def __init__(
        self,
        problem: Problem,
        model: Model,
        coordinates: Sequence[Coordinate],
        known: Mapping[str, Array],
        steps: Mapping[str, float],
        cost: Callable[[Array, Array], float],
        use: Mask,
        most: int,
    ) -> None:
        self.problem, self.model, self.coordinates = problem, model, coordinates
        self.steps, self.cost, self.use, self.most = dict(steps), cost, use, most
        self.unknown = [j for j, c in enumerate(coordinates) if c.name not in known]
        self.jacobian = np.column_stack(
            [known.get(c.name, np.zeros(problem.features.size)) for c in coordinates]
        )
        self.z, self.residual = np.zeros(0), np.zeros(0)
        self.fresh, self.taken = False, 0

    def forget(self) -> None:
        """Take those that are not known by finite differences next time."""
        self.z = np.zeros(0)

    def at(self, z: Array, residual: Array) -> Array:
        """The derivatives at a point z (k,), with the residual (size,) there."""
        move = z - self.z if self.z.size else None
        if move is None or not self._promised(move, z, residual):
            self.taken += len(self.unknown)
            self.jacobian = self.jacobian.copy()
            self.jacobian[:, self.unknown] = finite_differences(
                self.problem, self.model, self.coordinates, z, residual, self.unknown, self.steps
            )
            self.fresh = True
        elif move.any():
            change, along = residual - self.residual, self.jacobian @ move
            part = np.where(self.use, along, 0.0)
            whole = float(part @ part)
            # What a short step missed is the simulation's roughness.
            if whole > 0.0 and np.linalg.norm(change[self.use]) > ROUGHNESS:
                missed = TAUGHT * (change - along) / whole
                self.jacobian = self.jacobian + np.outer(missed, part @ self.jacobian)
            self.fresh = False
        self.z, self.residual = z.copy(), residual
        return self.jacobian

    def _promised(self, move: Array, z: Array, residual: Array) -> bool:
        """Whether a step led about where the derivatives promised, or none may be taken any more."""
        if not self.unknown or self.taken + len(self.unknown) > self.most:
            return True
        promised = self.residual + self.jacobian @ move
        was, made, hoped = (
            self.cost(r, at) for r, at in ((self.residual, self.z), (residual, z), (promised, z))
        )
        missed = self.cost(residual - promised, np.zeros(z.size))
        return was - made >= KEPT * (was - hoped) and missed <= MISSED * made


class _NotWorth(Exception):
    """A search that leads to no cost that is worth its time."""


def linear_minimum(jacobian: Array, residual: Array, z: Array, prior: Array) -> tuple[float, Array]:
    """Least cost along the straight lines (jacobian (n, k) at z (k,)) with the priors (k,), and where it is (k,)."""
    weight = np.diag(np.maximum(prior, 1e-9))
    step = -np.linalg.lstsq(jacobian.T @ jacobian + weight, jacobian.T @ residual + prior * z, rcond=None)[0]
    left, there = residual + jacobian @ step, z + step
    return float(left @ left + (prior * there) @ (prior * there)), there


@dataclass
class _Objective:
    """What a fit lowers: whitened residual (size,) and priors at a point z (k,).

    use     (size,) features that take part
    priors  (k,) weights of z
    """

    problem: Problem
    model: Model
    coordinates: tuple[Coordinate, ...]
    use: Mask
    priors: Array
    kept: dict[bytes, Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls, problem: Problem, model: Model, coordinates: tuple[Coordinate, ...], rows: Mask | None
    ) -> _Objective:
        """Of all features, or of some (see UNSEEN)."""
        priors = prior_weights(coordinates)
        if rows is None:
            return cls(problem, model, coordinates, np.ones(problem.features.size, dtype=bool), priors)
        return cls(problem, model, coordinates, rows, np.maximum(priors, UNSEEN))

    def residual(self, z: Array) -> Array:
        """Whitened residual (size,) of all features; the last ones are kept."""
        key = z.tobytes()
        if key not in self.kept:
            if len(self.kept) > 4:
                self.kept.clear()
            self.kept[key] = self.problem.residual(self.model, values_at(self.coordinates, z))
        return self.kept[key]

    def misfit(self, r: Array) -> float:
        return float(r[self.use] @ r[self.use])

    def cost(self, r: Array, z: Array) -> float:
        return self.misfit(r) + self.penalty(z)

    def penalty(self, z: Array) -> float:
        """What the priors ask for a point."""
        return float((self.priors * z) @ (self.priors * z))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (k,) of z."""
        low, high = np.array([c.bounds for c in self.coordinates]).reshape(-1, 2).T
        return low, high

    def inside(self, z: Array) -> Array:
        """The point a little inside its bounds."""
        (low, high), own = self.bounds, prior_weights(self.coordinates) > 0.0
        edge = np.where(own, OFF_BOUND, 1e-9)
        return np.clip(z, low + edge, high - edge)


def fit(
    problem: Problem,
    model: Model,
    coordinates: Sequence[Coordinate],
    start: Mapping[str, float] | Array,
    *,
    rows: Mask | None = None,
    known: Mapping[str, Array] | None = None,
    steps: Mapping[str, float] | None = None,
    evaluations: int = 12,
    little: float = LITTLE_GAIN,
    exact: bool = False,
    worth: float = np.inf,
) -> Fit:
    """Least squares over z from `start` (z by name, others 0).

    rows         features that take part; None: all (see UNSEEN)
    known        derivatives (size,) by coordinate name with which to begin; the others are found by finite differences,
                 see Derivatives
    steps        of the finite differences, see there
    evaluations  limit on the simulations, in those of a step for which all derivatives are found
    little       see LITTLE_GAIN
    exact        the derivatives at the end are found by finite differences there, for intervals
    worth        a search ends early where the straight lines lead to no cost below this, have little left to gain, and
                 promise much the same as a step ago
    """
    coordinates, known = tuple(coordinates), known or {}
    objective = _Objective.of(problem, model, coordinates, rows)
    if not coordinates:
        r = problem.residual(model, {})
        return Fit(model, (), np.zeros(0), objective.misfit(r), r, np.zeros((r.size, 0)))
    if isinstance(start, Mapping):
        start = np.array([start.get(c.name, 0.0) for c in coordinates])
    most = evaluations * (1 + sum(c.name not in known for c in coordinates))
    derivatives = Derivatives(
        problem, model, coordinates, known, steps or {}, objective.cost, objective.use, most
    )
    z, complete = _descend(objective, derivatives, objective.inside(start), little, worth)
    if rows is not None:
        z = _unseen_at_rest(objective, derivatives, z)
    if complete:
        z = _at_the_liked_factor(objective, z)
    r = objective.residual(z)
    if exact and not derivatives.fresh:
        derivatives.forget()
    jacobian = derivatives.at(z, r)
    return Fit(model, coordinates, z, objective.cost(r, z), r, jacobian, complete)


def _descend(
    objective: _Objective, derivatives: Derivatives, z: Array, little: float, worth: float
) -> tuple[Array, bool]:
    """Where least squares end from a point z (k,), and True; or where they were found not worth it, and False."""
    use, priors, promised = objective.use, objective.priors, list[float]()

    def jacobian_of(z: Array) -> Array:
        r = objective.residual(z)
        jacobian = derivatives.at(z, r)[use]
        if worth < np.inf:
            promised.append(linear_minimum(jacobian, r[use], z, priors)[0])
            short = promised[-1] - worth
            to_gain = objective.cost(r, z) - promised[-1]
            if len(promised) > 1 and short > max(to_gain, PATIENCE * abs(promised[-2] - promised[-1])):
                raise _NotWorth
        return np.vstack([jacobian, np.diag(priors)])

    simulated, samples = 0, int(np.count_nonzero(use))
    try:
        while True:
            found = least_squares(
                lambda z: np.concatenate([objective.residual(z)[use], priors * z]),
                z,
                jac=jacobian_of,
                bounds=objective.bounds,
                method="trf",
                max_nfev=max(1, derivatives.most - derivatives.taken - simulated),
                ftol=1e-5,
                xtol=1e-5,
                gtol=1e-8,
                x_scale=1.0,
            )
            gain = objective.cost(objective.residual(z), z) - 2.0 * found.cost
            z, simulated = found.x, simulated + found.nfev
            if (
                simulated + derivatives.taken >= derivatives.most
                or derivatives.fresh
                or gain < max(LEAST_GAIN, little * (2.0 * found.cost - samples))
            ):
                return z, True
            derivatives.forget()
    except _NotWorth:
        return derivatives.z, False


def _unseen_at_rest(objective: _Objective, derivatives: Derivatives, z: Array) -> Array:
    """The point with what the features that take part do not show put where it vanishes, is typical, or is expected
    (see UNSEEN): what is drawn by so little may not arrive before a fit ends, nor by a prior where much is left."""
    moves = np.linalg.norm(derivatives.at(z, objective.residual(z))[objective.use], axis=0)
    return np.where((moves <= UNSEEN) & (z != 0.0), objective.inside(np.zeros(z.size)), z)


def _at_the_liked_factor(objective: _Objective, z: Array) -> Array:
    """The point with all forces by the factor that the priors like best, where the data do not tell it (see Forces).

    What the data tell of it, one way or the other (or by the roughness of a bad fit), is for the search.
    """
    forces = Forces(objective.coordinates, z, scaling(objective.problem, objective.model))
    whole, misfit = forces.likeliest(objective.priors), objective.misfit(objective.residual(z))
    for part in FACTOR_PARTS:
        other = objective.inside(forces.scaled(part * whole))
        gain = objective.penalty(z) - objective.penalty(other)
        if gain <= LEAST_GAIN:  # not worth a simulation
            break
        if abs(objective.misfit(objective.residual(other)) - misfit) < gain:
            return other
    return z


def nuisance_table(
    found: Fit, intervals: Mapping[str, tuple[float, float]] | None = None
) -> dict[str, dict[str, Any]]:
    """The nuisance parameters of a fit by name: value and nominal in their unit, and the difference in standard
    deviations of the prior (`prior_sds`); with intervals their ends, else NaN.  Not those that move nothing."""
    out: dict[str, dict[str, Any]] = {}
    unmoved = found.unmoved
    for c, z in zip(found.coordinates, found.z, strict=True):
        if c.nuisance and c.name not in unmoved:
            low, high = (intervals or {}).get(c.name, (math.nan, math.nan))
            value, nominal = c.value(float(z)), c.value(0.0)
            out[c.name] = {"value": value, "nominal": nominal, "prior_sds": float(z)}
            out[c.name] |= {"low": low, "high": high, "unit": c.unit}
    return out

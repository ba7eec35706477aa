"""Named parameters of a model identified from whitened residuals, with intervals.

    z* = argmin |r(z)|^2 + |z|^2        r: whitened residual (Problem or TargetProblem); z: standard deviations
                                        from the prior's mean, inside the bounds

from several starts; intervals from the curvature at the best.  What is held is not exact: a held parameter that is one
standard deviation of its tolerance away moves the estimate by a column of

    G = (J^T J + 1)^-1 J^T H        J, H: derivatives of the residual by the free and by the held parameters

so that the covariance of the estimate is that of the fit plus G G^T.  A parameter whose interval is hardly narrower
than its prior is not identified by the data; of two whose effects on the data are nearly proportional only one
combination is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import with_unit
from hannes_description.parameters import data_path, read_yaml
from numpy.typing import NDArray

from .fit import Fit, finite_differences, fit
from .problem import Coordinate, Problem

Array = NDArray[np.float64]

DEFAULT_SD = 0.3
"""Prior standard deviation of a free parameter without one of its own: of its logarithm, or of its bounds' span."""

WIDEN = 3.0
"""A freed parameter may lie this many times farther from nominal than the population's tolerance says."""

UNIDENTIFIED = 0.7
"""Posterior over prior standard deviation above which the data say next to nothing."""

CONFOUNDED = 0.95
"""Correlation of two parameters' posterior, priors aside, above which they cannot be told apart."""

ON_BOUND = 0.01
"""Of the distance between the bounds (on the parameter's own scale): nearer than this is on the bound."""

SPREAD = 0.5
"""Scatter of the further starts, in prior standard deviations."""

RESTARTS = 2
"""How often a search goes on from its own end at most."""

STEP = 0.02
"""Finite-difference step: of the logarithm, or of the prior's standard deviation."""


class Residuals(Protocol):
    """What is fitted: `features.size` whitened residuals of a model with some values (Problem is one)."""

    @property
    def features(self) -> Any: ...

    def residual(self, model: Model, values: Mapping[str, float]) -> Array: ...


@dataclass(frozen=True)
class Identified:
    """One calibrated parameter.

    low, high   95 % interval, with the tolerances of what is held
    narrowing   standard deviation of the estimate over that of the prior
    identified  the data narrowed it and nothing else can take its place
    confounded  the parameter that it cannot be told apart from, with their correlation
    at_bound    the best value lies on a bound
    held        the held parameter whose tolerance widens the interval most, with its share of the variance
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    narrowing: float
    identified: bool
    confounded: str | None = None
    correlation: float = 0.0
    at_bound: bool = False
    held: str | None = None
    held_share: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        return self.__dict__.copy()


@dataclass(frozen=True)
class Calibration:
    """What a calibration found.

    costs    least-squares cost of every start's end, best first; agree: how many ended as well as the best
    errors   training and held-out error in multiples of the repeatability (recordings), before and after
    """

    model: Model
    parameters: tuple[Identified, ...]
    costs: tuple[float, ...]
    agree: int
    errors: Mapping[str, float]
    warnings: tuple[str, ...]
    simulations: int
    from_cache: int
    best: Fit = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        return {
            "model": {"name": self.model.name, "sha256": self.model.sha256},
            "parameters": [p.to_dict() for p in self.parameters],
            "costs": list(self.costs),
            "agree": self.agree,
            "errors": dict(self.errors),
            "warnings": list(self.warnings),
            "simulations": self.simulations,
            "from_cache": self.from_cache,
        }


def free_coordinates(
    model: Model, names: Sequence[str], sds: Mapping[str, float] | None = None
) -> list[Coordinate]:
    """Coordinates of named parameters of a model or of its effects, with bounds and priors.

    sds  prior standard deviation by name: of the logarithm for positive parameters, else in the parameter's unit
    Raises HannesError for unknown or repeated names.
    """
    if not names:
        raise HannesError("Nothing is free: give --free NAME,NAME (see `hannes model show` for the names).")
    twice = sorted({n for n in names if list(names).count(n) > 1})
    if twice:
        raise HannesError(f"--free names {', '.join(twice)} twice.")
    table = read_yaml(data_path("parameters", "population.yaml"), "population file")
    out = []
    for name in names:
        p = model.named(name)
        log = p.lower >= 0.0 and p.value > 0.0
        sd = (sds or {}).get(name)
        if sd is None:
            known = table.get(name)
            sd = (
                WIDEN * float(known["hand_sd"])
                if known and log
                else DEFAULT_SD * (1.0 if log else p.upper - p.lower)
            )
        if not (math.isfinite(sd) and sd > 0.0):
            raise HannesError(f"The prior of '{name}' has the standard deviation {sd}; it must be positive.")
        out.append(
            Coordinate(
                name,
                p.value,
                sd,
                log,
                max(p.lower, 1e-3 * p.value) if log else p.lower,
                p.upper,
                True,
                STEP / sd if log else STEP,
                p.unit,
            )
        )
    return out


def search(
    problem: Residuals,
    model: Model,
    coordinates: Sequence[Coordinate],
    *,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 15,
    first: Mapping[str, float] | None = None,
    announce: Callable[[int, int], None] | None = None,
) -> list[Fit]:
    """Fits from the nominal point (or `first`, z by name) and from points drawn from the priors, best first.

    Dry friction makes the figures a little rough, on which a search may stop short; so each goes on from its end with a
    new trust region until that gains nothing.
    """
    if starts < 1:
        raise HannesError(f"A calibration needs at least one start, not {starts}.")
    rng = np.random.default_rng(seed)
    begin = np.array([(first or {}).get(c.name, 0.0) for c in coordinates])
    found = []
    for k in range(starts):
        if announce is not None:
            announce(k, starts)
        z = begin if k == 0 else begin + SPREAD * np.clip(rng.standard_normal(len(coordinates)), -1.5, 1.5)
        best = fit(cast(Problem, problem), model, coordinates, z, evaluations=evaluations, exact=True)
        for _ in range(RESTARTS):
            again = fit(
                cast(Problem, problem), model, coordinates, best.z, evaluations=evaluations, exact=True
            )
            gain = best.cost - again.cost
            best = min(best, again, key=lambda f: f.cost)
            if gain < _close(best.cost):
                break
        found.append(best)
    return sorted(found, key=lambda f: f.cost)


def _close(cost: float) -> float:
    """Difference of two costs that says nothing: 1 % of the cost, or half of one standard deviation of the data."""
    return max(0.01 * cost, 0.5)


def agreeing(costs: Sequence[float]) -> int:
    """How many starts ended as well as the best, which comes first."""
    return sum(c <= costs[0] + _close(costs[0]) for c in costs)


def held_coordinates(model: Model, free: Sequence[str]) -> list[Coordinate]:
    """The parameters of the model that the population's tolerances speak of and that are not free."""
    out = []
    for name, entry in read_yaml(data_path("parameters", "population.yaml"), "population file").items():
        if name in free or name not in model.parameters or model.parameters.value(name) <= 0.0:
            continue
        out.append(
            Coordinate(
                name,
                model.parameters.value(name),
                float(entry["hand_sd"]),
                entry["unit"] == "1",
                -math.inf,
                math.inf,
                True,
                0.5,
                model.parameters[name].unit,
            )
        )
    return out


def sensitivities(problem: Residuals, best: Fit, held: Sequence[Coordinate]) -> Array:
    """Derivatives (n, len(held)) of the residual at the best point by held parameters, in their standard deviations."""
    k = len(best.coordinates)
    return finite_differences(
        cast(Problem, problem),
        best.model,
        [*best.coordinates, *held],
        np.concatenate([best.z, np.zeros(len(held))]),
        best.residual,
        range(k, k + len(held)),
    )


def identify(
    best: Fit, free: Sequence[str], held: Sequence[Coordinate] = (), by_held: Array | None = None
) -> tuple[Identified, ...]:
    """Intervals of the free parameters and what the data cannot tell, from the curvature at the best point.

    held, by_held  parameters that were held, and the residual's derivatives (n, len(held)) by them (`sensitivities`)

    The covariance of the residual is taken as 1 or, where there are more data than parameters and the misfit is
    larger than that and than what the held parameters' tolerances explain, inflated to it.
    """
    n, k = best.residual.size, len(best.coordinates)
    moved = np.zeros((n, 0)) if by_held is None else by_held
    along = moved.T @ best.residual
    # r^T (1 + H H^T)^-1 r by Woodbury's formula
    explained = (
        along @ np.linalg.solve(np.eye(moved.shape[1]) + moved.T @ moved, along) if along.size else 0.0
    )
    inflate = max(1.0, (best.misfit - float(explained)) / (n - k)) if n > k else 1.0
    fitted = best.covariance(inflate)
    shift = best.covariance() @ best.jacobian.T @ moved
    posterior = fitted + shift @ shift.T
    information = best.jacobian.T @ best.jacobian
    # Without priors; a hair of regularisation keeps what is not seen at all finite.
    alone = np.linalg.pinv(information + 1e-9 * np.eye(k) * max(1.0, float(np.trace(information))))
    spread = np.sqrt(np.maximum(np.diag(alone), 1e-300))
    correlation = alone / np.outer(spread, spread)
    out = []
    for j, c in enumerate(best.coordinates):
        if c.name not in free:
            continue
        sd = math.sqrt(max(float(posterior[j, j]), 0.0))
        z = float(best.z[j])
        low, high = sorted((c.value(z - 1.96 * sd), c.value(z + 1.96 * sd)))
        others = np.abs(np.where(np.arange(k) == j, 0.0, correlation[j]))
        other = int(np.argmax(others)) if k > 1 else -1
        partner = best.coordinates[other].name if other >= 0 and others[other] > CONFOUNDED else None
        lower, upper = c.bounds
        near = ON_BOUND * min(upper - lower, 1.0)
        bound = bool(min(abs(z - lower), abs(upper - z)) < near)
        seen = sd <= UNIDENTIFIED
        widest = int(np.argmax(np.abs(shift[j]))) if shift.shape[1] else -1
        out.append(
            Identified(
                c.name,
                c.unit,
                c.value(z),
                low,
                high,
                sd,
                seen and partner is None and not bound,
                partner,
                float(correlation[j, other]) if other >= 0 else 0.0,
                bound,
                held[widest].name if widest >= 0 else None,
                float(shift[j, widest] ** 2 / max(posterior[j, j], 1e-300)) if widest >= 0 else 0.0,
            )
        )
    return tuple(out)


def warnings_of(parameters: Sequence[Identified], free_count: int, data_count: int) -> list[str]:
    """What the user must know of parameters that the data do not identify."""
    out = []
    pairs: set[frozenset[str]] = set()
    for p in parameters:
        if p.narrowing > UNIDENTIFIED:
            by_held = p.held_share > 0.5
            width = (
                f"{100 * p.narrowing:.0f} % of the prior's"
                if p.narrowing < 1.0
                else "no narrower than the prior's"
            )
            out.append(
                f"{p.name} is not identified by these data: its interval is {width}"
                + (
                    f", most of it from the tolerance of {p.held}, which is held: measure {p.held}, or free it."
                    if by_held
                    else ", which decides much of its value"
                    + (f" (confounded with {p.confounded})." if p.confounded else ".")
                )
            )
        elif p.confounded and frozenset((p.name, p.confounded)) not in pairs:
            pairs.add(frozenset((p.name, p.confounded)))
            out.append(
                f"{p.name} and {p.confounded} cannot be told apart by these data (correlation "
                f"{p.correlation:+.3f}); only a combination of both is identified. Fix one of them."
            )
        if p.at_bound:
            out.append(
                f"{p.name} ends on its bound ({with_unit(p.value, p.unit)}); the model may lack something."
            )
    if free_count >= data_count:
        out.append(
            f"{free_count} free parameters for {data_count} figures: the priors fill in; reaching the figures "
            "is a calibration and proves nothing about the model."
        )
    return out


def calibrated_model(model: Model, parameters: Sequence[Identified], source: str) -> Model:
    """The model with the identified values, their intervals as bounds' comment in the source, status identified."""
    out, names = model, model.names
    for p in parameters:
        if p.name in names:
            interval = f"95 % {p.low:.4g} .. {p.high:.4g}"
            doubt = "" if p.identified else "; not identified alone"
            out = out.with_values(
                {p.name: p.value}, status="identified", source=f"{source}; {interval}{doubt}"
            )
    return out

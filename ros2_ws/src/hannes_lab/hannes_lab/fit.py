"""Maximum a posteriori fit of nuisance and effect parameters in closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from hannes_description.model import Model
from numpy.typing import NDArray
from scipy.optimize import least_squares

from .problem import Coordinate, Problem

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Fit:
    """A fitted point.

    z           (k,) coordinates; values: by name in their units
    cost        sum of squares of whitened residual and prior
    residual    (size,) whitened residual of all features, also of those that were held out
    jacobian    (size, k) derivative of the residual by z
    """

    model: Model
    coordinates: tuple[Coordinate, ...]
    z: Array
    cost: float
    residual: Array
    jacobian: Array

    @property
    def values(self) -> dict[str, float]:
        return {c.name: c.value(float(z)) for c, z in zip(self.coordinates, self.z, strict=True)}

    @property
    def misfit(self) -> float:
        """Sum of squares of the whitened residual alone."""
        return float(self.residual @ self.residual)

    def z_of(self, name: str) -> float | None:
        for c, z in zip(self.coordinates, self.z, strict=True):
            if c.name == name:
                return float(z)
        return None

    def covariance(self, inflate: float = 1.0) -> Array:
        """Covariance (k, k) of z from the curvature at the optimum, with the priors; pseudo-inverse where singular."""
        prior = np.diag([1.0 if c.prior else 1e-6 for c in self.coordinates])
        return np.asarray(np.linalg.pinv(self.jacobian.T @ self.jacobian + prior) * inflate, dtype=np.float64)


def finite_differences(
    problem: Problem,
    model: Model,
    coordinates: Sequence[Coordinate],
    z: Array,
    residual: Array,
    columns: Sequence[int],
) -> Array:
    """Derivatives (size, len(columns)) of the whitened residual, one simulation each; steps stay inside the bounds."""
    out = np.empty((residual.size, len(columns)))
    values = {c.name: c.value(float(v)) for c, v in zip(coordinates, z, strict=True)}
    for k, j in enumerate(columns):
        c = coordinates[j]
        step = c.inside_step(float(z[j]))
        moved = problem.residual(model, {**values, c.name: c.value(float(z[j] + step))})
        out[:, k] = (moved - residual) / step
    return out


def fit(
    problem: Problem,
    model: Model,
    coordinates: Sequence[Coordinate],
    start: Mapping[str, float] | Array,
    *,
    rows: Mask | None = None,
    known: Mapping[str, Array] | None = None,
    evaluations: int = 12,
) -> Fit:
    """Least squares over z from `start` (z by name, others 0).

    rows         features that take part; None: all
    known        derivatives (size,) by coordinate name that are taken as constant (those of nuisance parameters hardly
                 change); the others are found by finite differences at every step
    evaluations  limit on the steps of the trust-region search (scipy's trf)
    """
    coordinates = tuple(coordinates)
    known = known or {}
    z0 = (
        np.array([start.get(c.name, 0.0) for c in coordinates])
        if isinstance(start, Mapping)
        else np.array(start)
    )
    bounds = np.array([c.bounds for c in coordinates]).T if coordinates else np.zeros((2, 0))
    priors = np.array([1.0 if c.prior else 0.0 for c in coordinates])
    use = np.ones(problem.features.size, dtype=bool) if rows is None else rows
    cache: dict[bytes, Array] = {}

    def residual_at(z: Array) -> Array:
        key = z.tobytes()
        if key not in cache:
            if len(cache) > 4:
                cache.clear()
            cache[key] = problem.residual(
                model, {c.name: c.value(float(v)) for c, v in zip(coordinates, z, strict=True)}
            )
        return cache[key]

    last: dict[str, Array] = {}

    def jacobian_at(z: Array) -> Array:
        r = residual_at(z)
        full = np.empty((r.size, len(coordinates)))
        todo = []
        for j, c in enumerate(coordinates):
            if c.name in known:
                full[:, j] = known[c.name]
            else:
                todo.append(j)
        full[:, todo] = finite_differences(problem, model, coordinates, z, r, todo)
        last["jacobian"] = full
        last["z"] = z.copy()
        return full

    if not coordinates:
        r = problem.residual(model, {})
        return Fit(model, (), np.zeros(0), float(r[use] @ r[use]), r, np.zeros((r.size, 0)))
    inside = np.clip(z0, bounds[0] + 1e-9, bounds[1] - 1e-9)
    found = least_squares(
        lambda z: np.concatenate([residual_at(z)[use], priors * z]),
        inside,
        jac=lambda z: np.vstack([jacobian_at(z)[use], np.diag(priors)]),
        bounds=(bounds[0], bounds[1]),
        method="trf",
        max_nfev=evaluations,
        ftol=1e-5,
        xtol=1e-5,
        gtol=1e-8,
        x_scale=1.0,
    )
    z = found.x
    r = residual_at(z)
    jacobian = last["jacobian"] if "z" in last and np.allclose(last["z"], z, atol=0.2) else jacobian_at(z)
    return Fit(model, coordinates, z, float(r[use] @ r[use] + (priors * z) @ (priors * z)), r, jacobian)

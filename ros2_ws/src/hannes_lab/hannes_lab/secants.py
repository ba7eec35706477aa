"""Derivatives from which intervals are made: secants along the axes of the curvature.

Where a fit goes on, derivatives by single parameters serve.  What they leave of parameters that act together is the
small difference of large columns, and what bends or is rough in those makes a valley look narrow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .fit import ROUGHNESS, SINGULAR, Fit, longest_step
from .problem import Problem, values_at

Array = NDArray[np.float64]

TURNS = 4
SAME_SD = 0.1
"""How often derivatives are taken along the axes that they have themselves, at most, and the logarithm of the factor by
which no standard deviation changes any more."""

SHORTER = 4
"""Steps of a secant that are tried; one along which the data bend is too long."""

DIRECTIONS = 4
BESIDE = 0.25
"""In how many directions, and how far, in standard deviations, a fit's surroundings are looked at for jumps of the
misfit: near enough that it is a parabola but for those."""

LEAST_PART = 0.01
"""Part of a step that must be inside the bounds."""


def over_its_spread(problem: Problem, found: Fit) -> Fit:
    """The fit with derivatives as secants over what its parameters may be, for the covariance.

    They are taken along the principal axes of the curvature, each over its own standard deviation or what moves the
    prediction by ROUGHNESS, on both sides.  Along single parameters they would not do: where each by itself moves the
    data much and several together hardly (a torque constant, masses and frictions of a drive in volts), what bends or
    is rough in the single ones would be all that is seen of the whole.  The axes depend on the derivatives, so they are
    taken until the standard deviations stay.
    """
    if not found.coordinates:
        return found
    for _ in range(TURNS):
        before = found.sd()
        found = replace(found, jacobian=_along_its_axes(problem, found))
        if np.all(np.abs(np.log(np.maximum(found.sd(), 1e-300) / np.maximum(before, 1e-300))) < SAME_SD):
            break
    return found


def grain_of(problem: Problem, found: Fit) -> float:
    """Standard deviation of what the misfit jumps by from place to place beside a fit.

    A law that computes in whole numbers makes the misfit a staircase in all parameters at once, and a fit ends in a
    hole of it.  Of any parabola f(d) + f(-d) - 4 f(d / 2) - 4 f(-d / 2) + 6 f(0) is nought, and of jumps that know
    nothing of each other its variance is 1 + 1 + 16 + 16 + 36 times theirs.  Root mean square over DIRECTIONS; 0 where
    nothing can be moved.
    """
    if not found.coordinates:
        return 0.0
    low, high = np.array([c.bounds for c in found.coordinates]).T
    most = np.array([longest_step(c, float(z)) for c, z in zip(found.coordinates, found.z, strict=True)])
    room = np.clip(np.minimum(high - found.z, found.z - low), 0.0, most)
    sizes, axes = np.linalg.eigh(found.covariance())
    spread = axes * np.sqrt(np.maximum(sizes, 0.0))

    def misfit(z: Array) -> float:
        residual = problem.residual(found.model, values_at(found.coordinates, z))
        return float(residual @ residual)

    rng = np.random.default_rng(0)
    here, squares = misfit(found.z), []
    for _ in range(DIRECTIONS):
        step = BESIDE * np.clip(spread @ rng.standard_normal(found.z.size), -room, room)
        failures = problem.failures
        far, near = (misfit(found.z + part * step) + misfit(found.z - part * step) for part in (1.0, 0.5))
        if problem.failures == failures:
            squares.append((far - 4.0 * near + 6.0 * here) ** 2 / 70.0)
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _along_its_axes(problem: Problem, found: Fit) -> Array:
    """The derivatives (size, k) as secants along the principal axes of the curvature."""
    unit, sizes, along = found.principal_axes()
    axes = along / unit[:, None]
    seen = found.jacobian @ axes
    for k, axis in enumerate(axes.T):
        moved = float(np.linalg.norm(seen[:, k]))
        wanted = max(1.0 / np.sqrt(max(sizes[k], SINGULAR)), ROUGHNESS / max(moved, 1e-12))
        seen[:, k] = _secant(problem, found, axis, wanted, seen[:, k])
    turned: Array = seen @ (along.T * unit)
    return turned


def _secant(problem: Problem, found: Fit, axis: Array, wanted: float, otherwise: Array) -> Array:
    """Derivative (size,) along an axis (k,) over a step to both sides, shorter where it moves the data too far.

    A side beyond the bounds, or where the simulation diverges, is left out; where both are, it is `otherwise`.
    """
    low, high = np.array([c.bounds for c in found.coordinates]).T
    most = np.array([longest_step(c, float(z)) for c, z in zip(found.coordinates, found.z, strict=True)])
    size = np.maximum(np.abs(axis), 1e-300)
    step = min(wanted, float(np.min(most / size)))
    for _ in range(SHORTER):
        there = []
        for way in (-1.0, 1.0):
            room = float(np.min(np.where(way * axis > 0.0, high - found.z, found.z - low) / size))
            length, residual = way * min(step, max(room, 0.0)), found.residual
            failures = problem.failures
            if abs(length) >= LEAST_PART * step:
                z = found.z + length * axis
                residual = problem.residual(found.model, values_at(found.coordinates, z))
            if residual is found.residual or problem.failures > failures:
                length, residual = 0.0, found.residual
            there.append((length, residual))
        (before, first), (after, last) = there
        farthest = max(float(np.linalg.norm(r - found.residual)) for r in (first, last))
        if farthest <= 2.0 * ROUGHNESS:
            break
        step *= max(np.sqrt(ROUGHNESS / farthest), 0.1)
    return (last - first) / (after - before) if after > before else otherwise

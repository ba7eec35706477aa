"""A factor on all forces and masses of a machine, which a motion may not tell, nor a voltage."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from hannes_description.model import Model
from hannes_description.units import in_volts, tokens
from numpy.typing import NDArray

from .problem import Coordinate, Problem

Array = NDArray[np.float64]

FORCES = ("N.m", "N", "kg.m2", "kg")
"""Units of what a machine's forces and masses are in, which all scale together."""

CURRENTS = {"A": 1.0, "ohm": -1.0, "H": -1.0}
"""What scales with them where a voltage drives: the current does, and resistance and inductance the other way, so that
the voltage across them stays as it is; the constant of the motor, in N.m/A, is known by its back-EMF."""

NEWTON = 4
"""Steps to the factor on all forces that priors like best."""

FARTHEST = 2.0
"""Logarithm of the factor at most: a machine is not seven times another."""

ALONG = 1e-3
"""Step, of a logarithm, of a derivative of the priors along a factor on all forces."""


def scaling(problem: Problem, model: Model) -> dict[str, float]:
    """By unit the power with which a factor on all forces, that the signals may not tell, enters; empty where they do.

    A recorded current or force tells it where a voltage drives.
    """
    forces = dict.fromkeys(FORCES, 1.0)
    if not in_volts(model.parameters):
        return forces
    told = {part for unit in problem.features.units for part, _ in tokens(unit)}
    return {} if told & {"A", *FORCES} else forces | CURRENTS


class Forces:
    """A factor on all forces and masses of a point z (k,).

    Where the command is a current or a force, its constant, masses, frictions, weights and ripples are known by the
    motion up to that factor: only priors tell it.  Of a voltage's drive the resistance is too, where no current is
    recorded.  The derivatives, which the roughness of dry friction blurs, lead a fit a little along this valley, tell
    it that there it ends, and make it look narrow.

    scale  by unit the power with which the factor enters, see scaling
    """

    def __init__(self, coordinates: Sequence[Coordinate], z: Array, scale: Mapping[str, float]) -> None:
        self.coordinates, self.z = coordinates, z
        self.powers = {
            j: power
            for j, c in enumerate(coordinates)
            if (power := sum(n * scale.get(unit, 0.0) for unit, n in tokens(c.unit)))
        }

    def scaled(self, sigma: float) -> Array:
        """The point with all of them larger by the factor exp(sigma)."""
        moved = self.z.copy()
        for j, power in self.powers.items():
            c = self.coordinates[j]
            moved[j] = c.z(c.value(float(self.z[j])) * math.exp(power * sigma))
        return moved

    def direction(self, sigma: float = 0.0) -> Array:
        """Derivative (k,) of the point by the factor's logarithm."""
        away: Array = (self.scaled(sigma + ALONG) - self.scaled(sigma - ALONG)) / (2.0 * ALONG)
        return away

    def likeliest(self, priors: Array) -> float:
        """Logarithm of the factor that priors of these weights (k,) like best (Newton's method)."""
        sigma = 0.0
        for _ in range(NEWTON):
            slope = priors * self.direction(sigma)
            curvature = float(slope @ slope)
            if curvature == 0.0:
                return 0.0
            step = float(slope @ (priors * self.scaled(sigma))) / curvature
            sigma = min(max(sigma - step, -FARTHEST), FARTHEST)
        return sigma

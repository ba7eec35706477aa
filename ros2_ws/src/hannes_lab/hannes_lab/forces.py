"""A factor on all forces and masses of a machine, which a motion may not tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from hannes_description.units import tokens
from numpy.typing import NDArray

from .problem import Coordinate

Array = NDArray[np.float64]

FORCES = ("N.m", "N", "kg.m2", "kg")
"""Units of what a machine's forces and masses are in, which all scale together."""

NEWTON = 4
"""Steps to the factor on all forces that priors like best."""

FARTHEST = 2.0
"""Logarithm of the factor at most: a machine is not seven times another."""

ALONG = 1e-3
"""Step, of a logarithm, of a derivative of the priors along a factor on all forces."""


class Forces:
    """A factor on all forces and masses of a point z (k,).

    Where the command is a current or a force, its constant, masses, frictions, weights and ripples are known by the
    motion up to that factor: only priors tell it.  The derivatives, which the roughness of dry friction blurs, lead a
    fit a little along this valley, tell it that there it ends, and make it look narrow.
    """

    def __init__(self, coordinates: Sequence[Coordinate], z: Array) -> None:
        self.coordinates, self.z = coordinates, z
        self.powers = {
            j: power
            for j, c in enumerate(coordinates)
            if (power := sum(n for unit, n in tokens(c.unit) if unit in FORCES))
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

    def likeliest(self, priors: Array) -> Array:
        """The point (k,) with the factor that priors of these weights (k,) like best (Newton's method)."""
        sigma = 0.0
        for _ in range(NEWTON):
            slope = priors * self.direction(sigma)
            curvature = float(slope @ slope)
            if curvature == 0.0:
                return self.z
            step = float(slope @ (priors * self.scaled(sigma))) / curvature
            sigma = min(max(sigma - step, -FARTHEST), FARTHEST)
        return self.scaled(sigma)

"""Friction that differs between closing and opening."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import DAMPING, FRICTION, V


class DirectionDependentFriction(Effect):
    """Half the difference of dry and viscous friction between the two directions.

    Equation: F = F_0 + c sign(v), B = B_0 + b sign(v): c and b are added while closing and subtracted while
    opening; the sum with the nominal never becomes negative in the plant.
    Limits: a step at standstill.
    """

    name = "direction_dependent_friction"
    title = "direction-dependent friction"
    parameters = (
        EffectParameter("coulomb", "N.m", -0.05, 0.05, 0.005, 0.0, "half the difference of dry friction c"),
        EffectParameter(
            "viscous", "N.m.s/rad", -0.005, 0.005, 5e-4, 0.0, "half the difference of viscous friction b"
        ),
    )
    both_ways = True
    looks_like = "the current is too high in one direction and too low in the other"
    told_by = "closing and opening at two speeds, signed current"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        side = 1.0 if x[V] > 0.0 else -1.0 if x[V] < 0.0 else 0.0
        y[FRICTION] += p[0] * side
        y[DAMPING] += p[1] * side

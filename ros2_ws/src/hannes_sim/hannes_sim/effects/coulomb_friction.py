"""Dry friction of motor, gearbox and pulleys beyond the nominal."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import FRICTION


class CoulombFriction(Effect):
    """Torque of constant size against the motion of the motor side; sticks at rest.

    Equation: |tau| <= F, tau = -F sign(v) in motion (Coulomb), solved implicitly by the plant.
    Limits: no memory, no dependence on speed or load; those are effects of their own.
    """

    name = "coulomb_friction"
    title = "Coulomb friction"
    parameters = (EffectParameter("level", "N.m", 0.0, 0.2, 0.01, 0.0, "friction torque F"),)
    looks_like = (
        "the current is higher by the same amount at every speed, with a step where the motion reverses"
    )
    told_by = "two speeds and a slow reversal, with the current logged"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[FRICTION] += p[0]

"""Viscous friction of motor, gearbox and pulleys beyond the nominal."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import DAMPING


class ViscousFriction(Effect):
    """Torque B v against the motion of the motor side.

    Equation: tau = -B v (Newtonian lubrication).  Limits: real lubricants thin with heat and speed.
    """

    name = "viscous_friction"
    title = "viscous friction"
    parameters = (EffectParameter("coefficient", "N.m.s/rad", 0.0, 0.02, 1e-3, 0.0, "viscous coefficient B"),)
    looks_like = (
        "the current is higher in both directions in proportion to the speed; fast closures show it most"
    )
    told_by = "the same closure at two speeds, with the current logged"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[DAMPING] += p[0]

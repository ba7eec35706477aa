"""The cosmetic glove: an elastic skin that resists closing and hardens."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import LOAD_TORQUE, QL


class GloveStiffness(Effect):
    """Elastic torque against closing.

    Equation: tau = -(k ql + h ql^3); the linear part acts like the return springs, the cubic part hardens.
    Limits: no hysteresis (glove_hysteresis has it), no pretension at the open hand.
    """

    name = "glove_stiffness"
    title = "glove stiffness"
    parameters = (
        EffectParameter("stiffness", "N.m/rad", 0.0, 0.05, 0.002, 0.0, "linear part k"),
        EffectParameter("hardening", "N.m/rad3", 0.0, 5e-4, 5e-6, 0.0, "cubic part h"),
    )
    looks_like = (
        "the current grows with the closing angle, most at the end of the closure, and drives the opening"
    )
    told_by = "closures with and without the glove"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[LOAD_TORQUE] -= x[QL] * (p[0] + p[1] * x[QL] * x[QL])

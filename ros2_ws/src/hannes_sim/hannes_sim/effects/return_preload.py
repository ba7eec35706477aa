"""Shifted preload of the return springs."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import LOAD_TORQUE


class ReturnPreload(Effect):
    """A constant torque that opens the hand.

    Equation: tau = -M.
    Limits: the same at all angles; a changed spring rate looks like glove stiffness.
    """

    name = "return_preload"
    title = "return-spring preload shift"
    parameters = (EffectParameter("torque", "N.m", -0.05, 0.05, 0.01, 0.0, "added preload M at the pulley"),)
    looks_like = (
        "more current while closing and less braking while opening, the same at all angles and speeds"
    )
    told_by = "closing and opening at one slow speed, signed current"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[LOAD_TORQUE] -= p[0]

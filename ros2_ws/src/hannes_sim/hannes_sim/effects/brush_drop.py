"""Voltage drop of the brushes."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import BRUSH


class BrushDrop(Effect):
    """A nearly constant voltage against the current.

    Equation: u_b = V_b sign(i), |u_b| <= V_b at i = 0 (contact drop of carbon or metal brushes), solved implicitly.
    Limits: no dependence on speed or wear.
    """

    name = "brush_drop"
    title = "brush voltage drop"
    parameters = (EffectParameter("voltage", "V", 0.0, 2.0, 0.3, 0.0, "drop V_b"),)
    looks_like = "a step of the voltage where the current changes its sign"
    told_by = "slow motion with voltage and current logged"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[BRUSH] += p[0]

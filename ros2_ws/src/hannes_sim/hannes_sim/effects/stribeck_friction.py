"""Breakaway friction: dry friction that is larger at rest than in motion."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import FRICTION, V


class StribeckFriction(Effect):
    """Extra dry friction near standstill that fades with speed.

    Equation: F(v) = F_s exp(-(v / v_s)^2) beyond Coulomb (Stribeck; Armstrong-Helouvry, Dupont, Canudas de Wit 1994).
    Limits: no presliding displacement, no dwell-time dependence.
    """

    name = "stribeck_friction"
    title = "Stribeck (breakaway) friction"
    parameters = (
        EffectParameter("stiction", "N.m", 0.0, 0.2, 0.01, 0.0, "extra friction at rest F_s"),
        EffectParameter(
            "velocity", "rad/s", 0.05, 20.0, 1.0, None, "Stribeck velocity v_s", starts=(0.3, 1.0, 4.0)
        ),
    )
    looks_like = (
        "the start is late and jerky, the current peaks before the motion; slow motion sticks and slips"
    )
    told_by = "slow reversals: several starts from rest"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        u = x[V] / p[1]
        y[FRICTION] += p[0] * math.exp(-u * u)

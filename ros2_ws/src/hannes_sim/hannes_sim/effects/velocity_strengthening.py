"""Velocity strengthening: dry friction that is smaller near standstill than in motion."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import FRICTION, V


class VelocityStrengthening(Effect):
    """Dry friction that reaches its full value within a small speed from standstill, as in lubricated, rolling guides.

    Equation: F(v) = -F_w exp(-(v / v_w)^2) beside Coulomb: Stribeck's term with the other sign, for contacts whose
    friction strengthens with speed (Armstrong-Helouvry, Dupont, Canudas de Wit 1994).
    Limits: the whole dry friction is never less than zero; speeds v_w near those of the motion are viscous friction's.
    """

    name = "velocity_strengthening"
    title = "velocity strengthening of dry friction"
    parameters = (
        EffectParameter("level", "N.m", 0.0, 0.2, 0.01, 0.0, "dry friction F_w that is missing at rest"),
        EffectParameter(
            "velocity", "rad/s", 0.05, 2.0, 0.5, None, "speed v_w at which it comes", starts=(0.2, 1.0)
        ),
    )
    looks_like = (
        "the start and the turn are softer than dry friction makes them; no jump of the current at rest"
    )
    told_by = "slow reversals: several starts from rest"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        u = x[V] / p[1]
        y[FRICTION] -= p[0] * math.exp(-u * u)

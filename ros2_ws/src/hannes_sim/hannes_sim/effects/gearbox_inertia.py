"""Inertia of rotor and gearbox beyond the nominal."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import INERTIA


class GearboxInertia(Effect):
    """Inertia of the moving gear parts, referred to the pulley.

    Equation: (J + dJ) q'' = torque.  The thesis' model has no gearbox inertia.
    Limits: rigid; an elastic gearbox would show a resonance.
    """

    name = "gearbox_inertia"
    title = "rotor and gearbox inertia"
    parameters = (
        EffectParameter("inertia", "kg.m2", 0.0, 5e-3, 3e-4, 0.0, "added inertia dJ at the pulley"),
    )
    looks_like = "a larger current peak at the start and more overshoot; nothing changes at constant speed"
    told_by = "fast closures and reversals"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[INERTIA] += p[0]

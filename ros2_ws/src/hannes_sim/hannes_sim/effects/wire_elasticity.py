"""Elastic wire: compliance beyond the nominal."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import COMPLIANCE


class WireElasticity(Effect):
    """Compliance of the wire and of what holds it.

    Equation: 1/k = 1/k_0 + c.
    Limits: linear; polymer wires stiffen with load and creep.
    """

    name = "wire_elasticity"
    title = "wire elasticity"
    parameters = (EffectParameter("compliance", "rad/(N.m)", 0.0, 30.0, 2.0, 0.0, "added compliance c"),)
    looks_like = "the motor runs on while the grip builds up: a stiff object feels softer"
    told_by = "grasp of a stiff object at two currents"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[COMPLIANCE] += p[0]

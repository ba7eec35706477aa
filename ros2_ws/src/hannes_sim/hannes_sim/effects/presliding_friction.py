"""Presliding: dry friction that acts through elastic bristles before it slips."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import DT, FRICTION, TORQUE, V


class PreslidingFriction(Effect):
    """A part of the dry friction builds up over a short distance instead of at once.

    Equation: dz/dq = (sign(v) - z) / l (Dahl 1968, the bristle of LuGre without its velocity terms), torque -F z, and
    the same level F taken off the plant's dry friction, so that nothing changes while it slides.  Exact over a step
    of constant velocity: z -> sign + (z - sign) exp(-|dq| / l).  So l is what a reversal shows; friction of many
    contacts (Maxwell slip, Masing) builds up over half of it from rest.
    Limits: F beyond the plant's dry friction adds friction; no damping of the bristles, no dwell time.  In recordings
    of another machine a length below 0.1 % of the travel is told, but not named: every real friction sets in over some.
    """

    name = "presliding_friction"
    title = "presliding (elastic) friction"
    parameters = (
        EffectParameter("level", "N.m", 0.0, 0.2, 0.01, 0.0, "part F of the dry friction that is elastic"),
        EffectParameter(
            "length", "rad", 1e-3, 3.0, 0.05, None, "distance l of the build-up", starts=(0.005, 0.05, 0.5)
        ),
    )
    states = 1
    law_below = ("length", 1e-3)
    looks_like = "after a reversal the current rises over a distance, not at once; the start is soft"
    told_by = "small and slow reversals, with position and current logged fast"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        if x[V] != 0.0:
            side = 1.0 if x[V] > 0.0 else -1.0
            s[0] = side + (s[0] - side) * math.exp(-abs(x[V]) * x[DT] / p[1])
        y[FRICTION] -= p[0]
        y[TORQUE] -= p[0] * s[0]

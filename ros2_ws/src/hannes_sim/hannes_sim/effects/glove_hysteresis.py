"""Viscoelastic glove: a spring that relaxes (Maxwell element)."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import DT, LOAD_TORQUE, VL


class GloveHysteresis(Effect):
    """A Maxwell element (spring k in series with a damper) between hand and frame.

    Equation: d tau/dt = k ql' - tau / t_r, torque -tau on the hand; exact over a step for constant velocity.
    Limits: one relaxation time; linear.
    """

    name = "glove_hysteresis"
    title = "glove viscoelasticity (hysteresis)"
    parameters = (
        EffectParameter("stiffness", "N.m/rad", 0.0, 0.05, 0.004, 0.0, "spring k of the Maxwell element"),
        EffectParameter(
            "relaxation", "s", 0.02, 20.0, 0.5, None, "relaxation time t_r", starts=(0.1, 0.5, 3.0)
        ),
    )
    states = 3
    looks_like = "more current while closing, less while holding: the torque relaxes while the hand rests"
    told_by = "a closure held for several relaxation times, at two speeds"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        rate = x[DT] / p[1]
        if rate != s[1]:
            s[1], s[2] = rate, math.exp(-rate)  # once a run: it takes longer than the rest
        s[0] = s[0] * s[2] + p[0] * p[1] * (1.0 - s[2]) * x[VL]
        y[LOAD_TORQUE] -= s[0]

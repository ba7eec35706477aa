"""Torque ripple of motor and gearbox: periodic in the angle."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import TORQUE, Q


class Cogging(Effect):
    """A torque that is periodic in the motor side's angle.

    Equation: tau = a sin(2 pi q / P) + b cos(2 pi q / P), of no mean, with any phase at the encoder's zero.
    Limits: one harmonic; with a sampling of the current below its frequency it is seen through the position only.
    """

    name = "cogging"
    title = "cogging / gear ripple"
    parameters = (
        EffectParameter("sine", "N.m", -0.1, 0.1, 0.01, 0.0, "amplitude a"),
        EffectParameter("cosine", "N.m", -0.1, 0.1, 0.0, 0.0, "amplitude b"),
        EffectParameter(
            "period",
            "rad",
            0.05,
            30.0,
            6.283185307179586,
            None,
            "period P at the pulley",
            starts=(0.3306939635357677, 1.65, 3.14159265, 6.283185307179586, 23.876),
            period=True,
        ),
    )
    looks_like = "the current wobbles with the angle, at the same angles in every closure and at every speed"
    told_by = "slow closures, current logged fast"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        angle = 2.0 * math.pi * x[Q] / p[2]
        y[TORQUE] += p[0] * math.sin(angle) + p[1] * math.cos(angle)

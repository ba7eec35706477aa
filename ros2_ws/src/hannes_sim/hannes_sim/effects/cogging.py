"""Torque ripple of motor and gearbox: periodic in the angle."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import TORQUE, Q

USUAL, MOST = 0.2, 1.0
"""Of the ripple's first harmonic: how large its second and third usually are, and may be."""


def _of_the_first(name: str, description: str) -> EffectParameter:
    return EffectParameter(name, "1", -MOST, MOST, 0.0, None, description, sd=USUAL)


class Cogging(Effect):
    """A torque that is periodic in the motor side's angle.

    Equation: tau = A (sin x + s2 sin 2x + c2 cos 2x + s3 sin 3x + c3 cos 3x), of no mean, where A sin x =
    a sin(2 pi q / P) + b cos(2 pi q / P), added to the motor's torque: any phase at the encoder's zero, and a wave that
    need not be a sine.
    Limits: three harmonics; with a sampling of the current below its frequency it is seen through the position only.
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
        _of_the_first("second_sine", "s2, part of A"),
        _of_the_first("second_cosine", "c2, part of A"),
        _of_the_first("third_sine", "s3, part of A"),
        _of_the_first("third_cosine", "c3, part of A"),
    )
    looks_like = "the current wobbles with the angle, at the same angles in every closure and at every speed"
    told_by = "slow closures, current logged fast"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        angle = 2.0 * math.pi * x[Q] / p[2]
        amplitude = math.sqrt(p[0] * p[0] + p[1] * p[1])
        if amplitude > 0.0:
            # Once each: they take longer than the rest of a step.
            up, across = math.sin(angle), math.cos(angle)
            sine = (p[0] * up + p[1] * across) / amplitude
            cosine = (p[0] * across - p[1] * up) / amplitude
            second = p[3] * 2.0 * sine * cosine + p[4] * (1.0 - 2.0 * sine * sine)
            third = p[5] * sine * (3.0 - 4.0 * sine * sine) + p[6] * cosine * (4.0 * cosine * cosine - 3.0)
            y[TORQUE] += amplitude * (sine + second + third)

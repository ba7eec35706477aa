"""The encoder's magnet runs out of true."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import SENSE_POSITION, Q

ENCODER_RATIO = 3.8
"""rad of pulley per rad of encoder."""


class EncoderEccentricity(Effect):
    """An error of the measured position with the period of the encoder's turn.

    Equation: q_measured = q + a sin(q / n) + b (cos(q / n) - 1); n (ratio) = 3.8: one turn of the encoder is 3.8 turns
    of the pulley (P09).
    Limits: first harmonic only.
    """

    name = "encoder_eccentricity"
    title = "encoder eccentricity"
    parameters = (
        EffectParameter("sine", "rad", -0.5, 0.5, 0.05, 0.0, "amplitude a"),
        EffectParameter("cosine", "rad", -0.5, 0.5, 0.0, 0.0, "amplitude b"),
    )
    known = (
        EffectParameter(
            "ratio",
            "1",
            1e-6,
            1e6,
            ENCODER_RATIO,
            description="units of the position for 1 rad of the encoder",
        ),
    )
    looks_like = (
        "the current waves weakly and slowly with the angle, the same in every closure and at every speed; "
        "the loop makes the encoder follow, so that the measured position hardly shows it"
    )
    told_by = "slow closures to full travel; compare with the finger joints"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        angle = x[Q] / p[2]
        y[SENSE_POSITION] += p[0] * math.sin(angle) + p[1] * (math.cos(angle) - 1.0)

"""The encoder's zero is not at the open hand."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import SENSE_POSITION


class EncoderOffset(Effect):
    """A constant error of the measured position.

    Equation: q_measured = q + q_0.
    Limits: constant; changed by homing.
    """

    name = "encoder_offset"
    title = "encoder offset"
    parameters = (EffectParameter("offset", "rad", -2.0, 2.0, 0.3, 0.0, "zero error q_0"),)
    looks_like = "contact and end stops come at shifted encoder angles"
    told_by = "the encoder read before the controller is on; both end stops touched slowly, from both sides"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[SENSE_POSITION] += p[0]

"""Backlash between motor and encoder."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import SENSE_POSITION, Q


class GearBacklash(Effect):
    """The encoder follows the motor through a dead zone (play operator).

    Equation: z stays while |q - z| <= b/2 and follows at the flank otherwise; the encoder shows z (friction holds
    its shaft in the gap).
    Limits: no impact at the flanks; the load does not push the encoder's shaft through the gap.
    """

    name = "gear_backlash"
    title = "gear backlash"
    parameters = (EffectParameter("width", "rad", 0.0, 1.0, 0.1, 0.0, "dead zone b at the pulley"),)
    states = 1
    looks_like = "the measured position rests after every reversal while the motor already turns"
    told_by = "small reversals"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        half = 0.5 * p[0]
        if x[Q] > s[0] + half:
            s[0] = x[Q] - half
        elif x[Q] < s[0] - half:
            s[0] = x[Q] + half
        y[SENSE_POSITION] += s[0] - x[Q]

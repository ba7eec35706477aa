"""Backlash between motor and encoder."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import CURRENT, FRICTION, SENSE_POSITION, Q, V


class GearBacklash(Effect):
    """The encoder follows the motor through a dead zone (play operator).

    Equation: z stays while |q - z| <= b/2 and follows at the flank otherwise; the encoder shows z (friction holds
    its shaft in the gap).  Dry friction f of what is beyond the gap brakes the motor only at the flank that it pushes:
    in the gap, and away from a flank, f is taken off the plant's.
    Limits: no impact at the flanks, no inertia beyond the gap; the load does not push the encoder's shaft through it.
    """

    name = "gear_backlash"
    title = "gear backlash"
    parameters = (
        EffectParameter("width", "rad", 0.0, 1.0, 0.1, 0.0, "dead zone b at the pulley"),
        EffectParameter("beyond", "N.m", 0.0, 0.2, 0.0, None, "dry friction f beyond the gap", sd=0.01),
    )
    states = 1
    looks_like = "the measured position rests after every reversal while the motor already turns"
    told_by = "small reversals"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        half = 0.5 * p[0]
        side = x[V] if x[V] != 0.0 else x[CURRENT]
        pushing = False
        if x[Q] >= s[0] + half:
            s[0] = x[Q] - half
            pushing = side > 0.0
        elif x[Q] <= s[0] - half:
            s[0] = x[Q] + half
            pushing = side < 0.0
        y[SENSE_POSITION] += s[0] - x[Q]
        if p[0] > 0.0 and not pushing:
            y[FRICTION] -= p[1]

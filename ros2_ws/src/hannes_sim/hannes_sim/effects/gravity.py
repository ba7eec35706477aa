"""Weight of the fingers when the hand is not held as in the nominal pose."""

import math
from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import LOAD_TORQUE, QL

FINGER_PER_PULLEY = 0.098
"""rad of metacarpophalangeal flexion per rad of pulley."""


class Gravity(Effect):
    """Gravity torque of the fingers at the pulley.

    Equation: tau = -(g_c cos(a ql) + g_s sin(a ql)), a (turn) = 0.098 rad of finger per rad of pulley (82 degrees of
    MCP over 14.6 rad). g_c: palm down or up, g_s: fingers up or down.  A joint of another machine that carries an arm
    turns by 1 rad per rad of its position; the weight on an axis that goes up is g_c, with a turn of 0.
    Limits: all fingers as one pendulum; the MuJoCo plant has the real masses.
    """

    name = "gravity"
    title = "gravity and hand pose"
    parameters = (
        EffectParameter("cosine", "N.m", -0.05, 0.05, 0.005, 0.0, "torque g_c at position 0 (the open hand)"),
        EffectParameter("sine", "N.m", -0.05, 0.05, 0.0, 0.0, "torque g_s where it has turned by 90 degrees"),
    )
    known = (
        EffectParameter(
            "turn",
            "1",
            -1000.0,
            1000.0,
            FINGER_PER_PULLEY,
            description="rad by which what hangs turns for each unit of the position",
        ),
    )
    looks_like = "an offset of the current that changes slowly with the closing angle and turns with the hand"
    told_by = "the same closure in two poses of the hand"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        angle = p[2] * x[QL]
        y[LOAD_TORQUE] -= p[0] * math.cos(angle) + p[1] * math.sin(angle)

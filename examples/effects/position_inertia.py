"""An inertia that depends on the position (a crank, a linkage): an effect of one's own
(`--effect position_inertia.py:PositionInertia`).

Set INERTIA and PERIOD to what your machine may have: a crank has its turn, a flap on a link half of it.
"""

import math

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import INERTIA, TORQUE, Q, V

INERTIA_THERE, PERIOD = 0.01, 2.0 * math.pi
"""kg.m2 (kg on a linear rig) by which it swings about its mean, and rad (m) after which it is the same again."""


class PositionInertia(Effect):
    """What is moved counts more in some positions than in others.

    Equation: J(q) q'' + J'(q) q'^2 / 2 = torque (Lagrange), J(q) = J_0 + J_s sin(2 pi q / P) + J_c cos(2 pi q / P); J_0
    is the plant's own inertia.
    Limits: one harmonic; J(q) must stay above nought.
    """

    name = "position_inertia"
    title = "inertia that depends on the position"
    parameters = (
        EffectParameter(
            "sine", "kg.m2", -20 * INERTIA_THERE, 20 * INERTIA_THERE, INERTIA_THERE, 0.0, "part J_s"
        ),
        EffectParameter(
            "cosine", "kg.m2", -20 * INERTIA_THERE, 20 * INERTIA_THERE, INERTIA_THERE, 0.0, "part J_c"
        ),
        EffectParameter("period", "rad", 0.3 * PERIOD, 3.0 * PERIOD, PERIOD, None, "period P"),
    )
    looks_like = (
        "the current of starts and stops is larger in some places than in others; nothing at a steady creep"
    )
    told_by = "short fast moves that begin and end at different places"

    @staticmethod
    def contribute(x, p, s, y):
        k = 2.0 * math.pi / p[2]
        sine, cosine = math.sin(k * x[Q]), math.cos(k * x[Q])
        y[INERTIA] += p[0] * sine + p[1] * cosine
        y[TORQUE] -= 0.5 * k * (p[0] * cosine - p[1] * sine) * x[V] * x[V]

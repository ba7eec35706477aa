"""Friction that is larger at one place: an effect of one's own (`--effect local_friction.py:LocalFriction`).

Set PLACE and WIDTH to what your machine may have, in the unit of its position; a diagnosis that says "acts along or
against the motion by where it is, most at 0.38 m" gives the first.
"""

import math

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import FRICTION, Q

FRICTION_THERE, PLACE, WIDTH = 10.0, 0.38, 0.05
"""N.m (N on a linear rig), and rad (m) of the place and of how wide it is."""


class LocalFriction(Effect):
    """Dry friction that is added around one place of the way, whichever way it is passed.

    Equation: F(q) = F exp(-((q - q_0) / w)^2) beside the plant's own dry friction.
    Limits: one place; below 0 it is where the machine runs more easily, and the sum is never less than zero.
    """

    name = "local_friction"
    title = "friction at a place"
    parameters = (
        EffectParameter(
            "level", "N.m", -4 * FRICTION_THERE, 4 * FRICTION_THERE, FRICTION_THERE, 0.0, "dry friction F"
        ),
        EffectParameter("place", "rad", PLACE - 5 * WIDTH, PLACE + 5 * WIDTH, PLACE, None, "where q_0"),
        EffectParameter("width", "rad", 0.2 * WIDTH, 5 * WIDTH, WIDTH, None, "how far w it reaches"),
    )
    looks_like = "the current is larger against the motion at one place, both ways and at every speed"
    told_by = "slow moves over the whole way, there and back"

    @staticmethod
    def contribute(x, p, s, y):
        u = (x[Q] - p[1]) / p[2]
        y[FRICTION] += p[0] * math.exp(-u * u)

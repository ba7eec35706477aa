"""A torque at one place: an effect of one's own (`--effect local_torque.py:LocalTorque`).

Set PLACE and WIDTH to what your machine may have, in the unit of its position; a diagnosis that says "goes with the
position, most near 0.71 rad" gives the first.
"""

import math

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import TORQUE, Q

TORQUE_THERE, PLACE, WIDTH = 0.1, 0.7, 0.05
"""N.m (N on a linear rig), and rad (m) of the place and of how wide it is."""


class LocalTorque(Effect):
    """What pulls to one place from both sides (a detent, a magnet), or pushes away from it.

    Equation: T(q) = -T_0 u exp((1 - u^2) / 2), u = (q - q_0) / w: the force of a well of energy, largest at q_0 - w and
    q_0 + w, nothing at q_0 and far away.  It gives back what it takes: passing it costs nothing.
    Limits: one place; below 0 it is a hump that has to be overcome.
    """

    name = "local_torque"
    title = "torque at a place"
    parameters = (
        EffectParameter(
            "level", "N.m", -10 * TORQUE_THERE, 10 * TORQUE_THERE, TORQUE_THERE, 0.0, "largest torque T_0"
        ),
        EffectParameter("place", "rad", PLACE - 5 * WIDTH, PLACE + 5 * WIDTH, PLACE, None, "where q_0"),
        EffectParameter("width", "rad", 0.2 * WIDTH, 5 * WIDTH, WIDTH, None, "how far w it reaches"),
    )
    looks_like = "the current rises before one place and falls after it, the same way at every speed"
    told_by = "slow moves over the whole way, there and back"

    @staticmethod
    def contribute(x, p, s, y):
        u = (x[Q] - p[1]) / p[2]
        y[TORQUE] -= p[0] * u * math.exp(0.5 * (1.0 - u * u))

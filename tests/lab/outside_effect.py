"""A user's own effect with bounds in the units of one machine: a worn spot of a guide."""

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import TORQUE, Q


class Worn(Effect):
    """Equation: force = -k q near the origin."""

    name = "worn"
    title = "worn spot"
    parameters = (EffectParameter("stiffness", "N/m", 0.0, 80.0, 4.0, 0.0),)
    looks_like = "the force is too low near the origin"

    @staticmethod
    def contribute(x, p, s, y):
        y[TORQUE] -= p[0] * x[Q]

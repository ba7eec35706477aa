"""Friction that grows faster than the load: one of the laws that the opening slope of R12 is tried with.

Not in the catalogue: the thesis' figures do not tell it from other laws (`hypotheses.py`).
"""

from typing import Any

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import FRICTION, LOAD


class Binding(Effect):
    """Dry friction with the square of the transmitted torque: parts that bind as they bend under the load.

    Equation: F = c T^2
    Limits: one coefficient for gear, carts and pulleys; the torque of the last step.
    """

    name = "binding"
    title = "friction with the square of the load"
    parameters = (
        EffectParameter("coefficient", "1/(N.m)", 0.0, 20.0, 1.5, 0.0, "friction torque over torque squared"),
    )
    looks_like = "as load-dependent friction on a hard object, hardly anything on a soft one"
    told_by = "grasps of a stiff and of a soft object, closing and opening"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[FRICTION] += p[0] * x[LOAD] * x[LOAD]

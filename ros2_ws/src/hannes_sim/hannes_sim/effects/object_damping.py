"""A damped object: plush, foam."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import OBJECT_DAMPING


class ObjectDamping(Effect):
    """Damping of the grasped object beyond the nominal.

    Equation: tau = -c ql' in contact, pushing back only.
    Limits: linear; no slow recovery of the shape.
    """

    name = "object_damping"
    title = "object damping"
    parameters = (
        EffectParameter("coefficient", "N.m.s/rad", 0.0, 0.5, 0.02, 0.0, "damping c at the pulley"),
    )
    looks_like = "the current rises faster with speed during the grasp and falls at once when the hand holds"
    told_by = "the same object grasped at two speeds"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[OBJECT_DAMPING] += p[0]

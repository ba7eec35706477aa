"""Capstan friction: dry friction that grows with the tension of the wire."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import FRICTION, LOAD, LOAD_FRICTION


class LoadDependentFriction(Effect):
    """Friction of the wire over pulleys and guides in proportion to its tension.

    Equation: F = mu |T r| (Euler-Eytelwein for small wrap x friction: exp(mu a) - 1 ~ mu a), T r the transmitted
    torque; the part `share` of it holds the hand, beyond the wire, the rest the motor.
    Limits: one lumped coefficient for all pulleys; the tension of the last step.
    """

    name = "load_dependent_friction"
    title = "load-dependent (capstan) friction"
    parameters = (
        EffectParameter("coefficient", "1", 0.0, 1.0, 0.1, 0.0, "friction torque over transmitted torque"),
        EffectParameter(
            "share",
            "1",
            0.0,
            1.0,
            0.0,
            None,
            "part of it that acts on the hand's side of the wire",
            starts=(0.0, 1.0),
            part=True,
            beyond_wire=True,
        ),
    )
    looks_like = (
        "the current is higher while gripping and lower while letting go, in proportion to the "
        "load; nothing changes on void"
    )
    told_by = "grasp of a stiff object, closing and opening, current logged"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        friction = p[0] * abs(x[LOAD])
        y[FRICTION] += (1.0 - p[1]) * friction
        y[LOAD_FRICTION] += p[1] * friction

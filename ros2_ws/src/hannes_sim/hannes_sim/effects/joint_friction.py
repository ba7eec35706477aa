"""Dry friction of finger joints and cart guides beyond the nominal."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import LOAD_FRICTION


class JointFriction(Effect):
    """Torque of constant size against the motion of the hand, behind the wire.

    Equation: |tau| <= F (Coulomb) on the load side.  While the wire is taut it looks like friction of the motor
    side; while the hand opens, the springs must overcome it, so the wire goes slack earlier.
    Limits: one level for all joints.  The hand opens only while the springs overcome it and the hand's own friction: of
    the nominal one (hand.preload 0.0107 N.m, hand.coulomb 0.008 N.m) 0.01 N.m leave it more than 4 rad closed; place of
    object, slack and preload can hardly be told apart then.
    """

    name = "joint_friction"
    title = "Coulomb friction of joints and guides"
    parameters = (EffectParameter("level", "N.m", 0.0, 0.2, 0.01, 0.0, "friction torque F at the pulley"),)
    looks_like = "as Coulomb friction while closing, but the motor runs ahead of the hand while opening"
    told_by = "a slow opening with the finger joints or the grip force logged"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[LOAD_FRICTION] += p[0]

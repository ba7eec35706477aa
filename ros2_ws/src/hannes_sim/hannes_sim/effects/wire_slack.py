"""Loose wire on the pulley: turns that must be taken up before the wire pulls."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import SLACK


class WireSlack(Effect):
    """Free length of the wire in rad of pulley.

    Equation: tension = k max(0, q - ql - slack).  After the hand has reopened the wire lies loose on the pulley,
    so the motor turns by `slack` before the hand follows (the thesis names it as missing in its model).
    Limits: a constant slack; the winding of the loose turns is not modelled.
    """

    name = "wire_slack"
    title = "wire slack (loose turns)"
    parameters = (EffectParameter("slack", "rad", 0.0, 5.0, 0.5, 0.0, "free length of the wire"),)
    looks_like = "the current rises late when closing starts, the contact comes at a larger motor angle"
    told_by = (
        "small reversals near the open hand, grasp of a stiff object; against an encoder offset, only the encoder read "
        "before the controller is on"
    )

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[SLACK] += p[0]

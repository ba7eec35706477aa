"""The command acts late."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import DELAY


class CommandDelay(Effect):
    """Dead time between the controller's output and the motor's voltage.

    Equation: u_motor(t) = u(t - t_d), between two steps of the plant by a straight line.
    Limits: constant; jitter and lost messages are not modelled; at most 511 steps of the plant.
    """

    name = "command_delay"
    title = "command delay"
    parameters = (
        EffectParameter(
            "delay",
            "s",
            0.0,
            0.02,
            0.002,
            0.0,
            "dead time t_d",
            starts=tuple(0.00025 * k for k in range(1, 21)),
        ),
    )
    looks_like = "overshoot and ringing at sharp changes of the reference; little in slow motion"
    told_by = "fast closures and reversals"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[DELAY] += p[0]

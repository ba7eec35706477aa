"""The battery's voltage sags under load."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import RESISTANCE, RESISTANCE_REL, SUPPLY, VOLTAGE


class SupplySag(Effect):
    """Inner resistance of the battery and its leads, seen through the duty cycle.

    Equation: supply = V - R_s i d with duty d = u / V (the bridge draws i d from the battery), so u_motor = u -
    R_s i d^2: a resistance R_s d^2 in series with the motor's.
    Limits: no capacity or recovery effects; the logged voltage is duty x nominal supply and does not show the sag.
    """

    name = "supply_sag"
    title = "supply sag"
    parameters = (EffectParameter("resistance", "ohm", 0.0, 5.0, 0.5, 0.0, "inner resistance R_s"),)
    looks_like = "more duty for the same motion at high speed and high current"
    told_by = "log the supply; a fast closure against a stall at the same current"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        duty = x[VOLTAGE] / x[SUPPLY]
        y[RESISTANCE_REL] += p[0] * duty * duty / x[RESISTANCE]

"""The winding heats up: more resistance, weaker magnets."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import CURRENT, DT, KT_REL, RESISTANCE, RESISTANCE_REL

ALPHA = 0.0039  # 1/K, copper
BETA = 0.0011  # 1/K, magnets


class WindingHeating(Effect):
    """Copper resistance rises and the torque constant falls with the losses of the last minutes.

    Equation: t_w dT/dt = R_th R (1 + alpha T) i^2 - T; R = R_0 (1 + alpha T), kt = kt_0 (1 - beta T) with alpha =
    0.0039 /K
    (copper) and beta = 0.0011 /K (NdFeB with a ferrite share; brushed motors' data sheets give 0.0005 to 0.002).
    Limits: one thermal mass; the housing's minutes-long rise is not modelled; no demagnetisation.
    """

    name = "winding_heating"
    title = "winding heating"
    parameters = (
        EffectParameter("thermal_resistance", "K/W", 0.0, 100.0, 15.0, 0.0, "winding to ambient R_th"),
        EffectParameter(
            "time_constant", "s", 1.0, 600.0, 20.0, None, "thermal time constant t_w", starts=(10.0, 100.0)
        ),
    )
    states = 1
    memory = True
    looks_like = (
        "from closure to closure the voltage for the same motion rises, and the current for the same load"
    )
    told_by = "many grasps in a row, voltage logged"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        resistance = x[RESISTANCE] * (1.0 + ALPHA * s[0])
        s[0] += x[DT] / p[1] * (p[0] * resistance * x[CURRENT] * x[CURRENT] - s[0])
        y[RESISTANCE_REL] += ALPHA * s[0]
        y[KT_REL] -= BETA * s[0]

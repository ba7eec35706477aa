"""A bridge that lets the motor coast between pulses (`--effect coasting_bridge.py:CoastingBridge`).

Small drivers in "fast decay" mode open the winding in the off-time of the PWM.  Set EMF to the back-EMF constant at the
output, motor.kt x gear.ratio.
"""

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import SUPPLY, VOLTAGE, VOLTAGE_DROP, V

EMF = 0.3
"""V.s/rad (V.s/m on a linear rig)."""


class CoastingBridge(Effect):
    """Back-EMF that brakes only while the bridge is on, the part |u| / U of each pulse.

    Equation: mean over a pulse of U sign(u) - k w while it is on, and of nothing while it is off: u - (|u| / U) k w; so
    (1 - |u| / U) k w is taken out of the plant's own back-EMF.  All of it is off at k = motor.kt x gear.ratio; a part
    of it where the current flows on for a while (mixed decay).
    Limits: the current is taken to be gone at once when the bridge opens.
    """

    name = "coasting_bridge"
    title = "bridge that coasts between pulses"
    parameters = (
        EffectParameter("emf", "V.s/rad", 0.0, 2.0 * EMF, EMF, 0.0, "back-EMF k that is gone at rest"),
    )
    looks_like = "at small commands the machine runs on, and is hardly braked when the command falls"
    told_by = "steps of the command down to a half and to nothing, at several speeds"

    @staticmethod
    def contribute(x, p, s, y):
        on = min(abs(x[VOLTAGE]) / x[SUPPLY], 1.0)
        y[VOLTAGE_DROP] -= (1.0 - on) * p[0] * x[V]

"""Effects that are not in the catalogue and not made from it: the lab must call them unknown."""

import math
from typing import Any

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import DAMPING, DT, FRICTION, LOAD_FRICTION, LOAD_TORQUE, QL, TORQUE, VL, V


class Latch(Effect):
    """A latch that holds the fingers at one angle and lets go: tau = -A u exp(-u^2), u = (ql - 6) / 0.5."""

    name = "outside_latch"
    parameters = (EffectParameter("torque", "N.m", 0.0, 1.0, 0.05, 0.0, "peak torque"),)

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        u = (x[QL] - 6.0) / 0.5
        y[LOAD_TORQUE] -= p[0] * u * math.exp(-u * u)


class TightSpot(Effect):
    """A joint that rubs around one angle: dry friction A exp(-((ql - 5) / 0.7)^2)."""

    name = "outside_tight_spot"
    parameters = (EffectParameter("friction", "N.m", 0.0, 1.0, 0.03, 0.0, "friction there"),)

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        u = (x[QL] - 5.0) / 0.7
        y[LOAD_FRICTION] += p[0] * math.exp(-u * u)


class DwellStiction(Effect):
    """Stiction that grows while the hand rests (Rabinowicz) and is worked off by motion."""

    name = "outside_dwell_stiction"
    parameters = (EffectParameter("stiction", "N.m", 0.0, 1.0, 0.06, 0.0, "stiction after a long rest"),)
    states = 1

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        if abs(x[V]) < 0.05:
            s[0] += x[DT] / 0.5 * (1.0 - s[0])
        else:
            s[0] -= x[DT] / 0.05 * s[0]
        y[FRICTION] += p[0] * s[0]


class Mount(Effect):
    """A second body on a soft mount, shaken by the hand: a lightly damped resonance at 4 Hz."""

    name = "outside_mount"
    parameters = (EffectParameter("stiffness", "N.m/rad", 0.0, 1.0, 0.02, 0.0, "of the mount"),)
    states = 2

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        w = 2.0 * math.pi * 4.0
        pull = x[QL] - s[0]
        s[1] += x[DT] * (w * w * pull - 2.0 * 0.05 * w * (s[1] - x[VL]))
        s[0] += x[DT] * s[1]
        y[LOAD_TORQUE] -= p[0] * pull


class Drag(Effect):
    """Drag with the square of the speed: B = c |v|."""

    name = "outside_drag"
    parameters = (EffectParameter("coefficient", "N.m.s2/rad2", 0.0, 1.0, 1.5e-4, 0.0, "c"),)

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[DAMPING] += p[0] * abs(x[V])


class SlowSpring(Effect):
    """A spring whose rest angle follows the hand while it is closed and returns slowly: creep with a threshold."""

    name = "outside_creep"
    parameters = (EffectParameter("stiffness", "N.m/rad", 0.0, 1.0, 0.01, 0.0, "of the creeping spring"),)
    states = 1

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        stretch = x[QL] - 8.0 - s[0]
        if stretch > 0.0:
            s[0] += x[DT] / 0.3 * stretch
            y[TORQUE] -= p[0] * stretch
        else:
            s[0] -= x[DT] / 2.0 * s[0]


NAMES = ("Latch", "TightSpot", "DwellStiction", "Mount", "Drag", "SlowSpring")
